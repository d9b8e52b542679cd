"""Another biped: an MJCF and a short TOML, and no Python."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.cli import main as cli
from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table
from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.files import write_json
from hector_jax.export.export import find_weights
from hector_jax.grfm.collection import load_walks
from hector_jax.robot.description import Description
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, hfs, ideal
from hector_jax.store import folder as runs
from hector_jax.store import nets
from hector_jax.store.cache import robot_hash
from hector_jax.store.nets import CollectConfig
from hector_jax.tuning.difftune import TuneConfig

STRIDER = Path(__file__).parents[1] / "examples" / "strider" / "robot.toml"

foot_poses_jit = jax.jit(foot_poses)


@pytest.fixture(scope="module")
def strider():
    return load_robot(STRIDER)


# What the description says


def test_the_description_of_hector_says_what_the_code_takes_by_default():
    robot = load_robot()
    assert replace(robot.description, control=(), nominal=None, expert=None) == Description()
    assert walk_config(robot) == WalkConfig()
    assert repr(walk_config(robot)) == repr(WalkConfig())  # by which walks are known
    for of_robot, default in ((nominal(robot), nominal()), (expert(robot), expert())):
        jax.tree.map(np.testing.assert_array_equal, of_robot, default)


def test_strider_stands_with_both_soles_on_the_floor(strider):
    feet = foot_poses_jit(strider, jnp.asarray(strider.standing_joints))
    np.testing.assert_allclose(feet.position[:, 2], -strider.trunk_height, atol=1e-5)
    assert -strider.heel < strider.com_offset[0] - feet.position[0, 0] < strider.toe


def test_imperfections_reach_the_joints_of_any_robot(strider):
    world = build_world(hfs(), strider.description)
    assert world.model.joint(int(world.slack[3])).name == "left_knee_backlash"
    np.testing.assert_array_equal(world.model.dof_frictionloss[world.joint_dof], 0.3)
    assert world.model.body_mass.sum() == pytest.approx(float(strider.mass))
    heavy = build_world(ideal()._replace(mass=np.array(1.1)), strider.description)
    assert heavy.model.body_mass.sum() == pytest.approx(1.1 * float(strider.mass))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[gait]", "[gate]", ["robot.toml: unknown field 'gate'", "did you mean 'gait'?"]),
        ("stance = 22", 'stance = "22"', ["gait: stance must be a whole number", "got '22'"]),
        (
            "kp = [150,",
            "kp = [",
            ["legs.kp must be a gain for each of the 5 joints", "got (150.0,"],
        ),
        ("min_height", "height", ["limits: unknown field 'height'", "did you mean 'min_height'?"]),
        ("[mpc]", "[mpc]\nstep_ticks = 1", ["robot.toml: gait.tick must be at most half"]),
        ('"left_yaw", ', "", ["joints: left and right must be 3 to 7 names each", "got 4 and 5"]),
        ("toe = ", "tow = ", ["feet: left: unknown field 'tow'", "did you mean 'toe'?"]),
        ("linkage = [5, 4]", "linkage = [6, 4]", ["joints: linkage must be two", "from 1 to 5"]),
        ("nominal.force", "nominal.farce", ["weights: nominal: unknown field 'farce'", "'force'?"]),
        (
            "nominal.euler = 50",
            "nominal.euler = [50, 0, 50]",
            ["weights: nominal: euler must be a number above 0", "got [50, 0, 50]"],
        ),
        ('model = "strider.xml"', "", ["robot.toml: model is missing", "MJCF or URDF, beside"]),
        ('"left_knee"', '"left_nee"', ["no joint 'left_nee'", "did you mean 'left_knee'?"]),
        ('"left_sole"', '"left_soul"', ["no site 'left_soul'", "did you mean 'left_sole'?"]),
    ],
)
def test_a_wrong_description_is_refused_in_one_line(tmp_path, old, new, words):
    text, xml, path = STRIDER.read_text(), STRIDER.with_name("strider.xml"), tmp_path / "robot.toml"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    (tmp_path / xml.name).write_text(xml.read_text())
    with pytest.raises(ValueError, match=str(tmp_path)) as caught:
        walk_config(load_robot(path))
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


# What a run leaves


def test_a_run_is_exported_and_viewed_with_the_robot_that_it_was_for(strider, tmp_path):
    settings = TuneConfig()
    walk = replace(settings.rollout, walk=walk_config(strider))
    config = {
        "flags": as_table(Tune(robot=STRIDER)),
        "robot": robot_hash(strider),
        "tune": replace(settings, rollout=walk).as_table(),
    }
    write_json(tmp_path / "config.json", config)
    save_weights(tmp_path / "weights" / "with.json", expert(strider))
    weights = tmp_path / "weights" / "with.json"
    assert find_weights(tmp_path, "with") == (weights, walk_config(strider))
    assert runs.read_request(tmp_path).robot == STRIDER
    found, _ = runs.weights_of(tmp_path, "nominal", strider)
    jax.tree.map(np.testing.assert_array_equal, found, nominal(strider))


# It walks


def walked(robot, world, seconds):
    job = Job(nominal(robot), named_command("straight"), world(), seconds)
    found = walk(walk_config(robot), robot, job)
    assert not found.fallen.any(), world
    assert not found.legs_touch.any(), world
    return found.state.position[-1] - found.initial.position


@pytest.mark.slow
def test_strider_walks_five_metres_untuned(strider):
    for world in (ideal, hfs):
        ahead, aside, up = walked(strider, world, 10.5)
        assert ahead > 5.0, world
        assert abs(aside) < 0.5, world
        assert abs(up) < 0.1, world


@pytest.mark.slow
def test_strider_is_tuned_by_the_same_command(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    small = CollectConfig(walks=6, seconds=1.0)
    monkeypatch.setattr(nets, "CollectConfig", lambda: small)
    flags = ("--traj", "straight", "--seeds", "1", "--iterations", "11", "--no-video")
    line = ["hector", "tune", "--robot", str(STRIDER), *flags, "--processes", "1"]
    monkeypatch.setattr(sys, "argv", line)
    assert cli.main() == 0
    assert "with" in capsys.readouterr().out
    strider = load_robot(STRIDER)
    assert len(load_walks(tmp_path / "data" / "strider" / "walks", strider).job.seed) == 6
    assert (tmp_path / "data" / "strider" / "grfm.npz").exists()
    with pytest.raises(ValueError, match="made for robot"):
        load_walks(tmp_path / "data" / "strider" / "walks", load_robot())
    (run,) = (tmp_path / "runs" / "strider" / "straight").iterdir()
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for name in ("without", "with"):
        L = [line["L"] for line in lines if line["set"] == name and line["accepted"]]
        assert L[-1] < 0.95 * L[0]
    assert json.loads((run / "result.json").read_text())["sets"]["with"]["hfs"]["falls"] == 0
