"""DiffTune: step the weights down the gradient of the closed loop, inside the box (P, Eq. 9).

theta <- P_Theta(theta - beta theta g), with g the gradient in log-weights, divided by its largest
magnitude inside Q and inside R: a weight moves by at most beta_Q or beta_R of itself, whatever the
size of the loss. A step that ends in a fall, a bad solve or a number that is not finite is refused:
the weights go back, the step is halved and the refusal is told.

Two results come out of one run: the weights after the paper's `ten` iterations, each accepted
unless it is refused, and the `converged` ones, for which steps that raise the loss are halved too
until nothing is gained any more.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights, bounds
from hector_jax.robot import Robot
from hector_jax.tuning.loss import LossConfig, Losses, losses, total
from hector_jax.tuning.rollout import RolloutConfig, rollout

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
        if self.update not in ("relative", "literal"):
            raise ValueError(
                f"TuneConfig.update must be 'relative' or 'literal', got {self.update!r}"
            )
        for name in ("beta_q", "beta_r", "residual", "smallest_step"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"TuneConfig.{name} must be positive, got {getattr(self, name)}")
        if self.iterations < 1 or self.patience < 1:
            raise ValueError("TuneConfig.iterations and patience must be at least 1")


class Evaluation(NamedTuple):
    """One rollout of a weight set on the model, with the gradient of its loss."""

    loss: Float[Array, "*batch"]
    parts: Losses
    gradient: Weights  # dL/dtheta
    fallen: Float[Array, "*batch"]  # share of the ticks after a fall
    residual: Float[Array, "*batch"]  # worst of the rollout


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
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> Evaluation:
    """Loss of a weight set on the model and its gradient, in one program. Source: Eq. 9, 11."""

    def objective(weights: Weights) -> tuple[Array, tuple]:
        trajectory = rollout(config.rollout, robot, weights, command, anchor, effect)
        parts = losses(trajectory)
        loss = total(config.loss, parts)
        return loss, (parts, jnp.mean(1.0 * trajectory.fallen), jnp.max(trajectory.residual))

    (loss, (parts, fallen, residual)), gradient = jax.value_and_grad(objective, has_aux=True)(
        weights
    )
    return Evaluation(loss, parts, gradient, fallen, residual)


tune_step = jax.jit(evaluate, static_argnums=0)
"""`evaluate`, compiled once per config: new weights, commands and nets need no compilation."""


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


def _tied(gradient: Weights) -> Weights:
    both = lambda g: jnp.broadcast_to(g.mean(axis=0), g.shape)  # noqa: E731
    return Weights(gradient.Q, jax.tree.map(both, gradient.R))


def step_weights(config: TuneConfig, weights: Weights, gradient: Weights, share: float) -> Weights:
    """Weights after `share` of a full step downhill, projected onto the box."""
    if config.tie_feet:
        gradient = _tied(gradient)
    optimiser = _optimiser(config)
    updates, _ = optimiser.update(gradient, optimiser.init(weights), weights)
    moved = optax.apply_updates(weights, jax.tree.map(lambda u: share * u, updates))
    return jax.tree.map(np.asarray, optax.projections.projection_box(moved, *bounds()))


def refusal(config: TuneConfig, evaluation: Evaluation) -> str:
    """Why an evaluation is not to be believed; empty when it is."""
    if not np.isfinite(evaluation.loss) or not all(
        np.isfinite(g).all() for g in jax.tree.leaves(evaluation.gradient)
    ):
        return "loss or gradient not finite"
    if evaluation.fallen > 0:
        return "the robot fell"
    if not evaluation.residual <= config.residual:
        return f"QP residual {float(evaluation.residual):.1e} above {config.residual:.0e}"
    return ""


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
        ValueError: the starting weights fall or cannot be solved on the model.

    Source: problem P and the paper's set-up (ten iterations, beta_Q 0.05, beta_R 0.08).
    """
    history: list[Iteration] = []

    def look(weights: Weights, step: float) -> Iteration:
        found = jax.tree.map(np.asarray, tune_step(config, robot, weights, command, anchor, effect))
        reason = refusal(config, found)
        return Iteration(len(history), weights, found, not reason, reason, step)

    def note(iteration: Iteration) -> None:
        history.append(iteration)
        on_iteration(iteration)

    best = look(jax.tree.map(np.asarray, weights), 0.0)
    if not best.accepted:
        raise ValueError(f"the starting weights cannot be tuned from: {best.reason}")
    note(best)
    share, stop, ten = 1.0, f"{config.iterations} iterations", best.weights
    for count in range(1, config.iterations + 1):
        tried = look(step_weights(config, best.weights, best.evaluation.gradient, share), share)
        if (
            tried.accepted
            and count > PAPER_ITERATIONS
            and not tried.evaluation.loss < best.evaluation.loss
        ):
            tried = tried._replace(accepted=False, reason="the loss rose")
        note(tried)
        if tried.accepted:
            best, share = tried, min(1.0, 2.0 * share)
        else:
            share /= 2.0
        if count <= PAPER_ITERATIONS:
            ten = best.weights
            continue
        if share < config.smallest_step:
            stop = "the step became too small to gain"
            break
        losses_then = [float(i.evaluation.loss) for i in history if i.accepted]
        window = losses_then[-config.patience - 1 :]
        if len(window) > config.patience and window[-1] > (1 - config.gain) * window[0]:
            stop = f"the loss fell by less than {config.gain:.1%} in {config.patience} iterations"
            break
    return Tuning(history, ten, best.weights, stop)


@partial(jax.jit, static_argnums=0)
def gradient_norms(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
) -> Losses:
    """Norms of the parts' gradients in log-weights, which the paper's footnote aligns."""

    def parts(weights: Weights) -> Losses:
        return losses(rollout(config.rollout, robot, weights, command, anchor, effect))

    def norm(gradient: Weights) -> Float[Array, ""]:
        logs = jax.tree.map(lambda g, w: g * w, gradient, weights)
        return jnp.sqrt(sum(jnp.sum(g**2) for g in jax.tree.leaves(logs)))

    return Losses(*(norm(gradient) for gradient in jax.jacrev(parts)(weights)))


def aligned(config: LossConfig, norms: Losses) -> LossConfig:
    """Loss weights that bring the three gradients to the order of that of L_ctrl (footnote)."""
    power = lambda ratio: float(10.0 ** np.round(np.log10(max(float(ratio), 1e-12))))  # noqa: E731
    return replace(
        config,
        euler=power(norms.control / norms.euler),
        position=power(norms.control / norms.position),
    )
