"""Write the model of a robot in the standard form that `robot.checks` defines, from its links.

Links of which the file excludes all bodies do not collide. A sphere, a cylinder or an ellipsoid
that collides becomes a capsule of its length and radius, or the largest box in it if it is a disc.
A body without geoms is drawn as a stick. Of the file's names only those of bodies and joints stay.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import expect
from hector_jax.importing.draft import Draft, PublishedFoot
from hector_jax.importing.links import Link, Pose, pose_of
from hector_jax.robot.checks import SHAPES, contact_bits

_RADIUS = 0.01  # [m] of the spheres of soles
_SCENE = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast" solver="Newton" cone="pyramidal"
          iterations="10" ls_iterations="10"/>
  <visual>
    <global offwidth="1280" offheight="720"/>
    <headlight ambient="0.4 0.4 0.4"/>
  </visual>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.86 0.90 0.94" rgb2="0.36 0.47 0.62"
             width="256" height="1536"/>
  </asset>
  <worldbody>
    <light pos="-1 -1.4 3.4" dir="0.28 0.4 -0.87" type="directional"/>
    <geom name="floor" type="plane" size="0 0 0.05" rgba="0.6 0.63 0.67 1" contype="1"
          conaffinity="0" friction="0.8 0.005 0.0001" solref="0.01 1" solmix="1"/>
  </worldbody>
</mujoco>"""
_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX = SHAPES
_ROBOT_GEOM = {"friction": [0.1, 0.005, 0.0001], "solmix": 0, "mass": 0}
_FLOOR_BITS = {"contype": 0, "conaffinity": 1, "condim": 3}
_DRAWN = {"contype": 0, "conaffinity": 0, "mass": 0}
_GREY, _DARK = [0.75, 0.78, 0.82, 1], [0.1, 0.1, 0.1, 1]
_STICK = 0.02  # [m] radius
_DISC = 0.7  # largest ratio of the two smaller axes of an ellipsoid that is a disc
_SHORTEST = 1e-4  # [m] half length of a capsule; Go1's hips are 1.5 mm apart


class Pieces(NamedTuple):
    """The parts that a robot is rebuilt from."""

    file: mujoco.MjData  # the file's own bodies in the standing pose, the trunk upright
    links: list[Link]  # trunk, then leg by leg
    limits: Sequence[float]  # [N m] of the motors
    trunk_quat: Float[np.ndarray, "4"]  # standing

    def standing(self, link: Link) -> Pose:
        """Return the pose of a link in the world, standing, the trunk's origin at the world's."""
        frames = []
        for one in (self.links[0], link):
            body, moves = next(iter(one.bodies)), one.joint >= 0
            place = self.file.xanchor[one.joint] if moves else self.file.xpos[body]
            frames.append(Pose(self.file.xmat[body].reshape(3, 3), place))
        return pose_of(np.zeros(3), self.trunk_quat) @ frames[0].to(frames[1])


def rebuild(path: Path, draft: Draft, pieces: Pieces, name: str) -> tuple[str, dict[str, Any]]:
    """Return the MJCF of a robot in the standard form, and the section [feet] of its TOML.

    Args:
        path: of the file, for messages.
        draft: names of joints and feet.
        pieces: all numbers.
        name: of the robot.

    Raises:
        InputError: one line: the body, site or spheres of a foot are not there.
    """
    root = ElementTree.fromstring(_SCENE)
    root.set("model", name)
    world, option = root.find("worldbody"), root.find("option")
    assert world is not None
    assert option is not None
    if not np.array_equal(gravity := pieces.file.model.opt.gravity, mujoco.MjOption().gravity):
        option.set("gravity", _text(gravity))
    contact, motors, keys = (_add(root, tag) for tag in ("contact", "actuator", "keyframe"))
    count, bodies = draft.count, []
    for index, link in enumerate(pieces.links):
        bodies.append(_add_link(bodies[link.parent] if bodies else world, pieces, link))
        leg = None if index == 0 else (index - 1) // count
        bits = contact_bits(len(draft.legs), leg, on_floor=index % count > 0 or index == 0)
        _add_geoms(pieces, index, bodies[-1], bits)
    _add_sticks(pieces, bodies)
    heights, feet = [], {}
    for leg, side in enumerate(draft.legs):
        foot = draft.feet[side]
        last = (leg + 1) * count
        link = pieces.links[last]
        text = f"feet.{side}.body is {foot.body!r}, expected one that joint "
        text += f"{draft.all_joints[last - 1]!r} moves: "
        contacts, point = _sole(path, foot, pieces, link, text)
        heights += (pieces.standing(link).p + contacts @ pieces.standing(link).R.T)[:, 2].tolist()
        feet[side] = _add_foot(bodies[last], side, contacts, point, pieces.standing(link).R[2])
    for joint, limit in zip(draft.all_joints, pieces.limits, strict=True):
        span = [-limit, limit]
        _add(motors, "motor", name=joint, joint=joint, ctrlrange=span, forcerange=span)
    _add_excludes(contact, pieces)
    model, joints = pieces.file.model, [link.joint for link in pieces.links[1:]]
    angles = pieces.file.qpos[model.jnt_qposadr[joints]]
    place = [0.0, 0.0, -min(heights)]
    bodies[0].set("pos", _text(place))
    _add(keys, "key", name="standing", qpos=[*place, *pieces.trunk_quat, *angles])
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n", feet


def _add(parent: ElementTree.Element, tag: str, **values: Any) -> ElementTree.Element:
    texts = {name: _text(value) for name, value in values.items()}
    return ElementTree.SubElement(parent, tag, texts)


def _text(value: Any) -> str:
    """Return numbers with all their digits, or a text as it is."""
    if isinstance(value, str):
        return value
    return " ".join(repr(float(x) + 0.0).removesuffix(".0") for x in np.ravel(value))


def _add_link(parent: ElementTree.Element, pieces: Pieces, link: Link) -> ElementTree.Element:
    """Add the body of a link and its joint."""
    model, j, I = pieces.file.model, link.joint, link.inertia  # noqa: E741
    body = _add(parent, "body", name=link.name, pos=link.pose.p, quat=link.pose.quat)
    moments = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
    _add(body, "inertial", pos=link.com, mass=link.mass, fullinertia=moments)
    if j < 0:
        _add(body, "freejoint")
        return body
    dof = model.jnt_dofadr[j]
    _add(
        body,
        "joint",
        name=model.joint(j).name,
        axis=model.jnt_axis[j],
        range=model.jnt_range[j],
        solreflimit=model.jnt_solref[j],
        solimplimit=model.jnt_solimp[j],
        margin=model.jnt_margin[j],
        damping=[model.dof_damping[dof], *model.dof_dampingpoly[dof]],
        stiffness=[model.jnt_stiffness[j], *model.jnt_stiffnesspoly[j]],
        springref=model.qpos_spring[model.jnt_qposadr[j]],
        armature=model.dof_armature[dof],
        frictionloss=model.dof_frictionloss[dof],
    )
    return body


def _add_geoms(
    pieces: Pieces, index: int, body: ElementTree.Element, bits: tuple[int, int]
) -> None:
    """Add the primitives of a link: visual ones unchanged, colliding ones as box or capsule."""
    model, link = pieces.file.model, pieces.links[index]
    in_link = np.isin(model.geom_bodyid, list(link.bodies)) & np.isin(model.geom_type, SHAPES)
    geoms, collide = np.flatnonzero(in_link), (model.geom_contype | model.geom_conaffinity) > 0
    for g in map(int, geoms):
        local = pose_of(model.geom_pos[g], model.geom_quat[g])
        pose = link.bodies[int(model.geom_bodyid[g])] @ local
        shape, size = int(model.geom_type[g]), model.geom_size[g]
        material = int(model.geom_matid[g])
        rgba = (model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]).round(3)
        fields: dict = {"group": int(model.geom_group[g]), "rgba": rgba, **_DRAWN}
        if collide[g]:
            shape, size, pose = _box_or_capsule(shape, size, pose)
            fields |= {**_ROBOT_GEOM, "contype": bits[0], "conaffinity": bits[1], "condim": 1}
            if collide[geoms].all():  # nothing else is drawn
                fields |= {"group": 2, "rgba": [*rgba[:3], 1.0]}
        kind = mujoco.mjtGeom(shape).name.removeprefix("mjGEOM_").lower()
        _add(body, "geom", type=kind, size=size, pos=pose.p, quat=pose.quat, **fields)


def _box_or_capsule(
    shape: int, size: Float[np.ndarray, "3"], pose: Pose
) -> tuple[int, Float[np.ndarray, "3"], Pose]:
    """Return a box or capsule unchanged, and of any other primitive a capsule or a disc's box."""
    if shape in (_BOX, _CAPSULE):
        return shape, size, pose
    radius, half = size[0], 0.0
    if shape == _CYLINDER:
        half = size[1] - radius
        if half < 0.0:
            return _BOX, np.array([radius, radius, size[1]]) * [*[np.sqrt(0.5)] * 2, 1.0], pose
    elif shape == _ELLIPSOID:
        longest, (thin, radius, _) = int(np.argmax(size)), np.sort(size)
        half = size[longest] - radius
        if thin < _DISC * radius:
            return _BOX, size / np.sqrt(3.0), pose
        # permute the axes so that z becomes the longest one
        pose = pose @ Pose(np.roll(np.eye(3), longest + 1, axis=0))
    return _CAPSULE, np.array([radius, max(half, _SHORTEST), 0.0]), pose


def _add_excludes(contact: ElementTree.Element, pieces: Pieces) -> None:
    """Exclude contacts of two links if the file excludes those of all their bodies that collide."""
    model = pieces.file.model
    excluded = {frozenset(divmod(int(pair), 1 << 16)) for pair in model.exclude_signature}
    collide = set(model.geom_bodyid[(model.geom_contype | model.geom_conaffinity) > 0].tolist())
    for one, other in combinations(pieces.links, 2):
        pairs = set(map(frozenset, product(collide & {*one.bodies}, collide & {*other.bodies})))
        if pairs and pairs <= excluded:
            _add(contact, "exclude", body1=one.name, body2=other.name)


def _add_sticks(pieces: Pieces, bodies: Sequence) -> None:
    """Draw each body of the file that has no geoms, from its origin to those of its children."""
    model, links = pieces.file.model, pieces.links
    drawn = model.geom_bodyid[np.isin(model.geom_type, SHAPES)]
    for index, link in enumerate(links):
        ends = [(int(model.body_parentid[b]), pose.p) for b, pose in link.bodies.items()]
        children = [child for child in links[1:] if child.parent == index]
        parents = model.body_parentid[model.jnt_bodyid[[child.joint for child in children]]]
        ends += [(int(b), child.pose.p) for b, child in zip(parents, children, strict=True)]
        for parent, end in ends:
            if parent in link.bodies and parent not in drawn:
                _add_stick(bodies[index], link.bodies[parent].p, end, _STICK)


def _add_stick(
    body: ElementTree.Element,
    start: Float[np.ndarray, "3"],
    end: Float[np.ndarray, "3"],
    radius: float,
) -> None:
    if np.linalg.norm(end - start) > radius:
        fields = {**_DRAWN, "group": 2, "rgba": _GREY}
        _add(body, "geom", type="capsule", size=radius, fromto=[*start, *end], **fields)


def _sole(
    path: Path, foot: PublishedFoot, pieces: Pieces, link: Link, expected: str
) -> tuple[Float[np.ndarray, "c 3"], Float[np.ndarray, "3"]]:
    """Return contacts of a foot, and where wrenches act, in the frame of its link [m]."""
    model = pieces.file.model
    if foot.body is not None:
        names = {model.body(b).name: pose for b, pose in link.bodies.items()}
        expect(path, foot.body in names, expected + ", ".join(names))
        R, p = names[foot.body]
        contacts = p + np.array(foot.places, float) @ R.T
        return contacts, contacts.mean(axis=0) if foot.point is None else p + R @ foot.point
    spheres = {
        model.geom(g).name: link.bodies[b].p
        + link.bodies[b].R @ model.geom_pos[g]
        - model.geom_size[g, 0] * pieces.standing(link).R[2]
        for g, b in enumerate(model.geom_bodyid.tolist())
        if b in link.bodies and model.geom_type[g] == _SPHERE
    }
    sites = {
        model.site(s).name: link.bodies[b].p + link.bodies[b].R @ model.site_pos[s]
        for s, b in enumerate(model.site_bodyid.tolist())
        if b in link.bodies
    }
    for name in foot.places:
        expect(path, name in spheres, f"no sphere {name!r} on body {link.name!r}")
    expect(path, foot.point in sites, f"no site {foot.point!r} on body {link.name!r}")
    return np.array([spheres[str(name)] for name in foot.places]), sites[str(foot.point)]


def _add_foot(
    body: ElementTree.Element,
    leg: str,
    contacts: Float[np.ndarray, "c 3"],
    point: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
) -> dict[str, Any]:
    """Add a site, and spheres whose lowest points, standing, are the contacts; return its TOML."""
    places = contacts + _RADIUS * up
    for place in places:
        _add_stick(body, places.mean(axis=0), place, _RADIUS)
    fields = {"size": _RADIUS, **_ROBOT_GEOM, **_FLOOR_BITS, "group": 2, "rgba": _DARK}
    names = [f"{leg}_contact_{i}" for i in range(len(places))]
    for name, place in zip(names, places, strict=True):
        _add(body, "geom", name=name, type="sphere", pos=place, **fields)
    _add(body, "site", name=f"{leg}_point", pos=point, size=0.005, group=4)
    return {"point": f"{leg}_point", "contacts": names}
