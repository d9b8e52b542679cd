"""Rollouts grounded on a measured walk: the model plus its residual at each tick of the walk.

With the weights of the walk such a rollout is the walk itself, so its errors are the measured
errors and its gradient is that along the walk (Eq. 9, 10). With weights nearby it differs from the
walk by what the model predicts: good for some steps, then another walk is needed.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Int

from hector_jax import qp
from hector_jax.control.controller import measured_feet
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, anchor_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, Wrench, has_fallen
from hector_jax.robot.model import Robot
from hector_jax.tuning.rollout import (
    Carry,
    RolloutConfig,
    Scenario,
    command_history,
    step_carry,
)


class MeasuredState(NamedTuple):
    """Measurements at the start of a tick; also differences of such, the residual of the model."""

    state: State  # of the base
    feet: Feet  # positions of the feet; those in the air are not used


def measured_states(robot: Robot, state: State, joints: Array) -> MeasuredState:
    """Compute the feet of measured states and joints; all with one leading axis."""
    measurement = Measurement(state, joints, jnp.zeros_like(joints))
    return MeasuredState(state, jax.vmap(partial(measured_feet, robot))(measurement))


def carry_from(
    measured: MeasuredState, anchor: Anchor, commands: Wrench, disturbance: Disturbance
) -> Carry:
    """Return the carry of a robot that has not fallen, from its measured state."""
    return Carry(*measured, commands, anchor, disturbance, fallen=jnp.asarray(False))


class Grounding(NamedTuple):
    """The model with start and residuals of rollouts grounded on a measured walk of T ticks.

    Estimates are not used: commands are planned anew, from the true states of the walk.
    """

    scenario: Scenario  # with the nominal body and the command and the anchor of the walk
    start: Carry  # at the end of the first tick
    tick: Int[Array, ""]  # gait tick at the start
    residuals: MeasuredState  # (T - 1, ...) measured less modelled values at the end of a tick


@partial(jax.jit, static_argnums=0)
def fit_grounding(
    config: RolloutConfig,
    scenario: Scenario,
    weights: Weights,
    walk: Trajectory,
    start_tick: Int[Array, ""] | int = 0,
) -> Grounding:
    """Compute the residuals of the model along a walk.

    Args:
        config: controller, and the T ticks of the walk.
        scenario: nominal body, phi and command; the walk gives the anchor.
        weights: of the walk.
        walk: true states, joints and commands, sampled at the plan interval: T samples.
        start_tick: gait tick of t = 0.

    Raises:
        ValueError: the walk has another number of ticks, from `jax.lax.scan`.

    Source: Eq. 12, 13 at the measured states.
    """
    robot = scenario.robot
    measured = measured_states(robot, walk.state, walk.joints)
    first, command_before = jax.tree.map(lambda x: x[0], (measured, walk.command))
    anchor, tick = anchor_at(robot, walk.initial, start_tick), jnp.asarray(start_tick) + 1

    def step(memory: tuple[Wrench, Disturbance], inputs: tuple) -> tuple[tuple, MeasuredState]:
        begin, end, tick = inputs
        carry = carry_from(begin, anchor, *memory)
        after, _ = step_carry(config, scenario, weights, carry, tick)
        residual = jax.tree.map(jnp.subtract, end, MeasuredState(after.state, after.feet))
        return (after.commands, after.disturbance), residual

    begins, ends = jax.tree.map(lambda x: x[:-1], measured), jax.tree.map(lambda x: x[1:], measured)
    memory = command_history(command_before), NO_DISTURBANCE
    _, residuals = jax.lax.scan(step, memory, (begins, ends, tick + jnp.arange(config.ticks - 1)))
    start = carry_from(first, anchor, *memory)
    return Grounding(scenario._replace(anchor=anchor), start, tick, residuals)


def grounded_rollout(config: RolloutConfig, grounding: Grounding, weights: Weights) -> Trajectory:
    """Walk on the model from the end of a walk's first tick, adding its residuals.

    Args:
        config: that of the grounding.
        grounding: see `fit_grounding`.
        weights: theta; the gradient is taken with respect to these.

    Returns:
        Trajectory of T - 1 samples. Nothing raises: check `fallen` and `residual`.

    Source: Eq. 12, 13 and the measured residuals.
    """
    scenario, start, tick, residuals = grounding

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(qp.SAVED))
    def step(carry: Carry, inputs: tuple) -> tuple[Carry, Trajectory]:
        residual, tick = inputs
        after, sample = step_carry(config, scenario, weights, carry, tick)
        state, feet = jax.tree.map(jnp.add, MeasuredState(after.state, after.feet), residual)
        fallen = carry.fallen | has_fallen(state, *scenario.robot.description.limits)
        after = after._replace(state=state, feet=feet, fallen=fallen)
        return after, sample._replace(state=state, feet=feet.position, fallen=fallen)

    ticks = tick + jnp.arange(len(residuals.feet.yaw))
    _, samples = jax.lax.scan(step, start, (residuals, ticks))
    return samples._replace(initial=start.state, period=jnp.asarray(config.walk.gait.tick))
