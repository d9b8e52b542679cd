"""DiffTune: step the weights by the derivative of the closed loop, inside the box (P, Eq. 9).

A tuning moves in coordinates z: log-steps of the weights from the start, all feet sharing one R,
and steps of other numbers of the controller (`TuneConfig.others`) as shares of their box. A rule of
`step_rules` makes the steps. The default, `gauss_newton`, minimises

    L(z) / L(0) + ridge / 2 |z|^2

by Gauss-Newton steps in a trust region, in about ten evaluations; `relative` and `literal` are the
paper's gradient steps. A step that ends in a fall, a bad solve or a number that is not finite is
refused, and so is one that gains less than a hundredth of what was predicted; the next is shorter.

`init` and `update` are pure functions of arrays: `tune` calls them from Python, once per
iteration; `batch` compiles them into its loop on the device.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float, Int

from hector_jax.control import parameters
from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import Other
from hector_jax.control.weights import Weights, directions, nominal, weights_to_vector
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, plural, short_repr, unknown
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, check, to_table
from hector_jax.core.trajectory import Wrench
from hector_jax.core.tree import stack, where
from hector_jax.tuning import step_rules
from hector_jax.tuning.curvature import least_squares_jit
from hector_jax.tuning.evaluate import Evaluation, Objective, evaluate_jit
from hector_jax.tuning.loss import PAPER_LOSS, alphas, check_loss
from hector_jax.tuning.rollout import RolloutConfig, Scenario
from hector_jax.tuning.status import StepStatus, Stop, status_text
from hector_jax.tuning.step_rules import StepState

SMALLEST_STEP = 1 / 128
"""Share of the full gradient step below which a tuning ends."""
SMALLEST_REGION = 1 / 100
"""Radius [e-folds] below which a tuning ends: the loss is rougher than its gain."""


@dataclass(frozen=True)
class TuneConfig:
    """Settings of a tuning."""

    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    loss: tuple = PAPER_LOSS  # of `LossTerm`
    others: tuple[Other, ...] = ()  # numbers that are tuned with Q and R
    rule: str = "gauss_newton"  # or the paper's: "relative", "literal" (theta - beta dL/dtheta)
    # of "gauss_newton": share of the loss at the start, for e-folds of |z|^2 = 2
    ridge: Annotated[float, NOT_NEGATIVE] = 0.003
    # share of the objective that a step of one e-fold must be predicted to gain
    least_gain: Annotated[float, NOT_NEGATIVE] = 5e-3
    # of the paper's rules: largest relative step of a weight in Q, in R
    beta_q: Annotated[float, POSITIVE] = 0.05
    beta_r: Annotated[float, POSITIVE] = 0.08
    beta_others: Annotated[float, POSITIVE] = 0.02  # largest step of the others, share of their box
    iterations: Annotated[int, AT_LEAST_ONE] = 10  # at most
    # largest accepted relative KKT residual: that of a solved QP
    residual: Annotated[float, POSITIVE] = 1e-8

    def __post_init__(self) -> None:
        check(self, rule=("gauss_newton", "relative", "literal"))
        check_loss(self.loss)
        got = short_repr(self.others)
        if self.others and self.rule == "literal":
            raise InputError(f"TuneConfig.others must be empty with the rule literal, got {got}")
        for name in (x for x in self.others if isinstance(x, str)):
            if reason := _why_not_tunable(self.rollout.walk, name):
                expected = "must be numbers that a gradient can tune"
                raise InputError(f"TuneConfig.others {expected}, got {got}: {reason}")

    def as_table(self) -> dict[str, Any]:
        """Return the settings as JSON values; of the loss only its weights."""
        return to_table(replace(self, loss=PAPER_LOSS)) | {"loss": alphas(self.loss)}


def _why_not_tunable(walk: WalkConfig, name: str) -> str:
    """Return why gradients of the rigid-body model cannot tune a number; empty if they can."""
    costs = [f"{parameters.COST}{cost}" for cost in walk.mpc.costs]
    if name not in (*parameters.TUNABLES, *costs):
        return unknown("tunable", name, (*parameters.TUNABLES, *costs))
    tunable = parameters.tunable(name)
    if tunable.of_legs:
        return (
            f"{name} cannot be tuned by gradients: the rigid-body model has no joints, so its "
            "gradient is zero; a weights file can set it"
        )
    if name in ("position_limit", "yaw_limit", "integral_limit"):
        return (
            f"{name} cannot be tuned by gradients: what it limits is mostly below it in rollouts, "
            "so that its gradient is mostly zero; a weights file can set it"
            + " and so does --safe"
            * (name == "position_limit")
        )
    if tunable.path.startswith("footstep.") and walk.footstep.rule == "paper":
        return f"{name} has no part in the paper's rule"
    return parameters.out_of_box(name, walk.with_others(nominal(), [name]).others[name])


class TuneState(NamedTuple):
    """State of a tuning between two rollouts."""

    start: Weights
    steps: Float[Array, "*batch n"]  # z, to be evaluated next
    rule: StepState  # holds the last accepted point
    iteration: Int[Array, "*batch"]  # number of the trial; the start is 0
    stop: Int[Array, "*batch"]  # a `Stop`


class Iteration(NamedTuple):
    """An iteration of a tuning; with leading axes, a history of iterations."""

    iteration: Int[Array, "*batch"]  # number; the start is 0
    weights: Weights
    evaluation: Evaluation
    status: Int[Array, "*batch"]  # a `StepStatus`
    # radius of the trust region [e-folds], or share of the full step, to these weights; 0 at first
    step_size: Float[Array, "*batch"]

    @property
    def accepted(self) -> Any:
        """True if the weights were accepted."""
        return self.status == StepStatus.ACCEPTED

    @property
    def reason(self) -> str:
        """Reason of the rejection; empty if accepted."""
        return status_text(StepStatus(int(self.status)), self.evaluation)


class Tuning(NamedTuple):
    """Result of a tuning, or with a leading axis of a batch of tunings."""

    weights: Weights  # of the last accepted iteration
    loss: Float[Array, "*batch"]  # there; infinite if the start was rejected
    precision: Float[Array, "*batch n n"]  # matrix / loss at the start + ridge, there
    stop: Int[Array, "*batch"]  # a `Stop`
    history: Iteration  # (*batch, iterations + 1); in a batch zero after the end

    @property
    def iterations(self) -> list[Iteration]:
        """The iterations of a single tuning, the start first."""
        count = len(self.history.iteration)
        return [jax.tree.map(lambda x, i=i: np.asarray(x[i]), self.history) for i in range(count)]

    @property
    def reason(self) -> str:
        """Why a single tuning ended."""
        return {
            Stop.GOING: "not ended",
            Stop.LIMIT: plural(len(self.history.iteration) - 1, "iteration"),
            Stop.SMALL_STEP: "the step became too small to gain",
            Stop.NO_GAIN: "a step of one e-fold was predicted to gain too little",
            Stop.BAD_START: "the starting weights were refused",
        }[Stop(int(self.stop))]


def tune_step(config: TuneConfig, scenario: Scenario, weights: Weights) -> Evaluation:
    """Evaluate weights with the rollout and the loss of a tuning, compiled."""
    return evaluate_jit(config.rollout, scenario, weights, config.loss)


def model_slope(
    config: TuneConfig, scenario: Scenario, weights: Weights
) -> tuple[Evaluation, Float[Array, "n n"] | None]:
    """Return what a tuning on the model steps by, compiled; see `evaluate.Objective`.

    By the default rule it is one program: all derivatives of a rollout in forward mode take one and
    a half times as long as its gradient in reverse mode.
    """
    if config.rule != "gauss_newton":
        return tune_step(config, scenario, weights), None
    return least_squares_jit(config.rollout, scenario, weights, config.loss, others=config.others)


def step_rule(config: TuneConfig, start: Weights) -> optax.GradientTransformationExtraArgs:
    """Return the transformation of the rule of a config; see `step_rules`."""
    if config.rule == "gauss_newton":
        return step_rules.trust_region(config.ridge)
    names = parameters.step_names(start, config.others)
    blocks = np.array([0 if n.startswith("Q_") else 1 if n.startswith("R_") else 2 for n in names])
    betas = np.array([config.beta_q, config.beta_r, config.beta_others])[blocks]
    if config.rule == "relative":
        return step_rules.relative(betas, blocks)
    shared = directions(start)
    return step_rules.literal(betas, shared @ jnp.square(weights_to_vector(start)))


def init(config: TuneConfig, weights: Weights) -> TuneState:
    """Return the state before the first rollout.

    All feet start from the geometric mean of their weights in R.
    """
    weights = config.rollout.walk.with_others(weights, config.others)
    weights = jax.tree.map(lambda w: jnp.asarray(w, float), weights)
    equal = jnp.all(jnp.stack([jnp.all(w == w[:1]) for w in weights.R]))
    mean_over_feet = lambda x: jnp.broadcast_to(x.mean(axis=0), x.shape)  # noqa: E731
    tied = jax.tree.map(lambda w: jnp.exp(mean_over_feet(jnp.log(w))), weights.R)
    # equal weights stay equal to the last bit
    weights = weights._replace(R=Wrench(*where(equal, weights.R, tied)))
    zero = jnp.zeros(len(parameters.step_names(weights, config.others)))
    count = jnp.asarray(0, jnp.int32)
    rule = cast(StepState, step_rule(config, weights).init(zero))
    return TuneState(weights, zero, rule, count, jnp.asarray(Stop.GOING, jnp.int32))


def trial_weights(config: TuneConfig, state: TuneState) -> Weights:
    """Return the weights that are to be evaluated next."""
    return parameters.weights_after(state.start, state.steps, config.others)


def step_status(config: TuneConfig, evaluation: Evaluation) -> Int[Array, ""]:
    """Return the `StepStatus` of an evaluation, without comparing its loss to others."""
    # squares, because a gradient near the largest number overflows in the step
    squares = [jnp.square(x) for x in (evaluation.loss, *jax.tree.leaves(evaluation.gradient))]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in squares]))
    solved = jnp.asarray(evaluation.residual) <= config.residual
    status = jnp.where(solved, StepStatus.ACCEPTED, StepStatus.UNSOLVED)
    status = jnp.where(jnp.asarray(evaluation.fallen) > 0, StepStatus.FELL, status)
    return jnp.where(finite, status, StepStatus.NOT_FINITE).astype(jnp.int32)


def trial_status(config: TuneConfig, state: TuneState, evaluation: Evaluation) -> Int[Array, ""]:
    """Return the `StepStatus` of the trial of a state, of which this is the evaluation."""
    status = step_status(config, evaluation)
    if config.rule != "gauss_newton":
        return status
    ratio = step_rules.gain_ratio(
        config.ridge, state.rule, state.steps, jnp.asarray(evaluation.loss)
    )
    little = jnp.isfinite(state.rule.value) & ~(ratio > step_rules.LEAST)
    return jnp.where((status == StepStatus.ACCEPTED) & little, StepStatus.NO_GAIN, status)


def update(
    config: TuneConfig,
    state: TuneState,
    evaluation: Evaluation,
    matrix: Float[Array | np.ndarray, "n n"],
) -> tuple[TuneState, Iteration]:
    """Accept or reject the trial by its evaluation; return the next state and the iteration.

    Args:
        config: the settings.
        state: from `init` or the iteration before.
        evaluation: of the trial, `trial_weights(config, state)`.
        matrix: Gauss-Newton matrix at the trial; not used if that is rejected.
    """
    iteration, begun = state.iteration, jnp.isfinite(state.rule.value)
    status = trial_status(config, state, evaluation)
    sound = (status != StepStatus.ACCEPTED) | jnp.all(jnp.isfinite(matrix))
    status = jnp.where(sound, status, StepStatus.NOT_FINITE)
    usable = (status == StepStatus.ACCEPTED) | (status == StepStatus.NO_GAIN)
    value = jnp.where(usable, evaluation.loss, jnp.inf)
    rule, trial = step_rule(config, state.start), trial_weights(config, state)
    gradient = parameters.gradient_by_steps(trial, evaluation.gradient, config.others)
    box = low, high = parameters.step_bounds(state.start, config.others)
    given = {"value": value, "matrix": matrix, "box": box}
    updates, after = rule.update(gradient, state.rule, state.steps, **given)
    after = cast(StepState, after)
    steps = optax.projections.projection_box(optax.apply_updates(state.steps, updates), low, high)

    stop = jnp.where(iteration >= config.iterations, Stop.LIMIT, Stop.GOING)
    if config.rule == "gauss_newton":
        step = step_rules.boxed_step(config.ridge, after, box, 1.0)
        gain = step_rules.predicted_gain(config.ridge, after, after.steps + step)
        least = config.least_gain * step_rules.objective(
            config.ridge, after, after.steps, after.value
        )
        stop = jnp.where(after.size < SMALLEST_REGION, Stop.SMALL_STEP, stop)
        stop = jnp.where(~(gain >= least), Stop.NO_GAIN, stop)
    else:
        stop = jnp.where(after.size < SMALLEST_STEP, Stop.SMALL_STEP, stop)
    stop = jnp.where(~begun & (status != StepStatus.ACCEPTED), Stop.BAD_START, stop)
    step_size = jnp.where(begun, state.rule.size, 0.0)
    after = TuneState(state.start, steps, after, iteration + 1, stop.astype(jnp.int32))
    return after, Iteration(iteration, trial, evaluation, status, step_size)


_update = jax.jit(update, static_argnums=0)


def result(config: TuneConfig, state: TuneState, history: Iteration) -> Tuning:
    """Return the result of a tuning from its last state and its iterations."""
    rule = state.rule
    weights = parameters.weights_after(state.start, rule.steps, config.others)
    precision = rule.matrix / rule.first + config.ridge * jnp.eye(len(rule.steps))
    return Tuning(weights, rule.value, precision, state.stop, history)


def tune(
    config: TuneConfig,
    scenario: Scenario,
    weights: Weights,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Tuning:
    """Tune the weights on the model.

    Args:
        config: the settings.
        scenario: the model, see `rollout`.
        weights: the start.
        on_iteration: called after each iteration; the start is iteration 0.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model.

    Source: problem P.
    """
    objective = Objective(partial(model_slope, config, scenario))
    return descend(config, weights, objective, on_iteration)


def descend(
    config: TuneConfig,
    weights: Weights,
    objective: Objective,
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Tuning:
    """Minimise an objective by the rule of a tuning, as a loop in Python.

    Args:
        config: the settings.
        weights: the start.
        objective: its slope is taken at each trial.
        on_iteration: called after each iteration.

    Raises:
        InputError: the starting weights are outside the box, or are rejected, after a call of
            `on_iteration`.
    """
    history: list[Iteration] = []
    state, static = init(config, weights), replace(config, loss=PAPER_LOSS)  # one program for all
    parameters.check_in_box(state.start, config.others)
    while state.stop == Stop.GOING:
        state = objective.place(state)
        # copies, because a view would keep the device's array for as long as the history
        trial = jax.tree.map(np.array, trial_weights(config, state))
        evaluation, matrix = jax.tree.map(np.array, objective.slope(trial))
        matrix = matrix if config.rule == "gauss_newton" else state.rule.matrix
        state, iteration = _update(static, state, evaluation, matrix)
        history.append(jax.tree.map(np.array, iteration))
        on_iteration(history[-1])
    return single(result(config, state, stack(history)))


def single(tuning: Tuning) -> Tuning:
    """Return a tuning, which may be one of a batch, with the iterations up to its end.

    Raises:
        InputError: its start was rejected.
    """
    found = jax.tree.map(np.asarray, tuning)
    count = 1 + int(np.max(found.history.iteration))
    found = found._replace(history=jax.tree.map(lambda x: x[:count], found.history))
    start = found.iterations[0]
    check_start(StepStatus(int(start.status)), start.evaluation)
    return found


def check_start(status: StepStatus, evaluation: Evaluation) -> None:
    """Raise an InputError with the reason if the start of a tuning is rejected."""
    if reason := status_text(status, evaluation):
        raise InputError(
            f"the starting weights cannot be tuned from: {reason} (try a slower or "
            "shorter trajectory, another gait, or other weights as the start)"
        )
