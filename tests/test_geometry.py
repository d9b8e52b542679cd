"""Rotations against SciPy and their own derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hector_jax.core import geometry

rotations = jax.jit(jax.vmap(geometry.rotation_from_euler))
eulers = jax.jit(jax.vmap(geometry.euler_from_rotation))
SOME = jnp.asarray(np.random.default_rng(0).uniform([-3, -1.4, -3], [3, 1.4, 3], size=(20, 3)))


def test_rotations_are_those_of_scipy_and_their_euler_angles_come_back():
    """Roll is turned by pitch, and then by yaw."""
    expected = Rotation.from_euler("xyz", SOME)
    np.testing.assert_allclose(rotations(SOME), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(eulers(rotations(SOME)), SOME, atol=1e-12)
    quaternions = jnp.asarray(expected.as_quat(scalar_first=True))
    found = jax.vmap(geometry.rotation_from_quaternion)(quaternions)
    np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-14)
    for turn, axis in ((geometry.rot_x, "x"), (geometry.rot_y, "y"), (geometry.rot_z, "z")):
        R = Rotation.from_euler(axis, 0.7).as_matrix()
        np.testing.assert_allclose(turn(jnp.array(0.7)), R, atol=1e-14)


def test_wrapped_angles_are_the_same_angle_within_half_a_turn_and_single_precision_stays():
    angle = jnp.linspace(-20.0, 20.0, 401)
    wrapped = geometry.wrap_angle(angle)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    np.testing.assert_allclose(np.cos(wrapped), np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(np.sin(wrapped), np.sin(angle), atol=1e-12)
    assert geometry.wrap_angle(jnp.array(0.3)) == pytest.approx(0.3)
    euler = jnp.array([0.1, 0.2, 0.3], jnp.float32)
    for name in ("rotation_from_euler", "euler_rates", "skew", "wrap_angle"):
        assert getattr(geometry, name)(euler).dtype == jnp.float32


def test_euler_rates_skew_and_the_inverse_are_what_they_are_called():
    omega = jnp.array([0.3, -0.8, 0.5])
    np.testing.assert_allclose(geometry.skew(omega) @ SOME[0], np.cross(omega, SOME[0]))
    for euler in SOME[:4]:
        rate = geometry.euler_rates(euler) @ omega
        R, change = jax.jvp(geometry.rotation_from_euler, (euler,), (rate,))
        np.testing.assert_allclose(change, geometry.skew(omega) @ R, atol=1e-12)
    M = np.random.default_rng(3).normal(size=(3, 3))  # not symmetric, unlike an inertia
    np.testing.assert_allclose(geometry.inverse(jnp.asarray(M)) @ M, np.eye(3), atol=1e-12)
