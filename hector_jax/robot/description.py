"""What is said of a robot beside its MJCF: names, limits, gait and weights, in a short TOML.

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

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import jax

from hector_jax.core.inputs import InputError, did_you_mean, short_repr
from hector_jax.core.settings import POSITIVE, read_toml, validation_error
from hector_jax.core.trajectory import MAX_TILT, MIN_HEIGHT

_PACKAGE = Path(__file__).parents[1]
_INSTALLED = _PACKAGE / "assets"  # where a wheel puts them
_ASSETS = _INSTALLED if _INSTALLED.exists() else _PACKAGE.parent / "assets"
MODEL_PATH = _ASSETS / "hector.xml"
DESCRIPTION_PATH = _ASSETS / "hector.toml"

SIDES = ("left", "right")
LEG_JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
HECTOR_AXES = "zxyyy"
CONTROL = ("gait", "mpc", "footstep", "legs")  # sections that the controller reads
DIAGONALS = ("euler", "position", "ang_velocity", "velocity", "force", "moment")

_TOP = ("name", "model", "standing", "joints", "feet", "limits", *CONTROL, "weights")
_MAX_BYTES = 100_000

Triple = tuple[float, float, float]


def _both(ending: str) -> tuple[str, str]:
    return f"left_{ending}", f"right_{ending}"


@jax.tree_util.register_static
@dataclass(frozen=True)
class Description:
    """What a robot's TOML says; the defaults are the names and limits of HECTOR."""

    model: Path = MODEL_PATH  # the MJCF
    path: Path = DESCRIPTION_PATH  # where this was read
    name: str = "hector"
    standing: str = "standing"  # keyframe
    joints: tuple[str, ...] = tuple(f"{side}_{joint}" for side in SIDES for joint in LEG_JOINTS)
    axes: str = HECTOR_AXES  # of each leg's joints, from the trunk down
    foot_points: tuple[str, str] = _both("foot_point")  # sites
    toes: tuple[str, str] = _both("toe")  # geoms
    heels: tuple[str, str] = _both("heel")  # geoms
    min_height: float = MIN_HEIGHT  # [m] of the centre of mass; below it the robot has fallen
    max_tilt: float = MAX_TILT  # [rad] of roll or pitch; beyond it too
    control: tuple[tuple[str, tuple[tuple[str, Any], ...]], ...] = ()  # sections as they came
    nominal: tuple[Triple, ...] | None = None  # in the order of DIAGONALS; None: as HECTOR's
    expert: tuple[Triple, ...] | None = None  # likewise

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


def read_description(path: Path) -> Description:
    """The description in a TOML file, as this module's docstring has it.

    What the sections of the controller may hold is known there: see `walking.walk_config`.

    Raises:
        InputError: one line naming file, key, what came and what was expected.
    """
    path = Path(path)
    told = read_toml(path, "the robot description", _MAX_BYTES)
    _known(path, told, _TOP, "")
    model = _text(path, told, "model", "", MODEL_PATH.name)
    if Path(model).name != model:
        raise _wrong(path, "model", model, "the name of a file beside it")
    joints, feet = _table(path, told, "joints"), _table(path, told, "feet")
    _known(path, joints, (*SIDES, "axes"), "joints.")
    axes = _text(path, joints, "axes", "joints.", HECTOR_AXES)
    if sorted(axes) != sorted(HECTOR_AXES):
        raise InputError(
            f"{path}: joints.axes is {short_repr(axes)}, expected {HECTOR_AXES!r} in the "
            "order of the leg"
        )
    limits, weights = _table(path, told, "limits"), _table(path, told, "weights")
    _known(path, weights, ("nominal", "expert"), "weights.")
    _known(path, limits, ("min_height", "max_tilt"), "limits.")
    return Description(
        model=path.parent / model,
        path=path,
        name=_name(path, told),
        standing=_text(path, told, "standing", "", Description.standing),
        joints=_joints(path, joints),
        axes=axes,
        **_feet(path, feet),
        min_height=_limit(path, limits, "min_height", MIN_HEIGHT),
        max_tilt=_limit(path, limits, "max_tilt", MAX_TILT),
        control=tuple(
            (name, tuple((key, _frozen(x)) for key, x in _table(path, told, name).items()))
            for name in CONTROL
            if name in told
        ),
        nominal=_diagonals(path, weights, "nominal"),
        expert=_diagonals(path, weights, "expert"),
    )


def as_table(description: Description) -> dict[str, Any]:
    """A description as JSON values; `from_card` reads them."""
    plain = lambda x: str(x) if isinstance(x, Path) else x  # noqa: E731
    return {name: plain(value) for name, value in asdict(description).items()}


def from_card(table: Mapping[str, Any]) -> Description:
    """The description that `as_table` told; what is not told is HECTOR's.

    Raises:
        TypeError: the table holds something else.
    """
    paths = {field.name for field in fields(Description) if field.type is Path}
    return Description(
        **{name: Path(x) if name in paths else _frozen(x) for name, x in table.items()}
    )


def _known(path: Path, table: Mapping[str, Any], names: tuple[str, ...], prefix: str) -> None:
    for key in table:
        if key not in names:
            raise InputError(
                f"{path}: unknown key {short_repr(prefix + key)}{did_you_mean(key, names)}; "
                f"known: {', '.join(names)}"
            )


def _wrong(path: Path, name: str, got: Any, expected: str) -> InputError:
    return InputError(f"{path}: {name} is {short_repr(got)}, expected {expected}")


def _table(path: Path, told: Mapping[str, Any], name: str) -> dict[str, Any]:
    table = told.get(name, {})
    if not isinstance(table, dict):
        raise _wrong(path, name, table, "a table")
    return table


def _text(path: Path, table: Mapping[str, Any], key: str, prefix: str, default: str) -> str:
    text = table.get(key, default)
    if not isinstance(text, str) or not text:
        raise _wrong(path, prefix + key, text, "a name")
    return text


def _name(path: Path, told: Mapping[str, Any]) -> str:
    name = _text(path, told, "name", "", path.stem)
    if not name.replace("-", "").replace("_", "").isalnum():
        raise _wrong(path, "name", name, "letters, digits, - and _ (it names a folder)")
    return name


def _joints(path: Path, table: Mapping[str, Any]) -> tuple[str, ...]:
    names: list[str] = []
    for side, default in zip(SIDES, (Description.joints[:5], Description.joints[5:]), strict=True):
        leg = table.get(side, list(default))
        if not isinstance(leg, list) or len(leg) != 5 or not all(isinstance(x, str) for x in leg):
            raise _wrong(path, f"joints.{side}", leg, "five names of joints")
        names += leg
    if len(set(names)) < len(names):
        raise _wrong(path, "joints", names, "ten different names")
    return tuple(names)


def _feet(path: Path, feet: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    _known(path, feet, SIDES, "feet.")
    fields = {"point": "foot_points", "toe": "toes", "heel": "heels"}
    tables = {side: _table(path, feet, side) for side in SIDES}
    for side, table in tables.items():
        _known(path, table, tuple(fields), f"feet.{side}.")

    def both(key: str, field: str) -> tuple[str, str]:
        left, right = (
            _text(path, table, key, f"feet.{side}.", default)
            for (side, table), default in zip(
                tables.items(), getattr(Description, field), strict=True
            )
        )
        return left, right

    return {field: both(key, field) for key, field in fields.items()}


def _positive(value: Any) -> bool:
    return validation_error(value, float, POSITIVE) is None


def _limit(path: Path, table: Mapping[str, Any], key: str, default: float) -> float:
    value = table.get(key, default)
    if not _positive(value):
        raise _wrong(path, f"limits.{key}", value, "a positive number")
    return float(value)


def _diagonals(path: Path, weights: Mapping[str, Any], name: str) -> tuple[Triple, ...] | None:
    if name not in weights:
        return None
    table = _table(path, weights, name)
    _known(path, table, DIAGONALS, f"weights.{name}.")
    rows = []
    for key in DIAGONALS:
        given = table.get(key)
        row = given if isinstance(given, list) else [given] * 3
        if len(row) != 3 or not all(map(_positive, row)):
            raise _wrong(path, f"weights.{name}.{key}", given, "a positive number, or three")
        x, y, z = map(float, row)
        rows.append((x, y, z))
    return tuple(rows)


def _frozen(value: Any) -> Any:
    """The value as one that can be hashed, which what is static has to be."""
    if isinstance(value, dict):
        value = list(value.items())
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value
