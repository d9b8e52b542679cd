"""Another biped: an MJCF and a short TOML, and no Python."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from model import EXAMPLES
from pretend import call

from hector_jax import Job, expert, hfs, ideal, load_robot, named_command, nominal, walk
from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.export.export import controller_of_run, find_weights
from hector_jax.robot.description import Description
from hector_jax.store import folder as runs
from hector_jax.store import nets
from hector_jax.store.collection import load_walks
from hector_jax.store.nets import CollectConfig

STRIDER = EXAMPLES / "strider" / "robot.toml"


@pytest.fixture(scope="module")
def strider():
    return load_robot(STRIDER)


def test_the_description_of_hector_says_what_the_code_takes_by_default():
    robot = load_robot()
    assert replace(robot.description, control=(), nominal=None, expert=None) == Description()
    assert walk_config(robot) == WalkConfig()
    assert repr(walk_config(robot)) == repr(WalkConfig())  # by which walks are known
    for of_robot, default in ((nominal(robot), nominal()), (expert(robot), expert())):
        jax.tree.map(np.testing.assert_array_equal, of_robot, default)


@pytest.mark.slow
def test_strider_walks_five_metres_untuned(strider):
    for world in (ideal, hfs):
        job = Job(nominal(strider), named_command("straight"), world(), 10.5)
        found = walk(walk_config(strider), strider, job)
        assert not found.fallen.any(), world
        assert not found.legs_touch.any(), world
        ahead, aside, up = found.state.position[-1] - found.initial.position
        assert ahead > 5.0, world
        assert max(abs(aside) / 5, abs(up)) < 0.1, world


@pytest.mark.long
@pytest.mark.slow
def test_strider_is_tuned_by_the_same_command_and_a_run_knows_it(monkeypatch, strider, tmp_path):
    monkeypatch.chdir(tmp_path)
    small = CollectConfig(walks=6, seconds=1.0)
    monkeypatch.setattr(nets, "CollectConfig", lambda: small)
    Path("ahead.toml").write_text('name = "ahead"\n[[segment]]\nseconds = 1.5\nv_x = 0.3\n')
    flags = ("--traj", "ahead.toml", "--seeds", "1", "--iterations", "4", "--no-video")
    few = ("--walk-plants", "1", "--processes", "1")
    assert call(monkeypatch, "tune", "--robot", STRIDER, *flags, *few) == 0
    assert len(load_walks(tmp_path / "data" / "strider" / "walks", strider).job.seed) == 6
    assert (tmp_path / "data" / "strider" / "grfm.npz").exists()
    with pytest.raises(ValueError, match="made for another robot"):
        load_walks(tmp_path / "data" / "strider" / "walks", load_robot())
    (run,) = (tmp_path / "runs" / "strider" / "ahead").iterdir()
    assert find_weights(run, "with") == run / "weights" / "with.json"
    assert controller_of_run(run) == walk_config(strider)
    assert runs.read_request(run).robot == STRIDER
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for name in ("without", "with"):
        L = [line["L"] for line in lines if line["set"] == name and line["accepted"]]
        assert L[-1] < 0.95 * L[0]
    assert json.loads((run / "result.json").read_text())["sets"]["with"]["hfs"]["falls"] == 0
