"""Minimise 1/2 x'Px + q'x subject to l <= A x <= u, and differentiate the minimiser.

`problem` has the data and the one form that all of it is brought to, `active_set`,
`interior_point` and `jaxopt_solver` the ways to a solution (`gpu_kernel` guesses on a GPU),
`certificates` what is proved on the way, `method` the loop over both and the verdict, `derivative`
the rule of both modes and `solver` the door.
"""

from hector_jax.qp.derivative import SAVED
from hector_jax.qp.linear import block_diagonal
from hector_jax.qp.method import INTERIOR_POINT, JAXOPT, SOLVERS, QpConfig, Solver
from hector_jax.qp.problem import QP, Solution, Status
from hector_jax.qp.solver import check_solved, solve_qp

# fmt: off
__all__ = [
    "INTERIOR_POINT", "JAXOPT", "QP", "SAVED", "SOLVERS", "QpConfig", "Solution", "Solver",
    "Status", "block_diagonal", "check_solved", "solve_qp",
]
