"""How a QP is solved, and what the answer is worth.

First the active set is guessed and corrected by signs (`active_set`). Where it does not settle,
another method gets near (`interior_point`), and its active set is corrected in the same way. A
`Solver` is the pair of both: where to guess, how to get near.

Verdicts. All are comparisons in the normalised problem; t is the tolerance.

- SOLVED: the three residuals are at most t, and the minimiser is held in every direction: P less
  1e-8 of the unit matrix is positive definite, or it is with the rows added to P that are
  equalities or press with a force of more than t. Where it is not held: NOT_UNIQUE.
- INFEASIBLE: a step of the multipliers proves that rows contradict each other, by more than t and
  by more than its own rounding. Or a row of zeros, or a row with l > u, is violated by more than t
  whatever x is.
- UNBOUNDED: P is not positive definite, and a step of x proves a fall that neither P nor a row
  ends, likewise by more than t and rounding.
- BAD_DATA: a number is not finite, or P plus 1e-9 of the unit matrix is not positive definite.

(In 32 bits: 1e-5 and 1e-6 for 1e-8 and 1e-9.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from hector_jax.core.arrays import Array
from hector_jax.core.part import Part, choose_part
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, check
from hector_jax.core.tree import where
from hector_jax.qp.active_set import active_set, first_guess
from hector_jax.qp.certificates import is_held, only_if, without_rows
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
    Status,
    Tolerances,
    normalise,
)


class Solver(Part):
    """A way to a solution; last correction, verdict and derivative are the same for all.

    Attributes:
        approach: gets near a solution of the normalised problem; called as `approach(tolerances,
            qp, enabled, max_iterations=...)`, and its result counts where `enabled`.
        guess: point and active sides from the minimiser without rows, tried before `approach`; None
            begins with the approach.
    """

    approach: Callable[..., Approach]
    guess: Callable[[Normal, Point], tuple[Point, Array]] | None


INTERIOR_POINT = Solver("interior_point", approach=approach, guess=first_guess)
JAXOPT = Solver("jaxopt", approach=box_osqp, guess=None)
SOLVERS = (INTERIOR_POINT, JAXOPT)
"""Those that a file can name."""


@dataclass(frozen=True)
class QpConfig:
    """How QPs are solved. Numbers left None follow the dtype.

    Attributes:
        solver: a `Solver`, or the name of one of SOLVERS: "interior_point" (active set first,
            interior point where it does not settle) or "jaxopt" (BoxOSQP instead of both, with our
            last correction and our derivative).
        tolerance: largest residual of a SOLVED problem; 1e-8 in 64 bits, 1e-4 in 32.
        active_set_tries: before the solver's approach.
        max_iterations: of the approach; BoxOSQP takes a hundred times as many, cheaper ones.
        ratio_cap: largest multiplier-to-slack ratio in a factorised matrix; 1e7 in 64 bits, 1e4
            in 32.
    """

    solver: str = INTERIOR_POINT
    tolerance: float | None = None
    active_set_tries: int = 15
    max_iterations: int = 60
    ratio_cap: float | None = None

    def __post_init__(self) -> None:
        rules = {"tolerance": POSITIVE, "ratio_cap": POSITIVE}
        check(self, **rules, active_set_tries=AT_LEAST_ONE, max_iterations=AT_LEAST_ONE)
        object.__setattr__(self, "solver", _solver(self))

    def tolerances(self, dtype: jnp.dtype) -> Tolerances:
        """What this config and the dtype allow."""
        usual = BITS_64 if jnp.finfo(dtype).bits == 64 else BITS_32
        tolerance = self.tolerance or usual.residual
        return usual._replace(
            residual=tolerance, target=min(usual.target, tolerance), cap=self.ratio_cap or usual.cap
        )


def _solver(config: QpConfig) -> Solver:
    return choose_part("QpConfig.solver", config.solver, Solver, SOLVERS)


class _Best(NamedTuple):
    point: Point
    residuals: Array
    certified: Array  # (2,) bool: infeasible, unbounded
    iterations: Array
    approached: Array  # whether the next round begins with an approach
    going: Array


def _solve_rounds(
    config: QpConfig, tolerances: Tolerances, qp: Normal, unconstrained: Point, enabled: Array
) -> _Best:
    """Best point: by the active set from a guess, else from where the approach gets near.

    Both rounds are one loop, so that the active set is compiled once.
    """
    solver = _solver(config)
    if solver.guess is None:
        start, guess = unconstrained, jnp.zeros_like(qp.side)
    else:
        start, guess = solver.guess(qp, unconstrained)

    def attempt(state: _Best) -> _Best:
        approaches = state.going & state.approached
        near = solver.approach(tolerances, qp, approaches, max_iterations=config.max_iterations)
        # slacks and multipliers have sizes of their own: far apart where the rows, not P, hold x
        pushes = near.point.z * qp.reach > near.slack * largest(near.point.z)
        begin, active = where(state.approached, (near.point, pushes), (start, guess))
        limit = jnp.where(state.approached, config.max_iterations, config.active_set_tries)
        hopeful = state.going & ~jnp.any(near.certified)
        exact, exact_residuals, tries = active_set(
            tolerances, qp, begin, active=active, enabled=hopeful, limit=limit
        )
        point, residuals = state.point, state.residuals
        for other, its in ((near.point, near.residuals), (exact, exact_residuals)):
            better = jnp.max(its) < jnp.max(residuals)
            point, residuals = where(better, (other, its), (point, residuals))
        steps = state.iterations + near.iterations + tries
        going = ~state.approached & (jnp.max(residuals) > tolerances.target)
        return _Best(point, residuals, near.certified, steps, jnp.ones((), bool), going)

    first = _Best(
        unconstrained,
        jnp.full(3, jnp.inf, qp.q.dtype),
        jnp.zeros(2, bool),
        jnp.zeros((), jnp.int32),
        jnp.asarray(solver.guess is None),
        enabled,
    )
    return lax.while_loop(lambda state: state.going, attempt, first)


def _or_trivial(valid: Array, qp: QP) -> QP:
    """The QP, or a trivial one in its place, so that nothing that follows meets a NaN."""
    trivial = QP(jnp.eye(len(qp.q), dtype=qp.q.dtype), *(jnp.zeros_like(v) for v in qp[1:]))
    return where(valid, qp, trivial)


@partial(jax.jit, static_argnums=0)
def solve_normal(config: QpConfig, qp: QP) -> tuple[Solution, Array, Normal]:
    """Solution, the ratios W (2, m) of its derivative, and the normalised problem."""
    tolerances = config.tolerances(qp.q.dtype)
    no_bound = jnp.isnan(qp.l) | jnp.isnan(qp.u) | (qp.l >= INFINITE) | (qp.u <= -INFINITE)
    numbers = jnp.maximum(jnp.maximum(largest(qp.P), largest(qp.q)), largest(qp.A))
    valid = jnp.isfinite(numbers) & ~jnp.any(no_bound)
    normal = normalise(tolerances, _or_trivial(valid, qp))
    free, definite, convex = without_rows(tolerances, normal)
    normal = normal._replace(flat=~definite)
    valid &= convex
    unconstrained = Point(free, jnp.zeros(normal.side.shape, qp.q.dtype))
    best = _solve_rounds(config, tolerances, normal, unconstrained, valid)
    # far from any solution (infeasible, unbounded) all residuals may be infinite, and so may x
    usable = valid & jnp.all(jnp.isfinite(best.residuals))
    point = jax.tree.map(lambda v: jnp.where(usable, v, 0.0), best.point)

    solved = usable & (jnp.max(best.residuals) <= tolerances.residual)
    # what no x can meet; an x that solves nothing is no measure of it
    sizes = jnp.min(normal.row_sizes(jnp.where(solved, point.x, normal.reach)), axis=0)
    unmet = jnp.max(normal.unmet / sizes, initial=0.0)
    held = lambda operands: is_held(tolerances, *operands)  # noqa: E731
    unique = only_if(solved & ~definite, held, definite, (normal, point))
    status = jnp.where(best.certified[1], Status.UNBOUNDED, Status.INACCURATE)
    status = jnp.where(best.certified[0], Status.INFEASIBLE, status)
    status = jnp.where(solved, jnp.where(unique, Status.SOLVED, Status.NOT_UNIQUE), status)
    status = jnp.where(unmet > tolerances.residual, Status.INFEASIBLE, status)
    status = jnp.where(valid, status, Status.BAD_DATA).astype(jnp.int32)
    primal, dual, gap = jnp.where(valid, best.residuals, jnp.inf)
    x = normal.size * normal.column * point.x
    y = normal.size * normal.row * multiplier(point.z)
    worst = jnp.maximum(primal, unmet)
    solution = Solution(x, y, worst, dual, gap, best.iterations, status)
    return solution, _ratios(tolerances, normal, point), normal


def _ratios(tolerances: Tolerances, qp: Normal, point: Point) -> Array:
    """W (2, m) of the derivative."""
    slack, kink = jnp.maximum(-qp.violation(point.x), 0.0), tolerances.kink
    ratio = ((point.z + kink) / (slack / qp.row_sizes(point.x) + kink)) ** 2
    ratio = jnp.where(qp.side, jnp.minimum(ratio, tolerances.cap), 0.0)
    # an equality moves with both of its bounds, half with each
    return jnp.where(qp.equality, 0.5 * tolerances.cap, ratio)
