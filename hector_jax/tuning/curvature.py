"""Which directions of the weights the loss feels: eigenvectors of its Gauss-Newton matrix.

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
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.robot.model import Robot
from hector_jax.tuning.loss import Loss, losses, total
from hector_jax.tuning.rollout import RolloutConfig, rollout

_MEMBER = 0.35  # least share of its largest entry that a weight has to be named in a direction
_UNFELT = 1e-3  # share of the loss by which doubling an unfelt weight changes it at most


class Direction(NamedTuple):
    """A direction in the log-weights."""

    change: float  # of the loss in second order where its weights double or halve, as a share
    steps: dict[str, float]  # by weight: entry of the unit vector

    @property
    def text(self) -> str:
        """The weights that matter in it, at most three a side: "`Q_pitch` against `Q_x`"."""
        ordered = sorted(self.steps, key=lambda name: -abs(self.steps[name]))
        largest = self.steps[ordered[0]]  # its side is named first
        shares = {name: self.steps[name] / largest for name in ordered}
        sides = ([n for n in ordered if s * shares[n] >= _MEMBER][:3] for s in (1.0, -1.0))
        return " against ".join(", ".join(f"`{n}`" for n in side) for side in sides if side)


class Felt(NamedTuple):
    """What of the weights the loss feels."""

    directions: list[Direction]  # the strongest first, as far as they are felt
    count: int  # of all directions
    unfelt: list[str]  # weights that change nothing by themselves


@partial(jax.jit, static_argnums=0)
def curvature(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    loss: Loss,
) -> tuple[Float[Array, ""], Float[Array, "n n"]]:
    """The loss of a rollout and its Gauss-Newton matrix in the n `directions` of the weights."""
    vector, along = weights_to_vector(weights), jnp.asarray(directions(weights))

    def walk(logs: Float[Array, " n"]) -> tuple[tuple[State, Wrench], Trajectory]:
        moved = vector_to_weights(vector * jnp.exp(logs @ along), weights)
        moved = moved._replace(others=weights.others)
        walked = rollout(config, robot, moved, command, anchor, effect)
        return (walked.state, walked.command), walked

    def move(direction: Float[Array, " n"]) -> tuple:
        still = jnp.zeros(len(along))
        return jax.jvp(walk, (still,), (direction,), has_aux=True)

    (at, tangents, walked) = jax.vmap(move, out_axes=(None, 0, None))(jnp.eye(len(along)))

    def objective(of: tuple[State, Wrench]) -> Float[Array, ""]:
        state, commands = of
        return total(loss, losses(loss, walked._replace(state=state, command=commands)))

    curved = jax.vmap(lambda tangent: jax.jvp(jax.grad(objective), (at,), (tangent,))[1])(tangents)
    flat = [
        jnp.concatenate([x.reshape(len(along), -1) for x in jax.tree.leaves(tree)], axis=1)
        for tree in (tangents, curved)
    ]
    return objective(at), flat[0] @ flat[1].T


def felt(matrix: Float[np.ndarray, "n n"], like: Weights) -> Felt:
    """What of the weights a loss feels, by its Gauss-Newton matrix as a share of the loss."""
    names, double = direction_names(like), 0.5 * np.log(2.0) ** 2
    sizes, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    strongest = [
        Direction(double * size, dict(zip(names, vector.tolist(), strict=True)))
        for size, vector in zip(sizes[::-1], vectors.T[::-1], strict=True)
        if double * size > _UNFELT
    ]
    alone = double * np.diag(matrix)
    return Felt(
        strongest, len(names), [n for n, x in zip(names, alone, strict=True) if x < _UNFELT]
    )
