"""Rebuild a robot from its links in the standard form that all later code reads.

The standard form has a trunk with a free joint; one body per leg joint, leg by leg; torque motors
in that order; a floor; small spheres at the contacts of the soles and a site where the wrench on a
foot acts; and a keyframe of the standing pose.

Contact bits: 1 floor, 2 first leg, 4 second leg, and so on. Soles touch the floor with their
spheres only; trunk and legs collide with the floor, so that falls are detected, and the legs with
each other, except links of which the file excludes all bodies. Friction and stiffness are those of
the floor. A sphere, a cylinder or an ellipsoid that collides becomes a capsule of its length and
radius, or the largest box in it if it is a disc. A body without geoms is drawn as a stick. Of the
file's geoms only the spheres of soles keep their names, and a part of ours has none that is taken.
"""

from collections.abc import Sequence
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.robot.checks import expect, lowest_points
from hector_jax.robot.description import Description, Foot, NamedFoot
from hector_jax.robot.links import Link, Pose, pose_of
from hector_jax.robot.mjcf import TIME_STEP

CONTACT_RADIUS = 0.01  # [m]
SHAPES = tuple(range(int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_BOX) + 1))
SOLVER = {
    "timestep": TIME_STEP,
    "integrator": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "solver": mujoco.mjtSolver.mjSOL_NEWTON,
    "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "iterations": 10,
    "ls_iterations": 10,
}
_SCENE = """<mujoco>
  <compiler angle="radian"/>
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
_ROBOT_GEOM = {"friction": [0.1, 0.005, 0.0001], "solmix": 0.0, "priority": 0}
_SITE = {"size": [0.005] * 3, "group": 4}
_TOUCHES_NOTHING = {"contype": 0, "conaffinity": 0}
_FLOOR_BITS = {"contype": 0, "conaffinity": 1, "condim": 3}
_GREY, _DARK = [0.75, 0.78, 0.82, 1.0], [0.1, 0.1, 0.1, 1.0]
_STICK = 0.02  # [m] radius
_DISC = 0.7  # largest ratio of the two smaller axes of an ellipsoid that is a disc
_SHORTEST = 1e-4  # [m] half length of a capsule; Go1's hips are 1.5 mm apart


class Pieces(NamedTuple):
    """The parts that a robot is rebuilt from."""

    model: mujoco.MjModel  # of the original file
    links: list[Link]  # trunk, then leg by leg
    limits: Sequence[float]  # [N m] of the motors
    angles: Sequence[float]  # [rad] of the legs' joints, standing
    trunk_quat: Float[np.ndarray, "4"]  # standing


def rebuild(description: Description, pieces: Pieces) -> mujoco.MjSpec:
    """Return the spec, with the names of `Description.named_feet` and `Description.standing_key`.

    Raises:
        InputError: one line: the body, site or spheres of a foot are not there.
    """
    spec = mujoco.MjSpec.from_string(_SCENE)
    spec.modelname = description.name
    for name, value in SOLVER.items():
        setattr(spec.option, name, value)
    spec.option.gravity = pieces.model.opt.gravity
    named = {str(name) for foot in description.feet if foot.body is None for name in foot.contacts}
    if "floor" in named:
        spec.geom("floor").name = ""
    bodies = []
    for link in pieces.links:
        bodies.append(_add_link(bodies[link.parent] if bodies else spec.worldbody, pieces, link))
        _add_geoms(description, pieces, len(bodies) - 1, bodies[-1], named)
    if "base" not in description.joints:
        bodies[0].joints[0].name = "base"
    for joint, limit in zip(description.joints, pieces.limits, strict=True):
        span = [-limit, limit]
        limits = {"ctrllimited": True, "ctrlrange": span, "forcelimited": True, "forcerange": span}
        spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, **limits)
    _add_sticks(pieces, bodies)
    _add_excludes(spec, pieces)
    for leg in range(len(description.feet)):
        _add_foot(spec, description, pieces, leg)
    _add_standing(spec, description, pieces)
    return spec


def _add_link(parent: mujoco.MjsBody, pieces: Pieces, link: Link) -> mujoco.MjsBody:
    """Add the body of a link and its joint."""
    model, j, I = pieces.model, link.joint, link.inertia  # noqa: E741
    body = parent.add_body(
        name=link.name,
        pos=link.pose.p,
        quat=link.pose.quat,
        mass=link.mass,
        ipos=link.com,
        fullinertia=[I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]],
        explicitinertial=True,
    )
    if j < 0:
        body.add_freejoint()
        return body
    dof = model.jnt_dofadr[j]
    body.add_joint(
        name=model.joint(j).name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=model.jnt_axis[j],
        limited=True,
        range=model.jnt_range[j],
        solref_limit=model.jnt_solref[j],
        solimp_limit=model.jnt_solimp[j],
        margin=model.jnt_margin[j],
        damping=[model.dof_damping[dof], *model.dof_dampingpoly[dof]],
        stiffness=[model.jnt_stiffness[j], *model.jnt_stiffnesspoly[j]],
        springref=model.qpos_spring[model.jnt_qposadr[j]],
        armature=model.dof_armature[dof],
        frictionloss=model.dof_frictionloss[dof],
    )
    return body


def contact_bits(legs: int, leg: int | None, *, on_floor: bool = True) -> tuple[int, int]:
    """Return contype and conaffinity of a leg, or of the trunk (None), by the number of legs."""
    if leg is None:
        return 0, 1
    others = sum(2 << i for i in range(legs) if i != leg)
    return 2 << leg, others + on_floor


def _add_geoms(
    description: Description, pieces: Pieces, index: int, body: mujoco.MjsBody, named: set[str]
) -> None:
    """Add the primitives of a link: visual ones unchanged, colliding ones as box or capsule."""
    model, link = pieces.model, pieces.links[index]
    count = description.leg_joints
    leg = None if index == 0 else (index - 1) // count
    bits = contact_bits(len(description.feet), leg, on_floor=index % count > 0 or index == 0)
    in_link = np.isin(model.geom_bodyid, list(link.bodies)) & np.isin(model.geom_type, SHAPES)
    geoms, collide = np.flatnonzero(in_link), (model.geom_contype | model.geom_conaffinity) > 0
    for g in map(int, geoms):
        local = pose_of(model.geom_pos[g], model.geom_quat[g])
        pose = link.bodies[int(model.geom_bodyid[g])] @ local
        shape, size = int(model.geom_type[g]), model.geom_size[g]
        name, material = model.geom(g).name, int(model.geom_matid[g])
        rgba = np.array(model.mat_rgba[material] if material >= 0 else model.geom_rgba[g])
        fields: dict = {"group": int(model.geom_group[g]), "rgba": rgba, **_TOUCHES_NOTHING}
        fields["mass"] = 0.0
        if name in named:
            fields |= {**_ROBOT_GEOM, **_FLOOR_BITS}
        elif collide[g]:
            shape, size, pose = _box_or_capsule(shape, size, pose)
            fields |= {**_ROBOT_GEOM, "contype": bits[0], "conaffinity": bits[1], "condim": 1}
            if collide[geoms].all():  # nothing else is drawn
                fields |= {"group": 2, "rgba": [*rgba[:3], 1.0]}
        body.add_geom(
            name=name * (name in named), type=shape, size=size, pos=pose.p, quat=pose.quat, **fields
        )


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


def _add_excludes(spec: mujoco.MjSpec, pieces: Pieces) -> None:
    """Exclude contacts of two links if the file excludes those of all their bodies that collide."""
    model = pieces.model
    excluded = {frozenset(divmod(int(pair), 1 << 16)) for pair in model.exclude_signature}
    collide = set(model.geom_bodyid[(model.geom_contype | model.geom_conaffinity) > 0].tolist())
    for one, other in combinations(pieces.links, 2):
        pairs = set(map(frozenset, product(collide & {*one.bodies}, collide & {*other.bodies})))
        if pairs and pairs <= excluded:
            spec.add_exclude(bodyname1=one.name, bodyname2=other.name)


def _add_sticks(pieces: Pieces, bodies: Sequence) -> None:
    """Draw each body of the file that has no geoms, from its origin to those of its children."""
    model, links = pieces.model, pieces.links
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
    body: mujoco.MjsBody, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float
) -> None:
    if np.linalg.norm(end - start) > radius:
        fields = {**_TOUCHES_NOTHING, "mass": 0.0, "group": 2, "rgba": _GREY}
        body.add_geom(type=_CAPSULE, size=[radius, 0.0, 0.0], fromto=[*start, *end], **fields)


def _standing_data(spec: mujoco.MjSpec, pieces: Pieces) -> mujoco.MjData:
    """Return the robot in the standing pose, with the trunk's origin at the world's."""
    data = mujoco.MjData(spec.compile())
    data.qpos[:] = [0.0, 0.0, 0.0, *pieces.trunk_quat, *pieces.angles]
    mujoco.mj_kinematics(data.model, data)
    return data


def _add_foot(spec: mujoco.MjSpec, description: Description, pieces: Pieces, leg: int) -> None:
    """Add the site and the contact spheres of a foot."""
    foot, path, model = description.feet[leg], description.model, pieces.model
    last, names = (leg + 1) * description.leg_joints, description.named_feet[leg]
    link = pieces.links[last]
    if foot.body is not None:
        poses = {model.body(b).name: pose for b, pose in link.bodies.items()}
        text = f"feet.{description.legs[leg]}.body is {foot.body!r}, expected one that joint "
        text += f"{description.joints[last - 1]!r} moves: {', '.join(poses)}"
        expect(path, foot.body in poses, text)
        _add_foot_by_points(spec, foot, names, pieces, on=(link, poses[foot.body]))
        return
    for name in names.contacts:
        geom = spec.geom(name)
        on_link = geom and geom.parent.name == link.name and geom.type == _SPHERE
        expect(path, on_link, f"no sphere {name!r} on body {link.name!r}")
    sites = [model.site(s) for s in range(model.nsite) if model.site_bodyid[s] in link.bodies]
    sites = [site for site in sites if site.name == names.point]
    expect(path, sites, f"no site {names.point!r} on body {link.name!r}")
    pose = link.bodies[int(sites[0].bodyid[0])]
    point = pose.p + pose.R @ sites[0].pos
    spec.body(link.name).add_site(name=names.point, pos=point, **_SITE)


def _add_foot_by_points(
    spec: mujoco.MjSpec, foot: Foot, names: NamedFoot, pieces: Pieces, *, on: tuple[Link, Pose]
) -> None:
    """Add the site and spheres whose lowest points in the standing pose are the contacts.

    `on` is the link that moves the foot, and the pose in it of the body that the foot names.
    """
    link, pose = on
    contacts = np.array([pose.p + pose.R @ np.array(contact) for contact in foot.contacts])
    data = _standing_data(spec, pieces)
    R, body = data.body(link.name).xmat.reshape(3, 3), spec.body(link.name)
    up = CONTACT_RADIUS * R.T[:, 2]
    for contact in contacts:
        _add_stick(body, contacts.mean(axis=0) + up, contact + up, CONTACT_RADIUS)
    fields = {"mass": 0.0, "group": 2, "rgba": _DARK, **_ROBOT_GEOM, **_FLOOR_BITS}
    for name, contact in zip(names.contacts, contacts, strict=True):
        size = [CONTACT_RADIUS, 0.0, 0.0]
        body.add_geom(name=name, type=_SPHERE, size=size, pos=contact + up, **fields)
    own = foot.point is not None
    point = pose.p + pose.R @ np.array(foot.point) if own else contacts.mean(axis=0)
    body.add_site(name=names.point, pos=point, **_SITE)


def _add_standing(spec: mujoco.MjSpec, description: Description, pieces: Pieces) -> None:
    """Add the keyframe of the standing pose, with the lowest contact on the floor."""
    names = [name for foot in description.named_feet for name in foot.contacts]
    low = min(lowest_points(_standing_data(spec, pieces), names))
    qpos = [0.0, 0.0, -low, *pieces.trunk_quat, *pieces.angles]
    spec.body(pieces.links[0].name).pos = qpos[:3]
    spec.add_key(name=description.standing_key, qpos=qpos)
