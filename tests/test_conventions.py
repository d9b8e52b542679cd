"""Conventions of a log, and of its controller's cost and model: planted ones are found."""

import json
from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from model import EXAMPLES
from pretend import call, refused

from hector_jax import InputError, expert, load_robot, named_command
from hector_jax.control.controller import walk_config
from hector_jax.control.twin import TwinConfig
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.own.conventions import find_conventions, settings_of
from hector_jax.own.walk_file import read_walk

TWIN = EXAMPLES / "own_controller" / "twin.toml"
SECONDS = 0.7
LINE = ("--traj", "s", "--seconds", SECONDS, "--weights", "expert")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """The entries of a log of the example."""
    pytest.importorskip("daqp")
    path = tmp_path_factory.mktemp("own") / "log.npz"
    with pytest.MonkeyPatch.context() as patch:
        words = ("walk", "--walker", TWIN.with_name("walker.py"), *LINE, "--out", path)
        assert call(patch, *words, "--robot", TWIN) == 0
    return dict(np.load(path))


WRENCHES, FORCES = ("command.force", "command.moment"), ("command", "effect", "contact")


# Each takes the entries of a log and returns those that it changes.


def legs(log):
    return {name: x[:, ::-1] for name, x in log.items() if name.startswith(FORCES)}


def joint_legs(log):
    return {"joints": np.roll(log["joints"], 5, axis=1)}


def on_ground(log):
    return {name: -log[name] for name in WRENCHES}


def turned(log, share):
    begins = np.concatenate([log["initial.euler"][None], log["state.euler"][:-1]])
    R = jax.vmap(rotation_from_euler)(begins * share)
    return {name: np.einsum("tji,tfj->tfi", R, log[name]) for name in WRENCHES}


heading, trunk = partial(turned, share=np.array([0.0, 0.0, 1.0])), partial(turned, share=1.0)


def ypr(log):
    return {name: x[..., ::-1] for name, x in log.items() if name.endswith(".euler")}


ORDER = ["right", "left"]
# changes of the log, in this order; how much of R, mass and height of its controller the file has
PLANTED = [
    ((legs,), {}, {"legs": ORDER}),
    ((joint_legs,), {}, {"joint_legs": ORDER}),
    ((legs, joint_legs), {}, {"legs": ORDER, "joint_legs": ORDER}),
    ((on_ground,), {}, {"wrenches": "on_ground"}),
    ((heading,), {}, {"wrench_frame": "heading"}),
    ((trunk,), {}, {"wrench_frame": "trunk"}),
    ((ypr,), {}, {"angles": "ypr"}),
    ((), {"R": 2.0}, {"input_cost": 0.5}),
    ((), {"R": 0.5}, {"input_cost": 2.0}),
    ((), {"R": 40.0}, {"input_cost": 0.025}),
    ((), {"R": 0.025}, {"input_cost": 40.0}),
    ((), {"R": 20.0}, {"input_cost": 0.05}),
    ((), {"mass": 0.85}, {"mass": 1.0}),
    ((), {"mass": 1.06}, {"mass": 1.0}),
    ((), {"height": 1.03}, {"height": 1.0}),
    ((), {"mass": 0.9, "height": 0.97}, {"mass": 1.0, "height": 1.0}),
    ((trunk, on_ground), {}, {"wrenches": "on_ground", "wrench_frame": "trunk"}),
    ((heading, legs), {}, {"legs": ORDER, "wrench_frame": "heading"}),
    ((trunk, on_ground), {"R": 0.5}, {"input_cost": 2.0, "wrenches": "on_ground"}),
    ((on_ground, ypr), {"mass": 1.1}, {"wrenches": "on_ground", "angles": "ypr", "mass": 1.0}),
]


def planted(folder, log, *, R=1.0, mass=1.0, height=1.0, file=TWIN):
    """Fields of [twin] that are found, and the mean error with them."""
    np.savez(folder / "log.npz", **log)
    robot, weights = load_robot(file), expert()
    body = robot._replace(mass=mass * robot.mass, standing_height=height * robot.standing_height)
    config = walk_config(robot)

    def read(twin):
        return read_walk(folder / "log.npz", robot, SECONDS, config.gait.tick, twin=twin)[0]

    weights = weights._replace(R=jax.tree.map(lambda x: R * x, weights.R))
    as_is, fit = find_conventions(read, config, body, weights, named_command("s"))
    found = settings_of(fit, as_is, body)
    for name, own in (("mass", robot.mass), ("height", robot.standing_height)):
        found |= {name: found[name] / float(own)} if name in found else {}
    return found, fit.error


@pytest.mark.parametrize(("changes", "model", "told"), PLANTED)
def test_a_planted_convention_is_found(tmp_path, walked, changes, model, told):
    log = dict(walked)
    for change in changes:
        log |= change(log)
    found, error = planted(tmp_path, log, **model)
    assert error < 0.01
    told = told | ({"wrench_frame": "trunk"} if trunk in changes else {})
    assert found.keys() == told.keys()
    for name, value in told.items():
        expected = pytest.approx(value, rel=1e-3) if isinstance(value, float) else value
        assert found[name] == expected, name


def test_a_convention_is_found_for_a_twin_with_another_centre_of_mass(tmp_path, walked):
    robot, file = load_robot(TWIN), tmp_path / "com.toml"
    own, height = robot.com_offset.tolist(), float(robot.standing_height)
    (tmp_path / "hector.xml").write_bytes(TWIN.with_name("hector.xml").read_bytes())
    file.write_text(f"{TWIN.read_text()}com = {own}\nheight = {height}\n")
    for log, told in ((walked, {}), (walked | on_ground(walked), {"wrenches": "on_ground"})):
        found, error = planted(tmp_path, log, file=file)
        assert found == told
        assert error < 0.01


def test_in_a_sound_log_no_convention_is_named(tmp_path, walked):
    rng = np.random.default_rng(0)
    noise = {name: walked[name] + 0.05 * rng.normal(size=walked[name].shape) for name in WRENCHES}
    for log in (walked, walked | noise):
        assert planted(tmp_path, log)[0] == {}
    # nor in one of another controller, that no convention makes that of the twin
    other = {name: np.roll(walked[name], 250, axis=0) for name in WRENCHES}
    assert planted(tmp_path, walked | other)[0] == {}


def test_the_lines_that_are_told_make_the_log_fit(tmp_path, walked, monkeypatch, capsys):
    log = walked
    for change in (trunk, on_ground, legs, ypr):
        log = log | change(log)
    path, robot = tmp_path / "log.npz", tmp_path / "mine.toml"
    np.savez(path, **log)
    (tmp_path / "hector.xml").write_bytes(TWIN.with_name("hector.xml").read_bytes())
    robot.write_text(TWIN.read_text())
    words = ("log", "twin", path, *LINE, "--robot", robot)
    assert call(monkeypatch, *words) == 0
    lines = capsys.readouterr().out.splitlines()
    pasted = lines[lines.index("[twin]") + 1 :]
    assert pasted == [
        'legs = ["right", "left"]',
        'wrenches = "on_ground"',
        'wrench_frame = "trunk"',
        'angles = "ypr"',
    ]
    robot.write_text(TWIN.read_text() + "\n".join(pasted) + "\n")
    assert call(monkeypatch, *words, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["conventions"] == {}
    assert max(of["worst"] for of in found["differences"].values()) < 1e-6
    robot.write_text(TWIN.read_text() + 'legs = ["left", "middle"]\n')
    told = "[twin] legs and joint_legs must be left, right in their order, got left, middle"
    assert told in refused(monkeypatch, capsys, *words)
    with pytest.raises(InputError, match="TwinConfig.angles must be 'rpy' or 'ypr'"):
        replace(TwinConfig(), angles="zyx")
