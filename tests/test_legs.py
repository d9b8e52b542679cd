"""Torques and swing paths: virtual work, MuJoCo's statics, derivatives."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model import QUADRUPED, ROBOT, WEIGHT

from hector_jax.control import LegConfig, Measurement, legs
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import SwingTarget
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.trajectory import State, Wrench
from hector_jax.robot.kinematics import foot_poses, leg_gravity
from hector_jax.robot.model import compile_model
from hector_jax.robot.poses import standing_data

CONFIG = LegConfig()
SWING = 0.2
HEAVY = (0.01, 0.02, 0.03, 0.02, 0.01)  # [kg m^2], motors of a leg
STANDS = jnp.asarray(ROBOT.standing_joints)

stance = jax.jit(lambda state, joints, wrench: legs.stance_torques(ROBOT, state, joints, wrench))
path = jax.jit(lambda start, end, s: legs.swing_path(CONFIG.parameters, start, end, s))


@partial(jax.jit, static_argnums=6)
def targets(state, start, start_yaw, end, end_yaw, elapsed, config=CONFIG):
    at, feet = Measurement(state, STANDS, 0 * STANDS), {"start": Feet(start, start_yaw)}
    feet["end"] = Feet(end, end_yaw)
    return legs.swing_joints(ROBOT, config.parameters, at, **feet, elapsed=elapsed, swing=SWING)


@partial(jax.jit, static_argnums=0)
def torques(config, measurement, contact, wrench, target):
    now = {"contact": contact, "wrench": wrench, "target": target}
    return legs.joint_torques(ROBOT, config.parameters, measurement, **now)


poses = jax.jit(lambda joints: foot_poses(ROBOT, joints))
carried = jax.jit(lambda joints, gravity: leg_gravity(ROBOT, joints, gravity))


def base(euler=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0)):
    height = [0.0, 0.0, float(ROBOT.standing_height)]
    return State(*(jnp.array(row, float) for row in (euler, height, (0, 0, 0), velocity)))


@jax.jit
def world_feet(state, joints):
    R_wb, local = rotation_from_euler(state.euler), poses(joints)
    return legs.trunk_position(ROBOT, state) + local.position @ R_wb.T, R_wb @ local.rotation


START, _ = world_feet(base(), STANDS)
END = START + jnp.array([[0.15, 0.02, 0.0], [0.1, -0.03, 0.0]])


def test_stance_torques_and_ground_do_no_work_together_at_the_hip():
    state = base((0.1, -0.2, 0.7))
    rng = np.random.default_rng(0)
    joints = STANDS + 0.2 * rng.normal(size=10)
    wrench = Wrench(jnp.asarray(50 * rng.normal(size=(2, 3))), jnp.asarray(rng.normal(size=(2, 3))))
    torque = stance(state, joints, wrench)
    for rates in np.eye(10):
        (_, R), (v, dR) = jax.jvp(lambda q: world_feet(state, q), (joints,), (jnp.asarray(rates),))
        spin = np.einsum("fij,fkj->fik", dR, R)  # the skew matrix of each foot's omega
        omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        power = np.sum(wrench.force * v) + np.sum(wrench.moment * omega)
        # the ground's power on the feet is what the joints give way by, trunk at rest
        assert float(torque @ rates) == pytest.approx(-float(power), abs=1e-10)


def statics(robot, share):
    """MuJoCo's joint torques of the standing pose when feet carry these shares of it.

    Moments bring the centre of pressure under the centre of mass where feet exert some; of four
    point feet shares are the least that balance.
    """
    model = compile_model(robot.description)
    data = standing_data(robot.description, model)
    sites = [data.site(foot.point) for foot in robot.description.feet]
    arms = np.array([site.xpos for site in sites]) - data.subtree_com[1]
    if share is None:
        A = np.stack([np.ones(4), arms[:, 0], arms[:, 1]])
        share = np.linalg.lstsq(A, [1.0, 0.0, 0.0])[0]
    force = float(robot.mass * robot.gravity[2]) * np.outer(share, [0.0, 0.0, 1.0])
    moment = np.zeros((4, 3)) if len(sites) == 4 else np.cross(-arms, force)
    need = data.qfrc_bias.copy()
    for foot, site in enumerate(sites):
        J_v, J_w = np.zeros((2, 3, model.nv))
        mujoco.mj_jacSite(model, data, J_v, J_w, site.id)
        need -= J_v.T @ force[foot] + J_w.T @ moment[foot]
    np.testing.assert_allclose(need[:6], 0.0, atol=1e-9)  # the trunk needs no help
    state = State(*jnp.zeros((4, 3)))._replace(position=jnp.asarray(data.subtree_com[1]))
    return need[6:], state, Wrench(jnp.asarray(force), jnp.asarray(moment))


@pytest.mark.parametrize(
    ("robot", "share"), [(ROBOT, (0.5, 0.5)), (ROBOT, (1.0, 0.0)), (QUADRUPED, None)]
)
def test_stance_torques_and_leg_weight_are_the_statics_of_mujoco(robot, share):
    need, state, wrench = statics(robot, share)
    joints = jnp.asarray(robot.standing_joints)
    weight = jax.jit(leg_gravity)(robot, joints, jnp.asarray(robot.gravity))
    found = jax.jit(legs.stance_torques)(robot, state, joints, wrench) + weight
    np.testing.assert_allclose(found, need, atol=1e-8)


@pytest.mark.parametrize("step_up", [0.0, 0.05])
def test_a_swing_foot_rises_to_its_apex_halfway_and_is_slow_at_both_ends(step_up):
    end = END + jnp.array([0.0, 0.0, step_up])
    along = jax.vmap(lambda s: path(START, end, jnp.full(2, s)))
    points = np.asarray(along(jnp.linspace(0.0, 1.0, 41)))
    np.testing.assert_allclose(points[0], START, atol=1e-12)
    np.testing.assert_allclose(points[40], end + jnp.array([0.0, 0.0, CONFIG.landing]), atol=1e-12)
    np.testing.assert_allclose(points[20, :, :2], (START + END)[:, :2] / 2)
    np.testing.assert_allclose(points[20, :, 2], step_up + CONFIG.height, atol=1e-6)
    rising = np.diff(points[..., 2], axis=0)
    assert (rising[:20] > 0).all()
    assert (rising[20:] < 0).all()
    at, step = jnp.array([0.0, 0.5, 1.0]), 1e-4
    begin, middle, last = (along(at + step) - along(at - step)) / (2 * step)
    np.testing.assert_allclose([begin, last], 0.0, atol=1e-3)
    np.testing.assert_allclose(middle[:, :2], 1.5 * (END - START)[:, :2], rtol=1e-6)
    np.testing.assert_allclose(middle[:, 2], 0.0, atol=1e-3)


def swing(elapsed, state=None, turn=0.3, config=CONFIG):
    state = base((0.0, 0.05, 0.1), (0.4, 0.1, 0.02)) if state is None else state
    yaw, elapsed = state.euler[2] + jnp.array([0.05, -0.1]), jnp.asarray(elapsed, float)
    return targets(state, START, yaw, END, yaw + turn, elapsed, config)


@pytest.mark.parametrize("elapsed", [0.04, 0.13, SWING + 0.01, 2 * SWING])
def test_swing_joints_put_the_feet_on_the_path_and_an_overdue_foot_waits_at_its_end(elapsed):
    state = base((0.0, 0.05, 0.1))
    joints = swing([elapsed] * 2, state).angles
    position, R = world_feet(state, joints)
    s = min(elapsed / SWING, 1.0)
    np.testing.assert_allclose(position, path(START, END, jnp.full(2, s)), atol=1e-9)
    assert np.abs(R[:, 2, 0]).max() < 0.02  # the sole stays level, toe to heel
    turned = 0.1 + np.array([0.05, -0.1]) + 0.3 * s * s * (3 - 2 * s)
    np.testing.assert_allclose(np.arctan2(R[:, 1, 0], R[:, 0, 0]), turned, atol=0.02)


def test_swing_rates_are_those_of_the_angles_and_half_a_turn_is_crossed_the_short_way():
    state, step = base((0.0, 0.05, 0.1), (0.4, 0.1, 0.02)), 1e-5

    def at(time):
        moved = state._replace(position=state.position + time * state.velocity)
        return np.asarray(swing([0.08 + time] * 2, moved).angles)

    rates = swing([0.08] * 2, state).rates
    np.testing.assert_allclose(rates, (at(step) - at(-step)) / (2 * step), atol=1e-6)
    assert np.abs(rates).max() > 1.0
    state = base((0.0, 0.0, np.pi))
    start_yaw, end_yaw = jnp.full(2, np.pi - 0.1), jnp.full(2, -np.pi + 0.1)
    turned = START * jnp.array([-1.0, -1.0, 1.0])
    joints = targets(state, turned, start_yaw, turned, end_yaw, jnp.full(2, SWING)).angles
    np.testing.assert_allclose(np.asarray(joints)[::5], 0.1, atol=1e-9)


def test_stance_legs_push_and_swing_legs_follow_and_carry_their_weight():
    """A stance leg carries its own on request."""
    state, joints, rates = base((0.1, 0.2, 0.3)), STANDS + 0.1, jnp.linspace(-0.5, 0.5, 10)
    wrench = Wrench(jnp.array([[1.0, 2.0, 0.8 * WEIGHT], [0.0, 0.0, 0.0]]), jnp.zeros((2, 3)))
    measurement = Measurement(state, joints, rates)
    target = SwingTarget(joints + 0.05, jnp.full(10, 0.2))
    stands, configs = jnp.array([True, False]), (LegConfig(gravity_compensation=True), CONFIG)
    loaded, plain = (torques(one, measurement, stands, wrench, target) for one in configs)
    weight = carried(joints, jnp.asarray(ROBOT.gravity) @ rotation_from_euler(state.euler))
    pushed = stance(state, joints, wrench)[:5]
    np.testing.assert_allclose(plain[:5], pushed, atol=1e-9)
    np.testing.assert_allclose(loaded[:5], pushed + weight[:5], atol=1e-9)
    pull = 0.05 * np.array(CONFIG.kp) + (0.2 - rates[5:]) * np.array(CONFIG.kd)
    np.testing.assert_allclose([plain[5:], loaded[5:]], [pull + weight[5:]] * 2, atol=1e-9)


def test_the_inertia_of_the_motors_is_fed_forward_where_it_is_given():
    state, moving = base((0.0, 0.05, 0.1), (0.4, 0.1, 0.02)), replace(CONFIG, armature=HEAVY)
    plain, target = (swing([0.08] * 2, state, config=config) for config in (CONFIG, moving))
    assert plain.accelerations is None
    np.testing.assert_allclose(target.angles, plain.angles, atol=1e-12)
    np.testing.assert_allclose(target.rates, plain.rates, atol=1e-10)
    later = state._replace(position=state.position + 1e-3 * state.velocity)
    after = swing([0.081] * 2, later).rates
    np.testing.assert_allclose(target.accelerations, (after - plain.rates) / 1e-3, atol=1e-6)
    assert np.abs(target.accelerations).max() > 10.0
    at = Measurement(state, plain.angles, plain.rates)
    now = jnp.zeros(2, bool), Wrench(jnp.zeros((2, 3)), jnp.zeros((2, 3)))
    more = torques(moving, at, *now, target) - torques(CONFIG, at, *now, plain)
    np.testing.assert_allclose(more, np.tile(HEAVY, 2) * target.accelerations, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torques_stay_within_their_limits(sign):
    at_rest = Measurement(base(), STANDS, jnp.zeros(10))
    huge = Wrench(jnp.full((2, 3), 1e5 * sign), jnp.zeros((2, 3)))
    far = SwingTarget(STANDS + 9.0 * sign, jnp.zeros(10))
    for stands in (True, False):
        found = torques(CONFIG, at_rest, jnp.full(2, stands), huge, far)
        assert (np.abs(found) <= ROBOT.torque_limit).all()
        assert (np.abs(found) == ROBOT.torque_limit).any()
    np.testing.assert_array_equal(found, sign * ROBOT.torque_limit)
