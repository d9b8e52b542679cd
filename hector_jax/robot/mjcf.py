"""Check a robot's file of any origin before MuJoCo opens it.

A model is one self-contained MJCF or URDF file of at most 1 MB: meshes and pictures are named in it
but never opened (`elements` removes them). Elements that read other files (includes) or expand
(entities, replicated and composed bodies, huge textures and memories) and numbers that no robot has
(NaN, negative masses, empty ranges) are refused; the message names file, element, attribute and
value. Other modules check which bodies and joints a robot has.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, did_you_mean, one_line, read_text, short_repr
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, Range
from hector_jax.robot.checks import expect

TIME_STEP = 0.001  # [s] of plant, joint control and samples of every robot
MOST_BYTES = 1_000_000
_DEEPEST = 100
_MOST_BODIES, _MOST_JOINTS = 2000, 200
_URDF_PARTS = ("link", "joint", "material", "mujoco")  # of a robot; others are for other programs
_REFUSED = ("include", "attach", "model", "replicate", "composite", "flexcomp", "plugin")

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
}
_PAIRS = ("range", "ctrlrange", "forcerange", "actuatorfrcrange")
_MEMORY = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30}
_MOST_MEMORY = 2**30


def read_mjcf(path: Path) -> ElementTree.Element:
    """Read the elements of an MJCF or URDF that is safe to open with MuJoCo.

    Raises:
        InputError: one line naming the file and the first error in it.
    """
    text = read_text(path, "the robot description", MOST_BYTES)
    if match := re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(f"{path}: {match[1].upper()} is not accepted, expected plain MJCF or URDF")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{path}: malformed XML: {one_line(error)}") from None
    if root.tag not in ("mujoco", "robot"):
        raise InputError(f"{path}: root element is <{root.tag[:40]}>, expected <mujoco> or <robot>")
    if root.tag == "robot":
        root[:] = [part for part in root if part.tag in _URDF_PARTS]
    bodies = joints = 0
    for element, label in _labelled(path, root):
        file = f" of {short_repr(element.get('file'))}" if "file" in element.attrib else ""
        text = f"<{element.tag}>{file} is not accepted, expected one self-contained file"
        expect(path, element.tag not in _REFUSED, text)
        bodies += element.tag in ("body", "link")
        joints += element.tag in ("joint", "freejoint") and element.get("type") != "fixed"
        for name, value in element.attrib.items():
            if expected := _expected(element.tag, name, value):
                message = f"{name} is {short_repr(value)}, expected {expected}"
                raise InputError(f"{path}: {label}: {message}")
    expect(path, bodies <= _MOST_BODIES, f"{bodies} bodies, expected at most {_MOST_BODIES}")
    text = f"{joints} joints that move, expected at most {_MOST_JOINTS}: fix those of no leg"
    expect(path, joints <= _MOST_JOINTS, text)
    return root


@contextmanager
def mujoco_errors(path: Path, root: ElementTree.Element | None = None) -> Iterator[None]:
    """Raise MuJoCo's errors as one-line InputErrors.

    Args:
        path: of the file, for the message.
        root: XML element of the file; if passed, the message suggests the name nearest to an
            unknown one.
    """
    try:
        yield
    except (ValueError, mujoco.FatalError) as error:
        message, hint = one_line(error), ""
        if root is not None:
            schema = re.findall(r"\w+", mujoco.mj_printSchema(False, False))
            names = {element.get("name", "") for element in root.iter()} | set(schema)
            # MuJoCo quotes unknown names and their context: the first word without a match counts
            unknown = [word for word in re.findall(r"'([^']*)'", message) if word not in names]
            hint = did_you_mean(unknown[0], names) if unknown else ""
            if "balanceinertia" in message:
                hint = ': write <compiler balanceinertia="true"/> into <mujoco>, in a URDF too'
        raise InputError(f"{path}: MuJoCo refuses it: {message}{hint}") from None


def _labelled(path: Path, root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, str]]:
    """Yield each element with its label for messages."""
    depth = {root: 1}
    yield root, f"<{root.tag}>"
    for parent in root.iter():
        expect(path, depth[parent] <= _DEEPEST, f"elements are nested deeper than {_DEEPEST}")
        for child in parent:
            depth[child] = depth[parent] + 1
            label = f"<{child.tag}>"
            if name := child.get("name"):
                label += f" {short_repr(name)}"
            elif owner := parent.get("name") or parent.get("class"):
                label += f" of {short_repr(owner)}"
            yield child, label


def _expected(tag: str, name: str, value: str) -> str | None:
    """Return what was expected of an attribute with an invalid value, None for a valid one."""
    if name == "name":
        return None
    numbers = _numbers(value)
    if name == "memory":
        size = re.fullmatch(r"(\d{1,12})([KMG]?)", value)
        valid = value == "-1" or (size and int(size[1]) * _MEMORY[size[2]] <= _MOST_MEMORY)
        return None if valid else "at most 1G"
    allowed = _RANGES_OF.get((tag, name)) or _RANGES.get(name)
    if allowed and not (numbers and all(number in allowed for number in numbers)):
        return f"numbers {allowed}"
    if numbers and not all(number in Range() for number in numbers):
        return "finite numbers"
    pair = name in _PAIRS and tag != "light"  # the range of a light is a length
    if pair and (numbers is None or len(numbers) != 2 or numbers[0] > numbers[1]):
        return "two numbers, the lower one first"
    return None


def _numbers(text: str) -> list[float] | None:
    """Return the numbers in a text, None if it contains anything else."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return None
