"""Minimise 1/2 x'Px + q'x subject to l <= A x <= u, and differentiate the minimiser.

`problem` has the data and its normalised form, `active_set`, `interior_point` and `jaxopt_solver`
the methods (`gpu_kernel` solves small ones on a GPU), `certificates` the proofs, `method` the
loop over the methods and the status, `derivative` the JVP rule and `solver` the public functions.
"""

from hector_jax.qp.derivative import SAVED
from hector_jax.qp.linear import block_diagonal
from hector_jax.qp.method import INTERIOR_POINT, JAXOPT, QpConfig, Solver
from hector_jax.qp.problem import QP, Solution, Status
from hector_jax.qp.solver import check_solved, solve_qp

# fmt: off
__all__ = [
    "INTERIOR_POINT", "JAXOPT", "QP", "SAVED", "QpConfig", "Solution", "Solver",
    "Status", "block_diagonal", "check_solved", "solve_qp",
]
