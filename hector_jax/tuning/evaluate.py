"""Loss of a weight set on the model and its gradient, by reverse mode (Eq. 9, 11)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.weights import Weights, weights_to_vector
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, unknown
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import stack
from hector_jax.tuning.loss import Loss, Terms, losses, total, with_alphas
from hector_jax.tuning.rollout import RolloutConfig, rollout

Walk = Callable[[RolloutConfig, Any, Weights], Trajectory]
"""`rollout`, or another walk on the model by its settings, what it walks, and weights."""


class Evaluation(NamedTuple):
    """Loss of a weight set on the model, its gradient, and the checks of the rollout."""

    loss: Float[Array, "*batch"]
    terms: Terms  # unweighted
    gradient: Weights  # dL/dtheta
    fallen: Float[Array, "*batch"]  # share of the ticks after a fall
    # largest of a QP; infinite if a solution is not unique or `parallel_rollout` did not converge
    residual: Float[Array, "*batch"]


def evaluate(
    config: RolloutConfig, scenario: Any, weights: Weights, loss: Loss, *, walk: Walk = rollout
) -> Evaluation:
    """Compute the loss of a weight set on the model and its gradient, in one program.

    Args:
        config, weights: see `rollout`.
        scenario: what is walked: a `Scenario`, or a `Grounding` by `grounded_rollout`.
        loss: terms and their weights.
        walk: `rollout`; `parallel_rollout` on a GPU with few rollouts; or `grounded_rollout`.

    Source: Eq. 9, 11.
    """

    def objective(weights: Weights) -> tuple[Array, tuple]:
        trajectory = walk(config, scenario, weights)
        terms = losses(loss, trajectory)
        checks = jnp.mean(1.0 * trajectory.fallen), jnp.max(trajectory.residual)
        return total(loss, terms), (terms, *checks)

    value_and_grad = jax.value_and_grad(objective, has_aux=True)
    (value, (terms, fallen, residual)), gradient = value_and_grad(weights)
    return Evaluation(value, terms, gradient, fallen, residual)


evaluate_jit = jax.jit(evaluate, static_argnums=0, static_argnames="walk")
"""`evaluate`, compiled once per rollout and set of terms: new weights, commands, nets and alphas
need no compilation."""


class Objective(NamedTuple):
    """What a tuning minimises."""

    # the evaluation of a weight set, and its Gauss-Newton matrix (n, n) in the steps of the tuning;
    # None for a rule that uses none
    slope: Callable[[Weights], tuple[Evaluation, Any]]
    # takes the state of a tuning to the point that is evaluated, if that is given
    place: Callable[[Any], Any] = lambda state: state


def mean_objective(
    slopes: Callable[[Weights], Sequence[tuple[Evaluation, Any]]],
    losses: Float[np.ndarray, " n"] | None = None,
) -> Objective:
    """Return the mean of several objectives, given by all their slopes.

    Each is divided by its share of the losses, those at the start, so that all have equal
    influence; without losses all count as they are. `fallen` and `residual` are the worst.
    """

    def mean(trees: Sequence[Any]) -> Any:
        scales = np.ones(len(trees)) if losses is None else losses / losses.mean()
        scaled = [jax.tree.map(lambda x, k=k: x / k, t) for t, k in zip(trees, scales, strict=True)]
        return jax.tree.map(lambda x: np.mean(x, axis=0), stack(scaled))

    def slope(weights: Weights) -> tuple[Evaluation, Any]:
        found = jax.device_get(slopes(weights))
        evaluation, matrix = mean(found)
        worst = {n: np.max([getattr(e, n) for e, _ in found]) for n in ("fallen", "residual")}
        return evaluation._replace(**worst), matrix

    return Objective(slope)


def gradient_norms(
    evaluate: Callable[[Loss], Evaluation], weights: Weights, loss: Loss
) -> dict[str, float]:
    """Return the norm of each term's gradient in log-weights, without its alpha.

    Args:
        evaluate: evaluates the weights by a loss.
        weights, loss: whose gradients are meant.
    """

    def norm(name: str) -> float:
        single = tuple(term._replace(weight=float(term.name == name)) for term in loss)
        logs = jax.tree.map(jnp.multiply, evaluate(single).gradient, weights)
        return float(jnp.linalg.norm(weights_to_vector(logs)))

    return {term.name: norm(term.name) for term in loss}


def aligned(loss: Loss, norms: Mapping[str, float]) -> Loss:
    """Weigh the terms so that their gradients have the order of that of one (footnote of Eq. 11).

    That one, which keeps its weight, is L_ctrl, or the last if the loss has none.

    Args:
        loss: terms and weights.
        norms: of the gradient of each term, see `gradient_norms`.

    Raises:
        InputError: a term has no norm.
    """
    weights = {term.name: term.weight for term in loss}
    to = "L_ctrl" if "L_ctrl" in weights else loss[-1].name
    for name in weights:
        if name not in norms:
            raise InputError(unknown("term of the loss", name, norms))

    def weight(norm: float) -> float:
        ratio = norms[to] / max(norm, 1e-12 * norms[to])
        return weights[to] * float(10.0 ** np.round(np.log10(max(ratio, 1e-12))))

    return with_alphas({name: weight(norm) for name, norm in norms.items() if name != to}, loss)
