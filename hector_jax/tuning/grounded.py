"""Rollouts grounded on a measured walk: the model plus its residual at each tick of the walk.

With the weights of the walk such a rollout is the walk itself, so its errors are the measured
errors and its gradient is that along the walk (Eq. 9, 10). With weights nearby it differs from the
walk by what the model predicts: good for some steps, then another walk is needed.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from hector_jax import qp
from hector_jax.control import parameters
from hector_jax.control.controller import Plan, measured_feet
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import Measurement
from hector_jax.control.parameters import without_numbers
from hector_jax.control.reference import Anchor, anchor_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import Disturbance, State, Trajectory, Wrench, has_fallen
from hector_jax.robot.model import Robot
from hector_jax.tuning.called import CalledPlans
from hector_jax.tuning.rollout import Carry, RolloutConfig, Scenario, command_history, step_carry


class MeasuredState(NamedTuple):
    """Measurements at the start of a tick; also differences of such, the residual of the model."""

    state: State  # of the base
    feet: Feet  # positions of the feet; of those in the air only a frozen twin or a planner knows


def measured_states(robot: Robot, state: State, joints: Array) -> MeasuredState:
    """Compute the feet of measured states and joints; all with one leading axis."""
    measurement = Measurement(state, joints, jnp.zeros_like(joints))
    return MeasuredState(state, jax.vmap(partial(measured_feet, robot))(measurement))


def carry_from(
    measured: MeasuredState, anchor: Anchor, commands: Wrench, disturbance: Disturbance
) -> Carry:
    """Return the carry of a robot that has not fallen, from its measured state."""
    state, feet = measured
    return Carry(state, feet, commands, anchor, disturbance, fallen=jnp.asarray(False))


class Grounding(NamedTuple):
    """The model with start and residuals of rollouts grounded on a measured walk of T ticks.

    Commands are planned anew, with the errors that the estimate of state and feet had in the walk.
    """

    scenario: Scenario  # with the nominal body and the command and the anchor of the walk
    start: Carry  # at the end of the first tick
    tick: Int[Array, ""]  # gait tick at the start
    errors: MeasuredState  # (T - 1, ...) estimated less true values at the start of a tick
    # (T - 1, ...) measured less modelled values at the end of a tick, in the yaw frame at its start
    residuals: MeasuredState
    weights: Weights  # of the walk
    called: CalledPlans | None = None  # (T - 1, ...) of another controller; None: this project's


def begins_of_ticks(robot: Robot, walk: Trajectory) -> tuple[MeasuredState, MeasuredState]:
    """Return true and estimated states when a walk of T ticks planned for all but the first.

    Args:
        robot: the nominal body.
        walk: see `fit_grounding`.
    """
    assert walk.belief is not None  # zero in a log without it
    state, joints = jax.tree.map(lambda x: x[:-1], (walk.state, walk.joints))
    errors = jax.tree.map(lambda x: x[1:], walk.belief)
    true, estimate = (
        measured_states(robot, state, joints),
        jax.tree.map(jnp.add, state, errors.state),
    )
    return true, measured_states(robot, estimate, joints + errors.joints)


@partial(jax.jit, static_argnums=0)
def fit_grounding(
    config: RolloutConfig,
    scenario: Scenario,
    weights: Weights,
    walk: Trajectory,
    start_tick: Int[Array, ""] | int = 0,
    *,
    called: CalledPlans | None = None,
    anchor: Anchor | None = None,
) -> Grounding:
    """Compute the residuals of the model along a walk.

    Args:
        config: controller, and the T ticks of the walk.
        scenario: nominal body, phi and command; the walk gives the anchor.
        weights: of the walk.
        walk: true states, joints, commands and what the controller believed, sampled at the plan
            interval: T samples.
        start_tick: gait tick of t = 0.
        called: plans of another controller for all ticks but the first; None: this project's.
        anchor: where the command began, before t = 0; None: at t = 0, where the robot was.

    Raises:
        ValueError: the walk has another number of ticks, from `jax.lax.scan`.

    Source: Eq. 12, 13 at the measured states.
    """
    robot, belief = scenario.robot, walk.belief
    assert belief is not None  # zero in a log without it
    anchor = anchor_at(robot, walk.initial, start_tick) if anchor is None else anchor
    tick = jnp.asarray(start_tick) + 1
    begins, estimated = begins_of_ticks(robot, walk)
    errors = jax.tree.map(jnp.subtract, estimated, begins)
    first, command_before = jax.tree.map(lambda x: x[0], (begins, walk.command))
    ends = measured_states(robot, *jax.tree.map(lambda x: x[1:], (walk.state, walk.joints)))

    def step(memory: tuple[Wrench, Disturbance], inputs: tuple) -> tuple[tuple, MeasuredState]:
        (commands, disturbance), (begin, end, error, tick, row) = memory, inputs
        carry = carry_from(begin, anchor, commands, disturbance)
        planner = _planner(row, carry, weights, weights)
        after, _ = step_carry(
            config, scenario, without_numbers(weights), carry, tick, error=error, planner=planner
        )
        residual = jax.tree.map(jnp.subtract, end, MeasuredState(after.state, after.feet))
        return (after.commands, after.disturbance), _turned(residual, -begin.state.euler[2])

    disturbance = jax.tree.map(lambda x: x[0], belief.disturbance)
    commands, ticks = command_history(command_before), tick + jnp.arange(len(ends.feet.yaw))
    memory, rows = (commands, disturbance), (begins, ends, errors, ticks, called)
    _, residuals = jax.lax.scan(step, memory, rows)
    start = carry_from(first, anchor, commands, disturbance)
    scenario = scenario._replace(anchor=anchor)
    return Grounding(scenario, start, tick, errors, residuals, weights, called)


def _planner(
    called: CalledPlans | None, carry: Carry, start: Weights, weights: Weights
) -> Callable[..., Plan] | None:
    """Return what plans in a tick: another controller, called with `start`; None: this one."""
    if called is None:
        return None
    names = parameters.own_names(start)
    changes = [weights.others[name] - start.others[name] for name in names]
    steps = jnp.append(parameters.steps_between(start, weights), jnp.array(changes))
    last = jax.tree.map(lambda x: x[0], carry.commands)
    return partial(called.plan, steps=steps, last=last, disturbance=carry.disturbance)


def _turned(x: MeasuredState, yaw: Float[Array, ""]) -> MeasuredState:
    """Return differences of states and feet turned by a yaw [rad]; angles stay."""
    R, state = rot_z(yaw), x.state
    position, rates, velocity = (v @ R.T for v in (state[1], *state[2:]))
    feet = x.feet._replace(position=x.feet.position @ R.T)
    return MeasuredState(State(state.euler, position, rates, velocity), feet)


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
    scenario, start, tick, errors, residuals, walked, called = grounding

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(qp.SAVED))
    def step(carry: Carry, inputs: tuple) -> tuple[Carry, Trajectory]:
        error, residual, tick, row = inputs
        options = {"error": error, "planner": _planner(row, carry, walked, weights)}
        twin = without_numbers(weights)
        after, sample = step_carry(config, scenario, twin, carry, tick, **options)
        residual = _turned(residual, carry.state.euler[2])
        state, feet = jax.tree.map(jnp.add, MeasuredState(after.state, after.feet), residual)
        fallen = carry.fallen | has_fallen(state, *scenario.robot.description.limits)
        after = after._replace(state=state, feet=feet, fallen=fallen)
        return after, sample._replace(state=state, feet=feet.position, fallen=fallen)

    ticks = tick + jnp.arange(len(residuals.feet.yaw))
    _, samples = jax.lax.scan(step, start, (errors, residuals, ticks, called))
    return samples._replace(initial=start.state, period=jnp.asarray(config.walk.gait.tick))
