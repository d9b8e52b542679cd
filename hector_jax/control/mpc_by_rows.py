"""The MPC's derivative by the rows of its wrench, quick where many tangents are asked for at once.

The wrenches of the feet that have inputs have fewer numbers than a tuning has weights. So the MPC
is differentiated in reverse, once for each of these numbers, and the rows multiply all tangents.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from hector_jax.control.mpc import MpcConfig, MpcProblem, feet_of_contacts, solve_mpc
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Wrench
from hector_jax.qp import Solution

solve_mpc_by_rows = jax.custom_jvp(solve_mpc, nondiff_argnums=(0, 2, 3))
"""`solve_mpc`, in its place in `controller.plan`: the same numbers, and the same derivative of the
wrench in both modes, in reverse slower. The rest of the solution has no derivative."""


@partial(jax.jit, static_argnums=(0, 2, 3))  # a program that differentiates it often traces it once
def _rows_of_wrench(
    config: MpcConfig, problem: MpcProblem, dt: float, max_contacts: int
) -> tuple[tuple[Wrench, Solution], Array, MpcProblem]:
    """Return `solve_mpc`, the feet of its contacts, and the derivative of their wrenches."""
    solve = partial(solve_mpc, config, dt=dt, max_contacts=max_contacts)
    wrench, pull_back, solution = jax.vjp(solve, problem, has_aux=True)
    horizon = problem.horizon
    inputs = horizon.contact if horizon.inputs is None else horizon.inputs
    feet = feet_of_contacts(inputs[0].astype(wrench.force.dtype), max_contacts)
    each = jnp.einsum("cf,ij->cifj", feet, jnp.eye(6, dtype=feet.dtype))
    each = each.reshape(-1, *feet.shape[1:], 6)
    (rows,) = jax.vmap(pull_back)(Wrench(each[..., :3], each[..., 3:]))
    return (wrench, solution), feet, rows


@partial(solve_mpc_by_rows.defjvp, symbolic_zeros=True)
def _tangents(
    config: MpcConfig, dt: float, max_contacts: int, primals: tuple, tangents: tuple
) -> tuple:
    (problem,), (moved,) = primals, tangents
    found, feet, rows = _rows_of_wrench(config, problem, dt, max_contacts)
    changes = [
        jnp.tensordot(row, change, jnp.ndim(change))
        for row, change in zip(*map(jax.tree.leaves, (rows, moved)), strict=True)
        if not isinstance(change, SymbolicZero)
    ]
    wrench = feet.T @ sum(changes).reshape(-1, 6)
    still = jax.tree.map(zero_from_primal, found[1])
    return found, (Wrench(wrench[:, :3], wrench[:, 3:]), still)
