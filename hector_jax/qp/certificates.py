"""What a QP's data and a step prove: curvature, a held minimiser, no solution, no lower bound."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve

from hector_jax.core.arrays import Array
from hector_jax.qp.linear import cholesky, largest, matvec, multiplier, plus_gram, rmatvec
from hector_jax.qp.problem import SIGN, Normal, Point, Tolerances


def _shifted(matrix: Array, shift: float) -> tuple[Array, Array]:
    """Cholesky factor of a matrix plus a multiple of the unit matrix, and whether there is one.

    So a smallest eigenvalue is compared exactly. Pivots would not tell: that of a singular matrix
    grows with the number of variables that share the flat direction.
    """
    factor = cholesky(matrix + shift * jnp.eye(len(matrix), dtype=matrix.dtype))
    return factor, jnp.isfinite(factor[-1, -1])


def without_rows(tolerances: Tolerances, qp: Normal) -> tuple[Array, Array, Array]:
    """Minimiser without rows; whether P curves in every direction; whether it is semidefinite.

    One factorisation where P curves.
    """

    def minimiser(shift: float, qp: Normal) -> tuple[Array, Array]:
        factor, exists = _shifted(qp.P, shift)
        return -cho_solve((factor, True), qp.q), exists

    x, curved = minimiser(-tolerances.curvature, qp)
    softened = partial(minimiser, tolerances.proximal)
    x, convex = only_if(~curved, softened, (x, curved), qp)
    return x, curved, convex


def only_if(enabled: Array, function: Callable, otherwise: Any, operands: Any) -> Any:
    """`function(operands)` where `enabled`, else `otherwise`; costs nothing where none is enabled.

    A loop of one round, because vmap makes a cond compute for every problem of a batch.
    """

    def once(state: tuple) -> tuple:
        # that reads the state, or the compiler would compute it once, before the loop
        _, hidden = lax.optimization_barrier((state[0], operands))
        return jnp.zeros((), bool), function(hidden)

    return lax.while_loop(lambda state: state[0], once, (enabled, otherwise))[1]


def is_held(tolerances: Tolerances, qp: Normal, point: Point) -> Array:
    """Whether P and the rows hold a minimiser in every direction.

    A row holds where it is an equality or presses with more than the tolerance. One that is active
    without force does not: the minimiser can leave it.
    """
    force = point.z / qp.slope_size(point)
    slack = jnp.abs(qp.violation(point.x)) / qp.row_sizes(point.x)
    pressing = qp.side & (force > tolerances.residual) & (force > slack)
    holding = qp.equality | jnp.any(pressing, axis=0)
    # the cap's rounding could hide a flat direction; this one's is a hundredth of the curvature
    weight = jnp.where(holding, 0.01 * tolerances.curvature / jnp.finfo(force.dtype).eps, 0.0)
    return _shifted(plus_gram(qp.P, qp.A, weight), -tolerances.curvature)[1]


def rays(tolerances: Tolerances, qp: Normal, before: Point, point: Point) -> tuple[Array, Array]:
    """What a step leaves of a proof that no x of moderate size meets the rows, of an endless fall.

    Without a solution the multipliers grow for ever along a combination of rows that cancels, or x
    along a fall. A step shows that purely; in the point itself is a part that does not cancel.

    Returns:
        What should be zero (2,), and a share of what it is to be small beside: below it, the step
        shows a ray.
    """
    dx, rise = point.x - before.x, point.z - before.z
    sign = jnp.asarray(SIGN, dx.dtype)
    grown = jnp.where(qp.equality, rise, jnp.maximum(rise, 0.0))  # what falls counts against it
    gap = -jnp.sum(sign * qp.bound * grown + (grown - rise) / tolerances.certificate)
    # differences of products that an iteration needs at both points anyway
    pull = rmatvec(qp.A, multiplier(point.z)) - rmatvec(qp.A, multiplier(before.z))
    outside = sign * (matvec(qp.A, point.x) - matvec(qp.A, before.x))
    outward = jnp.where(qp.equality, jnp.abs(outside), jnp.where(qp.side, outside, 0.0))
    needed = jnp.maximum(largest(qp.P @ point.x - qp.P @ before.x), jnp.max(outward, initial=0.0))
    # where P curves in every direction no fall is endless
    left = jnp.stack([largest(pull), jnp.where(qp.flat, needed, jnp.inf)])
    return left, tolerances.certificate * jnp.stack([gap, -jnp.dot(qp.q, dx)])


def certificates(tolerances: Tolerances, qp: Normal, before: Point, point: Point) -> Array:
    """Whether the step proves that the problem is infeasible, and unbounded (2,).

    By more than the tolerance, within which it can be solved, and by more than rounding.
    """
    dx, rise = point.x - before.x, point.z - before.z
    rows = jnp.sum(jnp.abs(rise) * qp.row_sizes(point.x))
    sizes = jnp.stack([rows, jnp.sum(jnp.abs(dx)) * qp.slope_size(point)])
    left, share = rays(tolerances, qp, before, point)
    A, x = jnp.abs(qp.A), jnp.abs(point.x)
    terms = largest(rmatvec(A, jnp.sum(jnp.abs(point.z), axis=0)))
    rounding = jnp.finfo(x.dtype).eps * jnp.stack(
        [terms, jnp.maximum(largest(jnp.abs(qp.P) @ x), largest(matvec(A, x)))]
    )
    certain = left + rounding < share
    return certain & (share > tolerances.certificate * tolerances.residual * sizes)
