"""The paper's own way to the gradient: sensitivities carried forward (Eq. 9, 10).

The recursion needs no memory in T and no reverse mode; the 24 columns of the sensitivity are 24
tangents of one tick, so that each QP is solved and factorised once. With a network in the loop the
past commands are part of what is carried. Reverse mode gives the same numbers faster
(`difftune.evaluate`); this is the check on it, and what online tuning steps along.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights, vector_to_weights, weights_to_vector
from hector_jax.robot import Robot
from hector_jax.trajectory import State, Trajectory, Wrench
from hector_jax.tuning.loss import LossConfig, losses, total
from hector_jax.tuning.rollout import (
    Carry,
    RolloutConfig,
    from_start,
    init_carry,
    step_carry,
    walked_ticks,
)


class Sensitivities(NamedTuple):
    """Derivatives of a rollout by the 24 weights, which are the first axis."""

    state: State  # (24, T, 3) each: dx_j+1 / dtheta
    command: Wrench  # (24, T, 2, 3) each: du_j / dtheta


def propagate(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> tuple[Trajectory, Sensitivities]:
    """Rollout and its sensitivities by forward recursion. Source: Eq. 10."""
    theta = weights_to_vector(weights)
    directions = jnp.eye(theta.size)

    def split(carry: Carry) -> tuple:
        place = carry.anchor.position, carry.anchor.yaw
        return carry.state, carry.feet, carry.commands, place

    def tick(carried, j):
        carry, tangents = carried

        def move(parts: tuple, theta: Float[Array, "24"]) -> tuple:
            state, feet, commands, (position, yaw) = parts
            place = Anchor(position, yaw, anchor.tick)
            now = Carry(state, feet, commands, place, carry.fallen)
            weights = vector_to_weights(theta)
            then, sample = step_carry(config, robot, weights, command, effect, now, j)
            return (split(then), sample.state, sample.command), (then, sample)

        def along(tangent: tuple, direction: Float[Array, "24"]):
            return jax.jvp(move, (split(carry), theta), (tangent, direction), has_aux=True)

        _, (tangents, state, wrench), (then, sample) = jax.vmap(along, out_axes=(None, 0, None))(
            tangents, directions
        )
        return (then, tangents), (sample, Sensitivities(state, wrench))

    carry = init_carry(robot, anchor)
    still = jax.tree.map(
        lambda x: jnp.zeros((theta.size, *x.shape), x.dtype), split(carry)
    )  # dx_0 / dtheta = 0
    ticks = walked_ticks(config, anchor)
    _, (samples, sensitivities) = jax.lax.scan(tick, (carry, still), ticks)
    later = jax.tree.map(lambda s: jnp.swapaxes(s[config.lead :], 0, 1), sensitivities)
    return from_start(config, samples), later


def gradient(
    loss: LossConfig, trajectory: Trajectory, sensitivities: Sensitivities
) -> tuple[Float[Array, ""], Weights]:
    """Loss and its gradient from the sensitivities. Source: Eq. 9."""

    def objective(state: State, command: Wrench) -> Float[Array, ""]:
        return total(loss, losses(trajectory._replace(state=state, command=command)))

    value, pull = jax.value_and_grad(objective, argnums=(0, 1))(
        trajectory.state, trajectory.command
    )
    terms = jax.tree.map(lambda g, s: jnp.tensordot(s, g, axes=g.ndim), pull, tuple(sensitivities))
    return value, vector_to_weights(sum(jax.tree.leaves(terms)))
