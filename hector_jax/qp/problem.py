"""Data, normalisation and residuals of the QPs.

Every QP is first normalised (`normalise`): x = kappa D v, D = diag(P)^-1/2, rows of A D of length
one, kappa the larger of |D q| and the bounds violated at v = 0. Residuals depend only on (x, y) in
that form, so that the units of objective, rows and variables do not matter. They do matter if
nothing else gives a scale: a column with zero diagonal in P is scaled by its largest entry in A,
and if q and the violated bounds are zero, kappa is 1.

A violation is relative to the larger of x and the row's bound. A row of zeros (entries of at most
1e-15 of the largest of their columns, 1e-7 in 32 bits) has no length and its bound sets no scale:
its violation is relative to x, its length is the geometric mean of the others, and a violation
below the rounding of the largest bound is zero. Bounds that cross within the tolerance are an
equality at their middle. A row without bounds has no part in any scale: its entries count as zeros.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from hector_jax.core.arrays import Array
from hector_jax.qp.linear import largest, matvec, multiplier, rmatvec

INFINITE = 1e20  # a bound of at least this size is infinite, as in most solvers
# a side is satisfied if SIGN * (A v - bound) <= 0; integers, which take the dtype of the product
SIGN = np.array([[1], [-1]])
_ROUNDING = 8  # machine epsilons; smaller relative differences are rounding
_SMALL = 1e-3  # keeps relative residuals meaningful if the solution is zero
_INNER = 1e-5  # a side with more multiplier and more slack may be active or not


class Status(IntEnum):
    """Status codes of a solution, in `Solution.status`.

    `meaning` explains the code and gives a remedy.
    """

    meaning: str

    def __new__(cls, code: int, meaning: str) -> "Status":
        """Create a code with its meaning."""
        member = int.__new__(cls, code)
        member._value_, member.meaning = code, meaning
        return member

    SOLVED = 0, "All residuals are at most the tolerance, and the minimiser is unique."
    INACCURATE = (
        1,
        "The residuals of the best point that was found are above the tolerance. Raise "
        "QpConfig.max_iterations or tolerance, or bring P and A nearer to one scale.",
    )
    INFEASIBLE = (
        2,
        "No x meets all rows. Widen the bounds, or give rows a slack variable that is priced in q.",
    )
    UNBOUNDED = (
        3,
        "The objective falls without end along a direction. Price that direction in P, or bound it "
        "by a row.",
    )
    BAD_DATA = (
        4,
        "A number is NaN, an entry of P, q or A is infinite, a bound excludes every number, or P "
        "has a negative eigenvalue. Look for it in what P, q, A, l and u are made of.",
    )
    NOT_UNIQUE = (
        5,
        "x is a minimiser, but along a direction neither P nor a row with force holds it: others "
        "lie beside it, and it has no derivative. Add a small multiple of the unit matrix to P, or "
        "use x without its derivative.",
    )


class QP(NamedTuple):
    """Minimise 1/2 x'Px + q'x subject to l <= A x <= u.

    P is positive semidefinite (its symmetric part counts). A is dense (m, n), or block-diagonal by
    step (N, r, b) with m = N r rows and n = N b: rows r k .. r (k+1) read variables b k .. b (k+1).
    Infinite bounds (1e20 and more), rows with l = u, redundant rows and rows of zeros are valid,
    and so are bounds that cross by rounding only. Use vmap for a batch.
    """

    P: Float[Array, "n n"]
    q: Float[Array, " n"]
    A: Float[Array, "m n"] | Float[Array, "N r b"]
    l: Float[Array, " m"]  # noqa: E741
    u: Float[Array, " m"]


class Solution(NamedTuple):
    """Minimiser and multipliers with residuals and status.

    Residuals are those of (x, y) in the normalised problem (module docstring), so they have no unit
    and are comparable between problems: `primal_residual` is the largest violation of a row over
    the larger of x and the row's bound, `dual_residual` the largest entry of P x + q + A'y over the
    largest of its terms, `gap` |x'Px + q'x + sum(u y+ - l y-)| over the largest of its terms (plus
    a small number, so that a zero solution has residuals too). The gap of a point that no active
    set yields is at least the smaller one of multiplier and slack of any side, if above 1e-5. With
    BAD_DATA x and y are zero and the residuals infinite.
    """

    x: Float[Array, " n"]
    y: Float[Array, " m"]  # positive if the upper bound is active, negative if the lower is
    primal_residual: Float[Array, ""]
    dual_residual: Float[Array, ""]
    gap: Float[Array, ""]
    iterations: Int[Any, ""]  # factorisations, 0 on a GPU whose kernel solved it; jaxopt's and ours
    status: Int[Any, ""]  # a code of Status


class Tolerances(NamedTuple):
    """Tolerances of a dtype, in the normalised problem."""

    residual: float  # largest residual of a solved problem
    target: float  # residuals and complementarity at which the iterations stop
    proximal: float  # rho of the active set; the interior point starts from ten times this
    cap: float  # largest W in a factorised matrix
    rounding: float  # smaller multipliers and violations have no sign
    kink: float  # e of the derivative
    certificate: float  # of infeasible and unbounded problems
    curvature: float  # a direction of less curvature is flat
    zero: float  # a row whose entries relative to the longest are at most this is a row of zeros


BITS_64 = Tolerances(1e-8, 1e-11, 1e-9, 1e7, 1e-12, 1e-11, 1e-7, 1e-8, 1e-15)
# in 32 bits a target of 1e-5 left 0.07 N in one of 9000 walking QPs, 3e-6 leaves 0.03 N
BITS_32 = Tolerances(1e-4, 3e-6, 1e-6, 1e4, 1e-6, 1e-6, 1e-4, 1e-5, 1e-7)


class Point(NamedTuple):
    """Candidate solution of a problem; sides are (u, l) as in `Normal`."""

    x: Array  # (n,)
    z: Array  # (2, m) multipliers of the sides; z[0] has no sign for an equality row


class Normal(NamedTuple):
    """A QP in normalised variables, x = size * column * v; sides are (u, l)."""

    P: Array
    q: Array
    A: Array
    bound: Array  # (2, m), zero if infinite; both sides of an equality are the same
    side: Array  # (2, m) bool: a finite bound of a row that is neither an equality nor of zeros
    equality: Array  # (m,) bool
    unmet: Array  # (m,) violation, for every x, of rows of zeros and of crossed bounds
    column: Array  # (n,)
    row: Array  # (m,)
    size: Array
    flat: Array  # () bool: P may have no curvature along some direction
    reach: Array  # size of A v: the largest finite bound, at most 1; 1 if all are zero

    def violation(self, x: Array) -> Array:
        """Return the violation of each side (2, m) by A x, negative inside; 0 without a side."""
        outside = SIGN * (matvec(self.A, x) - self.bound)
        return jnp.where(self.side | self.equality, outside, 0.0)

    def outward(self, change: Array) -> Array:
        """Return how far a change of A x leads out of each side (2, m), negative inward."""
        change = SIGN * change
        return jnp.where(self.equality, jnp.abs(change), jnp.where(self.side, change, 0.0))

    def row_sizes(self, x: Array) -> Array:
        """Return the scale of a violation of each side (2, m): x, as rows are unit, and its bound.

        Only the bound of its own row: a loose bound elsewhere would make every violation small.
        """
        return jnp.maximum(jnp.maximum(largest(x), _SMALL * self.reach), jnp.abs(self.bound))

    def slope_size(self, point: Point) -> Array:
        """Return the scale of a residual of P x + q + A'y: its largest term plus a small number."""
        pull = rmatvec(self.A, multiplier(point.z))
        terms = jnp.maximum(largest(self.P @ point.x), largest(pull))
        return _SMALL + jnp.maximum(terms, largest(self.q))

    def residuals(self, point: Point) -> Array:
        """Return primal residual, dual residual and gap, see `Solution`; infinite for NaN."""
        x, y = point.x, multiplier(point.z)
        pull, slope = rmatvec(self.A, y), self.P @ x
        support = jnp.sum(jnp.where(y > 0, self.bound[0], self.bound[1]) * y)  # u y+ - l y-
        terms = jnp.stack([jnp.dot(x, slope), jnp.dot(self.q, x), support])
        primal = jnp.max(self.violation(x) / self.row_sizes(x), initial=0.0)
        dual = largest(slope + self.q + pull) / self.slope_size(point)
        gap = jnp.abs(jnp.sum(terms)) / (_SMALL * self.reach + largest(terms))
        residuals = jnp.stack([primal, dual, gap])
        return jnp.where(jnp.isfinite(jnp.sum(residuals)), residuals, jnp.inf)

    def inner_residuals(self, point: Point) -> Array:
        """Return the residuals of a point that no active set yields, see `Solution`.

        Such a point leaves every side some multiplier and some slack. The smaller of both has the
        size of the error of x and of the root of the gap: in 32 bits a gap of 1e-5 alone left 0.9 N
        in a walking QP.
        """
        slack = -self.violation(point.x) / self.row_sizes(point.x)
        smaller = jnp.minimum(point.z / self.slope_size(point), slack)
        inner = jnp.max(jnp.where(self.side, smaller, 0.0), initial=0.0)
        return self.residuals(point).at[2].max(jnp.where(inner > _INNER, inner, 0.0))


def _by_column(A: Array, column: Array) -> Array:
    """Return numbers of the columns (n,) in a shape that multiplies the columns of A."""
    return column if A.ndim == 2 else column.reshape(A.shape[0], 1, A.shape[2])


def _scales(tolerances: Tolerances, qp: QP) -> tuple[Array, Array, Array]:
    """Return the column scales D, the scales that make rows of A D unit, and which rows are zeros.

    D = |diag(P)|^-1/2, so that no curvature is small beside another. A column with zero diagonal in
    P, or a negative one within rounding, is scaled by its largest entry in A, to the size of the
    largest of the other columns: D is then independent of the unit of the objective. A row of zeros
    has no length and gets the geometric mean of the others' largest entries.
    """
    diagonal = jnp.diagonal(qp.P)
    reach = jnp.max(jnp.abs(qp.A), axis=-2, initial=0.0).ravel()  # largest entry of a column
    tiny, rounding = jnp.finfo(qp.P.dtype).tiny, tolerances.rounding * jnp.max(diagonal)
    curved = (diagonal >= tiny) | (diagonal < -rounding)
    column = lax.rsqrt(jnp.where(curved, jnp.abs(diagonal), 1.0))
    widest = jnp.max(jnp.where(curved, column * reach, 0.0))
    by_reach = jnp.where(widest > 0, widest, 1.0) / jnp.where(reach > 0, reach, 1.0)
    column = jnp.where(curved, column, by_reach)
    zeros = jnp.all(jnp.abs(qp.A) <= tolerances.zero * _by_column(qp.A, reach), axis=-1)
    rows = qp.A * _by_column(qp.A, column)
    peak = jnp.max(jnp.abs(rows), axis=-1, initial=0.0)
    peak = jnp.where(zeros, 1.0, peak)  # divide by it first, otherwise squares overflow
    squares = jnp.sum((rows / peak[..., None]) ** 2, axis=-1)
    mean = jnp.exp(jnp.sum(jnp.log(peak)) / jnp.maximum(jnp.sum(~zeros), 1))
    row = jnp.where(zeros, 1.0 / mean, lax.rsqrt(jnp.where(zeros, 1.0, squares)) / peak)
    return column, row.ravel(), zeros.ravel()


def normalise(tolerances: Tolerances, qp: QP) -> Normal:
    """Normalise a QP of finite numbers."""
    bound = jnp.stack([qp.u, qp.l])
    finite = jnp.abs(bound) < INFINITE
    # a row without bounds is one of zeros: its entries must not scale variables and other rows
    bounded = jnp.any(finite, axis=0).reshape(qp.A.shape[:-1])
    qp = qp._replace(A=jnp.where(bounded[..., None], qp.A, 0.0))
    column, row, zeros = _scales(tolerances, qp)
    A = row.reshape(*qp.A.shape[:-1], 1) * qp.A * _by_column(qp.A, column)
    bound = jnp.where(finite, row * bound, 0.0)
    rounding = _ROUNDING * jnp.finfo(A.dtype).eps
    # no x satisfies a violated row of zeros, nor comes nearer to crossed bounds than their middle
    width = jnp.where(finite[0] & finite[1], bound[0] - bound[1], jnp.inf)
    crossed = width < 0
    unmet = jnp.maximum(-0.5 * width, jnp.where(zeros, jnp.max(-SIGN * bound, axis=0), 0.0))
    finite &= ~zeros
    bound = jnp.where(crossed, 0.5 * (bound[0] + bound[1]), bound)
    bound = jnp.where(finite, bound, 0.0)
    q = column * qp.q
    size = jnp.maximum(largest(q), jnp.max(-SIGN * bound, initial=0.0))  # violated at v = 0
    size = jnp.where(size > 0, size, 1.0)
    bound = bound / size
    # a row narrower than rounding has no interior: it is an equality
    narrow = width / size <= rounding * jnp.maximum(1.0, jnp.abs(bound[0]))
    equality = narrow & ~zeros
    bound = jnp.where(equality, 0.5 * (bound[0] + bound[1]), bound)
    widest = largest(bound)
    return Normal(
        column[:, None] * qp.P * column,
        q / size,
        A,
        bound,
        finite & ~equality,
        equality,
        jnp.where(unmet / size > rounding * widest, unmet / size, 0.0),
        column,
        row,
        size,
        jnp.ones((), bool),
        jnp.where(widest > rounding, jnp.minimum(widest, 1.0), 1.0),
    )


class Start(NamedTuple):
    """First guess of a solution, and the curvature of P.

    On a GPU false for `definite` and `convex` means that nothing proved them yet; then `method`
    computes them.
    """

    point: Point
    active: Array  # (2, m) bool: guess of the active sides
    residuals: Array  # (3,) of the point; infinite if not computed
    definite: Array  # () bool
    convex: Array  # () bool: P is semidefinite


class Approach(NamedTuple):
    """Result of a method that approaches a solution, for the active set."""

    point: Point
    slack: Array  # (2, m)
    residuals: Array  # (3,) of the point; infinite if no point was computed
    certified: Array  # (2,) bool: infeasible, unbounded
    iterations: Array
