"""Leg kinematics against MuJoCo, and the equation of motion that they take part in (Eq. 1)."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hector_jax.core.geometry import rot_z, rotation_from_euler
from hector_jax.robot import kinematics
from hector_jax.robot.description import Description
from hector_jax.robot.kinematics import foot_jacobians, foot_poses, leg_gravity
from hector_jax.robot.model import compile_model, describe, load_robot

FOOT_POINTS = [foot.point for foot in Description().named_feet]

foot_poses_jit = jax.jit(foot_poses)
foot_jacobians_jit = jax.jit(foot_jacobians)
leg_gravity_jit = jax.jit(leg_gravity)


@pytest.fixture(scope="module")
def model():
    return compile_model(describe())


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def random_joints(robot):
    rng = np.random.default_rng(1)
    return jnp.array(rng.uniform(robot.joint_lower, robot.joint_upper, size=(40, 10)))


def pose(model, joints, quaternion=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0)):
    data = mujoco.MjData(model)
    data.qpos[:] = [*position, *quaternion, *joints]
    mujoco.mj_forward(model, data)
    return data


def leg_angles(joints):
    """Hip yaw and sum of the pitch joints of each leg."""
    legs = joints.reshape(2, 5)
    return legs[:, 0], legs[:, 2:].sum(axis=1)


def inverse_legs(robot, position, yaw, pitch):
    """Of soles that pitch as their leg is rolled; the closed form needs no joints to start from."""
    zero = jnp.zeros_like(pitch)
    in_leg = jnp.stack([jnp.sin(pitch), zero, jnp.cos(pitch)], axis=1)
    up = jnp.einsum("fij,fj->fi", jax.vmap(rot_z)(yaw), in_leg)
    return kinematics.inverse_legs(robot, position, yaw, up, jnp.zeros(10))


inverse_legs_jit = jax.jit(inverse_legs)
inverse_forward = jax.jit(jax.jacfwd(inverse_legs, argnums=1))
inverse_reverse = jax.jit(jax.jacrev(inverse_legs, argnums=1))


# Feet from joints


def test_mirrored_joints_have_mirrored_feet(robot, random_joints):
    flip = jnp.array([-1.0, -1.0, 1.0, 1.0, 1.0])
    mirror = jnp.array([1.0, -1.0, 1.0])
    joints = random_joints[0]
    mirrored = (joints.reshape(2, 5)[::-1] * flip).reshape(10)
    np.testing.assert_allclose(
        foot_poses_jit(robot, mirrored).position,
        foot_poses_jit(robot, joints).position[::-1] * mirror,
        atol=1e-15,
    )


# Joints from feet


def test_inverse_legs_undoes_foot_poses(robot, random_joints):
    tried = 0
    for joints in random_joints:
        feet = foot_poses_jit(robot, joints)
        back = inverse_legs_jit(robot, feet.position, *leg_angles(joints))
        # a foot folded up beside its hip roll axis belongs to the other branch
        legs = joints.reshape(2, 5)
        roll_axis = robot.joint_origin[:, 0, 2] + robot.joint_origin[:, 1, 2]
        below = feet.position[:, 2] < roll_axis - 0.1
        tried += int(below.sum())
        np.testing.assert_allclose(back.reshape(2, 5)[below], legs[below], rtol=0, atol=1e-10)
    assert tried > 60


def test_standing_feet_give_the_standing_joints(robot):
    joints = jnp.asarray(robot.standing_joints)
    feet = foot_poses_jit(robot, joints)
    np.testing.assert_allclose(feet.position[:, 2], -robot.trunk_height, atol=1e-6)
    back = inverse_legs_jit(robot, feet.position, jnp.zeros(2), jnp.zeros(2))
    np.testing.assert_allclose(back, joints, rtol=0, atol=1e-10)


def test_target_out_of_reach_is_pointed_at_with_the_knee_at_its_limit(robot):
    far = np.array([[0.3, 0.2, -2.0], [-0.3, -0.2, -2.0]])
    joints = inverse_legs_jit(robot, far, jnp.zeros(2), jnp.zeros(2))
    np.testing.assert_allclose(np.asarray(joints)[[3, 8]], robot.joint_upper[[3, 8]], atol=1e-12)
    reached = foot_poses_jit(robot, joints).position
    ankle = np.array([0.0, 0.0, 0.04])
    hip = robot.joint_origin[:, :3].sum(axis=1)
    wanted, got = far + ankle - hip, reached + ankle - hip
    wanted, got = (v[:, 0] / np.linalg.norm(v, axis=1) for v in (wanted, got))
    np.testing.assert_allclose(got, wanted, atol=0.01)


def degenerate_targets(robot):
    """Foot points on the joints' own axes, above the hip, and far away."""
    yaw, roll, hip, *_ = np.cumsum(robot.joint_origin, axis=1).transpose(1, 0, 2)
    sole = robot.foot_point
    lateral = robot.joint_origin[:, 2:].sum(axis=1) * [0, 1, 0]
    rolled_hip = roll + lateral + robot.joint_origin[:, 2] * [1, 0, 1]
    return {
        "yaw axis": yaw,
        "roll axis": roll,
        "hip": hip,
        "ankle in the hip": rolled_hip + sole,
        "above": hip + [0.0, 0.0, 0.5],
        "far": hip * 1e6,
        "straight leg": rolled_hip + [0.0, 0.0, -0.48],
    }


@pytest.mark.parametrize("name", degenerate_targets(load_robot()))
def test_inverse_legs_is_finite_with_finite_derivatives_everywhere(robot, name):
    target = jnp.asarray(degenerate_targets(robot)[name])

    rest = jnp.zeros(2)
    assert jnp.isfinite(inverse_legs_jit(robot, target, rest, rest)).all()
    assert jnp.isfinite(inverse_forward(robot, target, rest, rest)).all()
    assert jnp.isfinite(inverse_reverse(robot, target, rest, rest)).all()


def test_derivative_of_the_inverse_is_the_inverse_of_the_derivative(robot):
    joints = jnp.asarray(robot.standing_joints) + 0.1
    feet = foot_poses_jit(robot, joints)
    yaw, pitch = leg_angles(joints)
    by_target = inverse_reverse(robot, feet.position, yaw, pitch)
    J_v, _ = foot_jacobians_jit(robot, joints)
    for side in range(2):
        own = slice(5 * side, 5 * side + 5)
        np.testing.assert_allclose(J_v[side] @ by_target[own, side], np.eye(3), atol=1e-12)


# The legs' own weight


def test_leg_gravity_is_the_static_bias_force_of_mujoco(model, robot, random_joints):
    rng = np.random.default_rng(2)
    for joints, euler in zip(random_joints, rng.uniform(-0.8, 0.8, (40, 3)), strict=True):
        R_wb = rotation_from_euler(jnp.array(euler))
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, np.asarray(R_wb).ravel())
        data = pose(model, joints, quaternion)
        torque = leg_gravity_jit(robot, joints, R_wb.T @ robot.gravity)
        np.testing.assert_allclose(torque, data.qfrc_bias[6:], rtol=0, atol=1e-12)


# The equation of motion


def recorded_states(model, robot, stand):
    """States of a shoved robot that stands by joint PD, or falls limp, with their accelerations."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("standing").id)
    data.qvel[:6] = [0.25, -0.1, 0.0, 0.2, 0.4, 0.8]
    rng = np.random.default_rng(3)
    states = []
    for step in range(1, 121):
        gain = 80.0 if stand else 4.0
        torque = gain * (robot.standing_joints - data.qpos[7:]) - 0.02 * gain * data.qvel[6:]
        data.ctrl[:] = torque + rng.normal(0.0, 1.0, 10)
        mujoco.mj_step(model, data)
        if step % 12 == 0:
            mujoco.mj_forward(model, data)
            states.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy()))
    return states


def foot_wrenches(model, data):
    """Force and moment of the floor on each foot at its foot point, world frame."""
    force, moment = np.zeros((2, 3)), np.zeros((2, 3))
    for index, contact in enumerate(data.contact):
        local = np.zeros(6)
        mujoco.mj_contactForce(model, data, index, local)
        names = [model.body(model.geom_bodyid[g]).name for g in contact.geom]
        assert names[0] == "world"  # then the force acts on the second body, the foot
        side = ("left_foot", "right_foot").index(names[1])
        world = contact.frame.reshape(3, 3).T @ local[:3]
        force[side] += world
        moment[side] += np.cross(contact.pos - data.site(FOOT_POINTS[side]).xpos, world)
    return force, moment


@pytest.mark.parametrize("stand", [True, False], ids=["standing", "falling"])
def test_equation_of_motion_holds_on_recorded_states(model, robot, stand):
    """H(q) qdd + C = Gamma + J^T lambda with our Jacobians and our joint order (Eq. 1).

    Generalised velocity: trunk velocity in the world frame, trunk rotation in its own axes, joints.
    """
    exact = compile_model(describe())
    exact.opt.iterations, exact.opt.tolerance = 100, 0.0
    touching = 0
    for qpos, qvel, torque in recorded_states(model, robot, stand):
        data = mujoco.MjData(exact)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, torque
        mujoco.mj_forward(exact, data)
        assert data.nefc == 4 * data.ncon  # contacts alone: no joint at its limit
        touching += data.ncon

        H = np.zeros((16, 16))
        mujoco.mj_fullM(exact, data, H)
        force, moment = foot_wrenches(exact, data)
        R_wb = data.body("trunk").xmat.reshape(3, 3)
        feet = foot_poses_jit(robot, jnp.array(qpos[7:]))
        lever = feet.position @ R_wb.T
        J_v, J_w = foot_jacobians_jit(robot, jnp.array(qpos[7:]))
        by_joint = np.einsum("lij,li->lj", J_v, force @ R_wb)
        by_joint += np.einsum("lij,li->lj", J_w, moment @ R_wb)
        J_lambda = np.concatenate(
            [
                force.sum(axis=0),
                (np.cross(lever, force) + moment).sum(axis=0) @ R_wb,
                by_joint.ravel(),
            ]
        )
        friction = 0.1 * qvel[6:]  # joint damping of the plant
        Gamma = np.concatenate([np.zeros(6), torque - friction])
        np.testing.assert_allclose(
            H @ data.qacc + data.qfrc_bias, Gamma + J_lambda, rtol=0, atol=1e-7
        )
    assert touching >= 10


# Composition


def test_vmap_equals_a_loop_and_jit_equals_no_jit(robot, random_joints):
    batch = jax.jit(jax.vmap(foot_poses, in_axes=(None, 0)))(robot, random_joints[:5]).position
    np.testing.assert_allclose(foot_poses(robot, random_joints[0]).position, batch[0], atol=1e-15)
    for joints, position in zip(random_joints[:5], batch, strict=True):
        np.testing.assert_allclose(foot_poses_jit(robot, joints).position, position, atol=1e-15)


def test_single_precision_in_single_precision_out(robot, random_joints):
    def everything(robot, joints):
        feet = foot_poses(robot, joints)
        back = inverse_legs(robot, feet.position, *leg_angles(joints))
        return feet, foot_jacobians(robot, joints), back, leg_gravity(robot, joints, robot.gravity)

    robot32 = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), robot)
    results = jax.eval_shape(everything, robot32, random_joints[0].astype(jnp.float32))
    assert {leaf.dtype for leaf in jax.tree.leaves(results)} == {jnp.dtype(jnp.float32)}
