"""Solve a small QP in one GPU kernel; residuals computed outside it prove the point.

A batched factorisation per iteration keeps a GPU waiting: the slowest problem of the batch
determines how often all are factorised. Here each problem is one program with its own registers and
stops independently. It inverts P once (by sweeps) and then applies rank-one updates to the inverse
of P + c A'A over the active rows: the worst row enters and the worst leaves, and in case of a cycle
only the first wrong row changes (Murty's least-index rule, which terminates because soft rows make
the matrix of the complementarity problem positive definite).

Only once no row is wrong by a coarse tolerance is a fine one applied: with the fine one alone, rows
enter that an inexact point touches by its rounding, and 2 % of the guesses were wrong.

Rows are soft here (c = `stiffness`) and the inverse drifts, so at the end passes of the method of
multipliers refine the point. Its residuals are computed outside; if they are too large,
`active_set` corrects it.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jaxtyping import Float, Int

from hector_jax.core.arrays import Array

VARIABLES, ROWS = 64, 128  # size of the kernel's tiles, limited by the registers of a program
_LIMIT = 120  # changes; the second half uses the least-index rule
_REFINEMENTS = 2  # passes at the end: of 1000 walking QPs one leaves 8e-13, two leave rounding


class Guess(NamedTuple):
    """Result of the pivoting."""

    x: Float[Array, " n"]
    y: Float[Array, " m"]  # positive where the upper bound presses
    side: Int[Array, " m"]  # 1 active at the upper bound, -1 at the lower, 0 inactive
    settled: Int[Array, ""]  # 1 if no row is wrong


class _Softness(NamedTuple):
    """Parameters for a dtype, for unit diagonal of P and rows of length one."""

    stiffness: float  # c of an active row
    proximal: float  # added to the diagonal of P
    coarse: float  # violations and multipliers up to it count as zero at first
    fine: float  # and up to this one after that
    passes: int  # of the method of multipliers after a change


def _softness(dtype: jnp.dtype) -> _Softness:
    if jnp.finfo(dtype).bits == 64:
        return _Softness(1e4, 1e-8, 1e-6, 1e-10, 1)
    # a leaving row divides by 1 / c: 32 bits need a small c
    return _Softness(30.0, 1e-3, 1e-4, 3e-6, 3)


def fits(variables: int, rows: int) -> bool:
    """Return whether the kernel accepts a QP of this size."""
    return variables <= VARIABLES and rows <= ROWS


def guess(
    P: Float[Array, "n n"],
    q: Float[Array, " n"],
    A: Float[Array, "m n"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    interpret: bool = False,
) -> Guess:
    """Solve a normalised QP for which `fits` holds, unproved; `vmap` is the GPU's grid.

    Args:
        P, q, A, lower, upper: the QP, P with unit diagonal, rows of A of length one; a missing
            bound is infinite.
        interpret: interpret the kernel's operations on any device; for tests.
    """
    n, m, dtype = len(q), len(lower), q.dtype
    columns, rows = (0, VARIABLES - n), (0, ROWS - m)  # padding
    tiles = (
        jnp.pad(P, (columns, columns)),
        jnp.pad(q, columns),
        jnp.pad(A, (rows, columns)),
        jnp.pad(A.T, (columns, rows)),
        jnp.pad(lower, rows, constant_values=-jnp.inf),
        jnp.pad(upper, rows, constant_values=jnp.inf),
    )
    shapes = {"x": (VARIABLES,), "y": (ROWS,), "side": (ROWS,), "settled": ()}
    kinds = {"x": dtype, "y": dtype, "side": jnp.int32, "settled": jnp.int32}
    out: Any = {name: jax.ShapeDtypeStruct(shapes[name], kinds[name]) for name in shapes}
    options = {}
    if not interpret:
        from jax.experimental.pallas import triton

        options["compiler_params"] = triton.CompilerParams(num_warps=4, num_stages=1)
    outputs = pl.pallas_call(
        partial(_kernel, n, _softness(dtype)),
        out_shape=Guess(**out),
        interpret=interpret,
        **options,
    )(*tiles)
    return Guess(outputs.x[:n], outputs.y[:m], outputs.side[:m], outputs.settled)


class _Problem(NamedTuple):
    """The QP in a program's registers, and parameters of its dtype."""

    P: Array
    q: Array
    A: Array
    At: Array  # A transposed
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


def _inverse(n: int, P: Array, proximal: np.ndarray, one: np.ndarray, zero: np.ndarray) -> Array:
    """Invert P with `proximal` added to its diagonal, by sweeps."""
    index = lax.broadcasted_iota(jnp.int32, (VARIABLES,), 0)
    across = lax.broadcasted_iota(jnp.int32, P.shape, 0)
    down = lax.broadcasted_iota(jnp.int32, P.shape, 1)
    eye = jnp.where(across == down, one, zero)

    def sweep(k: Array, M: Array) -> Array:
        column = jnp.sum(jnp.where(across == k, M, zero), axis=0)  # M is symmetric
        pivot = jnp.sum(jnp.where(index == k, column, zero))
        # with this entry one rank-one update also sweeps row and column k, and adds 2 at (k, k)
        column = jnp.where(index == k, pivot - one, column)
        return M - (column * (one / pivot))[:, None] * column[None, :]

    swept = lax.fori_loop(0, n, sweep, P + proximal * eye)
    return jnp.where((across < n) & (down < n), (one + one) * eye - swept, eye)


def _correct(qp: _Problem, M: Array, side: Array, x: Array, rows: Array, y: Array) -> tuple:
    """Run one pass of the method of multipliers with the active rows. Returns x, A x and y."""
    active = side != 0
    y = jnp.where(active, y + qp.c * (rows - jnp.where(side > 0, qp.upper, qp.lower)), qp.zero)
    dx = -_times(M, _times(qp.P, x) + qp.q + _times(qp.A, y))
    d_rows = _times(qp.At, dx)
    return x + dx, rows + d_rows, jnp.where(active, y + qp.c * d_rows, qp.zero)


def _pivot(qp: _Problem, read_row: Callable[[Array], Array], state: tuple) -> tuple:
    """Solve with the active rows, then let the worst row enter and the worst row leave."""
    c, one, zero, number = qp.c, qp.one, qp.zero, qp.number

    def update(M: Array, row: Array, weight: Array) -> Array:
        """Update the inverse for a weight on one more row."""
        a = read_row(row)
        v = _times(M, a)
        return M - (weight / (one + weight * jnp.sum(a * v))) * v[:, None] * v[None, :]

    x, rows, y, side, M, tolerance, count, _ = state
    active = side != 0
    for _ in range(qp.passes):
        x, rows, y = _correct(qp, M, side, x, rows, y)
    over, under = rows - qp.upper, qp.lower - rows
    outside = jnp.where(active, -one, jnp.maximum(over, under))
    negative = jnp.where(active, jnp.where(side > 0, -y, y), -one)
    wrong = jnp.maximum(outside, negative) > tolerance
    first = jnp.min(jnp.where(wrong, number, ROWS))
    allowed = wrong & ((count < _LIMIT // 2) | (number == first))
    outside, negative = jnp.where(allowed, outside, -one), jnp.where(allowed, negative, -one)
    enter, leave = jnp.max(outside) > tolerance, jnp.max(negative) > tolerance
    entering, leaving = lax.argmax(outside, 0, jnp.int32), lax.argmax(negative, 0, jnp.int32)
    M = update(M, entering, jnp.where(enter, c, zero))
    M = update(M, leaving, jnp.where(leave, -c, zero))
    side = jnp.where(enter & (number == entering), jnp.where(over > under, 1, -1), side)
    side = jnp.where(leave & (number == leaving), 0, side)
    changed = enter | leave
    running = changed | (tolerance > qp.fine)
    tolerance = jnp.where(changed, tolerance, qp.fine)
    return x, rows, y, side, M, tolerance, count + 1, running


def _kernel(
    n: int, soft: _Softness, P_ref, q_ref, A_ref, At_ref, lower_ref, upper_ref, *refs
) -> None:
    out: Any = Guess(*refs)
    P, q, A, At = P_ref[...], q_ref[...], A_ref[...], At_ref[...]
    lower, upper = lower_ref[...], upper_ref[...]
    c, proximal, coarse, fine = (np.asarray(v, P.dtype) for v in soft[:4])
    one, zero = np.asarray(1.0, P.dtype), np.asarray(0.0, P.dtype)
    inverse = _inverse(n, P, proximal, one, zero)
    number = lax.broadcasted_iota(jnp.int32, (ROWS,), 0)
    qp = _Problem(P, q, A, At, lower, upper, number, c, fine, one, zero, soft.passes)
    x = -_times(inverse, q)
    y, side = jnp.zeros((ROWS,), P.dtype), jnp.zeros((ROWS,), jnp.int32)
    counters = jnp.asarray(coarse), jnp.int32(0), jnp.asarray(True)
    state = (x, _times(At, x), y, side, inverse, *counters)
    x, _, y, side, inverse, *_, running = lax.while_loop(
        lambda state: state[-1] & (state[-2] < _LIMIT),
        partial(_pivot, qp, lambda row: A_ref[row, :]),
        state,
    )
    rows = _times(At, x)
    for _ in range(_REFINEMENTS):
        x, rows, y = _correct(qp, inverse, side, x, rows, y)
    out.x[...], out.y[...], out.side[...] = x, y, side.astype(jnp.int32)
    out.settled[...] = jnp.where(running, 0, 1).astype(jnp.int32)
