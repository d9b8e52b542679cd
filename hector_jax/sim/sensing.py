"""What the robot and we know: base state, encoders, ground wrenches, falls, estimation errors.

Everything here is pure and reads arrays that MuJoCo C and MJX both have, so that one function
serves both. The centre of mass is the trunk's pose plus the constant offset of the standing robot,
as the controller has it. A wrench is that of the ground on the robot at the foot point, in the
world frame. The controller gets an estimate; losses and labels read the truth.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.control.legs import Measurement
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import euler_from_rotation, rotation_from_quaternion, wrap_angle
from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import State
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim.world import Estimator, World

_EDGES = np.arange(4)  # of a friction pyramid, in order
CONTACTS = 16  # contacts kept of a millisecond in MuJoCo C
DRIFT_TIME = 4.0  # [s] after which the drift has its stated size


class Reading(NamedTuple):
    """Coordinates of the robot, those of MuJoCo in every engine."""

    pose: Float[Array, "*batch 7"]  # trunk: position [m], quaternion
    velocity: Float[
        Array, "*batch 6"
    ]  # trunk: linear in the world [m/s], angular in the trunk [rad/s]
    joints: Float[Array, "*batch joints"]  # [rad] motor side
    joint_rates: Float[Array, "*batch joints"]  # [rad/s]
    slack: Float[Array, "*batch joints"]  # [rad] from motor to link; zero without backlash


class Touches(NamedTuple):
    """What touches what; feet on the floor apart."""

    floor: Bool[Array, "*batch"]  # the floor is touched by anything else
    legs: Bool[Array, "*batch"]  # one leg touches the other


class Ground(NamedTuple):
    """What the ground does to the feet over a millisecond."""

    force: Float[Array, "*batch feet 3"]  # [N] on each foot, world frame
    moment: Float[Array, "*batch feet 3"]  # [N m] about the world's origin
    touches: Touches


class Contacts(NamedTuple):
    """Contact points of one step as MuJoCo has them; rows without a contact have geoms -1."""

    geoms: Int[Array, "*batch n 2"]
    position: Float[Array, "*batch n 3"]  # [m]
    frame: Float[Array, "*batch n 3 3"]  # rows: normal from the first geom to the second, tangents
    pyramid: Float[Array, "*batch n 4"]  # [N] along the edges of the friction pyramid
    friction: Float[Array, "*batch n 2"]  # along the tangents


def coordinates(world: World) -> Int[np.ndarray, " reading"]:
    """Where a flat reading's entries are in (qpos, qvel, 0); no backlash reads the zero."""
    model = world.model
    rigid = np.full(len(world.joint_qpos), model.nq + model.nv)
    slack = world.slack_qpos if world.slack_qpos.size else rigid
    trunk_rates, joint_rates = model.nq + np.arange(6), model.nq + world.joint_dof
    return np.concatenate([np.arange(7), trunk_rates, world.joint_qpos, joint_rates, slack])


def unpack_reading(row: Float[Array, "*batch reading"]) -> Reading:
    """Reading of a flat row, which holds its fields in their order."""
    joints = (row.shape[-1] - 13) // 3
    ends = np.cumsum([7, 6, joints, joints])
    return Reading(*jnp.split(row, ends, axis=-1))


def base_state(robot: Robot, reading: Reading, yaw_before: Float[Array, ""]) -> State:
    """True state of the single rigid body; its yaw is the one closest to `yaw_before` [rad]."""
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
    """True foot points in the world [m]."""
    R_wb = rotation_from_quaternion(reading.pose[3:])
    local = foot_poses(robot, reading.joints + reading.slack).position
    return reading.pose[:3] + local @ R_wb.T


def foot_contacts(
    contacts: Contacts, floor: Int[Array, ""], foot_of_geom: Int[Array, " ngeom"]
) -> tuple[Int[Array, " n"], Touches]:
    """Foot of each contact with the floor (-1: none), and what else touches.

    Whatever touches and is not the floor are legs: the model lets no other parts collide.
    """
    real = contacts.geoms[:, 0] >= 0
    on_floor = contacts.geoms == floor
    ground = on_floor.any(axis=1) & real
    other = jnp.where(on_floor[:, 0], contacts.geoms[:, 1], contacts.geoms[:, 0])
    foot = jnp.where(ground, foot_of_geom[other], -1)
    return foot, Touches(jnp.any(ground & (foot < 0)), jnp.any(real & ~ground))


def ground_of(
    contacts: Contacts, floor: Int[Array, ""], foot_of_geom: Int[Array, " ngeom"], feet: int
) -> Ground:
    """What the contacts of a step of MuJoCo do to each of `feet` feet.

    Args:
        contacts: of the step; pyramidal cones of three dimensions.
        floor, foot_of_geom: from the World.
        feet: their number.
    """
    foot, touches = foot_contacts(contacts, floor, foot_of_geom)
    p, mu = contacts.pyramid, contacts.friction
    local = jnp.stack(
        [p.sum(axis=1), mu[:, 0] * (p[:, 0] - p[:, 1]), mu[:, 1] * (p[:, 2] - p[:, 3])], axis=1
    )
    # MuJoCo's contact force acts on the second geom.
    sign = jnp.where(contacts.geoms[:, 1] == floor, -1.0, 1.0)
    force = sign[:, None] * jnp.einsum("nij,ni->nj", contacts.frame, local)
    mine = (foot[None, :] == jnp.arange(feet)[:, None])[..., None]  # (feet, n, 1)
    at_foot = jnp.where(mine, force, 0.0)
    moment = jnp.cross(contacts.position, at_foot).sum(axis=1)
    return Ground(at_foot.sum(axis=1), moment, touches)


def read_contacts(world: World, data: mujoco.MjData, out: Contacts, row: int) -> None:
    """Copy the contacts of the last step of MuJoCo C into a row of `out` (numpy)."""
    count, found = data.ncon, data.contact
    out.geoms[row] = -1
    if count > CONTACTS:  # nobody walks with so many: told as the floor touched by no foot
        out.geoms[row] = world.floor
    elif count:
        address = found.efc_address  # -1: left out of the constraints
        edges = address[:, None] + _EDGES
        out.geoms[row, :count] = found.geom
        out.position[row, :count] = found.pos
        out.frame[row, :count] = found.frame.reshape(-1, 3, 3)
        out.friction[row, :count] = found.friction[:, :2]
        out.pyramid[row, :count] = data.efc_force.take(edges, mode="clip")
        if address.min() < 0:
            out.pyramid[row, :count][address < 0] = 0.0


def empty_contacts(rows: int) -> Contacts:
    """Room for the contacts of `rows` steps of MuJoCo C (numpy)."""
    n = CONTACTS
    return Contacts(
        geoms=np.full((rows, n, 2), -1),
        position=np.zeros((rows, n, 3)),
        frame=np.zeros((rows, n, 3, 3)),
        pyramid=np.zeros((rows, n, 4)),
        friction=np.zeros((rows, n, 2)),
    )


def measure(
    robot: Robot, reading: Reading, yaw_before: Float[Array, ""], error: Float[Array, " errors"]
) -> tuple[Measurement, Float[Array, ""]]:
    """What the controller is told, the truth plus `error`; and the true yaw, for the next call."""
    state = base_state(robot, reading, yaw_before)
    estimate = State(*(value + error[3 * i : 3 * i + 3] for i, value in enumerate(state)))
    joints = reading.joints + error[12:]
    return Measurement(estimate, joints, reading.joint_rates), state.euler[2]


def no_error(robot: Robot) -> Float[Array, " errors"]:
    """Errors of an estimate that has none: those of a State in its order, then the joints'."""
    return jnp.zeros(12 + len(robot.joint_lower))


def draw_errors(
    estimator: Estimator, joints: int, seed: int, before: int, after: int
) -> Float[np.ndarray, "steps errors"]:
    """Errors of the estimate by millisecond: white noise, and a drift that starts at t = 0.

    Args:
        estimator: their sizes.
        joints: of the robot.
        seed: which errors; the same seed gives the same bytes.
        before: steps before t = 0.
        after: steps from t = 0 on.
    """
    rng = np.random.default_rng([0xE57, seed])
    steps = before + after
    sizes = [estimator.angle, estimator.position, estimator.ang_velocity, estimator.velocity]
    size = np.concatenate([np.repeat(sizes, 3), np.repeat(estimator.joint, joints)])
    errors = rng.standard_normal((steps, len(size))) * size
    walk = rng.standard_normal((after, 3)) * np.sqrt(TIME_STEP / DRIFT_TIME)
    walk *= [estimator.drift_yaw, estimator.drift, estimator.drift]
    errors[before:, [2, 3, 4]] += np.cumsum(walk, axis=0)  # yaw, x, y
    return errors
