"""Which directions of the weights matter: eigenvectors of the loss's Gauss-Newton matrix.

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

_NAMED = 0.35  # least share of the largest entry with which a weight is named in a direction
_FLAT = 1e-3  # least share of the loss that a direction or a weight that matters changes


class Direction(NamedTuple):
    """A direction in the log-weights."""

    change: float  # share of the loss, in second order, after a step as long as a doubled weight's
    steps: dict[str, float]  # by weight: entry of the unit vector

    @property
    def text(self) -> str:
        """The weights that matter in it, at most three a side: "`Q_pitch` against `Q_x`"."""
        ordered = sorted(self.steps, key=lambda name: -abs(self.steps[name]))
        largest = self.steps[ordered[0]]  # its side is named first
        shares = {name: self.steps[name] / largest for name in ordered}
        sides = ([n for n in ordered if s * shares[n] >= _NAMED][:3] for s in (1.0, -1.0))
        return " against ".join(", ".join(f"`{n}`" for n in side) for side in sides if side)


class Curvature(NamedTuple):
    """How the loss is curved in the weights."""

    directions: list[Direction]  # those that matter, the strongest first
    number: int  # of all directions
    flat: list[str]  # weights that by themselves do not matter


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
    """The loss of a rollout and its Gauss-Newton matrix.

    Args:
        config, robot, command, anchor, effect: of the rollout.
        weights: at which it is taken.
        loss: terms and their weights.

    Returns:
        L, and the matrix in the n directions of `control.weights.directions`.
    """
    count = len(direction_names(weights))

    def walk(logs: Float[Array, " n"]) -> tuple[tuple[State, Wrench], Trajectory]:
        moved = scale_weights(weights, logs)
        walked = rollout(config, robot, moved, command, anchor, effect)
        return (walked.state, walked.command), walked

    def move(direction: Float[Array, " n"]) -> tuple:
        return jax.jvp(walk, (jnp.zeros(count),), (direction,), has_aux=True)

    at, tangents, walked = jax.vmap(move, out_axes=(None, 0, None))(jnp.eye(count))

    def objective(of: tuple[State, Wrench]) -> Float[Array, ""]:
        state, commands = of
        return total(loss, losses(loss, walked._replace(state=state, command=commands)))

    curved = jax.vmap(lambda tangent: jax.jvp(jax.grad(objective), (at,), (tangent,))[1])(tangents)
    changes, slopes = (
        jnp.concatenate([x.reshape(count, -1) for x in jax.tree.leaves(tree)], axis=1)
        for tree in (tangents, curved)
    )
    return objective(at), changes @ slopes.T


def main_directions(matrix: Float[np.ndarray, "n n"], like: Weights) -> Curvature:
    """The eigenvectors that matter of a Gauss-Newton matrix divided by the loss.

    Args:
        matrix: see `gauss_newton`.
        like: weights of its shape.
    """
    names, doubled = direction_names(like), 0.5 * np.log(2.0) ** 2
    sizes, vectors = np.linalg.eigh(matrix)
    strongest = [
        Direction(doubled * size, dict(zip(names, vector.tolist(), strict=True)))
        for size, vector in zip(sizes[::-1], vectors.T[::-1], strict=True)
        if doubled * size > _FLAT
    ]
    alone = zip(names, doubled * np.diag(matrix), strict=True)
    return Curvature(strongest, len(names), [name for name, change in alone if change < _FLAT])
