"""The active set of a QP, guessed and corrected by signs: a semismooth Newton method.

Each try factorises P + rho I + A'WA once, W the cap on active rows and zero on the others: five
tries on the QPs of walking, exact to rounding where it settles. On a GPU a kernel (`gpu_kernel`)
makes the first guess and one try proves it.
"""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve

from hector_jax.core.arrays import Array
from hector_jax.core.console import say
from hector_jax.core.tree import where
from hector_jax.qp import gpu_kernel
from hector_jax.qp.linear import (
    block_diagonal,
    cholesky,
    matvec,
    multiplier,
    plus_gram,
    rmatvec,
)
from hector_jax.qp.problem import SIGN, Normal, Point, Tolerances


class _Fixed(NamedTuple):
    """What all tries share."""

    tolerances: Tolerances
    qp: Normal
    sign: Array  # (2, 1)
    always: Array  # (2, m) bool: the one side of an equality
    eye: Array


class _Try(NamedTuple):
    point: Point
    active: Array  # (2, m) bool
    best: Point
    residuals: Array  # of the best point
    rho: Array
    iterations: Array
    going: Array


class _Factor(NamedTuple):
    """The matrix of one try."""

    active: Array
    weight: Array  # (2, m)
    cholesky: Array


_Corrected = tuple[Point, Array, Array]  # the point, which sides (2, m) are wrong, and by how much


def _signed(fixed: _Fixed, z: Array) -> Array:
    """Multipliers with their sign; those of equalities have none."""
    return jnp.where(fixed.always, z, jnp.maximum(z, 0.0))


def _correct(fixed: _Fixed, factor: _Factor, point: Point) -> _Corrected:
    """A pass of the method of multipliers, which takes six digits off."""
    qp, (x, z), least = fixed.qp, point, fixed.tolerances.rounding
    z = z + factor.weight * qp.violation(x)
    slope = qp.P @ x + qp.q + rmatvec(qp.A, multiplier(z))
    dx = -cho_solve((factor.cholesky, True), slope)
    x, z = x + dx, z + factor.weight * fixed.sign * matvec(qp.A, dx)
    outside = qp.violation(x)
    pulls, leaves = z < -least, outside > least * qp.row_sizes(x)
    wrong = jnp.where(factor.active, pulls, leaves) & ~fixed.always
    return Point(x, z), wrong, jnp.where(factor.active, -z, outside)


def _improve(fixed: _Fixed, limit: Array, state: _Try) -> _Try:
    """Factorise for a guess, and change the sides that are wrong."""
    tolerances, qp, *_ = fixed
    dtype = qp.q.dtype
    weight = jnp.where(state.active, jnp.asarray(tolerances.cap, dtype), 0.0)
    matrix = plus_gram(qp.P + state.rho * fixed.eye, qp.A, weight[0] + weight[1])
    correct = partial(_correct, fixed, _Factor(state.active, weight, cholesky(matrix)))

    def settle() -> tuple[_Corrected, Array]:
        """Digits and residuals are for a guess that stays."""
        done = correct(first[0])
        return done, qp.residuals(done[0]._replace(z=_signed(fixed, done[0].z)))

    first = correct(Point(state.point.x, jnp.where(state.active, state.point.z, 0.0)))
    none = jnp.full(3, jnp.inf, dtype)
    ((x, z), wrong, by), residuals = lax.cond(jnp.any(first[1]), lambda: (first, none), settle)
    changed = worst_sides(qp, wrong, state.active, by)
    point = Point(x, _signed(fixed, z))
    better = jnp.max(residuals) < jnp.max(state.residuals)
    best, residuals = where(better, (point, residuals), (state.best, state.residuals))
    # a factorisation that fails is tried again with a larger rho
    fine = jnp.isfinite(jnp.sum(x) + jnp.sum(z))
    point = where(fine, Point(x, z), state.point)
    active = where(fine, state.active ^ changed, state.active)
    rho = jnp.where(fine, state.rho, 100.0 * state.rho)
    iterations = state.iterations + 1
    # a flat P makes more passes worth their while though the guess stays
    going = ~fine | jnp.any(wrong) | (jnp.max(residuals) > tolerances.target)
    going &= (rho < 1.0) & (iterations < limit)
    return _Try(point, active, best, residuals, rho, iterations, going)


def active_set(
    tolerances: Tolerances, qp: Normal, start: Point, *, active: Array, enabled: Array, limit: Array
) -> tuple[Point, Array, Array]:
    """Solve with the active sides as equations, and correct the guess by signs until it stays.

    Args:
        tolerances: of the dtype.
        qp: the problem.
        start: where to begin.
        active: guess of the active sides (2, m).
        enabled: nothing is computed where this is false.
        limit: tries at most, as the guess may cycle.

    Returns:
        The best of the points whose guess stayed, its residuals (infinite where none did) and the
        number of tries.
    """
    dtype = qp.q.dtype
    sign = jnp.asarray(SIGN, dtype)
    always = jnp.zeros_like(qp.side).at[0].set(qp.equality)
    fixed = _Fixed(tolerances, qp, sign, always, jnp.eye(len(qp.q), dtype=dtype))
    first = _Try(
        start,
        (active & qp.side) | always,
        start,
        jnp.full(3, jnp.inf, dtype),
        jnp.asarray(tolerances.proximal, dtype),
        jnp.zeros((), jnp.int32),
        enabled,
    )
    end = lax.while_loop(lambda state: state.going, partial(_improve, fixed, limit), first)
    return end.best, end.residuals, end.iterations


def worst_sides(qp: Normal, wrong: Array, active: Array, by: Array) -> Array:
    """Of the wrong sides (2, m) those to change at once.

    Rows of a block share its few variables: one correction mends or spoils the others. So a block
    takes its worst of each kind, to let go and to take up, and the cycles of changing all are rare.
    """
    if qp.A.ndim == 2:
        return wrong
    blocks = (2, *qp.A.shape[:2])
    by = jnp.where(wrong, by, 0.0).reshape(blocks)
    active = active.reshape(blocks)
    most = lambda v: jnp.max(v, axis=(0, 2), keepdims=True)  # noqa: E731
    bar = jnp.where(active, most(jnp.where(active, by, 0.0)), most(jnp.where(active, 0.0, by)))
    return wrong & (by >= 0.9 * bar).reshape(wrong.shape)


def first_guess(qp: Normal, unconstrained: Point) -> tuple[Point, Array]:
    """Point and active sides (2, m) to start from, given the minimiser without rows."""

    def violated(qp: Normal) -> tuple[Point, Array]:
        outside = qp.violation(unconstrained.x)
        return unconstrained, worst_sides(qp, outside > 0, jnp.zeros_like(qp.side), outside)

    def pivoted(qp: Normal) -> tuple[Point, Array]:
        held = qp.side | qp.equality
        upper, lower = jnp.where(held, qp.bound, jnp.asarray(SIGN, qp.q.dtype) * jnp.inf)
        x, y, side, settled = gpu_kernel.guess(qp.P, qp.q, block_diagonal(qp.A), lower, upper)
        z = jnp.maximum(jnp.asarray(SIGN, y.dtype) * y, 0.0)
        usable = (settled > 0) & jnp.isfinite(jnp.sum(x) + jnp.sum(y))
        return where(usable, (Point(x, z), jnp.stack([side > 0, side < 0])), violated(qp))

    if jax.default_backend() != "gpu":
        return violated(qp)
    if qp.A.ndim != 3 or not gpu_kernel.fits(len(qp.q), len(qp.row)):
        _say_slower(len(qp.q), len(qp.row))
        return violated(qp)
    return lax.platform_dependent(qp, cuda=pivoted, default=violated)


@cache  # once for each size
def _say_slower(variables: int, rows: int) -> None:
    say(
        f"on a GPU a QP of {variables} variables and {rows} rows takes the slower path: the kernel "
        f"holds block-diagonal ones of up to {gpu_kernel.VARIABLES} and {gpu_kernel.ROWS}"
    )
