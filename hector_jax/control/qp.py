"""The QP door: minimise 1/2 x'Px + q'x subject to l <= A x <= u, and its derivative.

Decided here: the algorithm, what "solved" means, and what the derivative is where the solution has a kink.

Every problem is first brought to one size (`_normalise`): x = kappa D v with D = diag(P)^-1/2, rows of A D of length one, and
kappa such that the larger of |D q| and the bounds violated at x = 0 is one. The interior point method (Mehrotra's predictor
and corrector on both sides of every row, proximal in x and in the multipliers) then solves one n x n Cholesky per iteration:

    (P + rho I + A'WA) dx = rhs,   W = sum over sides of z / (s + delta z)      (z multiplier, s slack of a side)

The proximal terms bound W by 1/delta, which is how equality rows (s = 0), redundant rows and singular P need no case of
their own. Residuals are those of (x, y) alone, measured in the normalised problem, and nothing is called solved by any
other measure.

Derivative. Differentiating stationarity and z s = const at the solution gives, for tangents of the data,

    (P + A'WA) dx = -(dP x + dq + dA'y + A'(W dA x - W_u du - W_l dl)),   dy = W (A dx + dA x) - W_u du - W_l dl

with W = W_u + W_l, W_side = min(z/s, cap) in the normalised problem: near cap on active rows, near zero on the others, in
between on a row that is barely active, where the true derivative has one value on either side. The cap keeps the system
regular at degenerate vertices. Solutions without status SOLVED have derivative zero.
"""

from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float, Int


class Status(IntEnum):
    """What a solution is worth; `Solution.status` holds these codes."""

    SOLVED = 0  # all three residuals are at most the tolerance
    INACCURATE = 1  # the best point found; its residuals say how far off it is
    INFEASIBLE = 2  # no x meets the rows (proved by a multiplier, or l > u)
    UNBOUNDED = 3  # the objective falls for ever (proved by a direction)
    BAD_DATA = 4  # NaN, an infinite number that is no bound, or P with a negative eigenvalue


class QP(NamedTuple):
    """Minimise 1/2 x'Px + q'x subject to l <= A x <= u.

    P is positive semidefinite (its symmetric part counts). A is dense (m, n), or block-diagonal by step (N, r, b) with
    m = N r rows and n = N b: rows r k .. r (k+1) read variables b k .. b (k+1). Infinite bounds, rows with l = u, redundant
    rows and rows of zeros are legal. A batch is vmap.
    """

    P: Float[Array, "n n"]
    q: Float[Array, " n"]
    A: Float[Array, "m n"] | Float[Array, "N r b"]
    l: Float[Array, " m"]  # noqa: E741
    u: Float[Array, " m"]


class Solution(NamedTuple):
    """Minimiser and multipliers with their own evidence.

    Residuals are those of (x, y) in the normalised problem (module docstring), so they have no unit and compare between
    problems: `primal_residual` largest violation of a row over 1 + largest |A x|, `dual_residual` largest entry of
    P x + q + A'y over 1 + largest entry of its terms, `gap` |x'Px + q'x + sum(u y+ - l y-)| over 1 + its largest term.
    Where status is BAD_DATA, x and y are zero and the residuals infinite.
    """

    x: Float[Array, " n"]
    y: Float[
        Array, " m"
    ]  # positive where the upper bound presses, negative where the lower one does
    primal_residual: Float[Array, ""]
    dual_residual: Float[Array, ""]
    gap: Float[Array, ""]
    iterations: Int[Array, ""]
    status: Int[Array, ""]  # of Status


@dataclass(frozen=True)
class QpConfig:
    """How QPs are solved. Numbers left None follow the dtype.

    Attributes:
        solver: "interior_point" (ours) or "jaxopt" (BoxOSQP with our derivative).
        tolerance: largest residual of a SOLVED problem; 1e-8 in 64 bits, 1e-4 in 32.
        max_iterations: of the interior point; BoxOSQP takes a hundred times as many, cheaper ones.
        ratio_cap: largest multiplier-to-slack ratio in the derivative; 1e8 in 64 bits, 1e4 in 32.
    """

    solver: str = "interior_point"
    tolerance: float | None = None
    max_iterations: int = 60
    ratio_cap: float | None = None

    def __post_init__(self) -> None:
        if self.solver not in ("interior_point", "jaxopt"):
            raise ValueError(
                f'QpConfig.solver is "{self.solver}"; there are "interior_point" and "jaxopt"'
            )
        for name in ("tolerance", "max_iterations", "ratio_cap"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"QpConfig.{name} is {value}; expected a positive number")


class _Floors(NamedTuple):
    """What the dtype allows, in the normalised problem."""

    tolerance: float  # residuals of a solved problem
    target: float  # residuals and complementarity at which the iteration stops
    proximal: float  # rho and delta
    ratio_cap: float
    certificate: float  # of infeasible and unbounded problems


def _floors(config: QpConfig, dtype: jnp.dtype) -> _Floors:
    double = jnp.finfo(dtype).bits == 64
    tolerance = config.tolerance or (1e-8 if double else 1e-4)
    ratio_cap = config.ratio_cap or (1e8 if double else 1e4)
    if double:
        return _Floors(tolerance, min(1e-12, tolerance), 1e-10, ratio_cap, 1e-8)
    return _Floors(tolerance, min(1e-6, tolerance), 1e-6, ratio_cap, 1e-4)


def solve_qp(qp: QP, config: QpConfig = QpConfig()) -> Solution:  # noqa: B008
    """Solve a QP; differentiable in both modes, for jit and vmap, in the dtype of the data.

    Never raises on values and never returns a NaN: `status` says what the answer is worth (`check_solved` looks at it).

    Raises:
        ValueError: shapes that do not fit together.
    """
    _check_shapes(qp)
    dtype = jnp.result_type(*qp, jnp.float32)
    P, q, A, lower, upper = (jnp.asarray(v, dtype) for v in qp)
    # only the symmetric part of P acts; taking it here makes the derivative that of the same function
    return _solve(config, QP(0.5 * (P + P.T), q, A, lower, upper))[0]


def check_solved(solution: Solution, what: str = "QP") -> None:
    """Look at a solution, or a batch of them, outside jit before believing it.

    Raises:
        ValueError: names the first one that is not SOLVED, its status and residuals.
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
    raise ValueError(f"{what} not solved: {count}{Status(status[first]).name} ({residuals})")


def _check_shapes(qp: QP) -> None:
    P, q, A, lower, upper = (jnp.shape(v) for v in qp)
    n = q[0] if len(q) == 1 else -1
    if len(A) == 3:
        fits = A[0] * A[2] == n
        rows = A[0] * A[1]
    else:
        fits = len(A) == 2 and A[1] == n
        rows = A[0] if A else -1
    if not (P == (n, n) and fits and lower == upper == (rows,) and n > 0):
        raise ValueError(
            f"QP shapes P {P}, q {q}, A {A}, l {lower}, u {upper}; expected P (n, n), q (n,), A (m, n) or (N, r, b) with "
            "n = N b and m = N r, l and u (m,); a batch is vmap"
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


def _plus_gram(P: Array, A: Array, w: Array) -> Array:
    """P + A' diag(w) A."""
    if A.ndim == 2:
        return P + (w[:, None] * A).T @ A
    N, r, b = A.shape
    blocks = jnp.einsum("krb,krc->kbc", w.reshape(N, r, 1) * A, A)
    spread = blocks[:, :, None, :] * jnp.eye(N, dtype=P.dtype)[:, None, :, None]
    return P + spread.reshape(N * b, N * b)


def _largest(v: Array) -> Array:
    return jnp.max(jnp.abs(v), initial=0.0)


class _Normal(NamedTuple):
    """A QP in normalised variables: x = size * column * v, A v between bounds, both sides of a row stacked."""

    P: Array
    q: Array
    A: Array
    bound: Array  # (2, m): u, l; zero where infinite
    side: Array  # (2, m) bool: there is such a bound, and the row is no equality
    equality: Array  # (m,) bool
    column: Array  # (n,)
    row: Array  # (m,)
    size: Array


_SIGN = np.array([[1.0], [-1.0]])  # slack of a side: sign * (bound - A x)


def _scales(qp: QP) -> tuple[Array, Array]:
    """Columns D = diag(P)^-1/2 and rows that make those of A D unit vectors; 1 where there is nothing to go by."""
    diagonal = jnp.diagonal(qp.P)
    reach = jnp.max(jnp.abs(qp.A), axis=-2, initial=0.0).ravel()  # largest entry of each column
    eps = jnp.finfo(qp.P.dtype).eps
    priced = diagonal > 1e-3 * eps * jnp.max(diagonal)
    curvature = jnp.where(priced, diagonal, jnp.where(reach > 0, reach, 1.0) ** 2)
    column = lax.rsqrt(curvature)
    per_column = column if qp.A.ndim == 2 else column.reshape(qp.A.shape[0], 1, qp.A.shape[2])
    squares = jnp.sum((qp.A * per_column) ** 2, axis=-1).ravel()
    return column, lax.rsqrt(jnp.where(squares > 0, squares, 1.0))


def _scale_matrix(A: Array, column: Array, row: Array) -> Array:
    if A.ndim == 2:
        return row[:, None] * A * column
    N, r, b = A.shape
    return row.reshape(N, r, 1) * A * column.reshape(N, 1, b)


def _normalise(qp: QP) -> _Normal:
    column, row = _scales(qp)
    A = _scale_matrix(qp.A, column, row)
    q = column * qp.q
    lower, upper = row * qp.l, row * qp.u
    pressed = jnp.max(jnp.maximum(lower, -upper), initial=0.0)  # bounds violated at x = 0
    size = jnp.maximum(_largest(q), jnp.where(jnp.isfinite(pressed), pressed, 0.0))
    size = jnp.where(size > 0, size, 1.0)
    bound = jnp.stack([upper, lower]) / size
    finite = jnp.isfinite(bound)
    bound = jnp.where(finite, bound, 0.0)
    width = bound[0] - bound[1]
    # a row narrower than rounding has no interior: it is an equality
    close = 8 * jnp.finfo(q.dtype).eps * jnp.maximum(1.0, jnp.abs(bound[0]))
    equality = finite[0] & finite[1] & (width <= close)
    # rows of zeros bind nothing once 0 is known to lie between their bounds (`_no_point` looks)
    empty = jnp.all(A == 0, axis=-1).ravel()
    return _Normal(
        column[:, None] * qp.P * column,
        q / size,
        A,
        bound,
        finite & ~equality & ~empty,
        equality & ~empty,
        column,
        row,
        size,
    )


class _Iterate(NamedTuple):
    x: Array  # (n,)
    slack: Array  # (2, m), positive; 1 on sides that are not there
    z: Array  # (2, m), positive, 0 on sides that are not there; z[0] is the free multiplier of an equality row


class _Loop(NamedTuple):
    iterate: _Iterate
    iterations: Array
    going: Array


def _interior_point(config: QpConfig, floors: _Floors, qp: _Normal) -> tuple[_Iterate, Array]:
    """Mehrotra's method with proximal terms, from a cold start; the last iterate whose entries are all finite."""
    dtype = qp.q.dtype
    delta = jnp.asarray(floors.proximal, dtype)
    sign = jnp.asarray(_SIGN, dtype)
    held = qp.side.at[0].set(qp.side[0] | qp.equality)  # sides that carry a multiplier
    free = jnp.zeros_like(qp.side).at[0].set(qp.equality)  # of those, the ones without a sign
    count = jnp.maximum(jnp.sum(qp.side), 1)
    P = qp.P + delta * jnp.eye(len(qp.q), dtype=dtype)

    def residuals(it: _Iterate) -> tuple[Array, Array, Array]:
        dual = qp.P @ it.x + qp.q + _columns(qp.A, it.z[0] - it.z[1])
        gap = sign * (qp.bound - _rows(qp.A, it.x))
        primal = jnp.where(held, gap - jnp.where(free, 0.0, it.slack), 0.0)
        mu = jnp.sum(jnp.where(qp.side, it.slack * it.z, 0.0)) / count
        return dual, primal, mu

    def advance(state: _Loop) -> _Loop:
        it = state.iterate
        dual, primal, mu = residuals(it)
        inverse = jnp.where(held, 1.0 / jnp.where(free, delta, it.slack + delta * it.z), 0.0)
        weight = inverse * jnp.where(free, 1.0, it.z)
        factor = lax.linalg.cholesky(
            _plus_gram(P, qp.A, weight[0] + weight[1]), symmetrize_input=False
        )

        def direction(product: Array) -> tuple[Array, Array, Array]:
            """Newton step for slack * z -> slack * z + product."""
            known = inverse * product - weight * primal
            dx = cho_solve((factor, True), -dual - _columns(qp.A, known[0] - known[1]))
            dz = known + weight * (sign * _rows(qp.A, dx))
            dslack = jnp.where(qp.side, primal - sign * _rows(qp.A, dx) + delta * dz, 0.0)
            return dx, dslack, dz

        def longest(dslack: Array, dz: Array) -> Array:
            steps = jnp.where(
                qp.side, jnp.maximum(-dslack / it.slack, -dz / jnp.where(qp.side, it.z, 1.0)), 0.0
            )
            return 1.0 / jnp.maximum(jnp.max(steps, initial=0.0), 1e-30)

        product = jnp.where(qp.side, -it.slack * it.z, 0.0)
        _, dslack, dz = direction(product)
        step = jnp.minimum(longest(dslack, dz), 1.0)
        reached = (
            jnp.sum(jnp.where(qp.side, (it.slack + step * dslack) * (it.z + step * dz), 0.0))
            / count
        )
        target = mu * jnp.clip(reached / jnp.where(mu > 0, mu, 1.0), 0.0, 1.0) ** 3
        dx, dslack, dz = direction(jnp.where(qp.side, product + target - dslack * dz, 0.0))
        step = jnp.minimum(0.995 * longest(dslack, dz), 1.0)
        new = _Iterate(it.x + step * dx, it.slack + step * dslack, it.z + step * dz)
        finite = jnp.isfinite(jnp.sum(new.x) + jnp.sum(new.slack) + jnp.sum(new.z))
        new = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, it)
        dual, primal, mu = residuals(new)
        reach = 1.0 + _largest(new.z)
        done = (
            (_largest(dual) <= floors.target * reach)
            & (_largest(primal) <= floors.target * (1.0 + _largest(new.slack)))
            & (mu <= floors.target)
        )
        infeasible, unbounded = _certificates(floors, qp, new.x, new.z[0] - new.z[1])
        iterations = state.iterations + 1
        going = finite & ~done & ~infeasible & ~unbounded & (iterations < config.max_iterations)
        return _Loop(new, iterations, going)

    slack = jnp.where(qp.side, jnp.maximum(sign * qp.bound, 1.0), 1.0)
    start = _Iterate(jnp.zeros_like(qp.q), slack, qp.side.astype(dtype))
    end = lax.while_loop(
        lambda state: state.going, advance, _Loop(start, jnp.zeros((), jnp.int32), jnp.array(True))
    )
    return end.iterate, end.iterations


def _support(qp: _Normal, y: Array) -> Array:
    """Sum of u y+ - l y-."""
    return jnp.sum(jnp.where(y > 0, qp.bound[0], qp.bound[1]) * y)


def _certificates(floors: _Floors, qp: _Normal, x: Array, y: Array) -> tuple[Array, Array]:
    """Whether y proves that no point of moderate size meets the rows, and x that the objective falls for ever."""
    loss = -_support(qp, y)
    infeasible = _largest(_columns(qp.A, y)) < floors.certificate * loss
    fall = -jnp.dot(qp.q, x)
    along = jnp.asarray(_SIGN, x.dtype) * _rows(qp.A, x)
    held = qp.side | qp.equality
    outward = jnp.max(
        jnp.where(held, jnp.where(qp.equality, jnp.abs(along), along), 0.0), initial=0.0
    )
    unbounded = jnp.maximum(_largest(qp.P @ x), outward) < floors.certificate * fall
    return infeasible, unbounded


def _evidence(qp: _Normal, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Primal residual, dual residual and gap of (x, y), as `Solution` defines them."""
    rows, pull, price = _rows(qp.A, x), _columns(qp.A, y), qp.P @ x
    held = qp.side | qp.equality
    violation = jnp.where(held, jnp.asarray(_SIGN, x.dtype) * (rows - qp.bound), 0.0)
    primal = jnp.max(violation, initial=0.0) / (1.0 + _largest(rows))
    size = jnp.maximum(jnp.maximum(_largest(price), _largest(pull)), _largest(qp.q))
    dual = _largest(price + qp.q + pull) / (1.0 + size)
    terms = jnp.stack([jnp.dot(x, price), jnp.dot(qp.q, x), _support(qp, y)])
    return primal, dual, jnp.abs(jnp.sum(terms)) / (1.0 + _largest(terms))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(config: QpConfig, qp: QP) -> tuple[Solution, Array]:
    """Solution, and the capped multiplier-to-slack ratios (2, m) of its derivative in the units of the data."""
    floors = _floors(config, qp.q.dtype)
    finite = jnp.isfinite(jnp.sum(qp.P) + jnp.sum(qp.q) + jnp.sum(qp.A))
    numbers = ~jnp.any(jnp.isnan(qp.l) | jnp.isnan(qp.u) | (qp.l == jnp.inf) | (qp.u == -jnp.inf))
    good = finite & numbers
    crossed = good & jnp.any(qp.l > qp.u)
    # a problem that cannot be solved is replaced by one that can, so that nothing below meets a NaN
    plain = QP(jnp.eye(len(qp.q), dtype=qp.q.dtype), *(jnp.zeros_like(v) for v in qp[1:]))
    safe = QP(*(jnp.where(good & ~crossed, v, p) for v, p in zip(qp, plain, strict=True)))
    normal = _normalise(safe)
    rounding = len(qp.q) * 8 * jnp.finfo(qp.q.dtype).eps
    trial = lax.linalg.cholesky(
        normal.P + rounding * jnp.eye(len(qp.q), dtype=qp.q.dtype), symmetrize_input=False
    )
    good &= jnp.isfinite(trial[-1, -1])
    iterate, iterations = _interior_point(config, floors, normal)
    x, y = iterate.x, iterate.z[0] - iterate.z[1]
    primal, dual, gap = _evidence(normal, x, y)
    solved = jnp.maximum(jnp.maximum(primal, dual), gap) <= floors.tolerance
    infeasible, unbounded = _certificates(floors, normal, x, y)
    zero_row = jnp.all(normal.A == 0, axis=-1).ravel() & ((safe.l > 0) | (safe.u < 0))
    infeasible |= crossed | jnp.any(zero_row)
    status = jnp.where(solved, Status.SOLVED, Status.INACCURATE)
    status = jnp.where(unbounded & ~solved, Status.UNBOUNDED, status)
    status = jnp.where(
        (infeasible & ~solved) | crossed | jnp.any(zero_row), Status.INFEASIBLE, status
    )
    status = jnp.where(good, status, Status.BAD_DATA).astype(jnp.int32)

    def told(v: Array) -> Array:  # residuals of data that say nothing
        return jnp.where(good & ~crossed, v, jnp.inf)

    solution = Solution(
        jnp.where(good & ~crossed, normal.size * normal.column * x, 0.0),
        jnp.where(good & ~crossed, normal.size * normal.row * y, 0.0),
        told(primal),
        told(dual),
        told(gap),
        iterations,
        status,
    )
    cap = jnp.asarray(floors.ratio_cap, x.dtype)
    ratio = jnp.where(normal.side, jnp.minimum(iterate.z / iterate.slack, cap), 0.0)
    ratio = jnp.where(
        normal.equality, 0.5 * cap, ratio
    )  # half to either bound, which move together
    return solution, ratio * normal.row**2


@_solve.defjvp
def _solve_jvp(config: QpConfig, primals: tuple[QP], tangents: tuple[QP]) -> tuple:
    (qp,), (d,) = primals, tangents
    solution, ratio = _solve(config, qp)
    solved = solution.status == Status.SOLVED
    column, _ = _scales(qp)
    n = len(qp.q)
    both = ratio[0] + ratio[1]
    scaled = column[:, None] * _plus_gram(qp.P, qp.A, both) * column
    floor = jnp.asarray(_floors(config, qp.q.dtype).proximal, qp.q.dtype)
    # unsolved problems get the unit matrix: their tangents are zero, and no NaN may reach them
    factor = lax.linalg.cholesky(
        jnp.where(solved, scaled, 0.0)
        + jnp.where(solved, floor, 1.0) * jnp.eye(n, dtype=qp.q.dtype),
        symmetrize_input=False,
    )
    moved = both * _rows(d.A, solution.x) - ratio[0] * d.u - ratio[1] * d.l
    pull = d.P @ solution.x + d.q + _columns(d.A, solution.y) + _columns(qp.A, moved)
    dx = -column * cho_solve((factor, True), jnp.where(solved, column * pull, 0.0))
    dy = jnp.where(solved, both * _rows(qp.A, dx) + moved, 0.0)
    zero = jnp.zeros((), qp.q.dtype)
    none = np.zeros((), jax.dtypes.float0)
    return (solution, ratio), (
        Solution(dx, dy, zero, zero, zero, none, none),
        jnp.zeros_like(ratio),
    )
