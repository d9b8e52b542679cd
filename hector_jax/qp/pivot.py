"""A guess at the active set of a small QP, in one GPU kernel; `control.qp` proves or mends it.

A batched factorisation per try keeps a GPU waiting: the slowest problem of the batch decides how
often all are factorised. Here a problem is one program with registers of its own and stops alone.
It inverts P once (by sweeps) and then changes a row at a time, each a rank-one change of the
inverse of P + c A'A over the active rows: the worst row in and the worst out, and, should that
cycle, the first wrong row alone (Murty's least-index rule, which ends because soft rows make the
complementarity problem one of a positive definite matrix).

Rows are soft here (c = `stiffness`) and the inverse drifts, so nothing of this is believed.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jaxtyping import Array, Float, Int

VARIABLES, ROWS = 64, 128  # of the kernel's tiles: what the registers of a program hold
_LIMIT = 120  # row changes; the least-index rule from half of it on


class Guess(NamedTuple):
    """Where the pivoting ended."""

    x: Float[Array, " n"]
    y: Float[Array, " m"]  # positive where the upper bound presses
    side: Int[Array, " m"]  # 1 active at the upper bound, -1 at the lower, 0 inactive
    settled: Int[Array, ""]  # 1 where no row is wrong any more


class _Softness(NamedTuple):
    """What the dtype allows, for unit diagonal of P and rows of length one."""

    stiffness: float  # c of an active row
    proximal: float  # added to the diagonal of P
    tolerance: float  # a violation or a multiplier this small is none
    passes: int  # of the method of multipliers after a change


def _softness(dtype: jnp.dtype) -> _Softness:
    if jnp.finfo(dtype).bits == 64:
        return _Softness(1e4, 1e-8, 1e-10, 1)
    return _Softness(30.0, 1e-3, 3e-6, 3)  # a row let go divides by 1 / c: 32 bits bear little


def fits(variables: int, rows: int) -> bool:
    """Whether a QP of this size can be guessed here."""
    return variables <= VARIABLES and rows <= ROWS


def guess(
    P: Float[Array, "n n"],
    q: Float[Array, " n"],
    A: Float[Array, "m n"],
    lower: Float[Array, " m"],
    upper: Float[Array, " m"],
    interpret: bool = False,
) -> Guess:
    """Guess the active set of a normalised QP, for which `fits` holds; `vmap` is the GPU's grid.

    Args:
        P, q, A, lower, upper: the QP, P with unit diagonal, rows of A of length one; a bound that
            is not there is infinite.
        interpret: run the kernel's operations one by one, anywhere; for tests.
    """
    n, m, dtype = len(q), len(lower), q.dtype
    more, spare = VARIABLES - n, ROWS - m
    tiles = (
        jnp.pad(P, ((0, more), (0, more))),
        jnp.pad(q, (0, more)),
        jnp.pad(A, ((0, spare), (0, more))),
        jnp.pad(lower, (0, spare), constant_values=-jnp.inf),
        jnp.pad(upper, (0, spare), constant_values=jnp.inf),
    )
    wide = jax.ShapeDtypeStruct((VARIABLES,), dtype)
    tall = jax.ShapeDtypeStruct((ROWS,), dtype)
    sides = jax.ShapeDtypeStruct((ROWS,), jnp.int32)
    flag = jax.ShapeDtypeStruct((), jnp.int32)
    options = {}
    if not interpret:
        from jax.experimental.pallas import triton

        options["compiler_params"] = triton.CompilerParams(num_warps=4, num_stages=1)
    found = pl.pallas_call(
        partial(_kernel, n, _softness(dtype)),
        out_shape=Guess(wide, tall, sides, flag),
        interpret=interpret,
        **options,
    )(*tiles)
    return Guess(found.x[:n], found.y[:m], found.side[:m], found.settled)


def _kernel(n: int, soft: _Softness, P_ref, q_ref, A_ref, lower_ref, upper_ref, *refs) -> None:
    out = Guess(*refs)
    P, q, A = P_ref[...], q_ref[...], A_ref[...]
    lower, upper = lower_ref[...], upper_ref[...]
    c, proximal, tolerance, one, zero = (np.asarray(v, P.dtype) for v in (*soft[:3], 1.0, 0.0))
    index = lax.broadcasted_iota(jnp.int32, (VARIABLES,), 0)
    number = lax.broadcasted_iota(jnp.int32, (ROWS,), 0)
    across = lax.broadcasted_iota(jnp.int32, P.shape, 0)
    down = lax.broadcasted_iota(jnp.int32, P.shape, 1)
    eye = jnp.where(across == down, one, zero)

    def times(M: Array, v: Array) -> Array:
        return jnp.sum(M * v[None, :], axis=1)

    def sweep(k: Array, M: Array) -> Array:
        column = jnp.sum(jnp.where(down == k, M, zero), axis=1)
        pivot = jnp.sum(jnp.where(index == k, column, zero))
        # with this entry one rank-one change sweeps row and column too, and leaves 2 too many at k
        column = jnp.where(index == k, pivot - one, column)
        return M - (column * (one / pivot))[:, None] * column[None, :]

    swept = lax.fori_loop(0, n, sweep, P + proximal * eye)
    inverse = jnp.where((across < n) & (down < n), (one + one) * eye - swept, eye)

    def change(M: Array, row: Array, weight: Array) -> Array:
        """The inverse with a weight on one more row."""
        a = A_ref[row, :]
        v = times(M, a)
        return M - (weight / (one + weight * jnp.sum(a * v))) * v[:, None] * v[None, :]

    def pivot(state: tuple) -> tuple:
        x, rows, y, side, M, count, _ = state
        active = side != 0
        bound = jnp.where(side > 0, upper, lower)
        for _ in range(soft.passes):
            y = jnp.where(active, y + c * (rows - bound), zero)
            dx = -times(M, times(P, x) + q + jnp.sum(A * y[:, None], axis=0))
            moved = times(A, dx)
            x, rows, y = x + dx, rows + moved, jnp.where(active, y + c * moved, zero)
        over, under = rows - upper, lower - rows
        leaves = jnp.where(active, -one, jnp.maximum(over, under))
        pulls = jnp.where(active, jnp.where(side > 0, -y, y), -one)
        wrong = jnp.maximum(leaves, pulls) > tolerance
        first = jnp.min(jnp.where(wrong, number, ROWS))
        chosen = wrong & ((count < _LIMIT // 2) | (number == first))
        leaves, pulls = jnp.where(chosen, leaves, -one), jnp.where(chosen, pulls, -one)
        enter, leave = jnp.max(leaves) > tolerance, jnp.max(pulls) > tolerance
        entering, leaving = lax.argmax(leaves, 0, jnp.int32), lax.argmax(pulls, 0, jnp.int32)
        M = change(M, entering, jnp.where(enter, c, zero))
        M = change(M, leaving, jnp.where(leave, -c, zero))
        side = jnp.where(enter & (number == entering), jnp.where(over > under, 1, -1), side)
        side = jnp.where(leave & (number == leaving), 0, side)
        return x, rows, y, side, M, count + 1, enter | leave

    x = -times(inverse, q)
    none = jnp.zeros((ROWS,), P.dtype)
    nowhere = jnp.zeros((ROWS,), jnp.int32)
    state = (x, times(A, x), none, nowhere, inverse, jnp.int32(0), jnp.asarray(True))
    x, _, y, side, _, _, going = lax.while_loop(
        lambda state: state[-1] & (state[-2] < _LIMIT), pivot, state
    )
    out.x[...], out.y[...], out.side[...] = x, y, side.astype(jnp.int32)
    out.settled[...] = jnp.where(going, 0, 1).astype(jnp.int32)
