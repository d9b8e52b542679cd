"""True values and measurements: base state, encoders, ground wrenches, falls, estimation errors.

The functions are pure and read arrays that MuJoCo C and MJX both have, so that they serve both.
The centre of mass is the trunk's pose plus the constant offset of the standing robot, as in the
controller. A wrench is that of the ground on the robot at the foot point, in the world frame. The
controller gets an estimate; losses and labels use the true values.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.control.legs import Measurement
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import euler_from_rotation, rotation_from_quaternion, wrap_angle
from hector_jax.core.trajectory import State
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim.world import Estimator, World

DRIFT_TIME = 4.0  # [s] after which the drift has its nominal size


class Reading(NamedTuple):
    """Coordinates of the robot, those of MuJoCo in every engine."""

    pose: Float[Array, "*batch 7"]  # trunk: position [m], quaternion (w, x, y, z)
    # trunk: linear velocity in the world [m/s], angular velocity in the trunk [rad/s]
    velocity: Float[Array, "*batch 6"]
    joints: Float[Array, "*batch joints"]  # [rad] motor side
    joint_rates: Float[Array, "*batch joints"]  # [rad/s]
    slack: Float[Array, "*batch joints"]  # [rad] from motor to link; zero without backlash


class Touches(NamedTuple):
    """Contacts other than feet on the floor."""

    floor: Bool[Array, "*batch"]  # a part other than a foot touches the floor
    legs: Bool[Array, "*batch"]  # one leg touches the other


class Ground(NamedTuple):
    """Load of the ground on the feet over a millisecond, and other contacts."""

    force: Float[Array, "*batch feet 3"]  # [N] on each foot, world frame
    moment: Float[Array, "*batch feet 3"]  # [N m] about `centre`
    centre: Float[Array, "*batch feet 3"]  # [m] of each foot's contacts, or any other point
    touches: Touches


class Contacts(NamedTuple):
    """Contact points of one step as MuJoCo has them; rows without a contact have geoms -1."""

    geoms: Int[Array, "*batch n 2"]
    position: Float[Array, "*batch n 3"]  # [m]
    frame: Float[Array, "*batch n 3 3"]  # rows: normal from the first geom to the second, tangents
    pyramid: Float[Array, "*batch n 4"]  # [N] along the edges of the friction pyramid
    friction: Float[Array, "*batch n 2"]  # along the tangents


def coordinates(world: World) -> Int[np.ndarray, " reading"]:
    """Return the indices of a flat reading in (qpos, qvel, 0); without backlash slack is the 0."""
    model = world.model
    rigid = np.full(len(world.joint_qpos), model.nq + model.nv)
    slack = model.jnt_qposadr[world.slack] if world.slack.size else rigid
    trunk_rates, joint_rates = model.nq + np.arange(6), model.nq + world.joint_dof
    return np.concatenate([np.arange(7), trunk_rates, world.joint_qpos, joint_rates, slack])


def unpack_reading(row: Float[Array, "*batch reading"]) -> Reading:
    """Split a flat row, which holds the fields in their order, into a Reading."""
    joints = (row.shape[-1] - 13) // 3
    ends = np.cumsum([7, 6, joints, joints])
    return Reading(*jnp.split(row, ends, axis=-1))


def base_state(robot: Robot, reading: Reading, yaw_before: Float[Array, ""]) -> State:
    """Return the true state of the rigid body; its yaw is the one closest to `yaw_before` [rad]."""
    R_wb = rotation_from_quaternion(reading.pose[3:])
    euler = euler_from_rotation(R_wb)
    offset = R_wb @ robot.com_offset
    ang_velocity = R_wb @ reading.velocity[3:]
    return State(
        euler=euler.at[2].set(yaw_before + wrap_angle(euler[2] - yaw_before)),
        position=reading.pose[:3] + offset,
        ang_velocity=ang_velocity,
        velocity=reading.velocity[:3] + jnp.cross(ang_velocity, offset),
    )


def foot_points(robot: Robot, reading: Reading) -> Float[Array, "feet 3"]:
    """Return the true foot points in the world [m]."""
    R_wb = rotation_from_quaternion(reading.pose[3:])
    local = foot_poses(robot, reading.joints + reading.slack).position
    return reading.pose[:3] + local @ R_wb.T


def ground_of(
    contacts: Contacts, floor: Int[Array, ""], foot_of_geom: Int[Array, " ngeom"], feet: int
) -> Ground:
    """Sum the contacts of a step of MuJoCo to the load on each of `feet` feet.

    Args:
        contacts: of the step; pyramidal cones of three dimensions.
        floor, foot_of_geom: from the World.
        feet: number of feet.
    """
    active, is_floor = contacts.geoms[:, 0] >= 0, contacts.geoms == floor
    on_floor = is_floor.any(axis=1) & active
    geom = jnp.where(is_floor[:, 0], contacts.geoms[:, 1], contacts.geoms[:, 0])
    foot = jnp.where(on_floor, foot_of_geom[geom], -1)
    # contacts off the floor are of two legs: the model lets no other parts collide
    touches = Touches(jnp.any(on_floor & (foot < 0)), jnp.any(active & ~on_floor))
    p, mu = contacts.pyramid, contacts.friction
    local = jnp.stack(
        [p.sum(axis=1), mu[:, 0] * (p[:, 0] - p[:, 1]), mu[:, 1] * (p[:, 2] - p[:, 3])], axis=1
    )
    # MuJoCo's contact force acts on the second geom.
    sign = jnp.where(contacts.geoms[:, 1] == floor, -1.0, 1.0)
    force = sign[:, None] * jnp.einsum("nij,ni->nj", contacts.frame, local)
    of_foot = (foot[None, :] == jnp.arange(feet)[:, None])[..., None]  # (feet, n, 1)
    foot_force = jnp.where(of_foot, force, 0.0)
    moment = jnp.cross(contacts.position, foot_force).sum(axis=1)
    return Ground(foot_force.sum(axis=1), moment, jnp.zeros_like(moment), touches)


def sensed_ground(rows: Float[np.ndarray, "n sensors"], feet: int) -> Ground:
    """Return the ground of n milliseconds from the contact sensors of a World (numpy).

    Args:
        rows: sensor data of each millisecond.
        feet: number of feet.
    """
    loads = rows[:, :-2].reshape(len(rows), feet, -1)
    floor, contacts = rows[:, -2:].T
    touches = Touches(floor > loads[:, :, 0].sum(axis=1), contacts > floor)
    # the sensors tell the load of the foot on the ground
    return Ground(-loads[:, :, 1:4], -loads[:, :, 4:7], loads[:, :, 7:], touches)


def measure(
    robot: Robot,
    row: Float[Array, " reading"],
    yaw: Float[Array, ""],
    error: Float[Array, " errors"],
) -> tuple[Measurement, Float[Array, ""]]:
    """Return the controller's measurement, truth plus `error`, and the yaw for the next call.

    Args:
        robot: nominal robot.
        row: flat reading.
        yaw: the true one [rad] shortly before.
        error: of the state estimate.
    """
    reading = unpack_reading(row)
    state = base_state(robot, reading, yaw)
    estimate = State(*(value + error[3 * i : 3 * i + 3] for i, value in enumerate(state)))
    joints = reading.joints + error[12:]
    return Measurement(estimate, joints, reading.joint_rates), state.euler[2]


def no_error(robot: Robot) -> Float[Array, " errors"]:
    """Return errors of zero: those of the fields of a State, then those of the joints."""
    return jnp.zeros(12 + len(robot.joint_lower))


def draw_errors(
    estimator: Estimator, joints: int, seed: int, before: int, after: int
) -> Float[np.ndarray, "steps errors"]:
    """Draw the estimate's errors by millisecond: white noise, and a drift that starts at t = 0.

    Args:
        estimator: sizes of the errors.
        joints: number of joints.
        seed: the same seed gives the same bytes.
        before: steps before t = 0.
        after: steps from t = 0 on.
    """
    rng = np.random.default_rng([0xE57, seed])
    sizes = [estimator.angle, estimator.position, estimator.ang_velocity, estimator.velocity]
    size = np.concatenate([np.repeat(sizes, 3), np.repeat(estimator.joint, joints)])
    errors = rng.standard_normal((before + after, len(size))) * size
    drift = rng.standard_normal((after, 3)) * np.sqrt(TIME_STEP / DRIFT_TIME)
    drift *= [estimator.drift_yaw, estimator.drift, estimator.drift]
    errors[before:, [2, 3, 4]] += np.cumsum(drift, axis=0)  # yaw, x, y
    return errors
