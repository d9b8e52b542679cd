"""DiffTune: step the weights down the gradient of the closed loop, inside the box (P, Eq. 9).

theta <- P_Theta(theta - beta theta g), with g the gradient in log-weights, divided by its largest
magnitude inside Q and inside R: a weight moves by at most beta_Q or beta_R of itself, whatever the
size of the loss. A step that ends in a fall, a bad solve or a number that is not finite is refused:
the weights go back, the step is halved and the refusal is told.

Two results come out of one run: the weights after the paper's `ten` iterations, each accepted
unless it is refused, and the `converged` ones, for which steps that raise the loss are halved too
until nothing is gained any more.

The rule by which all that is decided is `init` and `update`, functions of arrays: `tune` asks them
from Python, one iteration after the other; `batch` compiles them into its loop on the device.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights, bounds, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, check
from hector_jax.robot.model import Robot
from hector_jax.tuning.loss import LossConfig, Losses, LossWeights, losses, total
from hector_jax.tuning.rollout import RolloutConfig, Variation, rollout

PAPER_ITERATIONS = 10


@dataclass(frozen=True)
class TuneConfig:
    """How the weights are tuned."""

    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    loss: LossConfig = LossConfig()
    beta_q: float = 0.05  # largest relative step of a weight in Q
    beta_r: float = 0.08  # and in R
    update: str = "relative"  # or "literal": the paper's theta - beta dL/dtheta
    tie_feet: bool = True  # one R for both feet, as the robot is its own mirror image
    iterations: int = 100  # at most
    patience: int = 10  # iterations over which the loss must fall
    gain: float = 5e-3  # by this share at least, or the tuning has converged
    smallest_step: float = 1 / 128  # of the full step; below it the tuning has converged
    residual: float = 1e-8  # worst relative KKT residual that is believed: that of a solved QP

    def __post_init__(self) -> None:
        check(
            self,
            beta_q=POSITIVE,
            beta_r=POSITIVE,
            update=("relative", "literal"),
            iterations=AT_LEAST_ONE,
            patience=AT_LEAST_ONE,
            gain=NOT_NEGATIVE,
            smallest_step=POSITIVE,
            residual=POSITIVE,
        )


class Evaluation(NamedTuple):
    """One rollout of a weight set on the model, with the gradient of its loss."""

    loss: Float[Array, "*batch"]
    parts: Losses
    gradient: Weights  # dL/dtheta
    fallen: Float[Array, "*batch"]  # share of the ticks after a fall
    residual: Float[
        Array, "*batch"
    ]  # worst of the rollout; infinite where a minimiser is not unique


class Reason(IntEnum):
    """Why an iteration was refused."""

    ACCEPTED = 0
    NOT_FINITE = 1
    FELL = 2
    UNSOLVED = 3  # a QP of the rollout
    ROSE = 4  # the loss, after the paper's ten iterations


class Stop(IntEnum):
    """Why a tuning ended."""

    GOING = 0
    LIMIT = 1  # of iterations
    SMALL_STEP = 2
    NO_GAIN = 3
    BAD_START = 4  # refused


class Progress(NamedTuple):
    """Where a tuning stands between two rollouts: the state of the rule."""

    trial: Weights  # to be evaluated next
    share: Float[Array, "*batch"]  # of the full step that leads from `best` to `trial`
    count: Int[Array, "*batch"]  # iteration of the trial; the start is 0
    best: Weights  # the last that were accepted
    loss: Float[Array, "*batch"]  # theirs
    gradient: Weights  # theirs
    recent: Float[Array, "*batch kept"]  # losses accepted last, newest first; NaN before the first
    ten: Weights  # best after at most the paper's ten iterations
    stop: Int[Array, "*batch"]  # a `Stop`


class Iteration(NamedTuple):
    """What one iteration did; a line of metrics.jsonl."""

    iteration: int
    weights: Weights
    evaluation: Evaluation
    accepted: bool
    reason: str  # why it was refused; empty when accepted
    step: float  # share of the full step that led here


class Tuning(NamedTuple):
    """A whole tuning."""

    history: list[Iteration]
    ten: Weights
    converged: Weights
    stop: str  # why it ended


def evaluate(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    alpha: LossWeights,
    variation: Variation | None = None,
) -> Evaluation:
    """Loss of a weight set on the model and its gradient, in one program.

    Args:
        config, robot, weights, command, anchor, effect, variation: see `rollout`.
        alpha: weights of the parts of the loss.

    Source: Eq. 9, 11.
    """

    def objective(weights: Weights) -> tuple[Array, tuple]:
        trajectory = rollout(config, robot, weights, command, anchor, effect, variation)
        parts = losses(trajectory)
        seen = parts, jnp.mean(1.0 * trajectory.fallen), jnp.max(trajectory.residual)
        return total(alpha, parts), seen

    (loss, (parts, fallen, residual)), gradient = jax.value_and_grad(objective, has_aux=True)(
        weights
    )
    return Evaluation(loss, parts, gradient, fallen, residual)


_evaluate = jax.jit(evaluate, static_argnums=0)
# once for a rollout: new weights, commands, nets and loss weights need no compilation


def tune_step(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> Evaluation:
    """`evaluate` with the rollout and the loss weights of a tuning, compiled."""
    alpha = config.loss.as_arrays()
    return _evaluate(config.rollout, robot, weights, command, anchor, effect, alpha)


def relative_step(beta_q: float, beta_r: float) -> optax.GradientTransformation:
    """Downhill in log-weights, the largest relative step being beta inside Q and inside R."""

    def scaled(tree: Any, weights: Any, beta: float) -> Any:
        logs = jax.tree.map(lambda g, w: g * w, tree, weights)
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(g)) for g in jax.tree.leaves(logs)]))
        size = beta / jnp.where(largest > 0.0, largest, 1.0)
        return jax.tree.map(lambda g, w: -size * g * w, logs, weights)

    def update(gradient: Weights, state: optax.OptState, weights: Weights | None = None):
        if weights is None:
            raise ValueError("relative_step needs the weights: pass params to update")
        return Weights(
            scaled(gradient.Q, weights.Q, beta_q), scaled(gradient.R, weights.R, beta_r)
        ), state

    return optax.GradientTransformation(lambda weights: optax.EmptyState(), update)


def _optimiser(config: TuneConfig) -> optax.GradientTransformation:
    if config.update == "relative":
        return relative_step(config.beta_q, config.beta_r)
    return optax.multi_transform(
        {"Q": optax.sgd(config.beta_q), "R": optax.sgd(config.beta_r)},
        Weights("Q", "R"),  # pyright: ignore
    )


def _mean_over_feet(tree: Weights) -> Weights:
    both = lambda x: jnp.broadcast_to(x.mean(axis=0), x.shape)  # noqa: E731
    return Weights(tree.Q, jax.tree.map(both, tree.R))


def step_weights(
    config: TuneConfig, weights: Weights, gradient: Weights, share: float | Float[Array, ""]
) -> Weights:
    """Weights after `share` of a full step downhill, projected onto the box."""
    if config.tie_feet:
        gradient = _mean_over_feet(gradient)
    optimiser = _optimiser(config)
    updates, _ = optimiser.update(gradient, optimiser.init(weights), weights)
    moved = optax.apply_updates(weights, jax.tree.map(lambda u: share * u, updates))
    return optax.projections.projection_box(moved, *bounds())


def believed(config: TuneConfig, evaluation: Evaluation) -> Int[Array, ""]:
    """Whether an evaluation is to be believed: the `Reason` why not."""
    # squares, because a gradient near the largest number overflows where a step is made of it
    squares = [jnp.square(x) for x in (evaluation.loss, *jax.tree.leaves(evaluation.gradient))]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in squares]))
    solved = jnp.asarray(evaluation.residual) <= config.residual
    reason = jnp.where(solved, Reason.ACCEPTED, Reason.UNSOLVED)
    reason = jnp.where(jnp.asarray(evaluation.fallen) > 0, Reason.FELL, reason)
    return jnp.where(finite, reason, Reason.NOT_FINITE).astype(jnp.int32)


def init(config: TuneConfig, weights: Weights, count: int = 0) -> Progress:
    """A tuning before its first rollout, which is iteration `count`.

    With `tie_feet` both feet start from the geometric mean of their weights in R.
    """
    weights = jax.tree.map(jnp.asarray, weights)
    if config.tie_feet:
        equal = jnp.all(jnp.stack([jnp.array_equal(*w) for w in weights.R]))
        tied = jax.tree.map(jnp.exp, _mean_over_feet(jax.tree.map(jnp.log, weights)))
        # weights that are equal stay so to the last bit
        weights = jax.tree.map(lambda w, t: jnp.where(equal, w, t), weights, tied)
    return Progress(
        trial=weights,
        share=jnp.asarray(1.0),
        count=jnp.asarray(count, jnp.int32),
        best=weights,
        loss=jnp.asarray(jnp.inf, float),  # typed as later ones, or `update` is compiled again
        gradient=jax.tree.map(jnp.zeros_like, weights),
        recent=jnp.full(config.patience + 1, jnp.nan, float),
        ten=weights,
        stop=jnp.asarray(Stop.GOING, jnp.int32),
    )


def update(
    config: TuneConfig, progress: Progress, evaluation: Evaluation
) -> tuple[Progress, Int[Array, ""]]:
    """What follows from the rollout of the trial: the next trial, and why this one was refused.

    The first `PAPER_ITERATIONS` are accepted whatever the loss; later ones must lower it. A
    refusal halves the step, an acceptance doubles it up to the full one. After the paper's
    iterations the tuning stops where the step has become too small or `patience` accepted
    iterations gained less than `gain`.
    """
    count, start = progress.count, jnp.isinf(progress.loss)  # nothing was accepted yet
    late = count > PAPER_ITERATIONS
    reason = believed(config, evaluation)
    rose = late & ~(evaluation.loss < progress.loss)
    reason = jnp.where((reason == Reason.ACCEPTED) & rose, Reason.ROSE, reason)
    accepted = reason == Reason.ACCEPTED

    def kept(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda x, y: jnp.where(accepted, x, y), new, old)

    best = kept(progress.trial, progress.best)
    gradient = kept(evaluation.gradient, progress.gradient)
    recent = jnp.append(jnp.asarray(evaluation.loss), progress.recent[:-1])
    recent = kept(recent, progress.recent)
    share = jnp.where(accepted, jnp.minimum(1.0, 2.0 * progress.share), progress.share / 2.0)

    little = recent[0] > (1 - config.gain) * recent[-1]  # false before there are enough
    stop = jnp.where(count >= config.iterations, Stop.LIMIT, Stop.GOING)
    stop = jnp.where(late & little, Stop.NO_GAIN, stop)
    stop = jnp.where(late & (share < config.smallest_step), Stop.SMALL_STEP, stop)
    stop = jnp.where(start & ~accepted, Stop.BAD_START, stop)
    return Progress(
        trial=step_weights(config, best, gradient, share),
        share=share,
        count=count + 1,
        best=best,
        loss=kept(evaluation.loss, progress.loss),
        gradient=gradient,
        recent=recent,
        ten=jax.tree.map(lambda x, y: jnp.where(late, y, x), best, progress.ten),
        stop=stop.astype(jnp.int32),
    ), reason.astype(jnp.int32)


def _in_words(config: TuneConfig, reason: Reason, evaluation: Evaluation) -> str:
    return {
        Reason.ACCEPTED: "",
        Reason.NOT_FINITE: "loss or gradient not finite",
        Reason.FELL: "the robot fell",
        Reason.UNSOLVED: (
            f"QP residual {float(evaluation.residual):.1e} above {config.residual:.0e}"
        ),
        Reason.ROSE: "the loss rose",
    }[reason]


def refusal(config: TuneConfig, evaluation: Evaluation) -> str:
    """Why an evaluation is not to be believed; empty when it is."""
    return _in_words(config, Reason(int(believed(config, evaluation))), evaluation)


def stopped(config: TuneConfig, stop: Stop) -> str:
    """Why a tuning ended, in words."""
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
        config: how.
        robot, command, anchor, effect: the model, see `rollout`.
        weights: where to start.
        on_iteration: called after each iteration, the start being iteration 0.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model.

    Source: problem P and the paper's set-up (ten iterations, beta_Q 0.05, beta_R 0.08).
    """
    return descend(
        config,
        weights,
        lambda trial: tune_step(config, robot, trial, command, anchor, effect),
        on_iteration,
    )


def descend(
    config: TuneConfig,
    weights: Weights,
    look: Callable[[Weights], Evaluation],
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
    first: int = 0,
) -> Tuning:
    """The rule, driven from Python: whatever `look` finds of weights is stepped down.

    Args:
        config: how.
        weights: where to start.
        look: loss and gradient of weights.
        on_iteration: called after each iteration.
        first: number of the first one; from the paper's ten on every step has to lower the loss.

    Raises:
        InputError: the evaluation of the starting weights is not to be believed; `on_iteration` has
            been told of it.
    """
    history: list[Iteration] = []
    progress = init(config, weights, first)
    while progress.stop == Stop.GOING:
        # copies, because a view would keep the device's array for as long as the history
        trial = jax.tree.map(np.array, progress.trial)
        found = jax.tree.map(np.array, look(trial))
        step = float(progress.share) if history else 0.0
        progress, code = update(config, progress, found)
        reason = _in_words(config, Reason(int(code)), found)
        history.append(Iteration(first + len(history), trial, found, not reason, reason, step))
        on_iteration(history[-1])
        if progress.stop == Stop.BAD_START:
            raise InputError(f"the starting weights cannot be tuned from: {reason}")
    stop = Stop(int(progress.stop))
    words = stopped(config, stop)
    if stop == Stop.SMALL_STEP and refusal(config, found):
        words = f"{words}, the last refused: {reason}"
    ten, converged = jax.tree.map(np.asarray, (progress.ten, progress.best))
    return Tuning(history, ten, converged, words)


def gradient_norms(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> Losses:
    """Norms of the parts' gradients in log-weights, which the paper's footnote aligns."""

    def norm(alpha: LossWeights) -> Float[Array, ""]:
        found = _evaluate(config.rollout, robot, weights, command, anchor, effect, alpha)
        logs = jax.tree.map(jnp.multiply, found.gradient, weights)
        return jnp.linalg.norm(weights_to_vector(logs))

    return Losses(*(norm(LossWeights(*alone)) for alone in np.eye(3)))


def aligned(config: LossConfig, norms: Losses) -> LossConfig:
    """Loss weights that bring the three gradients to the order of that of L_ctrl (footnote)."""
    power = lambda ratio: float(10.0 ** np.round(np.log10(max(float(ratio), 1e-12))))  # noqa: E731
    return replace(
        config,
        euler=power(norms.control / norms.euler),
        position=power(norms.control / norms.position),
    )
