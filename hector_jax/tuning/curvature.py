"""The loss of a rollout as least squares: its slope, and the directions of the weights that matter.

The loss is a sum of squares of residuals, so along a step s in the log-weights it is curved by
s' H s with H = 2 J' J, where J is the derivative of the residuals. The directions are eigenvectors
of H: one with a small eigenvalue changes neither walk nor loss.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import Other, gradient_by_weights, stepped, steps_between
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Trajectory
from hector_jax.tuning.evaluate import Evaluation, Walk
from hector_jax.tuning.loss import Loss, losses, residuals
from hector_jax.tuning.rollout import RolloutConfig, rollout

_NAMED = 0.35  # a direction is named by the weights of at least this share of its largest entry
_FLAT = 1e-3  # a direction that changes the loss by less than this share does not matter


class Direction(NamedTuple):
    """A direction in the coordinates of a tuning."""

    change: float  # of the loss, to second order, for a step as long as doubling a weight
    fixed: float  # share of the precision that is the walk's; the rest is the ridge's
    steps: dict[str, float]  # entries of the unit vector, by name of the weight

    @property
    def text(self) -> str:
        """The weights that matter, at most three of each sign: "`Q_pitch` against `Q_x`"."""
        ordered = sorted(self.steps, key=lambda name: -abs(self.steps[name]))
        largest = self.steps[ordered[0]]  # its sign is named first
        shares = {name: self.steps[name] / largest for name in ordered}
        sides = ([n for n in ordered if s * shares[n] >= _NAMED][:3] for s in (1.0, -1.0))
        return " against ".join(", ".join(f"`{n}`" for n in side) for side in sides if side)


class Determined(NamedTuple):
    """What the walk of the model determines of the weights, and what it leaves to the ridge."""

    directions: list[Direction]  # that matter, the strongest first
    number: int  # of all directions
    # 1 - variance with the walk / variance of the ridge alone, of each weight
    weights: dict[str, float]

    @property
    def left_open(self) -> list[str]:
        """Names of the weights that the ridge determines more than the walk."""
        return [name for name, share in self.weights.items() if share < 0.5]


def least_squares(
    config: RolloutConfig,
    scenario: Any,
    weights: Weights,
    loss: Loss,
    *,
    walk: Walk = rollout,
    others: tuple[Other, ...] = (),
    columns: Float[Array | np.ndarray, "rows n"] | float = 0.0,
) -> tuple[Evaluation, Float[Array, "n n"]]:
    """Compute the loss, its gradient and its Gauss-Newton matrix in one program, in forward mode.

    With the residuals r and their derivative J these are r'r, 2 J'r and 2 J'J.

    Args:
        config, scenario, walk: of the rollout, see `evaluate`.
        weights: the point of evaluation; all feet share one R.
        loss: terms and their weights.
        others: numbers beside Q and R.
        columns: are added to J: derivatives by numbers that the model does not have.

    Returns:
        The evaluation, and the matrix in the n coordinates of `parameters.stepped`.
    """
    zero = jnp.zeros(len(steps_between(weights, weights, others)))
    config = replace(config, forward=True)

    def rows(steps: Float[Array, " n"]) -> tuple[Float[Array, " rows"], tuple[Array, Trajectory]]:
        trajectory = walk(config, scenario, stepped(weights, steps, others))
        r = residuals(loss, trajectory)
        return r, (r, trajectory)

    J, (r, trajectory) = jax.jacfwd(rows, has_aux=True)(zero)
    J = J + columns
    gradient = gradient_by_weights(weights, 2.0 * r @ J, others)
    fallen, residual = jnp.mean(1.0 * trajectory.fallen), jnp.max(trajectory.residual)
    found = Evaluation(r @ r, losses(loss, trajectory), gradient, fallen, residual)
    return found, 2.0 * J.T @ J


least_squares_jit = jax.jit(least_squares, static_argnums=0, static_argnames=("walk", "others"))
"""`least_squares`, compiled once per rollout and set of terms: new weights, commands, nets and
alphas need no compilation."""


def determined(
    precision: Float[Array | np.ndarray, "n n"], ridge: float, names: Sequence[str]
) -> Determined:
    """Find what a tuning knows about its weights.

    Args:
        precision: Gauss-Newton matrix by the loss at the start, plus the ridge on the diagonal; see
            `difftune.Tuning`.
        ridge: of the tuning.
        names: of the coordinates.

    Source: the Gaussian (Laplace) approximation of a posterior whose prior is the ridge.
    """
    of_doubling = 0.5 * np.log(2.0) ** 2
    eigenvalues, vectors = np.linalg.eigh(np.asarray(precision))
    curvatures = np.maximum(eigenvalues - ridge, 0.0)
    strongest = [
        Direction(
            of_doubling * curvature,
            curvature / (curvature + ridge),
            dict(zip(names, vector.tolist(), strict=True)),
        )
        for curvature, vector in zip(curvatures[::-1].tolist(), vectors.T[::-1], strict=True)
        if of_doubling * curvature > _FLAT
    ]
    smallest = max(1e-12 * eigenvalues[-1], np.finfo(float).tiny)
    variances = np.diag(vectors / np.maximum(eigenvalues, smallest) @ vectors.T)
    shares = np.clip(1.0 - ridge * variances, 0.0, 1.0).tolist()
    return Determined(strongest, len(names), dict(zip(names, shares, strict=True)))
