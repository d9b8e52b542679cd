"""The TOML file with names, limits, gait and weights that accompanies a robot's model.

    name = "strider"                   # its walks and net are stored under this name
    model = "strider.xml"              # MJCF in the standard form (`checks`), beside this file
    standing = "standing"              # keyframe of the standing pose
    [joints]                           # of each leg, from the trunk down
    left, right = three to seven names each; of four legs: front_left, front_right, hind_left, ..
    linkage = [5, 4]                   # the fifth joint's motor also turns the fourth; optional
    [feet]                             # by leg: names of a site on the sole and of spheres
    left, right = { point = site, toe = sphere, heel = sphere }
    left, right = { point = site, contacts = [sphere, ...] }                 # 1, 2 or 4 contacts
    [limits]
    min_height, max_tilt               # [m] of the centre of mass, [rad]: beyond them it has fallen
    [gait] [mpc] [slip] [footstep] [legs] [twin]  # fields of GaitConfig, MpcConfig and so on
    [weights]                          # each an x, y, z triple or a single number
    nominal, expert = { euler, position, ang_velocity, velocity, force, moment }
    [loss]                             # weights of the loss terms: L_Eul, L_pos, L_ctrl
    [tuning] [plants]                  # fields of TuningSettings, PlantSizes
    [numbers.NAME]                     # of a user's controller: fields of Number

The model must be named; all other defaults are those of assets/hector.toml, but without [slip] the
controller does not react to slips. Masses, lengths, joint and torque limits come from the model; a
description is a static field of its `Robot` under jit. Published robots have more keys
(`importing.draft`), with which `hector robot` brings them into this form.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax

from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, check, from_table, read_toml
from hector_jax.core.trajectory import FEET, MAX_TILT, MIN_HEIGHT
from hector_jax.robot.numbers import Number

_PACKAGE = Path(__file__).parents[1]
_INSTALLED = _PACKAGE / "assets"  # the folder in a wheel
_ASSETS = _INSTALLED if _INSTALLED.exists() else _PACKAGE.parent / "assets"
MODEL_PATH = _ASSETS / "hector.xml"
DESCRIPTION_PATH = _ASSETS / "hector.toml"

FEWEST_JOINTS, MOST_JOINTS = 3, 7  # of a leg
CONTROL = ("gait", "mpc", "slip", "footstep", "legs", "twin")  # sections that the controller reads

MAX_BYTES = 100_000

Triple = tuple[float, float, float]


class Foot(NamedTuple):
    """A foot by names in the model."""

    point: str  # site where wrenches act
    contacts: tuple[str, ...]  # spheres


_Factor = Annotated[float, NOT_NEGATIVE]


@dataclass(frozen=True)
class PlantSizes:
    """Sizes of the imperfections of this robot's plants, as multiples of HECTOR's."""

    joint_friction: _Factor = 1.0
    joint_damping: _Factor = 1.0
    push: _Factor = 1.0  # external forces
    trunk_com: _Factor = 1.0  # lengths: shift of the trunk's centre of mass, payload position
    payload: _Factor = 1.0  # masses

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class TuningSettings:
    """Tuning settings of this robot; the defaults are HECTOR's."""

    lead: Annotated[int, NOT_NEGATIVE] = 0  # gait ticks of stepping in place before the command
    touchdown_error: bool = False  # the net learns the distance from planned to actual touchdown
    estimate_noise: Annotated[float, NOT_NEGATIVE] = 0.0  # factor on that of a real robot's sensors
    delay: Annotated[float, NOT_NEGATIVE] = 0.0  # [s] of the ground's reaction, at most a tick

    def __post_init__(self) -> None:
        check(self)


@jax.tree_util.register_static
@dataclass(frozen=True)
class Description:
    """The content of a robot's TOML."""

    model: Path  # MJCF
    path: Path  # of the TOML
    name: str
    standing: str  # keyframe
    joints: tuple[str, ...]  # leg by leg
    linkage: tuple[int, int] | None  # motor, and joint it also turns; counted from 1
    feet: tuple[Foot, ...]  # in the order of FEET
    min_height: float = MIN_HEIGHT  # [m] of the centre of mass; below it the robot has fallen
    max_tilt: float = MAX_TILT  # [rad] of roll or pitch; beyond it the robot has fallen
    control: tuple[tuple[str, tuple[tuple[str, Any], ...]], ...] = ()  # unchecked sections
    nominal: tuple[Triple, ...] | None = None  # in the order of _Diagonals; None: HECTOR's
    expert: tuple[Triple, ...] | None = None  # in the order of _Diagonals; None: HECTOR's
    loss: tuple[tuple[str, float], ...] = ()  # alphas by term; missing ones are the paper's
    plants: PlantSizes = PlantSizes()
    tuning: TuningSettings = TuningSettings()
    numbers: tuple[tuple[str, Number], ...] = ()  # of a user's controller, by name

    def __post_init__(self) -> None:
        object.__setattr__(self, "control", _as_tuples(self.control))

    @property
    def limits(self) -> tuple[float, float]:
        """Minimum height [m] and maximum tilt [rad] of a robot that has not fallen."""
        return self.min_height, self.max_tilt

    @property
    def legs(self) -> tuple[str, ...]:
        """Names of the legs."""
        return FEET[len(self.feet)]

    @property
    def leg_joints(self) -> int:
        """Number of joints of a leg."""
        return len(self.joints) // len(self.feet)


@dataclass(frozen=True)
class Joints:
    """The section [joints] of a file."""

    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()
    front_left: tuple[str, ...] = ()
    front_right: tuple[str, ...] = ()
    hind_left: tuple[str, ...] = ()
    hind_right: tuple[str, ...] = ()
    linkage: tuple[int, int] | None = None

    @property
    def legs(self) -> dict[str, tuple[str, ...]]:
        """Joints by leg, in the order of FEET."""
        legs = sum(FEET.values(), ())
        return {leg: joints for leg in legs if (joints := getattr(self, leg))}

    def __post_init__(self) -> None:
        if tuple(self.legs) not in FEET.values():
            expected = "; or ".join(map(", ".join, FEET.values()))
            raise InputError(f"must have {expected}, got {', '.join(self.legs) or 'none of them'}")
        names = sum(self.legs.values(), ())
        counts = [len(joints) for joints in self.legs.values()]
        count = counts[0]
        if not FEWEST_JOINTS <= count <= MOST_JOINTS or set(counts) != {count}:
            *first, last = map(str, counts)
            text = f"{' and '.join(self.legs)} must be {FEWEST_JOINTS} to {MOST_JOINTS} names each "
            text += f"and as many in {'both' if len(counts) == 2 else 'all'}, got "
            raise InputError(f"{text}{', '.join(first)} and {last}")
        if len(set(names)) < len(names):
            duplicate = next(name for name in names if names.count(name) > 1)
            raise InputError(f"must be different names, got {short_repr(duplicate)} twice")
        if self.linkage and (
            not all(1 <= i <= count for i in self.linkage) or len(set(self.linkage)) < 2
        ):
            text = f"linkage must be two joints of a leg, counted from 1 to {count}"
            raise InputError(f"{text}, got {list(self.linkage)}")


@dataclass(frozen=True)
class NamedFoot:
    """A foot in the section [feet]."""

    point: str
    contacts: tuple[str, ...] = ()
    toe: str | None = None
    heel: str | None = None

    @property
    def places(self) -> tuple[str, ...]:
        """Its contacts, of which toe and heel are two."""
        return self.contacts or tuple(x for x in (self.toe, self.heel) if x is not None)

    def __post_init__(self) -> None:
        both = self.contacts and (self.toe is not None or self.heel is not None)
        if both or len(self.places) not in (1, 2, 4):
            raise InputError(
                "must be names: point (a site) and toe and heel (spheres), or point and 1, 2 or 4 "
                "contacts (spheres)"
            )


@dataclass(frozen=True)
class Names:
    """The part of a file that names what its model has."""

    joints: Joints
    feet: dict[str, NamedFoot]
    standing: str

    @property
    def all_joints(self) -> tuple[str, ...]:
        """Joints, leg by leg."""
        return sum(self.joints.legs.values(), ())

    def __post_init__(self) -> None:
        legs = self.joints.legs
        if {*self.feet} != {*legs}:
            text = f"joints has the legs {', '.join(legs)}, expected them in feet"
            raise InputError(f"{text}, got {', '.join(self.feet)}")
        counts = [len(self.feet[leg].places) for leg in legs]
        if len(set(counts)) > 1:
            raise InputError(f"{' and '.join(legs)} must have as many contacts, got {counts}")


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
        """Return three numbers per field."""
        return tuple(x if isinstance(x, tuple) else (x, x, x) for x in vars(self).values())


@dataclass(frozen=True)
class _Weights:
    nominal: _Diagonals | None = None
    expert: _Diagonals | None = None


@dataclass(frozen=True)
class _File:
    name: str | None = None
    model: str = ""
    limits: _Limits = _Limits()
    gait: dict | None = None
    mpc: dict | None = None
    slip: dict | None = None
    footstep: dict | None = None
    legs: dict | None = None
    twin: dict | None = None
    weights: _Weights = _Weights()
    loss: dict[str, float] | None = None
    tuning: TuningSettings = TuningSettings()
    plants: PlantSizes = PlantSizes()
    numbers: dict[str, Number] = field(default_factory=dict)


def model_name(path: Path, table: dict[str, Any]) -> str:
    """Return the name of the model in the table of a TOML file.

    Raises:
        InputError: it is missing, or not in the folder of the TOML file.
    """
    name = table.get("model")
    if not isinstance(name, str) or not name:
        raise InputError(f"{path}: model is missing: the name of an MJCF or URDF beside this file")
    if Path(name).name != name:
        text = f"model must name a file beside it, got {short_repr(name)}"
        raise InputError(f"{path}: {text}")
    return name


_TABLE = read_toml(DESCRIPTION_PATH, "the robot description", MAX_BYTES)
HECTOR_NAMES = {key: _TABLE[key] for key in ("joints", "feet", "standing")}
HECTOR_NAMES["joints"] = {
    leg: _TABLE["joints"][leg] for leg in FEET[2]
}  # a linkage is HECTOR's own
"""The part of HECTOR's table that a robot with its names may leave out."""


def read_description(path: Path) -> Description:
    """Read a description from a TOML file in the format of the module's docstring.

    The fields of the controller's sections are checked by `controller.walk_config`, the terms of
    the loss by `loss.loss_of_robot`.

    Raises:
        InputError: one line naming the file, the key, the value received and the expected one.
    """
    path = Path(path)
    return description_of(path, read_toml(path, "the robot description", MAX_BYTES))


def description_of(path: Path, table: dict[str, Any]) -> Description:
    """Return the description that a TOML file at a path would give with this content.

    Raises:
        InputError: as `read_description`.
    """
    names = HECTOR_NAMES | {key: table[key] for key in HECTOR_NAMES if key in table}
    try:
        named = from_table(str(path), Names, names)
    except InputError as error:
        raise InputError(f"{error}; {convert_by(path)}") from None
    others = {key: x for key, x in table.items() if key not in names}
    file = from_table(str(path), _File, others)
    name = path.stem if file.name is None else file.name
    if not name.replace("-", "").replace("_", "").isalnum():
        text = "name must be letters, digits, - and _ (it names a folder)"
        raise InputError(f"{path}: {text}, got {short_repr(name)}")
    if odd := [name for name in file.numbers if not name.isidentifier()]:
        text = "the name of a number must be letters, digits and _"
        raise InputError(f"{path}: numbers: {text}, got {short_repr(odd[0])}")
    sections = {name: getattr(file, name) for name in CONTROL}
    return Description(
        model=path.parent / model_name(path, table),
        path=path,
        name=name,
        standing=named.standing,
        joints=named.all_joints,
        linkage=named.joints.linkage,
        feet=tuple(Foot(x.point, x.places) for x in (named.feet[leg] for leg in named.joints.legs)),
        **vars(file.limits),
        control=_as_tuples({name: x for name, x in sections.items() if x is not None}),
        nominal=file.weights.nominal and file.weights.nominal.rows(),
        expert=file.weights.expert and file.weights.expert.rows(),
        loss=_as_tuples(file.loss or {}),
        tuning=file.tuning,
        plants=file.plants,
        numbers=tuple(file.numbers.items()),
    )


def convert_by(path: Path) -> str:
    """Return the words that name the command which brings a file into the standard form."""
    return f"a robot as published is converted once, by hector robot {path} --out FOLDER"


def _as_tuples(value: Any) -> Any:
    """Return the value with tuples for lists and dicts, hashable as static arguments must be."""
    if isinstance(value, dict):
        value = list(value.items())
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


HECTOR = description_of(DESCRIPTION_PATH, _TABLE)
"""The default robot, whose plants are drawn if no description is passed."""
