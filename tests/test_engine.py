"""Engines as values: what is chosen once and passed down, and how one is added."""

import json
import sys

import jax
import numpy as np
import pytest

from hector_jax.cli.main import main
from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import ENGINES, MJX, MUJOCO_C, Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import ideal
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout


def walk_rigid(pool, config, robot, jobs, *, exact=True, batch=0):
    """The plain single rigid body as an engine: it knows no plant, and samples once per tick."""
    walked = jax.jit(rollout, static_argnums=0)
    for job in jobs:
        rollout_config = RolloutConfig(config, ticks=round(job.seconds / config.gait.tick))
        anchor = standing_anchor(robot, job.start_tick)
        scenario = Scenario(robot, job.command, anchor, last_command)
        yield jax.device_get(walked(rollout_config, scenario, job.weights))


RIGID = Engine("rigid", "rigid body", walk_rigid, lambda exact: 64)


def test_an_engine_is_added_in_one_place(monkeypatch):
    monkeypatch.setitem(ENGINES, "rigid", RIGID)
    engine = choose_engine("rigid")
    jobs = [Job(nominal(), named_command("straight"), ideal(), 0.5, start_tick=i) for i in (0, 20)]
    left, right = engine.walk(None, WalkConfig(), load_robot(), jobs)
    assert left.fallen.shape == (50,)
    assert not left.fallen.any()
    np.testing.assert_array_equal(left.contact[0], ~right.contact[0])


def test_auto_is_mjx_where_there_is_an_accelerator(monkeypatch):
    assert choose_engine("c") is MUJOCO_C
    assert choose_engine("mjx") is MJX
    for backend, engine, bits in (("cpu", MUJOCO_C, 64), ("gpu", MJX, 32)):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert choose_engine("auto") is engine
        assert (engine.bits(False), engine.bits(True)) == (bits, 64)


def test_an_engine_that_is_not_installed_says_what_to_install(monkeypatch):
    monkeypatch.setitem(ENGINES, "drake", ENGINES["drake"]._replace(package="no-such-package"))
    expected = (
        r"drake needs no-such-package, which is not installed: pip install 'hector-jax\[drake\]'"
    )
    with pytest.raises(InputError, match=expected):
        choose_engine("drake")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("import nose_of_old", "pinocchio cannot be loaded from {}: No module named 'nose_of_old'"),
        ("", "Pinocchio (pip install 'pin>=4.1') is expected, {} is another"),
    ],
)
def test_an_engine_of_another_python_or_of_other_people_is_named(monkeypatch, tmp_path, text, line):
    for loaded in [x for x in sys.modules if x.split(".")[0] in ("pinocchio", "coal")]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.delitem(sys.modules, "hector_jax.sim.pinocchio", raising=False)
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own / "pinocchio", own / "coal", own / "pin-9.0.dist-info", other / "pinocchio"):
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text("")
    (own / "pin-9.0.dist-info" / "METADATA").write_text("Name: pin\nVersion: 9.0")
    (file := other / "pinocchio" / "__init__.py").write_text(text)
    monkeypatch.setattr(sys, "path", [sys.path[0], str(other), str(own), *sys.path[1:]])
    monkeypatch.setenv("PYTHONPATH", str(other))
    with pytest.raises(InputError) as refused:
        choose_engine("pinocchio")
    assert str(refused.value).startswith(line.format(file))


def test_a_walk_and_an_evaluation_take_another_engine(monkeypatch, capsys):
    jobs = []

    def walk(pool, config, robot, them, **others):
        jobs.extend(them)
        return walk_rigid(pool, config, robot, them)

    monkeypatch.setitem(ENGINES, "mjx", MJX._replace(walk=walk))
    flags = ["--engine", "mjx", "--seconds", "0.5", "--json"]  # the program of the test above
    monkeypatch.setattr(sys, "argv", ["hector", "walk", "--world", "ideal", *flags])
    assert main() == 0
    assert json.loads(capsys.readouterr().out)["engine"] == "mjx"
    evaluate = ["hector", "evaluate", "--world", "hfs", "--weights", "nominal", *flags]
    monkeypatch.setattr(sys, "argv", evaluate)
    assert main() == 0
    assert json.loads(capsys.readouterr().out)["engine"] == "mjx"
    assert len(jobs) == 2
    monkeypatch.setattr(sys, "argv", ["hector", "walk", "--world", "srbm", *flags])
    assert main() == 2
    assert "--engine mjx needs a world with a plant" in capsys.readouterr().err
