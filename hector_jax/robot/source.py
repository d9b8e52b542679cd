"""Convert a published robot file to the standard form that all later code reads.

`build_spec` takes any MJCF or URDF. A model that already has the standard form (defined in
`rebuild`) only loses its meshes, pictures and other unused parts. Any other model is rebuilt from
what MuJoCo compiles: joints outside the legs are fixed, bodies without a joint are merged with
their parents, motors become torque motors, and floor, solver and contacts are set. Each change is
reported in a note.
"""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import did_you_mean
from hector_jax.robot.checks import ON_FLOOR, expect, listed, lowest_points, require
from hector_jax.robot.description import Description
from hector_jax.robot.elements import spec_of
from hector_jax.robot.links import MASSLESS, Link, data_at, links_of
from hector_jax.robot.mjcf import mujoco_errors, read_mjcf
from hector_jax.robot.rebuild import SHAPES, SOLVER, Pieces, contact_bits, rebuild

_JOINT = mujoco.mjtJoint
_MOTOR = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE
_LISTED = 12  # bodies
_ENDLESS = 4.0 * np.pi  # [rad] of a range
UNITS = 'rad in a URDF, degrees in an MJCF without <compiler angle="radian"/>'
_MAX_FRICTION = 0.2  # of the robot's geoms; MuJoCo takes the larger friction of two geoms


class Source(NamedTuple):
    """A robot in the standard form, with the names of `Description.named_feet`."""

    spec: mujoco.MjSpec
    notes: tuple[str, ...]  # one line per change to the file
    file: mujoco.MjData  # the file's own bodies in the standing pose
    links: list[Link]


class _File(NamedTuple):
    description: Description
    spec: mujoco.MjSpec
    model: mujoco.MjModel  # without motors and keyframes, which may not match the model
    trunk: int  # body
    joints: list[int]  # of the legs
    free: int  # joint, or -1


def build_spec(description: Description) -> Source:
    """Read the robot of a description and convert it to the standard form.

    Raises:
        InputError: one line with the value received, the expected one and the remedy.
    """
    path = description.model
    root = read_mjcf(path)
    urdf = root.tag == "robot"
    keyframe = description.standing if isinstance(description.standing, str) else None
    spec, notes = spec_of(path, root, description.joints, keyframe, description.weld)
    file = _read(description, root, spec)
    _set_numbers(file)
    _check_joints(file)
    _check_world(file)
    angles, trunk_quat = _standing(file, urdf)
    limits = _torque_limits(file)
    fixed = {j: angle for j, angle in angles.items() if j not in file.joints}
    links = links_of(file.model, file.trunk, file.joints, fixed)
    _check_links(description, links)
    changes = ["a URDF, with neither motors nor a floor"] * urdf + _changes(file, limits, links)
    options = [name for name, value in SOLVER.items() if getattr(spec.option, name) != value]
    for name in options:
        setattr(spec.option, name, SOLVER[name])
    notes += [f"option {listed(options)} set"] * bool(options)
    standing = data_at(file.model, angles)
    if not changes:
        return Source(file.spec, (*notes, *_lower_keyframe(file)), standing, links)
    leg_angles = [angles[joint] for joint in file.joints]
    spec = rebuild(description, Pieces(file.model, links, limits, leg_angles, trunk_quat))
    return Source(spec, (*notes, *changes), standing, links)


def compile_bare(path: Path, root: ElementTree.Element, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a file without its motors and keyframes, which may not match the model.

    Raises:
        InputError: MuJoCo's error in one line.
    """
    bare = spec.copy()
    for part in (*bare.actuators, *bare.keys):
        bare.delete(part)
    # welded bodies may have no mass; `_check_links` checks the masses of the merged links
    bare.compiler.boundmass = MASSLESS
    bare.compiler.boundinertia = 1e-12
    with mujoco_errors(path, root):
        return bare.compile()


def _read(description: Description, root: ElementTree.Element, spec: mujoco.MjSpec) -> _File:
    """Compile a file and find the robot in it."""
    path = description.model
    model = compile_bare(path, root, spec)
    names = [model.joint(j).name for j in range(model.njnt)]
    for joint in (*description.joints, *description.weld):
        require(path, "joint", joint, names)
    for motor in _motors(spec):
        text = f"actuator {motor.name!r} drives no joint {motor.target!r}"
        expect(path, motor.target in names, text + did_you_mean(motor.target, names))
    free = [j for j in range(model.njnt) if model.jnt_type[j] == _JOINT.mjJNT_FREE]
    text = f"{len(free)} free joints, expected exactly one, of the trunk; joints: {listed(names)}"
    expect(path, len(free) < 2, text)
    fixed = [names[j] for j in free if names[j] in description.weld]
    expect(path, not fixed, f"weld names {listed(fixed)}, the free joint, expected hinges")
    joints = [names.index(joint) for joint in description.joints]
    first_body = model.jnt_bodyid[joints[0]]
    trunk = int(model.jnt_bodyid[free[0]] if free else model.body_rootid[first_body])
    return _File(description, spec, model, trunk, joints, free[0] if free else -1)


def without_limits(description: Description) -> tuple[list[str], list[str]]:
    """Return the legs' joints that have no range, and those that have no torque limit, in a file.

    Raises:
        InputError: as `build_spec`.
    """
    root = read_mjcf(description.model)
    spec, _ = spec_of(description.model, root, description.joints, None, description.weld)
    file = _read(description, root, spec)
    stated = _stated_limits(file)
    passive = [name for name, limits in stated.items() if not min(limits, default=0.0) > 0.0]
    return _without_range(file), passive


def _set_numbers(file: _File) -> None:
    """Set the numbers of the joints that the description has and the model has not."""
    description, model, legs = file.description, file.model, len(file.description.feet)
    if description.armature:
        model.dof_armature[model.jnt_dofadr[file.joints]] = legs * description.armature
    if description.range:
        without = _without_range(file)
        for j, span in zip(file.joints, legs * description.range, strict=True):
            if model.joint(j).name in without:
                model.jnt_limited[j], model.jnt_range[j] = True, span


def _without_range(file: _File) -> list[str]:
    """Return the joints of the legs that turn without end, unless all are wheels."""
    description, model = file.description, file.model
    endless = [
        model.joint(j).name
        for j in file.joints
        if not model.jnt_limited[j] or np.ptp(model.jnt_range[j]) > _ENDLESS
    ]
    last = description.joints[description.leg_joints - 1 :: description.leg_joints]
    limited = [name for name in endless if model.jnt_limited[model.joint(name).id]]
    text = f"joints {listed(endless)} turn without end, as wheels do, expected feet: fix them"
    text += f"; or the ranges of {listed(limited)} have another unit: {UNITS}" * bool(limited)
    expect(description.model, not endless or not set(endless) <= set(last), text)
    return [name for name in endless if name not in limited]


def _check_joints(file: _File) -> None:
    """Check that leg joints are hinges with a range, one per body, and all others are welded."""
    description, model = file.description, file.model
    path, weld = description.model, description.weld
    extra = [
        model.joint(j).name or f"of body {model.body(model.jnt_bodyid[j]).name!r}"
        for j in range(model.njnt)
        if j not in (*file.joints, file.free) and model.joint(j).name not in weld
    ]
    text = f"joints {listed(extra)} are of no leg: add them to weld or remove them"
    expect(path, not extra, text)
    without = _without_range(file)
    text = f"joint {nor(without)}, expected limits (in a URDF: revolute, lower and upper)"
    expect(path, not without, text.format("range"))
    for j in file.joints:
        body, joint = int(model.jnt_bodyid[j]), f"joint {model.joint(j).name!r}"
        expect(path, model.jnt_type[j] == _JOINT.mjJNT_HINGE, f"{joint} is not a hinge")
        text = f"{joint} is not below the trunk, body {model.body(file.trunk).name!r}"
        expect(path, model.body_rootid[body] == file.trunk and body != file.trunk, text)
        text = f"{joint} shares body {model.body(body).name!r} with another joint"
        expect(path, model.body_jntnum[body] == 1, f"{text}, expected a body for each")


def _check_world(file: _File) -> None:
    """Check that gravity points downwards and that the floor, if any, is level at z = 0."""
    path, model = file.description.model, file.model
    gravity = model.opt.gravity
    downwards = np.all(gravity[:2] == 0.0) and gravity[2] < 0.0
    expect(path, downwards, f"gravity is {gravity}, expected 0 0 and a negative number")
    for g in _world_geoms(file):
        plane = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE
        name, position = model.geom(g).name or repr(g), model.geom_pos[g]
        expect(path, plane, f"geom {name} of the world is terrain, expected a plane at z = 0")
        level = abs(position[2]) <= 1e-6 and np.allclose(model.geom_quat[g][1:3], 0.0)
        expect(path, level, f"floor {name} is at {position}, expected level at z = 0")


def _world_geoms(file: _File) -> list[int]:
    """Return the geoms that collide and do not belong to the robot."""
    model = file.model
    collide = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    return [int(g) for g in collide if model.body_rootid[model.geom_bodyid[g]] != file.trunk]


def _standing(file: _File, urdf: bool) -> tuple[dict[int, float], Float[np.ndarray, "4"]]:
    """Return each hinge's and slide's standing angle [rad] by joint, and the trunk's quaternion."""
    description, model = file.description, file.model
    path, pose, trunk_quat = description.model, description.standing, np.array([1.0, 0.0, 0.0, 0.0])
    names = (*description.joints, *description.weld)
    hinges = {name: model.joint(name).id for name in names}
    if not isinstance(pose, str):
        for name, _ in pose:
            require(path, "joint", name, names)
        angles = dict.fromkeys(hinges.values(), 0.0)
        return angles | {hinges[name]: angle for name, angle in pose}, trunk_quat
    keys = [key for key in file.spec.keys if key.name == pose]
    hint = "; a URDF has none" if urdf else ""
    text = f"no keyframe {pose!r}{hint}; expected one, or standing = {{ joint = angle }}"
    expect(path, keys, text)
    qpos = np.array(keys[0].qpos)
    text = f"keyframe {pose!r} has {len(qpos)} numbers, expected {model.nq}"
    expect(path, len(qpos) == model.nq, text)
    angles = {j: float(qpos[model.jnt_qposadr[j]]) for j in hinges.values()}
    if file.free >= 0:
        start = model.jnt_qposadr[file.free]
        trunk_quat = qpos[start + 3 : start + 7]
    return angles, trunk_quat


def _torque_limits(file: _File) -> list[float]:
    """Return the smallest limit of each leg joint's torque [N m] that the file states.

    Limits are stated for the forces of its actuators, for the control of a motor and for the joint
    itself (effort in a URDF).
    """
    torques, description = _stated_limits(file), file.description
    if description.torque:
        for name, torque in zip(torques, len(description.feet) * description.torque, strict=True):
            if not min(torques[name], default=0.0) > 0.0:
                torques[name] = [torque]
    passive = [name for name, limits in torques.items() if not min(limits, default=0.0) > 0.0]
    text = f"joint {nor(passive)}, expected forcerange or ctrlrange of its motor, "
    text += (
        "actuatorfrcrange of the joint, or effort in a URDF; a joint that is to have no motor is "
    )
    text += "named in joints.weld and not among those of its leg"
    expect(file.description.model, not passive, text.format("torque limit"))
    return [float(min(limits)) for limits in torques.values()]


def _stated_limits(file: _File) -> dict[str, list[float]]:
    """Return all limits of each leg joint's torque that the file states [N m]."""
    model, torques = file.model, {}
    for joint, name in zip(file.joints, file.description.joints, strict=True):
        limited = model.jnt_actfrclimited[joint]
        torques[name] = [np.abs(model.jnt_actfrcrange[joint]).min()] if limited else []
    for motor in _motors(file.spec):
        if (name := motor.target) in torques:
            gear = abs(motor.gear[0])
            if _limited(motor.forcelimited, motor.forcerange):
                torques[name].append(gear * np.abs(motor.forcerange).min())
            if _is_motor(motor) and _limited(motor.ctrllimited, motor.ctrlrange):
                torques[name].append(gear * abs(motor.gainprm[0]) * np.abs(motor.ctrlrange).min())
    return torques


def nor(names: Sequence[str]) -> str:
    """Return names, the first one with a gap for what it has not.

    >>> nor(["a", "b", "c"]).format("range")
    "'a' has no range, nor have b, c"
    """
    first, others = repr(next(iter(names), "")), ", ".join(names[1:])
    return f"{first} has no {{}}" + f", nor have {others}" * bool(others)


def _motors(spec: mujoco.MjSpec) -> list:
    joint_types = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    return [motor for motor in spec.actuators if motor.trntype in joint_types]


def _limited(flag: mujoco.mjtLimited, span: Float[np.ndarray, "2"]) -> bool:
    automatic = flag == mujoco.mjtLimited.mjLIMITED_AUTO
    return bool(span[0] < span[1]) if automatic else bool(flag)


def _is_motor(motor: mujoco.MjsActuator) -> bool:
    """Return whether the control of an actuator is a force."""
    return (motor.gaintype, motor.biastype, motor.dyntype) == _MOTOR


def _changes(file: _File, limits: Sequence[float], links: Sequence[Link]) -> list[str]:
    """Return one line per reason to rebuild a robot; none if it has the standard form."""
    description, model = file.description, file.model
    inside = [b for b in range(1, model.nbody) if model.body_rootid[b] == file.trunk]
    beside = [
        model.body(b).name for b in {*range(1, model.nbody)} - {*inside} if model.body_mass[b]
    ]
    static = [model.body(b).name for b in inside if not model.body_jntnum[b] and b != file.trunk]
    more = f" and {len(static) - _LISTED} more" if len(static) > _LISTED else ""
    order = [file.free, *file.joints] == list(range(model.njnt))
    at_origin = not np.any(model.jnt_pos) and not np.any(model.qpos0[7:])
    floor, motors = _world_geoms(file), "replace the actuators" if file.spec.actuators else "added"
    bits = [(model.geom_contype[g], model.geom_conaffinity[g]) for g in floor]
    lines = (
        ("free joint added to the trunk", file.free < 0),
        (f"fixed: {listed(description.weld)}", description.weld),
        (f"made one with their parents: {listed(static[:_LISTED])}{more}", static),
        (f"left out, which no joint holds: {listed(beside)}", beside),
        ("joints put in order, leg by leg", file.free >= 0 and not (order or description.weld)),
        ("frames of the joints put into their anchors", not at_origin and order),
        (f"torque motors {motors}", not _motors_match(file, limits)),
        ("floor added" if not floor else "floor replaced", bits != [(1, 0)]),
        ("armature of the joints set", description.armature),
        ("ranges or torque limits of the joints set", description.range or description.torque),
        ("contacts placed on the soles", any(f.body is not None for f in description.feet)),
        ("contact bits, friction and shapes set", not _contacts_match(file, links)),
        ("standing pose by angles", not isinstance(description.standing, str)),
    )
    return [line for line, needed in lines if needed]


def _motors_match(file: _File, limits: Sequence[float]) -> bool:
    """Return whether the actuators are torque motors in the order of the joints."""
    motors = list(file.spec.actuators)
    return [motor.target for motor in motors] == list(file.description.joints) and all(
        _is_motor(motor)
        and motor.gainprm[0] == motor.gear[0] == 1.0
        and _limited(motor.ctrllimited, motor.ctrlrange)
        and tuple(motor.ctrlrange) == (-limit, limit)
        and tuple(motor.forcerange) in ((0.0, 0.0), (-limit, limit))
        for motor, limit in zip(motors, limits, strict=True)
    )


def _contacts_match(file: _File, links: Sequence[Link]) -> bool:
    """Return whether the robot's geoms have the contact settings of the standard form."""
    model, feet = file.model, file.description.feet
    link_of = {body: index for index, link in enumerate(links) for body in link.bodies}
    contacts = {name for foot in feet for name in foot.contacts}
    for g in map(int, np.flatnonzero(model.geom_contype | model.geom_conaffinity)):
        link = link_of.get(int(model.geom_bodyid[g]))
        if link is None:  # a geom of the world
            continue
        leg = (link - 1) // file.description.leg_joints if link else None
        contype, conaffinity = contact_bits(len(feet), leg)
        if (
            model.geom_contype[g] & ~contype
            or model.geom_conaffinity[g] & ~conaffinity
            or model.geom_solmix[g]
            or model.geom_priority[g]
            or model.geom_condim[g] != (3 if model.geom(g).name in contacts else 1)
            or model.geom_friction[g, 0] > _MAX_FRICTION
            or model.geom_type[g] not in SHAPES
        ):
            return False
    return True


def _lower_keyframe(file: _File) -> list[str]:
    """Lower the keyframe in place so that level soles are on the floor. Returns a note if so."""
    data = mujoco.MjData(file.model)
    key = next(key for key in file.spec.keys if key.name == file.description.standing)
    data.qpos[:] = key.qpos
    mujoco.mj_kinematics(file.model, data)
    contacts = [name for foot in file.description.named_feet for name in foot.contacts]
    if not all(map(file.spec.geom, contacts)):  # `checks.check_model` reports it
        return []
    heights = lowest_points(data, contacts)
    low = min(heights)
    if abs(low) <= ON_FLOOR or max(heights) - low > ON_FLOOR:
        return []
    data.qpos[2] -= low
    key.qpos = data.qpos
    return [f"keyframe {key.name!r} lowered by {low:.4g} m to stand on the floor"]


def _check_links(description: Description, links: Sequence[Link]) -> None:
    """Check that each leg is a chain from the trunk down and that each link has a mass."""
    path, count = description.model, description.leg_joints
    for index, link in enumerate(links):
        text = f"body {link.name!r} moves and has no mass: give it an <inertial>"
        expect(path, link.mass > 0.0, text)
        if index:
            parent = 0 if index % count == 1 else index - 1
            text = f"joint {description.joints[index - 1]!r} is on body {links[link.parent].name!r}"
            text += f", expected {links[parent].name!r}: name each leg from the trunk down"
            expect(path, link.parent == parent, text)
