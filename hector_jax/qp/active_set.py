"""The active set of a QP, guessed and corrected by signs: a semismooth Newton method.

Each iteration factorises P + rho I + A'WA once, with W equal to the cap on active rows and zero on
the others. The QPs of walking take five iterations, and the result is exact to rounding if the
active set converges. On a GPU a kernel (`gpu_kernel`) solves first, and the iterations are for
points whose residuals are too large.
"""

from functools import cache, partial
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import cho_solve

from hector_jax.core.arrays import Array
from hector_jax.core.console import say
from hector_jax.core.tree import where
from hector_jax.qp.certificates import curvature
from hector_jax.qp.linear import cholesky, largest, matvec, multiplier, plus_gram, rmatvec
from hector_jax.qp.problem import SIGN, Normal, Point, Start, Tolerances


class _Fixed(NamedTuple):
    """Data of all iterations."""

    tolerances: Tolerances
    qp: Normal
    limit: Array  # largest number of iterations


class _Loop(NamedTuple):
    point: Point
    active: Array  # (2, m) bool
    factor: Array  # of the matrix of the active set before its last change
    rho: Array
    iterations: Array
    running: Array


def _correct(fixed: _Fixed, state: _Loop) -> _Loop:
    """Run a pass of the method of multipliers, which removes six digits, and change wrong sides."""
    (tolerances, qp, _), (x, z), active = fixed, state.point, state.active
    weight = jnp.where(active, jnp.asarray(tolerances.cap, x.dtype), 0.0)
    z = jnp.where(active, z, 0.0) + weight * qp.violation(x)
    slope = qp.P @ x + qp.q + rmatvec(qp.A, multiplier(z))
    dx = -cho_solve((state.factor, True), slope)
    x, z = x + dx, z + weight * SIGN * matvec(qp.A, dx)
    outside = qp.violation(x)
    negative, violated = z < -tolerances.rounding, outside > tolerances.rounding * qp.row_sizes(x)
    wrong = jnp.where(active, negative, violated) & ~qp.equality
    changed = worst_sides(qp, wrong, active, jnp.where(active, -z, outside))
    # a failed factorisation is repeated with a larger rho
    finite = jnp.isfinite(largest(x))
    point = where(finite, Point(x, z), state.point)
    return state._replace(
        point=point,
        active=active ^ (changed & finite),
        rho=jnp.where(finite, state.rho, 100.0 * state.rho),
        running=~finite | jnp.any(changed),
    )


def _runs(fixed: _Fixed, state: _Loop) -> Array:
    return state.running & (state.rho < 1.0) & (state.iterations < fixed.limit)


def _improve(fixed: _Fixed, state: _Loop) -> _Loop:
    """Factorise for the current active set, and correct it."""
    qp = fixed.qp
    weight = fixed.tolerances.cap * jnp.sum(state.active, axis=0, dtype=qp.q.dtype)
    factor = cholesky(plus_gram(qp.P, qp.A, weight, state.rho))
    return _correct(fixed, state._replace(factor=factor, iterations=state.iterations + 1))


def active_set(
    tolerances: Tolerances, qp: Normal, start: Point, *, active: Array, enabled: Array, limit: Array
) -> tuple[Point, Array, Array]:
    """Solve with active sides as equations, and correct the active set by signs until it converges.

    Args:
        tolerances: tolerances of the dtype.
        qp: the problem.
        start: initial point.
        active: guess of the active sides (2, m).
        enabled: if false nothing is computed.
        limit: largest number of iterations, because the active set may cycle.

    Returns:
        The best point of a converged active set, its residuals (infinite if none converged) and the
        number of iterations.
    """
    dtype = qp.q.dtype
    # the single side of an equality, which is always active
    equality = jnp.stack([qp.equality, jnp.zeros_like(qp.equality)])
    fixed = _Fixed(tolerances, qp, limit)
    runs = partial(_runs, fixed)

    def converge(state: tuple[_Loop, Point, Array]) -> tuple[_Loop, Point, Array]:
        """Iterate until no side is wrong, then run another pass and compute residuals."""
        loop, best, residuals = state
        loop = lax.while_loop(runs, partial(_improve, fixed), loop)
        converged, loop = ~loop.running, _correct(fixed, loop)
        x, z = loop.point  # clipped at zero, except multipliers of equalities, which have no sign
        point = Point(x, jnp.where(equality, z, jnp.maximum(z, 0.0)))
        found = point, qp.residuals(point)
        better = converged & (jnp.max(found[1]) < jnp.max(residuals))
        best, residuals = where(better, found, (best, residuals))
        # with a flat P more iterations improve the point even if the active set does not change
        running = loop.running | (jnp.max(residuals) > tolerances.target)
        return loop._replace(running=running), best, residuals

    begin = _Loop(
        start,
        (active & qp.side) | equality,
        jnp.zeros_like(qp.P),
        jnp.asarray(tolerances.proximal, dtype),
        jnp.zeros((), jnp.int32),
        enabled,
    )
    first = begin, start, jnp.full(3, jnp.inf, dtype)
    loop, best, residuals = lax.while_loop(lambda state: runs(state[0]), converge, first)
    return best, residuals, loop.iterations


def worst_sides(qp: Normal, wrong: Array, active: Array, error: Array) -> Array:
    """Select the wrong sides (2, m) that are changed in one iteration.

    Rows of a block share its few variables, so one change affects the others. Only the worst side
    to deactivate and the worst to activate change in each block, which makes cycles rare.
    """
    if qp.A.ndim == 2:
        return wrong
    blocks = (2, *qp.A.shape[:2])
    error = jnp.where(wrong, error, 0.0).reshape(blocks)
    active = active.reshape(blocks)
    worst = lambda v: jnp.max(v, axis=(0, 2), keepdims=True)  # noqa: E731
    deactivate, activate = jnp.where(active, error, 0.0), jnp.where(active, 0.0, error)
    threshold = 0.9 * jnp.where(active, worst(deactivate), worst(activate))
    return wrong & (error >= threshold).reshape(wrong.shape)


def no_guess(tolerances: Tolerances, qp: Normal) -> Start:
    """Start from zero."""
    _, definite, convex = curvature(tolerances, qp)
    none, infinite = jnp.zeros_like(qp.side), jnp.full(3, jnp.inf, qp.q.dtype)
    point = Point(jnp.zeros_like(qp.q), jnp.zeros_like(qp.bound))
    return Start(point, none, infinite, definite, convex)


def first_guess(tolerances: Tolerances, qp: Normal) -> Start:
    """Start from the unconstrained minimiser, on a GPU from the kernel's solution."""
    infinite = jnp.full(3, jnp.inf, qp.q.dtype)

    def violated(qp: Normal) -> Start:
        x, definite, convex = curvature(tolerances, qp)
        outside, none = qp.violation(x), jnp.zeros_like(qp.side)
        active = worst_sides(qp, outside > 0, none, outside)
        return Start(Point(x, none.astype(x.dtype)), active, infinite, definite, convex)

    def pivoted(kernel: ModuleType, qp: Normal) -> Start:
        present = qp.side | qp.equality
        upper, lower = jnp.where(present, qp.bound, jnp.asarray(SIGN, qp.q.dtype) * jnp.inf)
        x, y, side, settled, definite = kernel.guess(
            qp.P, qp.q, qp.A, lower, upper, curvature=tolerances.curvature
        )
        point = Point(x, jnp.maximum(SIGN * y, 0.0))
        residuals = qp.residuals(point)
        found = point, jnp.stack([side > 0, side < 0]), residuals
        nothing = jax.tree.map(jnp.zeros_like, point), jnp.zeros_like(qp.side), infinite
        sound = (settled > 0) & jnp.all(jnp.isfinite(residuals))
        point, active, residuals = where(sound, found, nothing)
        # if not proved, `method` factorises P
        return Start(point, active, residuals, definite > 0, definite > 0)

    if jax.default_backend() != "gpu":
        return violated(qp)
    kernel = _kernel(len(qp.q), len(qp.row), qp.A.ndim == 3)
    if kernel is None:
        return violated(qp)
    return lax.platform_dependent(qp, cuda=partial(pivoted, kernel), default=violated)


@cache  # say it once for each size
def _kernel(variables: int, rows: int, block_diagonal: bool) -> ModuleType | None:
    """Return the GPU's kernel for a QP of this size; None, and a message, if there is none."""
    try:
        from jax.experimental.pallas import triton  # noqa: F401
    except ImportError:  # as on Windows; and JAX has announced that it will go
        why = "this JAX has no Triton"
    else:
        from hector_jax.qp import gpu_kernel  # imports it

        if block_diagonal and gpu_kernel.fits(variables, rows):
            return gpu_kernel
        limits = f"{gpu_kernel.VARIABLES} and {gpu_kernel.ROWS}"
        why = f"the kernel holds block-diagonal ones of up to {limits}"
    say(f"on a GPU a QP of {variables} variables and {rows} rows takes the slower path: {why}")
    return None
