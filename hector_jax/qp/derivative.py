"""The derivative of a solution, from the optimality conditions; no iteration is unrolled.

Differentiating stationarity and the active rows gives, for tangents of the data,

    P dx + A'dy = -(dP x + dq + dA'y),    A dx - dy / W = du (dl) - dA x,

W_side = ((z + e) / (s + e))^2 from multiplier z and slack s of a side: infinite on active rows,
zero on the others. The square is that of the central path: where the one-sided derivatives
differ, one weakly active row (z = s = 0) gets a value between them; several that depend on each
other get a finite one, which may lie outside. W is capped in the factorised matrix,
and a second pass removes the cap's bias; degenerate vertices stay regular. The derivative is zero
without status SOLVED. (In 32 bits the matrix of a minimiser that is almost not unique may have no
Cholesky factor; the derivative is then NaN.)
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jax.scipy.linalg import cho_solve

from hector_jax.core.arrays import Array
from hector_jax.qp.linear import cholesky, matvec, numpy_promotion, plus_gram, rmatvec
from hector_jax.qp.method import QpConfig, solve_normal
from hector_jax.qp.problem import QP, Normal, Solution, Status

SAVED = "qp"
"""Checkpoint name of solver results: a `jax.checkpoint` policy saves them for the reverse pass."""


class _Conditions(NamedTuple):
    """Terms of the optimality conditions at a fixed solution, as functions of the data."""

    slope: Array  # (n,) P x + q + A'y
    rows: Array  # (m,) A x
    l: Array  # (m,)  # noqa: E741
    u: Array  # (m,)


def differentiable_solve(
    config: QpConfig, qp: QP, slope: Callable[[Array], Array] | None = None
) -> Solution:
    """Solve a QP with symmetric P by `solve_normal`, with the derivative of this module."""
    found = solve_normal(config, jax.lax.stop_gradient(qp))
    solution, ratio = checkpoint_name(found[:2], SAVED)
    pull = qp.P @ solution.x + qp.q if slope is None else slope(solution.x)
    pull = pull + rmatvec(qp.A, solution.y)
    conditions = _Conditions(pull, matvec(qp.A, solution.x), qp.l, qp.u)
    return _follow(config, (solution, ratio, found[2]), conditions)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _follow(
    config: QpConfig, found: tuple[Solution, Array, Normal], conditions: _Conditions
) -> Solution:
    """Return the solution, with the derivative that keeps the conditions fulfilled."""
    return found[0]


def _second(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError("solve_qp has a first derivative only, a second one was asked for")


# W by itself, which the derivative takes from fixed data: it raises where the conditions move it.
# A rule of `jax.custom_jvp` would be lost in the reverse pass of a loop.
_once = Primitive("differentiated_once")
_once.def_impl(lambda weight, *_: weight)
_once.def_abstract_eval(lambda weight, *_: weight)
mlir.register_lowering(_once, lambda context, weight, *_: [weight])
batching.primitive_batchers[_once] = lambda parts, axes: (_once.bind(*parts), axes[0])
ad.primitive_jvps[_once] = _second


@_follow.defjvp
@numpy_promotion()
def _jvp(config: QpConfig, primals: tuple, tangents: tuple) -> tuple[Solution, Solution]:
    ((solution, ratio, normal), at), d = primals, tangents[1]
    dtype = solution.x.dtype
    tolerances = config.tolerances(dtype)
    column, row = normal.column, normal.row
    weight = jnp.sum(ratio, axis=0)  # XLA repeats ratio[0] + ratio[1] in each use, a reduction not
    weight = _once.bind(weight, at.slope, at.rows, at.l, at.u)
    capped = weight >= tolerances.cap
    solved = solution.status == Status.SOLVED
    shift = weight * d.rows - ratio[0] * d.u - ratio[1] * d.l
    pull, shift = jnp.where(solved, column * d.slope, 0.0), jnp.where(solved, row * shift, 0.0)
    factor = cholesky(plus_gram(normal.P, normal.A, weight, tolerances.proximal))

    def step(pull: Array, force: Array) -> tuple[Array, Array]:
        dv = -cho_solve((factor, True), pull + rmatvec(normal.A, force))
        dv = jnp.where(solved, dv, 0.0)  # without a solution the factor can be NaN
        return dv, force + weight * matvec(normal.A, dv)

    dv, dz = step(pull, shift)
    # as in `active_set`, a second pass removes the bias of cap and rho
    force = jnp.where(capped, dz, 0.0) + weight * matvec(normal.A, dv) + shift
    more, dz = step(normal.P @ dv + pull, force)
    dv = dv + more
    zero = jnp.zeros((), dtype)
    none = np.zeros((), jax.dtypes.float0)
    return solution, Solution(column * dv, row * dz, zero, zero, zero, none, none)
