"""DiffTune: step the weights down the gradient of the closed loop, inside the box (P, Eq. 9).

theta <- P_Theta(theta - beta theta g), with g the gradient in log-weights, divided by its largest
magnitude inside Q and inside R: a weight moves by at most beta_Q or beta_R of itself, whatever the
size of the loss. Other numbers of the controller (`TuneConfig.others`), which may be zero, move by
at most beta_others of the width of their box. A step that ends in a fall, a bad solve or a number
that is not finite is rejected: the weights are reset and the step is halved.

A tuning has two results: the weights after the paper's `ten` iterations, whose steps may raise the
loss, and the `converged` weights, for which steps that raise the loss are rejected too until the
loss falls no more.

`init` and `update` are this rule as functions of arrays: `tune` calls them from Python, once per
iteration; `batch` compiles them into its loop on the device.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import TUNABLES, bounds, out_of_box
from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, short_repr, unknown
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, check
from hector_jax.core.trajectory import Wrench
from hector_jax.core.tree import where
from hector_jax.robot.model import Robot
from hector_jax.tuning.evaluate import Evaluation, evaluate_jit
from hector_jax.tuning.loss import PAPER_LOSS, alphas, check_loss
from hector_jax.tuning.rollout import RolloutConfig
from hector_jax.tuning.status import StepStatus, Stop, status_text

PAPER_ITERATIONS = 10


@dataclass(frozen=True)
class TuneConfig:
    """Settings of a tuning."""

    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    loss: tuple = PAPER_LOSS  # of `LossTerm`
    beta_q: Annotated[float, POSITIVE] = 0.05  # largest relative step of a weight in Q
    beta_r: Annotated[float, POSITIVE] = 0.08  # largest relative step of a weight in R
    others: tuple[str, ...] = ()  # names in `parameters.TUNABLES`, tuned with Q and R
    # largest step of the others, as a share of their box
    beta_others: Annotated[float, POSITIVE] = 0.02
    update: str = "relative"  # or "literal": the paper's theta - beta dL/dtheta
    tie_feet: bool = True  # one R for all feet, as the robot is its own mirror image
    iterations: Annotated[int, AT_LEAST_ONE] = 100  # at most
    patience: Annotated[int, AT_LEAST_ONE] = 10  # iterations in which the loss must fall
    # by at least this share, or the tuning has converged
    gain: Annotated[float, NOT_NEGATIVE] = 5e-3
    # of the full step; below it the tuning has converged
    smallest_step: Annotated[float, POSITIVE] = 1 / 128
    # largest accepted relative KKT residual: that of a solved QP
    residual: Annotated[float, POSITIVE] = 1e-8

    def __post_init__(self) -> None:
        check(self, update=("relative", "literal"))
        check_loss(self.loss)
        got = short_repr(self.others)
        if self.others and self.update != "relative":
            raise InputError(f"TuneConfig.others must be empty with update literal, got {got}")
        for name in self.others:
            if reason := _why_not_tunable(self.rollout.walk, name):
                expected = "must be numbers that a gradient can tune"
                raise InputError(f"TuneConfig.others {expected}, got {got}: {reason}")

    def as_table(self) -> dict[str, Any]:
        """Return the settings as JSON values; of the loss only its weights."""
        return asdict(replace(self, loss=PAPER_LOSS)) | {"loss": alphas(self.loss)}


def _why_not_tunable(walk: WalkConfig, name: str) -> str:
    """Return why gradients of the rigid-body model cannot tune a number; empty if they can."""
    if name not in TUNABLES:
        return unknown("tunable", name, TUNABLES)
    tunable = TUNABLES[name]
    if tunable.of_legs:
        return (
            f"{name} cannot be tuned by gradients: the rigid-body model has no joints, so its "
            "gradient is zero; a weights file can set it, or --walks tune it"
        )
    if name == "position_limit":
        return (
            f"{name} cannot be tuned by gradients: the errors of a rollout are mostly below it, so "
            "that its gradient is mostly zero; a weights file or --safe can set it"
        )
    if tunable.path.startswith("footstep.") and walk.footstep.rule == "paper":
        return f"{name} has no part in the paper's rule"
    return out_of_box(name, walk.with_others(nominal(), [name]).others[name])


class TuneState(NamedTuple):
    """State of a tuning between two rollouts."""

    trial: Weights  # to be evaluated next
    step_scale: Float[Array, "*batch"]  # share of the full step from `best` to `trial`
    iteration: Int[Array, "*batch"]  # number of the trial; the start is 0
    best: Weights  # the last accepted weights
    loss: Float[Array, "*batch"]  # of `best`
    gradient: Weights  # of `best`
    recent: Float[Array, "*batch recent"]  # last accepted losses, newest first; NaN where none
    ten: Weights  # best after at most the paper's ten iterations
    stop: Int[Array, "*batch"]  # a `Stop`


class Iteration(NamedTuple):
    """An iteration of a tuning; with leading axes, a history of iterations."""

    iteration: Int[Array, "*batch"]  # number; the start is 0
    weights: Weights
    evaluation: Evaluation
    status: Int[Array, "*batch"]  # a `StepStatus`
    step_scale: Float[Array, "*batch"]  # share of the full step to these weights; 0 at the start

    @property
    def accepted(self) -> Any:
        """True if the weights were accepted."""
        return self.status == StepStatus.ACCEPTED

    @property
    def reason(self) -> str:
        """Reason of the rejection; empty if accepted."""
        return status_text(StepStatus(int(self.status)), self.evaluation)


class Tuning(NamedTuple):
    """Result of a tuning."""

    history: list[Iteration]
    ten: Weights
    converged: Weights
    stop: str  # reason of the end


def tune_step(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> Evaluation:
    """Evaluate weights with the rollout and the loss of a tuning, compiled."""
    return evaluate_jit(config.rollout, robot, weights, command, anchor, effect, config.loss)


def relative_step(
    beta_q: float, beta_r: float, beta_others: float = 0.0
) -> optax.GradientTransformation:
    """Return steps downhill in log-weights; the largest relative step is beta, in Q and in R.

    Other numbers step by at most `beta_others` of the width of their box.
    """

    def scaled(tree: Any, sizes: Any, beta: float) -> Any:
        products = jax.tree.map(jnp.multiply, tree, sizes)
        largest = jnp.max(jnp.abs(ravel_pytree(products)[0]), initial=0.0)
        factor = beta / jnp.where(largest > 0.0, largest, 1.0)
        return jax.tree.map(lambda x, size: -factor * x * size, products, sizes)

    def update(updates: Any, params: Any) -> Weights:
        if params is None:
            raise ValueError("relative_step needs the weights: pass params to update")
        widths = {name: TUNABLES[name].upper - TUNABLES[name].lower for name in params.others}
        sizes = params._replace(others=widths)
        return Weights(*map(scaled, updates, sizes, (beta_q, beta_r, beta_others)))

    return optax.stateless(update)


def _optimiser(config: TuneConfig) -> optax.GradientTransformation:
    if config.update == "relative":
        return relative_step(config.beta_q, config.beta_r, config.beta_others)
    rules = {"Q": optax.sgd(config.beta_q), "R": optax.sgd(config.beta_r), "": optax.set_to_zero()}
    return optax.multi_transform(rules, Weights("Q", "R", ""))  # pyright: ignore


def _mean_over_feet(R: Wrench) -> Wrench:
    return jax.tree.map(lambda x: jnp.broadcast_to(x.mean(axis=0), x.shape), R)


def step_weights(
    config: TuneConfig, weights: Weights, gradient: Weights, step_scale: float | Float[Array, ""]
) -> Weights:
    """Step the weights downhill by `step_scale` of a full step and project them onto the box."""
    if config.tie_feet:
        gradient = gradient._replace(R=_mean_over_feet(gradient.R))
    zero = jax.tree.map(jnp.zeros_like, gradient.others)
    tuned = {name: gradient.others[name] for name in config.others}
    gradient = gradient._replace(others={**zero, **tuned})
    optimiser = _optimiser(config)
    updates, _ = optimiser.update(gradient, optimiser.init(weights), weights)
    stepped = optax.apply_updates(weights, jax.tree.map(lambda u: step_scale * u, updates))
    return optax.projections.projection_box(stepped, *bounds(weights.others, weights))


def step_status(config: TuneConfig, evaluation: Evaluation) -> Int[Array, ""]:
    """Return the `StepStatus` of an evaluation, without comparing its loss to others."""
    # squares, because a gradient near the largest number overflows in the step
    squares = [jnp.square(x) for x in (evaluation.loss, *jax.tree.leaves(evaluation.gradient))]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in squares]))
    solved = jnp.asarray(evaluation.residual) <= config.residual
    status = jnp.where(solved, StepStatus.ACCEPTED, StepStatus.UNSOLVED)
    status = jnp.where(jnp.asarray(evaluation.fallen) > 0, StepStatus.FELL, status)
    return jnp.where(finite, status, StepStatus.NOT_FINITE).astype(jnp.int32)


def init(config: TuneConfig, weights: Weights, first: int = 0) -> TuneState:
    """Return the state before the first rollout, which is iteration `first`.

    With `tie_feet` all feet start from the geometric mean of their weights in R.
    """
    weights = config.rollout.walk.with_others(weights, config.others)
    weights = jax.tree.map(lambda w: jnp.asarray(w, float), weights)
    if config.tie_feet:
        equal = jnp.all(jnp.stack([jnp.all(w == w[:1]) for w in weights.R]))
        tied = jax.tree.map(jnp.exp, _mean_over_feet(jax.tree.map(jnp.log, weights.R)))
        # equal weights stay equal to the last bit
        weights = weights._replace(R=where(equal, weights.R, tied))
    return TuneState(
        trial=weights,
        step_scale=jnp.asarray(1.0),
        iteration=jnp.asarray(first, jnp.int32),
        best=weights,
        loss=jnp.asarray(jnp.inf, float),  # of the later type, or `update` is compiled again
        gradient=jax.tree.map(jnp.zeros_like, weights),
        recent=jnp.full(config.patience + 1, jnp.nan, float),
        ten=weights,
        stop=jnp.asarray(Stop.GOING, jnp.int32),
    )


def update(
    config: TuneConfig, state: TuneState, evaluation: Evaluation
) -> tuple[TuneState, Iteration]:
    """Accept or reject the trial by its evaluation; return the next state and the iteration.

    The first `PAPER_ITERATIONS` may raise the loss; later iterations must lower it. A
    rejection halves the step, an acceptance doubles it up to the full one. After the paper's
    iterations the tuning stops where the step has become too small or `patience` accepted
    iterations gained less than `gain`.
    """
    iteration, start = state.iteration, jnp.isinf(state.loss)  # nothing was accepted yet
    late = iteration > PAPER_ITERATIONS
    status = step_status(config, evaluation)
    rose = late & ~(evaluation.loss < state.loss)
    status = jnp.where((status == StepStatus.ACCEPTED) & rose, StepStatus.ROSE, status)
    accepted = status == StepStatus.ACCEPTED

    if_accepted = partial(where, accepted)
    best = if_accepted(state.trial, state.best)
    gradient = if_accepted(evaluation.gradient, state.gradient)
    recent = if_accepted(jnp.append(jnp.asarray(evaluation.loss), state.recent[:-1]), state.recent)
    scale = jnp.where(accepted, jnp.minimum(1.0, 2.0 * state.step_scale), state.step_scale / 2.0)

    little = recent[0] > (1 - config.gain) * recent[-1]  # false while the last is NaN
    stop = jnp.where(iteration >= config.iterations, Stop.LIMIT, Stop.GOING)
    stop = jnp.where(late & little, Stop.NO_GAIN, stop)
    stop = jnp.where(late & (scale < config.smallest_step), Stop.SMALL_STEP, stop)
    stop = jnp.where(start & ~accepted, Stop.BAD_START, stop)
    after = TuneState(
        trial=step_weights(config, best, gradient, scale),
        step_scale=scale,
        iteration=iteration + 1,
        best=best,
        loss=if_accepted(evaluation.loss, state.loss),
        gradient=gradient,
        recent=recent,
        ten=jax.tree.map(lambda x, y: jnp.where(late, y, x), best, state.ten),
        stop=stop.astype(jnp.int32),
    )
    scale = jnp.where(start, 0.0, state.step_scale)
    return after, Iteration(iteration, state.trial, evaluation, status.astype(jnp.int32), scale)


def rejection_reason(config: TuneConfig, evaluation: Evaluation) -> str:
    """Return why an evaluation is rejected; empty if it is not."""
    return status_text(StepStatus(int(step_status(config, evaluation))), evaluation)


def stop_reason(config: TuneConfig, stop: Stop) -> str:
    """Describe why a tuning ended."""
    return {
        Stop.GOING: "not ended",
        Stop.LIMIT: f"{config.iterations} iterations",
        Stop.SMALL_STEP: "the step became too small to gain",
        Stop.NO_GAIN: (
            f"the loss fell by less than {config.gain:.1%} in {config.patience} iterations"
        ),
        Stop.BAD_START: "the starting weights were refused",
    }[stop]


def tune(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Tuning:
    """Tune the weights on the model.

    Args:
        config: the settings.
        robot, command, anchor, effect: the model, see `rollout`.
        weights: the start.
        on_iteration: called after each iteration; the start is iteration 0.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model.

    Source: problem P and the paper's set-up (ten iterations, beta_Q 0.05, beta_R 0.08).
    """
    evaluate = partial(tune_step, config, robot, command=command, anchor=anchor, effect=effect)
    return descend(config, weights, evaluate, on_iteration)


def descend(
    config: TuneConfig,
    weights: Weights,
    evaluate: Callable[[Weights], Evaluation],
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
    first: int = 0,
) -> Tuning:
    """Minimise the loss of `evaluate` by the rule of a tuning, as a loop in Python.

    Args:
        config: the settings.
        weights: the start.
        evaluate: loss and gradient of weights.
        on_iteration: called after each iteration.
        first: number of the first iteration; after the paper's ten every step must lower the loss.

    Raises:
        InputError: the starting weights are rejected, after a call of `on_iteration`.
    """
    history: list[Iteration] = []
    state = init(config, weights, first)
    while state.stop == Stop.GOING:
        # copies, because a view would keep the device's array for as long as the history
        trial = jax.tree.map(np.array, state.trial)
        state, iteration = update(config, state, jax.tree.map(np.array, evaluate(trial)))
        history.append(jax.tree.map(np.array, iteration))
        on_iteration(history[-1])
    stop, last = Stop(int(state.stop)), history[-1]
    if stop == Stop.BAD_START:
        raise InputError(f"the starting weights cannot be tuned from: {last.reason}")
    reason = stop_reason(config, stop)
    if stop == Stop.SMALL_STEP and rejection_reason(config, last.evaluation):
        reason = f"{reason}, the last refused: {last.reason}"
    ten, converged = jax.tree.map(np.asarray, (state.ten, state.best))
    return Tuning(history, ten, converged, reason)
