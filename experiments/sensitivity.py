"""The paper's method for the gradient: sensitivities carried forward (Eq. 9, 10).

The recursion needs no memory in T and no reverse mode; the columns of the sensitivity are tangents
of one tick, so that each QP is solved and factorised once. With a network in the loop the past
commands are part of the state. Reverse mode gives the same numbers faster (`evaluate.evaluate`);
the recursion checks it and gives the gradient along measured walks.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from hector_jax.control.parameters import step_names, stepped
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.tuning.loss import Loss, losses, residuals, total
from hector_jax.tuning.rollout import (
    Carry,
    RolloutConfig,
    Scenario,
    init_carry,
    step_carry,
    varied,
    walked_ticks,
    with_constants,
    with_variation,
    without_lead,
)


class Sensitivities(NamedTuple):
    """Derivatives of a rollout by the n numbers of theta; these are the first axis."""

    state: State  # (n, T, 3) each: dx_j+1 / dtheta
    command: Wrench  # (n, T, feet, 3) each: du_j / dtheta


def propagate(
    config: RolloutConfig, scenario: Scenario, weights: Weights
) -> tuple[Trajectory, Sensitivities]:
    """Compute a rollout and its sensitivities by forward recursion. Source: Eq. 10."""
    scenario = with_variation(config, scenario)
    theta, to_weights = ravel_pytree(weights)

    def tick(carried: tuple[Carry, Carry], j: Int[Array, ""]):
        """Walk one tick of the closed loop with the n tangents of the `varied` carry."""
        carry, tangents = carried

        def step(parts: Carry, theta: Float[jax.Array, " n"]) -> tuple:
            before = with_constants(parts, carry)
            after, sample = step_carry(config, scenario, to_weights(theta), before, j)
            return (varied(after), sample.state, sample.command), (after, sample)

        def tangent_of(tangent: Carry, direction: Float[Array, " n"]) -> tuple:
            point = varied(carry), jnp.asarray(theta)
            return jax.jvp(step, point, (tangent, direction), has_aux=True)

        along = jax.vmap(tangent_of, out_axes=(None, 0, None))
        _, (tangents, state, wrench), (after, sample) = along(tangents, jnp.eye(theta.size))
        return (after, tangents), (sample, Sensitivities(state, wrench))

    carry, ticks = init_carry(scenario), walked_ticks(config, scenario.anchor)
    zero = lambda x: jnp.zeros((theta.size, *x.shape), x.dtype)  # noqa: E731, dx_0 / dtheta
    _, (samples, columns) = jax.lax.scan(tick, (carry, jax.tree.map(zero, varied(carry))), ticks)
    columns = jax.tree.map(lambda s: jnp.swapaxes(s[config.lead :], 0, 1), columns)
    return without_lead(config, samples), columns


def gradient(
    loss: Loss, trajectory: Trajectory, sensitivities: Sensitivities, weights: Weights
) -> tuple[Float[Array, ""], Weights]:
    """Compute the loss and its gradient by `weights` from the sensitivities. Source: Eq. 9."""

    def objective(state: State, command: Wrench) -> Float[Array, ""]:
        return total(loss, losses(loss, trajectory._replace(state=state, command=command)))

    value_and_grad = jax.value_and_grad(objective, argnums=(0, 1))
    value, slopes = value_and_grad(trajectory.state, trajectory.command)
    products = jax.tree.map(
        lambda g, s: jnp.tensordot(s, g, axes=g.ndim), slopes, tuple(sensitivities)
    )
    return value, ravel_pytree(weights)[1](jnp.asarray(sum(jax.tree.leaves(products))))


def matrix(
    loss: Loss,
    trajectory: Trajectory,
    sensitivities: Sensitivities,
    weights: Weights,
    others: tuple[str, ...] = (),
) -> Float[jax.Array, "m m"]:
    """Compute the Gauss-Newton matrix in the steps of `parameters.stepped` from `weights`."""

    def moved(steps: Float[jax.Array, " m"]) -> Float[jax.Array, " n"]:
        return ravel_pytree(stepped(weights, steps, others))[0]

    def rows(state: State, command: Wrench) -> Float[jax.Array, " rows"]:
        return jnp.asarray(residuals(loss, trajectory._replace(state=state, command=command)))

    by_steps = jax.jacobian(moved)(jnp.zeros(len(step_names(weights, others))))
    at = trajectory.state, trajectory.command
    along = jax.vmap(lambda *tangent: jax.jvp(rows, at, tangent)[1])
    J = along(sensitivities.state, sensitivities.command).T @ by_steps
    return jnp.asarray(2.0 * J.T @ J)
