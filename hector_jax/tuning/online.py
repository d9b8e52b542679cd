"""DiffTune while walking: weights stepped by the gradient over the walk that was just measured.

Every `window` ticks the loss of these ticks is differentiated by the weights in force, and the
weights take one of DiffTune's steps, inside its guards. The states, feet and contacts along which
dynamics and controller are differentiated are the measured ones (Eq. 9, 10), and so are the errors
that enter the loss: what the model does not know, such as a load on the trunk, is in both. A
sagging trunk is the example: under the error e = d / k that a load d leaves, the recursion along
the measured states settles at -(dk / dtheta) e / k, the derivative of d / k itself; a model that is
rolled out from the measured state sees the error die away and with it the reason to stiffen.

The sensitivities are carried on from window to window: a window is shorter than the answer of the
closed loop to a weight, and a recursion begun anew in each would see the first of it only. On the
hfs, from nominal weights, the three ways of `ESTIMATORS` gain about the same.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from hector_jax.control.controller import Retune, measured_feet
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import NOT_NEGATIVE, SHARE, Range, check
from hector_jax.core.trajectory import State, Trajectory, Wrench, has_fallen
from hector_jax.core.tree import stack
from hector_jax.grfm.effect import HISTORY
from hector_jax.robot.model import Robot
from hector_jax.tuning import sensitivity
from hector_jax.tuning.difftune import Iteration, TuneConfig, step_status, step_weights
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import Loss, losses
from hector_jax.tuning.rollout import Carry, RolloutConfig
from hector_jax.tuning.sensitivity import Sensitivities, Varied, no_tangents, step_sensitivities

ESTIMATORS = ("carried", "cut", "model")


@dataclass(frozen=True)
class OnlineConfig:
    """How weights are tuned while walking."""

    tune: TuneConfig = field(default_factory=TuneConfig)  # controller, loss, steps and guards
    window: int = 40  # ticks between steps, and of the loss of a step; a gait cycle
    late: int = 0  # ticks after a window's end at which its step comes into force
    step: float = 1.0  # of the full step of `tune`
    estimator: str = "carried"  # along measured states; "cut": begun anew in each window; "model"

    def __post_init__(self) -> None:
        check(self, window=Range(2), late=NOT_NEGATIVE, step=SHARE, estimator=ESTIMATORS)
        if self.late >= self.window:
            raise InputError(f"OnlineConfig.late must be below window, got {self.late}")


class MeasuredState(NamedTuple):
    """What is measured at the start of a tick."""

    state: State  # of the base
    feet: Feet  # where the feet are; of one in the air it is not used


class Trace(NamedTuple):
    """What a window hands to the next."""

    commands: Wrench  # (HISTORY, feet, 3) each, world frame, newest first
    disturbance: Disturbance  # of the controller, at its end
    tangents: Varied  # of the carry at its end


def init_trace(anchor: Anchor, measured: MeasuredState, last: Wrench, weights: Weights) -> Trace:
    """No weight has a part in what was measured so far.

    Args:
        anchor: of the reference.
        measured: now.
        last: wrench commanded over the last tick, taken for those before it too.
        weights: whose numbers are counted.
    """
    commands = jax.tree.map(lambda w: jnp.broadcast_to(w, (HISTORY, *jnp.shape(w))), last)
    carry = _carry(anchor, measured, commands, NO_DISTURBANCE)
    return Trace(commands, NO_DISTURBANCE, no_tangents(carry, weights))


def _carry(
    anchor: Anchor, measured: MeasuredState, commands: Wrench, disturbance: Disturbance
) -> Carry:
    never = jnp.asarray(False)
    return Carry(measured.state, measured.feet, commands, anchor, disturbance, never)


def window_gradient(
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
) -> tuple[Trace, Evaluation]:
    """Loss of the ticks of a window and its gradient by the weights.

    Args:
        config: controller.
        loss: terms and their weights.
        robot: nominal body.
        command, anchor: what was walked, from where.
        effect: phi, `Window -> Effect`; its Jacobian is used.
        trace: of the window before, see `init_trace`.
        weights: in force over each of the n ticks, stacked.
        tick: gait tick at the window's start, later than t = 0.
        states: n + 1 measurements, stacked: at the start of each tick and at the end of the last.
        measured: along what was measured; or along the model's own walk from the first measurement
            on (static).

    Returns:
        The trace for the next window, and the evaluation. The change from the command before the
        window to its first is priced in it.

    Source: Eq. 9-11, along measured states.
    """

    def one(carried: tuple[Carry, Varied], inputs: tuple) -> tuple:
        carry, tangents = carried
        tick, weights, now, after = inputs
        if measured:
            carry = _carry(anchor, now, carry.commands, carry.disturbance)
        then, tangents, sample, columns = step_sensitivities(
            config, robot, weights, command, effect, carry, tangents, tick
        )
        if measured:
            fallen = has_fallen(after.state, *robot.description.limits)
            sample = sample._replace(state=after.state, fallen=fallen)
        return (then, tangents), (sample, columns)

    now, after = jax.tree.map(lambda x: x[:-1], states), jax.tree.map(lambda x: x[1:], states)
    begin = jax.tree.map(lambda x: x[0], states), trace.commands, trace.disturbance
    ticks = tick + jnp.arange(len(now.feet.yaw))
    (last, tangents), (samples, columns) = jax.lax.scan(
        one, (_carry(anchor, *begin), trace.tangents), (ticks, weights, now, after)
    )
    walk, columns = _with_command_before(samples, columns, trace)
    first = jax.tree.map(lambda x: x[0], weights)
    value, gradient = sensitivity.gradient(loss, walk, columns, first)
    fallen, residual = jnp.mean(1.0 * samples.fallen), jnp.max(samples.residual)
    evaluation = Evaluation(value, losses(loss, walk), gradient, fallen, residual)
    return Trace(last.commands, last.disturbance, tangents), evaluation


_window_gradient = jax.jit(window_gradient, static_argnums=0, static_argnames="measured")


def follow(
    config: TuneConfig, robot: Robot, *window: Any, measured: bool = True
) -> tuple[Trace, Evaluation]:
    """`window_gradient` with the rollout and the loss of a tuning, compiled."""
    return _window_gradient(config.rollout, config.loss, robot, *window, measured=measured)


def _with_command_before(
    samples: Trajectory, columns: Sensitivities, trace: Trace
) -> tuple[Trajectory, Sensitivities]:
    """Samples after one that has no error and the command before the window."""

    def after(first: Any, rest: Any) -> Any:
        return jax.tree.map(lambda one, more: jnp.concatenate([one[None], more]), first, rest)

    newest = jax.tree.map(lambda w: w[0], trace.commands)
    first = jax.tree.map(lambda x: x[0], samples)
    walk = after(first._replace(state=first.reference, command=newest), samples)
    before = Sensitivities(
        jax.tree.map(lambda s: jnp.zeros_like(s[0]), columns.state),
        jax.tree.map(lambda w: w[:, 0], trace.tangents.commands),
    )
    columns = jax.tree.map(lambda s: jnp.swapaxes(s, 0, 1), after(before, columns))
    return walk._replace(period=first.period, initial=first.initial), columns


_feet = jax.jit(measured_feet)


class Adaptation(NamedTuple):
    """Where online tuning stands between two ticks."""

    weights: Weights  # in force
    newest: Weights  # that come into force at tick `due`
    sound: Weights  # of the last window that was not refused
    scale: float  # of the next step, 1 for a full one
    led: float  # scale of the step that led to `newest`
    windows: int  # so far
    due: int  # gait tick
    trace: Trace | None  # of the windows so far; None before the first
    states: tuple[MeasuredState, ...]  # measured since the window began
    used: tuple[Weights, ...]  # in force over its ticks


def init_adaptation(weights: Weights) -> Adaptation:
    """Online tuning before its first tick, from some weights."""
    start = jax.tree.map(np.asarray, weights)
    return Adaptation(start, start, start, 1.0, 0.0, 0, 0, None, (), ())


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
    """Weights for one tick of a walk; at the end of a window, what its step was.

    A window that fell, was not solved or is not finite is refused: the weights go back to those of
    the last window that was sound, the step is halved and the sensitivities begin anew.

    Args:
        config: how.
        robot: nominal body.
        command, anchor: what is walked, from where.
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
    carry, iteration = carry._replace(states=states), None
    trace = carry.trace or init_trace(anchor, state, last, carry.weights)
    carry = carry._replace(trace=trace)
    if len(carry.used) == config.window:
        window = carry.states, carry.used, tick - config.window
        trace, evaluation = _follow_window(config, robot, command, anchor, effect, trace, *window)
        status = step_status(config.tune, evaluation)
        row = carry.windows, carry.weights, evaluation, status, carry.led
        iteration = Iteration(*jax.tree.map(np.asarray, row))
        if not iteration.accepted:
            scale, led, newest, sound = carry.scale / 2.0, 0.0, carry.sound, carry.sound
            trace = init_trace(anchor, state, last, carry.weights)
        else:
            scale, led, sound = min(1.0, 2.0 * carry.scale), config.step * carry.scale, carry.newest
            newest = step_weights(config.tune, sound, evaluation.gradient, led)
        due, states = tick + config.late, carry.states[-1:]
        windows = carry.windows + 1
        carry = Adaptation(
            carry.weights, newest, sound, scale, led, windows, due, trace, states, ()
        )
    weights = carry.newest if tick >= carry.due else carry.weights
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
) -> tuple[Trace, Evaluation]:
    """`window_gradient` of the window from tick `begin`, as numbers of NumPy."""
    if config.estimator != "carried":
        trace = trace._replace(tangents=jax.tree.map(jnp.zeros_like, trace.tangents))
    result = follow(
        config.tune,
        robot,
        command,
        anchor,
        effect,
        trace,
        stack(used),
        np.asarray(begin, np.int32),
        stack(states),
        measured=config.estimator != "model",
    )
    return jax.tree.map(np.asarray, result)


def retuner(
    config: OnlineConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    on_step: Callable[[Iteration], None] = lambda iteration: None,
) -> Retune:
    """Online tuning for `sim.walk.walk`.

    Args:
        config, robot, command, effect: see `step_adaptation`.
        weights: where to start.
        on_step: called after each window, with the weights in force at its end.
    """

    def step(carry: Adaptation, *tick: Any) -> tuple[Adaptation, Weights]:
        carry, iteration = step_adaptation(config, robot, command, effect, carry, *tick)
        if iteration is not None:
            on_step(iteration)
        return carry, carry.weights

    start = config.tune.rollout.walk.with_others(weights, config.tune.others)
    return Retune(init_adaptation(start), step)
