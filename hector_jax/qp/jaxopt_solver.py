"""BoxOSQP of jaxopt, as a second method to approach a solution; its derivative is not used."""

import jax
import jax.numpy as jnp

from hector_jax.core.arrays import Array
from hector_jax.qp.certificates import certificates
from hector_jax.qp.linear import block_diagonal
from hector_jax.qp.problem import SIGN, Approach, Normal, Point, Tolerances


def box_osqp(
    tolerances: Tolerances, qp: Normal, enabled: Array, *, max_iterations: int
) -> Approach:
    """Run BoxOSQP with a hundred times `max_iterations`, because its iterations are cheaper.

    It runs for every problem, even if `enabled` is false.
    """
    from jaxopt import BoxOSQP

    present = qp.side | qp.equality
    bound = jnp.where(present, qp.bound, jnp.asarray(SIGN, qp.q.dtype) * jnp.inf)
    solver = BoxOSQP(
        eq_qp_solve="lu",
        tol=max(1e-5, tolerances.target),
        maxiter=100 * max_iterations,
        termination_check_frequency=25,
        implicit_diff=False,
    )
    A = qp.A if qp.A.ndim == 2 else block_diagonal(qp.A)
    params, state = solver.run(None, (qp.P, qp.q), A, (bound[1], bound[0]))
    finite = jnp.isfinite(jnp.sum(params.primal[0]) + jnp.sum(params.dual_eq))
    x = jnp.where(finite, params.primal[0], 0.0)
    y = jnp.where(finite, params.dual_eq, 0.0)
    z = jnp.maximum(SIGN * y, 0.0)
    z = jnp.where(qp.equality, jnp.stack([y, jnp.zeros_like(y)]), jnp.where(present, z, 0.0))
    point = Point(x, z)
    certified = certificates(tolerances, qp, jax.tree.map(jnp.zeros_like, point), point)
    slack = jnp.maximum(-qp.violation(x), 0.0)
    residuals = qp.inner_residuals(point)
    return Approach(point, slack, residuals, certified, state.iter_num.astype(jnp.int32))
