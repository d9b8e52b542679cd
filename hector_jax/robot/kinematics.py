"""Forward and inverse kinematics of the legs in the trunk frame.

A leg is a chain of three to seven hinges with any axes and origins (`Robot.joint_axis`,
`Robot.joint_origin`). Its inverse is a damped Newton iteration from nearby joint angles: the foot
meets the target in the rows of its twist that the leg can control (`Structure.placed`), and
redundant joints stay near the standing pose.

Legs built like HECTOR's (`Structure.closed_form`) have a closed-form inverse: hip yaw (z), hip roll
(x), hip pitch, knee, ankle (y). After yaw psi and roll phi the three pitch joints move in one
plane. With the cumulative pitches a = q_2, b = q_2 + q_3 and theta = q_2 + q_3 + q_4

    foot point = o_yaw + Rz(psi) (o_roll + Rx(phi) p)
    p = o_pitch + Ry(a) o_knee + Ry(b) o_ankle + Ry(theta) sole

Yaw is an input, roll turns the plane onto the target, and the pitch joints solve a triangle of
thigh and shin, bent in the direction that the knee's limits allow.
"""

from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_x, rot_y, rot_z, skew
from hector_jax.robot.model import Robot

NEWTON_STEPS = 4  # from the joint angles of the previous tick; distant starts need more
_MAX_STEP = 0.4  # [rad] of a joint in a Newton step
_DAMPING = 0.1  # times the squared error


class FootPoses(NamedTuple):
    """Poses of the feet in the trunk frame."""

    position: Float[Array, "feet 3"]  # foot points [m]
    rotation: Float[Array, "feet 3 3"]  # takes foot vectors to the trunk frame


def foot_poses(robot: Robot, joints: Float[Array, " joints"]) -> FootPoses:
    """Return foot points and foot axes for joint angles [rad]."""
    chain = _chain(robot, joints)
    return FootPoses(chain.foot, chain.rotation)


def foot_jacobians(
    robot: Robot, joints: Float[Array, " joints"]
) -> tuple[Float[Array, "feet 3 j"], Float[Array, "feet 3 j"]]:
    """Return each foot's Jacobians for velocity [m] and angular velocity [-] by its leg's joints.

    In trunk axes with the trunk at rest: for a foot at rest on the ground, add the trunk's motion.
    """
    chain = _chain(robot, joints)
    J_v = jnp.cross(chain.axis, chain.foot[:, None] - chain.origin)
    return jnp.swapaxes(J_v, 1, 2), jnp.swapaxes(chain.axis, 1, 2)


def inverse_legs(
    robot: Robot,
    position: Float[Array, "feet 3"],
    yaw: Float[Array, " feet"],
    up: Float[Array, "feet 3"],
    start: Float[Array, " joints"],
    *,
    steps: int = NEWTON_STEPS,
) -> Float[Array, " joints"]:
    """Return the joint angles [rad] for target foot poses; the inverse of `foot_poses`.

    If a target is out of reach, the leg points at it as far as its limits allow. The result and its
    derivatives are always finite. The closed form limits yaw and knee only; it returns the solution
    with the foot point below the hip roll axis.

    Args:
        robot: with the legs.
        position: foot points in the trunk frame [m].
        yaw: headings of the feet in the trunk frame [rad].
        up: normals of the soles in the trunk frame.
        start: nearby joint angles [rad]; not used by the closed form.
        steps: of the Newton iteration (static).
    """
    leg = _leg_constants(robot)
    if robot.structure.closed_form:
        yaw = jnp.clip(yaw, leg.lower[:, 0], leg.upper[:, 0])
        up_yawed = jnp.stack([n @ rot_z(psi) for n, psi in zip(up, yaw, strict=True)])
        pitch = jnp.arctan2(up_yawed[:, 0], up_yawed[:, 2])
        return jax.vmap(_closed_form_inverse)(leg, position, yaw, pitch).reshape(-1)
    inverse = jax.vmap(partial(_newton_inverse, placed=robot.structure.placed, steps=steps))
    return inverse(leg, start.reshape(leg.lower.shape), position, yaw, up).reshape(-1)


def leg_gravity(
    robot: Robot, joints: Float[Array, " joints"], up: Float[Any, "3"]
) -> Float[Array, " joints"]:
    """Return the joint torques [N m] that hold the legs' own weight, with the trunk fixed.

    Args:
        robot: link masses and CoMs.
        joints: angles [rad].
        up: gravity pointing up, in the trunk frame [m/s^2].
    """
    chain = _chain(robot, joints)
    com = chain.origin + jnp.sum(chain.frames * jnp.asarray(robot.link_com)[:, :, None, :], axis=-1)
    link_mass, count = jnp.asarray(robot.link_mass), robot.description.leg_joints
    # a joint carries the links from its own outwards: row of the joint, column of the link
    mass = jnp.triu(jnp.broadcast_to(link_mass[:, None, :], (len(link_mass), count, count)))
    lever = jnp.sum(mass[..., None] * (com[:, None] - chain.origin[:, :, None]), axis=2)
    return jnp.sum(chain.axis * jnp.cross(lever, up), axis=-1).reshape(-1)


def knee_joints(robot: Robot) -> tuple[int, int, int]:
    """Return the indices of hip, knee and ankle in a leg, counted from the trunk.

    The knee is the joint that changes the leg's length most in the standing pose; hip and ankle are
    the joints nearest to it with parallel axes, or the first and the last joint.
    """
    count, standing = robot.description.leg_joints, jnp.asarray(robot.standing_joints)
    leg = foot_poses(robot, standing).position[0] - robot.joint_origin[0, 0]
    slopes = np.abs(leg @ foot_jacobians(robot, standing)[0][0])  # of half the squared length
    knee = int(np.argmax(slopes[1:])) + 1
    parallel = np.abs(robot.joint_axis[0] @ robot.joint_axis[0, knee]) > 0.9
    above, below = np.flatnonzero(parallel[:knee]), np.flatnonzero(parallel[knee + 1 :])
    hip = int(above[-1]) if len(above) else 0
    return hip, knee, knee + 1 + int(below[0]) if len(below) else count - 1


class _Leg(NamedTuple):
    """Constants of a leg."""

    origin: Float[Array, "*legs j 3"]
    axis: Float[Array, "*legs j 3"]
    foot_point: Float[Array, "*legs 3"]
    sole: Float[Array, "*legs 3 3"]
    lower: Float[Array, "*legs j"]
    upper: Float[Array, "*legs j"]
    standing: Float[Array, "*legs j"]


class _Chain(NamedTuple):
    """Feet, joints and links of all legs in the trunk frame."""

    foot: Float[Array, "feet 3"]
    rotation: Float[Array, "feet 3 3"]
    origin: Float[Array, "feet j 3"]
    axis: Float[Array, "feet j 3"]
    frames: Float[Array, "feet j 3 3"]  # axes of the links; XLA drops them if they are not used


def _leg_constants(robot: Robot) -> _Leg:
    """Return the constants of all legs."""
    parts = (robot.joint_origin, robot.joint_axis, robot.foot_point, robot.sole)
    limits = (robot.joint_lower, robot.joint_upper, robot.standing_joints)
    lower, upper, standing = (jnp.asarray(x).reshape(len(robot.foot_point), -1) for x in limits)
    return _Leg(*map(jnp.asarray, parts), lower=lower, upper=upper, standing=standing)


def _chain(robot: Robot, joints: Float[Array, " joints"]) -> _Chain:
    chain = _closed_form_chain if robot.structure.closed_form else _general_chain
    return jax.vmap(chain)(_leg_constants(robot), joints.reshape(len(robot.foot_point), -1))


def _closed_form_chain(leg: _Leg, joints: Float[Array, "5"]) -> _Chain:
    pitches = jnp.stack([*accumulate(joints[2:])])
    cy, sy = jnp.cos(joints[0]), jnp.sin(joints[0])
    cr, sr = jnp.cos(joints[1]), jnp.sin(joints[1])
    cp, sp = jnp.cos(pitches), jnp.sin(pitches)
    zero, one = jnp.zeros_like(cy), jnp.ones_like(cy)
    R_yaw = jnp.stack([cy, -sy, zero, sy, cy, zero, zero, zero, one]).reshape(3, 3)
    R_roll = jnp.stack([cy, -sy * cr, sy * sr, sy, cy * cr, -cy * sr, zero, sr, cr]).reshape(3, 3)
    ahead, side, up = R_roll[:, 0], R_roll[:, 1], R_roll[:, 2]
    # columns of R_roll Ry(p) for each of the three cumulative pitches
    R_pitch = jnp.stack(
        [
            cp[:, None] * ahead - sp[:, None] * up,
            jnp.broadcast_to(side, (3, 3)),
            sp[:, None] * ahead + cp[:, None] * up,
        ],
        axis=-1,
    )
    frames = jnp.concatenate([R_yaw[None], R_roll[None], R_pitch])
    steps = jnp.concatenate([leg.origin[1:], leg.foot_point[None]])
    # o_yaw, o_roll, ..., o_ankle, foot: each point is the previous one plus a step in its frame
    points = [*accumulate(jnp.sum(frames * steps[:, None, :], axis=-1), initial=leg.origin[0])]
    axis = jnp.stack([R_yaw[:, 2], ahead, side, side, side])
    return _Chain(points[5], frames[4], jnp.stack(points[:5]), axis, frames)


def _closed_form_inverse(
    leg: _Leg, position: Float[Array, "3"], yaw: Float[Array, ""], pitch: Float[Array, ""]
) -> Float[Array, "5"]:
    origin, foot_point = leg.origin, leg.foot_point
    # target from the roll joint, in the yawed frame
    cy, sy = jnp.cos(yaw), jnp.sin(yaw)
    x, y, z = position - origin[0]
    x, y, z = cy * x + sy * y - origin[1, 0], cy * y - sy * x - origin[1, 1], z - origin[1, 2]

    # roll turns the leg's plane, offset from the roll axis by `side`, onto the target
    side = origin[2, 1] + origin[3, 1] + origin[4, 1] + foot_point[1]
    on_axis = y**2 + z**2 < 1e-12
    z = jnp.where(on_axis, -1e-6, z)
    distance = jnp.sqrt(jnp.maximum(y**2 + z**2, (1.001 * side) ** 2 + 1e-12))
    roll = jnp.arctan2(y, -z) - jnp.arcsin(side / distance)

    # hip pitch joint to ankle, in the rolled plane
    cr, sr = jnp.cos(roll), jnp.sin(roll)
    cp, sp = jnp.cos(pitch), jnp.sin(pitch)
    x = x - origin[2, 0] - (cp * foot_point[0] + sp * foot_point[2])
    z = cr * z - sr * y - origin[2, 2] - (cp * foot_point[2] - sp * foot_point[0])
    z = jnp.where(x**2 + z**2 < 1e-12, -1e-6, z)

    # triangle of thigh and shin
    thigh, shin = -origin[3, 2], -origin[4, 2]
    cos_knee = (x**2 + z**2 - thigh**2 - shin**2) / (2 * thigh * shin)
    # the limits keep both ends away from +-1, where the derivative of arccos is infinite
    low, high = jnp.cos(leg.lower[3]), jnp.cos(leg.upper[3])
    bend = jnp.arccos(jnp.clip(cos_knee, jnp.minimum(low, high), jnp.maximum(low, high)))
    knee = jnp.where(leg.lower[3] < 0.0, -bend, bend)
    hip = jnp.arctan2(-x, -z) - jnp.arctan2(shin * jnp.sin(knee), thigh + shin * jnp.cos(knee))
    return jnp.stack([yaw, roll, hip, knee, pitch - hip - knee])


def _general_chain(leg: _Leg, joints: Float[Array, " j"]) -> _Chain:
    R, point = jnp.eye(3, dtype=joints.dtype), jnp.zeros(3, joints.dtype)
    K = jax.vmap(skew)(leg.axis.astype(joints.dtype))
    sin, cos = jnp.sin(joints)[:, None, None], jnp.cos(joints)[:, None, None]
    rotations = jnp.eye(3, dtype=joints.dtype) + sin * K + (1.0 - cos) * (K @ K)  # Rodrigues
    points, axes, frames = [], [], []
    for origin, axis, rotation in zip(leg.origin, leg.axis, rotations, strict=True):
        point = point + R @ origin
        points.append(point)
        axes.append(R @ axis)
        R = R @ rotation
        frames.append(R)
    foot = point + R @ leg.foot_point
    return _Chain(foot, R @ leg.sole, *map(jnp.stack, (points, axes, frames)))


def _newton_inverse(
    leg: _Leg,
    start: Float[Array, " j"],
    position: Float[Array, "3"],
    yaw: Float[Array, ""],
    up: Float[Array, "3"],
    *,
    placed: tuple[int, ...],
    steps: int,
) -> Float[Array, " j"]:
    rows = np.array(placed)

    def error(
        joints: Array, target: tuple[Array, Array, Array]
    ) -> tuple[Float[Array, " rows"], Float[Array, "rows j"]]:
        """Return the error of foot point [m] and sole [rad] in the rows, and its Jacobian."""
        chain, (position, yaw, up) = _general_chain(leg, joints), target
        pitch = jnp.arctan2(-up[0], jnp.hypot(up[1], up[2]))
        to_target = rot_z(yaw).T @ rot_y(pitch) @ rot_x(jnp.arctan2(up[1], up[2]))
        rotation = _rotation_vector(to_target @ chain.rotation)
        J_v = jnp.cross(chain.axis, chain.foot - chain.origin).T
        J_w = _rotation_vector_rates(rotation) @ to_target @ chain.axis.T
        residual = jnp.concatenate([chain.foot - position, rotation])
        return residual[rows], jnp.concatenate([J_v, J_w])[rows]

    def step(joints: Array, target: tuple[Array, Array, Array]) -> Array:
        constant = jax.lax.stop_gradient(joints)
        residual, J = error(constant, target)
        J = jax.lax.stop_gradient(J)
        damping = _DAMPING * jax.lax.stop_gradient(residual @ residual) + 1e-12
        damped = J @ J.T + damping * jnp.eye(len(rows), dtype=J.dtype)
        rest = leg.standing - constant  # for redundant joints
        return rest - J.T @ _solve(damped, residual + J @ rest)

    def iterate(joints: Array, _: None) -> tuple[Array, None]:
        joints = joints + jnp.clip(step(joints, constant_target), -_MAX_STEP, _MAX_STEP)
        return jnp.clip(joints, leg.lower, leg.upper), None

    target = (position, yaw, up)
    constant_target = jax.lax.stop_gradient(target)
    joints, _ = jax.lax.scan(iterate, jax.lax.stop_gradient(start), length=steps)
    # only this last step is differentiated: its derivative is that of the solution
    return joints + step(joints, target)


def _solve(A: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve A x = b for a small positive definite A by elimination in operations that XLA fuses."""
    rows = jnp.concatenate([A, b[:, None]], axis=1)
    for i in range(len(b)):
        pivot = rows[i] / rows[i, i]
        rows = jnp.where(np.arange(len(b))[:, None] == i, pivot, rows - rows[:, i : i + 1] * pivot)
    return rows[:, -1]


def _rotation_vector(R: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return axis times angle [rad] of a rotation by less than half a turn."""
    vector = 0.5 * jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    square = vector @ vector
    small = square < 1e-16
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = jnp.arctan2(sine, 0.5 * (jnp.trace(R) - 1.0))
    return jnp.where(small, 1.0, angle / sine) * vector


def _rotation_vector_rates(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the inverse left Jacobian of SO(3): angular velocity to rate of a rotation vector."""
    square = vector @ vector
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    second = jnp.where(small, 1.0 / 12.0, (1.0 - 0.5 * angle / jnp.tan(0.5 * angle)) / angle**2)
    K = skew(vector)
    return jnp.eye(3, dtype=vector.dtype) - 0.5 * K + second * (K @ K)
