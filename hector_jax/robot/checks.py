"""Check that a model has the standard form, that all later code reads, and that it can stand.

The standard form has a trunk with a free joint, whose frame has x ahead and z up; one body per leg
joint, leg by leg from the trunk down, with the joint in its origin; torque motors in that order; a
floor; one, two or four spheres about a point, a site, on the sole of each foot; and a keyframe of
the standing pose, on the floor, in balance and within the limits of joints and motors.

Contact bits: 1 floor, 2 first leg, 4 second leg, and so on. Soles touch the floor with their
spheres only; trunk and legs collide with the floor, so that falls are detected, and the legs with
each other. Friction and stiffness are those of the floor.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, expect, listed, require
from hector_jax.core.trajectory import FEET
from hector_jax.robot.description import Description, convert_by
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.poses import standing_data, trunk_body

_TOLERANCE = 1e-4  # [m]: between the contacts of different feet; angles in files have few digits
_ON_FLOOR = 1e-3  # [m]: largest distance of a sole from the floor
_OVER_FEET = 5e-3  # [m]: of the centre of mass outside the contacts; a point spans no length
_MOST_FRICTION = 0.2  # of the robot's geoms; MuJoCo takes the larger friction of two geoms
SHAPES = tuple(range(int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_BOX) + 1))
SOLVER = {
    "timestep": TIME_STEP,
    "integrator": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "solver": mujoco.mjtSolver.mjSOL_NEWTON,
    "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "iterations": 10,
    "ls_iterations": 10,
}
"""The options of every robot, by name in MuJoCo."""


def check_form(description: Description, model: mujoco.MjModel) -> None:
    """Check that a compiled model has the standard form, with the names of a description.

    Raises:
        InputError: one line with a name that it has not and the possible ones; or what it has not
            of the form, and the command that converts it.
    """
    path, remedy = description.model, f"; {convert_by(description.path)}"
    for kind, names, part, count in (
        ("keyframe", [description.standing], model.key, model.nkey),
        ("joint", description.joints, model.joint, model.njnt),
        ("site", [foot.point for foot in description.feet], model.site, model.nsite),
        ("geom", sum((foot.contacts for foot in description.feet), ()), model.geom, model.ngeom),
    ):
        known = [part(i).name for i in range(count)]
        for name in names:
            require(path, kind, name, known, remedy)
    for text in (*_not_of_robot(description, model), *_not_of_world(description, model)):
        raise InputError(f"{path}: not in the standard form: {text}{remedy}")


def _not_of_robot(description: Description, model: mujoco.MjModel) -> Iterator[str]:
    """Yield what bodies, joints and motors have not of the standard form."""
    names, kinds = [model.joint(j).name for j in range(model.njnt)], mujoco.mjtJoint
    free = np.flatnonzero(model.jnt_type == kinds.mjJNT_FREE)
    if [*free] != [0] or tuple(names[1:]) != description.joints:
        yield f"joints are {listed(names)}, expected a free one, then {listed(description.joints)}"
        return
    count, hinges = description.leg_joints, np.arange(1, model.njnt)
    above = np.where((hinges - 1) % count == 0, 1, hinges)  # the trunk, or the body before
    bodies = [*model.jnt_bodyid] == [*range(1, model.nbody)]
    if not (bodies and np.array_equal(model.body_parentid[2:], above)):
        yield "expected a body for each joint and no other, leg by leg from the trunk down"
        return
    if np.any(model.jnt_type[1:] != kinds.mjJNT_HINGE) or not np.all(model.jnt_limited[1:]):
        yield "expected hinges with a range"
    if np.any(model.jnt_pos) or np.any(model.qpos0[7:]):
        yield "expected each joint in the origin of its body, and no ref"
    span, force = model.actuator_ctrlrange, model.actuator_forcerange
    motor = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtDyn.mjDYN_NONE)
    own = model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype
    if not (
        np.array_equal(model.actuator_trnid[:, 0], hinges)
        and np.all(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        and np.all(np.transpose(own) == motor)
        and np.all(model.actuator_gainprm[:, 0] == 1.0)
        and np.all(model.actuator_gear[:, 0] == 1.0)
        and np.all(model.actuator_ctrllimited)
        and np.array_equal(span[:, 0], -span[:, 1])
        and np.all((force == span) | (model.actuator_forcelimited[:, None] == 0))
    ):
        yield "expected a motor of torque for each joint in their order, with a ctrlrange"
    last_bodies = model.jnt_bodyid[count::count]
    for foot, body in zip(description.feet, last_bodies, strict=True):
        contacts = [model.geom(name) for name in foot.contacts]
        spheres = all(x.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE for x in contacts)
        if {body} != {
            part.bodyid[0] for part in (model.site(foot.point), *contacts)
        } or not spheres:
            parts = listed((foot.point, *foot.contacts))
            yield f"expected a site and spheres on body {model.body(body).name!r}, got {parts}"


def _not_of_world(description: Description, model: mujoco.MjModel) -> Iterator[str]:
    """Yield what floor, contacts and options have not of the standard form."""
    collide = (model.geom_contype | model.geom_conaffinity) > 0
    floor = np.flatnonzero(collide & (model.geom_bodyid == 0))
    bits = [(model.geom_contype[g], model.geom_conaffinity[g], model.geom_type[g]) for g in floor]
    level = not np.any(model.geom_pos[floor]) and not np.any(model.geom_quat[floor, 1:3])
    if bits != [(1, 0, mujoco.mjtGeom.mjGEOM_PLANE)] or not level:
        yield "expected one floor that collides, a plane at z = 0 with contype 1, conaffinity 0"
    contacts = {name for foot in description.feet for name in foot.contacts}
    for g in map(int, np.flatnonzero(collide & (model.geom_bodyid > 0))):
        link = int(model.geom_bodyid[g]) - 1
        leg = (link - 1) // description.leg_joints if link else None
        geom, body = model.geom(g), model.body(link + 1).name
        bits = contact_bits(len(description.feet), leg)
        for text in _not_of_geom(geom, bits, 3 if geom.name in contacts else 1):
            label = f"geom {geom.name!r}" if geom.name else "a geom without a name"
            yield f"{label} of body {body!r} has {text}"
    for name, value in SOLVER.items():
        if (own := getattr(model.opt, name)) != value:
            yield f"option {name} is {own}, expected {float(value):g}"
    gravity = model.opt.gravity
    if np.any(gravity[:2]) or not gravity[2] < 0.0:
        yield f"gravity is {gravity}, expected 0 0 and a negative number"


def _not_of_geom(geom: Any, bits: tuple[int, int], condim: int) -> Iterator[str]:
    """Yield what a geom of the robot that collides has, and what it was expected to have."""
    for name, allowed in zip(("contype", "conaffinity"), bits, strict=True):
        if (own := int(getattr(geom, name)[0])) & ~allowed:
            yield f"{name} {own}, expected no bits but those of {allowed}"
    for name, expected in (("condim", condim), ("solmix", 0), ("priority", 0)):
        if (own := getattr(geom, name)[0]) != expected:
            yield f"{name} {own:g}, expected {expected}"
    if (own := geom.friction[0]) > _MOST_FRICTION:
        yield f"friction {own:g}, expected at most {_MOST_FRICTION}"
    if (own := int(geom.type[0])) not in SHAPES:
        names = [mujoco.mjtGeom(x).name.removeprefix("mjGEOM_").lower() for x in (own, *SHAPES)]
        yield f"type {names[0]}, expected one of {listed(names[1:])}"


def contact_bits(legs: int, leg: int | None, *, on_floor: bool = True) -> tuple[int, int]:
    """Return contype and conaffinity of a leg, or of the trunk (None), by the number of legs."""
    if leg is None:
        return 0, 1
    others = sum(2 << i for i in range(legs) if i != leg)
    return 2 << leg, others + on_floor


def check_soles(path: Path, contacts: Float[np.ndarray, "feet c 3"]) -> None:
    """Check that each foot's contacts surround its point on one sole and are alike in all feet.

    Args:
        path: of the model.
        contacts: lowest points of each foot's spheres from the foot point, in the sole's axes [m].

    Raises:
        InputError: one line with the contacts and what was expected.
    """
    for side, points in zip(legs := FEET[len(contacts)], contacts, strict=True):
        text = f"contacts of the {side} foot are at {points.round(4).tolist()} from its point"
        expect(path, np.abs(points[:, 2]).max() <= 1e-3, f"{text}, expected them on one sole")
        x, y = points[:, 0], points[:, 1]
        if len(points) == 1:
            valid, expected = np.abs(points).max() <= 1e-3, "it there"
        elif len(points) == 2:
            valid = x.min() < 0.0 < x.max() and np.abs(y).max() <= 1e-3
            expected = "one ahead of it and one behind"
        else:
            quadrants = set(zip(x > 0.0, y > 0.0, strict=True))
            valid, expected = len(quadrants) == 4, "one at each corner around it"
        expect(path, valid, f"{text}, expected {expected}")
    first, *others = np.sort(contacts[..., 0], axis=1)
    for side, other in zip(legs[1:], others, strict=True):
        text = f"contacts are at x = {first} of the {legs[0]} foot and {other} of the {side} one"
        same = np.allclose(first, other, rtol=0, atol=_TOLERANCE)
        expect(path, same, f"{text}, expected the same")


def check_standing(description: Description, model: mujoco.MjModel) -> None:
    """Check that the standing pose is on the floor, balanced, within limits and can be held.

    Raises:
        InputError: one line with the value received and the expected one.
    """
    path, data = description.model, standing_data(description, model)
    key = f"keyframe {description.standing!r}"
    for name in description.joints:
        angle, limits = data.joint(name).qpos[0], model.joint(name).range
        if not limits[0] <= angle <= limits[1]:
            text = f"{key} has joint {name!r} at {angle:.4g}, expected it in its range {limits}"
            raise InputError(f"{path}: {text}")
    feet, legs = description.feet, description.legs
    spheres = [name for foot in feet for name in foot.contacts]
    heights = [data.geom(x).xpos[2] - model.geom(x).size[0] for x in spheres]
    low = min(heights)
    offsets = (f"{name} {1e3 * (h - low):.1f}" for name, h in zip(spheres, heights, strict=True))
    text = "standing, the soles are not level: contacts above the lowest one [mm]: "
    text += (
        f"{', '.join(offsets)}; expected at most {1e3 * _ON_FLOOR:g}: change the standing angles"
    )
    expect(path, max(heights) - low <= _ON_FLOOR, text)
    text = f"{key} has the soles {low:.4g} m above the floor; {convert_by(description.path)}"
    expect(path, abs(low) <= _ON_FLOOR, text)
    for contact in data.contact:
        bodies = model.geom_bodyid[contact.geom]
        sole = any(model.geom(g).name in spheres for g in contact.geom)
        text = f"{key} has body {model.body(bodies.max()).name!r} {-contact.dist:.3g} m below the "
        text += "floor, expected nothing there but soles: change the standing angles or the shape"
        expect(path, sole or bodies.min() or contact.dist > -_ON_FLOOR, text)
    x, y, _ = np.array([data.site(foot.point).xpos for foot in feet]).T
    pairs = [(i, i + 1, "y", y, "left") for i in range(0, len(feet), 2)]
    for i, j, axis, at, word in pairs + [(i, i + 2, "x", x, "ahead") for i in range(len(feet) - 2)]:
        text = f"{key} has the {legs[i]} foot at {axis} = {at[i]:.4g}, expected it {word} of the "
        expect(path, at[i] > at[j], f"{text}{legs[j]} one, at {at[j]:.4g}")
    com = data.subtree_com[trunk_body(model)][:2]
    contacts = np.array([data.geom(name).xpos[:2] for name in spheres])
    low, high = contacts.min(axis=0), contacts.max(axis=0)
    text = f"{key} has the centre of mass at {com}, expected it over the feet, from {low} to {high}"
    over = np.all(low - _OVER_FEET <= com) and np.all(com <= high + _OVER_FEET)
    expect(path, over, text)
    _check_load(description, data)


def _check_load(description: Description, data: mujoco.MjData) -> None:
    """Check that each motor can hold its joint in the standing pose, the feet sharing the load."""
    model, trunk, feet = data.model, trunk_body(data.model), description.feet
    com, torques = data.subtree_com[trunk], data.qfrc_bias - data.qfrc_passive  # of springs
    force = -model.opt.gravity * model.body_subtreemass[trunk] / len(feet)
    for foot in feet:
        site = data.site(foot.point)
        J_v, J_w = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, J_v, J_w, site.id)
        # with two feet, the centre of pressure lies under the centre of mass along the foot
        lever = np.array([com[0] - site.xpos[0] if len(feet) == 2 else 0.0, 0.0, 0.0])
        torques -= J_v.T @ force + J_w.T @ np.cross(lever, force)
    for index, name in enumerate(description.joints):
        torque, limit = torques[6 + index], model.actuator(index).ctrlrange[1]
        text = f"standing takes {abs(torque):.3g} N m of joint {name!r}, which has {limit:g}"
        expect(description.model, abs(torque) <= limit, text)
