"""DiffTune: step the weights down the gradient of the closed loop, inside the box (P, Eq. 9).

theta <- P_Theta(theta - beta theta g), with g the gradient in log-weights, divided by its largest
magnitude inside Q and inside R: a weight moves by at most beta_Q or beta_R of itself, whatever the
size of the loss. Other numbers of the controller (`TuneConfig.others`), which may be zero, move by
at most beta_others of the width of their box. A step that ends in a fall, a bad solve or a number
that is not finite is rejected: the weights go back and the step is halved.

Two results come out of one run: the weights after the paper's `ten` iterations, each accepted
unless it is refused, and the `converged` ones, for which steps that raise the loss are halved too
until nothing is gained any more.

The rule by which all that is decided is `init` and `update`, functions of arrays: `tune` asks them
from Python, one iteration after the other; `batch` compiles them into its loop on the device.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import TUNABLES, bounds
from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, short_repr, unknown
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, Range, check, from_table
from hector_jax.core.trajectory import Wrench
from hector_jax.core.tree import where
from hector_jax.robot.model import Robot
from hector_jax.tuning.evaluate import Evaluation, evaluate_jit
from hector_jax.tuning.loss import PAPER_LOSS, Loss, alphas, check_loss, with_alphas
from hector_jax.tuning.rollout import RolloutConfig
from hector_jax.tuning.status import StepStatus, Stop, status_text

PAPER_ITERATIONS = 10


@dataclass(frozen=True)
class TuneConfig:
    """How the weights are tuned."""

    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    loss: tuple = PAPER_LOSS  # of `LossTerm`
    beta_q: float = 0.05  # largest relative step of a weight in Q
    beta_r: float = 0.08  # and in R
    others: tuple[str, ...] = ()  # of `parameters.TUNABLES`, tuned beside Q and R
    beta_others: float = 0.02  # largest step of one, as a share of its box
    update: str = "relative"  # or "literal": the paper's theta - beta dL/dtheta
    tie_feet: bool = True  # one R for all feet, as the robot is its own mirror image
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
            beta_others=POSITIVE,
            update=("relative", "literal"),
            iterations=AT_LEAST_ONE,
            patience=AT_LEAST_ONE,
            gain=NOT_NEGATIVE,
            smallest_step=POSITIVE,
            residual=POSITIVE,
        )
        check_loss(self.loss)
        got = short_repr(self.others)
        if self.others and self.update != "relative":
            raise InputError(f"TuneConfig.others must be empty with update literal, got {got}")
        for name in self.others:
            if fault := _fault(self.rollout.walk, name):
                expected = "must be numbers that a gradient can tune"
                raise InputError(f"TuneConfig.others {expected}, got {got}: {fault}")

    def as_table(self) -> dict[str, Any]:
        """The settings as JSON values; of the loss its weights."""
        return asdict(replace(self, loss=PAPER_LOSS)) | {"loss": alphas(self.loss)}

    @classmethod
    def from_table(cls, where: str, table: Any, loss: Loss = PAPER_LOSS) -> "TuneConfig":
        """Settings of JSON values, with the terms of a loss.

        Raises:
            InputError: one line with `where`, for settings that there are not.
        """
        if not isinstance(table, dict) or not isinstance(table.get("loss", {}), dict):
            return from_table(where, cls, table)  # refuses it
        rest = {name: value for name, value in table.items() if name != "loss"}
        try:
            weighted = with_alphas(table.get("loss", {}), loss)
        except InputError as error:
            raise InputError(f"{where}: loss: {error}") from None
        return replace(from_table(where, cls, rest), loss=weighted)


def _fault(walk: WalkConfig, name: str) -> str:
    """Why a number cannot be tuned by the gradient of the rigid-body model; empty if it can."""
    if name not in TUNABLES:
        return unknown("tunable", name, TUNABLES)
    path, lower, upper, _ = TUNABLES[name]
    if path.startswith("legs."):
        return (
            f"{name} cannot be tuned by gradients: the rigid-body model has no joints, so its "
            "gradient is zero; a weights file can set it"
        )
    if path.startswith("footstep.") and walk.footstep.rule == "paper":
        return f"{name} has no part in the paper's rule"
    start, box = walk.with_others(nominal(), [name]).others[name], Range(lower, upper)
    return "" if start in box else f"{name} starts at {start}, expected {box}"


class TuneState(NamedTuple):
    """Where a tuning stands between two rollouts: the state of the rule."""

    trial: Weights  # to be evaluated next
    step_scale: Float[Array, "*batch"]  # of the full step that leads from `best` to `trial`
    iteration: Int[Array, "*batch"]  # of the trial; the start is 0
    best: Weights  # the last that were accepted
    loss: Float[Array, "*batch"]  # theirs
    gradient: Weights  # theirs
    recent: Float[Array, "*batch kept"]  # losses accepted last, newest first; NaN before the first
    ten: Weights  # best after at most the paper's ten iterations
    stop: Int[Array, "*batch"]  # a `Stop`


class Iteration(NamedTuple):
    """An iteration of a tuning; with leading axes, a history of them."""

    iteration: Int[Array, "*batch"]  # its number; the start is 0
    weights: Weights
    evaluation: Evaluation
    status: Int[Array, "*batch"]  # a `StepStatus`
    step_scale: Float[Array, "*batch"]  # of the full step that led here; 0 at the start

    @property
    def accepted(self) -> Any:
        """Whether the weights became the best so far."""
        return self.status == StepStatus.ACCEPTED

    @property
    def reason(self) -> str:
        """Why the weights of one iteration were rejected; empty when accepted."""
        return status_text(StepStatus(int(self.status)), self.evaluation)


class Tuning(NamedTuple):
    """A whole tuning."""

    history: list[Iteration]
    ten: Weights
    converged: Weights
    stop: str  # why it ended


def tune_step(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> Evaluation:
    """`evaluate` with the rollout and the loss of a tuning, compiled."""
    return evaluate_jit(config.rollout, robot, weights, command, anchor, effect, config.loss)


def relative_step(
    beta_q: float, beta_r: float, beta_others: float = 0.0
) -> optax.GradientTransformation:
    """Downhill in log-weights, the largest relative step being beta inside Q and inside R.

    Other numbers step by at most `beta_others` of the width of their box.
    """

    def scaled(tree: Any, sizes: Any, beta: float) -> Any:
        if not jax.tree.leaves(tree):
            return tree
        products = jax.tree.map(jnp.multiply, tree, sizes)
        largest = jnp.max(
            jnp.stack([jnp.max(jnp.abs(x), initial=0.0) for x in jax.tree.leaves(products)])
        )
        by = beta / jnp.where(largest > 0.0, largest, 1.0)
        return jax.tree.map(lambda x, size: -by * x * size, products, sizes)

    def update(updates: Any, state: optax.OptState, params: Any = None):
        gradient, weights = updates, params
        if weights is None:
            raise ValueError("relative_step needs the weights: pass params to update")
        widths = {name: TUNABLES[name].upper - TUNABLES[name].lower for name in weights.others}
        sizes = weights._replace(others=widths)
        return Weights(*map(scaled, gradient, sizes, (beta_q, beta_r, beta_others))), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


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
    """Weights after `step_scale` of a full step downhill, projected onto the box."""
    if config.tie_feet:
        gradient = gradient._replace(R=_mean_over_feet(gradient.R))
    zero = jax.tree.map(jnp.zeros_like, gradient.others)
    tuned = {name: gradient.others[name] for name in config.others}
    gradient = gradient._replace(others={**zero, **tuned})
    optimiser = _optimiser(config)
    updates, _ = optimiser.update(gradient, optimiser.init(weights), weights)
    moved = optax.apply_updates(weights, jax.tree.map(lambda u: step_scale * u, updates))
    return optax.projections.projection_box(moved, *bounds(weights.others, weights))


def step_status(config: TuneConfig, evaluation: Evaluation) -> Int[Array, ""]:
    """`StepStatus` of an evaluation by itself, whatever the loss was before."""
    # squares, because a gradient near the largest number overflows where a step is made of it
    squares = [jnp.square(x) for x in (evaluation.loss, *jax.tree.leaves(evaluation.gradient))]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in squares]))
    solved = jnp.asarray(evaluation.residual) <= config.residual
    reason = jnp.where(solved, StepStatus.ACCEPTED, StepStatus.UNSOLVED)
    reason = jnp.where(jnp.asarray(evaluation.fallen) > 0, StepStatus.FELL, reason)
    return jnp.where(finite, reason, StepStatus.NOT_FINITE).astype(jnp.int32)


def init(config: TuneConfig, weights: Weights, first: int = 0) -> TuneState:
    """A tuning before its first rollout, which is iteration `first`.

    With `tie_feet` all feet start from the geometric mean of their weights in R.
    """
    weights = config.rollout.walk.with_others(weights, config.others)
    weights = jax.tree.map(lambda w: jnp.asarray(w, float), weights)
    if config.tie_feet:
        equal = jnp.all(jnp.stack([jnp.all(w == w[:1]) for w in weights.R]))
        tied = jax.tree.map(jnp.exp, _mean_over_feet(jax.tree.map(jnp.log, weights.R)))
        # weights that are equal stay so to the last bit
        weights = weights._replace(R=where(equal, weights.R, tied))
    return TuneState(
        trial=weights,
        step_scale=jnp.asarray(1.0),
        iteration=jnp.asarray(first, jnp.int32),
        best=weights,
        loss=jnp.asarray(jnp.inf, float),  # typed as later ones, or `update` is compiled again
        gradient=jax.tree.map(jnp.zeros_like, weights),
        recent=jnp.full(config.patience + 1, jnp.nan, float),
        ten=weights,
        stop=jnp.asarray(Stop.GOING, jnp.int32),
    )


def update(
    config: TuneConfig, state: TuneState, evaluation: Evaluation
) -> tuple[TuneState, Iteration]:
    """Accept or reject the trial by its evaluation; returns the next state and the iteration.

    The first `PAPER_ITERATIONS` are accepted whatever the loss; later ones must lower it. A
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
    recent = jnp.append(jnp.asarray(evaluation.loss), state.recent[:-1])
    recent = if_accepted(recent, state.recent)
    scale = jnp.where(accepted, jnp.minimum(1.0, 2.0 * state.step_scale), state.step_scale / 2.0)

    little = recent[0] > (1 - config.gain) * recent[-1]  # false before there are enough
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
    led = jnp.where(start, 0.0, state.step_scale)
    return after, Iteration(iteration, state.trial, evaluation, status.astype(jnp.int32), led)


def rejection_reason(config: TuneConfig, evaluation: Evaluation) -> str:
    """Why an evaluation cannot be used; empty when it can."""
    return status_text(StepStatus(int(step_status(config, evaluation))), evaluation)


def stop_reason(config: TuneConfig, stop: Stop) -> str:
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
    evaluate: Callable[[Weights], Evaluation],
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
    first: int = 0,
) -> Tuning:
    """The rule, driven from Python: step down whatever loss `evaluate` finds.

    Args:
        config: how.
        weights: where to start.
        evaluate: loss and gradient of weights.
        on_iteration: called after each iteration.
        first: number of the first one; from the paper's ten on every step has to lower the loss.

    Raises:
        InputError: the starting weights were rejected; `on_iteration` was called before.
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
    words = stop_reason(config, stop)
    if stop == Stop.SMALL_STEP and rejection_reason(config, last.evaluation):
        words = f"{words}, the last refused: {last.reason}"
    ten, converged = jax.tree.map(np.asarray, (state.ten, state.best))
    return Tuning(history, ten, converged, words)
