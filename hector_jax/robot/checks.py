"""Check that a compiled MJCF is a biped that this package can walk.

A free trunk; two legs of three to seven hinges; one motor per joint; feet that touch at one, two or
four spheres, with contacts that the floor of each plant decides; a standing pose that stands.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, did_you_mean
from hector_jax.robot.description import Description

_SAME = 1e-6  # [m], [-]: numbers in a description that should agree
_ON_FLOOR = 1e-3  # [m]
_MOST_FRICTION = 0.2  # of the robot's geoms; of two that touch the larger one counts


def check_model(description: Description, model: mujoco.MjModel) -> None:
    """Check a compiled model.

    Raises:
        InputError: one line saying what came, what was expected and what there is.
    """
    _check_base(description.model, model)
    _check_joints(description, model)
    _check_motors(description, model)
    _check_feet(description, model)
    _check_contacts(description, model)
    _check_standing(description, model)


def _check_base(path: Path, model: mujoco.MjModel) -> None:
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    joints = _listed(_joints(model))
    text = f"{len(free)} free joints, expected exactly one, the first; joints: {joints}"
    _expect(path, list(free) == [0], text)


def _check_joints(description: Description, model: mujoco.MjModel) -> None:
    path, joints = description.model, description.joints
    names = _joints(model)
    for name in joints:
        _require(path, "joint", name, names)
    got = [name for name in names if name in joints]
    expected = f"expected a free joint, then {_listed(joints)}"
    right = got == list(joints) and len(names) == 1 + len(joints)
    _expect(path, right, f"joints are {_listed(names)}; {expected}")
    for index, name in enumerate(joints):
        joint = model.joint(name)
        body, this = joint.bodyid[0], f"joint {name!r}"
        _expect(path, joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE, f"{this} is not a hinge")
        _expect(path, joint.limited[0], f"{this} has no range, expected limits in radians")
        parent, first = model.body_parentid[body], index % description.leg_joints == 0
        above = trunk_body(model) if first else model.joint(joints[index - 1]).bodyid[0]
        on, expected = model.body(parent).name, model.body(above).name
        _expect(path, parent == above, f"{this} is on body {on!r}, expected {expected!r}")


def _check_motors(description: Description, model: mujoco.MjModel) -> None:
    path, joints = description.model, description.joints
    expected = f"expected {len(joints)}, one per joint: {_listed(joints)}"
    _expect(path, model.nu == len(joints), f"{model.nu} actuators, {expected}")
    for index, name in enumerate(joints):
        motor = model.actuator(index)
        driven, limits, gear = model.joint(motor.trnid[0]).name, motor.ctrlrange, motor.gear[0]
        text = f"actuator {index} drives joint {driven!r}, expected {name!r}"
        _expect(path, driven == name, text)
        limited = motor.ctrllimited[0]
        range_ = f"ctrlrange {limits}" if limited else "no ctrlrange"
        text = f"actuator of joint {name!r} has {range_} and gear {gear}"
        right = limited and limits[1] > 0 and limits[0] == -limits[1] and gear == 1.0
        _expect(path, right, f"{text}, expected a torque range about 0 and gear 1")
        gain = model.actuator_gainprm[index, 0]
        fixed = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE
        right = (motor.gaintype[0], motor.biastype[0]) == fixed and gain == 1.0
        text = f"actuator of joint {name!r} is no motor or has gain {gain}"
        _expect(path, right, f"{text}, expected a motor of gain 1, whose control is a torque")


def _check_feet(description: Description, model: mujoco.MjModel) -> None:
    path = description.model
    _require(
        path, "keyframe", description.standing_key, [model.key(i).name for i in range(model.nkey)]
    )
    sites = [model.site(i).name for i in range(model.nsite)]
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    lasts = description.joints[description.leg_joints - 1 :: description.leg_joints]
    for foot, last in zip(description.named_feet, lasts, strict=True):
        _require(path, "site", foot.point, sites)
        body, site = model.joint(last).bodyid[0], model.site(foot.point)
        name = model.body(body).name
        right = site.bodyid[0] == body
        _expect(path, right, f"site {foot.point!r} is not on the foot, body {name!r}")
        for end in foot.contacts:
            _require(path, "geom", end, geoms)
            geom = model.geom(end)
            right = geom.bodyid[0] == body and geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
            _expect(path, right, f"geom {end!r} is not a sphere on body {name!r}")


def check_soles(path: Path, contacts: Float[np.ndarray, "2 c 3"]) -> None:
    """Check that the contacts of a foot are about its point, on one sole, and alike in both feet.

    Args:
        path: of the model.
        contacts: lowest points of each foot's spheres from the foot point, in the sole's axes [m].

    Raises:
        InputError: one line saying what came and what was expected.
    """
    for side, of_foot in zip(("left", "right"), contacts, strict=True):
        text = f"contacts of the {side} foot are at {of_foot.round(4).tolist()} from its point"
        _expect(path, np.abs(of_foot[:, 2]).max() <= 1e-3, f"{text}, expected them on one sole")
        x, y = of_foot[:, 0], of_foot[:, 1]
        if len(of_foot) == 1:
            right, expected = np.abs(of_foot).max() <= 1e-3, "it there"
        elif len(of_foot) == 2:
            right = x.min() < 0.0 < x.max() and np.abs(y).max() <= 1e-3
            expected = "one ahead of it and one behind"
        else:
            corners = {(a > 0.0, b > 0.0) for a, b in zip(x, y, strict=True)}
            right, expected = len(corners) == 4, "one at each corner around it"
        _expect(path, right, f"{text}, expected {expected}")
    left, right = (np.sort(of_foot[:, 0]) for of_foot in contacts)
    text = f"contacts are at x = {left} of the left foot and {right} of the right one"
    _expect(path, np.allclose(left, right, rtol=0, atol=_SAME), f"{text}, expected the same")


def _check_contacts(description: Description, model: mujoco.MjModel) -> None:
    """What would walk and be read wrongly, or leave a plant's floor without effect."""
    path, trunk = description.model, trunk_body(model)
    pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    _expect(path, pyramidal, "option cone is elliptic, expected pyramidal")
    for name in _ends(description):
        dimensions = model.geom(name).condim[0]
        _expect(path, dimensions == 3, f"condim of geom {name!r} is {dimensions}, expected 3")
    _expect(path, model.npair == 0, f"{model.npair} contact pairs, expected none")
    for index in map(int, np.flatnonzero(model.geom_contype | model.geom_conaffinity)):
        if model.body_rootid[model.geom_bodyid[index]] != trunk:
            continue
        friction, solmix = model.geom_friction[index, 0], model.geom_solmix[index]
        priority = model.geom_priority[index]
        text = f"geom {model.geom(index).name or index!r} has friction {friction}, solmix {solmix}"
        right = friction <= _MOST_FRICTION and solmix == 0.0 and priority == 0
        expected = f"expected at most {_MOST_FRICTION}, 0 and 0: the floor of a plant decides"
        _expect(path, right, f"{text} and priority {priority}, {expected}")


def _check_standing(description: Description, model: mujoco.MjModel) -> None:
    """The standing pose is within the limits, on the floor and in balance, and can be held."""
    path, data, this = (
        description.model,
        mujoco.MjData(model),
        f"keyframe {description.standing_key!r}",
    )
    mujoco.mj_resetDataKeyframe(model, data, model.key(description.standing_key).id)
    mujoco.mj_forward(model, data)
    for name in description.joints:
        angle, limits = data.joint(name).qpos[0], model.joint(name).range
        text = f"{this} has joint {name!r} at {angle:.4g}, expected it in its range {limits}"
        _expect(path, limits[0] <= angle <= limits[1], text)
    ends = [(name, data.geom(name).xpos) for name in _ends(description)]
    for name, place in ends:
        height = place[2] - model.geom(name).size[0]
        text = f"{this} has the sole at geom {name!r} {height:.4g} m above the floor, expected 0"
        _expect(path, abs(height) <= _ON_FLOOR, text)
    left, right = (data.site(foot.point).xpos[1] for foot in description.named_feet)
    text = f"{this} has the left foot at y = {left:.4g}, expected it left of the right one, at"
    _expect(path, left > right, f"{text} {right:.4g}")
    com = data.subtree_com[trunk_body(model)]
    low, high = (side([place[:2] for _, place in ends], axis=0) for side in (np.min, np.max))
    right = np.all(low <= com[:2]) and np.all(com[:2] <= high)
    text = f"{this} has the centre of mass at {com[:2]}, expected it over the feet"
    _expect(path, right, f"{text}, from {low} to {high}")
    _check_load(description, model, data)


def _check_load(description: Description, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Each motor can hold its joint in the standing pose, the feet sharing the weight."""
    com, torques = data.subtree_com[trunk_body(model)], data.qfrc_bias.copy()
    force = -0.5 * model.opt.gravity * model.body_subtreemass[trunk_body(model)]
    for foot in description.named_feet:
        site = data.site(foot.point)
        J_v, J_w, place = np.zeros((3, model.nv)), np.zeros((3, model.nv)), site.xpos
        mujoco.mj_jacSite(model, data, J_v, J_w, site.id)
        # the pressure is under the centre of mass along the foot and under the foot across it
        ahead = np.array([com[0] - place[0], 0.0, 0.0])
        torques -= J_v.T @ force + J_w.T @ np.cross(ahead, force)
    for index, name in enumerate(description.joints):
        torque, limit = torques[model.joint(name).dofadr[0]], model.actuator(index).ctrlrange[1]
        text = f"standing takes {abs(torque):.3g} N m of joint {name!r}, which has {limit:g}"
        _expect(description.model, abs(torque) <= limit, text)


def _expect(path: Path, right: Any, message: str) -> None:
    if not right:
        raise InputError(f"{path}: {message}")


def trunk_body(model: mujoco.MjModel) -> int:
    """Body that the free joint moves."""
    return int(model.jnt_bodyid[0])


def _ends(description: Description) -> list[str]:
    """Spheres of both feet."""
    return [name for foot in description.named_feet for name in foot.contacts]


def _joints(model: mujoco.MjModel) -> list[str]:
    return [model.joint(i).name for i in range(model.njnt)]


def _require(path: Path, kind: str, name: str, names: Sequence[str]) -> None:
    _expect(path, name in names, _missing(kind, name, names))


def _missing(kind: str, name: str, names: Sequence[str]) -> str:
    return f"no {kind} {name!r}{did_you_mean(name, names)}; {kind}s: {_listed(names)}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(name for name in names if name) or "none"
