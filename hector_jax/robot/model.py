"""The robot as numbers: mass, lengths and limits, read from its MJCF and stated nowhere else.

`compile_model` compiles the MJCF of a description and checks that it is a biped this package can
walk: a free trunk, two mirrored legs with hip yaw, hip roll, hip pitch, knee and ankle, one motor
per joint, and line feet that touch at a toe and a heel. `load_robot` reads a `Robot` off the
compiled model; which names the parts have, the description says.

Frames: the trunk's is at the trunk body's origin, x ahead, y left, z up; a link's frame sits in the
joint that moves it, parallel to the trunk's when all joints are zero.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, did_you_mean
from hector_jax.robot.description import (
    DESCRIPTION_PATH,
    HECTOR_AXES,
    Description,
    read_description,
)
from hector_jax.robot.mjcf import read_mjcf, refusal

_AXES = dict(zip("xyz", np.eye(3), strict=True))
_SAME = 1e-6  # [m], [-]: numbers in a description that should agree


@contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings into a file of the working directory.

    The counters in MjData, which every walk reads, tell the same.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


class Robot(NamedTuple):
    """The robot's constants: a pytree of 64-bit host arrays, an argument of jitted functions."""

    mass: Float[np.ndarray, ""]  # whole robot [kg]
    inertia: Float[
        np.ndarray, "3 3"
    ]  # composite, about the CoM in the standing pose, trunk axes [kg m^2]
    com_offset: Float[np.ndarray, "3"]  # CoM in the trunk frame, standing pose [m]
    gravity: Float[np.ndarray, "3"]  # pointing up as in the paper [m/s^2]
    joint_origin: Float[np.ndarray, "2 5 3"]  # joint frame in its parent's frame [m]
    joint_axis: Float[np.ndarray, "5 3"]  # in the joint's own frame, the same for both legs
    foot_point: Float[
        np.ndarray, "2 3"
    ]  # on the sole under the ankle axis, in the foot's frame [m]
    link_mass: Float[np.ndarray, "2 5"]  # of the link that each joint moves [kg]
    link_com: Float[np.ndarray, "2 5 3"]  # its CoM in its own frame [m]
    toe: Float[np.ndarray, ""]  # contact length ahead of the foot point [m]
    heel: Float[np.ndarray, ""]  # contact length behind it [m]
    joint_lower: Float[np.ndarray, "10"]  # [rad], left leg then right
    joint_upper: Float[np.ndarray, "10"]  # [rad]
    torque_limit: Float[np.ndarray, "10"]  # [N m]
    standing_joints: Float[np.ndarray, "10"]  # [rad]
    standing_height: Float[np.ndarray, ""]  # CoM above the floor when standing [m]
    trunk_height: Float[np.ndarray, ""]  # trunk origin above the floor when standing [m]
    description: Description  # its names and what else its TOML says; static, no array


def describe(path: Path | None = None) -> Description:
    """The description of a robot.

    Args:
        path: TOML file; an MJCF file with HECTOR's names, which is then described as HECTOR is;
            None takes the packaged hector.toml.

    Raises:
        InputError: as `read_description`.
    """
    path = DESCRIPTION_PATH if path is None else Path(path)
    if path.suffix == ".toml":
        return read_description(path)
    return replace(read_description(DESCRIPTION_PATH), model=path)


@quiet_mujoco()
def load_robot(path: Path | None = None) -> Robot:
    """The robot of a file, see `describe`.

    Raises:
        InputError: as `describe` and `compile_model`.
    """
    description = describe(path)
    model = compile_model(description)
    data = mujoco.MjData(model)
    key = model.key(description.standing)
    mujoco.mj_resetDataKeyframe(model, data, key.id)
    mujoco.mj_forward(model, data)

    trunk = _trunk(model)
    R_wb = data.xmat[trunk].reshape(3, 3)
    com = data.subtree_com[trunk]
    # The legs' joints, links and actuators in the package's order, whatever the file's.
    joint = np.array([model.joint(name).id for name in description.joints])
    link = model.jnt_bodyid[joint]
    site = [model.site(name).id for name in description.foot_points]
    foot_point = model.site_pos[site]
    return Robot(
        mass=model.body_subtreemass[trunk].copy(),
        inertia=R_wb.T @ _composite_inertia(model, data, com) @ R_wb,
        com_offset=R_wb.T @ (com - data.xpos[trunk]),
        gravity=0.0 - model.opt.gravity,
        joint_origin=model.body_pos[link].reshape(2, 5, 3),
        joint_axis=model.jnt_axis[joint[:5]],
        foot_point=foot_point,
        link_mass=model.body_mass[link].reshape(2, 5),
        link_com=model.body_ipos[link].reshape(2, 5, 3),
        toe=model.geom(description.toes[0]).pos[0] - foot_point[0, 0],
        heel=foot_point[0, 0] - model.geom(description.heels[0]).pos[0],
        joint_lower=model.jnt_range[joint, 0],
        joint_upper=model.jnt_range[joint, 1],
        torque_limit=model.actuator_ctrlrange[:, 1].copy(),
        standing_joints=key.qpos[model.jnt_qposadr[joint]],
        standing_height=com[2].copy(),
        trunk_height=data.xpos[trunk][2].copy(),
        description=description,
    )


@quiet_mujoco()
def compile_model(description: Description) -> mujoco.MjModel:
    """The compiled and checked model of a description.

    Raises:
        InputError: one line saying what came, what was expected and what there is. The MJCF must be
            one that `mjcf.read_mjcf` lets pass and that compiles to the biped of this module's
            docstring.
    """
    path = description.model
    root = read_mjcf(path)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise refusal(path, root, mujoco.mj_printSchema(False, False), error) from None
    _check_base(path, model)
    _check_joints(description, model)
    _check_motors(description, model)
    _check_feet(description, model)
    return model


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
        which, body, this = index % 5, joint.bodyid[0], f"joint {name!r}"
        _expect(path, joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE, f"{this} is not a hinge")
        axis = _AXES[description.axes[which]]
        right = np.allclose(joint.axis, axis, atol=_SAME)
        _expect(path, right, f"axis of {this} is {joint.axis}, expected {axis}")
        _expect(path, joint.limited[0], f"{this} has no range, expected limits in radians")
        parent = model.body_parentid[body]
        above = _trunk(model) if which == 0 else model.joint(joints[index - 1]).bodyid[0]
        on, expected = model.body(parent).name, model.body(above).name
        _expect(path, parent == above, f"{this} is on body {on!r}, expected {expected!r}")
        right = np.abs(joint.pos).max() <= _SAME and abs(model.body_quat[body][0]) >= 1 - _SAME
        expected = "expected neither pos on the joint nor an orientation on the body"
        _expect(path, right, f"{this} is off its body's origin or its body is turned, {expected}")
        # Two parallel links in one plane: what the closed-form inverse kinematics solves.
        at = model.body_pos[body]
        closed = description.axes == HECTOR_AXES and which >= 3
        right = not closed or (at[0] == 0.0 and at[2] < 0.0)
        _expect(path, right, f"body of {this} is at {at}, expected x = 0 and z < 0")
        # a stretched leg has no derivative there, and the closed form bends the knee backwards only
        low, high = joint.range
        right = not closed or which != 3 or -np.pi < low < high < 0.0
        text = f"range of {this} is {joint.range}, expected -pi < lower < upper < 0"
        _expect(path, right, f"{text}: it bends backwards only")


def _check_motors(description: Description, model: mujoco.MjModel) -> None:
    path, joints = description.model, description.joints
    expected = f"expected {len(joints)}, one per joint: {_listed(joints)}"
    _expect(path, model.nu == len(joints), f"{model.nu} actuators, {expected}")
    for index, name in enumerate(joints):
        motor = model.actuator(index)
        driven, limits, gear = model.joint(motor.trnid[0]).name, motor.ctrlrange, motor.gear[0]
        text = f"actuator {index} drives joint {driven!r}, expected {name!r}"
        _expect(path, driven == name, text)
        text = f"actuator of joint {name!r} has ctrlrange {limits} and gear {gear}"
        right = motor.ctrllimited[0] and limits[1] > 0 and gear == 1.0
        _expect(path, right, f"{text}, expected a torque range and gear 1")


def _check_feet(description: Description, model: mujoco.MjModel) -> None:
    path, toes, heels = description.model, description.toes, description.heels
    _require(path, "keyframe", description.standing, [model.key(i).name for i in range(model.nkey)])
    sites = [model.site(i).name for i in range(model.nsite)]
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    for side, foot in enumerate(description.foot_points):
        _require(path, "site", foot, sites)
        body, site = model.joint(description.joints[5 * side + 4]).bodyid[0], model.site(foot)
        name = model.body(body).name
        _expect(path, site.bodyid[0] == body, f"site {foot!r} is not on the foot, body {name!r}")
        for end, ahead in ((toes[side], 1), (heels[side], -1)):
            _require(path, "geom", end, geoms)
            geom = model.geom(end)
            right = geom.bodyid[0] == body and geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
            _expect(path, right, f"geom {end!r} is not a sphere on body {name!r}")
            reach = geom.pos - [0, 0, geom.size[0]] - site.pos
            expected = f"expected it {'ahead' if ahead > 0 else 'behind'} on the same sole"
            text = f"lowest point of geom {end!r} is {reach} from site {foot!r}, {expected}"
            _expect(path, ahead * reach[0] > 0 and np.abs(reach[1:]).max() <= 1e-3, text)
    for names in (toes, heels):
        left, right = (model.geom(name).pos[0] for name in names)
        text = f"{names[0]} at x = {left}, {names[1]} at x = {right}, expected the same"
        _expect(path, abs(left - right) <= _SAME, text)


def _expect(path: Path, right: Any, message: str) -> None:
    if not right:
        raise InputError(f"{path}: {message}")


def _composite_inertia(
    model: mujoco.MjModel, data: mujoco.MjData, com: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Inertia of the whole robot about `com`, joints frozen, world axes."""
    R = data.ximat.reshape(-1, 3, 3)
    own = np.einsum("bij,bj,bkj->bik", R, model.body_inertia, R)
    arm = data.xipos - com
    square = np.einsum("bi,bi->b", arm, arm)[:, None, None] * np.eye(3)
    steiner = model.body_mass[:, None, None] * (square - arm[:, :, None] * arm[:, None, :])
    return (own + steiner).sum(axis=0)


def _trunk(model: mujoco.MjModel) -> int:
    return int(model.jnt_bodyid[0])


def _joints(model: mujoco.MjModel) -> list[str]:
    return [model.joint(i).name for i in range(model.njnt)]


def _require(path: Path, kind: str, name: str, names: Sequence[str]) -> None:
    _expect(path, name in names, _missing(kind, name, names))


def _missing(kind: str, name: str, names: Sequence[str]) -> str:
    return f"no {kind} {name!r}{did_you_mean(name, names)}; {kind}s: {_listed(names)}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(name for name in names if name) or "none"
