"""The robot description: what it says, and what of it touches what."""

import mujoco
import numpy as np
import pytest
from model import ROBOT
from oracles import mass_matrix

from hector_jax.importing.remarks import differences
from hector_jax.robot.checks import standing_data
from hector_jax.robot.description import Description
from hector_jax.robot.model import compile_model, describe

MODEL = compile_model(describe())


def body_pairs(model, data):
    bodies = model.geom_bodyid[data.contact.geom]
    return [tuple(model.body(b).name for b in pair) for pair in bodies]


def test_the_standing_robot_is_that_of_the_facts_sheet_and_its_own_mirror_image():
    """MuJoCo's H, moved from the trunk's origin to the CoM; armature sits on joints only."""
    data = standing_data(Description(), MODEL)
    assert ROBOT.trunk_height == pytest.approx(0.548, abs=1e-3)
    for foot, side in zip([foot.point for foot in Description().named_feet], (1, -1), strict=True):
        there = [-0.0135, side * 0.0942, 0.0]
        np.testing.assert_allclose(data.site(foot).xpos, there, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(ROBOT.standing_joints), [0, 0, 45, -90, 45] * 2)
    np.testing.assert_allclose(ROBOT.com_offset, [-0.011, 0.0, -0.125], atol=1e-3)
    np.testing.assert_allclose(np.diag(ROBOT.inertia), [0.321, 0.268, 0.120], atol=1e-3)
    assert ROBOT.inertia[0, 2] == pytest.approx(-0.027, abs=1e-3)
    assert ROBOT.standing_height == pytest.approx(0.548 - 0.125, abs=1e-3)
    H = mass_matrix(MODEL, data)
    S = np.cross(ROBOT.com_offset, np.eye(3)).T  # S(c) w = c x w
    np.testing.assert_allclose(H[:3, :3], ROBOT.mass * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(H[:3, 3:6], -ROBOT.mass * S, atol=1e-12)
    np.testing.assert_allclose(H[3:6, 3:6], ROBOT.inertia - ROBOT.mass * S @ S, atol=1e-12)
    assert differences(ROBOT) == []
    np.testing.assert_allclose(ROBOT.com_offset[1], 0.0, atol=1e-15)
    np.testing.assert_allclose(ROBOT.inertia[[0, 1], [1, 2]], 0.0, atol=1e-15)


def test_robot_in_the_air_touches_only_leg_against_leg():
    rng = np.random.default_rng(0)
    data = mujoco.MjData(MODEL)
    touched = 0
    for joints in rng.uniform(ROBOT.joint_lower, ROBOT.joint_upper, size=(300, 10)):
        data.qpos[:] = [0, 0, 2, 1, 0, 0, 0, *joints]
        mujoco.mj_forward(MODEL, data)
        touched += data.ncon
        for a, b in body_pairs(MODEL, data):
            assert {a.split("_")[0], b.split("_")[0]} == {"left", "right"}
    assert touched > 0


@pytest.mark.parametrize(("turn", "height"), [((0.7, 0.7, 0, 0), 0.08), ((0.7, 0, 0.7, 0), 0.05)])
def test_lying_robot_touches_the_floor_with_more_than_its_feet(turn, height):
    data = standing_data(Description(), MODEL)
    data.qpos[2:7] = [height, *turn]
    mujoco.mj_forward(MODEL, data)
    touching = {body for pair in body_pairs(MODEL, data) for body in pair}
    assert "trunk" in touching
