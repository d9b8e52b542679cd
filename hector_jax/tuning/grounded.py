"""Rollouts grounded on a measured walk: the model, and at each tick what it missed there.

With the weights that were walked such a rollout is the walk itself, so its errors are the measured
ones and its gradient is that along the walk (Eq. 9, 10). With weights nearby it is what the model
says that they change: good for some steps, and then for another walk.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Int

from hector_jax import qp
from hector_jax.control.controller import measured_feet
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Command, anchor_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, Wrench, has_fallen
from hector_jax.grfm.effect import HISTORY
from hector_jax.robot.model import Robot
from hector_jax.tuning.evaluate import Evaluation, evaluation
from hector_jax.tuning.loss import Loss
from hector_jax.tuning.rollout import Carry, RolloutConfig, step_carry


class Missed(NamedTuple):
    """What a model misses in a tick: measured less modelled, at its end."""

    state: State
    feet: Feet


class Grounding(NamedTuple):
    """What grounds rollouts on a measured walk of T ticks.

    Estimates play no part: commands are planned anew, from the true states of the walk.
    """

    start: Carry  # at the end of the first tick
    tick: Int[Array, ""]  # gait tick there
    missed: Missed  # (T - 1, ...)


@partial(jax.jit, static_argnums=0)
def fit_grounding(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    walk: Trajectory,
    start_tick: Int[Array, ""] | int = 0,
) -> Grounding:
    """Find what the model missed of a walk.

    Args:
        config: controller, and the T ticks of the walk.
        robot: nominal body.
        weights, command: that were walked.
        effect: phi.
        walk: true states, joints and commands, sampled at the plan interval: T samples.
        start_tick: gait tick of t = 0.

    Raises:
        ValueError: the walk has another number of ticks.

    Source: Eq. 12, 13 at the measured states.
    """
    ticks = config.ticks
    if len(walk.fallen) != ticks:
        raise ValueError(f"a walk of {ticks} ticks has {len(walk.fallen)} samples")

    def feet_of(state: State, joints: Array) -> Feet:
        return measured_feet(robot, Measurement(state, joints, jnp.zeros_like(joints)))

    measured = Missed(walk.state, jax.vmap(feet_of)(walk.state, walk.joints))
    held = jax.tree.map(lambda w: jnp.broadcast_to(w[0], (HISTORY, *w.shape[1:])), walk.command)
    anchor, tick = anchor_at(robot, walk.initial, start_tick), jnp.asarray(start_tick) + 1

    def at(now: Missed, commands: Wrench, disturbance: Disturbance) -> Carry:
        return Carry(now.state, now.feet, commands, anchor, disturbance, jnp.asarray(False))

    def one(carried: tuple[Wrench, Disturbance], inputs: tuple) -> tuple[Any, Missed]:
        now, then, tick = inputs
        after, _ = step_carry(config, robot, weights, command, effect, at(now, *carried), tick)
        missed = jax.tree.map(jnp.subtract, then, Missed(after.state, after.feet))
        return (after.commands, after.disturbance), missed

    now, then = jax.tree.map(lambda x: x[:-1], measured), jax.tree.map(lambda x: x[1:], measured)
    first = jax.tree.map(lambda x: x[0], measured)
    carried = held, NO_DISTURBANCE
    _, missed = jax.lax.scan(one, carried, (now, then, tick + jnp.arange(ticks - 1)))
    return Grounding(at(first, *carried), tick, missed)


def grounded_rollout(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    grounding: Grounding,
) -> Trajectory:
    """Walk on the model from the end of a walk's first tick, adding what it missed of the walk.

    Args:
        config, robot, command, effect: those of the grounding.
        weights: any; the gradient is taken with respect to these.
        grounding: see `fit_grounding`.

    Returns:
        Trajectory of T - 1 samples. Nothing raises: read `fallen` and `residual`.

    Source: Eq. 12, 13 and the measured remainder.
    """

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(qp.SAVED))
    def one(carry: Carry, inputs: tuple) -> tuple[Carry, Trajectory]:
        missed, tick = inputs
        after, sample = step_carry(config, robot, weights, command, effect, carry, tick)
        state, feet = jax.tree.map(jnp.add, Missed(after.state, after.feet), missed)
        fallen = carry.fallen | has_fallen(state, *robot.description.limits)
        after = after._replace(state=state, feet=feet, fallen=fallen)
        return after, sample._replace(state=state, feet=feet.position, fallen=fallen)

    ticks = grounding.tick + jnp.arange(len(grounding.missed.feet.yaw))
    _, samples = jax.lax.scan(one, grounding.start, (grounding.missed, ticks))
    initial = grounding.start.state
    return samples._replace(initial=initial, period=jnp.asarray(config.walk.gait.tick))


@partial(jax.jit, static_argnums=0)
def evaluate_grounded(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    grounding: Grounding,
    loss: Loss,
) -> Evaluation:
    """Loss of a grounded rollout and its gradient by the weights, as `evaluate` of a plain one.

    Args:
        config, robot, weights, command, effect, grounding: see `grounded_rollout`.
        loss: terms and their weights; the changes of the command are those after the first tick.

    Source: Eq. 9, 11.
    """
    return evaluation(
        lambda w: grounded_rollout(config, robot, w, command, effect, grounding), weights, loss
    )
