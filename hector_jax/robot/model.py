"""The robot as numbers: mass, lengths and limits, read from its MJCF and stated nowhere else.

`compile_model` compiles the MJCF of a description and has it checked (`checks`); `load_robot` reads
a `Robot` off the compiled model. Which names the parts have, the description says.

Frames: the trunk's is at the trunk body's origin, x ahead, y left, z up; a link's frame sits in the
joint that moves it, parallel to the trunk's when all joints are zero.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.robot.checks import check_model, trunk_body
from hector_jax.robot.description import DESCRIPTION_PATH, Description, read_description
from hector_jax.robot.source import build_spec, compile_spec


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

    trunk = trunk_body(model)
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
        InputError: one line saying what came, what was expected and what there is. The file must be
            one that `source.build_spec` takes and that compiles to the biped of `checks`.
    """
    model = compile_spec(description, build_spec(description).spec)
    check_model(description, model)
    return model


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
