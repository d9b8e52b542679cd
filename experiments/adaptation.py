"""DiffTune while walking: steps of the weights by the derivative of the last measured window.

Every `window` ticks the loss of these ticks is differentiated by the weights in use, and the
weights take one Gauss-Newton step of DiffTune, with its checks and within a fixed radius. Dynamics
and controller are differentiated at the measured states, feet and contacts (Eq. 9, 10), and the
loss has the measured errors: both contain what the model does not know, such as a load on the
trunk. A sagging trunk is the example: at the error e = d / k under a load d, the recursion along
the measured states converges to -(dk / dtheta) e / k, the derivative of d / k itself; in a rollout
of the model from the measured state the error decays, and with it the gradient towards more
stiffness.

The sensitivities are carried on from window to window: the response of the closed loop to a weight
is longer than a window, and a recursion restarted in each would cover its beginning only. On the
hfs, from nominal weights, the three `ESTIMATORS` gain about the same.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import sensitivity
from jaxtyping import Float, Int
from sensitivity import Sensitivities, no_tangents, step_sensitivities

from hector_jax.control.controller import measured_feet
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import NOT_NEGATIVE, POSITIVE, Range, check
from hector_jax.core.trajectory import Trajectory, Wrench, has_fallen
from hector_jax.core.tree import stack
from hector_jax.robot.model import Robot
from hector_jax.tuning import difftune
from hector_jax.tuning.difftune import Iteration, TuneConfig, TuneState, trial_weights
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import MeasuredState, carry_from
from hector_jax.tuning.loss import Loss, losses
from hector_jax.tuning.rollout import Carry, RolloutConfig, Scenario, command_history

ESTIMATORS = ("carried", "cut", "model")


@dataclass(frozen=True)
class OnlineConfig:
    """Settings of tuning while walking."""

    tune: TuneConfig = field(default_factory=TuneConfig)  # controller, loss, steps and checks
    window: int = 40  # ticks of the loss of a step, and between steps; a gait cycle
    late: int = 0  # ticks from a window's end to the use of its step
    radius: float = 0.2  # [e-folds] of the trust region of a step
    estimator: str = "carried"  # along measured states; "cut": restarted in each window; "model"

    def __post_init__(self) -> None:
        check(self, window=Range(2), late=NOT_NEGATIVE, radius=POSITIVE, estimator=ESTIMATORS)
        if self.late >= self.window:
            raise InputError(f"OnlineConfig.late must be below window, got {self.late}")


class Trace(NamedTuple):
    """State of the recursion between two windows."""

    commands: Wrench  # (HISTORY, feet, 3) each, world frame, newest first
    disturbance: Disturbance  # of the controller
    tangents: Carry  # of the `varied` carry


def init_trace(anchor: Anchor, measured: MeasuredState, last: Wrench, weights: Weights) -> Trace:
    """Start the recursion: the past does not depend on the weights.

    Args:
        anchor: of the reference.
        measured: at the start of the tick.
        last: wrench commanded over the last tick, also used for the ticks before it.
        weights: of the shape that the tangents are taken by.
    """
    commands = command_history(last)
    carry = carry_from(measured, anchor, commands, NO_DISTURBANCE)
    return Trace(commands, NO_DISTURBANCE, no_tangents(carry, weights))


def window_derivatives(
    config: RolloutConfig,
    loss: Loss,
    robot: Robot,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    trace: Trace,
    weights: Weights,
    tick: Int[Array, ""],
    states: MeasuredState,
    measured: bool = True,
    others: tuple[str, ...] = (),
) -> tuple[Trace, Evaluation, Float[Array, "n n"]]:
    """Compute the loss of the ticks of a window and its derivatives by the weights.

    Args:
        config: controller.
        loss: terms and their weights.
        robot: nominal body.
        command, anchor: of the walk.
        effect: phi, `Window -> Effect`; its Jacobian is used.
        trace: of the window before, see `init_trace`.
        weights: in use over each of the n ticks, stacked.
        tick: gait tick at the window's start, later than t = 0.
        states: n + 1 measurements, stacked: at the start of each tick and at the end of the last.
        measured: True along the measured states, False along a rollout of the model from the first
            measurement (static).
        others: names of the numbers beside Q and R that are stepped (static).

    Returns:
        The trace for the next window, the evaluation, which includes the change from the command
        before the window to its first, and the Gauss-Newton matrix at the weights of the last tick.

    Source: Eq. 9-11, along measured states.
    """

    def step(carried: tuple[Carry, Carry], inputs: tuple) -> tuple:
        carry, tangents = carried
        tick, weights, begin, end = inputs
        if measured:
            carry = carry_from(begin, anchor, carry.commands, carry.disturbance)
        after, tangents, sample, columns = step_sensitivities(
            config, scenario, weights, carry, tangents, tick
        )
        if measured:
            fallen = has_fallen(end.state, *robot.description.limits)
            sample = sample._replace(state=end.state, fallen=fallen)
        return (after, tangents), (sample, columns)

    scenario = Scenario(robot, command, anchor, effect)
    begins, ends = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states)
    state, newest = jax.tree.map(lambda x: x[0], states), jax.tree.map(lambda x: x[-1], weights)
    carry = carry_from(state, anchor, trace.commands, trace.disturbance)
    ticks = tick + jnp.arange(len(begins.feet.yaw))
    (last, tangents), (samples, columns) = jax.lax.scan(
        step, (carry, trace.tangents), (ticks, weights, begins, ends)
    )
    walk, columns = _with_command_before(samples, columns, trace)
    value, gradient = sensitivity.gradient(loss, walk, columns, newest)
    matrix = sensitivity.matrix(loss, walk, columns, newest, others)
    fallen, residual = jnp.mean(1.0 * samples.fallen), jnp.max(samples.residual)
    evaluation = Evaluation(value, losses(loss, walk), gradient, fallen, residual)
    return Trace(last.commands, last.disturbance, tangents), evaluation, matrix


_window_derivatives = jax.jit(
    window_derivatives, static_argnums=0, static_argnames=("measured", "others")
)


def follow(
    config: TuneConfig, robot: Robot, *window: Any, measured: bool = True
) -> tuple[Trace, Evaluation, Float[Array, "n n"]]:
    """Run `window_derivatives` with the settings of a tuning, compiled."""
    how = {"measured": measured, "others": config.others}
    return _window_derivatives(config.rollout, config.loss, robot, *window, **how)


def _with_command_before(
    samples: Trajectory, columns: Sensitivities, trace: Trace
) -> tuple[Trajectory, Sensitivities]:
    """Prepend a sample that has no error and the command before the window."""

    def prepend(first: Any, rest: Any) -> Any:
        return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), first, rest)

    newest = jax.tree.map(lambda w: w[0], trace.commands)
    first = jax.tree.map(lambda x: x[0], samples)
    walk = prepend(first._replace(state=first.reference, command=newest), samples)
    before = Sensitivities(
        jax.tree.map(lambda s: jnp.zeros_like(s[0]), columns.state),
        jax.tree.map(lambda w: w[:, 0], trace.tangents.commands),
    )
    columns = jax.tree.map(lambda s: jnp.swapaxes(s, 0, 1), prepend(before, columns))
    return walk._replace(period=first.period, initial=first.initial), columns


_feet = jax.jit(measured_feet)


class Adaptation(NamedTuple):
    """State of online tuning between two ticks."""

    tuning: TuneState  # its weights are in use from tick `due` on; its rule has the radius only
    sound: Float[Array, " n"]  # steps of the last accepted window
    weights: Weights  # in use
    due: int  # gait tick
    trace: Trace | None  # of the windows so far; None before the first
    states: tuple[MeasuredState, ...]  # since the start of the window
    used: tuple[Weights, ...]  # over the ticks of the window


def init_adaptation(config: OnlineConfig, weights: Weights) -> Adaptation:
    """Return the state of online tuning before its first tick."""
    tuning = _with_radius(difftune.init(config.tune, weights), config.radius)
    start = jax.tree.map(np.asarray, tuning.start)
    return Adaptation(tuning, tuning.steps, start, 0, None, (), ())


def _with_radius(tuning: TuneState, radius: Any) -> TuneState:
    return tuning._replace(rule=tuning.rule._replace(size=jnp.asarray(radius, float)))


_update = jax.jit(difftune.update, static_argnums=0)


def step_adaptation(
    config: OnlineConfig,
    robot: Robot,
    command: Command,
    effect: jax.tree_util.Partial,
    carry: Adaptation,
    tick: int,
    anchor: Anchor,
    measurement: Measurement,
    last: Wrench,
) -> tuple[Adaptation, Iteration | None]:
    """Choose the weights for a tick of a walk; at the end of a window, also return its iteration.

    A window with a fall, an unsolved QP or a number that is not finite is rejected: the weights are
    reset to those of the last accepted window, the radius is halved and the sensitivities restart.

    Args:
        config: the settings.
        robot: nominal body.
        command, anchor: of the walk.
        effect: phi.
        carry: from `init_adaptation` or the tick before.
        tick: gait tick, from t = 0 on.
        measurement: at the tick's start.
        last: wrench commanded over the tick before [N, N m].
    """
    if tick == anchor.tick:  # the reference is anchored in this tick
        return carry, None
    state = MeasuredState(measurement.state, _feet(robot, measurement))
    states = (*carry.states, jax.tree.map(np.asarray, state))
    trace = carry.trace or init_trace(anchor, state, last, carry.weights)
    carry, iteration = carry._replace(states=states, trace=trace), None
    if len(carry.used) == config.window:
        window = states, carry.used, tick - config.window
        trace, *found = _follow_window(config, robot, command, anchor, effect, trace, *window)
        # the state of the rule is that of a start, because another window is another objective, and
        # the ratio of true to predicted gain compares losses of one; hence the fixed radius
        after, iteration = _update(config.tune, carry.tuning, *found)
        iteration, radius = jax.tree.map(np.asarray, iteration), carry.tuning.rule.size
        if iteration.accepted:
            sound, steps, radius = carry.tuning.steps, after.steps, min(config.radius, 2.0 * radius)
        else:
            sound, steps, radius = carry.sound, carry.sound, radius / 2.0
            trace = init_trace(anchor, state, last, carry.weights)
        tuning = carry.tuning._replace(steps=steps, iteration=after.iteration)
        carry = carry._replace(tuning=_with_radius(tuning, radius), sound=sound)
        carry = carry._replace(due=tick + config.late, trace=trace, states=states[-1:], used=())
    weights = carry.weights
    if tick == carry.due:
        weights = jax.tree.map(np.asarray, trial_weights(config.tune, carry.tuning))
    return carry._replace(weights=weights, used=(*carry.used, weights)), iteration


def _follow_window(
    config: OnlineConfig,
    robot: Robot,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    trace: Trace,
    states: Sequence[MeasuredState],
    used: Sequence[Weights],
    begin: int,
) -> tuple[Trace, Evaluation, Float[Array, "n n"]]:
    """Run `window_derivatives` on the window from tick `begin`; returns NumPy arrays."""
    if config.estimator != "carried":
        trace = trace._replace(tangents=jax.tree.map(jnp.zeros_like, trace.tangents))
    window = trace, stack(used), np.asarray(begin, np.int32), stack(states)
    measured = config.estimator != "model"
    result = follow(config.tune, robot, command, anchor, effect, *window, measured=measured)
    return jax.tree.map(np.asarray, result)


def retuner(
    config: OnlineConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    on_step: Callable[[Iteration], None] = lambda iteration: None,
) -> Callable[..., Weights]:
    """Return online tuning as a callback of `sim.walk.walk`, for one walk.

    Args:
        config, robot, command, effect: see `step_adaptation`.
        weights: the start.
        on_step: called after each window, with the weights in use at its end.
    """
    carry = init_adaptation(config, weights)

    def retune(*tick: Any) -> Weights:
        nonlocal carry
        carry, iteration = step_adaptation(config, robot, command, effect, carry, *tick)
        if iteration is not None:
            on_step(iteration)
        return carry.weights

    return retune
