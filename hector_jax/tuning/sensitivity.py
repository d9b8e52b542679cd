"""The paper's own way to the gradient: sensitivities carried forward (Eq. 9, 10).

The recursion needs no memory in T and no reverse mode; the columns of the sensitivity are tangents
of one tick, so that each QP is solved and factorised once. With a network in the loop the past
commands are part of what is carried. Reverse mode gives the same numbers faster
(`evaluate.evaluate`); this is the check on it, and what online tuning steps along.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from hector_jax.control.disturbance import Disturbance
from hector_jax.control.footstep import Feet
from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.robot.model import Robot
from hector_jax.tuning.loss import Loss, losses, total
from hector_jax.tuning.rollout import (
    Carry,
    RolloutConfig,
    from_start,
    init_carry,
    step_carry,
    walked_ticks,
)


class Sensitivities(NamedTuple):
    """Derivatives of a rollout by the n numbers of theta, which are the first axis."""

    state: State  # (n, T, 3) each: dx_j+1 / dtheta
    command: Wrench  # (n, T, feet, 3) each: du_j / dtheta


class Varied(NamedTuple):
    """What of a `Carry` the weights have a part in; of this shape are its tangents too."""

    state: State
    feet: Feet
    commands: Wrench
    disturbance: Disturbance
    position: Float[Array, "*batch 3"]  # of the anchor
    yaw: Float[Array, "*batch"]


def varied(carry: Carry) -> Varied:
    """The part of a carry that the weights have a part in."""
    state, feet, commands, anchor, disturbance, *_ = carry
    return Varied(state, feet, commands, disturbance, anchor.position, anchor.yaw)


def no_tangents(carry: Carry, weights: Weights) -> Varied:
    """Tangents of a start in which no weight has a part: dx_0 / dtheta = 0."""
    count = ravel_pytree(weights)[0].size
    return jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), varied(carry))


def step_sensitivities(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    carry: Carry,
    tangents: Varied,
    tick: Int[Array, ""],
) -> tuple[Carry, Varied, Trajectory, Sensitivities]:
    """One tick of the closed loop with its tangents, all n at once.

    Args:
        config, robot, weights, command, effect, carry, tick: as for `step_carry`.
        tangents: of the carry, the weights being their first axis.

    Returns:
        The next carry and its tangents, the tick's sample, and the sample's sensitivities (n, 3).

    Source: Eq. 10.
    """
    theta, as_weights = ravel_pytree(weights)

    def move(parts: Varied, theta: Float[jax.Array, " n"]) -> tuple:
        place = Anchor(parts.position, parts.yaw, carry.anchor.tick)
        state, feet, commands, disturbance, *_ = parts
        now = Carry(state, feet, commands, place, disturbance, carry.fallen)
        then, sample = step_carry(config, robot, as_weights(theta), command, effect, now, tick)
        return (varied(then), sample.state, sample.command), (then, sample)

    def along(tangent: Varied, direction: Float[Array, " n"]) -> tuple:
        at = varied(carry), jnp.asarray(theta)
        return jax.jvp(move, at, (tangent, direction), has_aux=True)

    _, (later, state, wrench), (then, sample) = jax.vmap(along, out_axes=(None, 0, None))(
        tangents, jnp.eye(theta.size)
    )
    return then, later, sample, Sensitivities(state, wrench)


def propagate(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> tuple[Trajectory, Sensitivities]:
    """Rollout and its sensitivities by forward recursion. Source: Eq. 10."""

    def tick(carried: tuple[Carry, Varied], j: Int[Array, ""]):
        carry, tangents, sample, columns = step_sensitivities(
            config, robot, weights, command, effect, *carried, j
        )
        return (carry, tangents), (sample, columns)

    carry = init_carry(robot, anchor)
    ticks = walked_ticks(config, anchor)
    _, (samples, sensitivities) = jax.lax.scan(tick, (carry, no_tangents(carry, weights)), ticks)
    later = jax.tree.map(lambda s: jnp.swapaxes(s[config.lead :], 0, 1), sensitivities)
    return from_start(config, samples), later


def gradient(
    loss: Loss, trajectory: Trajectory, sensitivities: Sensitivities, weights: Weights
) -> tuple[Float[Array, ""], Weights]:
    """Loss and its gradient from the sensitivities by `weights`. Source: Eq. 9."""

    def objective(state: State, command: Wrench) -> Float[Array, ""]:
        walk = trajectory._replace(state=state, command=command)
        return total(loss, losses(loss, walk))

    value, pull = jax.value_and_grad(objective, argnums=(0, 1))(
        trajectory.state, trajectory.command
    )
    terms = jax.tree.map(lambda g, s: jnp.tensordot(s, g, axes=g.ndim), pull, tuple(sensitivities))
    return value, ravel_pytree(weights)[1](jnp.asarray(sum(jax.tree.leaves(terms))))
