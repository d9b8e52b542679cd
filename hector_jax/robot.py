"""The robot as numbers: mass, lengths and limits, read from hector.xml and stated nowhere else.

`load_model` compiles a robot description and checks that it is a biped this package can walk: a
free trunk, two mirrored legs with hip yaw, hip roll, hip pitch, knee and ankle, one motor per
joint, and line feet that touch at a toe and a heel. `load_robot` reads a `Robot` off the compiled
model.

Frames: the trunk's is at the trunk body's origin, x ahead, y left, z up; a link's frame sits in the
joint that moves it, parallel to the trunk's when all joints are zero.
"""

import difflib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from hector_jax.mjcf import read_mjcf, refusal

_PACKAGE = Path(__file__).parent
_INSTALLED = _PACKAGE / "assets" / "hector.xml"  # where a wheel puts it
MODEL_PATH = _INSTALLED if _INSTALLED.exists() else _PACKAGE.parent / "assets" / "hector.xml"

SIDES = ("left", "right")
LEG_JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")
JOINT_NAMES = tuple(f"{side}_{joint}" for side in SIDES for joint in LEG_JOINTS)
FOOT_POINTS = tuple(f"{side}_foot_point" for side in SIDES)
TOES = tuple(f"{side}_toe" for side in SIDES)
HEELS = tuple(f"{side}_heel" for side in SIDES)
STANDING = "standing"  # the keyframe of the standing pose

_LEG_AXES = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 1, 0]], dtype=float)
_SAME = 1e-6  # [m], [-]: numbers in a description that should agree

# MuJoCo writes its warnings into a file of the working directory; the counters in MjData, which
# every walk reads, tell the same.
mujoco.set_mju_user_warning(lambda message: None)


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


def load_robot(path: Path | None = None) -> Robot:
    """The robot of a description file.

    Args:
        path: MJCF file; None takes the packaged hector.xml.

    Raises:
        ValueError: as `load_model`.
    """
    model = load_model(path)
    data = mujoco.MjData(model)
    key = model.key(STANDING)
    mujoco.mj_resetDataKeyframe(model, data, key.id)
    mujoco.mj_forward(model, data)

    trunk = _trunk(model)
    R_wb = data.xmat[trunk].reshape(3, 3)
    com = data.subtree_com[trunk]
    # The legs' joints, links and actuators in the package's order, whatever the file's.
    joint = np.array([model.joint(name).id for name in JOINT_NAMES])
    link = model.jnt_bodyid[joint]
    site = [model.site(name).id for name in FOOT_POINTS]
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
        toe=model.geom(TOES[0]).pos[0] - foot_point[0, 0],
        heel=foot_point[0, 0] - model.geom(HEELS[0]).pos[0],
        joint_lower=model.jnt_range[joint, 0],
        joint_upper=model.jnt_range[joint, 1],
        torque_limit=model.actuator_ctrlrange[:, 1].copy(),
        standing_joints=key.qpos[model.jnt_qposadr[joint]],
        standing_height=com[2].copy(),
        trunk_height=data.xpos[trunk][2].copy(),
    )


def load_model(path: Path | None = None) -> mujoco.MjModel:
    """The compiled and checked model of a description file.

    Args:
        path: MJCF file; None takes the packaged hector.xml.

    Raises:
        ValueError: one line saying what came, what was expected and what there is. The file must be
            one that `mjcf.read_mjcf` lets pass and that compiles to the biped of this module's
            docstring.
    """
    path = MODEL_PATH if path is None else Path(path)
    root = read_mjcf(path)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise refusal(path, root, mujoco.mj_printSchema(False, False), error) from None
    _check_base(path, model)
    _check_joints(path, model)
    _check_motors(path, model)
    _check_feet(path, model)
    return model


def _check_base(path: Path, model: mujoco.MjModel) -> None:
    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if len(free) != 1 or free[0] != 0:
        raise ValueError(
            f"{path}: {len(free)} free joints, expected exactly one, the first; "
            f"joints: {_listed(_joints(model))}"
        )


def _check_joints(path: Path, model: mujoco.MjModel) -> None:
    names = _joints(model)
    for name in JOINT_NAMES:
        _require(path, "joint", name, names)
    got = [name for name in names if name in JOINT_NAMES]
    if got != list(JOINT_NAMES) or len(names) != 1 + len(JOINT_NAMES):
        raise ValueError(
            f"{path}: joints are {_listed(names)}; "
            f"expected a free joint, then {_listed(JOINT_NAMES)}"
        )
    for index, name in enumerate(JOINT_NAMES):
        joint = model.joint(name)
        which = index % 5
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"{path}: joint {name!r} is no hinge, expected a hinge")
        if not np.allclose(joint.axis, _LEG_AXES[which], atol=_SAME):
            raise ValueError(
                f"{path}: axis of joint {name!r} is {joint.axis}, expected {_LEG_AXES[which]}"
            )
        if not joint.limited[0]:
            raise ValueError(f"{path}: joint {name!r} has no range, expected limits in radians")
        body = joint.bodyid[0]
        parent = model.body_parentid[body]
        expected = _trunk(model) if which == 0 else model.joint(JOINT_NAMES[index - 1]).bodyid[0]
        if parent != expected:
            raise ValueError(
                f"{path}: joint {name!r} hangs on body {model.body(parent).name!r}, "
                f"expected {model.body(expected).name!r}"
            )
        if np.abs(joint.pos).max() > _SAME or abs(model.body_quat[body][0]) < 1 - _SAME:
            raise ValueError(
                f"{path}: joint {name!r} is off its body's origin or its body is turned, "
                "expected neither pos on the joint nor an orientation on the body"
            )
        # Two parallel links in one plane: what the closed-form inverse kinematics solves.
        if which >= 3 and (model.body_pos[body][0] != 0.0 or model.body_pos[body][2] >= 0.0):
            raise ValueError(
                f"{path}: body of joint {name!r} is at {model.body_pos[body]}, "
                "expected x = 0 and z < 0"
            )


def _check_motors(path: Path, model: mujoco.MjModel) -> None:
    if model.nu != len(JOINT_NAMES):
        raise ValueError(
            f"{path}: {model.nu} actuators, expected {len(JOINT_NAMES)}, "
            f"one per joint: {_listed(JOINT_NAMES)}"
        )
    for index, name in enumerate(JOINT_NAMES):
        motor = model.actuator(index)
        driven = model.joint(motor.trnid[0]).name
        if driven != name:
            raise ValueError(f"{path}: actuator {index} drives joint {driven!r}, expected {name!r}")
        if not motor.ctrllimited[0] or motor.ctrlrange[1] <= 0 or motor.gear[0] != 1.0:
            raise ValueError(
                f"{path}: actuator of joint {name!r} has ctrlrange {motor.ctrlrange} and gear "
                f"{motor.gear[0]}, expected a torque range and gear 1"
            )


def _check_feet(path: Path, model: mujoco.MjModel) -> None:
    if STANDING not in (keys := [model.key(i).name for i in range(model.nkey)]):
        raise ValueError(f"{path}: {_missing('keyframe', STANDING, keys)}")
    sites = [model.site(i).name for i in range(model.nsite)]
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    for side, foot in enumerate(FOOT_POINTS):
        _require(path, "site", foot, sites)
        body = model.joint(JOINT_NAMES[5 * side + 4]).bodyid[0]
        point = model.site(foot).pos
        if model.site(foot).bodyid[0] != body:
            raise ValueError(
                f"{path}: site {foot!r} is not on the foot, body {model.body(body).name!r}"
            )
        for name, ahead in ((TOES[side], 1), (HEELS[side], -1)):
            _require(path, "geom", name, geoms)
            geom = model.geom(name)
            if geom.bodyid[0] != body or geom.type[0] != mujoco.mjtGeom.mjGEOM_SPHERE:
                raise ValueError(
                    f"{path}: geom {name!r} is no sphere on body {model.body(body).name!r}"
                )
            reach = geom.pos - [0, 0, geom.size[0]] - point
            if ahead * reach[0] <= 0 or np.abs(reach[1:]).max() > 1e-3:
                raise ValueError(
                    f"{path}: lowest point of geom {name!r} is {reach} from site {foot!r}, "
                    f"expected it {'ahead' if ahead > 0 else 'behind'} on the same sole"
                )
    for names in (TOES, HEELS):
        left, right = (model.geom(name).pos[0] for name in names)
        if abs(left - right) > _SAME:
            raise ValueError(
                f"{path}: {names[0]} at x = {left}, {names[1]} at x = {right}, expected the same"
            )


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
    if name not in names:
        raise ValueError(f"{path}: {_missing(kind, name, names)}")


def _missing(kind: str, name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return f"no {kind} {name!r}{hint}; {kind}s: {_listed(names)}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(name for name in names if name) or "none"
