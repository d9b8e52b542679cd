"""The problem that the QP solvers work on: data, one size for all, residuals.

Every QP is first brought to one size (`normalise`): x = kappa D v, D = diag(P)^-1/2, rows of A D of
length one, kappa the larger of |D q| and the bounds violated at v = 0. Residuals are those of
(x, y) alone in that form, so that the units of objective, rows and variables do not matter. They do
where nothing else gives a size: a column without price in P is scaled by its largest entry in A,
and where q and the violated bounds are zero, kappa is 1.

A violation is measured by the larger of x and the row's bound. A row of zeros (entries of at most
1e-15 of the longest row's, 1e-7 in 32 bits) has neither a length nor a bound that counts: it is
measured by x, its length is the geometric mean of the others, and what is below the rounding of the
largest bound is none. Within the tolerance crossed bounds are an equality with their middle.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from hector_jax.core.arrays import Array
from hector_jax.qp.linear import largest, matvec, multiplier, rmatvec

INFINITE = 1e20  # a bound as large as this is none, as most solvers have it
SIGN = np.array([[1.0], [-1.0]])  # a side holds where sign * (A v - bound) <= 0
_ROUNDING = 8  # machine epsilons; what is smaller than that beside its like is rounding
_SMALL = 1e-3  # keeps relative residuals meaningful where the solution is zero


class Status(IntEnum):
    """What a solution is worth; `Solution.status` holds these codes.

    `meaning` says it in words, with a remedy.
    """

    meaning: str

    def __new__(cls, code: int, meaning: str) -> "Status":
        """A code that carries its meaning."""
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
    Infinite bounds (1e20 and more), rows with l = u, redundant rows and rows of zeros are legal,
    and so are bounds that only rounding has crossed. A batch is vmap.
    """

    P: Float[Array, "n n"]
    q: Float[Array, " n"]
    A: Float[Array, "m n"] | Float[Array, "N r b"]
    l: Float[Array, " m"]  # noqa: E741
    u: Float[Array, " m"]


class Solution(NamedTuple):
    """Minimiser and multipliers with their own evidence.

    Residuals are those of (x, y) in the normalised problem (module docstring), so they have no unit
    and compare between problems: `primal_residual` is the largest violation of a row over the
    larger of x and the row's bound, `dual_residual` the largest entry of P x + q + A'y over the
    largest of its terms, `gap` |x'Px + q'x + sum(u y+ - l y-)| over the largest of its terms (and a
    little, so that a solution of zeros has residuals too). With BAD_DATA x and y are zero and the
    residuals infinite.
    """

    x: Float[Array, " n"]
    y: Float[Array, " m"]  # positive where the upper bound presses, negative where the lower does
    primal_residual: Float[Array, ""]
    dual_residual: Float[Array, ""]
    gap: Float[Array, ""]
    iterations: Int[Any, ""]  # factorisations; with jaxopt its iterations and ours
    status: Int[Any, ""]  # of Status


class Tolerances(NamedTuple):
    """What the dtype allows, in the normalised problem."""

    residual: float  # of a solved problem, at most
    target: float  # residuals and complementarity at which the iterations stop
    proximal: float  # rho of the active set; the interior point starts from ten times it
    cap: float  # largest W in a factorised matrix
    rounding: float  # a multiplier or violation this small has no sign
    kink: float  # e of the derivative
    certificate: float  # of infeasible and unbounded problems
    curvature: float  # a direction with less than this along it is flat
    zero: float  # a row with no larger entry, beside the longest, is a row of zeros


BITS_64 = Tolerances(1e-8, 1e-11, 1e-9, 1e7, 1e-12, 1e-11, 1e-7, 1e-8, 1e-15)
BITS_32 = Tolerances(1e-4, 1e-5, 1e-6, 1e4, 1e-6, 1e-6, 1e-4, 1e-5, 1e-7)


class Point(NamedTuple):
    """Candidate of one problem; side values stand for (u, l) as in `Normal`."""

    x: Array  # (n,)
    z: Array  # (2, m) multipliers of the sides; z[0] is the free one of an equality row


class Normal(NamedTuple):
    """A QP in normalised variables, x = size * column * v; side values stand for (u, l)."""

    P: Array
    q: Array
    A: Array
    bound: Array  # (2, m), zero where infinite; both sides of an equality the same
    side: Array  # (2, m) bool: a finite bound of a row that is neither an equality nor of zeros
    equality: Array  # (m,) bool
    unmet: Array  # (m,) violation of a row of zeros, or of crossed bounds, whatever x is
    column: Array  # (n,)
    row: Array  # (m,)
    size: Array
    flat: Array  # () bool: P may have no curvature along some direction
    reach: Array  # size of A v: largest finite bound, but 1 at most, and where all are zero

    def violation(self, x: Array) -> Array:
        """How far A x lies outside each side (2, m), negative inside; 0 where there is no side."""
        outside = jnp.asarray(SIGN, x.dtype) * (matvec(self.A, x) - self.bound)
        return jnp.where(self.side | self.equality, outside, 0.0)

    def row_sizes(self, x: Array) -> Array:
        """What a violation of each side is measured by (2, m): x, as rows are unit, and its bound.

        Of its own row: one loose bound would otherwise make every violation small.
        """
        return jnp.maximum(jnp.maximum(largest(x), _SMALL * self.reach), jnp.abs(self.bound))

    def slope_size(self, point: Point) -> Array:
        """What a residual of P x + q + A'y is measured by: its largest term, and a little."""
        pull = rmatvec(self.A, multiplier(point.z))
        return _SMALL + jnp.maximum(
            jnp.maximum(largest(self.P @ point.x), largest(pull)), largest(self.q)
        )

    def residuals(self, point: Point) -> Array:
        """Primal residual, dual residual and gap, as `Solution` defines them; infinite for NaN."""
        x, y = point.x, multiplier(point.z)
        pull, price = rmatvec(self.A, y), self.P @ x
        prices = jnp.dot(x, price), jnp.dot(self.q, x)
        support = jnp.sum(jnp.where(y > 0, self.bound[0], self.bound[1]) * y)  # u y+ - l y-
        terms = jnp.stack([*prices, support])
        primal = jnp.max(self.violation(x) / self.row_sizes(x), initial=0.0)
        dual = largest(price + self.q + pull) / self.slope_size(point)
        gap = jnp.abs(jnp.sum(terms)) / (_SMALL * self.reach + largest(terms))
        residuals = jnp.stack([primal, dual, gap])
        return jnp.where(jnp.isfinite(jnp.sum(residuals)), residuals, jnp.inf)


def _scales(tolerances: Tolerances, qp: QP) -> tuple[Array, Array, Array]:
    """Columns D, rows that make those of A D unit vectors, and which rows are zeros.

    D = diag(P)^-1/2. A column that P does not price is scaled by its largest entry in A, so that it
    is as large there as the largest priced one: D keeps one unit when the objective changes its.
    A row of zeros has no length and gets the geometric mean of the others' largest entries.
    """
    diagonal = jnp.diagonal(qp.P)
    reach = jnp.max(jnp.abs(qp.A), axis=-2, initial=0.0).ravel()  # largest entry of a column
    priced = diagonal > 1e-3 * jnp.finfo(qp.P.dtype).eps * jnp.max(diagonal)
    column = lax.rsqrt(jnp.where(priced, diagonal, 1.0))
    widest = jnp.max(jnp.where(priced, column * reach, 0.0))
    unpriced = jnp.where(widest > 0, widest, 1.0) / jnp.where(reach > 0, reach, 1.0)
    column = jnp.where(priced, column, unpriced)
    wide = column if qp.A.ndim == 2 else column.reshape(qp.A.shape[0], 1, qp.A.shape[2])
    rows = qp.A * wide
    most = jnp.max(jnp.abs(rows), axis=-1, initial=0.0)
    zeros = most <= tolerances.zero * jnp.max(most, initial=0.0)
    most = jnp.where(zeros, 1.0, most)  # divided by first, or squares leave the range
    squares = jnp.sum((rows / most[..., None]) ** 2, axis=-1)
    mean = jnp.exp(jnp.sum(jnp.log(most)) / jnp.maximum(jnp.sum(~zeros), 1))
    row = jnp.where(zeros, 1.0 / mean, lax.rsqrt(jnp.where(zeros, 1.0, squares)) / most)
    return column, row.ravel(), zeros.ravel()


def _scale_rows_and_columns(A: Array, row: Array, column: Array) -> Array:
    if A.ndim == 2:
        return row[:, None] * A * column
    N, r, b = A.shape
    return row.reshape(N, r, 1) * A * column.reshape(N, 1, b)


def normalise(tolerances: Tolerances, qp: QP) -> Normal:
    """Bring a QP of finite numbers to one size."""
    column, row, zeros = _scales(tolerances, qp)
    A = _scale_rows_and_columns(qp.A, row, column)
    sign = jnp.asarray(SIGN, A.dtype)
    bound = jnp.stack([qp.u, qp.l])
    given = jnp.abs(bound) < INFINITE
    bound = jnp.where(given, row * bound, 0.0)
    rounding = _ROUNDING * jnp.finfo(A.dtype).eps
    # no x mends a row of zeros, nor brings a row nearer to crossed bounds than their middle
    width = jnp.where(given[0] & given[1], bound[0] - bound[1], jnp.inf)
    crossed = width < 0
    unmet = jnp.maximum(-0.5 * width, jnp.where(zeros, jnp.max(-sign * bound, axis=0), 0.0))
    given &= ~zeros
    bound = jnp.where(crossed, 0.5 * (bound[0] + bound[1]), bound)
    bound = jnp.where(given, bound, 0.0)
    q = column * qp.q
    size = jnp.maximum(largest(q), jnp.max(-sign * bound, initial=0.0))  # violated at v = 0
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
        given & ~equality,
        equality,
        jnp.where(unmet / size > rounding * widest, unmet / size, 0.0),
        column,
        row,
        size,
        jnp.ones((), bool),
        jnp.where(widest > rounding, jnp.minimum(widest, 1.0), 1.0),
    )


class Approach(NamedTuple):
    """What a method that gets near a solution hands to the active set."""

    point: Point
    slack: Array  # (2, m)
    residuals: Array  # (3,) of the point; infinite where nothing was tried
    certified: Array  # (2,) bool: infeasible, unbounded
    iterations: Array
