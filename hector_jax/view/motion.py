"""The motion of a robot over a walk, drawn by both the film and the page."""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from hector_jax.core.trajectory import State, Trajectory, Wrench, from_start
from hector_jax.robot.model import Robot

INK = (20, 20, 25)
MIN_SOLE = 0.015  # [m] least length of a footprint ahead of and behind the foot point


class Motion(NamedTuple):
    """A walk in the frame of its start; after a fall the robot keeps its last upright pose."""

    period: float  # [s] between samples, which are at the ends of their intervals
    weight: float  # of the robot [N]
    height: float  # of the centre of mass when the robot stands [m]
    qpos: Float[np.ndarray, "T nq"]  # of MuJoCo
    path: Float[np.ndarray, "T 3"]  # of the centre of mass [m]
    reference: Float[np.ndarray, "T 3"]  # of the centre of mass [m]
    contact: Bool[np.ndarray, "T feet"]  # planned stance
    feet: Float[np.ndarray, "T feet 3"]  # foot points [m]
    R_yaw: Float[np.ndarray, "T 3 3"]  # heading of the trunk at the start of each interval
    wrenches: dict[str, Wrench]  # of the ground on the feet by source, (T, feet, 3) each
    soles: Float[np.ndarray, "n 2 3"]  # heel and toe of each foot at touchdown; see MIN_SOLE
    upright: int  # number of samples before the fall; all of them if there is none

    @property
    def times(self) -> Float[np.ndarray, " T"]:
        """Times of the samples [s]."""
        return self.period * np.arange(1, len(self.qpos) + 1)

    @property
    def fall_time(self) -> float:
        """Time of the fall [s]; infinite if there is none."""
        return self.period * self.upright if self.upright < len(self.qpos) else np.inf

    @property
    def distance(self) -> Float[np.ndarray, " T"]:
        """Distance of the centre of mass from its reference in the plane [m]."""
        return np.linalg.norm((self.path - self.reference)[:, :2], axis=1)

    def sample_at(self, times: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        """Return the indices of the samples at some times [s]."""
        index = np.round(times / self.period).astype(int) - 1
        return np.asarray(np.clip(index, 0, len(self.qpos) - 1))


def motion(robot: Robot, walk: Trajectory, ground: Mapping[str, Wrench] | None = None) -> Motion:
    """Compute the motion of a walk.

    Args:
        robot: the body that walked.
        walk: its trajectory, at any period.
        ground: wrenches of the ground by source, (T, feet, 3) each, in the yaw frame of the walk.
    """
    walk = from_start(walk)
    count, fallen = len(walk.fallen), walk.fallen
    upright = int(np.argmax(fallen)) if fallen.any() else count
    pose = np.minimum(np.arange(count), max(upright - 1, 0))  # at each sample, the last upright one
    moving = walk.state, walk.feet, walk.joints
    state, feet, joints = jax.tree.map(lambda x: np.asarray(x)[pose], moving)
    heading = np.append(walk.initial.euler[2], state.euler[:-1, 2])
    R_yaw = Rotation.from_euler("z", heading[:, None]).as_matrix()
    ahead = R_yaw[:, None, :, 0]
    heel, toe = max(MIN_SOLE, float(robot.heel)), max(MIN_SOLE, float(robot.toe))
    soles = np.stack([feet - heel * ahead, feet + toe * ahead], axis=2)
    touchdowns = np.diff(walk.contact[:upright].astype(int), axis=0, prepend=0) > 0
    return Motion(
        period=float(walk.period),
        weight=float(robot.mass * robot.gravity[2]),
        height=float(robot.standing_height),
        qpos=poses(robot, state, joints),
        path=state.position,
        reference=np.asarray(walk.reference.position),
        contact=np.asarray(walk.contact),
        feet=feet,
        R_yaw=R_yaw,
        wrenches={
            source: Wrench(*(np.asarray(part)[pose] @ R_yaw.mT for part in wrench))
            for source, wrench in (ground or {}).items()
        },
        soles=soles[:upright][touchdowns],
        upright=upright,
    )


def motions(robot: Robot, walks: Mapping[str, Trajectory]) -> dict[str, Motion]:
    """Compute the motions of walks by name, without wrenches of the ground."""
    return {name: motion(robot, walk) for name, walk in walks.items()}


def poses(
    robot: Robot, state: State, joints: Float[np.ndarray, "T joints"]
) -> Float[np.ndarray, "T nq"]:
    """Return MuJoCo's qpos of a walk: trunk position, trunk quaternion, joints.

    Args:
        robot: the body; its CoM offset gives the trunk from the centre of mass.
        state: (T, 3) each, world frame.
        joints: [rad].
    """
    R_wb = Rotation.from_euler("ZYX", np.asarray(state.euler)[:, ::-1])
    trunk = np.asarray(state.position) - R_wb.apply(np.asarray(robot.com_offset))
    return np.concatenate([trunk, R_wb.as_quat(scalar_first=True), joints], axis=1)
