import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ROBOT as HECTOR
from oracles import pack_state

from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.trajectory import Load, State, Wrench, pack_wrench, zero_wrench
from hector_jax.robot import srbm

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
