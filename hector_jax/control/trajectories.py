"""User-defined trajectories: a command from a TOML file, and a check that the robot can walk it.

    name = "slalom"        # letters, digits, - and _; names the folder of the results

    [[segment]]            # executed in order, then repeated from the first
    seconds = 1.0          # a multiple of 0.05 s
    v_x = 0.4              # [m/s] forward
    v_y = 0.0              # [m/s] to the left
    yaw_rate = 0.8         # [rad/s] to the left

A missing velocity of a segment is zero. Walks, tunings and verdicts of such a command last for the
sum of its segments. Speeds beyond any biped of this size are an error; speeds beyond this robot
cause a warning and are walked nevertheless.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import COMMANDS, UNSEEN, Command, named_command
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import Range, check, from_table, read_toml
from hector_jax.robot.kinematics import knee_joints
from hector_jax.robot.model import Robot

_MOST_SECONDS = 600.0
_GRID = 0.05  # [s]
_SPEED = Range(-10.0, 10.0)  # [m/s], [rad/s]; larger values are in another unit


class NamedCommand(NamedTuple):
    """A command with its name."""

    name: str
    command: Command
    seconds: float | None = None  # its duration, if read from a file


@dataclass(frozen=True)
class Segment:
    """A segment of constant velocity in the robot's frame."""

    seconds: Annotated[float, Range(_GRID, _MOST_SECONDS)]
    v_x: Annotated[float, _SPEED] = 0.0  # [m/s] forward
    v_y: Annotated[float, _SPEED] = 0.0  # [m/s] to the left
    yaw_rate: Annotated[float, _SPEED] = 0.0  # [rad/s]

    def __post_init__(self) -> None:
        check(self)
        if abs(self.seconds / _GRID - round(self.seconds / _GRID)) > 1e-6:
            raise InputError(
                f"Segment.seconds must be a multiple of {_GRID} s, got {short_repr(self.seconds)}"
            )


@dataclass(frozen=True)
class _File:
    name: str
    segment: tuple

    def __post_init__(self) -> None:
        check(self)
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}", self.name):
            raise InputError(
                "name must be 1 to 40 letters, digits, - or _, the first neither - nor _, "
                f"got {short_repr(self.name)}"
            )
        if self.name in (*COMMANDS, *UNSEEN, "all"):
            raise InputError(f"name must not be that of a built-in trajectory, got {self.name!r}")
        if not self.segment:
            raise InputError("[[segment]] must be given at least once")


def load_command(path: Path) -> NamedCommand:
    """Read the command of a TOML file, see the module docstring.

    Raises:
        InputError: one line naming the file and the field that is unknown, missing or out of range.
    """
    path = Path(path)
    file = from_table(str(path), _File, read_toml(path, "a trajectory"))
    segments = [
        from_table(f"{path}: segment {number}", Segment, table)
        for number, table in enumerate(file.segment, 1)
    ]
    seconds = sum(segment.seconds for segment in segments)
    if seconds > _MOST_SECONDS:
        raise InputError(
            f"{path}: the segments must last at most {_MOST_SECONDS:g} s together, got {seconds:g}"
        )
    command = Command(
        duration=np.array([segment.seconds for segment in segments]),
        velocity=np.array([(segment.v_x, segment.v_y) for segment in segments]),
        yaw_rate=np.array([segment.yaw_rate for segment in segments]),
    )
    return NamedCommand(file.name, command, round(seconds / _GRID) * _GRID)


def command_of(text: str) -> NamedCommand:
    """Return a trajectory by its name, or from the TOML file at that path.

    Raises:
        InputError: the name is unknown, or see `load_command`.
    """
    if text.endswith(".toml"):
        return load_command(Path(text))
    try:
        return NamedCommand(text, named_command(text))
    except InputError as error:
        raise InputError(f"{error}, or a file NAME.toml") from None


class Limits(NamedTuple):
    """Largest speeds at which a robot can be expected to walk."""

    ahead: float  # [m/s]
    back: float  # [m/s]
    aside: float  # [m/s]
    turn: float  # [rad/s]


def limits(robot: Robot, gait: GaitConfig) -> Limits:
    """Estimate the speeds at which a robot can walk, from its legs and the duration of a stance.

    A rule of thumb: during a stance the body moves by half of the leg's reach at standing height;
    the other half remains for balance. Sideways the hip's roll limits the reach, backwards the
    foot's shorter lever behind the foot point, in a turn the hip's yaw, or without such a joint the
    way that the feet go sideways. A leg without an ankle ends at its foot point. For HECTOR in
    MuJoCo (`hfs`, expert weights, 6 s from standing) the estimate is 1.55, 1.04, 1.20 m/s and
    3.5 rad/s; it walked at 1.6, 1.0, 1.2 m/s and 4 rad/s, and fell at 1.8, 1.2, 1.5 m/s and
    5 rad/s.
    """
    hip, knee, ankle = knee_joints(robot)
    axis, foot = robot.joint_axis[0], np.asarray(robot.foot_point[0])
    hip_yaw, hip_roll = (np.argmax(np.abs(axis[:, direction])) for direction in (2, 0))

    def length(offset: np.ndarray) -> float:
        """Return the length [m] of an offset in the knee's plane, the leg straight at zero."""
        return float(np.linalg.norm(offset - (offset @ axis[knee]) * axis[knee]))

    origin = np.asarray(robot.joint_origin[0])
    thigh = length(origin[hip + 1 : knee + 1].sum(axis=0))
    shin = length(origin[knee + 1 : ankle + 1].sum(axis=0) if ankle > knee else foot)

    def leg_length(bend: float) -> float:
        return np.sqrt(thigh**2 + shin**2 + 2 * thigh * shin * np.cos(bend))

    def smallest_limit(joint: Any) -> float:
        low, high = robot.joint_lower[joint], robot.joint_upper[joint]
        return 0.0 if low <= 0.0 <= high and joint == knee else np.min(np.abs([low, high]))

    standing_length = leg_length(robot.standing_joints[knee])
    reach = np.sqrt(max(leg_length(smallest_limit(knee)) ** 2 - standing_length**2, 0.0))
    height = standing_length + (abs(foot[2]) if ankle > knee else 0.0)
    sideways = min(reach, height * np.tan(smallest_limit(hip_roll)))
    has_yaw = np.abs(axis[hip_yaw, 2]) > 0.5
    radius = max(np.linalg.norm(origin[0, :2]), 1e-9)  # [m] of the hips about the trunk's origin
    turn = smallest_limit(hip_yaw) if has_yaw else sideways / radius
    stance = gait.stance * gait.tick
    back = min(robot.heel / robot.toe, 1.0) if robot.toe > 0.0 else 1.0
    return Limits(
        ahead=float(reach / stance),
        back=float(reach / stance * back),
        aside=float(sideways / stance),
        turn=float(turn / stance),
    )


def beyond(limits: Limits, command: Command) -> str | None:
    """Return a one-line warning if a command exceeds the limits of a robot, else None.

    A change of velocity between segments has the limits of a start from standing.
    """
    ahead, aside = np.asarray(command.velocity).T
    limits_by_name = {
        "v_x": (ahead, -limits.back, limits.ahead, "m/s"),
        "v_y": (aside, -limits.aside, limits.aside, "m/s"),
        "yaw_rate": (np.asarray(command.yaw_rate), -limits.turn, limits.turn, "rad/s"),
    }
    for name, (values, low, high, unit) in limits_by_name.items():
        changes = np.diff(values, prepend=0.0)
        for number, (value, change) in enumerate(zip(values, changes, strict=True), 1):
            for what, size in ((name, value), (f"the change of {name}", change)):
                if not low <= size <= high:
                    return (
                        f"segment {number}: {what} is {size:g} {unit}; this robot and gait can be "
                        f"expected to walk {low:.2g} to {high:.2g} {unit}"
                    )
    return None
