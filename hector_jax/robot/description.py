"""The TOML file with names, limits, gait and weights that accompanies a robot's model.

    name = "strider"                   # its walks and net are stored under this name
    model = "strider.xml"              # MJCF or URDF, beside this file
    standing = "home"                  # keyframe of the standing pose, or angles: { knee = 0.5 }
    [joints]                           # of each leg, from the trunk down
    left, right = three to seven names each; of four legs: front_left, front_right, hind_left, ..
    linkage = [5, 4]                   # the fifth joint's motor also turns the fourth; optional
    weld = ["waist"]                   # hinges that are fixed in the standing pose
    armature = one number per joint    # [kg m^2] of a leg's motors, which a URDF cannot state
    range, torque = [lower, upper] and a number per joint  # [rad], [N m] where the model has none
    [feet]                             # per leg: names in the model, or points in a body's frame
    left, right = { point = site on the sole, toe = geom, heel = geom }
    left, right = { point = site, contacts = [geom, ...] }                   # 1, 2 or 4 contacts
    left, right = { body, contacts = [[x, y, z], ...], point = [x, y, z] }   # as many
    [limits]
    min_height, max_tilt               # [m] of the centre of mass, [rad]: beyond them it has fallen
    [gait] [mpc] [slip] [footstep] [legs] [twin]  # fields of GaitConfig, MpcConfig and so on
    [weights]                          # each an x, y, z triple or a single number
    nominal, expert = { euler, position, ang_velocity, velocity, force, moment }
    [loss]                             # weights of the loss terms: L_Eul, L_pos, L_ctrl
    [tuning] [plants]                  # fields of TuningSettings, PlantSizes
    [numbers.NAME]                     # of a user's controller: fields of Number

The model must be named; all other defaults are those of assets/hector.toml,
but without [slip] the controller does not react to slips. Masses, lengths, joint
and torque limits come from the model; a description is a static field of its `Robot` under jit.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax

from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, check, from_table, read_toml
from hector_jax.core.trajectory import FEET, MAX_TILT, MIN_HEIGHT
from hector_jax.robot.numbers import Number, read_numbers

_PACKAGE = Path(__file__).parents[1]
_INSTALLED = _PACKAGE / "assets"  # the folder in a wheel
_ASSETS = _INSTALLED if _INSTALLED.exists() else _PACKAGE.parent / "assets"
MODEL_PATH = _ASSETS / "hector.xml"
DESCRIPTION_PATH = _ASSETS / "hector.toml"

LEG_JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
FEWEST_JOINTS, MOST_JOINTS = 3, 7  # of a leg
CONTROL = ("gait", "mpc", "slip", "footstep", "legs", "twin")  # sections that the controller reads

MAX_BYTES = 100_000

Triple = tuple[float, float, float]


def _joint_names(side: str) -> tuple[str, ...]:
    return tuple(f"{side}_{joint}" for joint in LEG_JOINTS)


class Foot(NamedTuple):
    """A foot in the model's file, by names in it or by points in the frame of a body."""

    point: str | Triple | None  # site; or point where wrenches act [m]; None: middle of contacts
    contacts: tuple[str | Triple, ...]  # spheres; or contact points of the sole [m]
    body: str | None = None  # whose frame the points are in


class NamedFoot(NamedTuple):
    """A foot in the compiled model, where site and spheres have names."""

    point: str  # site
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
    """The content of a robot's TOML; the defaults are the names and limits of HECTOR."""

    model: Path = MODEL_PATH  # MJCF or URDF
    path: Path = DESCRIPTION_PATH  # of the TOML
    name: str = "hector"
    standing: str | tuple[tuple[str, float], ...] = "standing"  # keyframe, or angles [rad] by joint
    joints: tuple[str, ...] = _joint_names("left") + _joint_names("right")
    linkage: tuple[int, int] | None = (5, 4)  # motor, and joint it also turns; counted from 1
    weld: tuple[str, ...] = ()  # joints
    armature: tuple[float, ...] = ()  # [kg m^2] of the joints of a leg; empty: the model's
    range: tuple[tuple[float, float], ...] = ()  # [rad] of those of a leg without one in the model
    torque: tuple[float, ...] = ()  # [N m] limits of those of a leg without one in the model
    feet: tuple[Foot, ...] = tuple(
        Foot(f"{side}_foot_point", (f"{side}_toe", f"{side}_heel")) for side in FEET[2]
    )
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
    def standing_key(self) -> str:
        """Keyframe of the standing pose in the compiled model."""
        return self.standing if isinstance(self.standing, str) else "standing"

    @property
    def legs(self) -> tuple[str, ...]:
        """Names of the legs."""
        return FEET[len(self.feet)]

    @property
    def named_feet(self) -> tuple[NamedFoot, ...]:
        """Site and spheres of each foot in the compiled model."""
        return tuple(
            NamedFoot(f"{leg}_point", tuple(f"{leg}_contact_{i}" for i in range(len(contacts))))
            if body is not None
            else NamedFoot(str(point), tuple(map(str, contacts)))
            for leg, (point, contacts, body) in zip(self.legs, self.feet, strict=True)
        )

    @property
    def leg_joints(self) -> int:
        """Number of joints of a leg."""
        return len(self.joints) // len(self.feet)


def _by_leg(section: Any, default: Any) -> dict[str, Any]:
    """Return the values of a section that are not the default, by leg in the order of FEET.

    Raises:
        InputError: the section has too few or too many legs.
    """
    legs = sum(FEET.values(), ())
    values = {leg: value for leg in legs if (value := getattr(section, leg)) != default}
    if tuple(values) not in FEET.values():
        expected = "; or ".join(map(", ".join, FEET.values()))
        raise InputError(f"must have {expected}, got {', '.join(values) or 'none of them'}")
    return values


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
    weld: tuple[str, ...] = ()
    armature: Annotated[tuple[float, ...], NOT_NEGATIVE] = ()
    range: tuple[tuple[float, float], ...] = ()
    torque: Annotated[tuple[float, ...], POSITIVE] = ()

    @property
    def legs(self) -> dict[str, tuple[str, ...]]:
        """Joints by leg."""
        return _by_leg(self, ())

    def __post_init__(self) -> None:
        names = sum(self.legs.values(), self.weld)
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
        for name in ("armature", "range", "torque"):
            if len(value := getattr(self, name)) not in (0, count):
                text = f"{name} must be {'a pair' if name == 'range' else 'a number'} for each of "
                raise InputError(f"{text}the {count} joints of a leg, got {short_repr(value)}")
        if any(not low < high for low, high in self.range):
            raise InputError(f"range must rise, got {short_repr(self.range)}")
        if self.linkage and (
            not all(1 <= i <= count for i in self.linkage) or len(set(self.linkage)) < 2
        ):
            text = f"linkage must be two joints of a leg, counted from 1 to {count}"
            raise InputError(f"{text}, got {list(self.linkage)}")


@dataclass(frozen=True)
class _Foot:
    point: str | Triple | None = None
    toe: str | None = None
    heel: str | None = None
    body: str | None = None
    contacts: tuple[str | Triple, ...] = ()

    def __post_init__(self) -> None:
        point, contacts, body = self.foot
        named = [isinstance(x, str) for x in contacts]
        valid = len(contacts) in (1, 2, 4) and not (self.contacts and (self.toe or self.heel))
        if body is None:
            valid = valid and all(named) and isinstance(point, str)
        else:
            points = [*contacts, (0.0, 0.0, 0.0) if point is None else point]
            valid = valid and not any(named) and not isinstance(point, str)
            valid = valid and all(math.isfinite(float(x)) for at in points for x in at)
        if not valid:
            raise InputError(
                "must be names: point (a site) and toe and heel (spheres), or point and 1, 2 or 4 "
                "contacts (spheres); or a body with 1, 2 or 4 contacts [x, y, z] on its sole and, "
                "if wanted, a point [x, y, z]"
            )

    @property
    def foot(self) -> Foot:
        """The foot in the form of the description."""
        ends = () if self.toe is None or self.heel is None else (self.toe, self.heel)
        return Foot(self.point, ends or self.contacts, self.body)


@dataclass(frozen=True)
class _Feet:
    left: _Foot | None = None
    right: _Foot | None = None
    front_left: _Foot | None = None
    front_right: _Foot | None = None
    hind_left: _Foot | None = None
    hind_right: _Foot | None = None

    @property
    def feet(self) -> dict[str, Foot]:
        """Feet by leg."""
        return {leg: foot.foot for leg, foot in _by_leg(self, None).items()}

    def __post_init__(self) -> None:
        counts = [len(foot.contacts) for foot in self.feet.values()]
        if len(set(counts)) > 1:
            raise InputError(f"{' and '.join(self.feet)} must have as many contacts, got {counts}")


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
    standing: str | dict[str, float] = "standing"
    joints: Joints = Joints(left=_joint_names("left"), right=_joint_names("right"))
    feet: _Feet | None = None
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
    numbers: dict[str, dict] | None = None

    def __post_init__(self) -> None:
        legs, feet = tuple(self.joints.legs), self.feet and tuple(self.feet.feet)
        if legs != (feet or FEET[2]):
            got = f"{', '.join(feet)} in feet" if feet else "no [feet]"
            text = f"joints has the legs {', '.join(legs)}, expected them in feet"
            raise InputError(f"{text}, got {got}")
        angles = self.standing.values() if isinstance(self.standing, dict) else ()
        if not all(map(math.isfinite, angles)):
            raise InputError(f"standing must be finite angles, got {short_repr(self.standing)}")
        if not self.model:
            raise InputError("model is missing: the name of an MJCF or URDF beside this file")
        if Path(self.model).name != self.model:
            raise InputError(f"model must name a file beside it, got {short_repr(self.model)}")


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
    file = from_table(str(path), _File, table)
    name = path.stem if file.name is None else file.name
    if not name.replace("-", "").replace("_", "").isalnum():
        text = "name must be letters, digits, - and _ (it names a folder)"
        raise InputError(f"{path}: {text}, got {short_repr(name)}")
    sections = {name: getattr(file, name) for name in CONTROL}
    return Description(
        model=path.parent / file.model,
        path=path,
        name=name,
        standing=_as_tuples(file.standing),
        joints=sum(file.joints.legs.values(), ()),
        linkage=file.joints.linkage,
        weld=file.joints.weld,
        armature=file.joints.armature,
        range=file.joints.range,
        torque=file.joints.torque,
        feet=tuple(file.feet.feet.values()) if file.feet else Description.feet,
        **vars(file.limits),
        control=_as_tuples({name: x for name, x in sections.items() if x is not None}),
        nominal=file.weights.nominal and file.weights.nominal.rows(),
        expert=file.weights.expert and file.weights.expert.rows(),
        loss=_as_tuples(file.loss or {}),
        tuning=file.tuning,
        plants=file.plants,
        numbers=read_numbers(str(path), file.numbers or {}),
    )


def _as_tuples(value: Any) -> Any:
    """Return the value with tuples for lists and dicts, hashable as static arguments must be."""
    if isinstance(value, dict):
        value = list(value.items())
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


HECTOR = Description()
"""The default robot, whose plants are drawn if no description is passed."""
