"""The robot's mass, lengths and limits; the model's file is their only source.

`compile_model` compiles the model of a description and checks it (`checks`); `load_robot` reads a
`Robot` from the compiled model. The description has the names of the parts.

The trunk's frame is at the trunk body's origin, x ahead, y left, z up.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from warnings import catch_warnings

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError, one_line
from hector_jax.robot.checks import check_form, check_soles, check_standing
from hector_jax.robot.description import HECTOR, Description, convert_by, read_description
from hector_jax.robot.mjcf import mujoco_errors, read_mjcf, text_of
from hector_jax.robot.poses import data_at, inertia_about, standing_data, trunk_body

_CLOSED_AXES = np.eye(3)[[2, 0, 1, 1, 1]]  # yaw, roll, hip pitch, knee, ankle
_TOLERANCE = 1e-6  # [m], [-]: between values of a model that are equal but for rounding
_MIN_SINGULAR = 0.02  # singular value of the rows that a leg controls, in leg lengths


@contextmanager
def quiet_mujoco() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings into a file of the working directory.

    Walks read the same information from the warning counters in MjData.
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


@contextmanager
def conversion(path: Path) -> Iterator[None]:
    """Raise as an InputError whatever MuJoCo, SciPy or a name raises while a file is converted."""
    try:
        with quiet_mujoco(), catch_warnings(action="ignore", category=UserWarning):
            yield
    except InputError:
        raise
    except (ArithmeticError, LookupError, ValueError, mujoco.FatalError) as error:
        text = f"{path}: no robot can be made of it: {type(error).__name__}: {one_line(error)}"
        raise InputError(text) from error


@jax.tree_util.register_static
@dataclass(frozen=True)
class Structure:
    """Structure of a robot's legs and feet; static under jit."""

    closed_form: bool  # the legs are built like HECTOR's and have closed-form inverse kinematics
    placed: tuple[int, ...]  # rows of a foot's twist (velocity, ang. velocity) that a leg controls
    contact: str  # "point", "line" or "flat"


class Robot(NamedTuple):
    """The robot's constants: a pytree of 64-bit host arrays, an argument of jitted functions.

    Legs are in the order of `trajectory.FEET`, each of j joints from the trunk down. A link's frame
    is at the joint that moves it and parallel to the trunk's when all joints are zero.
    """

    mass: Float[np.ndarray, ""]  # whole robot [kg]
    inertia: Float[np.ndarray, "3 3"]  # composite, standing, about the CoM, trunk axes [kg m^2]
    com_offset: Float[np.ndarray, "3"]  # CoM in the trunk frame, standing pose [m]
    gravity: Float[np.ndarray, "3"]  # pointing up as in the paper [m/s^2]
    joint_origin: Float[np.ndarray, "feet j 3"]  # joint in the frame of the link above [m]
    joint_axis: Float[np.ndarray, "feet j 3"]  # in its own link's frame
    foot_point: Float[np.ndarray, "feet 3"]  # where wrenches act on the sole, in the last link [m]
    sole: Float[np.ndarray, "feet 3 3"]  # takes vectors of a sole (x ahead, z up) to the last link
    link_mass: Float[np.ndarray, "feet j"]  # of the link that each joint moves [kg]
    link_com: Float[np.ndarray, "feet j 3"]  # its CoM in its own frame [m]
    toe: Float[np.ndarray, ""]  # contact length ahead of the foot point [m]
    heel: Float[np.ndarray, ""]  # contact length behind the foot point [m]
    half_width: Float[np.ndarray, ""]  # contact width to either side of the foot point [m]
    foot_ahead: Float[np.ndarray, " feet"]  # x from the middle of all foot points, standing [m]
    joint_lower: Float[np.ndarray, " joints"]  # [rad], leg by leg
    joint_upper: Float[np.ndarray, " joints"]  # [rad]
    torque_limit: Float[np.ndarray, " joints"]  # [N m]
    standing_joints: Float[np.ndarray, " joints"]  # [rad]
    standing_height: Float[np.ndarray, ""]  # CoM above the floor when standing [m]
    trunk_height: Float[np.ndarray, ""]  # trunk origin above the floor when standing [m]
    description: Description  # names and settings of its TOML; static, no array
    structure: Structure  # static


def describe(path: Path | None = None) -> Description:
    """Read the description of a robot.

    Args:
        path: TOML file; None takes the packaged hector.toml.

    Raises:
        InputError: as `read_description`.
    """
    if path is None:
        return HECTOR
    if (path := Path(path)).suffix != ".toml":
        raise InputError(f"{path}: expected the TOML file of a robot; {convert_by(path)}")
    return read_description(path)


def load_robot(path: Path | None = None) -> Robot:
    """Load the robot of a file accepted by `describe`.

    Raises:
        InputError: as `describe` and `build_model`.
    """
    return robot_of(describe(path))


def robot_of(description: Description, *, checked: bool = True) -> Robot:
    """Compile the robot of a description and read its constants.

    Raises:
        InputError: as `build_model`.
    """
    model = build_model(description, checked=checked)[1]
    with conversion(description.model):
        return _constants(description, model, checked)


def _constants(description: Description, model: mujoco.MjModel, checked: bool) -> Robot:
    data = standing_data(description, model)
    trunk = trunk_body(model)
    R_wb = data.xmat[trunk].reshape(3, 3)
    com = data.subtree_com[trunk]
    points = np.array([data.site(foot.point).xpos for foot in description.feet])
    # in the standard form the first joint is the trunk's, and the others are those of the legs
    standing_joints, ranges = data.qpos[7:].copy(), model.jnt_range[1:]
    R, centers = data.ximat.reshape(-1, 3, 3), data.xipos
    legs, spheres, radius = _legs(description, model)
    angles = standing_joints.reshape(len(spheres), -1)
    sole = np.stack([(R_wb @ R).T for R in map(_leg_rotation, legs["joint_axis"], angles)])
    sole = np.where(np.abs(sole - np.eye(3)).max() <= _TOLERANCE, np.eye(3), sole)  # rounding
    contacts = np.einsum("fij,fcj->fci", sole.mT, spheres)
    contacts[..., 2] -= radius
    if checked:
        check_soles(description.model, contacts)
    toe, heel, half_width = _sole_lengths(contacts)
    contact = {1: "point", 2: "line", 4: "flat"}[contacts.shape[1]]
    robot = Robot(
        mass=model.body_subtreemass[trunk].copy(),
        inertia=R_wb.T @ inertia_about(com, model.body_mass, model.body_inertia, R, centers) @ R_wb,
        com_offset=R_wb.T @ (com - data.xpos[trunk]),
        gravity=0.0 - model.opt.gravity,
        sole=sole,
        toe=toe,
        heel=heel,
        half_width=half_width,
        foot_ahead=_foot_ahead(points @ R_wb),
        joint_lower=ranges[:, 0].copy(),
        joint_upper=ranges[:, 1].copy(),
        torque_limit=model.actuator_ctrlrange[:, 1].copy(),
        standing_joints=standing_joints,
        standing_height=com[2].copy(),
        trunk_height=data.xpos[trunk][2].copy(),
        description=description,
        structure=Structure(closed_form=False, placed=(), contact=contact),
        **legs,
    )
    return robot._replace(structure=Structure(_closed_form(robot), _placed_rows(robot), contact))


def compile_model(description: Description) -> mujoco.MjModel:
    """Return the compiled and checked model of a description, with its pictures.

    Raises:
        InputError: as `build_model`.
    """
    return build_model(description, pictures=True)[1]


def build_model(
    description: Description, *, checked: bool = True, pictures: bool = False
) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Return the spec of a description, and its compiled model.

    Args:
        description: of the robot.
        checked: whether it must stand.
        pictures: whether it keeps them; they take half of the time to compile.

    Returns:
        The spec; its compiled model.

    Raises:
        InputError: one line with the value received, the expected one and the possible names, from
            `mjcf.read_mjcf`, MuJoCo, `checks.check_form` or `checks.check_standing`.
    """
    with conversion(description.model):
        root = read_mjcf(description.model, description.path)
        with mujoco_errors(description.model, root):
            spec = mujoco.MjSpec.from_string(text_of(root))
            if not pictures:
                for geom in spec.geoms:
                    geom.material = ""
                for picture in (*spec.materials, *spec.textures):
                    spec.delete(picture)
            model = spec.compile()
        check_form(description, model)
        if checked:
            check_standing(description, model)
    return spec, model


def _legs(
    description: Description, model: mujoco.MjModel
) -> tuple[dict[str, Any], Float[np.ndarray, "feet c 3"], Float[np.ndarray, "feet c"]]:
    """Read the legs in the pose with the trunk at the origin and all joints at zero.

    Returns:
        Fields of `Robot`; centres of the contacts' spheres from the foot points [m]; radii [m].
    """
    data, links, feet = data_at(model), model.jnt_bodyid[1:], description.feet
    anchor = data.xanchor[1:].reshape(len(feet), -1, 3)
    foot_point = np.array([data.site(foot.point).xpos for foot in feet]) - anchor[:, -1]
    spheres = [[model.geom(name).id for name in foot.contacts] for foot in feet]
    fields = {
        "joint_origin": np.diff(anchor, axis=1, prepend=0.0),
        "joint_axis": data.xaxis[1:].reshape(len(feet), -1, 3).copy(),
        "foot_point": foot_point,
        "link_mass": model.body_mass[links].reshape(len(feet), -1),
        "link_com": data.xipos[links].reshape(len(feet), -1, 3) - anchor,
    }
    contacts = data.geom_xpos[spheres] - anchor[:, -1:] - foot_point[:, None]
    return fields, contacts, model.geom_size[spheres, 0]


def _leg_rotation(axes: Float[np.ndarray, "j 3"], joints: Float[np.ndarray, " j"]) -> np.ndarray:
    """Return the rotation (3, 3) of a leg's last link relative to the trunk."""
    R = np.eye(3)
    for axis, angle in zip(axes, joints, strict=True):
        R = R @ Rotation.from_rotvec(angle * axis).as_matrix()
    return R


def _sole_lengths(contacts: Float[np.ndarray, "feet c 3"]) -> list[np.ndarray]:
    """Return toe, heel and half width [m] of the largest rectangle about the foot points."""
    count, lengths = contacts.shape[1], (0.0, 0.0, 0.0)
    if count > 1:
        x = np.sort(contacts[..., 0], axis=1)
        half_width = np.abs(contacts[..., 1]).min() if count == 4 else 0.0
        lengths = (x[:, count // 2 :].min(), -x[:, : count // 2].max(), half_width)
    return [np.asarray(length) for length in lengths]


def _foot_ahead(points: Float[np.ndarray, "feet 3"]) -> Float[np.ndarray, " feet"]:
    """Return the mean x of each foot's pair from the middle of all foot points [m]."""
    pair_x = np.repeat(points[:, 0].reshape(-1, 2).mean(axis=1), 2)
    return pair_x - pair_x.mean()


def _closed_form(robot: Robot) -> bool:
    """Return whether the closed-form inverse of `kinematics` holds for these legs.

    Yaw, roll and three pitches; thigh and shin straight down at zero; the knee bends one way only.
    """
    if robot.joint_axis.shape[1] != len(_CLOSED_AXES):
        return False
    low, high = (limit[3 :: len(_CLOSED_AXES)] for limit in (robot.joint_lower, robot.joint_upper))
    one_way = np.all((high < 0.0) & (low > -np.pi)) or np.all((low > 0.0) & (high < np.pi))
    down = robot.joint_origin[:, 3:]
    return bool(
        one_way
        and np.allclose(robot.joint_axis, _CLOSED_AXES, rtol=0, atol=_TOLERANCE)
        and np.allclose(robot.sole, np.eye(3), rtol=0, atol=_TOLERANCE)
        and np.all(np.abs(down[..., 0]) <= _TOLERANCE)
        and np.all(down[..., 2] < 0.0)
    )


def _placed_rows(robot: Robot) -> tuple[int, ...]:
    """Return the rows of the first foot's twist that its leg can control in the standing pose.

    The rows of the position come first, then pitch, yaw and roll of the sole if the joints suffice.
    """
    rows: list[int] = []
    axes, origin = robot.joint_axis[0], robot.joint_origin[0]
    joints = robot.standing_joints[: len(axes)]
    frames = [_leg_rotation(axes[:i], joints[:i]) for i in range(len(joints) + 1)]
    anchors = np.cumsum([R @ step for R, step in zip(frames, origin, strict=False)], axis=0)
    foot = anchors[-1] + frames[-1] @ robot.foot_point[0]
    turned_axes = np.array([R @ axis for R, axis in zip(frames, axes, strict=False)])
    length = np.linalg.norm(foot - anchors[0])
    J_w = (frames[-1] @ robot.sole[0]).T @ turned_axes.T
    J = np.concatenate([np.cross(turned_axes, foot - anchors).T / length, J_w])
    for row in (0, 1, 2, 4, 5, 3):
        J_rows = J[[*rows, row]]
        if len(J_rows) <= len(joints) and np.linalg.svd(J_rows)[1][-1] > _MIN_SINGULAR:
            rows.append(row)
    return tuple(sorted(rows))
