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

# pyright: reportIncompatibleVariableOverride=false
# a draft may have more than the standard form has

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, from_table
from hector_jax.robot.description import Joints, NamedFoot, Names, Triple


@dataclass(frozen=True)
class PublishedJoints(Joints):
    """The section [joints] of a draft."""

    weld: tuple[str, ...] = ()
    armature: Annotated[tuple[float, ...], NOT_NEGATIVE] = ()
    range: tuple[tuple[float, float], ...] = ()
    torque: Annotated[tuple[float, ...], POSITIVE] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        names = sum(self.legs.values(), ())
        count = len(names) // len(self.legs)
        if twice := {*names} & {*self.weld}:
            raise InputError(f"must be different names, got {short_repr(min(twice))} twice")
        for name in ("armature", "range", "torque"):
            if len(value := getattr(self, name)) not in (0, count):
                text = f"{name} must be {'a pair' if name == 'range' else 'a number'} for each of "
                raise InputError(f"{text}the {count} joints of a leg, got {short_repr(value)}")
        if any(not low < high for low, high in self.range):
            raise InputError(f"range must rise, got {short_repr(self.range)}")


@dataclass(frozen=True)
class PublishedFoot(NamedFoot):
    """A foot by names, or by points in the frame of a body."""

    point: str | Triple | None = None  # site; or where wrenches act [m]; None: middle of contacts
    contacts: tuple[str | Triple, ...] = ()  # spheres; or points on the sole [m]
    body: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [isinstance(x, str) for x in (*self.places, self.point) if x is not None]
        points = () if any(named) else (*self.contacts, self.point or (0.0, 0.0, 0.0))
        finite = all(math.isfinite(float(x)) for point in points for x in point)
        by_names = all(named) and self.point is not None
        if not (by_names if self.body is None else finite and not any(named)):
            raise InputError(
                "must be a body with 1, 2 or 4 contacts [x, y, z] on its sole and, if wanted, a "
                "point [x, y, z]; or names alone"
            )


@dataclass(frozen=True)
class Draft(Names):
    """Names and numbers with which a file is converted."""

    joints: PublishedJoints
    feet: dict[str, PublishedFoot]
    standing: str | dict[str, float] = "standing"

    @property
    def legs(self) -> tuple[str, ...]:
        """Names of the legs."""
        return tuple(self.joints.legs)

    @property
    def count(self) -> int:
        """Number of joints of a leg."""
        return len(self.all_joints) // len(self.legs)

    def __post_init__(self) -> None:
        super().__post_init__()
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
