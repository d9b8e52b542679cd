"""Proofs from a QP's data and a step: curvature, unique minimiser, infeasible, unbounded."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve

from hector_jax.core.arrays import Array
from hector_jax.qp.linear import cholesky, largest, matvec, multiplier, plus_gram, rmatvec
from hector_jax.qp.problem import SIGN, Normal, Point, Tolerances


def _shifted(matrix: Array, shift: float) -> tuple[Array, Array]:
    """Factorise a matrix plus `shift` times the identity; return the factor and whether it exists.

    Its existence compares the smallest eigenvalue exactly. Pivots do not: those of a singular
    matrix grow with the number of variables that share the flat direction.
    """
    factor = cholesky(matrix + shift * jnp.eye(len(matrix), dtype=matrix.dtype))
    return factor, jnp.isfinite(factor[-1, -1])


def curvature(tolerances: Tolerances, qp: Normal) -> tuple[Array, Array, Array]:
    """Return the minimiser without rows, whether P is definite and whether it is semidefinite.

    A definite P takes one factorisation.
    """

    def minimise(qp: Normal, shift: float) -> tuple[Array, Array]:
        factor, exists = _shifted(qp.P, shift)
        return -cho_solve((factor, True), qp.q), exists

    x, definite = minimise(qp, -tolerances.curvature)
    proximal = lambda qp: minimise(qp, tolerances.proximal)  # noqa: E731
    x, convex = only_if(~definite, proximal, (x, definite), qp)
    return x, definite, convex


def only_if(enabled: Array, function: Callable, otherwise: Any, *operands: Any) -> Any:
    """Return `function(*operands)` if `enabled`, else `otherwise`, at no cost if none is enabled.

    This is a loop of one iteration, because under vmap a cond computes both branches.
    """

    def once(state: tuple) -> tuple:
        # depend on the state, otherwise the compiler moves the computation out of the loop
        _, hidden = lax.optimization_barrier((state[0], operands))
        return jnp.zeros((), bool), function(*hidden)

    return lax.while_loop(lambda state: state[0], once, (enabled, otherwise))[1]


def is_unique(tolerances: Tolerances, qp: Normal, point: Point) -> Array:
    """Return whether P and the rows make a minimiser unique in every direction.

    A row counts if it is an equality or its force is above the tolerance. A row that is active
    without force does not count: the minimiser can leave it.
    """
    force = point.z / qp.slope_size(point)
    slack = jnp.abs(qp.violation(point.x)) / qp.row_sizes(point.x)
    pressing = qp.side & (force > tolerances.residual) & (force > slack)
    binding = qp.equality | jnp.any(pressing, axis=0)
    # rounding with the cap could hide a flat direction; with this weight it is 1 % of the curvature
    weight = jnp.where(binding, 0.01 * tolerances.curvature / jnp.finfo(force.dtype).eps, 0.0)
    return _shifted(plus_gram(qp.P, qp.A, weight), -tolerances.curvature)[1]


def rays(tolerances: Tolerances, qp: Normal, before: Point, point: Point) -> tuple[Array, Array]:
    """Test whether a step is a ray: of infeasible rows for any moderate x, or of unbounded descent.

    Without a solution the multipliers diverge along a combination of rows that cancels, or x along
    a descent direction. The step shows it alone; the point also contains a part that does not
    cancel.

    Returns:
        A residual that is zero for a ray (2,), and a threshold (2,): the step is a ray if the
        residual is below it.
    """
    dx, rise = point.x - before.x, point.z - before.z
    growth = jnp.where(qp.equality, rise, jnp.maximum(rise, 0.0))  # a decrease is a penalty in gap
    gap = -jnp.sum(SIGN * qp.bound * growth + (growth - rise) / tolerances.certificate)
    # differences of products that an iteration computes at both points anyway
    pull = rmatvec(qp.A, multiplier(point.z)) - rmatvec(qp.A, multiplier(before.z))
    outward = qp.outward(matvec(qp.A, point.x) - matvec(qp.A, before.x))
    change = jnp.maximum(largest(qp.P @ point.x - qp.P @ before.x), jnp.max(outward, initial=0.0))
    # if P is definite the objective is bounded
    residual = jnp.stack([largest(pull), jnp.where(qp.flat, change, jnp.inf)])
    return residual, tolerances.certificate * jnp.stack([gap, -jnp.dot(qp.q, dx)])


def certificates(tolerances: Tolerances, qp: Normal, before: Point, point: Point) -> Array:
    """Return whether the step proves that the problem is infeasible, and unbounded (2,).

    The proof has to exceed rounding and the tolerance, within which the problem can be solved.
    """
    dx, rise = point.x - before.x, point.z - before.z
    residual, threshold = rays(tolerances, qp, before, point)
    terms = rmatvec(jnp.abs(qp.A), jnp.sum(jnp.abs(point.z), axis=0))
    rounding = jnp.finfo(dx.dtype).eps * largest(terms)
    size = jnp.sum(jnp.abs(rise) * qp.row_sizes(point.x))
    infeasible = residual[0] + rounding < threshold[0]
    infeasible &= threshold[0] > tolerances.certificate * tolerances.residual * size
    falls = _falls(tolerances, qp, dx, residual[1] < threshold[1], qp.slope_size(point))
    return jnp.stack([infeasible, falls])


def _falls(tolerances: Tolerances, qp: Normal, step: Array, enabled: Array, size: Array) -> Array:
    """Return whether a step contains a descent that P and rows limit by no more than rounding.

    A step to infinity also has a part of finite size, which P or a row limits. It is removed first;
    nothing remains of a step with curvature. `size` is that of a slope; if not `enabled` nothing is
    computed.
    """
    # far above rounding, which would otherwise turn one flat direction into another
    shift = tolerances.rounding**0.5
    P = qp.P + shift * jnp.eye(len(step), dtype=step.dtype)

    def remove(state: tuple[Array, ...]) -> tuple[Array, ...]:
        d, held, *_ = state
        factor = cholesky(plus_gram(P, qp.A, held.astype(d.dtype)))
        # multiplies the part of curvature c by shift / (shift + c)
        d = lax.fori_loop(0, 3, lambda _, d: shift * cho_solve((factor, True), d), d)
        length = jnp.sum(jnp.abs(d))
        crossed = jnp.max(qp.outward(matvec(qp.A, d)), axis=0) > tolerances.rounding * length
        flat = largest(qp.P @ d) <= tolerances.rounding * length
        falls = flat & ~jnp.any(crossed) & (-jnp.dot(qp.q, d) > tolerances.residual * size * length)
        return d, held | crossed, jnp.any(crossed & ~held), falls

    start = step / jnp.sum(jnp.abs(step)), qp.equality, enabled, jnp.zeros((), bool)
    return lax.while_loop(lambda state: state[2], remove, start)[3]
