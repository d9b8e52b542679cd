"""Convert a published file to the standard form that `robot.checks` defines.

A robot is rebuilt from what MuJoCo compiles of its file: joints outside the legs are fixed, bodies
without a joint are merged with their parents, motors become torque motors, and floor, solver,
contacts and standing pose are set (`rebuild`). Each change is told in a note.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import did_you_mean, expect, listed, require
from hector_jax.importing.draft import Draft
from hector_jax.importing.elements import File, check_couplings
from hector_jax.importing.links import Link, links_of, subtree
from hector_jax.importing.rebuild import Pieces, rebuild
from hector_jax.robot.poses import data_at

_JOINT = mujoco.mjtJoint
_MOTOR = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE
_LISTED = 12  # bodies
_ENDLESS = 4.0 * np.pi  # [rad] of a range
UNITS = 'rad in a URDF, degrees in an MJCF without <compiler angle="radian"/>'
_HALF_TURN = 3.14  # [rad]: range of a joint that has none
_TORQUE = 0.6  # torque limit of a joint that has none, by weight and length of a leg; HECTOR 0.6
_ARMATURE = 2e-4  # [s^2] times the torque limit: HECTOR's is 2.4e-4, Unitree's robots 1e-4 to 4e-4


class Standard(NamedTuple):
    """A robot in the standard form."""

    text: str  # MJCF
    feet: dict[str, Any]  # section of the TOML
    notes: tuple[str, ...]  # one line per change to the file
    file: mujoco.MjData  # the file's own bodies in the standing pose
    links: list[Link]


class _Parts(NamedTuple):
    """The robot in a file."""

    file: File
    draft: Draft
    trunk: int  # body
    joints: list[int]  # of the legs
    free: int  # joint, or -1


def to_standard(file: File, draft: Draft, name: str) -> Standard:
    """Convert a file with the names and numbers of a draft, all of which it has.

    Raises:
        InputError: one line with the value received, the expected one and the remedy.
    """
    check_couplings(file, draft.all_joints, draft.joints.weld)
    parts, model = _parts(file, draft), file.model
    legs = len(draft.legs)
    if draft.joints.armature:
        model.dof_armature[model.jnt_dofadr[parts.joints]] = legs * draft.joints.armature
    without, limits = _without_range(parts), _stated_limits(parts)
    for j, span in zip(parts.joints, legs * draft.joints.range, strict=False):
        if model.joint(j).name in without:
            model.jnt_limited[j], model.jnt_range[j] = True, span
    for joint, torque in zip(limits, legs * draft.joints.torque, strict=False):
        limits[joint] = limits[joint] or torque
    _check_joints(parts)
    _check_world(parts)
    angles, trunk_quat = _standing(parts)
    fixed = {j: angle for j, angle in angles.items() if j not in parts.joints}
    links = links_of(model, parts.trunk, parts.joints, fixed)
    _check_links(parts, links)
    standing = data_at(model, angles)
    pieces = Pieces(standing, links, [*limits.values()], trunk_quat)
    text, feet = rebuild(file.path, draft, pieces, name)
    return Standard(text, feet, (*file.notes, *_changes(parts)), standing, links)


def guessed_numbers(file: File, draft: Draft) -> tuple[dict[str, Any], list[str]]:
    """Return the numbers of a leg's joints that a file lacks, by rules, as keys of [joints].

    Returns:
        Range and torque, of which the file has none for some joint, and armature; a line for each
        guess.
    """
    parts, count, joints, lines = _parts(file, draft), draft.count, {}, []
    model = file.model
    if (without := _without_range(parts)) and not draft.joints.range:
        joints["range"] = [[-_HALF_TURN, _HALF_TURN]] * count
        lines.append(
            f"joint {_nor(without).format('range')}: half a turn to both sides is a guess; "
            "write joints.range, or limits into the model"
        )
    limits = _stated_limits(parts)
    if (without := [name for name, limit in limits.items() if not limit]) and (
        not draft.joints.torque
    ):
        data, mass = data_at(model), float(model.body_subtreemass[parts.trunk])
        first, last = parts.joints[0], parts.joints[count - 1]
        end = data.xipos[subtree(model, int(model.jnt_bodyid[last])), 2].min()
        length = float(data.xanchor[first][2] - end)
        torque = short(_TORQUE * mass * float(np.linalg.norm(model.opt.gravity)) * length)
        joints["torque"] = [torque] * count
        lines.append(
            f"joint {_nor(without).format('torque limit')}: {torque:g} N m, {_TORQUE} times "
            "weight and length of a leg, is a guess; write joints.torque, or limits of motors "
            "(effort in a URDF) into the model; a joint without a motor belongs into joints.weld"
        )
    armature = model.dof_armature[model.jnt_dofadr[parts.joints[:count]]]
    if not draft.joints.armature and not armature.all():
        torques = joints.get("torque") or draft.joints.torque or [0.0] * count
        rule = [_ARMATURE * (a or b) for a, b in zip(limits.values(), torques, strict=False)]
        joints["armature"] = [short(x) for x in np.where(armature, armature, rule)]
    return joints, lines


def short(x: float) -> float:
    """Return a number rounded to three digits."""
    return float(f"{x:.3g}")


def _parts(file: File, draft: Draft) -> _Parts:
    """Find the robot in a file."""
    path, model, names = file.path, file.model, file.joints
    for joint in (*draft.all_joints, *draft.joints.weld):
        require(path, "joint", joint, names)
    for motor in _motors(file):
        text = f"actuator {motor.name!r} drives no joint {motor.target!r}"
        expect(path, motor.target in names, text + did_you_mean(motor.target, names))
    free = [j for j in range(model.njnt) if model.jnt_type[j] == _JOINT.mjJNT_FREE]
    text = f"{len(free)} free joints, expected exactly one, of the trunk; joints: {listed(names)}"
    expect(path, len(free) < 2, text)
    fixed = [names[j] for j in free if names[j] in draft.joints.weld]
    expect(path, not fixed, f"weld names {listed(fixed)}, the free joint, expected hinges")
    joints = [names.index(joint) for joint in draft.all_joints]
    first_body = model.jnt_bodyid[joints[0]]
    trunk = int(model.jnt_bodyid[free[0]] if free else model.body_rootid[first_body])
    return _Parts(file, draft, trunk, joints, free[0] if free else -1)


def _without_range(parts: _Parts) -> list[str]:
    """Return the joints of the legs that turn without end, unless all are wheels."""
    draft, model, names = parts.draft, parts.file.model, parts.file.joints
    endless = [
        names[j]
        for j in parts.joints
        if not model.jnt_limited[j] or np.ptp(model.jnt_range[j]) > _ENDLESS
    ]
    last = {joints[-1] for joints in draft.joints.legs.values()}
    limited = [name for name in endless if model.jnt_limited[names.index(name)]]
    text = f"joints {listed(endless)} turn without end, as wheels do, expected feet: fix them"
    text += f"; or the ranges of {listed(limited)} have another unit: {UNITS}" * bool(limited)
    expect(parts.file.path, not endless or not set(endless) <= last, text)
    return [name for name in endless if name not in limited]


def _check_joints(parts: _Parts) -> None:
    """Check that leg joints are hinges, one per body, and all others are welded."""
    model, names, path = parts.file.model, parts.file.joints, parts.file.path
    others = [j for j in range(model.njnt) if j not in (*parts.joints, parts.free)]
    extra = [names[j] for j in others if names[j] not in parts.draft.joints.weld]
    text = f"joints {listed(extra)} are of no leg: add them to weld or remove them"
    expect(path, not extra, text)
    for j in parts.joints:
        body, joint = int(model.jnt_bodyid[j]), f"joint {names[j]!r}"
        expect(path, model.jnt_type[j] == _JOINT.mjJNT_HINGE, f"{joint} is not a hinge")
        text = f"{joint} is not below the trunk, body {model.body(parts.trunk).name!r}"
        expect(path, model.body_rootid[body] == parts.trunk and body != parts.trunk, text)
        text = f"{joint} shares body {model.body(body).name!r} with another joint"
        expect(path, model.body_jntnum[body] == 1, f"{text}, expected a body for each")


def _check_world(parts: _Parts) -> None:
    """Check that gravity points downwards and that the floor, if any, is level at z = 0."""
    path, model = parts.file.path, parts.file.model
    gravity = model.opt.gravity
    downwards = np.all(gravity[:2] == 0.0) and gravity[2] < 0.0
    expect(path, downwards, f"gravity is {gravity}, expected 0 0 and a negative number")
    for g in _world_geoms(parts):
        plane = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE
        name, position = model.geom(g).name or repr(g), model.geom_pos[g]
        expect(path, plane, f"geom {name} of the world is terrain, expected a plane at z = 0")
        level = abs(position[2]) <= 1e-6 and np.allclose(model.geom_quat[g][1:3], 0.0)
        expect(path, level, f"floor {name} is at {position}, expected level at z = 0")


def _world_geoms(parts: _Parts) -> list[int]:
    """Return the geoms that collide and do not belong to the robot."""
    model = parts.file.model
    collide = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    return [int(g) for g in collide if model.body_rootid[model.geom_bodyid[g]] != parts.trunk]


def _standing(parts: _Parts) -> tuple[dict[int, float], Float[np.ndarray, "4"]]:
    """Return each hinge's and slide's standing angle [rad] by joint, and the trunk's quaternion."""
    draft, (path, root, spec, model, _) = parts.draft, parts.file
    pose, trunk_quat = draft.standing, np.array([1.0, 0.0, 0.0, 0.0])
    names = (*draft.all_joints, *draft.joints.weld)
    hinges = {name: parts.file.joints.index(name) for name in names}
    if not isinstance(pose, str):
        for name in pose:
            require(path, "joint", name, names)
        return {j: pose.get(name, 0.0) for name, j in hinges.items()}, trunk_quat
    keys = [key for key in spec.keys if key.name == pose]
    hint = "; a URDF has none" if root.tag == "robot" else ""
    text = f"no keyframe {pose!r}{hint}; expected one, or standing = {{ joint = angle }}"
    expect(path, keys, text)
    qpos = np.array(keys[0].qpos)
    text = f"keyframe {pose!r} has {len(qpos)} numbers, expected {model.nq}"
    expect(path, len(qpos) == model.nq, text)
    if parts.free >= 0:
        start = model.jnt_qposadr[parts.free]
        trunk_quat = qpos[start + 3 : start + 7]
    return {j: float(qpos[model.jnt_qposadr[j]]) for j in hinges.values()}, trunk_quat


def _stated_limits(parts: _Parts) -> dict[str, float]:
    """Return the smallest limit of each leg joint's torque that a file states [N m], or 0.

    Limits are stated for the forces of its actuators, for the control of a motor and for the joint
    itself (effort in a URDF).
    """
    model, torques = parts.file.model, {}
    for joint, name in zip(parts.joints, parts.draft.all_joints, strict=True):
        limited = model.jnt_actfrclimited[joint]
        torques[name] = [np.abs(model.jnt_actfrcrange[joint]).min()] if limited else []
    for motor in _motors(parts.file):
        if (name := motor.target) in torques:
            gear = abs(motor.gear[0])
            if _limited(motor.forcelimited, motor.forcerange):
                torques[name].append(gear * np.abs(motor.forcerange).min())
            is_motor = (motor.gaintype, motor.biastype, motor.dyntype) == _MOTOR
            if is_motor and _limited(motor.ctrllimited, motor.ctrlrange):
                torques[name].append(gear * abs(motor.gainprm[0]) * np.abs(motor.ctrlrange).min())
    return {name: max(float(min(limits, default=0.0)), 0.0) for name, limits in torques.items()}


def _nor(names: Sequence[str]) -> str:
    """Return names, the first one with a gap for what it has not.

    >>> _nor(["a", "b", "c"]).format("range")
    "'a' has no range, nor have b, c"
    """
    first, others = repr(next(iter(names), "")), ", ".join(names[1:])
    return f"{first} has no {{}}" + f", nor have {others}" * bool(others)


def _motors(file: File) -> list:
    joint_types = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    return [motor for motor in file.spec.actuators if motor.trntype in joint_types]


def _limited(flag: mujoco.mjtLimited, span: Float[np.ndarray, "2"]) -> bool:
    automatic = flag == mujoco.mjtLimited.mjLIMITED_AUTO
    return bool(span[0] < span[1]) if automatic else bool(flag)


def _changes(parts: _Parts) -> list[str]:
    """Return one line per change that not every robot needs."""
    (_, root, spec, model, _), trunk = parts.file, parts.trunk
    inside = [b for b in range(1, model.nbody) if model.body_rootid[b] == trunk]
    beside = [
        model.body(b).name for b in {*range(1, model.nbody)} - {*inside} if model.body_mass[b]
    ]
    static = [model.body(b).name for b in inside if not model.body_jntnum[b] and b != trunk]
    more = f" and {len(static) - _LISTED} more" if len(static) > _LISTED else ""
    lines = (
        ("a URDF, with neither motors nor a floor", root.tag == "robot"),
        ("free joint added to the trunk", parts.free < 0),
        (f"made one with their parents: {listed(static[:_LISTED])}{more}", static),
        (f"left out, which no joint holds: {listed(beside)}", beside),
        (f"torque motors {'replace the actuators' if spec.actuators else 'added'}", True),
        (f"floor {'replaced' if _world_geoms(parts) else 'added'}", True),
    )
    return [line for line, needed in lines if needed]


def _check_links(parts: _Parts, links: Sequence[Link]) -> None:
    """Check that each leg is a chain from the trunk down and that each link has a mass."""
    path, names, count = parts.file.path, parts.draft.all_joints, parts.draft.count
    for index, link in enumerate(links):
        text = f"body {link.name!r} moves and has no mass: give it an <inertial>"
        expect(path, link.mass > 0.0, text)
        if index:
            parent = 0 if index % count == 1 else index - 1
            text = f"joint {names[index - 1]!r} is on body {links[link.parent].name!r}"
            text += f", expected {links[parent].name!r}: name each leg from the trunk down"
            expect(path, link.parent == parent, text)
