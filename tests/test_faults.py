"""Faults planted inside a tuning: refused, told, dumped, done again, and never in the weights."""

import json
import re
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.cli.main import main
from hector_jax.control.parameters import bounds
from hector_jax.control.reference import Command
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.core import tree_file
from hector_jax.core.runtime import workers
from hector_jax.report.run import tuning_section
from hector_jax.robot.model import load_robot
from hector_jax.runs import replay, tunings
from hector_jax.runs.folder import Journal
from hector_jax.runs.setup import Setup
from hector_jax.runs.tunings import Problem
from hector_jax.tuning import rollout
from hector_jax.tuning.difftune import TuneConfig, descend
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.rollout import RolloutConfig
from tests.model import small_net

pytestmark = pytest.mark.usefixtures("on_cpu")
ROBOT = load_robot()
TICKS, AT = 24, 9  # of the walk, of the fault
CONFIG = TuneConfig(rollout=RolloutConfig(ticks=TICKS), iterations=14)


class Fault(IntEnum):
    """What is planted; told to the program in the command, so that all share one."""

    NONE = 0
    STATE = 1
    GRADIENT = 2
    QP = 3
    FALL = 4
    FLAT = 5


REASONS = {
    Fault.STATE: "loss or gradient not finite",
    Fault.GRADIENT: "loss or gradient not finite",
    Fault.QP: "QP residual inf too large",
    Fault.FALL: "the robot fell",
    Fault.FLAT: "QP residual inf too large",
}
FIRST = {
    Fault.STATE: {"not finite": AT, "fallen": AT, "unsolved": AT},
    Fault.GRADIENT: {"not finite": None, "fallen": None, "unsolved": None},
    Fault.QP: {"not finite": None, "fallen": None, "unsolved": AT},
    Fault.FALL: {"not finite": None, "fallen": AT, "unsolved": None},
    Fault.FLAT: {"not finite": None, "fallen": None, "unsolved": AT},
}


def told(fault=Fault.NONE, reach=0.0):
    """A straight line whose last piece, never walked, names the fault.

    It shows in weights that are further than `reach`, in log-weights, from the nominal ones.
    """
    seconds, velocity = np.array([1e3, 1.0]), np.array([[0.5, 0.0], [float(AT), reach]])
    return Command(*(np.concatenate([x, x[:1]]) for x in (seconds, velocity, [0.0, fault])))


@jax.custom_vjp
def spoiled(x, flag):
    """`x`, with a gradient that is not a number where the flag is set."""
    return x


spoiled.defvjp(lambda x, flag: (x, flag), lambda flag, g: (jnp.where(flag, jnp.nan, g), None))

step_carry = rollout.step_carry


def planted(config, robot, weights, command, effect, carry, tick, variation=None):
    """`step_carry` with the fault that the command names."""
    flat = [weights_to_vector(w) for w in (weights, nominal())]
    far = jnp.max(jnp.abs(jnp.log(flat[0] / flat[1]))) > command.velocity[1, 1]
    now = far & (tick == command.velocity[1, 0])
    is_now = lambda fault: now & (command.yaw_rate[1] == fault)  # noqa: E731
    walked = command._replace(yaw_rate=jnp.zeros_like(command.yaw_rate))
    position = spoiled(carry.state.position, is_now(Fault.GRADIENT))
    position = jnp.where(is_now(Fault.STATE), jnp.nan, position)
    position = position.at[2].set(jnp.where(is_now(Fault.FALL), 0.1, position[2]))
    carry = carry._replace(state=carry.state._replace(position=position))
    curved = jnp.where(is_now(Fault.QP), -1.0, weights.R.force)  # a QP that is not convex
    weights = weights._replace(R=weights.R._replace(force=curved))
    # a QP without a price, solved by any wrench
    weights = jax.tree.map(lambda w: jnp.where(is_now(Fault.FLAT), 0.0, w), weights)
    return step_carry(config, robot, weights, walked, effect, carry, tick, variation)


@pytest.fixture(scope="module", autouse=True)
def plant():
    """The commands of this file have a shape of their own, so that no other test meets it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "step_carry", planted)
        yield


@pytest.fixture(scope="module")
def params():
    """A small net that adds a newton or so to what was commanded."""
    return small_net()


def tune(folder, command, params, config=CONFIG, robot=ROBOT):
    """The tuning as a run does it; with the lines that it left."""
    with ThreadPoolExecutor(1) as pool, TemporaryDirectory() as kept:
        found = tunings.tune(
            Setup(pool, config, robot),
            {"with": Problem((command,), params)},
            Path(kept),
            title="tuning",
            journal=Journal(Path(kept) / "metrics.jsonl"),
            dumps=folder,
        )
        lines = (Path(kept) / "metrics.jsonl").read_text().splitlines()
    return found["with"].tuning, [json.loads(line) for line in lines]


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["hector", *map(str, arguments)])
    return main()


def inside(weights):
    lower, upper, vector = (np.asarray(weights_to_vector(w)) for w in (*bounds(), weights))
    return bool(((lower <= vector) & (vector <= upper)).all())  # NaN is not


def test_without_a_fault_nothing_is_dumped(tmp_path, params):
    found, lines = tune(tmp_path / "dumps", told(), params)
    assert all(line["accepted"] for line in lines)
    assert len(lines) == 15
    assert found.stop == "14 iterations"
    assert not (tmp_path / "dumps").exists()


@pytest.mark.parametrize("fault", REASONS)
def test_a_fault_is_refused_and_shrunk_and_the_run_goes_on(tmp_path, params, fault):
    """It shows beyond 0.03 in log-weights: a full step is 0.08, a quarter of it stays within."""
    found, lines = tune(tmp_path / "dumps", told(fault, 0.03), params)
    assert [line["step"] for line in lines[:4]] == [0.0, 1.0, 0.5, 0.25]
    assert [line["accepted"] for line in lines[:4]] == [True, False, False, True]
    for before, line in zip(lines[1:], lines[2:], strict=False):
        grown = min(1.0, 2.0 * before["step"])
        assert line["step"] == (grown if before["accepted"] else before["step"] / 2)
    reasons = Counter(line["reason"] for line in lines if not line["accepted"])
    assert reasons.keys() <= {REASONS[fault], "the loss rose"}
    assert reasons[REASONS[fault]] >= 3
    refused = sum(not line["accepted"] for line in lines)
    assert f"{len(lines) - 1} iterations, {refused} refused" in tuning_section("with", found)
    assert all(inside(weights) for weights in (found.ten, found.converged))
    assert all(inside(iteration.weights) for iteration in found.history)
    assert weights_to_vector(found.converged)[0] != weights_to_vector(nominal())[0]

    dumps = sorted((tmp_path / "dumps").iterdir())
    kinds = {Fault.QP: "unsolved", Fault.FLAT: "unsolved", Fault.FALL: "fell"}
    kind = kinds.get(fault, "not-finite")
    assert [path.name for path in dumps[:2]] == [f"with-00{i}-{kind}.npz" for i in (1, 2)]
    assert len(dumps) == replay.MOST
    for path in dumps:
        done = replay.replay(path)
        assert done.same
        assert done.recorded["reason"] == done.again["reason"] == REASONS[fault]
        assert done.first == FIRST[fault]
        assert done.changed.keys() <= {"commit"}  # this checkout may change beside a test


@pytest.mark.parametrize("fault", [Fault.FALL])
def test_where_every_step_is_refused_the_run_ends_with_the_reason(tmp_path, params, fault):
    found, lines = tune(tmp_path / "dumps", told(fault), params)
    assert not any(line["accepted"] for line in lines[1:])
    assert [line["step"] for line in lines[1:]] == [0.5**i for i in range(len(lines) - 1)]
    expected = f"the step became too small to gain, the last refused: {REASONS[fault]}"
    assert found.stop == expected
    for weights in (found.ten, found.converged):
        jax.tree.map(np.testing.assert_array_equal, weights, nominal())
    assert len(list((tmp_path / "dumps").iterdir())) == replay.MOST


def spoilt_net(params):
    kernel = params.force["Dense_0"]["kernel"].at[0, 0, 0].set(jnp.nan)
    force = {**params.force, "Dense_0": {**params.force["Dense_0"], "kernel": kernel}}
    return told(), params._replace(force=force), ROBOT


def crouched(params):
    return told(), params, ROBOT._replace(standing_height=np.asarray(0.1))


@pytest.mark.parametrize(
    ("spoil", "reason", "first"),
    [
        (spoilt_net, "loss or gradient not finite", "not finite"),
        (crouched, "the robot fell", "fallen"),
    ],
)
def test_a_start_that_cannot_be_believed_ends_the_run_and_leaves_a_dump(
    tmp_path, capsys, monkeypatch, params, spoil, reason, first
):
    command, net, robot = spoil(params)
    with pytest.raises(ValueError, match=f"the starting weights cannot be tuned from: {reason}"):
        tune(tmp_path / "dumps", command, net, robot=robot)
    (path,) = (tmp_path / "dumps").iterdir()
    said = " ".join(capsys.readouterr().err.split())
    assert f"with, iteration 0: {reason}; see hector replay {path}" in said
    assert call(monkeypatch, "replay", path, "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["same"] is True
    assert shown["first"][first] == 0
    assert shown["recorded"] == shown["again"]
    assert shown["again"]["reason"] == reason


@pytest.mark.slow  # compiled in two processes
def test_a_dump_of_a_worker_is_reproduced_by_the_console_script(tmp_path, params):
    """A worker holds one core, the console script has all; the robot is asked to run."""
    command = Command(np.array([0.2, 9.0]), np.array([[0.5, 0.0], [9.0, 0.0]]), np.zeros(2))
    config = TuneConfig(rollout=RolloutConfig(ticks=80), iterations=10)
    with workers(2) as pool:
        problems = {"with": Problem((command,), params)}
        kept, dumps = tmp_path / "kept", tmp_path / "dumps"
        told = tunings.tune(Setup(pool, config, ROBOT), problems, kept, title="", dumps=dumps)
        found = told["with"].tuning
    path = min(dumps.iterdir())
    number = min(i.iteration for i in found.history if i.reason == "the robot fell")
    assert path.name == f"with-{number:03d}-fell.npz"
    shown = subprocess.run(
        [sys.executable, "-m", "hector_jax.cli.main", "replay", path],
        capture_output=True,
        text=True,
    )
    assert shown.returncode == 0, shown.stderr
    print(shown.stdout)
    first = re.search(r"first fallen +tick (\d+)", shown.stdout)
    assert 20 < int(first[1]) < 80


# What replay says


@pytest.fixture(scope="module")
def dump(tmp_path_factory, params):
    folder = tmp_path_factory.mktemp("dumps")
    tune(folder, told(Fault.FALL), params, TuneConfig(rollout=CONFIG.rollout, iterations=1))
    (path,) = folder.iterdir()
    return path


def rewritten(path, dump, change):
    """The dump's numbers under `path`, after a change to the notes on its card."""
    kept, config, about = replay.load(dump)
    about = json.loads(json.dumps(about))
    change(about)
    loss = np.nextafter(kept.seen.loss, np.inf)
    kept = kept._replace(seen=kept.seen._replace(loss=loss))
    tree_file.save_tree(path, kept, kind="refused evaluation", about=about)
    return path


def test_a_dump_tells_what_was_and_what_is(monkeypatch, capsys, dump):
    assert call(monkeypatch, "replay", dump) == 0
    rows = capsys.readouterr().out.splitlines()
    assert rows[0] == "with, iteration 1"
    assert rows[2].split() == ["reason", *2 * ["the", "robot", "fell"]]
    assert ["first", "fallen", "tick", str(AT)] in [row.split() for row in rows]
    assert rows[-1] == "the same to the last bit"


def test_one_other_bit_is_not_reproduced(monkeypatch, capsys, tmp_path, dump):
    path = rewritten(tmp_path / "dump.npz", dump, lambda about: None)
    assert call(monkeypatch, "replay", path) == 1
    shown, line = capsys.readouterr()
    assert "not reproduced: the same reason, other numbers; same versions" in shown
    assert line.count("\n") == 1
    assert str(path) in line


def test_a_dump_of_another_version_says_which(monkeypatch, capsys, tmp_path, dump):
    path = rewritten(
        tmp_path / "dump.npz", dump, lambda about: about["environment"].update(jax="0.1")
    )
    assert call(monkeypatch, "replay", path, "--json") == 1
    shown, line = capsys.readouterr()
    assert json.loads(shown)["changed"] == {"jax": ["0.1", jax.__version__]}
    assert f"changed since: jax 0.1 -> {jax.__version__}" in line


def test_settings_of_another_version_are_refused_by_name(monkeypatch, capsys, tmp_path, dump):
    path = rewritten(
        tmp_path / "dump.npz", dump, lambda about: about["config"]["rollout"].update(leap=3)
    )
    assert call(monkeypatch, "replay", path) == 2
    line = capsys.readouterr().err
    assert f"{path}: config: rollout: unknown field 'leap'" in line


def test_a_dump_is_replayed_on_the_cpu(monkeypatch, dump):
    on_cpus = []
    monkeypatch.setattr("hector_jax.cli.main.start_jax", lambda on_cpu: on_cpus.append(on_cpu))
    assert call(monkeypatch, "replay", dump) == 0
    assert on_cpus == [True]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match="JAX_PLATFORMS=cpu"):
        replay.replay(dump)


def test_what_is_no_dump_is_refused(monkeypatch, capsys, tmp_path, dump):
    cut, other = tmp_path / "cut.npz", tmp_path / "other.npz"
    cut.write_bytes(dump.read_bytes()[:-100])
    tree_file.save_tree(other, nominal(), kind="weights")
    for path, expected in (
        (cut, "cut or changed"),
        (other, "holds weights, expected refused evaluation"),
        (tmp_path / "none.npz", "cannot read"),
    ):
        assert call(monkeypatch, "replay", path) == 2
        line = capsys.readouterr().err
        assert expected in line
        assert str(path) in line


def test_a_folder_that_cannot_be_written_does_not_end_the_tuning(tmp_path, capsys, params):
    (tmp_path / "wall").write_text("a file, where a folder is wanted")
    config = TuneConfig(rollout=CONFIG.rollout, iterations=4)
    _, lines = tune(tmp_path / "wall", told(Fault.FALL), params, config)
    assert len(lines) > 3
    assert "a refused step was not recorded" in capsys.readouterr().err


# Numbers that no rollout gives


def evaluated(loss, gradient):
    one = np.asarray(1.0)
    loss = np.asarray(float(loss))
    tree = jax.tree.map(lambda w: np.full_like(w, gradient), nominal())
    terms = dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), one)
    return Evaluation(loss, terms, tree, np.asarray(0.0), np.asarray(1e-12))


@pytest.mark.parametrize(
    "number", [np.nan, np.inf, -np.inf, 1.7e308, -1.7e308, 1e-308, 5e-324, 0.0]
)
@pytest.mark.parametrize("update", ["relative", "literal"])
@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_no_number_makes_weights_that_are_not_finite(number, update, where):
    """From the third evaluation on."""
    looks = Counter()

    def look(weights):
        looks["all"] += 1
        odd = {where: number} if looks["all"] > 2 else {}
        return evaluated(**{"loss": 1.0 / looks["all"], "gradient": 1e3, **odd})

    found = descend(TuneConfig(update=update, iterations=14), nominal(), look)
    assert all(inside(iteration.weights) for iteration in found.history)
    assert inside(found.ten)
    assert inside(found.converged)
    if not abs(number) < 1e150:
        assert not any(iteration.accepted for iteration in found.history[2:])
        assert found.stop.endswith("the last refused: loss or gradient not finite")
