"""Remove the parts of an MJCF or URDF that the package does not use, before MuJoCo compiles it.

Meshes, pictures, sensors, contact pairs and couplings are removed; the files that they name are
never opened. A body whose mass comes from a mesh, and a coupling of leg joints, are refused.

CAD programs export frames of no mass, whose inertia is rounding: a body of at most MASSLESS has
none, and a heavier one that is fixed to its parent is a point mass if no body can have its inertia.
Of a light link that moves such moments are fixed, and a note says so.

Bodies and joints without a name get one, by which descriptions and messages mean them.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from copy import deepcopy
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import expect, listed, short_repr
from hector_jax.importing.links import MASSLESS
from hector_jax.importing.published import read_published
from hector_jax.robot.mjcf import mujoco_errors, text_of

_GEOM = mujoco.mjtGeom
MESHES = (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_SDF, _GEOM.mjGEOM_HFIELD)
_NO_INERTIA = 1e-12  # [kg m^2], which MuJoCo accepts of any body
_LIGHT, _LIGHTEST = 0.1, 0.02  # shares of the mass up to which moments are fixed, see `_repaired`
_NONE = 1e-6  # [m^2] of moments of inertia by mass that are no more than rounding
_DENSITY = 1000.0  # [kg/m^3] of the ball whose moments such a link gets
_COUPLINGS = ("equality", "tendon")
_UNUSED = (*_COUPLINGS, "sensor", "deformable", "custom")
# settings that MuJoCo no longer has, by element; only with the value, if there is one
_OF_OTHER_VERSIONS: dict[str, dict[str, str | None]] = {
    "compiler": {"coordinate": "local", "convexhull": None},
    "option": dict.fromkeys(("collision", "apirate", "mpr_iterations", "mpr_tolerance")),
}
_JOINT_PARTS = ("parent", "child", "origin", "axis", "limit", "dynamics")


class File(NamedTuple):
    """A file without the parts that are not used, as MuJoCo reads it."""

    path: Path
    root: ElementTree.Element  # with all its parts
    spec: mujoco.MjSpec
    model: mujoco.MjModel  # without motors and keyframes, which may not match it
    notes: list[str]  # one line per kind of part that was removed or repaired

    @property
    def joints(self) -> list[str]:
        """Names of the joints by index."""
        return [self.model.joint(j).name for j in range(self.model.njnt)]


def read_file(path: Path) -> File:
    """Read a file without unused parts.

    Raises:
        InputError: one line naming a body that loses its mass; or MuJoCo's error.
    """
    root = read_published(path)
    whole = deepcopy(root)
    spec, notes, removed = parsed(path, root)
    removed += _remove_meshes(path, spec)
    notes += repair_inertias(path, spec)
    notes += [f"{removed} meshes and pictures are not read"] * bool(removed)
    return File(path, whole, spec, compile_bare(path, root, spec), notes)


def compile_bare(path: Path, root: ElementTree.Element, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a file without its motors and keyframes.

    Raises:
        InputError: MuJoCo's error in one line.
    """
    bare = spec.copy()
    for part in (*bare.actuators, *bare.keys):
        bare.delete(part)
    # welded bodies may have no mass; `to_standard` checks the masses of the merged links
    bare.compiler.boundmass = MASSLESS
    bare.compiler.boundinertia = _NO_INERTIA
    with mujoco_errors(path, root):
        return bare.compile()


def parsed(path: Path, root: ElementTree.Element) -> tuple[mujoco.MjSpec, list[str], int]:
    """Return the spec of a file with the meshes of an MJCF, none opened; notes; meshes removed."""
    removed, notes = 0, []
    if root.tag == "robot":
        removed = _clean_urdf(path, root)
    else:
        notes += _clean_options(root) + _add_trunk(root)
        for tag in _UNUSED:
            parts = root.findall(tag)
            if any(len(part) for part in parts):
                notes.append(f"<{tag}> is not used")
            _remove(root, parts)
        held = [x for x in root.iter("body") if x.get("gravcomp", "0") != "0"]
        held += [x for x in root.findall("actuator/*") if {"site", "body"} & {*x.attrib}]
        names = ", ".join(repr(x.get("name", "")) for x in held)
        text = f"{names} push bodies (gravcomp, actuators of sites and bodies), expected motors of "
        expect(path, not held, f"{text}joints alone: remove that")
        for contact in root.findall("contact"):
            _remove(contact, contact.findall("pair"))
    with mujoco_errors(path, root):
        spec = mujoco.MjSpec.from_string(text_of(root))
    _add_names(spec)
    return spec, notes, removed


def _clean_options(root: ElementTree.Element) -> list[str]:
    """Remove flags, and settings of other versions of MuJoCo. Returns notes."""
    gone = []
    for option in root.findall("option"):
        gone += ["<flag> of <option>"] * len(option.findall("flag"))
        _remove(option, option.findall("flag"))
    for tag, names in _OF_OTHER_VERSIONS.items():
        for part in root.findall(tag):
            for name in {*names} & {*part.attrib}:
                if part.get(name) in (names[name], None) or names[name] is None:
                    gone.append(f"{name} of <{tag}>")
                    del part.attrib[name]
    return [f"{listed(list(dict.fromkeys(gone)))} not used"] * bool(gone)


def _add_trunk(root: ElementTree.Element) -> list[str]:
    """Put legs that hang at the world, and all beside them, into a body. Returns a note."""
    worlds = root.findall("worldbody")
    bodies = [x for world in worlds for x in world.findall("body")]
    hang = [x for x in bodies if any(j.get("type") != "free" for j in x.findall("joint"))]
    free = root.find(".//freejoint") is not None or root.find(".//joint[@type='free']") is not None
    if len(hang) < 2 or free:
        return []
    trunk = ElementTree.Element("body", name="trunk")
    for world in worlds:
        own = [x for x in world if x.tag in ("body", "geom")]
        _remove(world, own)
        trunk.extend(x for x in own if x.get("type") != "plane")  # a floor, as high as it likes
    worlds[0].append(trunk)
    return ["the legs hang at the world: what is there is the trunk"]


def _remove(parent: ElementTree.Element, children: Sequence[ElementTree.Element]) -> None:
    for child in children:
        parent.remove(child)


def _add_names(spec: mujoco.MjSpec) -> None:
    """Name each body and each joint that has no name; a free joint needs none."""
    joints = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    for kind, parts in (("body", spec.bodies[1:]), ("joint", joints)):
        names = {part.name for part in parts}
        for i, part in enumerate(parts, 1):
            name = f"{kind}_{i}"
            while not part.name and name in names:
                name += "_"
            part.name = part.name or name


def repair_inertias(path: Path, spec: mujoco.MjSpec) -> list[str]:
    """Replace the inertias of bodies that have none, see the module's docstring. Returns a note."""
    total, changed = sum(body.mass for body in spec.bodies[1:] if body.explicitinertial), []
    for body in spec.bodies[1:]:
        xx, yy, zz, xy, xz, yz = [*body.inertia] + [0.0] * 3
        if np.isfinite(body.fullinertia[0]):
            xx, yy, zz, xy, xz, yz = body.fullinertia
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        least, middle, most = moments
        fixed = not body.joints and body.parent.name != "world"
        impossible = least <= 0.0 or least + middle < most
        if not body.explicitinertial or not (body.mass <= MASSLESS or impossible):
            continue
        value: float | None = _NO_INERTIA
        if body.mass > MASSLESS and not fixed:
            value = _repaired(moments, body.mass, body.mass / total)
            text = f"body {body.name!r} has moments of inertia from {least:.3g} to {most:.3g}"
            expect(path, value or least > 0.0, f"{text}, expected positive ones")
            if value is None:  # MuJoCo says what to write, or the file has written it
                continue
            changed.append(body.name)
        body.fullinertia, body.inertia = np.full(6, np.nan), np.full(3, value)
    text = "moments of inertia that no body has are the mean of the three, or a ball's: "
    return [text + listed(changed)] * bool(changed)


def _repaired(moments: Float[np.ndarray, "3"], mass: float, share: float) -> float | None:
    """Return a moment of inertia in the place of impossible ones; None of a link that matters."""
    if moments[2] <= _NONE * mass:
        return 0.4 * mass * (0.75 * mass / (np.pi * _DENSITY)) ** (2 / 3)
    light = share <= (_LIGHT if moments[0] > 0.0 else _LIGHTEST)
    return float(moments.mean()) if light and moments.mean() > 0.0 else None


def _remove_meshes(path: Path, spec: mujoco.MjSpec) -> int:
    """Remove meshes and pictures and the geoms made of them. Returns the number of parts."""
    meshes = [geom for geom in spec.geoms if geom.type in MESHES or geom.meshname]
    for geom in meshes:
        body, of_world = geom.parent, geom.parent.name == "world"
        terrain = of_world and (geom.contype or geom.conaffinity)
        text = f"geom {short_repr(geom.name)} of the world is terrain, expected a plane at z = 0"
        expect(path, not terrain, f"{text} or nothing")
        heavy = not of_world and not body.explicitinertial and _has_mass(spec, geom)
        text = f"body {short_repr(body.name)} has its mass from a mesh, which is not read: give"
        expect(path, not heavy, f"{text} the body an <inertial>")
    pictures = [x for x in spec.textures if x.file or x.content_type or any(x.cubefiles)]
    removed = [*meshes, *spec.meshes, *spec.hfields, *spec.skins, *pictures]
    for part in removed:
        spec.delete(part)
    textures = {texture.name for texture in spec.textures}
    for material in spec.materials:
        material.textures = [name if name in textures else "" for name in material.textures]
    return len(removed)


def _has_mass(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Return whether a geom adds to the mass of a body without <inertial>."""
    low, high = spec.compiler.inertiagrouprange
    enabled = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    mass = geom.density if np.isnan(geom.mass) else geom.mass
    return bool(enabled and low <= geom.group <= high and mass)


def check_couplings(file: File, joints: Sequence[str], weld: Sequence[str]) -> None:
    """Refuse what couples a part of a leg, and nothing welded: equality, tendon or mimic.

    Raises:
        InputError: one line with the parts of the legs that it couples, and the remedy.
    """
    leg_parts, welded = set(joints), set(weld)
    for joint in file.root.findall("joint[mimic]"):
        name = joint.get("name", "")
        text = f"joint {name!r} mimics another one, expected a free hinge"
        expect(file.path, name not in leg_parts, text)
    for body in file.root.iter("body"):
        own = {joint.get("name") for joint in body.findall("joint")}
        parts = {part.get("name", "") for part in body.iter() if part.tag != "default"}
        if own & {*joints}:
            leg_parts |= parts
        elif own and own <= {*weld}:
            welded |= parts
    for tag, coupling in ((of, x) for of in _COUPLINGS for x in file.root.findall(f"{of}/*")):
        references = {
            value
            for element in coupling.iter()
            for name, value in element.attrib.items()
            if name not in ("name", "class")
        }
        coupled = sorted(references & leg_parts)
        open_ = references & welded or coupling.get("active") == "false"
        text = f"<{coupling.tag}> of <{tag}> couples {', '.join(coupled)}, expected legs of "
        text += "free hinges: remove it, or weld a joint of it (hector robot --weld NAME)"
        expect(file.path, not coupled or open_, text)


def _clean_urdf(path: Path, root: ElementTree.Element) -> int:
    """Keep links of numbers and primitives, and free joints. Returns the number of meshes."""
    removed = 0
    _check_tree(path, root)
    for joint in root.findall("joint[@type='floating']"):  # of a world: MuJoCo's trunk floats
        parent = joint.find("parent")
        assert parent is not None
        above = root.findall(f"joint/child[@link='{parent.get('link')}']")
        world = root.find(f"link[@name='{parent.get('link')}']")
        alone = len(root.findall(f"joint/parent[@link='{parent.get('link')}']")) == 1
        if world is not None and alone and not above and world.find("inertial") is None:
            _remove(root, [joint, world])
    for joint in root.findall("joint"):
        _remove(joint, [part for part in joint if part.tag not in _JOINT_PARTS])
    for link in root.findall("link"):
        _remove(link, [x for x in link.findall("collision") if x.find("geometry") is None])
        for part in link.findall("collision"):
            part.attrib.pop("name", None)  # MuJoCo warns of each that comes twice
        meshes = [part for part in link if part.find(".//mesh") is not None]
        removed += len(meshes)
        _remove(link, meshes)
        for part in link.findall("inertial"):
            mass = part.find("mass")
            # `read_published` found numbers in it; MuJoCo refuses more than one
            if mass is None or float(mass.get("value", "0").split()[0]) == 0.0:
                link.remove(part)
    # the root link stays a body, and a link without <inertial> has no mass
    flags = {"fusestatic": "false", "discardvisual": "false", "inertiafromgeom": "false"}
    own = {name: x for part in root.findall("mujoco/compiler") for name, x in part.attrib.items()}
    _remove(root, root.findall("mujoco"))
    options = ElementTree.Element("mujoco")
    ElementTree.SubElement(options, "compiler", own | flags)
    root.insert(0, options)
    return removed


def _check_tree(path: Path, root: ElementTree.Element) -> None:
    """Refuse a URDF whose links and joints are no tree: MuJoCo drops a link that nothing holds."""
    links, joints = ([x.get("name", "") for x in root.findall(tag)] for tag in ("link", "joint"))
    twice = {x for names in (links, joints) for x in names if not x or names.count(x) > 1}
    text = f"names of links and of joints must differ, got {sorted(twice)} empty or twice"
    expect(path, not twice, text)
    above: dict[str, str] = {}
    for joint in root.findall("joint"):
        ends = [x.get("link", "") for tag in ("parent", "child") for x in joint.findall(tag)]
        text = f"joint {joint.get('name')!r} joins {ends}, expected its parent and child, two links"
        expect(path, len(ends) == 2 and {*ends} <= {*links}, text)
        expect(path, ends[1] not in above, f"{text}, and no other joint to have this child")
        above[ends[1]] = ends[0]
    tops = list(links)
    for _ in links:
        tops = [above.get(top, top) for top in tops]
    ring = [link for link, top in zip(links, tops, strict=True) if top in above]
    expect(path, not ring, f"links {listed(ring)} hang in a ring, expected one tree")
    roots = sorted({*tops}, key=tops.count)  # that of the robot is last
    text = f"no joint holds {listed(roots[:-1])}, expected one tree below {listed(roots[-1:])}"
    expect(path, len(roots) < 2, text)
