"""Rotations and the single rigid body: SciPy, momentum, orders of their errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ROBOT as HECTOR
from oracles import pack_state
from scipy.spatial.transform import Rotation

from hector_jax.core import geometry
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.trajectory import Load, State, Wrench, pack_wrench, zero_wrench
from hector_jax.robot import srbm

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


ROBOT = jax.tree.map(jnp.asarray, HECTOR)


def some_state(seed):
    draws = np.random.default_rng(seed).normal(size=(4, 3)) * np.array([[0.2], [0.3], [1.0], [0.5]])
    draws[1, 2] += 0.4
    return State(*map(jnp.asarray, draws))


def some_wrench(seed):
    rng = np.random.default_rng(100 + seed)
    return Wrench(*(jnp.asarray(size * rng.normal(size=(2, 3))) for size in (40, 3)))


FEET = jnp.array([[0.02, 0.08, 0.0], [-0.03, -0.09, 0.0]])


def test_momentum_changes_by_the_impulse_of_the_wrench_and_of_a_load():
    def momenta(state):
        R = rotation_from_euler(state.euler)
        spin = R @ ROBOT.inertia @ R.T @ state.ang_velocity
        linear = ROBOT.mass * state.velocity
        return linear, spin + jnp.cross(state.position, linear)

    state, wrench = some_state(1), some_wrench(1)
    load = Load(jnp.array([3.0, -2.0, 1.0]), jnp.array([0.1, 0.2, -0.3]))
    rates = srbm.rates(ROBOT, state, wrench, FEET, load)
    _, (linear, angular) = jax.jvp(momenta, (state,), (rates,))
    at_centre = load.force - ROBOT.mass * ROBOT.gravity
    force = wrench.force.sum(0) + at_centre
    torque = (jnp.cross(FEET, wrench.force) + wrench.moment).sum(0)
    torque = torque + load.torque + jnp.cross(state.position, at_centre)
    np.testing.assert_allclose(linear, force, atol=1e-10)
    np.testing.assert_allclose(angular, torque, atol=1e-10)


def test_halving_the_step_quarters_the_error_of_the_linearisation():
    def error(scale):
        """Of A x + B u against the exact Euler step, away from what was linearised about."""
        yaw = jnp.array([0.0, 0.0, 0.6])
        base = State(yaw, jnp.array([0.0, 0.0, 0.42]), jnp.zeros(3), jnp.zeros(3))
        away = some_state(4)
        state = jax.tree.map(lambda b, a: b + scale * (a - b), base, away)
        half = jnp.broadcast_to(ROBOT.mass * ROBOT.gravity / 2, (2, 3))
        wrench = Wrench(half + scale * some_wrench(4).force, scale * some_wrench(4).moment)
        # The lever of the linearisation is frozen, so it is the same foot under a moved body; the
        # static wrench has no moment about the CoM, which a turned inertia would turn too.
        lever = jnp.array([[0.0, 0.09, 0.0], [0.0, -0.09, 0.0]]) - base.position
        A, B = srbm.linearise(ROBOT, base.euler, lever, 0.03)
        x = A @ pack_state(state, ROBOT.gravity) + B @ pack_wrench(wrench)
        rate = srbm.rates(ROBOT, state, wrench, lever + state.position)
        exact = jax.tree.map(lambda s, d: s + 0.03 * d, state, rate)
        return float(jnp.linalg.norm(pack_state(exact, ROBOT.gravity) - x))

    assert error(0.0) < 1e-12
    assert 3.5 < error(1e-2) / error(5e-3) < 4.5


def test_free_fall_is_a_parabola_and_runge_kutta_is_of_fourth_order():
    state = some_state(0)._replace(ang_velocity=jnp.zeros(3))
    after = srbm.step(ROBOT, state, zero_wrench(), FEET, 0.1)
    expected = state.position + 0.1 * state.velocity - 0.5 * 0.1**2 * ROBOT.gravity
    np.testing.assert_allclose(after.position, expected, atol=1e-12)
    state, wrench = some_state(5), some_wrench(5)

    def walk(steps):
        s = state
        for _ in range(steps):
            s = srbm.step(ROBOT, s, wrench, FEET, 0.08 / steps)
        return pack_state(s, ROBOT.gravity)

    exact = walk(64)
    ratio = jnp.linalg.norm(walk(2) - exact) / jnp.linalg.norm(walk(4) - exact)
    assert 12 < ratio < 20


@pytest.mark.parametrize("seed", range(3))
def test_what_a_wrench_leaves_unexplained_is_the_load(seed):
    state, wrench, dt = some_state(seed), some_wrench(seed), 1e-4
    load = Load(jnp.array([3.0, -2.0, 1.0]), jnp.array([0.4, 0.2, -0.3]))
    after = srbm.step(ROBOT, state, wrench, FEET, dt, load=load)
    found = srbm.unexplained(ROBOT, state, after, wrench, FEET, dt=dt)
    np.testing.assert_allclose(found.force, load.force, atol=1e-6)
    np.testing.assert_allclose(found.torque, load.torque, atol=1e-3)
