"""The robot as numbers: mass, lengths and limits, read from its MJCF and stated nowhere else.

`compile_model` compiles the MJCF of a description and has it checked (`checks`); `load_robot` reads
a `Robot` off the compiled model. Which names the parts have, the description says.

The trunk's frame is at the trunk body's origin, x ahead, y left, z up.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from hector_jax.core.headless import mujoco
from hector_jax.robot.checks import check_model, check_soles, trunk_body
from hector_jax.robot.description import DESCRIPTION_PATH, Description, read_description
from hector_jax.robot.links import inertia_about
from hector_jax.robot.source import build_spec, compile_spec

_CLOSED_AXES = np.eye(3)[[2, 0, 1, 1, 1]]  # yaw, roll, hip pitch, knee, ankle
_SAME = 1e-6  # [m], [-]: numbers in a model that should agree
_RANK = 0.02  # least singular value of rows that a leg places, lengths in those of the leg


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


@jax.tree_util.register_static
@dataclass(frozen=True)
class Structure:
    """What a robot's model says beside numbers; static under jit."""

    closed_form: bool  # legs as HECTOR's, whose inverse kinematics has a formula
    placed: tuple[int, ...]  # rows of a foot's twist (velocity, angular velocity) that a leg places
    contact: str  # "point", "line" or "flat"


class Robot(NamedTuple):
    """The robot's constants: a pytree of 64-bit host arrays, an argument of jitted functions.

    Legs are in the order of `trajectory.FEET`, each of j joints from the trunk down. A link's frame
    sits in the joint that moves it, parallel to the trunk's when all joints are zero.
    """

    mass: Float[np.ndarray, ""]  # whole robot [kg]
    inertia: Float[
        np.ndarray, "3 3"
    ]  # composite, about the CoM in the standing pose, trunk axes [kg m^2]
    com_offset: Float[np.ndarray, "3"]  # CoM in the trunk frame, standing pose [m]
    gravity: Float[np.ndarray, "3"]  # pointing up as in the paper [m/s^2]
    joint_origin: Float[np.ndarray, "feet j 3"]  # joint in the frame of the link above [m]
    joint_axis: Float[np.ndarray, "feet j 3"]  # in its own link's frame
    foot_point: Float[
        np.ndarray, "feet 3"
    ]  # on the sole under the ankle, in the frame of the last link [m]
    sole: Float[np.ndarray, "feet 3 3"]  # takes vectors of a sole (x ahead, z up) to the last link
    link_mass: Float[np.ndarray, "feet j"]  # of the link that each joint moves [kg]
    link_com: Float[np.ndarray, "feet j 3"]  # its CoM in its own frame [m]
    toe: Float[np.ndarray, ""]  # contact length ahead of the foot point [m]
    heel: Float[np.ndarray, ""]  # contact length behind it [m]
    half_width: Float[np.ndarray, ""]  # contact width to either side of it [m]
    foot_ahead: Float[np.ndarray, " feet"]  # of the middle of all foot points, standing [m]
    joint_lower: Float[np.ndarray, " joints"]  # [rad], leg by leg
    joint_upper: Float[np.ndarray, " joints"]  # [rad]
    torque_limit: Float[np.ndarray, " joints"]  # [N m]
    standing_joints: Float[np.ndarray, " joints"]  # [rad]
    standing_height: Float[np.ndarray, ""]  # CoM above the floor when standing [m]
    trunk_height: Float[np.ndarray, ""]  # trunk origin above the floor when standing [m]
    description: Description  # its names and what else its TOML says; static, no array
    structure: Structure  # static


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


def load_robot(path: Path | None = None) -> Robot:
    """The robot of a file, see `describe`.

    Raises:
        InputError: as `describe` and `compile_model`.
    """
    return robot_of(describe(path))


@quiet_mujoco()
def robot_of(description: Description) -> Robot:
    """The robot of a description.

    Raises:
        InputError: as `compile_model`.
    """
    model = compile_model(description)
    data = mujoco.MjData(model)
    key = model.key(description.standing_key)
    mujoco.mj_resetDataKeyframe(model, data, key.id)
    mujoco.mj_forward(model, data)

    trunk = trunk_body(model)
    R_wb = data.xmat[trunk].reshape(3, 3)
    com = data.subtree_com[trunk]
    joints = _ids(model, description)
    standing_joints, ranges = key.qpos[model.jnt_qposadr[joints]], model.jnt_range[joints]
    parts = model.body_mass, model.body_inertia, data.ximat.reshape(-1, 3, 3)
    legs = _legs(description, model)
    frames = [
        _turned(axes, q)
        for axes, q in zip(legs.axis, standing_joints.reshape(len(legs.axis), -1), strict=True)
    ]
    sole = np.stack([(R_wb @ R).T for R in frames])
    sole = np.where(np.abs(sole - np.eye(3)).max() <= _SAME, np.eye(3), sole)  # rounding
    contacts = np.einsum("fij,fcj->fci", sole.mT, legs.contacts - legs.foot_point[:, None])
    contacts[..., 2] -= legs.radius
    check_soles(description.model, contacts)
    toe, heel, half_width = _sole_lengths(contacts)
    return Robot(
        mass=model.body_subtreemass[trunk].copy(),
        inertia=R_wb.T @ inertia_about(com, *parts, data.xipos) @ R_wb,
        com_offset=R_wb.T @ (com - data.xpos[trunk]),
        gravity=0.0 - model.opt.gravity,
        joint_origin=legs.origin,
        joint_axis=legs.axis,
        foot_point=legs.foot_point,
        sole=sole,
        link_mass=legs.mass,
        link_com=legs.com,
        toe=toe,
        heel=heel,
        half_width=half_width,
        foot_ahead=_ahead(description, R_wb, data),
        joint_lower=ranges[:, 0],
        joint_upper=ranges[:, 1],
        torque_limit=model.actuator_ctrlrange[:, 1].copy(),
        standing_joints=standing_joints,
        standing_height=com[2].copy(),
        trunk_height=data.xpos[trunk][2].copy(),
        description=description,
        structure=Structure(
            closed_form=_closed_form(legs, sole, ranges),
            placed=_placed(legs, standing_joints, sole),
            contact={1: "point", 2: "line", 4: "flat"}[contacts.shape[1]],
        ),
    )


def compile_model(description: Description) -> mujoco.MjModel:
    """The compiled and checked model of a description; raises as `build_model`."""
    return build_model(description)[1]


@quiet_mujoco()
def build_model(description: Description) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """The spec of a description, and its compiled and checked model.

    Raises:
        InputError: one line saying what came, what was expected and what there is. The file must be
            one that `source.build_spec` takes and that compiles to the robot of `checks`.
    """
    spec = build_spec(description).spec
    model = compile_spec(description, spec)
    check_model(description, model)
    return spec, model


class _Legs(NamedTuple):
    """All legs, everything in the frame of its link."""

    origin: Float[np.ndarray, "feet j 3"]  # joint in the frame of the link above [m]
    axis: Float[np.ndarray, "feet j 3"]
    mass: Float[np.ndarray, "feet j"]  # [kg]
    com: Float[np.ndarray, "feet j 3"]  # [m]
    foot_point: Float[np.ndarray, "feet 3"]  # [m]
    contacts: Float[np.ndarray, "feet c 3"]  # centres of their spheres [m]
    radius: Float[np.ndarray, "feet c"]  # [m]


def _ids(model: mujoco.MjModel, description: Description) -> np.ndarray:
    """The legs' joints in the package's order, whatever the file's."""
    return np.array([model.joint(name).id for name in description.joints])


def _legs(description: Description, model: mujoco.MjModel) -> _Legs:
    """Read off the pose in which the trunk is at the origin and all joints are zero."""
    data = mujoco.MjData(model)
    data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
    data.qpos[7:] = 0.0
    mujoco.mj_kinematics(model, data)
    joint = _ids(model, description)
    link = model.jnt_bodyid[joint]
    feet = len(description.feet)
    anchor = data.xanchor[joint].reshape(feet, -1, 3)
    above = np.concatenate([np.zeros((feet, 1, 3)), anchor[:, :-1]], axis=1)
    foot = anchor[:, -1]
    points = np.array([data.site(foot.point).xpos for foot in description.named_feet])
    spheres = [[model.geom(name).id for name in foot.contacts] for foot in description.named_feet]
    return _Legs(
        origin=anchor - above,
        axis=data.xaxis[joint].reshape(feet, -1, 3).copy(),
        mass=model.body_mass[link].reshape(feet, -1),
        com=data.xipos[link].reshape(feet, -1, 3) - anchor,
        foot_point=points - foot,
        contacts=data.geom_xpos[spheres] - foot[:, None],
        radius=model.geom_size[spheres, 0],
    )


def _turned(axes: Float[np.ndarray, "j 3"], joints: Float[np.ndarray, " j"]) -> np.ndarray:
    """Rotation (3, 3) of the last link against the trunk."""
    R = np.eye(3)
    for axis, angle in zip(axes, joints, strict=True):
        R = R @ Rotation.from_rotvec(angle * axis).as_matrix()
    return R


def _sole_lengths(contacts: Float[np.ndarray, "feet c 3"]) -> list[np.ndarray]:
    """Toe, heel and half width [m] of the largest rectangle about the foot points."""
    ahead = np.sort(contacts[..., 0], axis=1)
    half = max(contacts.shape[1] // 2, 1)
    toe, heel = ahead[:, half:].min(initial=np.inf), -ahead[:, :half].max()
    width = np.abs(contacts[..., 1]).min() if contacts.shape[1] == 4 else 0.0
    return [np.asarray(x) for x in ((toe, heel, width) if contacts.shape[1] > 1 else (0.0,) * 3)]


def _ahead(
    description: Description, R_wb: Float[np.ndarray, "3 3"], data: mujoco.MjData
) -> Float[np.ndarray, " feet"]:
    """How far each foot point is ahead of the middle of all, a pair by its mean [m]."""
    points = np.array([data.site(foot.point).xpos for foot in description.named_feet]) @ R_wb
    of_pair = np.repeat(points[:, 0].reshape(-1, 2).mean(axis=1), 2)
    return of_pair - of_pair.mean()


def _closed_form(legs: _Legs, sole: np.ndarray, ranges: Float[np.ndarray, "joints 2"]) -> bool:
    """Whether `kinematics` knows the angles of these legs by a formula.

    Yaw, roll and three pitches; thigh and shin straight down at zero; the knee bends one way only.
    """
    if legs.axis.shape[1] != len(_CLOSED_AXES):
        return False
    low, high = ranges.reshape(len(legs.axis), -1, 2)[:, 3].T
    one_way = np.all((high < 0.0) & (low > -np.pi)) or np.all((low > 0.0) & (high < np.pi))
    down = legs.origin[:, 3:]
    return bool(
        one_way
        and np.allclose(legs.axis, _CLOSED_AXES, rtol=0, atol=_SAME)
        and np.allclose(sole, np.eye(3), rtol=0, atol=_SAME)
        and np.all(np.abs(down[..., 0]) <= _SAME)
        and np.all(down[..., 2] < 0.0)
    )


def _placed(
    legs: _Legs, standing: Float[np.ndarray, " joints"], sole: Float[np.ndarray, "feet 3 3"]
) -> tuple[int, ...]:
    """Rows of a foot's twist that the legs can place in the standing pose.

    First the position, then the pitch of the sole, its yaw and its roll, as far as the joints go.
    """
    rows: list[int] = []
    joints, axes, origin = standing.reshape(len(legs.axis), -1)[0], legs.axis[0], legs.origin[0]
    frames = [_turned(axes[:i], joints[:i]) for i in range(len(joints) + 1)]
    anchors = np.cumsum([R @ step for R, step in zip(frames, origin, strict=False)], axis=0)
    foot = anchors[-1] + frames[-1] @ legs.foot_point[0]
    turns = np.array([R @ axis for R, axis in zip(frames, axes, strict=False)])
    length = np.linalg.norm(foot - anchors[0])
    spin = (frames[-1] @ sole[0]).T @ turns.T
    J = np.concatenate([np.cross(turns, foot - anchors).T / length, spin])
    for row in (0, 1, 2, 4, 5, 3):
        tried = J[[*rows, row]]
        if len(tried) <= len(joints) and np.linalg.svd(tried)[1][-1] > _RANK:
            rows.append(row)
    return tuple(sorted(rows))
