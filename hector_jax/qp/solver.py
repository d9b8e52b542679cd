"""The public functions: `solve_qp`, and `check_solved` for its solutions."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from hector_jax.core.arrays import Array
from hector_jax.qp.derivative import differentiable_solve
from hector_jax.qp.linear import numpy_promotion
from hector_jax.qp.method import QpConfig
from hector_jax.qp.problem import QP, Solution, Status


@numpy_promotion()
def solve_qp(
    qp: QP,
    config: QpConfig = QpConfig(),  # noqa: B008
    slope: Callable[[Array], Array] | None = None,
) -> Solution:
    """Solve a QP; differentiable once, in both modes, for jit and vmap, in the dtype of the data.

    Never raises on values and never returns a NaN: `status` qualifies the solution (`check_solved`
    checks it). Whole numbers become floats of JAX's default dtype.

    Args:
        qp: the data.
        config: the method.
        slope: x (n,) -> P x + q, with the data's derivative. Where P is costly to differentiate, a
            product with it that forms no matrix makes the derivative cheap; by default P @ x + q.

    Raises:
        ValueError: the shapes do not match.
        NotImplementedError: a second derivative is asked for.

    The point of the line x + y = 1 that is nearest to the origin, with x at most 0.2:

    >>> A = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    >>> low, high = jnp.array([1.0, 0.0]), jnp.array([1.0, 0.2])
    >>> solution = solve_qp(QP(jnp.eye(2), jnp.zeros(2), A, low, high))
    >>> solution.x.round(9).tolist(), Status(int(solution.status)).name
    ([0.2, 0.8], 'SOLVED')
    """
    _check_shapes(qp)
    dtype = jnp.result_type(jnp.result_type(*qp, float), jnp.float32)
    P, q, A, lower, upper = (jnp.asarray(v, dtype) for v in qp)
    # only the symmetric part of P matters; taking it here makes the derivative consistent
    return differentiable_solve(config, QP(0.5 * (P + P.T), q, A, lower, upper), slope)


def check_solved(solution: Solution) -> None:
    """Check a solution, or a batch of solutions, outside jit.

    Raises:
        ValueError: names the first solution that is not SOLVED, its status, residuals and remedy.
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
    code = Status(status[first])
    raise ValueError(f"QP: {count}{code.name} ({residuals}). {code.meaning}")


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
