"""What is sensed: base state, ground wrench, falls and the estimator's errors, against MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model import ROBOT

from hector_jax.sim import sensing
from hector_jax.sim.loop import contact_effect
from hector_jax.sim.standin import standin
from hector_jax.sim.world import build_world, hfs, ideal, standing_qpos, truth


@jax.jit
def sensed(robot, row, ground):
    reading = sensing.unpack_reading(row)
    points = sensing.foot_points(robot, reading)
    state = sensing.base_state(robot, reading, jnp.zeros(()))
    return state, contact_effect(points, ground), points, ground.touches


def flat_reading(world, data):
    return np.concatenate([data.qpos, data.qvel, [0.0]])[sensing.coordinates(world)]


def sense(world, data, row):
    """State, wrench, foot points and touch of the last step, which started at `row`."""
    ground = sensing.sensed_ground(data.sensordata[None], feet=2)
    return sensed(ROBOT, row, jax.tree.map(lambda x: x[0], ground))


def stand(plant, height=0.0, steps=1500):
    """A robot held in its standing pose by a joint PD, let go `height` [m] above the floor."""
    world = build_world(plant, sensors=True)
    data = mujoco.MjData(world.model)
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints, float(ROBOT.trunk_height) + height)
    row = flat_reading(world, data)
    for _ in range(steps):
        row = flat_reading(world, data)
        error = ROBOT.standing_joints - data.qpos[world.joint_qpos]
        data.ctrl[:] = 400.0 * error - 6.0 * data.qvel[world.joint_dof]
        mujoco.mj_step(world.model, data)
    return world, data, row


def momentum(world, data):
    """Of all links together, at the start of the last step [kg m/s]."""
    mujoco.mj_subtreeVel(world.model, data)
    return data.subtree_linvel[0] * world.model.body_subtreemass[0]


@pytest.mark.parametrize("plant", [ideal(), hfs()], ids=["ideal", "hfs"])
def test_at_rest_the_ground_carries_the_weight_inside_the_feet(plant):
    world, data, row = stand(plant)
    _, wrench, _, touches = sense(world, data, row)
    force, moment = np.asarray(wrench.force), np.asarray(wrench.moment)
    weight = world.model.body_mass.sum() * 9.81
    before = momentum(world, data)
    mujoco.mj_step(world.model, data)
    wanted = (momentum(world, data) - before) / 0.001 + [0.0, 0.0, weight]
    assert np.linalg.norm(force.sum(axis=0) - wanted) <= 0.01 * weight  # m (a + g) of all links
    assert force[:, 2].sum() == pytest.approx(weight, rel=0.005)
    ahead, aside = -moment[:, 1] / force[:, 2], moment[:, 0] / force[:, 2]
    assert (-ROBOT.heel <= ahead).all()
    assert (ahead <= ROBOT.toe).all()
    assert np.abs(aside).max() < 1e-3
    assert not any(touches)


def test_the_wrench_is_the_sum_of_mujocos_contact_forces():
    world, data, row = stand(ideal(), height=0.01, steps=60)
    assert data.ncon > 0
    force, moment, out = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(6)
    _, wrench, points, _ = sense(world, data, row)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(world.model, data, i, out)
        foot = world.foot_of_geom[[g for g in contact.geom if g != world.floor][0]]
        pushed = contact.frame.reshape(3, 3).T @ out[:3]
        force[foot] += pushed
        moment[foot] += np.cross(contact.pos - np.asarray(points)[foot], pushed)
    np.testing.assert_allclose(wrench.force, force, atol=1e-9)
    np.testing.assert_allclose(wrench.moment, moment, atol=1e-9)


def test_base_state_is_that_of_a_point_fixed_to_the_trunk():
    (world, data, _), rng = stand(ideal(), steps=0), np.random.default_rng(3)
    data.qpos[3:7] = rng.normal(size=4)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qvel[:6] = rng.normal(size=6)
    state, *_ = sense(world, data, flat_reading(world, data))
    mujoco.mj_forward(world.model, data)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(world.model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)
    R_wb = data.xmat[1].reshape(3, 3)
    offset = R_wb @ ROBOT.com_offset
    np.testing.assert_allclose(state.position, data.subtree_com[0], atol=1e-4)
    np.testing.assert_allclose(state.position, data.xpos[1] + offset, atol=1e-9)
    np.testing.assert_allclose(state.ang_velocity, velocity[:3], atol=1e-9)
    expected = velocity[3:] + np.cross(velocity[:3], offset)
    np.testing.assert_allclose(state.velocity, expected, atol=1e-9)


def test_foot_points_count_the_backlash():
    world, data, _ = stand(hfs(), steps=0)
    data.qpos[world.model.jnt_qposadr[world.slack]] = np.linspace(-0.005, 0.005, 10)
    mujoco.mj_kinematics(world.model, data)
    points = sense(world, data, flat_reading(world, data))[2]
    for foot, ankle in enumerate(world.joint_dof[[4, 9]]):
        body = world.model.dof_bodyid[ankle]
        expected = data.xpos[body] + data.xmat[body].reshape(3, 3) @ ROBOT.foot_point[foot]
        np.testing.assert_allclose(points[foot], expected, atol=1e-9)


def test_yaw_goes_on_past_half_a_turn():
    yaw_of = jax.jit(lambda reading, yaw: sensing.base_state(ROBOT, reading, yaw).euler[2])
    row, before = np.zeros(43), jnp.zeros(())
    for yaw in np.linspace(0.0, 9.0, 40):
        row[3:7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        before = yaw_of(sensing.unpack_reading(jnp.asarray(row)), before)
        assert before == pytest.approx(yaw, abs=1e-9)


@pytest.mark.parametrize(
    ("height", "inwards", "floor", "legs"),
    [(0.2, 0.0, True, False), (1.0, 0.0, False, False), (1.0, 0.3, False, True)],
    ids=["knees on the floor", "in the air", "legs crossed"],
)
def test_what_touches_is_told_and_only_feet_on_the_floor_push(height, inwards, floor, legs):
    world, data, _ = stand(ideal(), steps=0)
    roll = inwards * np.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints + roll, height)
    mujoco.mj_forward(world.model, data)
    _, wrench, _, touches = sense(world, data, flat_reading(world, data))
    assert (touches.floor, touches.legs) == (floor, legs)
    assert floor or not (np.any(wrench.force) or np.any(wrench.moment))


def test_the_controller_is_told_the_truth_plus_errors_of_their_stated_sizes():
    assert not sensing.draw_errors(truth(), 10, 0, 10, 20).any()
    estimator = standin(0).estimator
    runs = np.stack([sensing.draw_errors(estimator, 10, seed, 100, 4000) for seed in range(60)])
    start = runs[:, :100]
    sizes = np.repeat([0.005, 0.003, 0.03, 0.03, 0.001], [3, 3, 3, 3, 10])
    np.testing.assert_allclose(start.std(axis=(0, 1)), sizes, rtol=0.1)
    end = runs[:, -100:].mean(axis=1)  # the noise averages out, the drift stays
    np.testing.assert_allclose(end[:, [2, 3, 4]].std(axis=0), 0.01, rtol=0.3)
    assert np.abs(end[:, [0, 1, 5]]).max() < 0.003
    reading = jnp.asarray(stand(ideal(), steps=0)[2])
    true, _ = sensing.measure(ROBOT, reading, jnp.zeros(()), sensing.no_error(ROBOT))
    error = jnp.linspace(0.01, 0.22, 22)
    told, yaw = sensing.measure(ROBOT, reading, jnp.zeros(()), error)
    off = jax.tree.map(jnp.subtract, told, true)
    np.testing.assert_allclose(np.concatenate(off.state), error[:12], atol=1e-12)
    np.testing.assert_allclose(off.joints, error[12:], atol=1e-12)
    assert not np.any(off.joint_rates)
    assert yaw == 0.0  # the true one
