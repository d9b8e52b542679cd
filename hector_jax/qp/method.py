"""The solution of a QP, and its status.

First the active set is guessed and corrected by signs (`active_set`); a guess whose point has
residuals within the target is the solution. If the active set does not converge, another method
approaches a solution (`interior_point`), and its active set is corrected in the same way. A
`Solver` is the pair of both: the guess and the approach.

Status. All conditions are comparisons in the normalised problem; t is the tolerance.

- SOLVED: the three residuals are at most t, and the minimiser is unique: P - 1e-8 I is positive
  definite, alone or after adding to P the rows that are equalities or have a force above t. If the
  minimiser is not unique: NOT_UNIQUE.
- INFEASIBLE: a step of the multipliers proves that rows contradict each other, by more than t and
  by more than its own rounding. Or a row of zeros, or a row with l > u, is violated by more than t
  for every x.
- UNBOUNDED: P is not positive definite, and a step of x proves a descent that neither P nor a row
  limits, by more than t and by more than its own rounding: it contains a ray d with q'd < 0 where
  P d and what A d leaves the bounds by are at most 1e-12 of the sum of |d|.
- BAD_DATA: a number is not finite, or P + 1e-9 I is not positive definite.

(In 32 bits: 1e-5, 1e-6 and 1e-6 for 1e-8, 1e-9 and 1e-12.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hector_jax.core.arrays import Array
from hector_jax.core.part import Part
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, check
from hector_jax.core.tree import where
from hector_jax.qp.active_set import active_set, first_guess, no_guess
from hector_jax.qp.certificates import curvature, is_unique, only_if
from hector_jax.qp.interior_point import approach
from hector_jax.qp.jaxopt_solver import box_osqp
from hector_jax.qp.linear import largest, multiplier
from hector_jax.qp.problem import (
    BITS_32,
    BITS_64,
    INFINITE,
    QP,
    Approach,
    Normal,
    Point,
    Solution,
    Start,
    Status,
    Tolerances,
    normalise,
)


class Solver(Part):
    """A method to approach a solution; last correction, status and derivative are common to all.

    Attributes:
        approach: approaches a solution of the normalised problem; called as `approach(tolerances,
            qp, enabled, max_iterations=...)`; unless `enabled` it returns infinite residuals and
            no certificate.
        guess: called as `guess(tolerances, qp)`, returns what is tried before `approach` and what
            it proves of P, see `Start`; None starts with `approach`.
    """

    approach: Callable[..., Approach]
    guess: Callable[[Tolerances, Normal], Start] | None


INTERIOR_POINT = Solver("interior_point", approach=approach, guess=first_guess)
JAXOPT = Solver("jaxopt", approach=box_osqp, guess=None)
Solver.known = (INTERIOR_POINT, JAXOPT)


@dataclass(frozen=True)
class QpConfig:
    """Configuration of the QP solver. Numbers that are None depend on the dtype.

    Attributes:
        solver: INTERIOR_POINT (active set first, interior point if it does not converge), JAXOPT
            (BoxOSQP instead of both, with our last correction and our derivative) or another.
        tolerance: largest residual of a SOLVED problem; 1e-8 in 64 bits, 1e-4 in 32.
        active_set_tries: largest number of active set iterations before the solver's approach.
        max_iterations: of the approach; BoxOSQP takes a hundred times as many, cheaper ones.
        ratio_cap: largest multiplier-to-slack ratio in a factorised matrix; 1e7 in 64 bits, 1e4
            in 32.
    """

    solver: Solver = INTERIOR_POINT
    tolerance: float | None = None
    active_set_tries: Annotated[int, AT_LEAST_ONE] = 15
    max_iterations: Annotated[int, AT_LEAST_ONE] = 60
    ratio_cap: float | None = None

    def __post_init__(self) -> None:
        check(self, tolerance=POSITIVE, ratio_cap=POSITIVE)

    def tolerances(self, dtype: jnp.dtype) -> Tolerances:
        """Return the tolerances of this config for a dtype."""
        default = BITS_64 if jnp.finfo(dtype).bits == 64 else BITS_32
        residual = self.tolerance or default.residual
        target, cap = min(default.target, residual), self.ratio_cap or default.cap
        return default._replace(residual=residual, target=target, cap=cap)


class _Best(NamedTuple):
    point: Point
    residuals: Array
    certified: Array  # (2,) bool: infeasible, unbounded
    iterations: Array
    approached: Array  # the next round starts with an approach
    running: Array


def _solve_rounds(
    config: QpConfig, tolerances: Tolerances, qp: Normal, first: _Best, active: Array
) -> _Best:
    """Return the best point: by the active set from the first one, else from the approach.

    Both rounds are one loop, so that the active set is compiled once.
    """
    solver = config.solver

    def attempt(state: _Best) -> _Best:
        approaches = state.running & state.approached
        near = solver.approach(tolerances, qp, approaches, max_iterations=config.max_iterations)
        # compare relative sizes: slacks and multipliers differ widely if the rows, not P, hold x
        pressing = near.point.z * qp.reach > near.slack * largest(near.point.z)
        begin, sides = where(state.approached, (near.point, pressing), (first.point, active))
        limit = jnp.where(state.approached, config.max_iterations, config.active_set_tries)
        solvable = state.running & ~jnp.any(near.certified)
        exact, exact_residuals, iterations = active_set(
            tolerances, qp, begin, active=sides, enabled=solvable, limit=limit
        )
        point, residuals = state.point, state.residuals
        for other in ((near.point, near.residuals), (exact, exact_residuals)):
            better = jnp.max(other[1]) < jnp.max(residuals)
            point, residuals = where(better, other, (point, residuals))
        iterations = state.iterations + near.iterations + iterations
        running = ~state.approached & (jnp.max(residuals) > tolerances.target)
        return _Best(point, residuals, near.certified, iterations, jnp.ones((), bool), running)

    return lax.while_loop(lambda state: state.running, attempt, first)


def _decide(
    config: QpConfig, tolerances: Tolerances, qp: Normal, valid: Array
) -> tuple[_Best, Array, Array]:
    """Return the best point, whether P is semidefinite, and whether a minimiser is unique.

    A GPU asks its host at each loop whether it runs. So there all that follows a guess that solves
    the problem and proves P definite is one loop.
    """
    solver = config.solver
    start = (solver.guess or no_guess)(tolerances, qp)
    unsolved = jnp.max(start.residuals) > tolerances.target
    first = _Best(
        start.point,
        start.residuals,
        jnp.zeros(2, bool),
        jnp.zeros((), jnp.int32),
        jnp.asarray(solver.guess is None),
        valid & unsolved,
    )

    def settle(qp: Normal, first: _Best, start: Start) -> tuple[_Best, Array, Array]:
        qp = qp._replace(flat=~start.definite)
        first = first._replace(running=first.running & start.convex)
        best = _solve_rounds(config, tolerances, qp, first, start.active)
        solved = valid & (jnp.max(best.residuals) <= tolerances.residual)
        test = partial(is_unique, tolerances)
        unique = only_if(solved & ~start.definite, test, start.definite, qp, best.point)
        return best, start.convex, unique

    if jax.default_backend() != "gpu":
        return settle(qp, first, start)

    def prove(qp: Normal, first: _Best, start: Start) -> tuple[_Best, Array, Array]:
        signs = lambda qp: curvature(tolerances, qp)[1:]  # noqa: E731
        definite, convex = only_if(~start.definite, signs, (start.definite, start.convex), qp)
        return settle(qp, first, start._replace(definite=definite, convex=convex))

    as_guessed = first, start.convex, start.definite
    return only_if(valid & (unsolved | ~start.definite), prove, as_guessed, qp, first, start)


@partial(jax.jit, static_argnums=0)
def solve_normal(config: QpConfig, qp: QP) -> tuple[Solution, Array, Normal]:
    """Solve a QP. Returns the solution, W (2, m) of its derivative and the normalised problem."""
    tolerances = config.tolerances(qp.q.dtype)
    no_bound = jnp.isnan(qp.l) | jnp.isnan(qp.u) | (qp.l >= INFINITE) | (qp.u <= -INFINITE)
    vectors = jnp.isfinite(qp.q) & jnp.isfinite(jnp.diagonal(qp.P))
    valid = jnp.all(vectors) & jnp.all(jnp.isfinite(qp.A)) & ~jnp.any(no_bound)
    # zeros replace invalid data, so that no NaN reaches the solver; a P with one is not convex
    q, A, lower, upper = where(valid, qp[1:], jax.tree.map(jnp.zeros_like, qp[1:]))
    normal = normalise(tolerances, QP(qp.P, q, A, lower, upper))
    best, convex, unique = _decide(config, tolerances, normal, valid)
    valid &= convex
    # without a solution (infeasible, unbounded) residuals and x may be infinite
    usable = valid & jnp.all(jnp.isfinite(best.residuals))
    point = jax.tree.map(lambda v: jnp.where(usable, v, 0.0), best.point)

    solved = usable & (jnp.max(best.residuals) <= tolerances.residual)
    # the unavoidable violation; an x that is no solution, or one of many, does not scale it
    sizes = jnp.min(normal.row_sizes(jnp.where(solved & unique, point.x, normal.reach)), axis=0)
    unmet = jnp.max(normal.unmet / sizes, initial=0.0)
    status = jnp.where(best.certified[1], Status.UNBOUNDED, Status.INACCURATE)
    status = jnp.where(best.certified[0], Status.INFEASIBLE, status)
    status = jnp.where(solved, jnp.where(unique, Status.SOLVED, Status.NOT_UNIQUE), status)
    status = jnp.where(unmet > tolerances.residual, Status.INFEASIBLE, status)
    status = jnp.where(valid, status, Status.BAD_DATA).astype(jnp.int32)
    primal, dual, gap = jnp.where(valid, best.residuals, jnp.inf)
    x = normal.size * normal.column * point.x
    y = normal.size * normal.row * multiplier(point.z)
    primal = jnp.maximum(primal, unmet)
    solution = Solution(x, y, primal, dual, gap, best.iterations, status)
    return solution, _ratios(tolerances, normal, point), normal


def _ratios(tolerances: Tolerances, qp: Normal, point: Point) -> Array:
    """Return W (2, m) of the derivative."""
    slack, kink = jnp.maximum(-qp.violation(point.x), 0.0), tolerances.kink
    ratio = ((point.z + kink) / (slack / qp.row_sizes(point.x) + kink)) ** 2
    ratio = jnp.where(qp.side, jnp.minimum(ratio, tolerances.cap), 0.0)
    # an equality depends on both of its bounds, half on each
    return jnp.where(qp.equality, 0.5 * tolerances.cap, ratio)
