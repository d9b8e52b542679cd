"""Check the model of a robot before MuJoCo opens it.

A model is an MJCF of at most 1 MB that names no other file. Elements that expand (entities,
replicated and composed bodies, huge textures and memories) and numbers that no robot has (NaN,
negative masses, empty ranges, turns in degrees where radians are due) are refused; the message
names file, element, attribute and value. `checks` says which bodies and joints a robot has.
"""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from itertools import product
from pathlib import Path

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import (
    InputError,
    did_you_mean,
    expect,
    one_line,
    read_text,
    short_repr,
)
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, Range
from hector_jax.robot.description import convert_by

TIME_STEP = 0.001  # [s] of plant, joint control and samples of every robot
MOST_BYTES = 1_000_000
_DEEPEST = 100
_MOST_BODIES, _MOST_JOINTS = 2000, 200
_TURN = 6.3  # [rad], rounded up
_REFUSED = ("attach", "model", "replicate", "composite", "flexcomp", "plugin")

_COUNT = Range(-1, 1_000_000)  # -1: as many as needed
_NOT_NEGATIVE = "mass density armature damping frictionloss friction margin size"
_PIXELS = "width height offwidth offheight nrow ncol shadowsize"
_COUNTS = "njmax nconmax nkey nstack nuserdata "
_COUNTS += "nuser_body nuser_jnt nuser_geom nuser_site nuser_actuator"
_RANGES: Mapping[str, Range] = {
    "diaginertia": NOT_NEGATIVE,
    "iterations": Range(1, 1000),
    "ls_iterations": Range(1, 1000),
    "offsamples": Range(0, 64),
    **dict.fromkeys(_NOT_NEGATIVE.split(), NOT_NEGATIVE),
    **dict.fromkeys(_PIXELS.split(), Range(0, 8192)),
    **dict.fromkeys(_COUNTS.split(), _COUNT),
}
_RANGES_OF = {
    ("inertial", "mass"): POSITIVE,
    ("numeric", "size"): _COUNT,
    ("mass", "value"): NOT_NEGATIVE,
    # of a URDF's shapes, which have no names
    ("box", "size"): POSITIVE,
    **dict.fromkeys(product(("sphere", "cylinder", "capsule"), ("radius", "length")), POSITIVE),
}
_PAIRS = ("range", "ctrlrange", "forcerange", "actuatorfrcrange")
_MEMORY = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30}
_MOST_MEMORY = 2**30


def read_mjcf(path: Path, toml: Path) -> ElementTree.Element:
    """Read the elements of an MJCF that is safe to open with MuJoCo and needs no other file.

    Args:
        path: of the file.
        toml: that names it.

    Raises:
        InputError: one line naming the file and the first error in it.
    """
    root = read_elements(path)
    text = f"root element is <{root.tag[:40]}>, expected <mujoco>; {convert_by(toml)}"
    expect(path, root.tag == "mujoco", text)
    for element in root.iter():  # as <include file=..>
        for file in (x for name, x in element.attrib.items() if name.startswith("file")):
            text = f"<{element.tag}> of {short_repr(file)} is of another file"
            raise InputError(f"{path}: {text}; {convert_by(toml)}")
    check_elements(path, root)
    return root


def read_elements(path: Path) -> ElementTree.Element:
    """Return the root element of a file.

    Raises:
        InputError: it cannot be read, or is no plain XML.
    """
    text = read_text(path, "the robot description", MOST_BYTES)
    if match := re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(f"{path}: {match[1].upper()} is not accepted, expected plain MJCF or URDF")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: malformed XML: {one_line(error)}") from None


def check_elements(path: Path, root: ElementTree.Element) -> None:
    """Check all elements and numbers of an MJCF or URDF.

    Raises:
        InputError: one line naming the file and the first error in it.
    """
    in_rad = root.tag == "robot" or any(x.get("angle") == "radian" for x in root.iter("compiler"))
    bodies = joints = 0
    for element, label in _labelled(path, root):
        text = f"<{element.tag}> is not accepted, expected plain bodies"
        expect(path, element.tag not in _REFUSED, text)
        bodies += element.tag in ("body", "link")
        joints += element.tag in ("joint", "freejoint") and element.get("type") != "fixed"
        for name, value in element.attrib.items():
            if expected := _expected(element.tag, name, value, in_rad):
                message = f"{name} is {short_repr(value)}, expected {expected}"
                raise InputError(f"{path}: {label}: {message}")
    expect(path, bodies <= _MOST_BODIES, f"{bodies} bodies, expected at most {_MOST_BODIES}")
    text = f"{joints} joints that move, expected at most {_MOST_JOINTS}: fix those of no leg"
    expect(path, joints <= _MOST_JOINTS, text)


@contextmanager
def mujoco_errors(path: Path, root: ElementTree.Element) -> Iterator[None]:
    """Raise MuJoCo's errors as one-line InputErrors, with the name nearest to an unknown one.

    Args:
        path: of the file, for the message.
        root: of which MuJoCo reads `text_of`.
    """
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        labels, message = [label for _, label in _labelled(path, root)], one_line(error)
        schema = re.findall(r"\w+", mujoco.mj_printSchema(False, False))
        names = {element.get("name", "") for element in root.iter()} | set(schema)
        # MuJoCo quotes unknown names and their context: the first word without a match counts
        unknown = [word for word in re.findall(r"'([^']*)'", message) if word not in names]
        hint = did_you_mean(unknown[0], names) if unknown else ""
        if "balanceinertia" in message:
            hint = ': write <compiler balanceinertia="true"/> into <mujoco>, in a URDF too'
        # the lines are those of `text_of`, and not the user's
        place = r"Element (?:name )?'[^']*'(?:, id \d+)?, line (\d+)"
        message = re.sub(place, lambda match: f"at {labels[int(match[1]) - 1]}", message)
        raise InputError(f"{path}: MuJoCo refuses it: {message}{hint}") from None


def text_of(root: ElementTree.Element) -> str:
    """Return the text of a file's elements, in which each one begins a line."""
    for parent in root.iter():
        parent.text = "\n" * bool(len(parent))
        for child in parent:
            child.tail = "\n" * (child is not parent[-1])
    return ElementTree.tostring(root, encoding="unicode")


def _labelled(
    path: Path, element: ElementTree.Element, owner: str = "", depth: int = 1
) -> Iterator[tuple[ElementTree.Element, str]]:
    """Yield each element in their order with its label: its own name or that of an outer one."""
    expect(path, depth <= _DEEPEST, f"elements are nested deeper than {_DEEPEST}")
    name = element.get("name")
    label = f" {short_repr(name)}" if name else f" of {short_repr(owner)}" * bool(owner)
    yield element, f"<{element.tag}>{label}"
    for child in element:
        yield from _labelled(path, child, name or element.get("class") or owner, depth + 1)


def _expected(tag: str, name: str, value: str, in_rad: bool) -> str | None:
    """Return what was expected of an attribute with an invalid value, None for a valid one."""
    if name == "name" or tag == "flag":  # a flag's attributes are words, as "enable"
        return None
    if name == "memory":
        size = re.fullmatch(r"(\d{1,12})([KMG]?)", value)
        valid = value == "-1" or (size and int(size[1]) * _MEMORY[size[2]] <= _MOST_MEMORY)
        return None if valid else "at most 1G"
    numbers: list[float] | None = None
    with suppress(ValueError):
        numbers = list(map(float, value.split()))
    allowed = _RANGES_OF.get((tag, name)) or _RANGES.get(name)
    if allowed and not (numbers and all(number in allowed for number in numbers)):
        return f"numbers {allowed}"
    if numbers and not math.isfinite(sum(numbers)):
        return "finite numbers"
    if name in ("rpy", "euler") and in_rad and max(map(abs, numbers or [0.0])) > _TURN:
        return "rad, and these are degrees"
    pair = name in _PAIRS and tag != "light"  # the range of a light is a length
    if pair and (numbers is None or len(numbers) != 2 or numbers[0] > numbers[1]):
        return "two numbers, the lower one first"
    return None
