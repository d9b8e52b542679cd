"""Rotations against MuJoCo and their own derivatives."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hector_jax.core.arrays import contract
from hector_jax.core.geometry import (
    euler_from_rotation,
    euler_rates,
    inverse,
    rot_x,
    rot_y,
    rot_z,
    rotation_from_euler,
    rotation_from_quaternion,
    skew,
    wrap_angle,
)

rotations = jax.jit(jax.vmap(rotation_from_euler))
eulers = jax.jit(jax.vmap(euler_from_rotation))
SOME = jnp.asarray(np.random.default_rng(0).uniform([-3, -1.4, -3], [3, 1.4, 3], size=(20, 3)))


@pytest.mark.parametrize(("turn", "axis"), [(rot_x, 0), (rot_y, 1), (rot_z, 2)])
def test_a_rotation_about_an_axis_is_that_of_mujoco(turn, axis):
    quaternion, R = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, np.eye(3)[axis], 0.7)
    mujoco.mju_quat2Mat(R, quaternion)
    np.testing.assert_allclose(turn(jnp.array(0.7)), R.reshape(3, 3), atol=1e-14)


def test_a_quaternion_is_that_of_mujoco():
    quaternion = np.random.default_rng(1).normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quaternion)
    found = rotation_from_quaternion(jnp.asarray(quaternion))
    np.testing.assert_allclose(found, R.reshape(3, 3), atol=1e-14)


def test_roll_is_turned_by_pitch_and_then_by_yaw():
    R = rotation_from_euler(jnp.array([0.2, 0.3, 0.4]))
    expected = rot_z(jnp.array(0.4)) @ rot_y(jnp.array(0.3)) @ rot_x(jnp.array(0.2))
    np.testing.assert_allclose(R, expected, atol=1e-15)
    # yaw turns the heading, whatever roll and pitch are
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.4)


def test_rotations_are_orthogonal_and_their_euler_angles_come_back():
    R = rotations(SOME)
    products = np.einsum("nij,nik->njk", R, R)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(eulers(R), SOME, atol=1e-12)


def test_euler_rates_are_those_of_the_rotation():
    omega = jnp.array([0.3, -0.8, 0.5])
    for euler in SOME[:4]:
        rate = euler_rates(euler) @ omega
        _, change = jax.jvp(rotation_from_euler, (euler,), (rate,))
        np.testing.assert_allclose(change, skew(omega) @ rotation_from_euler(euler), atol=1e-12)


def test_skew_is_the_cross_product():
    a, b = jnp.array([1.0, -2.0, 3.0]), jnp.array([0.5, 0.7, -0.2])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))
    np.testing.assert_array_equal(skew(a), -skew(a).T)


def test_wrapped_angles_are_the_same_angle_within_half_a_turn():
    angle = jnp.linspace(-20.0, 20.0, 401)
    wrapped = wrap_angle(angle)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    np.testing.assert_allclose(np.cos(wrapped), np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(np.sin(wrapped), np.sin(angle), atol=1e-12)
    assert wrap_angle(jnp.array(0.3)) == pytest.approx(0.3)


def test_single_precision_stays_single():
    euler = jnp.array([0.1, 0.2, 0.3], jnp.float32)
    for made in (rotation_from_euler(euler), euler_rates(euler), skew(euler), wrap_angle(euler)):
        assert made.dtype == jnp.float32


def test_an_inverse_times_its_matrix_is_the_identity():
    M = np.random.default_rng(3).normal(size=(3, 3))  # not symmetric, unlike an inertia
    np.testing.assert_allclose(inverse(jnp.asarray(M)) @ M, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("subscripts", "shapes"),
    [("kjxy,kx->jy", [(4, 4, 3, 3), (4, 3)]), ("g,psi,gipo->pso", [(5,), (2, 2, 7), (5, 7, 2, 6)])],
)
def test_contract_is_einsum(subscripts, shapes):
    rng = np.random.default_rng(4)
    operands = [rng.normal(size=shape) for shape in shapes]
    expected = np.einsum(subscripts, *operands)
    np.testing.assert_allclose(contract(subscripts, *operands), expected, atol=1e-12)
