"""Tuning on walks: the folder, the logs, and files against walks in process."""

from concurrent.futures import Executor, ThreadPoolExecutor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from pretend import pretend_history

from hector_jax.cli import tune as command
from hector_jax.cli.flags import Tune
from hector_jax.control.reference import named_command
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import expert, nominal
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import save_tree
from hector_jax.robot.model import load_robot
from hector_jax.runs import walks
from hector_jax.runs.tunings import Tuned
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import TuneConfig, Tuning
from hector_jax.tuning.rollout import RolloutConfig

COMMAND = {"s": named_command("s")}
CONFIG = TuneConfig(rollout=RolloutConfig(ticks=6))


@pytest.fixture(scope="module")
def robot():
    return jax.tree.map(np.asarray, load_robot())


@pytest.fixture(scope="module")
def pool():
    with ThreadPoolExecutor(1) as pool:
        yield pool


def campaign(folder, robot, plants=(None,), seed=0):
    return walks.campaign(folder, CONFIG, robot, nominal(robot), COMMAND, plants, seed)


@pytest.fixture(scope="module")
def in_process(robot, pool, tmp_path_factory):
    one = campaign(tmp_path_factory.mktemp("walked"), robot, [hfs()])
    return one, *walks.tune_on_walks(pool, one, 10)


def walked(robot, weights, path):
    job = Job(weights, COMMAND["s"], hfs(), 0.06)
    save_tree(path, walk(CONFIG.rollout.walk, robot, job), kind="trajectory", robot=robot)
    return path


def test_ten_walks_through_files_equal_ten_in_process_to_the_last_bit(
    robot, pool, in_process, tmp_path
):
    one, (_, _, rows) = campaign(tmp_path, robot), in_process
    space, again = walks.space_of(pool, one), []
    for number in range(10):
        again = walks.read_history(one)  # as a new process would
        proposal, weights = walks.next_proposal(pool, one, space, again)
        log = walks.read_log(walked(robot, weights, tmp_path / f"{number}.npz"), robot, 0.06)
        again = walks.add_walk(one, again, proposal, walks.see(pool, one, [log]))
    assert len(again) == len(rows) == 10
    for mine, theirs in zip(again, rows, strict=True):
        np.testing.assert_array_equal(mine.point, theirs.point)
        np.testing.assert_array_equal(mine.losses, theirs.losses)
        assert (mine.method, mine.predicted) == (theirs.method, theirs.predicted)
    assert min(row.losses[0] for row in rows) < 0.9 * rows[0].losses[0]


def test_what_was_walked_is_not_walked_again(monkeypatch, pool, in_process):
    one, weights, _ = in_process
    monkeypatch.setattr(walks, "_walk_job", None)
    again, _ = walks.tune_on_walks(pool, one, 10)
    np.testing.assert_array_equal(again.Q.euler, weights.Q.euler)


def test_the_record_of_another_tuning_is_refused(robot, in_process):
    one = in_process[0]._replace(seed=1)
    with pytest.raises(InputError, match=r"its seed is 0, expected 1"):
        walks.read_history(one)


def test_a_start_that_falls_is_refused(robot, pool, in_process, tmp_path):
    one, space = campaign(tmp_path, robot), walks.space_of(pool, in_process[0])
    row = walks.Row(np.zeros(18), "start", None, np.array([np.inf]), 1.0)
    with pytest.raises(InputError, match="the start fell"):
        walks.next_proposal(pool, one, space, [row])


@pytest.fixture
def arrays(robot, tmp_path):
    path = walked(robot, nominal(robot), tmp_path / "whole.npz")
    with np.load(path) as archive:
        return {name: archive[name] for name in archive.files if name != "card"}


def test_a_plain_archive_with_the_least_entries_is_a_log(robot, arrays, tmp_path):
    least = {n: x for n, x in arrays.items() if n.split(".")[0] in ("initial", "state", "command")}
    np.savez(tmp_path / "least.npz", joints=arrays["joints"], **least)
    log = walks.read_log(tmp_path / "least.npz", robot, 0.06)
    assert log.joints.shape == (60, 10)
    assert not log.fallen.any()
    # a log that ends early is that of a fall
    seen = walks._see(
        CONFIG, robot, COMMAND["s"], walks.read_log(tmp_path / "least.npz", robot, 0.06)
    )
    assert np.isfinite(seen[0].loss)
    short = walks.read_log(tmp_path / "least.npz", robot, 0.08)
    assert short.fallen.tolist() == [False] * 60 + [True] * 20


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joints": np.zeros((60, 9))}, r"joints must have shape \(60, 10\), got \(60, 9\)"),
        ({"state.euler": np.full((60, 3), np.nan)}, "state.euler must hold finite numbers"),
        ({"period": np.array(0.01)}, "samples must be of 0.001 s, got 0.01"),
        ({"command.force": None}, "command.force is missing"),
        ({"joints": np.zeros((61, 10))}, "expected 60 samples of joints, got 61"),
    ],
)
def test_a_log_that_is_none_is_refused_in_one_line(robot, arrays, tmp_path, change, words):
    changed = {n: x for n, x in (arrays | change).items() if x is not None}
    np.savez(tmp_path / "log.npz", **changed)
    with pytest.raises(InputError, match=words):
        walks.read_log(tmp_path / "log.npz", robot, 0.06)


def test_what_is_no_archive_is_refused(robot, tmp_path):
    (tmp_path / "log.npz").write_text("no log")
    with pytest.raises(InputError, match="not a log"):
        walks.read_log(tmp_path / "log.npz", robot, 0.06)


def test_a_run_spends_the_walks_that_were_asked_for(monkeypatch, robot, tmp_path):
    there = Tuned(Tuning(pretend_history(3), nominal(), expert(), "done"), "")
    row = walks.Row(np.zeros(18), "start", None, np.ones(2), 0.1)
    seen = {}

    def on_walks(pool, one, count):
        seen.update(plants=len(one.plants), commands=list(one.commands), count=count)
        return expert(), [row]

    monkeypatch.setattr(command.tunings, "tune", lambda *_, **__: {"without": there, "with": there})
    monkeypatch.setattr(command.choice, "choose", lambda *_, **__: {})
    monkeypatch.setattr(command.choice, "answer", lambda *_, **__: nominal())
    monkeypatch.setattr(command, "tune_on_walks", on_walks)
    net = SimpleNamespace(params="a net")
    course = NamedCommand("straight", named_command("straight"))
    notes = {"seconds": 4.0, "config": CONFIG, "net": net, "commit": ""}
    args = Tune(walks=12, walk_plants=3)
    run = command._Run(tmp_path, args, robot, nominal(), (course,), **notes)
    tuned = command._tune_sets(Executor(), run)
    assert seen == {"plants": 3, "commands": ["straight"], "count": 12}
    assert tuned.sets["best"] is not tuned.sets["before_walks"]
    assert (tmp_path / "weights" / "before_walks.json").exists()
    assert walks.changes(tuned.walked)[0].change == 0.0
    with pytest.raises(InputError, match=r"--walks must be 0 or at least 6 .*, got 5"):
        command._trajectories(Tune(walks=5, walk_plants=3), robot)
