"""The robot description, how trunk and legs answer, and the delay that the loops bear."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from model import QUADRUPED, ROBOT
from oracles import mass_matrix
from scipy.linalg import solve_discrete_are

from hector_jax.control import MpcConfig, nominal, walk_config
from hector_jax.core.inputs import InputError
from hector_jax.importing.remarks import differences
from hector_jax.robot import response as answers
from hector_jax.robot.description import HECTOR
from hector_jax.robot.model import compile_model, describe
from hector_jax.robot.poses import standing_data
from hector_jax.robot.response import DELAY, LAG, PHASE_MARGIN, response
from hector_jax.sim.margin import Loops, delay_lines, modes

MODEL = compile_model(describe())


def body_pairs(model, data):
    bodies = model.geom_bodyid[data.contact.geom]
    return [tuple(model.body(b).name for b in pair) for pair in bodies]


def test_the_standing_robot_is_that_of_the_facts_sheet_and_its_own_mirror_image():
    """MuJoCo's H, moved from the trunk's origin to the CoM; armature sits on joints only."""
    data = standing_data(HECTOR, MODEL)
    assert ROBOT.trunk_height == pytest.approx(0.548, abs=1e-3)
    for foot, side in zip([foot.point for foot in HECTOR.feet], (1, -1), strict=True):
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
    data = standing_data(HECTOR, MODEL)
    data.qpos[2:7] = [height, *turn]
    mujoco.mj_forward(MODEL, data)
    touching = {body for pair in body_pairs(MODEL, data) for body in pair}
    assert "trunk" in touching


RATES = np.geomspace(1.0, 1e3, 20001)  # [rad/s]


@pytest.mark.parametrize("robot", [ROBOT, QUADRUPED], ids=lambda r: r.description.name)
def test_the_mobility_is_that_of_a_robot_whose_stance_feet_do_not_move(robot):
    answer = response(robot)
    model = compile_model(robot.description)
    data, nv = standing_data(robot.description, model), model.nv
    M = mass_matrix(model, data)
    J = np.concatenate(answer.twists[answer.stance][:, answer.held])
    zero = np.zeros((len(J), len(J)))
    solved = np.linalg.solve(np.block([[M, J.T], [J, zero]]), np.eye(nv + len(J)))[:nv, :nv]
    np.testing.assert_allclose(answer.mobility, solved, atol=1e-8)
    np.testing.assert_allclose(answer.inertia, M.diagonal()[6:])


def margin(loop, rates=RATES):
    """Phase margin [rad] of an open loop, a function of s."""
    values = loop(1j * rates)
    crossing = np.flatnonzero(np.abs(values) >= 1.0)[-1]
    return np.pi + np.unwrap(np.angle(values))[crossing]


def test_the_fastest_joints_of_a_swing_leg_have_the_phase_margin():
    answer = response(QUADRUPED)
    w, dofs = answers.swing_frequency(answer), answer.swing_dofs
    kp = answer.inertia[dofs - 6] * w**2
    motor = lambda s: np.exp(-(DELAY + 0.0005) * s) / (1 + LAG * s)  # noqa: E731

    def joints(s):
        pd = (kp + kp / w * s[:, None])[:, None, :]
        matrix = answer.mobility[np.ix_(dofs, dofs)] * pd / (s**2)[:, None, None]
        values = np.linalg.eigvals(matrix)
        return motor(s) * np.take_along_axis(values, np.abs(values).argmax(1)[:, None], 1)[:, 0]

    assert margin(joints, np.geomspace(5.0, 500.0, 4001)) == pytest.approx(PHASE_MARGIN, abs=0.01)


def test_the_plan_turns_its_share_of_the_inertia_and_keeps_the_phase_margin_with_it():
    A, B = np.array([[1.0, 0.03], [0.0, 1.0]]), np.array([[0.0], [0.03]])
    P = solve_discrete_are(A, B, np.diag([50.0, 1.0]), [[1e-9]])  # nearly without a cost on u
    stiffness, damping = np.linalg.solve(B.T @ P @ B, B.T @ P @ A)[0]
    times, of = {"step": 0.03, "tick": 0.01}, np.array([3.0, 1.0, 4.0])
    share = answers.planned_inertia(of, angle=50.0, rate=1.0, **times)
    assert (share[1], share[0] / share[2]) == (1.0, pytest.approx(4.0 / 3.0))

    def loop(s):
        plan = 3.0 * share[0] * (damping * s + stiffness) / s**2
        return plan * np.exp(-(DELAY + 0.005) * s) / (1 + LAG * s)

    assert margin(loop) == pytest.approx(PHASE_MARGIN, abs=2e-3)
    config = MpcConfig(inertia_share=(0.25, 1.0, 0.49))
    found = config.planned_inertia(np.ones((3, 3)))
    np.testing.assert_allclose(found[0], [0.25, 0.5, 0.35])
    with pytest.raises(InputError, match=r"MpcConfig.inertia_share must .* above 0 and at most 1"):
        MpcConfig(inertia_share=(0.0, 1.0, 1.0))


def test_a_delayed_joint_is_stable_up_to_its_phase_margin():
    w = 50.0
    loop = lambda s: (w**2 + w * s) / s**2 / (1 + 0.004 * s)  # noqa: E731
    rate = RATES[np.abs(loop(1j * RATES)) >= 1.0][-1]
    critical = margin(loop) / rate  # the steps of plant and lag are as early as a command is late
    h = 0.001
    # of a joint of unit inertia that is held at rest; nothing is planned
    rest = {"base": np.zeros((12, 2)), "held": np.zeros((1, 12)), "substeps": 10, "slowest": 1.0}
    step, push = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h], [h]])
    parts = Loops(step=step, push=push, now=-np.array([[w**2, w]]), **rest)
    for delay, sign in ((critical - 0.0003, -1), (critical + 0.0003, 1)):
        first = modes(parts, delay, lag=0.004)[0]
        assert (np.sign(first.real), first.imag) == (sign, pytest.approx(rate, rel=0.03))


def test_the_rules_of_the_gains_bear_the_delay_that_made_the_legs_cycle():
    config, weights = walk_config(QUADRUPED), nominal(QUADRUPED)
    first, remedy = delay_lines(QUADRUPED, config, weights)
    stable = "stable up to {} ms of the motors, with a lag of 6 ms; later, it shakes at {}"
    assert first.startswith(stable.format(5, ""))
    assert remedy.startswith("for 8 ms set legs.kp = [")
    # w = 30 rad/s and the inertia of the whole robot, as robots were proposed before
    legs = replace(config.legs, kp=(45.8, 37.4, 13.2), kd=(1.53, 1.25, 0.439))
    stiff = replace(config, legs=legs, mpc=replace(config.mpc, inertia_share=(1.0, 1.0, 1.0)))
    first, remedy = delay_lines(QUADRUPED, stiff, weights)
    assert first.startswith(stable.format(3, "22 Hz"))  # in MuJoCo the cycle has 20 Hz
    assert remedy.startswith("for 8 ms set mpc.inertia_share = [0.59, 1.0, 1.0], legs.kp = [")
