"""Check the feet and the standing pose of a robot that `source` has brought to its form.

Feet touch at one, two or four spheres about a point; the standing pose is on the floor, in balance
and within the limits of joints and motors.
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

_SAME = 1e-6  # [m], [-]: numbers in a description that should agree
ON_FLOOR = 1e-3  # [m] that a sole may be off the floor


def check_model(description: Description, model: mujoco.MjModel) -> None:
    """Check a model that `source.build_spec` brought to its form.

    Raises:
        InputError: one line saying what came, what was expected and what there is.
    """
    path = description.model
    sites = [model.site(i).name for i in range(model.nsite)]
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    lasts = description.joints[description.leg_joints - 1 :: description.leg_joints]
    for foot, last in zip(description.named_feet, lasts, strict=True):
        require(path, "site", foot.point, sites)
        body, site = model.joint(last).bodyid[0], model.site(foot.point)
        name = model.body(body).name
        right = site.bodyid[0] == body
        expect(path, right, f"site {foot.point!r} is not on the foot, body {name!r}")
        for end in foot.contacts:
            require(path, "geom", end, geoms)
            geom = model.geom(end)
            right = geom.bodyid[0] == body and geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
            expect(path, right, f"geom {end!r} is not a sphere on body {name!r}")
    _check_standing(description, model)


def check_soles(path: Path, contacts: Float[np.ndarray, "feet c 3"]) -> None:
    """Check that the contacts of a foot are about its point, on one sole, and alike in all feet.

    Args:
        path: of the model.
        contacts: lowest points of each foot's spheres from the foot point, in the sole's axes [m].

    Raises:
        InputError: one line saying what came and what was expected.
    """
    for side, of_foot in zip(legs := FEET[len(contacts)], contacts, strict=True):
        text = f"contacts of the {side} foot are at {of_foot.round(4).tolist()} from its point"
        expect(path, np.abs(of_foot[:, 2]).max() <= 1e-3, f"{text}, expected them on one sole")
        x, y = of_foot[:, 0], of_foot[:, 1]
        if len(of_foot) == 1:
            right, expected = np.abs(of_foot).max() <= 1e-3, "it there"
        elif len(of_foot) == 2:
            right = x.min() < 0.0 < x.max() and np.abs(y).max() <= 1e-3
            expected = "one ahead of it and one behind"
        else:
            corners = {(a > 0.0, b > 0.0) for a, b in zip(x, y, strict=True)}
            right, expected = len(corners) == 4, "one at each corner around it"
        expect(path, right, f"{text}, expected {expected}")
    first, *others = (np.sort(of_foot[:, 0]) for of_foot in contacts)
    for side, other in zip(legs[1:], others, strict=True):
        text = f"contacts are at x = {first} of the {legs[0]} foot and {other} of the {side} one"
        expect(path, np.allclose(first, other, rtol=0, atol=_SAME), f"{text}, expected the same")


def _check_standing(description: Description, model: mujoco.MjModel) -> None:
    """The standing pose is within the limits, on the floor and in balance, and can be held."""
    path, data = description.model, mujoco.MjData(model)
    this = f"keyframe {description.standing_key!r}"
    mujoco.mj_resetDataKeyframe(model, data, model.key(description.standing_key).id)
    mujoco.mj_forward(model, data)
    for name in description.joints:
        angle, limits = data.joint(name).qpos[0], model.joint(name).range
        text = f"{this} has joint {name!r} at {angle:.4g}, expected it in its range {limits}"
        expect(path, limits[0] <= angle <= limits[1], text)
    feet = description.named_feet
    ends = [(name, data.geom(name).xpos) for foot in feet for name in foot.contacts]
    for name, place in ends:
        height = place[2] - model.geom(name).size[0]
        text = f"{this} has the sole at geom {name!r} {height:.4g} m above the floor, expected 0"
        expect(path, abs(height) <= ON_FLOOR, text)
    x, y, _ = np.array([data.site(foot.point).xpos for foot in feet]).T
    legs = description.legs
    for one, other in zip(range(0, len(feet), 2), range(1, len(feet), 2), strict=True):
        text = f"{this} has the {legs[one]} foot at y = {y[one]:.4g}, expected it left of the "
        expect(path, y[one] > y[other], f"{text}{legs[other]} one, at {y[other]:.4g}")
    for one, other in zip(range(len(feet) - 2), range(2, len(feet)), strict=True):
        text = f"{this} has the {legs[one]} foot at x = {x[one]:.4g}, expected it ahead of the "
        expect(path, x[one] > x[other], f"{text}{legs[other]} one, at {x[other]:.4g}")
    com = data.subtree_com[trunk_body(model)]
    low, high = (side([place[:2] for _, place in ends], axis=0) for side in (np.min, np.max))
    right = np.all(low <= com[:2]) and np.all(com[:2] <= high)
    text = f"{this} has the centre of mass at {com[:2]}, expected it over the feet"
    expect(path, right, f"{text}, from {low} to {high}")
    _check_load(description, model, data)


def _check_load(description: Description, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Each motor can hold its joint in the standing pose, the feet sharing the weight."""
    com, torques = data.subtree_com[trunk_body(model)], data.qfrc_bias.copy()
    feet = description.named_feet
    force = -model.opt.gravity * model.body_subtreemass[trunk_body(model)] / len(feet)
    for foot in feet:
        site = data.site(foot.point)
        J_v, J_w, place = np.zeros((3, model.nv)), np.zeros((3, model.nv)), site.xpos
        mujoco.mj_jacSite(model, data, J_v, J_w, site.id)
        # of two feet the pressure is under the centre of mass along the foot
        ahead = np.array([com[0] - place[0] if len(feet) == 2 else 0.0, 0.0, 0.0])
        torques -= J_v.T @ force + J_w.T @ np.cross(ahead, force)
    for index, name in enumerate(description.joints):
        torque, limit = torques[model.joint(name).dofadr[0]], model.actuator(index).ctrlrange[1]
        text = f"standing takes {abs(torque):.3g} N m of joint {name!r}, which has {limit:g}"
        expect(description.model, abs(torque) <= limit, text)


def expect(path: Path, right: Any, message: str) -> None:
    """InputError `path: message` where something is not right."""
    if not right:
        raise InputError(f"{path}: {message}")


def trunk_body(model: mujoco.MjModel) -> int:
    """Body that the free joint moves."""
    return int(model.jnt_bodyid[0])


def require(path: Path, kind: str, name: str, names: Sequence[str]) -> None:
    """InputError with the nearest name where one is not among those there are."""
    text = f"no {kind} {name!r}{did_you_mean(name, names)}; {kind}s: {listed(names)}"
    expect(path, name in names, text)


def listed(names: Sequence[str]) -> str:
    """Names in one line, those of no letters left out."""
    return ", ".join(name for name in names if name) or "none"
