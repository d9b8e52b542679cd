"""The part of a robot's TOML that names what a published file has; the rest is `description`'s.

Beside the keys of the standard form it has

    standing = { knee = 0.5 }          # angles [rad] of joints, or a keyframe
    [joints]
    weld = ["waist"]                   # hinges that are fixed in the standing pose
    armature = one number per joint    # [kg m^2] of a leg's motors, which a URDF cannot state
    range, torque = [lower, upper] and a number per joint  # [rad], [N m] where the model has none
    [feet]
    left, right = { body, contacts = [[x, y, z], ...], point = [x, y, z] }   # 1, 2 or 4 contacts
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, from_table
from hector_jax.core.trajectory import FEET
from hector_jax.robot.description import Joints, Triple, by_leg


@dataclass(frozen=True)
class PublishedJoints(Joints):
    """The section [joints] of a draft."""

    weld: tuple[str, ...] = ()
    armature: Annotated[tuple[float, ...], NOT_NEGATIVE] = ()
    range: tuple[tuple[float, float], ...] = ()
    torque: Annotated[tuple[float, ...], POSITIVE] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        count, own = len(next(iter(self.legs.values()))), sum(self.legs.values(), ())
        if twice := {*own} & {*self.weld}:
            raise InputError(f"must be different names, got {short_repr(min(twice))} twice")
        for name in ("armature", "range", "torque"):
            if len(value := getattr(self, name)) not in (0, count):
                text = f"{name} must be {'a pair' if name == 'range' else 'a number'} for each of "
                raise InputError(f"{text}the {count} joints of a leg, got {short_repr(value)}")
        if any(not low < high for low, high in self.range):
            raise InputError(f"range must rise, got {short_repr(self.range)}")


@dataclass(frozen=True)
class PublishedFoot:
    """A foot by names of a site and of spheres, or by points in the frame of a body."""

    body: str | None = None
    contacts: tuple[str | Triple, ...] = ()  # spheres; or points on the sole [m]
    point: str | Triple | None = None  # site; or where wrenches act [m]; None: middle of contacts
    toe: str | None = None
    heel: str | None = None

    @property
    def places(self) -> tuple[str | Triple, ...]:
        """Its spheres or points."""
        ends = () if self.toe is None or self.heel is None else (self.toe, self.heel)
        return ends or self.contacts

    def __post_init__(self) -> None:
        named = [isinstance(x, str) for x in (*self.places, self.point)]
        if self.body is None:
            valid = all(named)
        else:
            points = [*self.places, *(x for x in (self.point,) if x is not None)]
            valid = not any(named) and all(math.isfinite(float(x)) for at in points for x in at)
        ends = self.toe is not None or self.heel is not None
        if not valid or len(self.places) not in (1, 2, 4) or (self.contacts and ends):
            raise InputError(
                "must be names: point (a site) and toe and heel (spheres), or point and 1, 2 or 4 "
                "contacts (spheres); or a body with 1, 2 or 4 contacts [x, y, z] on its sole and, "
                "if wanted, a point [x, y, z]"
            )


@dataclass(frozen=True)
class _Feet:
    left: PublishedFoot | None = None
    right: PublishedFoot | None = None
    front_left: PublishedFoot | None = None
    front_right: PublishedFoot | None = None
    hind_left: PublishedFoot | None = None
    hind_right: PublishedFoot | None = None


@dataclass(frozen=True)
class Draft:
    """Names and numbers with which a file is converted."""

    joints: PublishedJoints
    feet: _Feet
    standing: str | dict[str, float] = "standing"

    @property
    def leg_joints(self) -> tuple[str, ...]:
        """Joints of all legs, leg by leg."""
        return sum(self.joints.legs.values(), ())

    @property
    def legs(self) -> tuple[str, ...]:
        """Names of the legs."""
        return FEET[len(self.joints.legs)]

    @property
    def soles(self) -> tuple[PublishedFoot, ...]:
        """Feet in the order of the legs."""
        return tuple(by_leg(self.feet, None).values())

    def __post_init__(self) -> None:
        feet = by_leg(self.feet, None)
        if self.legs != tuple(feet):
            text = f"joints has the legs {', '.join(self.legs)}, expected them in feet"
            raise InputError(f"{text}, got {', '.join(feet)}")
        counts = [len(foot.places) for foot in self.soles]
        if len(set(counts)) > 1:
            raise InputError(f"{' and '.join(feet)} must have as many contacts, got {counts}")
        angles = self.standing.values() if isinstance(self.standing, dict) else ()
        if not all(map(math.isfinite, angles)):
            raise InputError(f"standing must be finite angles, got {short_repr(self.standing)}")


def draft_of(path: Path, table: dict[str, Any]) -> Draft:
    """Return the draft in a table of a robot's TOML at a path.

    Raises:
        InputError: one line naming the file, the key, the value received and the expected one.
    """
    names = {key: table[key] for key in ("joints", "feet", "standing") if key in table}
    return from_table(str(path), Draft, names)
