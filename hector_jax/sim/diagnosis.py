"""Diagnosis of walks in MuJoCo C that go wrong: why the robot fell, and what no weights can cure.

A trajectory has the samples from t = 0 on, without torques and contacts. A walk that fell is
simulated once more with each millisecond recorded, so that a normal walk costs nothing extra.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.controller import WalkConfig
from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import SOLVED, Trajectory
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.robot.poses import rotation_of
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import World

AT_LIMIT = 0.98  # share of a limit: behind a lag that of a torque is only approached
MOST_AT_LIMIT = 0.05  # share of a walk for which a motor may be at its limit
# What lasts for more than a tenth of the last second may have caused a fall. In walks of the
# examples without one soles tilt for at most 5 % of a second, and feet slip for 9 %, the strider's
# for 23 %.
BEFORE_FALL, MOST_BEFORE_FALL = 1.0, 0.1  # [s], share
LOADED = 0.2  # share of the weight on a foot that stands; less bears it when it lands and leaves
TILTED = 0.2  # [rad] of the sole of a foot that stands; a soft floor allows a tenth of it
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
    load: Float[np.ndarray, "n feet"]  # of the floor on each foot, as a share of the weight
    friction: Float[np.ndarray, "n feet"]  # of the floor on each foot, as a share of the largest
    sole: Float[np.ndarray, "n feet"]  # tilt against the floor [rad]; zero for a point
    legs_touch: Bool[np.ndarray, " n"]
    touching: str  # parts other than feet that touch the floor at the end; empty if none do
    fallen: bool  # the last row is a fall
    trajectory: Trajectory

    @property
    def tilt(self) -> Float[np.ndarray, " n"]:
        """Larger of roll and pitch [rad], without sign."""
        return np.abs(self.angles).max(axis=1)


class Fall(NamedTuple):
    """A fall and its cause."""

    time: float  # [s] after t = 0; not above zero in the start-up
    height: float  # [m] of the centre of mass
    tilt: float  # [rad], the larger of roll and pitch
    cause: str  # the likeliest, and what to change

    def __str__(self) -> str:
        when = f"after {self.time:.2f} s"
        when = when if self.time > 0.0 else f"at {self.time:.2f} s, in the start-up"
        return (
            f"fell {when}: centre of mass {self.height:.2f} m high, tilt {self.tilt:.2f} rad; "
            f"likeliest cause: {self.cause}"
        )


class Fault(NamedTuple):
    """What may go wrong at some time of a walk."""

    text: str
    when: Bool[np.ndarray, " n"]
    remedy: str


class Recorder:
    """Notes each millisecond of a walk; `note` is called after each step of its `MujocoPlant`."""

    def __init__(self, robot: Robot, body: Robot, most: int | None = None) -> None:
        """Begin a record of the last `most` milliseconds, by default of all.

        Args:
            robot: the controller's.
            body: the plant's, see `Job.body`.
            most: number of milliseconds.
        """
        self._robot, self._feet = robot, body.description.feet
        self._limits = robot.description.limits
        self._rows: deque[tuple] = deque(maxlen=most)
        self._touching: list[str] = []

    def note(self, world: World, data: mujoco.MjData) -> None:
        """Note a millisecond; none after a fall."""
        rows = self._rows
        if rows and rows[-1][-1]:
            return  # the rest of the ten ticks in which it fell
        up = rotation_of(data.qpos[3:7])[2]  # z of the trunk's axes in the world
        roll, pitch = np.arctan2(up[1], up[2]), -np.arcsin(np.clip(up[0], -1.0, 1.0))
        height = data.qpos[2] + up @ self._robot.com_offset
        torque = data.ctrl / world.model.actuator_ctrlrange[:, 1]
        *contacts, self._touching = _contacts(world, data, len(self._feet))
        soles = [
            _tilt_of(np.array([data.geom(name).xpos for name in f.contacts])) for f in self._feet
        ]
        # false for values that are not finite
        min_height, max_tilt = self._limits
        upright = height >= min_height and max(abs(roll), abs(pitch)) <= max_tilt
        fallen = bool(self._touching) or not upright
        rows.append((height, (roll, pitch), torque, *contacts, soles, fallen))

    def record(self, trajectory: Trajectory, lead: int = 0) -> Record:
        """Return what was noted of a walk whose record begins `lead` milliseconds before t = 0."""
        columns = map(np.array, zip(*self._rows, strict=True))
        height, angles, torque, force, use, legs_touch, sole, fallen = columns
        return Record(
            time=TIME_STEP * (1 + np.arange(len(height)) - lead),
            height=height,
            angles=angles,
            torque=torque,
            load=force / float(self._robot.mass * self._robot.gravity[2]),
            friction=use,
            sole=sole,
            legs_touch=legs_touch,
            touching=", ".join(self._touching),
            fallen=bool(fallen[-1]),
            trajectory=trajectory,
        )


def record_walk(config: WalkConfig, robot: Robot, job: Job) -> Record:
    """Walk once with each millisecond recorded.

    Args:
        config, robot, job: as for `walk`.
    """
    recorder = Recorder(robot, job.body(robot))
    trajectory = walk(config, robot, job, build=partial(MujocoPlant, on_step=recorder.note))
    return recorder.record(trajectory, (job.start_tick - first_tick(config)) * substeps(config))


def _contacts(
    world: World, data: mujoco.MjData, feet: int
) -> tuple[Float[np.ndarray, " feet"], Float[np.ndarray, " feet"], bool, list[str]]:
    """Return what touches in a millisecond.

    Returns:
        Force [N] of the floor on each foot; the share of its friction in use; whether legs touch;
        names of geoms, or of their bodies, that touch the floor and are of no foot.
    """
    force, used, legs_touch, names, local = *np.zeros((2, feet)), False, set(), np.zeros(6)
    for i, contact in enumerate(data.contact):
        geom = contact.geom[contact.geom != world.floor][0]
        foot, part = world.foot_of_geom[geom], world.model.geom(geom)
        if world.floor not in contact.geom:
            legs_touch = True
        elif foot < 0:
            names.add(part.name or world.model.body(part.bodyid[0]).name)
        else:
            mujoco.mj_contactForce(world.model, data, i, local)
            force[foot] += local[0]
            used[foot] += np.abs(local[1:3]).sum() / contact.friction[0]
    return force, used / np.maximum(force, 1e-9), legs_touch, sorted(names)


def _tilt_of(points: Float[np.ndarray, "c 3"]) -> float:
    """Return the steepest slope [rad] from the lowest of the points to another; zero for one."""
    above = points - points[np.argmin(points[:, 2])]
    slopes = np.arctan2(above[:, 2], np.linalg.norm(above[:, :2], axis=1))
    return float(slopes.max())


def motors(robot: Robot, torque: Float[np.ndarray, "n joints"]) -> Iterator[Fault]:
    """Yield where each motor is at its limit; `torque` is a share of the limits."""
    remedy = "a slower trajectory, another gait, or a larger limit"
    named = zip(robot.description.joints, robot.torque_limit, torque.T, strict=True)
    for name, limit, share in named:
        text = f"the torque of {name} is at its limit of {limit:g} N m"
        yield Fault(text, np.abs(share) >= AT_LIMIT, remedy)


def _feet(robot: Robot, record: Record) -> Iterator[Fault]:
    names, loaded = robot.description.legs, record.load >= LOADED
    slower = "a slower trajectory or another gait"
    tilted, slips = loaded & (record.sole >= TILTED), loaded & (record.friction >= AT_LIMIT)
    for name, tilts, slides in zip(names, tilted.T, slips.T, strict=True):
        foot = f"the {name.replace('_', ' ')} foot"
        text = f"{foot} stands on an edge of its sole, tilted by {TILTED:g} rad or more,"
        yield Fault(text, tilts, f"{slower}; contacts of the sole in [feet]")
        text = f"{foot} slips, at the limit of the floor's friction,"
        yield Fault(text, slides, f"{slower}; a smaller friction in [mpc]")
    remedy = "a larger width in [footstep], or a slower trajectory"
    yield Fault("the legs touch each other", record.legs_touch, remedy)


def lasting(
    faults: Iterable[Fault], rows: slice | Bool[np.ndarray, " n"], most: float, span: str
) -> list[str]:
    """Return a line for each fault in a share of the rows above `most`, the longest first."""
    shares = [(np.sum(fault.when[rows]) / max(len(fault.when[rows]), 1), fault) for fault in faults]
    shares.sort(key=lambda pair: -pair[0])
    return [
        f"{text} for {100 * share:.0f} % of {span} (try {remedy})"
        for share, (text, _, remedy) in shares
        if share > most
    ]


def fall_of(config: WalkConfig, robot: Robot, job: Job) -> Fall | None:
    """Return time, pose and cause of a robot's fall; None if it does not fall.

    Args:
        config, robot, job: as for `walk`.
    """
    record = record_walk(config, robot, job)
    if not (fallen := np.asarray(record.trajectory.fallen)).any():
        return None
    finite = np.flatnonzero(np.isfinite(record.height) & np.isfinite(record.tilt))
    last = finite[-1] if len(finite) else 0
    upright = float(record.trajectory.period * np.sum(~fallen))
    return Fall(
        time=upright or min(float(record.time[-1]), 0.0),
        height=float(record.height[last]),
        tilt=float(record.tilt[last]),
        cause=likeliest_cause(robot, record),
    )


def likeliest_cause(robot: Robot, record: Record) -> str:
    """Return the likeliest cause of a fall and what to change.

    It is what lasts longest in the second before the robot is half over: motors at their limits, a
    foot on an edge or slipping, legs that touch. A plan that is not solved comes first.
    """
    if not record.fallen or not np.isfinite(record.height[-1]):
        return "the physics diverges (joint gains too large, masses or inertias too small)"
    walk = record.trajectory
    recent = np.sum(walk.fallen) + round(BEFORE_FALL / float(walk.period))
    if not (worst := np.max(walk.residual[-recent:])) <= SOLVED:
        return f"a QP of the MPC is not solved, residual {worst:.0e} (try other weights or [mpc])"
    min_height, max_tilt = robot.description.limits
    standing = float(robot.standing_height)
    over = (record.tilt > 0.5 * max_tilt) | (record.height < 0.5 * (standing + min_height))
    count = max(int(np.argmax(over)) if over.any() else len(over), 1)
    rows = slice(max(count - round(BEFORE_FALL / TIME_STEP), 0), count)
    span = f"the {TIME_STEP * (count - rows.start):.2g} s before it"
    faults = *motors(robot, record.torque), *_feet(robot, record)
    if lines := lasting(faults, rows, MOST_BEFORE_FALL, span):
        return lines[0]
    error = record.height[rows] - standing
    if _grows(error, record.tilt[rows] / max_tilt):
        motion = "sinks" if error[-1] < 0.0 else "rises"
        return (
            f"the centre of mass {motion} steadily, by {100 * abs(error[-1]):.0f} cm while still "
            "upright: the feet do not reach the floor as planned (try other kp, correct the mass)"
        )
    if record.touching and record.tilt[-1] <= max_tilt and record.height[-1] >= min_height:
        return f"{record.touching} touches the floor (try another standing pose, or larger kp)"
    roll, pitch = record.angles[-1]
    if abs(roll) > abs(pitch):
        direction = "to the right" if roll > 0.0 else "to the left"
    else:
        direction = "forwards" if pitch > 0.0 else "backwards"
    return (
        f"it tips over {direction} (try a slower trajectory, other weights, gait, kp, or another "
        "standing pose)"
    )


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


def steady_height(trajectory: Trajectory, rows: Bool[np.ndarray, " T"]) -> list[str]:
    """Return a line if the height has a steady error in some samples of a walk."""
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

    Faults are a height with a steady error, and motors at their limits.

    Args:
        config, robot, job: as for `walk`.
    """
    record = record_walk(config, robot, job)
    end = record.time[-1] - FALLING * record.fallen
    time = float(record.trajectory.period) * np.arange(1, len(record.trajectory.fallen) + 1)
    upright, late = (time > SETTLED) & (time <= end), motors(robot, record.torque)
    lines = lasting(late, record.time <= end, MOST_AT_LIMIT, "the time")
    return [*steady_height(record.trajectory, upright), *lines]
