"""Mehrotra's predictor and corrector, proximal in x and in the multipliers.

It always approaches an existing solution and yields the active set for a last correction; without
a solution its steps prove that there is none. The matrix is P + rho I + A'WA, W = 1 / (slack /
multiplier + delta), so that equality rows (slack zero), redundant rows and singular P need no
special cases.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve

from hector_jax.core.arrays import Array
from hector_jax.core.tree import where
from hector_jax.qp.certificates import certificates, rays
from hector_jax.qp.linear import cholesky, largest, matvec, multiplier, plus_gram, rmatvec
from hector_jax.qp.problem import SIGN, Approach, Normal, Point, Tolerances


class _Fixed(NamedTuple):
    """Data of all iterations."""

    tolerances: Tolerances
    qp: Normal
    least: Array  # (2,) smallest proximal parameters
    free: Array  # (2, m) bool: sides whose multiplier has no sign
    present: Array  # (2, m) bool: sides with a finite bound
    sides: Array  # number of sides whose multiplier has a sign, at least 1
    eye: Array


class _Loop(NamedTuple):
    point: Point
    before: Point
    slack: Array  # (2, m), positive; 1 on missing sides
    proximal: Array  # (2,) rho and delta
    iterations: Array
    running: Array


def _longest(qp: Normal, z: Array, slack: Array, dz: Array, dslack: Array) -> Array:
    """Return the step length at which the first slack or multiplier reaches zero."""
    rates = jnp.maximum(-dslack / slack, -dz / jnp.where(qp.side, z, 1.0))
    fastest = jnp.max(jnp.where(qp.side, rates, 0.0), initial=0.0)
    return 1.0 / jnp.maximum(fastest, jnp.finfo(z.dtype).tiny)


def _newton(fixed: _Fixed, state: _Loop) -> tuple[Callable[[Array], tuple], Array]:
    """Factorise the linear system at a point.

    Returns:
        A function that returns the Newton step (dx, dz, dslack) from slack * z to slack * z +
        product, and the mean product of slack and multiplier.
    """
    tolerances, qp, _, free, present, count, eye = fixed
    (x, z), slack = state.point, state.slack
    dual = qp.P @ x + qp.q + rmatvec(qp.A, multiplier(z))
    room = SIGN * (qp.bound - matvec(qp.A, x))
    primal = jnp.where(present, room - jnp.where(free, 0.0, slack), 0.0)
    mu = jnp.sum(jnp.where(qp.side, slack * z, 0.0)) / count
    rho, delta = state.proximal
    softness = jnp.where(free, 0.1 / tolerances.cap, slack + delta * z)
    inverse = jnp.where(present, 1.0 / softness, 0.0)
    weight = inverse * jnp.where(free, 1.0, z)
    factor = cholesky(plus_gram(qp.P + rho * eye, qp.A, weight[0] + weight[1]))

    def refine(_: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        dx, dz = step
        residual = dual + qp.P @ dx + rmatvec(qp.A, multiplier(dz))
        correction = -cho_solve((factor, True), residual)
        return dx + correction, dz + weight * SIGN * matvec(qp.A, correction)

    def direction(product: Array) -> tuple[Array, Array, Array]:
        # later passes remove the error of rounding and rho
        begin = jnp.zeros_like(qp.q), inverse * product - weight * primal
        dx, dz = lax.fori_loop(0, 3, refine, begin)
        along = SIGN * matvec(qp.A, dx)
        return dx, dz, jnp.where(qp.side, primal - along + delta * dz, 0.0)

    return direction, mu


def _advance(fixed: _Fixed, limit: int, state: _Loop) -> _Loop:
    """Run one iteration: predictor, centring, corrector."""
    tolerances, qp, least, *_ = fixed
    (x, z), slack, dtype = state.point, state.slack, qp.q.dtype
    direction, mu = _newton(fixed, state)
    longest = partial(_longest, qp, z, slack)

    product = jnp.where(qp.side, -slack * z, 0.0)
    _, dz, dslack = direction(product)
    step = jnp.minimum(longest(dz, dslack), 1.0)
    reached = (slack + step * dslack) * (z + step * dz)
    ratio = jnp.sum(jnp.where(qp.side, reached, 0.0)) / fixed.sides / jnp.where(mu > 0, mu, 1.0)
    centre = mu * jnp.clip(ratio, 0.0, 1.0) ** 3
    dx, dz, dslack = direction(jnp.where(qp.side, product + centre - dslack * dz, 0.0))
    step = jnp.minimum(0.995 * longest(dz, dslack), 1.0)
    new = (Point(x + step * dx, z + step * dz), slack + step * dslack)
    # a failed factorisation is repeated with larger proximal parameters
    finite = jnp.isfinite(jnp.sum(new[0].x) + jnp.sum(new[0].z) + jnp.sum(new[1]))
    point, slack = where(finite, new, (state.point, state.slack))
    factors = jnp.where(finite, 0.1, jnp.array([10.0, 100.0], dtype))
    proximal = jnp.maximum(factors * state.proximal, least)
    residuals = qp.inner_residuals(point)
    converged = jnp.max(residuals) <= tolerances.target
    iterations = state.iterations + 1
    residual, threshold = rays(tolerances, qp, state.point, point)
    running = ~converged & ~jnp.any(residual < threshold) & (proximal[0] < 1.0)
    running &= iterations < limit
    return _Loop(point, state.point, slack, proximal, iterations, running)


def interior_point(
    tolerances: Tolerances, qp: Normal, enabled: Array, *, max_iterations: int
) -> tuple[Point, Array, Array, Array]:
    """Solve from a cold start. Returns the last finite point, slacks, certificates and iterations.

    If `enabled` is false nothing is computed.
    """
    dtype = qp.q.dtype
    least = jnp.array([10.0 * tolerances.proximal, 50.0 * jnp.finfo(dtype).eps], dtype)
    free = jnp.zeros_like(qp.side).at[0].set(qp.equality)
    present = qp.side | free
    count = jnp.maximum(jnp.sum(qp.side), 1)
    eye = jnp.eye(len(qp.q), dtype=dtype)
    fixed = _Fixed(tolerances, qp, least, free, present, count, eye)
    # all products of slack and multiplier are equal, however far the bound
    room = jnp.where(qp.side, jnp.maximum(SIGN * qp.bound, qp.reach), 1.0)
    begin = Point(jnp.zeros_like(qp.q), jnp.where(qp.side, 1.0 / jnp.maximum(room, 1.0), 0.0))
    start = _Loop(begin, begin, room, least, jnp.zeros((), jnp.int32), enabled)
    advance = partial(_advance, fixed, max_iterations)
    end = lax.while_loop(lambda state: state.running, advance, start)
    proofs = certificates(tolerances, qp, end.before, end.point)
    return end.point, end.slack, proofs, end.iterations


def approach(
    tolerances: Tolerances, qp: Normal, enabled: Array, *, max_iterations: int
) -> Approach:
    """Run the interior point method, and once more in the scales of its result if it stays far.

    `normalise` scales x and slope by one size from q and the bounds. If rows hold x far from the
    unconstrained minimiser the sizes differ, and the regularisation of one is too coarse for the
    other.
    """

    def attempt(state: tuple) -> tuple:
        best, (size, slope), _ = state
        first = best.iterations == 0
        # a step that was no ray at first stops no second attempt
        scaled = qp._replace(P=size / slope * qp.P, q=qp.q / slope, flat=qp.flat & first)
        scaled = scaled._replace(bound=qp.bound / size, reach=qp.reach / size)
        point, slack, certified, iterations = interior_point(
            tolerances, scaled, enabled, max_iterations=max_iterations
        )
        point = Point(size * point.x, slope * point.z)
        residuals = qp.inner_residuals(point)
        better = first | (jnp.max(residuals) < jnp.max(best.residuals))
        before = best.point, best.slack, best.residuals
        point, slack, residuals = where(better, (point, size * slack, residuals), before)
        sizes = jnp.stack([largest(point.x), jnp.maximum(largest(qp.P @ point.x), largest(qp.q))])
        far = first & (jnp.max(residuals) > tolerances.target)
        again = far & ~jnp.any(certified) & jnp.all(sizes > 0.0)
        best = Approach(point, slack, residuals, certified, best.iterations + iterations)
        return best, jnp.where(again, sizes, 1.0), again

    initial = Approach(
        Point(jnp.zeros_like(qp.q), jnp.zeros_like(qp.bound)),
        jnp.ones_like(qp.bound),
        jnp.full(3, jnp.inf, qp.q.dtype),
        jnp.zeros(2, bool),
        jnp.zeros((), jnp.int32),
    )
    start = initial, jnp.ones(2, qp.q.dtype), enabled
    return lax.while_loop(lambda state: state[-1], attempt, start)[0]
