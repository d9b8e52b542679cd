"""The QP door: minimise 1/2 x'Px + q'x subject to l <= A x <= u, and its derivative.

Decided here: the algorithm, what "solved" means, and what the derivative is where the solution has
a kink.

Size. Every problem is first brought to one size (`_normalise`): x = kappa D v, D = diag(P)^-1/2,
rows of A D of length one, kappa the larger of |D q| and the bounds violated at v = 0. Residuals are
those of (x, y) alone in that form, and nothing is called solved by another measure.

Verdicts. All are comparisons in that form, so that the units of objective, rows and variables do
not matter; t is the tolerance.

- SOLVED: the three residuals are at most t, and the minimiser is held in every direction: P less
  1e-8 of the unit matrix is positive definite, or it is with the rows added to P that are
  equalities or press with a force of more than t. Where it is not held: NOT_UNIQUE.
- INFEASIBLE: a step of the multipliers proves that rows contradict each other, by more than t and
  by more than its own rounding. Or a row of zeros, or a row with l > u, is violated by more than t
  whatever x is. Within t, crossed bounds are an equality with their middle, and a row of zeros is
  met.
- UNBOUNDED: P is not positive definite, and a step of x proves a fall that neither P nor a row
  ends, likewise by more than t and rounding.
- BAD_DATA: a number is not finite, or P plus 1e-9 of the unit matrix is not positive definite.

A violation is measured by the larger of x and the row's bound. A row of zeros (entries of at most
1e-15 of the longest row's) has neither a length nor a bound that counts: it is measured by x, its
length is the geometric mean of the others, and what is below the rounding of the largest bound is
none. Units do matter where nothing else gives a size: a column without price in P is scaled by its
largest entry in A, and where q and the violated bounds are zero, kappa is 1. (In 32 bits: 1e-5,
1e-6 and 1e-7 for 1e-8, 1e-9 and 1e-15.)

Algorithm. First the active set is guessed and corrected by signs (`_active_set`, a semismooth
Newton method): one n x n Cholesky per try, five tries on the QPs of walking, exact to rounding
where it settles; on a GPU a kernel (`control.pivot`) makes the guess and one try proves it. Where
it does not settle, Mehrotra's predictor and corrector (`_interior_point`), which always gets near,
names the active set for a last correction. Both are proximal in x and in the multipliers,

    (P + rho I + A'WA) dx = rhs,    W = 1 / (slack / multiplier + delta),

so that equality rows (slack zero), redundant rows and singular P need no case of their own.

Derivative. Differentiating stationarity and the active rows gives, for tangents of the data,

    P dx + A'dy = -(dP x + dq + dA'y),    A dx - dy / W = du (dl) - dA x,

W_side = ((z + e) / (s + e))^2 from multiplier z and slack s of a side: infinite on active rows,
zero on the others. The square is that of the central path: a row barely active (z = s = 0), where
the true derivative has one value on either side, gets one between. W is capped in the matrix that
is factorised, and a second pass takes the cap's bias off; degenerate vertices stay regular.
The derivative is zero without status SOLVED. (In 32 bits the matrix of a minimiser that is barely
held may have no Cholesky factor; the derivative is then NaN.)
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.custom_derivatives import SymbolicZero
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int

from hector_jax.core.inputs import AT_LEAST_ONE, POSITIVE, check
from hector_jax.qp import pivot

SAVED = "qp"
"""Name of what `jax.checkpoint` is to keep of a solve, so that none is solved again backwards."""


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
    iterations: Int[Array, ""]  # factorisations; with jaxopt its iterations and ours
    status: Int[Array, ""]  # of Status


@dataclass(frozen=True)
class QpConfig:
    """How QPs are solved. Numbers left None follow the dtype.

    Attributes:
        solver: "interior_point" (active set first, interior point where it does not settle) or
            "jaxopt" (BoxOSQP instead of both, with our last correction and our derivative).
        tolerance: largest residual of a SOLVED problem; 1e-8 in 64 bits, 1e-4 in 32.
        active_set_tries: before the interior point is asked.
        max_iterations: of the interior point; BoxOSQP takes a hundred times as many, cheaper ones.
        ratio_cap: largest multiplier-to-slack ratio in a factorised matrix; 1e7 in 64 bits, 1e4
            in 32.
    """

    solver: str = "interior_point"
    tolerance: float | None = None
    active_set_tries: int = 15
    max_iterations: int = 60
    ratio_cap: float | None = None

    def __post_init__(self) -> None:
        check(
            self,
            solver=("interior_point", "jaxopt"),
            tolerance=POSITIVE,
            active_set_tries=AT_LEAST_ONE,
            max_iterations=AT_LEAST_ONE,
            ratio_cap=POSITIVE,
        )


class _Floors(NamedTuple):
    """What the dtype allows, in the normalised problem."""

    tolerance: float  # residuals of a solved problem
    target: float  # residuals and complementarity at which the iterations stop
    proximal: float  # rho of the active set; the interior point starts from ten times it
    cap: float  # largest W in a factorised matrix
    rounding: float  # a multiplier or violation this small has no sign
    kink: float  # e of the derivative
    certificate: float  # of infeasible and unbounded problems
    curvature: float  # a direction with less than this along it is flat
    zero: float  # a row with no larger entry, beside the longest, is a row of zeros


def _floors(config: QpConfig, dtype: jnp.dtype) -> _Floors:
    if jnp.finfo(dtype).bits == 64:
        floors = _Floors(1e-8, 1e-11, 1e-9, 1e7, 1e-12, 1e-11, 1e-7, 1e-8, 1e-15)
    else:
        floors = _Floors(1e-4, 1e-5, 1e-6, 1e4, 1e-6, 1e-6, 1e-4, 1e-5, 1e-7)
    tolerance = config.tolerance or floors.tolerance
    return floors._replace(
        tolerance=tolerance,
        target=min(floors.target, tolerance),
        cap=config.ratio_cap or floors.cap,
    )


def solve_qp(qp: QP, config: QpConfig = QpConfig()) -> Solution:  # noqa: B008
    """Solve a QP; differentiable in both modes, for jit and vmap, in the dtype of the data.

    Never raises on values and never returns a NaN: `status` says what the answer is worth
    (`check_solved` looks at it).

    Raises:
        ValueError: shapes that do not fit together.

    The point of a line, x + y = 1, that is nearest to the origin with x at most 0.2:

    >>> A = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    >>> low, high = jnp.array([1.0, 0.0]), jnp.array([1.0, 0.2])
    >>> found = solve_qp(QP(jnp.eye(2), jnp.zeros(2), A, low, high))
    >>> found.x.round(9).tolist(), Status(int(found.status)).name
    ([0.2, 0.8], 'SOLVED')
    """
    _check_shapes(qp)
    dtype = jnp.result_type(*qp, jnp.float32)
    P, q, A, lower, upper = (jnp.asarray(v, dtype) for v in qp)
    # only the symmetric part of P acts; taken here, the derivative is that of the same function
    return _solve(config, QP(0.5 * (P + P.T), q, A, lower, upper))


def check_solved(solution: Solution, what: str = "QP") -> None:
    """Look at a solution, or a batch of them, outside jit before believing it.

    Raises:
        ValueError: names the first one that is not SOLVED, its status, residuals and remedy.
    """
    status = np.atleast_1d(np.asarray(solution.status))
    bad = np.argwhere(status != Status.SOLVED)
    if not len(bad):
        return
    first = tuple(int(i) for i in bad[0])
    residuals = ", ".join(
        f"{name} {float(np.atleast_1d(np.asarray(getattr(solution, name)))[first]):.1e}"
        for name in ("primal_residual", "dual_residual", "gap")
    )
    count = f"{len(bad)} of {status.size} problems, first at {first}: " if status.size > 1 else ""
    found = Status(status[first])
    raise ValueError(f"{what}: {count}{found.name} ({residuals}). {found.meaning}")


def _check_shapes(qp: QP) -> None:
    P, q, A, lower, upper = (jnp.shape(v) for v in qp)
    n = q[0] if len(q) == 1 else 0
    rows = A[0] * A[1] if len(A) == 3 else A[0] if len(A) == 2 else -1
    fits = A[0] * A[2] == n if len(A) == 3 else A[1:] == (n,)
    if not (n > 0 and P == (n, n) and fits and lower == upper == (rows,)):
        raise ValueError(
            f"QP shapes P {P}, q {q}, A {A}, l {lower}, u {upper}; expected P (n, n), q (n,), "
            "A (m, n) or (N, r, b) with n = N b and m = N r, l and u (m,); a batch is vmap"
        )


def _rows(A: Array, x: Array) -> Array:
    """A x."""
    if A.ndim == 2:
        return A @ x
    return jnp.einsum("krb,kb->kr", A, x.reshape(A.shape[0], A.shape[2])).ravel()


def _columns(A: Array, y: Array) -> Array:
    """A'y."""
    if A.ndim == 2:
        return y @ A
    return jnp.einsum("krb,kr->kb", A, y.reshape(A.shape[:2])).ravel()


def block_diagonal(blocks: Float[Array, "N r b"]) -> Float[Array, "m n"]:
    """Matrix (N r, N b) with these blocks on its diagonal."""
    N, r, b = blocks.shape
    wide = blocks[:, :, None, :] * jnp.eye(N, dtype=blocks.dtype)[:, None, :, None]
    return wide.reshape(N * r, N * b)


def _plus_gram(P: Array, A: Array, w: Array) -> Array:
    """P + A' diag(w) A."""
    if A.ndim == 2:
        return P + (w[:, None] * A).T @ A
    weighted = w.reshape(*A.shape[:2], 1) * A
    return P + block_diagonal(jnp.einsum("krb,krc->kbc", weighted, A))


def _cholesky(matrix: Array) -> Array:
    return lax.linalg.cholesky(matrix, symmetrize_input=False)


def _largest(v: Array) -> Array:
    return jnp.max(jnp.abs(v), initial=0.0)


class _Normal(NamedTuple):
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


_INFINITE = 1e20  # a bound as large as this is none, as most solvers have it
_ROUNDING = 8  # machine epsilons; what is smaller than that beside its like is rounding
_SMALL = 1e-3  # keeps relative residuals meaningful where the solution is zero
_SIGN = np.array([[1.0], [-1.0]])  # a side holds where sign * (A v - bound) <= 0


def _scales(floors: _Floors, qp: QP) -> tuple[Array, Array, Array]:
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
    zeros = most <= floors.zero * jnp.max(most, initial=0.0)
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


def _normalise(floors: _Floors, qp: QP) -> _Normal:
    column, row, zeros = _scales(floors, qp)
    A = _scale_rows_and_columns(qp.A, row, column)
    sign = jnp.asarray(_SIGN, A.dtype)
    bound = jnp.stack([qp.u, qp.l])
    given = jnp.abs(bound) < _INFINITE
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
    size = jnp.maximum(_largest(q), jnp.max(-sign * bound, initial=0.0))  # violated at v = 0
    size = jnp.where(size > 0, size, 1.0)
    bound = bound / size
    # a row narrower than rounding has no interior: it is an equality
    narrow = width / size <= rounding * jnp.maximum(1.0, jnp.abs(bound[0]))
    equality = narrow & ~zeros
    bound = jnp.where(equality, 0.5 * (bound[0] + bound[1]), bound)
    largest = _largest(bound)
    return _Normal(
        column[:, None] * qp.P * column,
        q / size,
        A,
        bound,
        given & ~equality,
        equality,
        jnp.where(unmet / size > rounding * largest, unmet / size, 0.0),
        column,
        row,
        size,
        jnp.ones((), bool),
        jnp.where(largest > rounding, jnp.minimum(largest, 1.0), 1.0),
    )


class _Point(NamedTuple):
    """Candidate of one problem; side values stand for (u, l) as in `_Normal`."""

    x: Array  # (n,)
    z: Array  # (2, m) multipliers of the sides; z[0] is the free one of an equality row


def _violation(qp: _Normal, x: Array) -> Array:
    """How far A x lies outside each side (2, m), negative inside; 0 where there is no side."""
    outside = jnp.asarray(_SIGN, x.dtype) * (_rows(qp.A, x) - qp.bound)
    return jnp.where(qp.side | qp.equality, outside, 0.0)


def _sizes(qp: _Normal, x: Array) -> Array:
    """What a violation of each side is measured by (2, m): x, as rows are unit, and its bound.

    Of its own row: one loose bound would otherwise make every violation small.
    """
    return jnp.maximum(jnp.maximum(_largest(x), _SMALL * qp.reach), jnp.abs(qp.bound))


def _multiplier(z: Array) -> Array:
    return z[0] - z[1]


class _Guess(NamedTuple):
    point: _Point
    active: Array  # (2, m) bool
    best: _Point
    proof: Array  # evidence of the best point
    rho: Array
    iterations: Array
    going: Array


def _worst(qp: _Normal, wrong: Array, active: Array, by: Array) -> Array:
    """Of the wrong sides (2, m) those to change at once.

    Rows of a block share its few variables: one correction mends or spoils the others. So a block
    takes its worst of each kind, to let go and to take up, and the cycles of changing all are rare.
    """
    if qp.A.ndim == 2:
        return wrong
    blocks = (2, *qp.A.shape[:2])
    by = jnp.where(wrong, by, 0.0).reshape(blocks)
    active = active.reshape(blocks)
    largest = lambda v: jnp.max(v, axis=(0, 2), keepdims=True)  # noqa: E731
    bar = jnp.where(
        active, largest(jnp.where(active, by, 0.0)), largest(jnp.where(active, 0.0, by))
    )
    return wrong & (by >= 0.9 * bar).reshape(wrong.shape)


def _active_set(
    floors: _Floors, qp: _Normal, start: _Point, active: Array, wanted: Array, limit: Array
) -> tuple[_Point, Array, Array]:
    """Semismooth Newton: active sides as equations, the guess corrected by signs until it stays.

    Exact to rounding where it settles; it may cycle, so `limit` bounds it. Returns the best of the
    points whose guess stayed, with its evidence (infinite where none did), and the tries; does
    nothing where `wanted` is false.
    """
    dtype = qp.q.dtype
    sign = jnp.asarray(_SIGN, dtype)
    always = jnp.zeros_like(qp.side).at[0].set(qp.equality)
    eye = jnp.eye(len(qp.q), dtype=dtype)

    def improve(state: _Guess) -> _Guess:
        weight = jnp.where(state.active, jnp.asarray(floors.cap, dtype), 0.0)
        factor = _cholesky(_plus_gram(qp.P + state.rho * eye, qp.A, weight[0] + weight[1]))

        def closer(point: _Point) -> tuple[_Point, Array, Array]:
            """A pass of the method of multipliers, which takes six digits off; what is wrong."""
            x, z = point
            z = z + weight * _violation(qp, x)
            dx = -cho_solve((factor, True), qp.P @ x + qp.q + _columns(qp.A, _multiplier(z)))
            x, z = x + dx, z + weight * sign * _rows(qp.A, dx)
            outside = _violation(qp, x)
            pulls, leaves = z < -floors.rounding, outside > floors.rounding * _sizes(qp, x)
            wrong = jnp.where(state.active, pulls, leaves) & ~always
            return _Point(x, z), wrong, jnp.where(state.active, -z, outside)

        def settle() -> tuple[tuple[_Point, Array, Array], Array]:
            """Digits and evidence are for a guess that stays."""
            done = closer(found[0])
            z = done[0].z
            point = done[0]._replace(z=jnp.where(always, z, jnp.maximum(z, 0.0)))
            return done, _evidence(qp, point)

        found = closer(_Point(state.point.x, jnp.where(state.active, state.point.z, 0.0)))
        nothing = jnp.full(3, jnp.inf, dtype)
        found, proof = lax.cond(jnp.any(found[1]), lambda: (found, nothing), settle)
        (x, z), wrong, by = found
        changed = _worst(qp, wrong, state.active, by)
        point = _Point(x, jnp.where(always, z, jnp.maximum(z, 0.0)))
        better = jnp.max(proof) < jnp.max(state.proof)
        best, proof = _choose(better, (point, proof), (state.best, state.proof))
        # a factorisation that fails is tried again with a larger rho
        fine = jnp.isfinite(jnp.sum(x) + jnp.sum(z))
        point = _choose(fine, _Point(x, z), state.point)
        active = _choose(fine, state.active ^ changed, state.active)
        rho = jnp.where(fine, state.rho, 100.0 * state.rho)
        iterations = state.iterations + 1
        # a flat P makes more passes worth their while though the guess stays
        going = ~fine | jnp.any(wrong) | (jnp.max(proof) > floors.target)
        going &= (rho < 1.0) & (iterations < limit)
        return _Guess(point, active, best, proof, rho, iterations, going)

    first = _Guess(
        start,
        (active & qp.side) | always,
        start,
        jnp.full(3, jnp.inf, dtype),
        jnp.asarray(floors.proximal, dtype),
        jnp.zeros((), jnp.int32),
        wanted,
    )
    end = lax.while_loop(lambda state: state.going, improve, first)
    return end.best, end.proof, end.iterations


def _first_guess(qp: _Normal, loose: _Point) -> tuple[_Point, Array]:
    """Where the active set starts from, `loose` being the minimiser without rows."""

    def violated(qp: _Normal) -> tuple[_Point, Array]:
        outside = _violation(qp, loose.x)
        return loose, _worst(qp, outside > 0, jnp.zeros_like(qp.side), outside)

    def pivoted(qp: _Normal) -> tuple[_Point, Array]:
        held = qp.side | qp.equality
        upper, lower = jnp.where(held, qp.bound, jnp.asarray(_SIGN, qp.q.dtype) * jnp.inf)
        x, y, side, settled = pivot.guess(qp.P, qp.q, block_diagonal(qp.A), lower, upper)
        z = jnp.maximum(jnp.asarray(_SIGN, y.dtype) * y, 0.0)
        usable = (settled > 0) & jnp.isfinite(jnp.sum(x) + jnp.sum(y))
        return _choose(usable, (_Point(x, z), jnp.stack([side > 0, side < 0])), violated(qp))

    on_gpu = (
        jax.default_backend() == "gpu" and qp.A.ndim == 3 and pivot.fits(len(qp.q), len(qp.row))
    )
    return lax.platform_dependent(qp, cuda=pivoted, default=violated) if on_gpu else violated(qp)


def _choose(first: Array, a, b):
    """`a` where `first` holds, else `b`, leaf by leaf."""
    return jax.tree.map(lambda v, w: jnp.where(first, v, w), a, b)


class _Loop(NamedTuple):
    point: _Point
    before: _Point
    slack: Array  # (2, m), positive; 1 on sides that are not there
    proximal: Array  # (2,) rho and delta
    iterations: Array
    going: Array


def _interior_point(
    config: QpConfig, floors: _Floors, qp: _Normal, wanted: Array
) -> tuple[_Point, Array, Array, Array]:
    """Mehrotra's proximal method, cold; last finite point, slacks, what is proved, iterations."""
    dtype = qp.q.dtype
    least = jnp.array([10.0 * floors.proximal, 50.0 * jnp.finfo(dtype).eps], dtype)
    sign = jnp.asarray(_SIGN, dtype)
    free = jnp.zeros_like(qp.side).at[0].set(qp.equality)  # sides whose multiplier has no sign
    held = qp.side | free
    count = jnp.maximum(jnp.sum(qp.side), 1)
    eye = jnp.eye(len(qp.q), dtype=dtype)

    def residuals(point: _Point, slack: Array) -> tuple[Array, Array, Array]:
        dual = qp.P @ point.x + qp.q + _columns(qp.A, _multiplier(point.z))
        room = sign * (qp.bound - _rows(qp.A, point.x))
        primal = jnp.where(held, room - jnp.where(free, 0.0, slack), 0.0)
        mu = jnp.sum(jnp.where(qp.side, slack * point.z, 0.0)) / count
        return dual, primal, mu

    def advance(state: _Loop) -> _Loop:
        (x, z), slack = state.point, state.slack
        dual, primal, mu = residuals(state.point, slack)
        rho, delta = state.proximal
        softness = jnp.where(free, 0.1 / floors.cap, slack + delta * z)
        inverse = jnp.where(held, 1.0 / softness, 0.0)
        weight = inverse * jnp.where(free, 1.0, z)
        factor = _cholesky(_plus_gram(qp.P + rho * eye, qp.A, weight[0] + weight[1]))

        def direction(product: Array) -> tuple[Array, Array, Array]:
            """Newton step that takes slack * z to slack * z + product."""

            def closer(_: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
                dx, dz = found
                pull = dual + qp.P @ dx + _columns(qp.A, _multiplier(dz))
                step = -cho_solve((factor, True), pull)
                return dx + step, dz + weight * sign * _rows(qp.A, step)

            # later passes take off what rounding and rho did
            begin = jnp.zeros_like(x), inverse * product - weight * primal
            dx, dz = lax.fori_loop(0, 3, closer, begin)
            along = sign * _rows(qp.A, dx)
            return dx, dz, jnp.where(qp.side, primal - along + delta * dz, 0.0)

        def longest(dz: Array, dslack: Array) -> Array:
            """Step at which the first slack or multiplier reaches zero."""
            rates = jnp.maximum(-dslack / slack, -dz / jnp.where(qp.side, z, 1.0))
            fastest = jnp.max(jnp.where(qp.side, rates, 0.0), initial=0.0)
            return 1.0 / jnp.maximum(fastest, jnp.finfo(dtype).tiny)

        product = jnp.where(qp.side, -slack * z, 0.0)
        _, dz, dslack = direction(product)
        step = jnp.minimum(longest(dz, dslack), 1.0)
        reached = (slack + step * dslack) * (z + step * dz)
        ratio = jnp.sum(jnp.where(qp.side, reached, 0.0)) / count / jnp.where(mu > 0, mu, 1.0)
        centre = mu * jnp.clip(ratio, 0.0, 1.0) ** 3
        dx, dz, dslack = direction(jnp.where(qp.side, product + centre - dslack * dz, 0.0))
        step = jnp.minimum(0.995 * longest(dz, dslack), 1.0)
        new = (_Point(x + step * dx, z + step * dz), slack + step * dslack)
        # a factorisation that fails is tried again further from singular
        fine = jnp.isfinite(jnp.sum(new[0].x) + jnp.sum(new[0].z) + jnp.sum(new[1]))
        point, slack = _choose(fine, new, (state.point, state.slack))
        factors = jnp.where(fine, 0.1, jnp.array([10.0, 100.0], dtype))
        proximal = jnp.maximum(factors * state.proximal, least)
        done = jnp.max(_evidence(qp, point)) <= floors.target
        iterations = state.iterations + 1
        left, share = _rays(floors, qp, state.point, point)
        going = ~done & ~jnp.any(left < share) & (proximal[0] < 1.0)
        going &= iterations < config.max_iterations
        return _Loop(point, state.point, slack, proximal, iterations, going)

    # every product of slack and multiplier the same, however far the bound
    room = jnp.where(qp.side, jnp.maximum(sign * qp.bound, qp.reach), 1.0)
    begin = _Point(jnp.zeros_like(qp.q), jnp.where(qp.side, 1.0 / jnp.maximum(room, 1.0), 0.0))
    start = _Loop(begin, begin, room, least, jnp.zeros((), jnp.int32), wanted)
    end = lax.while_loop(lambda state: state.going, advance, start)
    return end.point, end.slack, _proofs(floors, qp, end.before, end.point), end.iterations


class _Approach(NamedTuple):
    point: _Point
    slack: Array  # (2, m)
    proof: Array  # evidence of the point; infinite where nothing was tried
    proved: Array  # (2,) bool: infeasible, unbounded
    iterations: Array


def _approach(config: QpConfig, floors: _Floors, qp: _Normal, wanted: Array) -> _Approach:
    """The interior point, again in the sizes of what it found where it did not get near.

    One size was taken for x and slope from q and the bounds. Where rows hold x far from where q
    would have it they differ, and what regularises one is too coarse for the other.
    """

    def attempt(state: tuple) -> tuple:
        best, (size, slope), _ = state
        sized = qp._replace(
            P=size / slope * qp.P, q=qp.q / slope, bound=qp.bound / size, reach=qp.reach / size
        )
        point, slack, proved, more = _interior_point(config, floors, sized, wanted)
        point = _Point(size * point.x, slope * point.z)
        proof = _evidence(qp, point)
        first = best.iterations == 0
        better = first | (jnp.max(proof) < jnp.max(best.proof))
        kept = best.point, best.slack, best.proof
        point, slack, proof = _choose(better, (point, size * slack, proof), kept)
        sizes = jnp.stack(
            [_largest(point.x), jnp.maximum(_largest(qp.P @ point.x), _largest(qp.q))]
        )
        again = first & (jnp.max(proof) > floors.target) & ~jnp.any(proved) & jnp.all(sizes > 0.0)
        best = _Approach(point, slack, proof, proved, best.iterations + more)
        return best, jnp.where(again, sizes, 1.0), again

    nowhere = _Approach(
        _Point(jnp.zeros_like(qp.q), jnp.zeros_like(qp.bound)),
        jnp.ones_like(qp.bound),
        jnp.full(3, jnp.inf, qp.q.dtype),
        jnp.zeros(2, bool),
        jnp.zeros((), jnp.int32),
    )
    start = nowhere, jnp.ones(2, qp.q.dtype), wanted
    return lax.while_loop(lambda state: state[-1], attempt, start)[0]


def _box_osqp(config: QpConfig, floors: _Floors, qp: _Normal) -> _Approach:
    """BoxOSQP of jaxopt, its derivative left aside."""
    from jaxopt import BoxOSQP

    held = qp.side | qp.equality
    bound = jnp.where(held, qp.bound, jnp.asarray(_SIGN, qp.q.dtype) * jnp.inf)
    solver = BoxOSQP(
        eq_qp_solve="lu",
        tol=max(1e-5, floors.target),
        maxiter=100 * config.max_iterations,
        termination_check_frequency=25,
        implicit_diff=False,
    )
    A = qp.A if qp.A.ndim == 2 else block_diagonal(qp.A)
    params, state = solver.run(None, (qp.P, qp.q), A, (bound[1], bound[0]))
    finite = jnp.isfinite(jnp.sum(params.primal[0]) + jnp.sum(params.dual_eq))
    x = jnp.where(finite, params.primal[0], 0.0)
    y = jnp.where(finite, params.dual_eq, 0.0)
    z = jnp.maximum(jnp.asarray(_SIGN, y.dtype) * y, 0.0)
    z = jnp.where(qp.equality, jnp.stack([y, jnp.zeros_like(y)]), jnp.where(held, z, 0.0))
    point = _Point(x, z)
    proved = _proofs(floors, qp, jax.tree.map(jnp.zeros_like, point), point)
    slack = jnp.maximum(-_violation(qp, x), 0.0)
    return _Approach(point, slack, _evidence(qp, point), proved, state.iter_num.astype(jnp.int32))


class _Best(NamedTuple):
    point: _Point
    proof: Array
    proved: Array  # (2,) bool
    iterations: Array
    approached: Array  # whether the next round begins with an approach
    going: Array


def _best(config: QpConfig, floors: _Floors, qp: _Normal, loose: _Point, wanted: Array) -> _Best:
    """Best point found: by the active set from a guess, else from where another method gets near.

    Both rounds are one loop, so that the active set is compiled once.
    """
    has_guess = config.solver == "interior_point"
    start, guess = _first_guess(qp, loose) if has_guess else (loose, jnp.zeros_like(qp.side))

    def attempt(state: _Best) -> _Best:
        if has_guess:
            near = _approach(config, floors, qp, state.going & state.approached)
        else:
            near = _box_osqp(config, floors, qp)
        # slacks and multipliers have sizes of their own: far apart where the rows, not P, hold x
        pushes = near.point.z * qp.reach > near.slack * _largest(near.point.z)
        begin, active = _choose(state.approached, (near.point, pushes), (start, guess))
        limit = jnp.where(state.approached, config.max_iterations, config.active_set_tries)
        hopeful = state.going & ~jnp.any(near.proved)
        exact, exact_proof, tries = _active_set(floors, qp, begin, active, hopeful, limit)
        point, proof = state.point, state.proof
        for other, its_proof in ((near.point, near.proof), (exact, exact_proof)):
            better = jnp.max(its_proof) < jnp.max(proof)
            point, proof = _choose(better, (other, its_proof), (point, proof))
        steps = state.iterations + near.iterations + tries
        going = ~state.approached & (jnp.max(proof) > floors.target)
        return _Best(point, proof, near.proved, steps, jnp.ones((), bool), going)

    first = _Best(
        loose,
        jnp.full(3, jnp.inf, qp.q.dtype),
        jnp.zeros(2, bool),
        jnp.zeros((), jnp.int32),
        jnp.asarray(not has_guess),
        wanted,
    )
    return lax.while_loop(lambda state: state.going, attempt, first)


def _support(qp: _Normal, y: Array) -> Array:
    """Sum of u y+ - l y-."""
    return jnp.sum(jnp.where(y > 0, qp.bound[0], qp.bound[1]) * y)


def _slope(qp: _Normal, point: _Point) -> Array:
    """What a residual of P x + q + A'y is measured by: its largest term, and a little."""
    pull = _columns(qp.A, _multiplier(point.z))
    return _SMALL + jnp.maximum(
        jnp.maximum(_largest(qp.P @ point.x), _largest(pull)), _largest(qp.q)
    )


def _rays(floors: _Floors, qp: _Normal, before: _Point, point: _Point) -> tuple[Array, Array]:
    """What a step leaves of a proof that no x of moderate size meets the rows, of an endless fall.

    Without a solution the multipliers grow for ever along a combination of rows that cancels, or x
    along a fall. A step shows that purely; in the point itself is a part that does not cancel.

    Returns:
        What should be zero (2,), and a share of what it is to be small beside: below it, the step
        shows a ray.
    """
    dx, rise = point.x - before.x, point.z - before.z
    sign = jnp.asarray(_SIGN, dx.dtype)
    grown = jnp.where(qp.equality, rise, jnp.maximum(rise, 0.0))  # what falls counts against it
    gap = -jnp.sum(sign * qp.bound * grown + (grown - rise) / floors.certificate)
    # differences of products that an iteration needs at both points anyway
    pull = _columns(qp.A, _multiplier(point.z)) - _columns(qp.A, _multiplier(before.z))
    outside = sign * (_rows(qp.A, point.x) - _rows(qp.A, before.x))
    outward = jnp.where(qp.equality, jnp.abs(outside), jnp.where(qp.side, outside, 0.0))
    needed = jnp.maximum(_largest(qp.P @ point.x - qp.P @ before.x), jnp.max(outward, initial=0.0))
    # where P curves in every direction no fall is endless
    left = jnp.stack([_largest(pull), jnp.where(qp.flat, needed, jnp.inf)])
    return left, floors.certificate * jnp.stack([gap, -jnp.dot(qp.q, dx)])


def _proofs(floors: _Floors, qp: _Normal, before: _Point, point: _Point) -> Array:
    """Whether the step proves that the problem is infeasible, and unbounded (2,).

    By more than the tolerance, within which it can be solved, and by more than rounding.
    """
    dx, rise = point.x - before.x, point.z - before.z
    rows = jnp.sum(jnp.abs(rise) * _sizes(qp, point.x))
    sizes = jnp.stack([rows, jnp.sum(jnp.abs(dx)) * _slope(qp, point)])
    left, share = _rays(floors, qp, before, point)
    A, x = jnp.abs(qp.A), jnp.abs(point.x)
    terms = _largest(_columns(A, jnp.sum(jnp.abs(point.z), axis=0)))
    rounding = jnp.finfo(x.dtype).eps * jnp.stack(
        [terms, jnp.maximum(_largest(jnp.abs(qp.P) @ x), _largest(_rows(A, x)))]
    )
    shown = left + rounding < share
    return shown & (share > floors.certificate * floors.tolerance * sizes)


def _evidence(qp: _Normal, point: _Point) -> Array:
    """Primal residual, dual residual and gap, as `Solution` defines them; infinite for NaN."""
    x, y = point.x, _multiplier(point.z)
    pull, price = _columns(qp.A, y), qp.P @ x
    terms = jnp.stack([jnp.dot(x, price), jnp.dot(qp.q, x), _support(qp, y)])
    primal = jnp.max(_violation(qp, x) / _sizes(qp, x), initial=0.0)
    dual = _largest(price + qp.q + pull) / _slope(qp, point)
    gap = jnp.abs(jnp.sum(terms)) / (_SMALL * qp.reach + _largest(terms))
    proof = jnp.stack([primal, dual, gap])
    return jnp.where(jnp.isfinite(jnp.sum(proof)), proof, jnp.inf)


def _or_plain(valid: Array, qp: QP) -> QP:
    """The QP, or a plain one in its place, so that nothing that follows meets a NaN."""
    plain = QP(jnp.eye(len(qp.q), dtype=qp.q.dtype), *(jnp.zeros_like(v) for v in qp[1:]))
    return _choose(valid, qp, plain)


def _shifted(matrix: Array, shift: float) -> tuple[Array, Array]:
    """Cholesky factor of a matrix plus a multiple of the unit matrix, and whether there is one.

    So a smallest eigenvalue is compared exactly. Pivots would not tell: that of a singular matrix
    grows with the number of variables that share the flat direction.
    """
    factor = _cholesky(matrix + shift * jnp.eye(len(matrix), dtype=matrix.dtype))
    return factor, jnp.isfinite(factor[-1, -1])


def _only_if(wanted: Array, function: Callable, otherwise: Any, operands: Any) -> Any:
    """`function(operands)` where `wanted`, else `otherwise`; costs nothing where none is wanted.

    A loop of one round, because vmap makes a cond compute for every problem of a batch.
    """

    def once(state: tuple) -> tuple:
        # that reads the state, or the compiler would compute it once, before the loop
        _, hidden = lax.optimization_barrier((state[0], operands))
        return jnp.zeros((), bool), function(hidden)

    return lax.while_loop(lambda state: state[0], once, (wanted, otherwise))[1]


def _without_rows(floors: _Floors, qp: _Normal) -> tuple[Array, Array, Array]:
    """Minimiser without rows; whether P curves in every direction; whether it is semidefinite.

    One factorisation where P curves.
    """

    def minimiser(shift: float, qp: _Normal) -> tuple[Array, Array]:
        factor, exists = _shifted(qp.P, shift)
        return -cho_solve((factor, True), qp.q), exists

    x, curved = minimiser(-floors.curvature, qp)
    softened = partial(minimiser, floors.proximal)
    x, convex = _only_if(~curved, softened, (x, curved), qp)
    return x, curved, convex


def _held(floors: _Floors, qp: _Normal, point: _Point) -> Array:
    """Whether P and the rows hold a minimiser in every direction.

    A row holds where it is an equality or presses with more than the tolerance. One that is active
    without force does not: the minimiser can leave it.
    """
    force = point.z / _slope(qp, point)
    slack = jnp.abs(_violation(qp, point.x)) / _sizes(qp, point.x)
    pressing = qp.side & (force > floors.tolerance) & (force > slack)
    holding = qp.equality | jnp.any(pressing, axis=0)
    # the cap's rounding could hide a flat direction; this one's is a hundredth of the curvature
    weight = jnp.where(holding, 0.01 * floors.curvature / jnp.finfo(force.dtype).eps, 0.0)
    return _shifted(_plus_gram(qp.P, qp.A, weight), -floors.curvature)[1]


@partial(jax.jit, static_argnums=0)
def _solve_normal(config: QpConfig, qp: QP) -> tuple[Solution, Array, _Normal]:
    """Solution, the ratios W (2, m) of its derivative, and the problem they belong to."""
    floors = _floors(config, qp.q.dtype)
    no_bound = jnp.isnan(qp.l) | jnp.isnan(qp.u) | (qp.l >= _INFINITE) | (qp.u <= -_INFINITE)
    numbers = jnp.maximum(jnp.maximum(_largest(qp.P), _largest(qp.q)), _largest(qp.A))
    valid = jnp.isfinite(numbers) & ~jnp.any(no_bound)
    normal = _normalise(floors, _or_plain(valid, qp))
    free, definite, convex = _without_rows(floors, normal)
    normal = normal._replace(flat=~definite)
    valid &= convex
    loose = _Point(free, jnp.zeros(normal.side.shape, qp.q.dtype))
    point, proof, proved, iterations, *_ = _best(config, floors, normal, loose, valid)
    # far from any solution (infeasible, unbounded) all evidence may be infinite, and so may x
    usable = valid & jnp.all(jnp.isfinite(proof))
    point = jax.tree.map(lambda v: jnp.where(usable, v, 0.0), point)

    solved = usable & (jnp.max(proof) <= floors.tolerance)
    # what no x can meet; an x that solves nothing is no measure of it
    sizes = jnp.min(_sizes(normal, jnp.where(solved, point.x, normal.reach)), axis=0)
    unmet = jnp.max(normal.unmet / sizes, initial=0.0)
    held = lambda operands: _held(floors, *operands)  # noqa: E731
    unique = _only_if(solved & ~definite, held, definite, (normal, point))
    status = jnp.where(proved[1], Status.UNBOUNDED, Status.INACCURATE)
    status = jnp.where(proved[0], Status.INFEASIBLE, status)
    status = jnp.where(solved, jnp.where(unique, Status.SOLVED, Status.NOT_UNIQUE), status)
    status = jnp.where(unmet > floors.tolerance, Status.INFEASIBLE, status)
    status = jnp.where(valid, status, Status.BAD_DATA).astype(jnp.int32)
    primal, dual, gap = jnp.where(valid, proof, jnp.inf)
    solution = Solution(
        normal.size * normal.column * point.x,
        normal.size * normal.row * _multiplier(point.z),
        jnp.maximum(primal, unmet),
        dual,
        gap,
        iterations,
        status,
    )
    slack = jnp.maximum(-_violation(normal, point.x), 0.0)
    ratio = ((point.z + floors.kink) / (slack / _sizes(normal, point.x) + floors.kink)) ** 2
    ratio = jnp.where(normal.side, jnp.minimum(ratio, floors.cap), 0.0)
    # an equality moves with both of its bounds, half with each
    return solution, jnp.where(normal.equality, 0.5 * floors.cap, ratio), normal


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(config: QpConfig, qp: QP) -> Solution:
    return _solve_normal(config, qp)[0]


def _moves(tangent: Any) -> bool:
    return not isinstance(tangent, SymbolicZero)


@partial(_solve.defjvp, symbolic_zeros=True)
def _solve_jvp(config: QpConfig, primals: tuple[QP], tangents: tuple[QP]) -> tuple:
    (qp,), (d,) = primals, tangents
    solution, ratio, normal = _solve_normal(config, qp)
    solution, ratio = checkpoint_name((solution, ratio), SAVED)
    dtype = qp.q.dtype
    floors = _floors(config, dtype)
    column, row = normal.column, normal.row
    both = ratio[0] + ratio[1]
    firm = both >= floors.cap
    eye = jnp.eye(len(qp.q), dtype=dtype)
    factor = _cholesky(_plus_gram(normal.P + floors.proximal * eye, normal.A, both))
    sound = solution.status == Status.SOLVED
    factor = jnp.where(sound, factor, eye)
    pull, shift = jnp.zeros_like(solution.x), jnp.zeros_like(solution.y)
    if _moves(d.P):
        pull += d.P @ solution.x
    if _moves(d.q):
        pull += d.q
    if _moves(d.A):
        pull, shift = pull + _columns(d.A, solution.y), shift + both * _rows(d.A, solution.x)
    if _moves(d.u):
        shift -= ratio[0] * d.u
    if _moves(d.l):
        shift -= ratio[1] * d.l
    pull, shift = jnp.where(sound, column * pull, 0.0), jnp.where(sound, row * shift, 0.0)
    dv, dz = jnp.zeros_like(pull), jnp.zeros_like(shift)
    for _ in range(2):  # as in `_active_set`: later passes take off what cap and rho did
        force = jnp.where(firm, dz, 0.0) + both * _rows(normal.A, dv) + shift
        step = -cho_solve((factor, True), normal.P @ dv + pull + _columns(normal.A, force))
        dv, dz = dv + step, force + both * _rows(normal.A, step)
    zero = jnp.zeros((), dtype)
    none = np.zeros((), jax.dtypes.float0)
    return solution, Solution(column * dv, row * dz, zero, zero, zero, none, none)
