"""Rotations, Euler rates and cross products: mathematics that knows no robot.

Euler angles are (roll, pitch, yaw) with R = Rz(yaw) Ry(pitch) Rx(roll), which takes body vectors to
the world; quaternions are w, x, y, z as in MuJoCo.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def rot_x(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation by `angle` [rad] about x."""
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.array([[one, zero, zero], [zero, c, -s], [zero, s, c]])


def rot_y(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation by `angle` [rad] about y."""
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.array([[c, zero, s], [zero, one, zero], [-s, zero, c]])


def rot_z(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation by `angle` [rad] about z."""
    c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
    return jnp.array([[c, -s, zero], [s, c, zero], [zero, zero, one]])


def rotation_from_euler(euler: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """R_wb of roll, pitch, yaw [rad]."""
    return rot_z(euler[2]) @ rot_y(euler[1]) @ rot_x(euler[0])


def euler_rates(euler: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """T with d(euler)/dt = T omega, omega in the world frame; singular at |pitch| = 90 degrees."""
    cp, tp = jnp.cos(euler[1]), jnp.tan(euler[1])
    cy, sy = jnp.cos(euler[2]), jnp.sin(euler[2])
    zero, one = jnp.zeros_like(cp), jnp.ones_like(cp)
    return jnp.array([[cy / cp, sy / cp, zero], [-sy, cy, zero], [cy * tp, sy * tp, one]])


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Matrix S(v) with S(v) w = v x w."""
    zero = jnp.zeros_like(v[0])
    return jnp.array([[zero, -v[2], v[1]], [v[2], zero, -v[0]], [-v[1], v[0], zero]])


def rotation_from_quaternion(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """R_wb of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def euler_from_rotation(R_wb: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Roll, pitch, yaw [rad] of R_wb; yaw in (-pi, pi]."""
    return jnp.array(
        [
            jnp.arctan2(R_wb[2, 1], R_wb[2, 2]),
            jnp.arcsin(jnp.clip(-R_wb[2, 0], -1.0, 1.0)),
            jnp.arctan2(R_wb[1, 0], R_wb[0, 0]),
        ]
    )


def wrap_angle(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle [rad] in [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi
