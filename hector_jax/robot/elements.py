"""What a published MJCF or URDF holds beside the robot's body, dropped before MuJoCo reads it.

Meshes, pictures, sensors, contact pairs and couplings are of no use here; the files that they name
are never opened. A body whose mass comes from a mesh, and a coupling of leg joints, are refused.
"""

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from pathlib import Path

from hector_jax.core.inputs import InputError, short_repr

_MESHES = ("mesh", "sdf", "hfield")
_COUPLINGS = ("equality", "tendon")
_UNUSED = (*_COUPLINGS, "sensor", "contact", "deformable", "custom")
_LINK_PARTS = ("inertial", "visual", "collision")
_JOINT_PARTS = ("parent", "child", "origin", "axis", "limit", "dynamics")


def drop_unused(
    path: Path, root: ElementTree.Element, joints: Sequence[str], keyframe: str | None
) -> list[str]:
    """Drop in place what is not needed, and say so in one line each.

    Args:
        path: the file.
        root: its elements.
        joints: of the legs.
        keyframe: the only one that stays.

    Raises:
        InputError: one line naming a body that loses its mass, or a coupling of leg joints.
    """
    if root.tag == "robot":
        return _drop_of_urdf(path, root, joints)
    _check_couplings(path, root, joints)
    notes = []
    for tag in _UNUSED:
        parts = root.findall(tag)
        if any(len(part) for part in parts):
            notes.append(f"<{tag}> is not used")
        _remove(root, parts)
    for part in root.findall("actuator"):  # those of tendons, sites and bodies
        _remove(part, [m for m in part if not {"joint", "jointinparent"} & set(m.attrib)])
    for part in root.findall("keyframe"):
        _remove(part, [key for key in part if key.get("name") != keyframe])
        for key in part:
            for name in ("ctrl", "act", "mpos", "mquat"):  # their number may change
                key.attrib.pop(name, None)
    dropped = _drop_mesh_geoms(path, root)
    dropped += _drop_files(root)
    return notes + _not_read(dropped)


def _not_read(number: int) -> list[str]:
    return [f"{number} meshes and pictures are not read"] if number else []


def _remove(parent: ElementTree.Element, children: Sequence[ElementTree.Element]) -> int:
    for child in children:
        parent.remove(child)
    return len(children)


def _reads_file(asset: ElementTree.Element) -> bool:
    return asset.tag in ("mesh", "hfield", "skin") or any(
        name.startswith("file") for name in asset.attrib
    )


def _drop_files(root: ElementTree.Element) -> int:
    """Drop what is read from other files, and the mention of it. Returns how many."""
    dropped = 0
    for assets in root.findall("asset"):
        dropped += _remove(assets, [part for part in assets if _reads_file(part)])
    textures = {part.get("name") for part in root.iterfind("asset/texture")}
    for material in root.iter("material"):
        _remove(material, [x for x in material if x.get("texture") not in textures])
        if material.get("texture") not in textures:
            material.attrib.pop("texture", None)
    for default in root.iter("default"):
        for geom in default.findall("geom"):
            geom.attrib.pop("mesh", None)
            geom.attrib.pop("hfield", None)
            if geom.get("type") in _MESHES:
                del geom.attrib["type"]
    for compiler in root.iter("compiler"):
        for name in ("assetdir", "meshdir", "texturedir"):
            compiler.attrib.pop(name, None)
    return dropped


def _drop_mesh_geoms(path: Path, root: ElementTree.Element) -> int:
    classes, dropped = _geom_classes(root), 0
    for body, parent, geom, inherited in _geoms(root):
        attributes = {**classes.get(geom.get("class", inherited), {}), **geom.attrib}
        if attributes.get("type") not in _MESHES and "mesh" not in attributes:
            continue
        parent.remove(geom)
        dropped += 1
        if body.tag == "worldbody":
            collides = attributes.get("contype", "1") != "0"
            if collides or attributes.get("conaffinity", "1") != "0":
                raise InputError(
                    f"{path}: geom {short_repr(geom.get('name', ''))} of the world is terrain, "
                    "expected a plane at z = 0 or nothing"
                )
        elif _has_mass(root, attributes) and body.find("inertial") is None:
            raise InputError(
                f"{path}: body {short_repr(body.get('name', ''))} has its mass from a mesh, which "
                "is not read: give the body an <inertial>"
            )
    return dropped


def _has_mass(root: ElementTree.Element, attributes: dict[str, str]) -> bool:
    """Whether a geom adds to the mass of a body without <inertial>."""
    low, high = "0", "5"
    for compiler in root.iter("compiler"):
        low, high = compiler.get("inertiagrouprange", f"{low} {high}").split()[:2]
        if compiler.get("inertiafromgeom") == "false":
            return False
    if not low <= attributes.get("group", "0") <= high:  # digits
        return False
    mass = attributes.get("mass", attributes.get("density", "1000"))
    return not re.fullmatch(r"\s*[+-]?0*\.?0*(e.*)?\s*", mass)


def _geom_classes(root: ElementTree.Element) -> dict[str, dict[str, str]]:
    """Attributes of geoms by default class."""
    classes: dict[str, dict[str, str]] = {"main": {}}

    def add(default: ElementTree.Element, inherited: dict[str, str]) -> None:
        own = dict(inherited)
        for geom in default.findall("geom"):
            own |= geom.attrib
        classes[default.get("class", "main")] = own
        for child in default.findall("default"):
            add(child, own)

    for default in root.findall("default"):
        add(default, classes["main"])
    return classes


def _geoms(
    root: ElementTree.Element,
) -> Iterator[tuple[ElementTree.Element, ElementTree.Element, ElementTree.Element, str]]:
    """Each geom with its body, the element that holds it and the class that it inherits."""
    places = [(world, world, "main") for world in root.findall("worldbody")]
    while places:
        body, holder, inherited = places.pop(0)
        inherited = holder.get("childclass", inherited)
        for child in list(holder):
            if child.tag == "geom":
                yield body, holder, child, inherited
            elif child.tag in ("body", "frame"):
                places.append((child if child.tag == "body" else body, child, inherited))


def _check_couplings(path: Path, root: ElementTree.Element, joints: Sequence[str]) -> None:
    """Refuse an equality or a tendon that takes part of a leg."""
    of_legs = set(joints)
    for body in root.iter("body"):
        if any(joint.get("name") in joints for joint in body.findall("joint")):
            of_legs |= {part.get("name", "") for part in body.iter() if part.tag != "default"}
    for tag in _COUPLINGS:
        for part in (part for section in root.findall(tag) for part in section):
            words = {
                value
                for element in part.iter()
                for name, value in element.attrib.items()
                if name not in ("name", "class")
            }
            if part.get("active") != "false" and (coupled := sorted(words & of_legs)):
                what = f"{path}: <{part.tag}> of <{tag}> couples {', '.join(coupled)}"
                raise InputError(
                    f"{what}, expected legs of free hinges: remove it, or weld a joint of it"
                )


def _drop_of_urdf(path: Path, root: ElementTree.Element, joints: Sequence[str]) -> list[str]:
    """Keep links of numbers and primitives, and joints without couplings."""
    dropped = 0
    for joint in root.findall("joint"):
        name = joint.get("name")
        if joint.find("mimic") is not None and name in joints:
            raise InputError(f"{path}: joint {name!r} mimics another one, expected a free hinge")
        _remove(joint, [part for part in joint if part.tag not in _JOINT_PARTS])
    for link in root.findall("link"):
        meshes = [part for part in link if part.find(".//mesh") is not None]
        dropped += _remove(link, meshes)
        _remove(link, [part for part in link if part.tag not in _LINK_PARTS])
        for part in link.findall("inertial"):
            mass = part.find("mass")
            if mass is None or float(mass.get("value", "0")) == 0.0:  # numbers, as was checked
                link.remove(part)
    for material in root.iter("material"):
        _remove(material, material.findall("texture"))
    own = ElementTree.SubElement(root, "mujoco")
    # the root link stays a body, and what has no <inertial> has no mass
    ElementTree.SubElement(
        own, "compiler", fusestatic="false", discardvisual="false", inertiafromgeom="false"
    )
    root.remove(own)
    root.insert(0, own)
    return _not_read(dropped)
