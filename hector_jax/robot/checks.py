"""Check the feet and the standing pose of a robot in the standard form (see `source`).

Feet touch the floor at one, two or four spheres about a point; the standing pose is on the floor,
in balance and within the limits of joints and motors.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, did_you_mean
from hector_jax.core.trajectory import FEET
from hector_jax.robot.description import Description

_TOLERANCE = 1e-4  # [m]: between the contacts of different feet; angles in files have few digits
ON_FLOOR = 1e-3  # [m]: largest distance of a sole from the floor
_OVER_FEET = 5e-3  # [m]: of the centre of mass outside the contacts; a point spans no length


def check_model(description: Description, model: mujoco.MjModel) -> None:
    """Check a model that `source.build_spec` has converted to the standard form.

    Raises:
        InputError: one line with the value received, the expected one and the possible names.
    """
    path = description.model
    sites = [model.site(i).name for i in range(model.nsite)]
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    last_joints = description.joints[description.leg_joints - 1 :: description.leg_joints]
    for foot, joint in zip(description.named_feet, last_joints, strict=True):
        require(path, "site", foot.point, sites)
        body = model.joint(joint).bodyid[0]
        name = model.body(body).name
        on_foot = model.site(foot.point).bodyid[0] == body
        expect(path, on_foot, f"site {foot.point!r} is not on the foot, body {name!r}")
        for contact in foot.contacts:
            require(path, "geom", contact, geoms)
            geom = model.geom(contact)
            valid = geom.bodyid[0] == body and geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
            expect(path, valid, f"geom {contact!r} is not a sphere on body {name!r}")
    _check_standing(description, model)


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


def _check_standing(description: Description, model: mujoco.MjModel) -> None:
    """Check that the standing pose is on the floor, balanced, within limits and can be held."""
    path, data = description.model, standing_data(description, model)
    key = f"keyframe {description.standing_key!r}"
    for name in description.joints:
        angle, limits = data.joint(name).qpos[0], model.joint(name).range
        text = f"{key} has joint {name!r} at {angle:.4g}, expected it in its range {limits}"
        expect(path, limits[0] <= angle <= limits[1], text)
    feet, legs = description.named_feet, description.legs
    spheres = [name for foot in feet for name in foot.contacts]
    heights = lowest_points(data, spheres)
    low, angles = min(heights), not isinstance(description.standing, str)
    for name, height in zip(spheres, heights, strict=True):
        text = f"{key} has the sole at geom {name!r} {height:.4g} m above the floor, expected 0"
        expect(path, angles or abs(height) <= ON_FLOOR, text)
    offsets = (f"{name} {1e3 * (h - low):.1f}" for name, h in zip(spheres, heights, strict=True))
    text = "standing, the soles are not level: contacts above the lowest one [mm]: "
    text += f"{', '.join(offsets)}; expected at most {1e3 * ON_FLOOR:g}: change the standing angles"
    expect(path, max(heights) - low <= ON_FLOOR, text)
    for contact in data.contact:
        bodies = model.geom_bodyid[contact.geom]
        sole = any(model.geom(g).name in spheres for g in contact.geom)
        text = f"{key} has body {model.body(bodies.max()).name!r} {-contact.dist:.3g} m below the "
        text += "floor, expected nothing there but soles: change the standing angles or the shape"
        expect(path, sole or bodies.min() or contact.dist > -ON_FLOOR, text)
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
    model, trunk, feet = data.model, trunk_body(data.model), description.named_feet
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


def expect(path: Path, condition: Any, message: str) -> None:
    """Raise InputError `path: message` unless the condition holds."""
    if not condition:
        raise InputError(f"{path}: {message}")


def standing_data(description: Description, model: mujoco.MjModel) -> mujoco.MjData:
    """Return the kinematics and dynamics of a model in the standing pose."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(description.standing_key).id)
    mujoco.mj_forward(model, data)
    return data


def trunk_body(model: mujoco.MjModel) -> int:
    """Return the body that the free joint moves."""
    return int(model.jnt_bodyid[0])


def lowest_points(data: mujoco.MjData, spheres: Sequence[str]) -> list[float]:
    """Return the height of the lowest point of each sphere [m]."""
    return [float(data.geom(s).xpos[2] - data.model.geom(s).size[0]) for s in spheres]


def require(path: Path, kind: str, name: str, names: Sequence[str]) -> None:
    """Raise InputError with the nearest name unless the name is one of the names."""
    if name not in names:  # the nearest name takes longer to find than all other checks
        text = f"no {kind} {name!r}{did_you_mean(name, names)}; {kind}s: {listed(names)}"
        raise InputError(f"{path}: {text}")


def listed(names: Sequence[str]) -> str:
    """Return the names that are not empty, joined by commas, or "none"."""
    return ", ".join(filter(None, names)) or "none"
