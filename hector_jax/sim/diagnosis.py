"""Diagnosis of walks in MuJoCo C that go wrong for other reasons than the weights.

A trajectory has the samples from t = 0 on. To see a fall in the start-up, or the motors' torques,
the same walk is simulated once more with each millisecond recorded, so that a normal walk costs
nothing extra.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.controller import WalkConfig
from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import SOLVED, Trajectory
from hector_jax.robot.links import rotation_of
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import World

AT_LIMIT = 0.98  # share of a torque limit: behind a lag the limit is only approached
MOST_AT_LIMIT = 0.05  # share of a walk for which a motor may be at its limit
MOST_BEFORE_FALL = 0.1  # the same before a fall, which must have some cause
# [m] least steady error of the height; [s] after t = 0. HECTOR is off by 1.7 cm on its curves.
STEADY, SETTLED = 0.02, 1.0
FALLING = 0.5  # [s] before a fall that are not evaluated
SUNK = 0.03  # [m] least loss of height of an upright robot that sinks


class Record(NamedTuple):
    """A walk by the millisecond, start-up included, up to its end or its fall."""

    time: Float[np.ndarray, " n"]  # [s] after t = 0, at the end of the millisecond
    height: Float[np.ndarray, " n"]  # [m] of the centre of mass
    angles: Float[np.ndarray, "n 2"]  # roll, pitch [rad]
    torque: Float[np.ndarray, "n joints"]  # as a share of the motor's limit
    touching: str  # parts other than feet that touch the floor at the end; empty if none do
    fallen: bool  # the last row is a fall
    trajectory: Trajectory

    @property
    def tilt(self) -> Float[np.ndarray, " n"]:
        """Larger of roll and pitch [rad], without sign."""
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
        config, robot, job: as for `walk`.
    """
    rows, touching = [], []
    min_height, max_tilt = robot.description.limits

    def append(world: World, data: mujoco.MjData) -> None:
        if rows and rows[-1][-1]:
            return  # the rest of the ten ticks in which it fell
        up = rotation_of(data.qpos[3:7])[2]  # z of the trunk's axes in the world
        roll, pitch = np.arctan2(up[1], up[2]), -np.arcsin(np.clip(up[0], -1.0, 1.0))
        height = data.qpos[2] + up @ robot.com_offset
        torque = data.ctrl / world.model.actuator_ctrlrange[:, 1]
        touching[:] = _on_floor(world, data)
        # false for values that are not finite
        upright = height >= min_height and max(abs(roll), abs(pitch)) <= max_tilt
        rows.append((height, roll, pitch, torque, bool(touching) or not upright))

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
    """Return the names of geoms, or of their bodies, that touch the floor and are of no foot."""
    names = set()
    for first, second in data.contact.geom[: data.ncon]:
        geom = second if first == world.floor else first
        if world.floor in (first, second) and world.foot_of_geom[geom] < 0:
            part = world.model.geom(geom)
            names.add(part.name or world.model.body(part.bodyid[0]).name)
    return sorted(names)


def at_limit(robot: Robot, torque: Float[np.ndarray, "n joints"], most: float) -> list[str]:
    """Return a line for each motor that is at its limit for a share of the time above `most`."""
    shares = (np.abs(torque) >= AT_LIMIT).mean(axis=0) if len(torque) else np.zeros(0)
    names = robot.description.joints
    return [
        f"the torque of {names[i]} is at its limit of {robot.torque_limit[i]:g} N m for "
        f"{100 * shares[i]:.0f} % of the time"
        for i in np.argsort(-shares, kind="stable")
        if shares[i] > most
    ]


def startup_fall(config: WalkConfig, robot: Robot, job: Job) -> StartupFall | None:
    """Return time, pose and cause of a robot's fall before t = 0; None if it does not fall.

    Args:
        config, robot, job: as for `walk`.
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
    """Return the likeliest cause of a fall, from the record before the robot was half over."""
    if not record.fallen or not np.isfinite(record.height[-1]):
        return "the physics diverges (joint gains too large, masses or inertias too small)"
    if not np.max(record.trajectory.residual) <= SOLVED:
        return "a QP of the MPC is not solved"
    min_height, max_tilt = robot.description.limits
    standing = float(robot.standing_height)
    over = (record.tilt > 0.5 * max_tilt) | (record.height < 0.5 * (standing + min_height))
    count = max(int(np.argmax(over)) if over.any() else len(over), 1)
    if lines := at_limit(robot, record.torque[:count], MOST_BEFORE_FALL):
        return lines[0]
    error = record.height[:count] - standing
    if _grows(error, record.tilt[:count] / max_tilt):
        motion = "sinks" if error[-1] < 0.0 else "rises"
        return (
            f"the centre of mass {motion} steadily, by {100 * abs(error[-1]):.0f} cm while still "
            "upright (the feet do not reach the floor as planned, joint gains or mass are wrong)"
        )
    if record.touching and record.tilt[-1] <= max_tilt and record.height[-1] >= min_height:
        return f"{record.touching} touches the floor"
    roll, pitch = record.angles[-1]
    if abs(roll) > abs(pitch):
        direction = "to the right" if roll > 0.0 else "to the left"
    else:
        direction = "forwards" if pitch > 0.0 else "backwards"
    return f"it tips over {direction} (standing pose, joint gains, gait)"


def _grows(error: Float[np.ndarray, " n"], tilt: Float[np.ndarray, " n"]) -> bool:
    """Return whether the height's error grows steadily, and shows before the tilt does.

    Args:
        error: of the height [m].
        tilt: as a share of the tilt of a fall.
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
    side = "above" if error > 0.0 else "below"
    return [
        f"the centre of mass is {100 * abs(error):.1f} cm {side} its reference all along: wrong "
        "mass, or joint gains (kp) that are too small"
    ]


def not_the_weights(config: WalkConfig, robot: Robot, job: Job) -> list[str]:
    """Return a line for each fault of a walk that is likely not due to the weights; mostly none.

    Faults are a fall in the start-up, or a height with a steady error and motors at their limits.

    Args:
        config, robot, job: as for `walk`.
    """
    record = record_walk(config, robot, job)
    if np.asarray(record.trajectory.fallen)[0]:
        return [str(startup_fall(config, robot, job))]
    end = record.time[-1] - FALLING * record.fallen
    time = float(record.trajectory.period) * np.arange(1, len(record.trajectory.fallen) + 1)
    upright = (time > SETTLED) & (time <= end)
    torque = record.torque[record.time <= end]
    return [*_steady_height(record.trajectory, upright), *at_limit(robot, torque, MOST_AT_LIMIT)]
