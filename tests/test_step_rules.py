"""Rules of the steps: against references, on residuals that SciPy fits, and as the paper has them.

The objective of `trust_region` is L / L(0) + ridge / 2 |z|^2, here often with L = |r|^2.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import least_squares, lsq_linear

from hector_jax.tuning import step_rules
from hector_jax.tuning.step_rules import predicted_gain, relative, trust_region

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


@pytest.mark.parametrize("seed", range(6))
def test_a_step_in_a_box_is_the_minimum_of_the_model_there(seed):
    """Of coupled coordinates: clipping the free minimum would end elsewhere, or go up."""
    rng, size = np.random.default_rng(seed), 5
    A, g = rng.normal(size=(8, size)), rng.normal(size=size)
    H, low, high = A.T @ A, -rng.uniform(0.0, 0.2, size), rng.uniform(0.0, 0.2, size)
    low[0] = high[1] = 0.0  # on a wall already
    _, state = begun(0.0, g, H, radius=1e3)
    step = np.asarray(step_rules.boxed_step(0.0, state, (jnp.asarray(low), jnp.asarray(high))))
    L = np.linalg.cholesky(H)
    exact = lsq_linear(L.T, np.linalg.solve(L, -g), (low, high + 1e-12))
    model = lambda s: g @ s + 0.5 * s @ H @ s  # noqa: E731
    assert ((low <= step) & (step <= high)).all()
    assert model(step) <= 0.98 * model(exact.x)
    clipped = np.clip(np.linalg.solve(H, -g), low, high)
    assert model(step) <= model(clipped) + 1e-12


def fitted(seed, ridge, refused):
    """Sums of exp(z) fitted to data, by 40 steps of the rule and by SciPy.

    The trials of the numbers in `refused` are refused.
    """
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.normal(size=(n, 4)))[0] for n in (12, 4))
    matrix = left @ np.diag([1.0, 0.5, 0.2, 0.1]) @ right
    data = matrix @ np.exp(rng.uniform(-1, 1, 4)) + 0.02 * rng.normal(size=12)
    residuals = lambda z: matrix @ np.exp(z) - data  # noqa: E731
    rule, z = trust_region(ridge), jnp.zeros(4)
    state, update = rule.init(z), jax.jit(rule.update)
    for number in range(40):
        r, J = residuals(np.asarray(z)), matrix * np.exp(np.asarray(z))
        value = jnp.asarray(np.inf if number in refused else r @ r)
        updates, state = update(2 * J.T @ r, state, z, value=value, matrix=2 * J.T @ J)
        z = optax.apply_updates(z, updates)
    share = np.sqrt(2.0 / np.sum(residuals(np.zeros(4)) ** 2))
    rows = lambda z: np.r_[share * residuals(z), np.sqrt(ridge) * z]  # noqa: E731
    exact = least_squares(rows, np.zeros(4), xtol=1e-12, ftol=1e-15, gtol=1e-12)
    return np.asarray(state.steps), exact.x


@pytest.mark.parametrize("refused", [(), (1,), (1, 2, 3), (2, 4, 5, 8)])
@pytest.mark.parametrize("ridge", [0.0, 0.01, 0.3])
def test_the_rule_alone_finds_the_minimum_that_scipy_finds(ridge, refused):
    """Also where some points are refused, as by a fall."""
    for seed in range(4):
        found, expected = fitted(seed, ridge, refused)
        assert np.linalg.norm(expected) > 0.05
        np.testing.assert_allclose(found, expected, atol=1e-4)


def after(ratio, *, radius=0.5, ridge=0.0, stiffness=1.0):
    """The states before and after a step whose true gain is `ratio` of the predicted; the step."""
    g, H = np.array([3.0, -4.0]), stiffness * np.eye(2)
    z, state = begun(ridge, g, H, 100.0, radius)
    gain = ratio * predicted_gain(ridge, state, z)
    value = state.first * (step_rules.objective(ridge, state, state.steps, state.value) - gain)
    value = value - state.first * 0.5 * ridge * z @ z
    if np.isfinite(ratio):
        found = float(step_rules.gain_ratio(ridge, state, z, value))
        assert found == pytest.approx(ratio, rel=1e-6, abs=1e-9)
    else:
        value = jnp.asarray(np.inf)
    _, new = update(ridge, jnp.asarray(g / 2), state, z, value, 2 * H)
    return state, new, z


RATIOS = [(1.0, 2.0, True), (0.61, 2.0, True), (0.59, 1.0, True), (0.26, 1.0, True)]
RATIOS += [(0.24, 0.25, True), (0.011, 0.25, True), (0.009, 1 / 8, False), (-2.0, 1 / 8, False)]
RATIOS += [(-np.inf, 1 / 8, False), (4.1, 2.0, True)]  # a gain beyond the prediction is no miss


@pytest.mark.parametrize("ridge", [0.0, 0.02])
@pytest.mark.parametrize(("ratio", "change", "accepted"), RATIOS)
def test_the_radius_follows_the_ratio_of_the_gains(ridge, ratio, change, accepted):
    before, new, z = after(ratio, ridge=ridge)
    assert float(new.size) == pytest.approx(change * float(before.size))
    point = z if accepted else before.steps
    np.testing.assert_array_equal(new.steps, point)
    assert float(new.matrix[0, 0]) == (2.0 if accepted else 1.0)
    assert float(new.first) == 100.0


def test_the_radius_grows_at_the_border_only_to_four_at_most_and_shrinks_to_a_part_of_the_step():
    before, new, z = after(1.0, radius=0.5, stiffness=100.0)  # ends inside
    assert np.linalg.norm(z) < 0.5 * float(before.size)
    assert float(new.size) == float(before.size)
    for radius in (2.5, 4.0):
        assert float(after(1.0, radius=radius, stiffness=0.1)[1].size) == 4.0
    for ratio, share in ((0.1, 1 / 4), (-1.0, 1 / 8)):
        _, new, z = after(ratio, radius=0.5, stiffness=100.0)
        assert float(new.size) == pytest.approx(share * np.linalg.norm(z))


def test_a_refusal_halves_the_papers_step_and_goes_back_and_a_rise_is_no_refusal():
    rule, z = relative(np.full(2, 0.05), np.zeros(2, int)), jnp.zeros(2)
    g = jnp.array([1.0, -0.5])
    updates, state = rule.update(g, rule.init(z), z, value=jnp.asarray(1.0))
    for share in (1.0, 0.5, 0.25):
        assert float(state.size) == share
        z = optax.apply_updates(z, updates)
        np.testing.assert_allclose(z, np.log(1 - share * 0.05 * g), rtol=1e-12)
        updates, state = rule.update(jnp.full(2, jnp.nan), state, z, value=jnp.asarray(np.inf))
    z = optax.apply_updates(z, updates)
    _, state = rule.update(g, state, z, value=jnp.asarray(5.0))
    assert float(state.size) == 0.25
    assert float(state.value) == 5.0
