"""What a published MJCF or URDF holds beside the robot's body, dropped before MuJoCo compiles it.

Meshes, pictures, sensors, contact pairs and couplings are of no use here; the files that they name
are never opened. A body whose mass comes from a mesh, and a coupling of leg joints, are refused.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.robot.mjcf import refusal

_MESHES = (
    mujoco.mjtGeom.mjGEOM_MESH,
    mujoco.mjtGeom.mjGEOM_SDF,
    mujoco.mjtGeom.mjGEOM_HFIELD,
)
_COUPLINGS = ("equality", "tendon")
_UNUSED = (*_COUPLINGS, "sensor", "contact", "deformable", "custom")
_LINK_PARTS = ("inertial", "visual", "collision")
_JOINT_PARTS = ("parent", "child", "origin", "axis", "limit", "dynamics")


def spec_of(
    path: Path, root: ElementTree.Element, joints: Sequence[str], keyframe: str | None
) -> tuple[mujoco.MjSpec, list[str]]:
    """The spec of a file without what is not needed, and what was dropped, a line each.

    Args:
        path: the file.
        root: its elements.
        joints: of the legs.
        keyframe: the only one that stays.

    Raises:
        InputError: one line naming a body that loses its mass, or a coupling of leg joints; or
            MuJoCo's refusal.
    """
    urdf, notes = root.tag == "robot", []
    dropped = _drop_of_urdf(path, root, joints) if urdf else 0
    if not urdf:
        _check_couplings(path, root, joints)
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
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise refusal(path, root, error) from None
    dropped += _drop_meshes(path, spec)
    return spec, [*notes, *[f"{dropped} meshes and pictures are not read"] * bool(dropped)]


def _remove(parent: ElementTree.Element, children: Sequence[ElementTree.Element]) -> int:
    for child in children:
        parent.remove(child)
    return len(children)


def _drop_meshes(path: Path, spec: mujoco.MjSpec) -> int:
    """Drop what is read from other files, and what is made of it. Returns how much."""
    meshes = [geom for geom in spec.geoms if geom.type in _MESHES or geom.meshname]
    for geom in meshes:
        body = geom.parent
        if body.name == "world":
            if geom.contype or geom.conaffinity:
                raise InputError(
                    f"{path}: geom {short_repr(geom.name)} of the world is terrain, expected a "
                    "plane at z = 0 or nothing"
                )
        elif not body.explicitinertial and _has_mass(spec, geom):
            raise InputError(
                f"{path}: body {short_repr(body.name)} has its mass from a mesh, which is not "
                "read: give the body an <inertial>"
            )
    pictures = [x for x in spec.textures if x.file or x.content_type or any(x.cubefiles)]
    dropped = [*meshes, *spec.meshes, *spec.hfields, *spec.skins, *pictures]
    for part in dropped:
        spec.delete(part)
    textures = {texture.name for texture in spec.textures}
    for material in spec.materials:
        material.textures = [name if name in textures else "" for name in material.textures]
    return len(dropped)


def _has_mass(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Whether a geom adds to the mass of a body without <inertial>."""
    low, high = spec.compiler.inertiagrouprange
    read = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    mass = geom.density if np.isnan(geom.mass) else geom.mass
    return bool(read and low <= geom.group <= high and mass)


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


def _drop_of_urdf(path: Path, root: ElementTree.Element, joints: Sequence[str]) -> int:
    """Keep links of numbers and primitives, and free joints. Returns how many meshes went."""
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
    return dropped
