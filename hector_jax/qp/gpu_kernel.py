"""Solve a small QP in one GPU kernel; residuals computed outside it prove the point.

A batched factorisation per iteration keeps a GPU waiting: the slowest problem of the batch
determines how often all are factorised. Here each problem is one program with its own registers and
stops independently. It inverts P once (by sweeps) and then applies rank-one updates to the inverse
of P + c A'A over the active rows: the worst row enters and the worst leaves, and in case of a cycle
only the first wrong row changes (Murty's least-index rule, which terminates because soft rows make
the matrix of the complementarity problem positive definite, if P is; if not, `_LIMIT` ends it).

Only once no row is wrong by a coarse tolerance is a fine one applied: with the fine one alone, rows
enter that an inexact point touches by its rounding, and 2 % of the guesses were wrong.

Rows are soft here (c = `stiffness`) and the inverse drifts, so at the end passes of the method of
multipliers refine the point. Its residuals are computed outside; if they are too large,
`active_set` corrects it.

What limits the speed is how many programs run at once, which registers decide. So only the inverse
and the few entries of each row and column of A stay in them; P is read whenever it is needed.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jaxtyping import Float, Int

from hector_jax.core.arrays import Array

VARIABLES, ROWS = 64, 128  # size of the kernel's vectors, limited by the registers of a program
_LIMIT = 120  # changes; the second half uses the least-index rule


class Guess(NamedTuple):
    """Result of the pivoting."""

    x: Float[Array, " n"]
    y: Float[Array, " m"]  # positive where the upper bound presses
    side: Int[Array, " m"]  # 1 active at the upper bound, -1 at the lower, 0 inactive
    settled: Int[Array, ""]  # 1 if no row is wrong
    definite: Int[Array, ""]  # 1 if all eigenvalues of P were proved to be above `curvature`


class _Softness(NamedTuple):
    """Parameters for a dtype, for unit diagonal of P and rows of length one."""

    stiffness: float  # c of an active row
    shift: float  # subtracted from P's diagonal; if positive, positive pivots prove P definite
    coarse: float  # violations and multipliers up to it count as zero at first
    fine: float  # and up to this one after that
    passes: int  # of the method of multipliers after a change
    refinements: int  # passes at the end


def _softness(dtype: jnp.dtype, curvature: float) -> _Softness:
    if jnp.finfo(dtype).bits == 64:
        return _Softness(1e4, curvature, 1e-6, 1e-10, 1, 2)
    # A leaving row divides by 1 / c: 32 bits need a small c, and a matrix that is easy to invert.
    # So a pass gains less: two at the end left 0.18 N of error in 100 walking QPs, six 0.03 N.
    return _Softness(30.0, -1e-3, 1e-4, 3e-6, 3, 6)


def fits(variables: int, rows: int) -> bool:
    """Return whether the kernel accepts a QP of this size."""
    return variables <= VARIABLES and 0 < rows <= ROWS


def guess(
    P: Float[Array, "n n"],
    q: Float[Array, " n"],
    A: Float[Array, "N r b"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    *,
    curvature: float,
    interpret: bool = False,
) -> Guess:
    """Solve a normalised QP for which `fits` holds, unproved; `vmap` is the GPU's grid.

    Args:
        P, q, A, lower, upper: the QP, P with unit diagonal, A block-diagonal by step with rows of
            length one; a missing bound is infinite.
        curvature: what the eigenvalues of a definite P exceed; 32 bits prove nothing.
        interpret: interpret the kernel's operations on any device; for tests.
    """
    options: Any = {}
    shaped: Any = jax.ShapeDtypeStruct
    flag, side = (shaped(shape, jnp.int32) for shape in ((), lower.shape))
    x, y = (shaped(v.shape, q.dtype) for v in (q, lower))
    if not interpret:
        options["compiler_params"] = triton.CompilerParams(num_warps=4, num_stages=1)
    return pl.pallas_call(
        partial(_kernel, A.shape, curvature, (lambda: None) if interpret else triton.debug_barrier),
        out_shape=Guess(x, y, side, flag, flag),
        interpret=interpret,
        **options,
    )(P, q, A.ravel(), lower, upper)


class _Problem(NamedTuple):
    """The QP as a program sees it, padded to VARIABLES and ROWS, and parameters of its dtype."""

    curve: Callable[[Array], Array]  # returns P x (VARIABLES,)
    rows: Callable[[Array], Array]  # returns A x (ROWS,)
    pull: Callable[[Array], Array]  # returns A'y (VARIABLES,)
    row: Callable[[Array], Array]  # returns the row of A (VARIABLES,) with this number
    q: Array
    lower: Array
    upper: Array
    number: Array  # index of each row
    c: np.ndarray
    fine: np.ndarray  # tolerance at the end
    one: np.ndarray
    zero: np.ndarray
    passes: int


def _times(M: Array, v: Array) -> Array:
    """Return M'v: a thread holds parts of columns, so that it sums most of a column alone."""
    return jnp.sum(M * v[:, None], axis=0)


def _indices(*shape: int) -> list[Array]:
    """Return the index along each axis, as arrays of this shape."""
    return [lax.broadcasted_iota(jnp.int32, shape, i) for i in range(len(shape))]


def _inverse(n: int, P: Array, one: np.ndarray, zero: np.ndarray) -> tuple[Array, Array]:
    """Invert P by sweeps; also return whether it is positive definite."""
    [index], (across, down) = _indices(VARIABLES), _indices(*P.shape)
    eye, inside = jnp.where(across == down, one, zero), (across < n) & (down < n)

    def sweep(k: Array, column: Array) -> tuple[Array, Array, Array]:
        pivot = jnp.sum(jnp.where(index == k, column, zero))
        # with this entry one rank-one update also sweeps row and column k, and adds 2 at (k, k)
        column = jnp.where(index == k, pivot - one, column)
        return column, column * (one / pivot), pivot > zero

    # Two columns at a time are one pass over M. For an odd n the last pair has a column of the
    # padding, whose result is not used.
    def sweep_two(pair: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        M, definite = state
        i, j = 2 * pair, 2 * pair + 1
        first, second = (jnp.sum(jnp.where(across == k, M, zero), axis=0) for k in (i, j))
        first, first_scaled, positive = sweep(i, first)
        definite &= positive
        # the second column as the first sweep leaves it
        second -= jnp.sum(jnp.where(index == j, first_scaled, zero)) * first
        second, second_scaled, positive = sweep(j, second)
        M -= first_scaled[:, None] * first + second_scaled[:, None] * second
        return M, definite & positive

    start = jnp.where(inside, P, eye), jnp.asarray(True)
    swept, definite = lax.fori_loop(0, (n + 1) // 2, sweep_two, start)
    return jnp.where(inside, (one + one) * eye - swept, eye), definite


def _correct(qp: _Problem, M: Array, side: Array, point: tuple[Array, Array, Array]) -> tuple:
    """Run one pass of the method of multipliers with the active rows, on x, A x and y."""
    x, rows, y = point
    active = side != 0
    y = jnp.where(active, y + qp.c * (rows - jnp.where(side > 0, qp.upper, qp.lower)), qp.zero)
    dx = -_times(M, qp.curve(x) + qp.q + qp.pull(y))
    d_rows = qp.rows(dx)
    return x + dx, rows + d_rows, jnp.where(active, y + qp.c * d_rows, qp.zero)


def _pivot(qp: _Problem, state: tuple) -> tuple:
    """Solve with the active rows, then let the worst row enter and the worst row leave."""
    one, number = qp.one, qp.number

    def update(M: Array, row: Array, weight: Any) -> Array:
        """Update the inverse for a weight on one more row."""
        a = qp.row(row)
        v = _times(M, a)
        return M - (weight / (one + weight * jnp.sum(a * v))) * v[:, None] * v[None, :]

    x, rows, y, side, M, tolerance, count, _ = state
    active = side != 0
    for _ in range(qp.passes):
        x, rows, y = _correct(qp, M, side, (x, rows, y))
    over, under = rows - qp.upper, qp.lower - rows
    outside = jnp.where(active, -one, jnp.maximum(over, under))
    negative = jnp.where(active, jnp.where(side > 0, -y, y), -one)
    wrong = jnp.maximum(outside, negative) > tolerance
    first = jnp.min(jnp.where(wrong, number, ROWS))
    allowed = wrong & ((count < _LIMIT // 2) | (number == first))
    outside, negative = jnp.where(allowed, outside, -one), jnp.where(allowed, negative, -one)
    enter, leave = jnp.max(outside) > tolerance, jnp.max(negative) > tolerance
    entering, leaving = lax.argmax(outside, 0, jnp.int32), lax.argmax(negative, 0, jnp.int32)
    M = lax.cond(enter, lambda: update(M, entering, qp.c), lambda: M)
    M = lax.cond(leave, lambda: update(M, leaving, -qp.c), lambda: M)
    side = jnp.where(enter & (number == entering), jnp.where(over > under, 1, -1), side)
    side = jnp.where(leave & (number == leaving), 0, side)
    changed = enter | leave
    running = changed | (tolerance > qp.fine)
    tolerance = jnp.where(changed, tolerance, qp.fine)
    return x, rows, y, side, M, tolerance, count + 1, running


def _load(ref: Any, index: Any, inside: Any, other: Any) -> Array:
    return triton.load(ref.at[index], mask=inside, other=other)


def _store(ref: Any, index: Any, inside: Any, value: Any) -> None:
    triton.store(ref.at[index], value, mask=inside)


def _products(
    shape: tuple[int, ...], barrier: Callable[[], Any], A_ref: Any, out: Any, zero: np.ndarray
) -> tuple[Callable[[Array], Array], ...]:
    """Return the functions `rows`, `pull` and `row` of `_Problem`, for blocks of this shape.

    A thread needs numbers that others hold and gets them through the memory of the outputs. Call
    `rows` and `pull` in turn: the barrier in one separates the loads of the other from its next
    store. Two calls of one of them need a barrier between.
    """
    _, r, b = map(np.int32, shape)
    m, n, [column], [number] = out.y.size, out.x.size, _indices(VARIABLES), _indices(ROWS)
    # The entries of each row, and of each column, one below the other; tiles have powers of two.
    place, row_of = _indices(1 << int(b - 1).bit_length(), ROWS)
    in_row, variable_at = (place < b) & (row_of < m), lax.div(row_of, r) * b + place
    A = _load(A_ref, row_of * b + place, in_row, zero)
    place, column_of = _indices(1 << int(r - 1).bit_length(), VARIABLES)
    in_column, row_at = (place < r) & (column_of < n), lax.div(column_of, b) * r + place
    At = _load(A_ref, row_at * b + lax.rem(column_of, b), in_column, zero)

    def rows(x: Array) -> Array:
        _store(out.x, column, column < n, x)
        barrier()
        return jnp.sum(A * _load(out.x, variable_at, in_row, zero), axis=0)

    def pull(y: Array) -> Array:
        _store(out.y, number, number < m, y)
        barrier()
        return jnp.sum(At * _load(out.y, row_at, in_column, zero), axis=0)

    def row(i: Array) -> Array:
        inside = (column < n) & (lax.div(column, b) == lax.div(i, r))
        return _load(A_ref, i * b + lax.rem(column, b), inside, zero)

    return rows, pull, row


def _kernel(
    shape: tuple[int, ...], curvature: float, barrier: Callable[[], Any], *refs: Any
) -> None:
    P_ref, q_ref, A_ref, lower_ref, upper_ref, *out_refs = refs
    out: Any = Guess(*out_refs)
    dtype, soft = P_ref.dtype, _softness(P_ref.dtype, curvature)
    c, shift, coarse, fine = (np.asarray(v, dtype) for v in soft[:4])
    one, zero, infinite = (np.asarray(v, dtype) for v in (1.0, 0.0, np.inf))
    n, m, [column], [number] = q_ref.size, lower_ref.size, _indices(VARIABLES), _indices(ROWS)
    across, down = _indices(VARIABLES, VARIABLES)
    in_x, in_y, in_P = column < n, number < m, (across < n) & (down < n)

    def matrix() -> Array:
        return _load(P_ref, (across, down), in_P, zero)

    inverse, definite = _inverse(n, matrix() - jnp.where(across == down, shift, zero), one, zero)
    q = _load(q_ref, column, in_x, zero)
    lower = _load(lower_ref, number, in_y, -infinite)
    upper = _load(upper_ref, number, in_y, infinite)
    curve = lambda x: _times(matrix(), x)  # noqa: E731
    rows, pull, row = _products(shape, barrier, A_ref, out, zero)
    qp = _Problem(curve, rows, pull, row, q, lower, upper, number, c, fine, one, zero, soft.passes)
    x, y, side = -_times(inverse, q), jnp.zeros((ROWS,), dtype), jnp.zeros((ROWS,), jnp.int32)
    counters = jnp.asarray(coarse), jnp.int32(0), jnp.asarray(True)
    x, _, y, side, inverse, *_, running = lax.while_loop(
        lambda state: state[-1] & (state[-2] < _LIMIT),
        partial(_pivot, qp),
        (x, rows(x), y, side, inverse, *counters),
    )
    barrier()
    product = rows(x)
    for _ in range(soft.refinements):
        x, product, y = _correct(qp, inverse, side, (x, product, y))
    barrier()
    _store(out.x, column, in_x, x)
    _store(out.y, number, in_y, y)
    _store(out.side, number, in_y, side)
    out.settled[...] = jnp.where(running, 0, 1).astype(jnp.int32)
    out.definite[...] = jnp.where(definite & (soft.shift > 0), 1, 0).astype(jnp.int32)
