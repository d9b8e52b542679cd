"""Kinematics of a compiled model in given poses: at joint angles, and standing."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.robot.description import Description


def rotation_of(quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation matrix of a quaternion (w, x, y, z)."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quat)
    return R.reshape(3, 3)


def data_at(model: mujoco.MjModel, angles: Mapping[Any, float] | None = None) -> mujoco.MjData:
    """Return the kinematics in a pose with free bodies upright at the origin.

    Args:
        model: compiled.
        angles: of joints [rad] by name or index; the other joints are at zero.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    for kind, start in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            data.qpos[start + 3 * (kind == mujoco.mjtJoint.mjJNT_FREE)] = 1.0
    for joint, angle in (angles or {}).items():
        if model.jnt_type[model.joint(joint).id] != mujoco.mjtJoint.mjJNT_BALL:
            data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def standing_data(description: Description, model: mujoco.MjModel) -> mujoco.MjData:
    """Return the kinematics and dynamics of a model in the standing pose."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(description.standing).id)
    mujoco.mj_forward(model, data)
    return data


def trunk_body(model: mujoco.MjModel) -> int:
    """Return the body that the free joint moves."""
    return int(model.jnt_bodyid[0])


def inertia_about(
    point: Float[np.ndarray, "3"],
    masses: Float[np.ndarray, " b"],
    moments: Float[np.ndarray, "b 3"],
    R: Float[np.ndarray, "b 3 3"],
    centers: Float[np.ndarray, "b 3"],
) -> Float[np.ndarray, "3 3"]:
    """Return the inertia [kg m^2] about a point of bodies fixed to each other.

    Args:
        point: [m].
        masses: [kg].
        moments: principal moments of inertia [kg m^2].
        R: principal axes, as columns.
        centers: centres of mass [m].
    """
    own = np.einsum("bij,bj,bkj->bik", R, moments, R)
    arm = centers - point
    square = np.einsum("bi,bi->b", arm, arm)[:, None, None] * np.eye(3)
    return (own + masses[:, None, None] * (square - arm[:, :, None] * arm[:, None, :])).sum(axis=0)
