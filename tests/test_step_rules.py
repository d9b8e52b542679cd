"""Rules of the steps: against references, on residuals that SciPy fits, and as the paper has them.

The objective of `trust_region` is L / L(0) + ridge / 2 |z|^2, here often with L = |r|^2.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import brentq, least_squares

from hector_jax.tuning.step_rules import (
    LARGEST,
    gain_ratio,
    literal,
    objective,
    predicted_gain,
    relative,
    trust_region,
)

RIDGES, RADII = (0.0, 0.01, 1.0), (1e-6, 0.1, 1.0, 1e3)


def positive(seed, rank, size=6):
    """A random positive semidefinite matrix whose eigenvalues span six decades."""
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(size, size)))[0][:, :rank]
    return (vectors * 10.0 ** rng.uniform(-3, 3, rank)) @ vectors.T


def begun(ridge, gradient, matrix, value=1.0, radius=1.0):
    """The first step and the state from which it was made."""
    start = jnp.zeros(len(gradient))
    state = trust_region(ridge).init(start)._replace(size=jnp.asarray(radius))
    return update(ridge, jnp.asarray(gradient), state, start, value, matrix)


@partial(jax.jit, static_argnums=0)
def update(ridge, gradient, state, z, value, matrix):
    return trust_region(ridge).update(gradient, state, z, value=value, matrix=matrix)


# The step within the trust region


@pytest.mark.parametrize("ridge", RIDGES)
@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize("rank", [0, 1, 3, 6])
def test_a_step_fulfils_the_optimality_conditions_of_the_trust_region(ridge, radius, rank):
    """(H + lambda I) s = -g with lambda >= 0 and lambda (|s| - radius) = 0 are sufficient too."""
    for seed in range(8):
        matrix, value = positive(seed, rank), 7.0
        g = np.random.default_rng(seed).normal(size=6)
        if radius > 100.0 and ridge == 0.0:  # without a bound a gradient in the null space is one
            g = matrix @ g
        step = np.asarray(begun(ridge, value * g, value * matrix, value, radius)[0])
        H, length = matrix + ridge * np.eye(6), np.linalg.norm(step)
        scale = max(float(np.linalg.norm(g)), 1e-300)
        assert length <= radius * (1 + 1e-9)
        damping = max(-(H @ step + g) @ step / max(step @ step, 1e-300), 0.0)
        np.testing.assert_allclose((H + damping * np.eye(6)) @ step, -g, atol=1e-6 * scale)
        assert damping * abs(length - radius) <= 1e-6 * scale


def test_a_step_does_not_depend_on_the_unit_of_the_loss():
    g, H = np.array([1.0, -2.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    one, other = (begun(0.1, k * g, k * H, k)[0] for k in (1.0, 1e9))
    np.testing.assert_allclose(one, other, rtol=1e-12)


# A whole descent


class Fit:
    """Sums of exp(z) to be fitted to data: residuals that are not linear in z."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        left, right = (np.linalg.qr(rng.normal(size=(n, 4)))[0] for n in (12, 4))
        self.matrix = left @ np.diag([1.0, 0.5, 0.2, 0.1]) @ right
        self.data = self.matrix @ np.exp(rng.uniform(-1, 1, 4)) + 0.02 * rng.normal(size=12)

    def residuals(self, z):
        """Return the residuals at z."""
        return self.matrix @ np.exp(z) - self.data

    def jacobian(self, z):
        """Return their derivative by z."""
        return self.matrix * np.exp(z)

    def minimum(self, ridge):
        """The minimum by SciPy, on the residuals with the rows sqrt(ridge) z of the ridge."""
        first = 2.0 / np.sum(self.residuals(np.zeros(4)) ** 2)
        rows = lambda z: np.r_[np.sqrt(first) * self.residuals(z), np.sqrt(ridge) * z]  # noqa: E731
        return least_squares(rows, np.zeros(4), xtol=1e-12, ftol=1e-15, gtol=1e-12).x


def descend(fit, ridge, steps, refused=()):
    """The loop of the docstring of `step_rules`; the trials of these numbers are refused."""
    rule, z = trust_region(ridge), jnp.zeros(4)
    state, update = rule.init(z), jax.jit(rule.update)
    for number in range(steps):
        r, J = fit.residuals(np.asarray(z)), fit.jacobian(np.asarray(z))
        value = jnp.asarray(np.inf if number in refused else r @ r)
        updates, state = update(2 * J.T @ r, state, z, value=value, matrix=2 * J.T @ J)
        z = optax.apply_updates(z, updates)
    return np.asarray(state.steps)


@pytest.mark.parametrize("refused", [(), (1,), (1, 2, 3), (2, 4, 5, 8)])
@pytest.mark.parametrize("ridge", [0.0, 0.01, 0.3])
def test_the_rule_alone_finds_the_minimum_that_scipy_finds(ridge, refused):
    """Also where some points are refused, as by a fall."""
    for seed in range(4):
        fit = Fit(seed)
        found, expected = descend(fit, ridge, 40, refused), fit.minimum(ridge)
        assert np.linalg.norm(expected) > 0.05
        np.testing.assert_allclose(found, expected, atol=1e-4)


# The radius and the model's quality


def after(ratio, *, radius=0.5, ridge=0.0, stiffness=1.0):
    """The states before and after a step whose true gain is `ratio` of the predicted one."""
    g, H = np.array([3.0, -4.0]), stiffness * np.eye(2)
    step, state = begun(ridge, g, H, 100.0, radius)
    z = state.steps + step
    gain = ratio * predicted_gain(ridge, state, z)
    value = state.first * (objective(ridge, state, state.steps, state.value) - gain)
    value = value - state.first * 0.5 * ridge * z @ z
    if np.isfinite(ratio):
        assert float(gain_ratio(ridge, state, z, value)) == pytest.approx(ratio, rel=1e-6, abs=1e-9)
    else:
        value = jnp.asarray(np.inf)
    updates, new = update(ridge, jnp.asarray(g / 2), state, z, value, 2 * H)
    return state, new, z, z + updates


@pytest.mark.parametrize("ridge", [0.0, 0.02])
@pytest.mark.parametrize(
    ("ratio", "change", "accepted", "misses"),
    [
        (1.0, 2.0, True, 0),
        (0.61, 2.0, True, 0),
        (0.59, 1.0, True, 0),
        (0.26, 1.0, True, 0),
        (0.24, 0.25, True, 1),
        (0.011, 0.25, True, 1),
        (0.009, 1 / 8, False, 1),
        (-2.0, 1 / 8, False, 1),
        (-np.inf, 1 / 8, False, 0),  # a fall says nothing about the model
        (3.9, 2.0, True, 0),
        (4.1, 2.0, True, 1),
    ],
)
def test_the_radius_follows_the_ratio_of_the_gains(ridge, ratio, change, accepted, misses):
    before, new, z, _ = after(ratio, ridge=ridge)
    assert float(new.size) == pytest.approx(change * float(before.size))
    assert int(new.misses) == misses
    point = z if accepted else before.steps
    np.testing.assert_array_equal(new.steps, point)
    assert float(new.matrix[0, 0]) == (2.0 if accepted else 1.0)
    assert float(new.first) == 100.0


def test_the_radius_grows_at_the_border_only_and_to_four_at_most():
    before, new, z, _ = after(1.0, radius=0.5, stiffness=100.0)  # ends inside
    assert np.linalg.norm(z) < 0.5 * float(before.size)
    assert float(new.size) == float(before.size)
    assert LARGEST == 4.0
    for radius, wanted in ((2.5, 4.0), (4.0, 4.0)):
        assert float(after(1.0, radius=radius, stiffness=0.1)[1].size) == wanted


def test_a_wrong_step_inside_the_region_shrinks_it_to_a_part_of_the_step():
    for ratio, share in ((0.1, 1 / 4), (-1.0, 1 / 8)):
        _, new, z, _ = after(ratio, radius=0.5, stiffness=100.0)
        assert float(new.size) == pytest.approx(share * np.linalg.norm(z))


def test_after_a_rejection_the_shorter_step_leaves_from_the_accepted_point():
    before, new, _, trial = after(-1.0, radius=0.5)
    again, _ = begun(0.0, np.array([3.0, -4.0]), np.eye(2), 100.0, 0.5 / 8)
    np.testing.assert_allclose(trial, np.asarray(before.steps + again), rtol=1e-9)
    assert float(new.value) == float(before.value)


def test_wrong_ratios_are_counted_in_a_row_across_falls():
    z, g, H, counts = jnp.zeros(1), jnp.ones(1), np.eye(1), []
    updates, state = begun(0.0, g, H, 100.0)
    for ratio in (0.1, -np.inf, 5.0, 0.5, 0.1):
        z = z + updates
        gain = ratio * predicted_gain(0.0, state, z)
        value = state.value - state.first * gain if np.isfinite(ratio) else np.inf
        updates, state = update(0.0, g, state, z, value, H)
        counts.append(int(state.misses))
    assert counts == [1, 1, 2, 0, 1]


def test_a_start_that_is_refused_is_no_start():
    rule, z = trust_region(0.01), jnp.zeros(2)
    given = {"value": jnp.asarray(np.inf), "matrix": jnp.full((2, 2), jnp.nan)}
    _, state = rule.update(jnp.full(2, jnp.nan), rule.init(z), z, **given)
    assert np.isinf(state.value)
    assert float(state.size) == 1.0
    assert np.isfinite(np.asarray(state.gradient)).all()
    assert np.isfinite(np.asarray(state.matrix)).all()


# The paper's rules, in the coordinates of two blocks of log-steps and one of shares

BLOCKS = np.array([0, 0, 0, 1, 1, 2])


def first_order(rule, z, gradient, share=1.0, value=1.0):
    state = rule.init(z)._replace(size=jnp.asarray(share / 2.0))  # an acceptance doubles it
    updates, state = rule.update(gradient, state, z, value=jnp.asarray(value))
    return np.asarray(updates), state


def test_the_largest_relative_step_of_a_block_is_its_beta():
    betas = np.array([0.05, 0.05, 0.05, 0.08, 0.08, 0.02])
    g, z = jnp.array([1.0, -2.0, 0.5, 3.0, -1.0, -7.0]), jnp.arange(6) / 10.0
    updates, _ = first_order(relative(betas, BLOCKS), z, g)
    down = betas * np.asarray(g) / np.array([2.0, 2.0, 2.0, 3.0, 3.0, 7.0])
    np.testing.assert_allclose(updates[:5], np.log(1 - down[:5]), rtol=1e-12)
    assert updates[5] == pytest.approx(0.02)
    still, _ = first_order(relative(betas, BLOCKS), z, jnp.zeros(6))
    np.testing.assert_array_equal(still, np.zeros(6))


def test_the_literal_step_is_the_papers_formula():
    """Theta less beta times its gradient, the mean over the feet that share a weight."""
    theta, feet, beta = np.array([30.0, 2e-4]), np.array([1, 2]), np.array([0.05, 0.08])
    of_feet = [np.array([0.4]), np.array([2e-6, -5e-6])]
    z = jnp.array([0.3, -0.2])
    now = theta * np.exp(np.asarray(z))
    log_gradient = jnp.asarray([now[0] * of_feet[0].sum(), now[1] * of_feet[1].sum()])
    updates, _ = first_order(literal(beta, jnp.asarray(feet * theta**2)), z, log_gradient)
    expected = now - beta * np.array([part.mean() for part in of_feet])
    np.testing.assert_allclose(now * np.exp(updates), expected, rtol=1e-12)


def test_a_refusal_halves_the_papers_step_and_goes_back():
    rule, z = relative(np.full(2, 0.05), np.zeros(2, int)), jnp.zeros(2)
    g = jnp.array([1.0, -0.5])
    updates, state = rule.update(g, rule.init(z), z, value=jnp.asarray(1.0))
    assert float(state.size) == 1.0
    for share in (0.5, 0.25):
        z = jnp.asarray(z) + jnp.asarray(updates)
        updates, state = rule.update(jnp.full(2, jnp.nan), state, z, value=jnp.asarray(np.inf))
        assert float(state.size) == share
        np.testing.assert_allclose(
            z + jnp.asarray(updates), np.log(1 - share * 0.05 * g), rtol=1e-12
        )
    _, state = rule.update(
        g, state, optax.apply_updates(z, updates), value=jnp.asarray(5.0)
    )  # a rise is no refusal
    assert float(state.size) == 0.5
    assert float(state.value) == 5.0


@pytest.mark.parametrize("ridge", RIDGES)
@pytest.mark.parametrize("radius", RADII[:3])
def test_a_step_is_that_of_the_secular_equation(ridge, radius):
    for seed in range(8):
        H = positive(seed, 6) + ridge * np.eye(6)
        g = np.random.default_rng(seed).normal(size=6)
        step = begun(ridge, g, H - ridge * np.eye(6), 1.0, radius)[0]
        damped = lambda damping, H=H, g=g: np.linalg.solve(H + damping * np.eye(6), -g)  # noqa: E731
        excess = lambda damping: np.linalg.norm(damped(damping)) - radius  # noqa: E731, B023
        inside = excess(0.0) <= 0.0
        damping = 0.0 if inside else brentq(excess, 0.0, 2 * np.linalg.norm(g) / radius, xtol=1e-14)
        np.testing.assert_allclose(step, damped(damping), rtol=1e-6, atol=1e-8 * radius)
