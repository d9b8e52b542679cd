"""Directions of the weights that matter: eigenvectors of the loss's Gauss-Newton matrix.

The loss is nearly quadratic in a walk, so along a step s in the log-weights it is curved by
s' H s with H = J' (d2L / dw2) J, where w are the states and commands of the walk and J is their
derivative. A direction of H with a small eigenvalue changes neither walk nor loss.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import Anchor, Command
from hector_jax.control.weights import Weights, direction_names, scale_weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.robot.model import Robot
from hector_jax.tuning.loss import Loss, losses, total
from hector_jax.tuning.rollout import RolloutConfig, rollout

_NAMED = 0.35  # a direction is named by the weights of at least this share of its largest entry
_FLAT = 1e-3  # a direction or weight that changes the loss by less than this share does not matter


class Direction(NamedTuple):
    """A direction in the log-weights."""

    change: float  # share of the loss, to second order, for a step as long as doubling a weight
    steps: dict[str, float]  # entries of the unit vector, by name of the weight

    @property
    def text(self) -> str:
        """The weights that matter, at most three of each sign: "`Q_pitch` against `Q_x`"."""
        ordered = sorted(self.steps, key=lambda name: -abs(self.steps[name]))
        largest = self.steps[ordered[0]]  # its sign is named first
        shares = {name: self.steps[name] / largest for name in ordered}
        sides = ([n for n in ordered if s * shares[n] >= _NAMED][:3] for s in (1.0, -1.0))
        return " against ".join(", ".join(f"`{n}`" for n in side) for side in sides if side)


class Curvature(NamedTuple):
    """Curvature of the loss in the weights."""

    directions: list[Direction]  # that matter, the strongest first
    number: int  # of all directions
    flat: list[str]  # names of the weights that alone do not matter


@partial(jax.jit, static_argnums=0)
def gauss_newton(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    loss: Loss,
) -> tuple[Float[Array, ""], Float[Array, "n n"]]:
    """Return the loss of a rollout and its Gauss-Newton matrix.

    Args:
        config, robot, command, anchor, effect: of the rollout.
        weights: the point of evaluation.
        loss: terms and their weights.

    Returns:
        L, and the matrix in the n directions of `control.weights.directions`.
    """
    count = len(direction_names(weights))

    def walk(logs: Float[Array, " n"]) -> tuple[tuple[State, Wrench], Trajectory]:
        scaled = scale_weights(weights, logs)
        trajectory = rollout(config, robot, scaled, command, anchor, effect)
        return (trajectory.state, trajectory.command), trajectory

    def tangent_of(direction: Float[Array, " n"]) -> tuple:
        return jax.jvp(walk, (jnp.zeros(count),), (direction,), has_aux=True)

    point, tangents, trajectory = jax.vmap(tangent_of, out_axes=(None, 0, None))(jnp.eye(count))

    def objective(point: tuple[State, Wrench]) -> Float[Array, ""]:
        state, command = point
        return total(loss, losses(loss, trajectory._replace(state=state, command=command)))

    gradient = jax.grad(objective)
    products = jax.vmap(lambda tangent: jax.jvp(gradient, (point,), (tangent,))[1])(tangents)
    rows, columns = (
        jnp.concatenate([x.reshape(count, -1) for x in jax.tree.leaves(tree)], axis=1)
        for tree in (tangents, products)
    )
    return objective(point), rows @ columns.T


def main_directions(matrix: Float[np.ndarray, "n n"], like: Weights) -> Curvature:
    """Find the eigenvectors that matter of a Gauss-Newton matrix divided by the loss.

    Args:
        matrix: see `gauss_newton`.
        like: weights of its shape.
    """
    names, of_doubling = direction_names(like), 0.5 * np.log(2.0) ** 2
    eigenvalues, vectors = np.linalg.eigh(matrix)
    strongest = [
        Direction(change, dict(zip(names, vector.tolist(), strict=True)))
        for change, vector in zip(of_doubling * eigenvalues[::-1], vectors.T[::-1], strict=True)
        if change > _FLAT
    ]
    changes = zip(names, of_doubling * np.diag(matrix), strict=True)
    return Curvature(strongest, len(names), [name for name, change in changes if change < _FLAT])
