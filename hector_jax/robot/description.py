"""The names, limits, gait and weights of a robot beside its MJCF, in a short TOML.

    name = "strider"                   # its walks and net are kept under this name
    model = "strider.xml"              # the MJCF, beside this file
    standing = "standing"              # keyframe of the standing pose
    [joints]                           # of each leg, from the trunk down
    left, right = five names each; axes = "zxyyy": z yaw, x roll, y pitch, in the order of the leg
    [feet]
    left, right = { point = site on the sole under the ankle, toe = geom, heel = geom }
    [limits]
    min_height, max_tilt               # [m] of the centre of mass, [rad]: beyond, it has fallen
    [gait] [mpc] [footstep] [legs]     # fields of GaitConfig, MpcConfig, FootstepConfig, LegConfig
    [weights]
    nominal, expert = { euler, position, ang_velocity, velocity, force, moment }   # x, y, z or one

What is left out is as in assets/hector.toml. Masses, lengths, joint and torque limits are the
MJCF's; a description rides on its `Robot` and is static under jit.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import jax

from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import POSITIVE, from_table, read_toml
from hector_jax.core.trajectory import MAX_TILT, MIN_HEIGHT

_PACKAGE = Path(__file__).parents[1]
_INSTALLED = _PACKAGE / "assets"  # where a wheel puts them
_ASSETS = _INSTALLED if _INSTALLED.exists() else _PACKAGE.parent / "assets"
MODEL_PATH = _ASSETS / "hector.xml"
DESCRIPTION_PATH = _ASSETS / "hector.toml"

LEG_JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
HECTOR_AXES = "zxyyy"
CONTROL = ("gait", "mpc", "footstep", "legs")  # sections that the controller reads

_MAX_BYTES = 100_000

Triple = tuple[float, float, float]


def _leg(side: str) -> tuple[str, str, str, str, str]:
    yaw, roll, pitch, knee, ankle = (f"{side}_{joint}" for joint in LEG_JOINTS)
    return yaw, roll, pitch, knee, ankle


def _both(ending: str) -> tuple[str, str]:
    return f"left_{ending}", f"right_{ending}"


@jax.tree_util.register_static
@dataclass(frozen=True)
class Description:
    """A robot's TOML; the defaults are the names and limits of HECTOR."""

    model: Path = MODEL_PATH  # the MJCF
    path: Path = DESCRIPTION_PATH  # where this was read
    name: str = "hector"
    standing: str = "standing"  # keyframe
    joints: tuple[str, ...] = _leg("left") + _leg("right")
    axes: str = HECTOR_AXES  # of each leg's joints, from the trunk down
    foot_points: tuple[str, str] = _both("foot_point")  # sites
    toes: tuple[str, str] = _both("toe")  # geoms
    heels: tuple[str, str] = _both("heel")  # geoms
    min_height: float = MIN_HEIGHT  # [m] of the centre of mass; below it the robot has fallen
    max_tilt: float = MAX_TILT  # [rad] of roll or pitch; beyond it too
    control: tuple[tuple[str, tuple[tuple[str, Any], ...]], ...] = ()  # sections as they came
    nominal: tuple[Triple, ...] | None = None  # in the order of _Diagonals; None: as HECTOR's
    expert: tuple[Triple, ...] | None = None  # likewise

    def __post_init__(self) -> None:
        object.__setattr__(self, "control", _frozen(self.control))

    @property
    def limits(self) -> tuple[float, float]:
        """Least height [m] and largest tilt [rad] of a robot that has not fallen."""
        return self.min_height, self.max_tilt

    @property
    def yaw_joint(self) -> int:
        """Which joint of a leg turns it about the vertical."""
        return self.axes.index("z")

    @property
    def roll_joint(self) -> int:
        """Which joint of a leg turns it about the way ahead."""
        return self.axes.index("x")

    @property
    def pitch_joints(self) -> tuple[int, int, int]:
        """Which joints of a leg are hip pitch, knee and ankle."""
        hip, knee, ankle = (i for i, axis in enumerate(self.axes) if axis == "y")
        return hip, knee, ankle


@dataclass(frozen=True)
class _Joints:
    left: tuple[str, str, str, str, str] = _leg("left")
    right: tuple[str, str, str, str, str] = _leg("right")
    axes: str = HECTOR_AXES

    def __post_init__(self) -> None:
        names = self.left + self.right
        if len(set(names)) < len(names):
            raise InputError(f"must be ten different names, got {short_repr(names)}")
        if sorted(self.axes) != sorted(HECTOR_AXES):
            raise InputError(
                f"axes must be {HECTOR_AXES!r} in the order of the leg, got {short_repr(self.axes)}"
            )


@dataclass(frozen=True)
class _Left:
    point: str = Description.foot_points[0]
    toe: str = Description.toes[0]
    heel: str = Description.heels[0]


@dataclass(frozen=True)
class _Right:
    point: str = Description.foot_points[1]
    toe: str = Description.toes[1]
    heel: str = Description.heels[1]


@dataclass(frozen=True)
class _Feet:
    left: _Left = _Left()
    right: _Right = _Right()


@dataclass(frozen=True)
class _Limits:
    min_height: Annotated[float, POSITIVE] = MIN_HEIGHT
    max_tilt: Annotated[float, POSITIVE] = MAX_TILT


_Diagonal = Annotated[float | Triple, POSITIVE]


@dataclass(frozen=True)
class _Diagonals:
    euler: _Diagonal
    position: _Diagonal
    ang_velocity: _Diagonal
    velocity: _Diagonal
    force: _Diagonal
    moment: _Diagonal

    def rows(self) -> tuple[Triple, ...]:
        """Three numbers each."""
        values = (getattr(self, one.name) for one in fields(self))
        return tuple(x if isinstance(x, tuple) else (x, x, x) for x in values)


@dataclass(frozen=True)
class _Weights:
    nominal: _Diagonals | None = None
    expert: _Diagonals | None = None


@dataclass(frozen=True)
class _File:
    name: str | None = None
    model: str = MODEL_PATH.name
    standing: str = Description.standing
    joints: _Joints = _Joints()
    feet: _Feet = _Feet()
    limits: _Limits = _Limits()
    gait: dict | None = None
    mpc: dict | None = None
    footstep: dict | None = None
    legs: dict | None = None
    weights: _Weights = _Weights()

    def __post_init__(self) -> None:
        if Path(self.model).name != self.model:
            raise InputError(
                f"model must be the name of a file beside it, got {short_repr(self.model)}"
            )


def read_description(path: Path) -> Description:
    """The description in a TOML file, see the module.

    The fields of the controller's sections are checked by `walking.walk_config`.

    Raises:
        InputError: one line naming file, key, what came and what was expected.
    """
    path = Path(path)
    file = from_table(str(path), _File, read_toml(path, "the robot description", _MAX_BYTES))
    name = path.stem if file.name is None else file.name
    if not name.replace("-", "").replace("_", "").isalnum():
        raise InputError(
            f"{path}: name must be letters, digits, - and _ (it names a folder), "
            f"got {short_repr(name)}"
        )
    left, right, weights = file.feet.left, file.feet.right, file.weights
    return Description(
        model=path.parent / file.model,
        path=path,
        name=name,
        standing=file.standing,
        joints=file.joints.left + file.joints.right,
        axes=file.joints.axes,
        foot_points=(left.point, right.point),
        toes=(left.toe, right.toe),
        heels=(left.heel, right.heel),
        min_height=file.limits.min_height,
        max_tilt=file.limits.max_tilt,
        control=tuple(
            (part, tuple(section.items()))
            for part in CONTROL
            if (section := getattr(file, part)) is not None
        ),
        nominal=weights.nominal and weights.nominal.rows(),
        expert=weights.expert and weights.expert.rows(),
    )


def _frozen(value: Any) -> Any:
    """The value as one that can be hashed, as static arguments have to be."""
    if isinstance(value, dict):
        value = list(value.items())
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value
