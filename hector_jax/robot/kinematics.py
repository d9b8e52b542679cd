"""Feet from joints and joints from feet, all in the trunk frame.

A leg is a chain hip yaw (z), hip roll (x), hip pitch, knee, ankle (y). Behind yaw psi and roll phi
the three pitch joints move in one plane. With the running pitches a = q_2, b = q_2 + q_3 and
theta = q_2 + q_3 + q_4

    foot point = o_yaw + Rz(psi) (o_roll + Rx(phi) p)
    p = o_pitch + Ry(a) o_knee + Ry(b) o_ankle + Ry(theta) sole

and the way back is closed: yaw is given, roll turns the plane onto the target, the rest is a
triangle of thigh and shin. The knee bends backwards (negative). `compile_model` has checked the
axes and that thigh and shin point down at zero.

A leg whose joints come in another order (`Description.axes`) is a product of rotations, and the way
back is a damped Newton iteration of `NEWTON_STEPS` steps from the standing pose. There the yaw is
the heading that the foot's y axis is square to, and the pitch is about that axis from it: in the
order above they are psi and theta.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_x, rot_y, rot_z
from hector_jax.robot.description import HECTOR_AXES
from hector_jax.robot.model import Robot

NEWTON_STEPS = 16
_LARGEST_STEP = 0.4  # [rad] of a joint in a Newton step
_DAMPING = 0.1  # times the squared error


class FootPoses(NamedTuple):
    """Both feet in the trunk frame, left then right."""

    position: Float[Array, "2 3"]  # foot points [m]
    rotation: Float[Array, "2 3 3"]  # takes foot vectors to the trunk frame


def foot_poses(robot: Robot, joints: Float[Array, "10"]) -> FootPoses:
    """Foot points and foot axes of the joint angles [rad]."""
    chain = _chain(robot, joints)
    return FootPoses(chain.foot, chain.rotation)


def foot_jacobians(
    robot: Robot, joints: Float[Array, "10"]
) -> tuple[Float[Array, "2 3 5"], Float[Array, "2 3 5"]]:
    """Jacobians of each foot point by its own leg's joints: velocity [m] and angular velocity [-].

    Trunk axes, trunk at rest: for a foot at rest on the ground, add the trunk's own motion.
    """
    chain = _chain(robot, joints)
    J_v = jnp.cross(chain.axis, chain.foot[:, None] - chain.origin)
    return jnp.swapaxes(J_v, 1, 2), jnp.swapaxes(chain.axis, 1, 2)


def inverse_legs(
    robot: Robot, position: Float[Array, "2 3"], yaw: Float[Array, "2"], pitch: Float[Array, "2"]
) -> Float[Array, "10"]:
    """Joint angles [rad] that put the foot points at `position`; the inverse of `foot_poses`.

    Where a target is out of reach the leg points at it as far as the knee's limits let it; hip and
    ankle angles are not limited. Of the two solutions it takes the one with the foot point below
    the hip roll axis. Finite, with finite derivatives, everywhere.

    Args:
        robot: leg lengths and knee limits.
        position: foot points in the trunk frame [m].
        yaw: hip yaw angles [rad].
        pitch: sum of the three pitch joints [rad], the foot's pitch against the leg's rolled frame.
    """
    knee = robot.description.pitch_joints[1]
    leg = _Leg(
        jnp.asarray(robot.joint_origin),
        jnp.asarray(robot.foot_point),
        jnp.asarray(robot.joint_lower).reshape(2, 5)[:, knee],
        jnp.asarray(robot.joint_upper).reshape(2, 5)[:, knee],
    )
    axes = robot.description.axes
    if axes == HECTOR_AXES:
        return jax.vmap(_inverse_leg)(leg, position, yaw, pitch).reshape(10)
    standing = jnp.asarray(robot.standing_joints).reshape(2, 5)
    search = jax.vmap(partial(_searched_leg, axes, knee))
    return search(leg, standing, position, yaw, pitch).reshape(10)


def leg_gravity(
    robot: Robot, joints: Float[Array, "10"], up: Float[Any, "3"]
) -> Float[Array, "10"]:
    """Joint torques [N m] that hold the legs' own weight, with the trunk fixed.

    Args:
        robot: link masses and CoMs.
        joints: angles [rad].
        up: gravity pointing up, in the trunk frame [m/s^2].
    """
    chain = _chain(robot, joints)
    com = chain.origin + jnp.sum(chain.frames * jnp.asarray(robot.link_com)[:, :, None, :], axis=-1)
    # a joint carries the links from its own outwards: row of the joint, column of the link
    mass = jnp.triu(jnp.broadcast_to(jnp.asarray(robot.link_mass)[:, None, :], (2, 5, 5)))
    lever = jnp.sum(mass[..., None] * (com[:, None] - chain.origin[:, :, None]), axis=2)
    moment = jnp.cross(lever, up)
    return jnp.sum(chain.axis * moment, axis=-1).reshape(10)


class _Leg(NamedTuple):
    """Constants of a leg."""

    origin: Float[Array, "*legs 5 3"]
    foot_point: Float[Array, "*legs 3"]
    knee_lower: Float[Array, "*legs"]
    knee_upper: Float[Array, "*legs"]


class _Chain(NamedTuple):
    """Both legs unrolled in the trunk frame."""

    foot: Float[Array, "2 3"]
    rotation: Float[Array, "2 3 3"]
    origin: Float[Array, "2 5 3"]
    axis: Float[Array, "2 5 3"]
    frames: Float[Array, "2 5 3 3"]  # links' axes; computed only where they are used


def _chain(robot: Robot, joints: Float[Array, "10"]) -> _Chain:
    axes = robot.description.axes
    leg = _leg_chain if axes == HECTOR_AXES else partial(_any_chain, axes)
    return jax.vmap(leg)(
        jnp.asarray(robot.joint_origin), jnp.asarray(robot.foot_point), joints.reshape(2, 5)
    )


def _leg_chain(
    origin: Float[Array, "5 3"], foot_point: Float[Array, "3"], joints: Float[Array, "5"]
) -> _Chain:
    pitches = jnp.cumsum(joints[2:])
    cy, sy = jnp.cos(joints[0]), jnp.sin(joints[0])
    cr, sr = jnp.cos(joints[1]), jnp.sin(joints[1])
    cp, sp = jnp.cos(pitches), jnp.sin(pitches)
    zero, one = jnp.zeros_like(cy), jnp.ones_like(cy)
    R_yaw = jnp.stack([cy, -sy, zero, sy, cy, zero, zero, zero, one]).reshape(3, 3)
    R_roll = jnp.stack([cy, -sy * cr, sy * sr, sy, cy * cr, -cy * sr, zero, sr, cr]).reshape(3, 3)
    ahead, side, up = R_roll[:, 0], R_roll[:, 1], R_roll[:, 2]
    # columns of R_roll Ry(p), one for each of the three running pitches
    R_pitch = jnp.stack(
        [
            cp[:, None] * ahead - sp[:, None] * up,
            jnp.broadcast_to(side, (3, 3)),
            sp[:, None] * ahead + cp[:, None] * up,
        ],
        axis=-1,
    )
    frames = jnp.concatenate([R_yaw[None], R_roll[None], R_pitch])
    steps = jnp.concatenate([origin[1:], foot_point[None]])
    # o_yaw, o_roll, ..., o_ankle, foot: each is the one before plus a step in its frame
    points = jnp.cumsum(
        jnp.concatenate([origin[:1], jnp.sum(frames * steps[:, None, :], axis=-1)]), axis=0
    )
    axis = jnp.stack([R_yaw[:, 2], ahead, side, side, side])
    return _Chain(points[5], frames[4], points[:5], axis, frames)


def _inverse_leg(
    leg: _Leg, position: Float[Array, "3"], yaw: Float[Array, ""], pitch: Float[Array, ""]
) -> Float[Array, "5"]:
    origin, foot_point, knee_lower, knee_upper = leg
    # target from the roll joint, in the yawed frame
    cy, sy = jnp.cos(yaw), jnp.sin(yaw)
    x, y, z = position - origin[0]
    x, y, z = cy * x + sy * y - origin[1, 0], cy * y - sy * x - origin[1, 1], z - origin[1, 2]

    # roll turns the leg's plane, `side` beside the roll axis, onto the target
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
    # compile_model has checked that the limits keep both ends off +-1, where arccos has no slope
    knee = -jnp.arccos(jnp.clip(cos_knee, jnp.cos(knee_lower), jnp.cos(knee_upper)))
    hip = jnp.arctan2(-x, -z) - jnp.arctan2(shin * jnp.sin(knee), thigh + shin * jnp.cos(knee))
    return jnp.stack([yaw, roll, hip, knee, pitch - hip - knee])


def _any_chain(
    axes: str, origin: Float[Array, "5 3"], foot_point: Float[Array, "3"], joints: Float[Array, "5"]
) -> _Chain:
    turns = {"x": rot_x, "y": rot_y, "z": rot_z}
    R, point = jnp.eye(3, dtype=joints.dtype), jnp.zeros(3, joints.dtype)
    points, axis, frames = [], [], []
    for i, letter in enumerate(axes):
        point = point + R @ origin[i]
        points.append(point)
        axis.append(R[:, "xyz".index(letter)])
        R = R @ turns[letter](joints[i])
        frames.append(R)
    foot = point + R @ foot_point
    return _Chain(foot, R, *(jnp.stack(rows) for rows in (points, axis, frames)))


def _searched_leg(
    axes: str,
    knee: int,
    leg: _Leg,
    start: Float[Array, "5"],
    position: Float[Array, "3"],
    yaw: Float[Array, ""],
    pitch: Float[Array, ""],
) -> Float[Array, "5"]:
    def error(joints: Array, position: Array, yaw: Array, pitch: Array) -> Array:
        """Of the foot point [m] and of the foot's two directions; zero where all is met."""
        chain = _any_chain(axes, leg.origin, leg.foot_point, joints)
        along = jnp.cos(yaw) * chain.rotation[0] + jnp.sin(yaw) * chain.rotation[1]
        across = jnp.cos(pitch) * along[2] - jnp.sin(pitch) * along[0]
        ahead = jnp.cos(pitch) * along[0] + jnp.sin(pitch) * along[2]
        ahead = jnp.where(across**2 + ahead**2 < 1e-12, 1.0, ahead)
        return jnp.append(chain.foot - position, jnp.stack([along[1], jnp.arctan2(across, ahead)]))

    def step(joints: Array, target: tuple[Array, Array, Array]) -> Array:
        still = jax.lax.stop_gradient(joints)
        now, J = error(still, *target), jax.jacfwd(error)(still, *jax.lax.stop_gradient(target))
        damping = _DAMPING * jax.lax.stop_gradient(now @ now) + 1e-12
        return -jnp.linalg.solve(J.T @ J + damping * jnp.eye(5, dtype=J.dtype), J.T @ now)

    def improved(joints: Array, _: None) -> tuple[Array, None]:
        moved = joints + jnp.clip(step(joints, fixed), -_LARGEST_STEP, _LARGEST_STEP)
        return moved.at[knee].set(jnp.clip(moved[knee], leg.knee_lower, leg.knee_upper)), None

    target = (position, yaw, pitch)
    fixed = jax.lax.stop_gradient(target)
    joints, _ = jax.lax.scan(improved, jax.lax.stop_gradient(start), length=NEWTON_STEPS)
    # one step more, the only one that is differentiated: its derivative is that of the solution
    return joints + step(joints, target)
