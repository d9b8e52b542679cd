"""The peers, each as a function of a QP; those that are not installed are left out.

Compiled solvers get ready dense QPs from Python, one by one. JAX solvers stand where ours stands in
the layer; they get Jacobi columns and unit rows, without which their answers are of no use here.
"""

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from hector_jax.qp import QP

Compiled = Callable[[QP], np.ndarray]
Traced = Callable[[QP], tuple[jax.Array, jax.Array]]

LARGE = 1e30  # what stands for an infinite bound where one is wanted


def _daqp() -> Compiled:
    import daqp

    return lambda qp: daqp.solve(
        qp.P, qp.q, qp.A, np.minimum(qp.u, LARGE), np.maximum(qp.l, -LARGE)
    )[0]


def _quadprog() -> Compiled:
    import quadprog

    def solve(qp: QP) -> np.ndarray:
        upper, lower = np.isfinite(qp.u), np.isfinite(qp.l)
        rows = np.concatenate([-qp.A[upper], qp.A[lower]])
        return quadprog.solve_qp(qp.P, -qp.q, rows.T, np.concatenate([-qp.u[upper], qp.l[lower]]))[
            0
        ]

    return solve


def _to_1e8(new: Callable[[QP], Any], load: str, result: str) -> Compiled:
    """A solver of two-sided rows: how it is made, and what it calls taking data and its result."""

    def solve(qp: QP) -> np.ndarray:
        problem = new(qp)
        problem.settings.eps_abs = 1e-8
        getattr(problem, load)(qp.P, qp.q, None, None, qp.A, qp.l, qp.u)
        problem.solve()
        return getattr(problem, result).x

    return solve


def _proxqp() -> Compiled:
    from proxsuite import proxqp

    def new(qp: QP) -> Any:
        problem = proxqp.dense.QP(len(qp.q), 0, len(qp.u))
        problem.settings.initial_guess = proxqp.NO_INITIAL_GUESS
        return problem

    return _to_1e8(new, "init", "results")


def _piqp() -> Compiled:
    import piqp

    return _to_1e8(lambda qp: piqp.DenseSolver(), "setup", "result")


def _osqp() -> Compiled:
    import osqp

    def solve(qp: QP) -> np.ndarray:
        problem = osqp.OSQP()
        problem.setup(
            scipy.sparse.csc_matrix(np.triu(qp.P)),
            qp.q,
            scipy.sparse.csc_matrix(qp.A),
            qp.l,
            qp.u,
            eps_abs=1e-6,
            eps_rel=1e-6,
            max_iter=20000,
            verbose=False,
        )
        return problem.solve().x

    return solve


def _installed(
    doors: Mapping[str, tuple[str, Callable]], *given: np.ndarray
) -> tuple[dict[str, Any], list[str]]:
    """Solvers by their names, and the packages that are not here."""
    here = {name: make(*given) for package, (name, make) in doors.items() if find_spec(package)}
    return here, [package for package in doors if not find_spec(package)]


def compiled_peers() -> tuple[dict[str, Compiled], list[str]]:
    """Compiled solvers that are here, DAQP first, and the packages that are not."""
    doors = {
        "daqp": ("DAQP", _daqp),
        "quadprog": ("quadprog", _quadprog),
        "proxsuite": ("ProxQP 1e-8", _proxqp),
        "piqp": ("PIQP 1e-8", _piqp),
        "osqp": ("OSQP 1e-6", _osqp),
    }
    return _installed(doors)


def _scaled(qp: QP) -> tuple[QP, jax.Array]:
    """The QP with dense rows in scaled variables, x = column * v."""
    N, r, b = qp.A.shape
    A = jnp.einsum("krb,kl->krlb", qp.A, jnp.eye(N, dtype=qp.A.dtype)).reshape(N * r, N * b)
    # the minimiser does not depend on the scales, so they need no derivative (infinite bounds
    # would make it NaN)
    column = jax.lax.stop_gradient(jax.lax.rsqrt(jnp.diagonal(qp.P)))
    A = A * column
    row = jax.lax.stop_gradient(jax.lax.rsqrt(jnp.sum(A**2, axis=1)))
    P = column[:, None] * qp.P * column
    return QP(P, column * qp.q, row[:, None] * A, row * qp.l, row * qp.u), column


def _qpax(upper: np.ndarray, lower: np.ndarray) -> Traced:
    import qpax

    def solve(qp: QP) -> tuple[jax.Array, jax.Array]:
        scaled, column = _scaled(qp)
        rows = jnp.concatenate([scaled.A[upper], -scaled.A[lower]])
        bounds = jnp.concatenate([scaled.u[upper], -scaled.l[lower]])
        none = jnp.zeros((0, len(qp.q)), qp.q.dtype)
        x = column * qpax.solve_qp_primal(
            scaled.P, scaled.q, none, none[:, 0], rows, bounds, solver_tol=1e-8, target_kappa=1e-5
        )
        return x, jnp.all(jnp.isfinite(x))

    return solve


def _jaxopt(*_: np.ndarray) -> Traced:
    from jaxopt import BoxOSQP

    solver = BoxOSQP(eq_qp_solve="lu", tol=1e-5, maxiter=4000)

    def solve(qp: QP) -> tuple[jax.Array, jax.Array]:
        scaled, column = _scaled(qp)
        params, state = solver.run(None, (scaled.P, scaled.q), scaled.A, (scaled.l, scaled.u))
        return column * params.primal[0], state.error <= 1e-5

    return solve


def traced_peers(upper: np.ndarray, lower: np.ndarray) -> tuple[dict[str, Traced], list[str]]:
    """JAX solvers that are here (x, and whether it says solved), and the packages that are not.

    Args:
        upper, lower: numbers of the rows with a finite bound, the same in all problems.
    """
    doors = {"qpax": ("qpax e, kappa 1e-5", _qpax), "jaxopt": ("jaxopt BoxOSQP 1e-5", _jaxopt)}
    return _installed(doors, upper, lower)
