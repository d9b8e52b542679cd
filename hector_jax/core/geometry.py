"""Rotations, Euler rates and cross products, independent of any robot.

Euler angles are (roll, pitch, yaw) with R = Rz(yaw) Ry(pitch) Rx(roll), which takes body vectors to
the world; quaternions are w, x, y, z as in MuJoCo.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array, contract

_CROSS = np.zeros((3, 3, 3))  # e_i x e_j = sum over k of _CROSS[i, k, j] e_k
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_i, _k, _j], _CROSS[_j, _k, _i] = 1.0, -1.0


def _like(array: Array, *matrices: np.ndarray) -> Any:
    """Cast constant matrices to the dtype of an array."""
    return [np.asarray(M, jnp.result_type(array)) for M in matrices]


def _about(axis: int, angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    # constant matrices compile faster than a rotation of twenty scalar operations
    along = np.diag(np.eye(3)[axis])
    along, plane, cross = _like(angle, along, np.eye(3) - along, _CROSS[axis])
    return along + jnp.cos(angle) * plane + jnp.sin(angle) * cross


def rot_x(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation by `angle` [rad] about x."""
    return _about(0, angle)


def rot_y(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation by `angle` [rad] about y."""
    return _about(1, angle)


def rot_z(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Return the rotation by `angle` [rad] about z."""
    return _about(2, angle)


def rotation_from_euler(euler: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return R_wb from roll, pitch, yaw [rad]."""
    return contract("ij,jk,kl->il", rot_z(euler[2]), rot_y(euler[1]), rot_x(euler[0]))


def euler_rates(euler: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return T in d(euler)/dt = T omega, omega in the world frame; singular at |pitch| = 90 deg."""
    roll = np.diag([1.0, 0.0, 0.0])
    yaw = np.roll(roll, 2, axis=0)
    roll, yaw, rest = _like(euler, roll, yaw, np.eye(3) - roll)
    by_heading = roll / jnp.cos(euler[1]) + yaw * jnp.tan(euler[1]) + rest
    return contract("ij,kj->ik", by_heading, rot_z(euler[2]))


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the matrix S(v) with S(v) w = v x w."""
    return contract("i,ijk->jk", v, np.asarray(_CROSS, jnp.result_type(v)))


def inverse(M: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the inverse in closed form: a factorisation would be library calls on a GPU."""
    cofactors = jnp.cross(M[np.array([1, 2, 0])], M[np.array([2, 0, 1])])
    return cofactors.T / jnp.sum(M[0] * cofactors[0])


def rotation_from_quaternion(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Return R_wb from a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def euler_from_rotation(R_wb: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return roll, pitch, yaw [rad] from R_wb; yaw in (-pi, pi]."""
    return jnp.array(
        [
            jnp.arctan2(R_wb[2, 1], R_wb[2, 2]),
            jnp.arcsin(jnp.clip(-R_wb[2, 0], -1.0, 1.0)),
            jnp.arctan2(R_wb[1, 0], R_wb[0, 0]),
        ]
    )


def wrap_angle(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Wrap an angle [rad] to [-pi, pi).

    >>> wrap_angle(jnp.array([0.5, 2 * jnp.pi + 0.5, -4.0])).round(3).tolist()
    [0.5, 0.5, 2.283]
    """
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi
