"""Another biped: an MJCF and a short TOML, and no Python."""

import json
import sys
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hector_jax.cli import main as cli
from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table
from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.control.reference import named_command
from hector_jax.control.trajectories import limits
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.files import write_json
from hector_jax.core.geometry import rot_x, rot_y, rot_z
from hector_jax.core.inputs import InputError
from hector_jax.export.export import find_weights
from hector_jax.grfm.collection import load_walks
from hector_jax.robot import kinematics
from hector_jax.robot.description import Description, TuningSettings
from hector_jax.robot.kinematics import foot_jacobians, foot_poses
from hector_jax.robot.model import compile_model, describe, load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.mjx_model import batched_model, find_places
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, hfs, ideal
from hector_jax.store import folder as runs
from hector_jax.store import nets
from hector_jax.store.cache import robot_hash
from hector_jax.store.nets import CollectConfig
from hector_jax.store.tunings import tune_config
from hector_jax.tuning.difftune import TuneConfig

STRIDER = Path(__file__).parents[1] / "examples" / "strider" / "robot.toml"

foot_poses_jit = jax.jit(foot_poses)
foot_jacobians_jit = jax.jit(foot_jacobians)


@partial(jax.jit, static_argnames="steps")
def inverse_legs_jit(robot, position, yaw, up, steps=16):
    """From the standing pose, which takes more steps than from a moment before."""
    start = jnp.asarray(robot.standing_joints)
    return kinematics.inverse_legs(robot, position, yaw, up, start, steps=steps)


inverse_forward = jax.jit(jax.jacfwd(inverse_legs_jit, argnums=1))
inverse_reverse = jax.jit(jax.jacrev(inverse_legs_jit, argnums=1))


def copied(folder, model=lambda text: text, toml=lambda text: text):
    """Strider with other text, in a folder of its own."""
    xml = STRIDER.with_name("strider.xml")
    (folder / xml.name).write_text(model(xml.read_text()))
    path = folder / STRIDER.name
    path.write_text(toml(STRIDER.read_text()))
    return path


def reordered(axes, folder):
    """Strider with the first three joints of its legs about other axes."""
    kinds = {"x": "roll", "y": "pitch", "z": "yaw"}
    bend = np.deg2rad(36.0)
    by_axis = [bend if axis == "y" else 0.0 for axis in axes[:3]] + [-2 * bend, bend]

    def model(text):
        for side in ("left", "right"):
            for joint, axis in zip(("yaw", "roll", "pitch"), axes, strict=False):
                was = f'name="{side}_{joint}" class="{joint}"'
                assert was in text
                text = text.replace(was, f'name="{side}_{joint}" class="{kinds[axis]}"')
        start, end = text.index(" 1 0 0 0 ") + 9, text.index('"/>\n  </keyframe>')
        text = text[:start] + " ".join(map(str, by_axis * 2)) + text[end:]
        compiled = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(compiled)
        mujoco.mj_resetDataKeyframe(compiled, data, 0)
        mujoco.mj_forward(compiled, data)
        above = data.geom("left_tip").xpos[2] - compiled.geom("left_tip").size[0]
        return text.replace("0 0 0.755410", f"0 0 {0.755410 - above}")

    return copied(folder, model)


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


def test_mjx_takes_any_robot_and_knows_what_may_not_touch_the_floor(strider):
    world = build_world(hfs(), strider.description)
    model, _ = batched_model([world])
    assert (model.nq, model.nu) == (27, 10)
    places = find_places(world)
    parts = [world.model.geom(geom).name for geom in (*places.boxes, *places.capsules)]
    assert parts == ["trunk", "left_thigh", "left_shin", "right_thigh", "right_shin"]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[gait]", "[gate]", ["robot.toml: unknown field 'gate'", "did you mean 'gait'?"]),
        (
            "stance = 22",
            "stanse = 22",
            ["robot.toml: gait: unknown field 'stanse'", "did you mean 'stance'?"],
        ),
        ("stance = 22", 'stance = "22"', ["gait: stance must be a whole number", "got '22'"]),
        ("stance = 22", "stance = 2", ["gait: stance must be at least swing", "got stance 2"]),
        ("= 900", "= nan", ["mpc: max_force must be a number", "got nan"]),
        (
            "kp = [150,",
            "kp = [",
            ["legs.kp must be a gain for each of the 5 joints", "got (150.0,"],
        ),
        ("min_height", "height", ["limits: unknown field 'height'", "did you mean 'min_height'?"]),
        ("= 0.35", "= -1", ["limits: min_height must be a number above 0, got -1"]),
        ("= 0.35", "= 1" + 400 * "0", ["limits: min_height must be a number above 0, got 1000"]),
        ("[mpc]", "[mpc]\nstep_ticks = 1", ["robot.toml: gait.tick must be at most half"]),
        ('"left_yaw", ', "", ["joints: left and right must be 3 to 7 names each", "got 4 and 5"]),
        (
            '"left_yaw", ',
            '"left_roll", ',
            ["joints: must be different names, got 'left_roll' twice"],
        ),
        ("toe = ", "tow = ", ["feet: left: unknown field 'tow'", "did you mean 'toe'?"]),
        (
            "linkage = [5, 4]",
            "armature = [0.01]",
            ["joints: armature must be a number for each of the 5 joints", "got (0.01,)"],
        ),
        ("linkage = [5, 4]", "linkage = [6, 4]", ["joints: linkage must be two", "from 1 to 5"]),
        ("[joints]", '[joints]\naxes = "zxyyy"', ["joints: unknown field 'axes'"]),
        ("nominal.force = 3.6e-5", "", ["weights: nominal: missing field 'force'"]),
        ("nominal.force", "nominal.farce", ["weights: nominal: unknown field 'farce'", "'force'?"]),
        (
            "nominal.euler = 50",
            "nominal.euler = [50, 0, 50]",
            ["weights: nominal: euler must be a number above 0", "got [50, 0, 50]"],
        ),
        (
            '"strider.xml"',
            '"../strider.xml"',
            ["model must be the name of a file beside it", "got '../strider.xml'"],
        ),
        ('"strider.xml"', '"other.xml"', ["other.xml", "cannot read"]),
        ('model = "strider.xml"', "", ["robot.toml: model is missing", "MJCF or URDF, beside"]),
        ('"strider"', '"a/b"', ["name must be letters", "names a folder", "got 'a/b'"]),
        ('"left_knee"', '"left_nee"', ["no joint 'left_nee'", "did you mean 'left_knee'?"]),
        ('"left_sole"', '"left_soul"', ["no site 'left_soul'", "did you mean 'left_sole'?"]),
        ('"home"', '"hom"', ["no keyframe 'hom'", "standing = { joint"]),
        ("[gait]", "[gait", ["not valid TOML"]),
    ],
)
def test_a_wrong_description_is_refused_in_one_line(tmp_path, old, new, words):
    text = STRIDER.read_text()
    assert old in text
    path = copied(tmp_path, toml=lambda text: text.replace(old, new, 1))
    with pytest.raises(ValueError, match=str(tmp_path)) as caught:
        walk_config(load_robot(path))
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_lead_before_the_gait_begins_is_refused_with_its_key():
    settings = TuningSettings(lead=1000)
    robot = load_robot()
    robot = robot._replace(description=replace(robot.description, tuning=settings))
    with pytest.raises(InputError, match=r"hector.toml: tuning: .*lead .*\(\d+ ticks\), got 1000"):
        tune_config(robot)


def test_the_same_legs_can_be_expected_to_walk_as_fast_in_any_order_of_their_joints(
    strider, tmp_path
):
    gait = walk_config(strider).gait
    expected = limits(strider, gait)
    np.testing.assert_allclose(limits(load_robot(reordered("xzyyy", tmp_path)), gait), expected)
    assert expected.ahead > limits(load_robot(), gait).ahead  # with longer legs


# What a run leaves


def test_a_run_is_exported_and_viewed_with_the_robot_that_it_was_for(strider, tmp_path):
    settings = TuneConfig()
    walk = replace(settings.rollout, walk=walk_config(strider))
    config = {
        "flags": as_table(Tune(robot=STRIDER)),
        "robot": robot_hash(strider),
        "tune": asdict(replace(settings, rollout=walk)) | {"loss": {}},
    }
    write_json(tmp_path / "config.json", config)
    save_weights(tmp_path / "weights" / "with.json", expert(strider))
    weights = tmp_path / "weights" / "with.json"
    assert find_weights(tmp_path, "with") == (weights, walk_config(strider))
    assert runs.read_request(tmp_path).robot == STRIDER
    found, _ = runs.weights_of(tmp_path, "nominal", strider)
    jax.tree.map(np.testing.assert_array_equal, found, nominal(strider))


# Feet from joints and joints from feet, in any order of the joints


@pytest.mark.parametrize("axes", ["zxyyy", "xzyyy", "yxzyy"])
def test_legs_of_any_order_reach_random_poses_of_mujoco(tmp_path, axes):
    """By the closed form (zxyyy) or the damped Newton iteration, to 1e-6 m."""
    path = reordered(axes, tmp_path)
    robot, model = load_robot(path), compile_model(describe(path))
    assert robot.structure.closed_form == (axes == "zxyyy")
    data = mujoco.MjData(model)
    names = [foot.point for foot in robot.description.named_feet]

    def posed(joints):
        data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *joints]
        mujoco.mj_kinematics(model, data)
        sites = [data.site(name) for name in names]
        rotations = [site.xmat.reshape(3, 3) for site in sites]
        return np.array([site.xpos for site in sites]), np.array(rotations)

    rng, far = np.random.default_rng(0), 0.0
    for _ in range(100):
        joints = rng.uniform(robot.joint_lower, robot.joint_upper)
        joints = robot.standing_joints + 0.7 * (joints - robot.standing_joints)
        position, rotation = posed(joints)
        feet = foot_poses_jit(robot, joints)
        np.testing.assert_allclose(feet.position, position, rtol=0, atol=1e-12)
        np.testing.assert_allclose(feet.rotation, rotation, rtol=0, atol=1e-12)
        up = rotation[:, :, 2]
        tilt = np.arctan2(up[:, 1], up[:, 2]), np.arctan2(-up[:, 0], np.hypot(*up[:, 1:].T))
        level = [
            rot_y(pitch) @ rot_x(roll) for roll, pitch in zip(*map(jnp.asarray, tilt), strict=True)
        ]
        ahead = np.einsum("fxy,fy->fx", np.array(level), rotation[:, :, 0])
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        if robot.structure.closed_form:  # by the angles of the hip's yaw and of all pitches
            yaw, pitch = joints.reshape(2, 5)[:, 0], joints.reshape(2, 5)[:, 2:].sum(axis=1)
            in_leg = np.stack([np.sin(pitch), 0 * pitch, np.cos(pitch)], axis=1)
            up = np.stack([rot_z(y) @ v for y, v in zip(jnp.asarray(yaw), in_leg, strict=True)])
        back = np.asarray(inverse_legs_jit(robot, position, yaw, up))
        reached, turned = posed(back)
        far = max(far, np.abs(reached - position).max(), np.abs(turned - rotation).max())
    assert far < 1e-6


def test_a_searched_leg_is_differentiable_and_finite_out_of_reach(tmp_path):
    robot = load_robot(reordered("xzyyy", tmp_path))
    joints, rest = jnp.asarray(robot.standing_joints) + 0.05, jnp.zeros(2)
    rest = rest, jnp.tile(jnp.array([0.0, 0.0, 1.0]), (2, 1))
    position = foot_poses_jit(robot, joints).position
    back = inverse_legs_jit(robot, position, *rest)
    np.testing.assert_allclose(foot_poses_jit(robot, back).position, position, rtol=0, atol=1e-9)
    J_v, _ = foot_jacobians_jit(robot, back)
    forward, reverse = (f(robot, position, *rest) for f in (inverse_forward, inverse_reverse))
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-9)
    for side in range(2):
        own = slice(5 * side, 5 * side + 5)
        np.testing.assert_allclose(J_v[side] @ forward[own, side], np.eye(3), atol=1e-6)
    for target in (jnp.full((2, 3), -5.0), robot.joint_origin[:, 0], jnp.zeros((2, 3))):
        assert jnp.isfinite(inverse_legs_jit(robot, target, *rest)).all()
        assert jnp.isfinite(inverse_forward(robot, target, *rest)).all()


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
def test_strider_walks_with_its_joints_in_another_order(tmp_path):
    ahead, aside, _ = walked(load_robot(reordered("xzyyy", tmp_path)), hfs, 4.0)
    assert ahead > 1.8
    assert abs(aside) < 0.3


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
