"""Why a walk in MuJoCo C goes wrong in ways that are not the weights' fault.

A trajectory has the samples from t = 0 on. What became of a robot that falls before, in the
start-up, and what its motors did, is found by walking once more, which gives the same walk, with
each millisecond recorded: a walk that goes well pays nothing for it.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.controller import WalkConfig
from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import SOLVED, Trajectory
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import World

AT_LIMIT = 0.98  # of a torque limit: behind a lag the limit is only approached
MOST_AT_LIMIT = 0.05  # share of a walk for which a motor may be at its limit
MOST_BEFORE_FALL = 0.1  # the same before a fall, where something has to be to blame
# [m] of a height that is off all along; [s] after t = 0. HECTOR is off by 1.7 cm on its curves.
STEADY, SETTLED = 0.02, 1.0
FALLING = 0.5  # [s] before a fall of which nothing is told
SUNK = 0.03  # [m] of a height that is lost while the robot is upright


class Record(NamedTuple):
    """A walk by the millisecond, start-up included, up to its end or its fall."""

    time: Float[np.ndarray, " n"]  # [s] after t = 0, at the end of the millisecond
    height: Float[np.ndarray, " n"]  # [m] of the centre of mass
    angles: Float[np.ndarray, "n 2"]  # roll, pitch [rad]
    torque: Float[np.ndarray, "n joints"]  # as a share of the motor's limit
    touching: str  # what touches the floor at the end and is no foot; empty where nothing does
    fallen: bool  # the last row is that of a fall
    trajectory: Trajectory

    @property
    def tilt(self) -> Float[np.ndarray, " n"]:
        """The larger of roll and pitch [rad], without sign."""
        return np.abs(self.angles).max(axis=1)


class StartupFall(NamedTuple):
    """A fall before t = 0."""

    time: float  # [s] after t = 0, so not above zero
    height: float  # [m] of the centre of mass
    tilt: float  # [rad], the larger of roll and pitch
    cause: str  # the likeliest

    def __str__(self) -> str:
        return (
            f"fell at {self.time:.2f} s, in the start-up: centre of mass {self.height:.2f} m high, "
            f"tilt {self.tilt:.2f} rad; likeliest cause: {self.cause}"
        )


def record_walk(config: WalkConfig, robot: Robot, job: Job) -> Record:
    """Walk once with each millisecond recorded.

    Args:
        config, robot, job: as those of `walk`.
    """
    rows, touching = [], []
    low, tilted = robot.description.limits

    def append(world: World, data: mujoco.MjData) -> None:
        if rows and rows[-1][-1]:
            return  # the rest of the tick in which it fell
        R_wb = np.zeros(9)
        mujoco.mju_quat2Mat(R_wb, data.qpos[3:7])
        below = R_wb[6:]  # z of the trunk's axes in the world
        roll, pitch = np.arctan2(below[1], below[2]), -np.arcsin(np.clip(below[0], -1.0, 1.0))
        height = data.qpos[2] + below @ robot.com_offset
        share = data.ctrl[world.actuator] / world.model.actuator_ctrlrange[world.actuator, 1]
        parts = _on_floor(world, data)
        upright = height >= low and max(abs(roll), abs(pitch)) <= tilted  # not if not finite
        fallen = bool(parts) or not upright
        rows.append((height, roll, pitch, share, fallen))
        touching[:] = parts

    trajectory = walk(config, robot, job, build=partial(MujocoPlant, on_step=append))
    heights, rolls, pitches, torques, fallen = zip(*rows, strict=True)
    lead = (job.start_tick - first_tick(config)) * substeps(config)
    return Record(
        time=TIME_STEP * (1 + np.arange(len(rows)) - lead),
        height=np.array(heights),
        angles=np.stack([rolls, pitches], axis=1),
        torque=np.array(torques),
        touching=", ".join(touching),
        fallen=fallen[-1],
        trajectory=trajectory,
    )


def _on_floor(world: World, data: mujoco.MjData) -> list[str]:
    """Geoms, or their bodies, that touch the floor and are of no foot."""
    names = set()
    for one, other in data.contact.geom[: data.ncon]:
        geom = other if one == world.floor else one
        if world.floor in (one, other) and world.foot_of_geom[geom] < 0:
            part = world.model.geom(geom)
            names.add(part.name or world.model.body(part.bodyid[0]).name)
    return sorted(names)


def at_limit(robot: Robot, torque: Float[np.ndarray, "n joints"], most: float) -> list[str]:
    """A line for each motor that is at its limit for a larger share of the time than `most`."""
    shares = (np.abs(torque) >= AT_LIMIT).mean(axis=0) if len(torque) else np.zeros(0)
    names = robot.description.joints
    return [
        f"the torque of {names[i]} is at its limit of {robot.torque_limit[i]:g} N m for "
        f"{100 * shares[i]:.0f} % of the time"
        for i in np.argsort(-shares, kind="stable")
        if shares[i] > most
    ]


def startup_fall(config: WalkConfig, robot: Robot, job: Job) -> StartupFall | None:
    """When, how and why a robot falls before t = 0; None where it does not.

    Args:
        config, robot, job: as those of `walk`.
    """
    record = record_walk(config, robot, job._replace(seconds=config.gait.tick))
    if not np.asarray(record.trajectory.fallen)[0]:
        return None
    finite = np.flatnonzero(np.isfinite(record.height) & np.isfinite(record.tilt))
    last = finite[-1] if len(finite) else 0
    return StartupFall(
        time=min(float(record.time[-1]), 0.0),
        height=float(record.height[last]),
        tilt=float(record.tilt[last]),
        cause=likeliest_cause(robot, record),
    )


def likeliest_cause(robot: Robot, record: Record) -> str:
    """The likeliest cause of a fall, from what came before the robot was half over."""
    if not record.fallen or not np.isfinite(record.height[-1]):
        return "the physics diverges (joint gains too large, masses or inertias too small)"
    if not np.max(record.trajectory.residual) <= SOLVED:
        return "a QP of the MPC is not solved"
    low, tilted = robot.description.limits
    standing = float(robot.standing_height)
    over = (record.tilt > 0.5 * tilted) | (record.height < 0.5 * (standing + low))
    count = max(int(np.argmax(over)) if over.any() else len(over), 1)
    if lines := at_limit(robot, record.torque[:count], MOST_BEFORE_FALL):
        return lines[0]
    error = record.height[:count] - standing
    if _grows(error, record.tilt[:count] / tilted):
        way = "sinks" if error[-1] < 0.0 else "rises"
        return (
            f"the centre of mass {way} steadily, by {100 * abs(error[-1]):.0f} cm while still "
            "upright (the feet do not reach the floor as planned, joint gains or mass are wrong)"
        )
    if record.touching and record.tilt[-1] <= tilted and record.height[-1] >= low:
        return f"{record.touching} touches the floor"
    roll, pitch = record.angles[-1]
    if abs(roll) > abs(pitch):
        way = "to the right" if roll > 0.0 else "to the left"
    else:
        way = "forwards" if pitch > 0.0 else "backwards"
    return f"it tips over {way} (standing pose, joint gains, gait)"


def _grows(error: Float[np.ndarray, " n"], tilt: Float[np.ndarray, " n"]) -> bool:
    """Whether an error of the height grows all along, and tells before the tilt does.

    Args:
        error: [m].
        tilt: as a share of that of a fall.
    """
    if len(error) < 3 or abs(error[-1]) < SUNK or tilt[np.argmax(np.abs(error) >= SUNK)] > 0.25:
        return False
    early, middle, late = (abs(part.mean()) for part in np.array_split(error, 3))
    return bool(early < middle < late)


def _steady_height(trajectory: Trajectory, rows: Bool[np.ndarray, " T"]) -> list[str]:
    errors = (trajectory.state.position - trajectory.reference.position)[rows, 2]
    if len(errors) < 3:
        return []
    error, parts = errors.mean(), [part.mean() for part in np.array_split(errors, 3)]
    if abs(error) <= STEADY or min(part / error for part in parts) < 0.5:
        return []
    way = "above" if error > 0.0 else "below"
    return [
        f"the centre of mass is {100 * abs(error):.1f} cm {way} its reference all along: wrong "
        "mass, or joint gains (kp) that are too small"
    ]


def not_the_weights(config: WalkConfig, robot: Robot, job: Job) -> list[str]:
    """What is wrong with a walk and likely not the weights' fault, a line each; mostly none.

    A fall in the start-up; otherwise a height that is off all along, and motors at their limits.

    Args:
        config, robot, job: as those of `walk`.
    """
    record = record_walk(config, robot, job)
    if np.asarray(record.trajectory.fallen)[0]:
        return [str(startup_fall(config, robot, job))]
    end = record.time[-1] - FALLING * record.fallen
    time = float(record.trajectory.period) * np.arange(1, len(record.trajectory.fallen) + 1)
    upright = (time > SETTLED) & (time <= end)
    torque = record.torque[record.time <= end]
    return [*_steady_height(record.trajectory, upright), *at_limit(robot, torque, MOST_AT_LIMIT)]
