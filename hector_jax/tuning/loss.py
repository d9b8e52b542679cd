"""Tracking and smoothness of a walk as one number (Eq. 11), the same in every world.

    L = alpha_1 sum |e - e_ref|^2 + alpha_2 sum |p - p_ref|^2 + sum |u_j - u_{j-1}|^2

over 1 kHz samples. A loss is a tuple of terms, each a weight alpha and the residuals of a walk
whose squares are summed; `PAPER_LOSS` has the three of the paper, and the commands use it with the
robot's own weights. A term that is added to it appears in gradients, logs, tables and files by its
name; functions in Python take any such tuple (docs/howto/loss.md).

A world with longer ticks multiplies its tracking sums by the milliseconds of a tick; the smoothness
term sums the changes of the held command. After a fall every missing sample counts the larger of
the last error and a minimum, and the smoothness term ends. The minimum error in position is the
height of the reference, so that it grows with the robot.

The terms grow with the robot: L_pos with the square of its height, L_ctrl with that of its weight.
A robot's description may weigh them otherwise (`loss_of_robot`).
"""

from collections.abc import Callable, Mapping
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_z
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError, short_repr, unknown
from hector_jax.core.settings import NOT_NEGATIVE, convert
from hector_jax.core.trajectory import State, Trajectory
from hector_jax.robot.description import Description

SAMPLE = 1e-3  # [s] period of the paper's sums
FALL_POSITION = 0.5  # [m] minimum error after a fall, if the height is less
FALL_EULER = 0.8  # [rad] minimum error after a fall
FALL_VELOCITY, FALL_RATE = 1.0, 1.0  # [m/s], [rad/s] minimum errors after a fall


class LossTerm(NamedTuple):
    """A term of the loss.

    As a pytree it has one leaf, its weight: another weight needs no compilation, another function
    does.
    """

    name: str  # "L_Eul": in tables, logs and files; begins with L_
    unit: str  # "rad^2"
    weight: float  # alpha; an array in a batch
    # residuals of one walk, of any shape: the unweighted term is the sum of their squares
    of: Callable[[Trajectory], Float[Array, "..."]]

    def __repr__(self) -> str:
        # identifies it in keys of stored results
        of = function_id(self.of)
        return f"LossTerm({self.name!r}, {self.unit!r}, {self.weight!r}, {of})"


jax.tree_util.register_pytree_node(
    LossTerm,
    lambda term: ((term.weight,), (term.name, term.unit, term.of)),
    lambda static, weight: LossTerm(static[0], static[1], weight[0], static[2]),
)

Loss = tuple[LossTerm, ...]
"""The loss of a walk is the sum of these terms, each times its weight."""

Terms = Mapping[str, Float[Array, "*batch"]]
"""Values of the terms of a loss, by name."""


def _tracking(
    trajectory: Trajectory, error: Float[Array, "T 3"], minimum: float | Float[Array, " T"]
) -> Float[Array, "T 3"]:
    """Return an error for sums over 1 kHz samples; after a fall the last, at least a minimum."""
    fallen = trajectory.fallen
    last = jnp.maximum(jnp.sum(~fallen) - 1, 0)
    square = jnp.sum(jnp.where(fallen[last], 0.0, error[last]) ** 2)
    charged = jnp.sqrt(jnp.maximum(square, minimum**2)) * jnp.ones(len(fallen))
    after = charged[:, None] * jnp.array([1.0, 0.0, 0.0])
    return jnp.sqrt(trajectory.period / SAMPLE) * jnp.where(fallen[:, None], after, error)


def euler_error(trajectory: Trajectory) -> Float[Array, "T 3"]:
    """Return the error of roll, pitch and yaw [rad] for sums over 1 kHz samples."""
    error = trajectory.state.euler - trajectory.reference.euler
    return _tracking(trajectory, error, FALL_EULER)


def position_error(trajectory: Trajectory) -> Float[Array, "T 3"]:
    """Return the error of the centre of mass [m] for sums over 1 kHz samples."""
    error = trajectory.state.position - trajectory.reference.position
    minimum = jnp.maximum(trajectory.reference.position[..., 2], FALL_POSITION)
    return _tracking(trajectory, error, minimum)


def command_changes(trajectory: Trajectory) -> Float[Array, "changes feet 6"]:
    """Return the changes of the commanded wrench [N and N m]; none after a fall."""
    changes = jnp.diff(jnp.concatenate(trajectory.command, axis=-1), axis=0)
    return jnp.where(trajectory.fallen[1:, None, None], 0.0, changes)


def _switched(trajectory: Trajectory) -> Bool[Array, "changes 1 1"]:
    contact = trajectory.contact
    return jnp.any(contact[1:] != contact[:-1], axis=-1)[:, None, None]


def changes_between(trajectory: Trajectory) -> Float[Array, "changes feet 6"]:
    """Return the changes of the command between switches of stance."""
    return jnp.where(_switched(trajectory), 0.0, command_changes(trajectory))


def tilt_error(trajectory: Trajectory) -> Float[Array, "T 3"]:
    """Return the error of roll and pitch [rad] for sums over 1 kHz samples."""
    error = trajectory.state.euler - trajectory.reference.euler
    return _tracking(trajectory, error * jnp.array([1.0, 1.0, 0.0]), FALL_EULER)


def height_error(trajectory: Trajectory) -> Float[Array, "T 3"]:
    """Return the error of the height [m] for sums over 1 kHz samples."""
    error = trajectory.state.position - trajectory.reference.position
    return _tracking(trajectory, error * jnp.array([0.0, 0.0, 1.0]), FALL_POSITION)


def velocity_error(trajectory: Trajectory) -> Float[Array, "T 3"]:
    """Return the error of the velocity ahead and aside [m/s] for sums over 1 kHz samples.

    Each velocity is seen along its own yaw, so that it does not matter where the robot is.
    """

    def along_yaw(state: State) -> Float[Array, "T 3"]:
        return jnp.einsum("tji,tj->ti", jax.vmap(rot_z)(state.euler[:, 2]), state.velocity)

    error = along_yaw(trajectory.state) - along_yaw(trajectory.reference)
    return _tracking(trajectory, error * jnp.array([1.0, 1.0, 0.0]), FALL_VELOCITY)


def yaw_rate_error(trajectory: Trajectory) -> Float[Array, "T 3"]:
    """Return the error of the yaw rate [rad/s] for sums over 1 kHz samples."""
    error = trajectory.state.ang_velocity - trajectory.reference.ang_velocity
    return _tracking(trajectory, error * jnp.array([0.0, 0.0, 1.0]), FALL_RATE)


PAPER_LOSS: Loss = (
    LossTerm("L_Eul", "rad^2", 1e5, euler_error),
    LossTerm("L_pos", "m^2", 2e5, position_error),
    LossTerm("L_ctrl", "N^2, (N m)^2", 1.0, command_changes),
)
"""The loss of the paper. Source: Eq. 11."""

OPTIONAL_TERMS: Loss = (
    LossTerm("L_tilt", "rad^2", 0.0, tilt_error),
    LossTerm("L_height", "m^2", 0.0, height_error),
    LossTerm("L_vel", "m^2/s^2", 0.0, velocity_error),
    LossTerm("L_yaw_rate", "rad^2/s^2", 0.0, yaw_rate_error),
)
"""Terms that a robot's description may have in place of the paper's, for a controller whose
reference starts at the robot in each plan: it knows how upright, how high and how fast it should
be, but neither where nor which way it should face."""


def losses(loss: Loss, trajectory: Trajectory) -> Terms:
    """Compute the unweighted terms of the loss of a walk. Source: Eq. 11."""
    trajectory = jax.tree.map(jnp.asarray, trajectory)  # the simulators return NumPy arrays
    return {term.name: jnp.sum(term.of(trajectory) ** 2) for term in loss}


def residuals(loss: Loss, trajectory: Trajectory) -> Float[Array, " rows"]:
    """Return the residuals of a walk, whose squares sum to its loss."""
    rows = [jnp.sqrt(term.weight) * jnp.ravel(term.of(trajectory)) for term in loss]
    return jnp.concatenate(rows)


def switch_loss(trajectory: Trajectory) -> Float[Array, ""]:
    """Compute the part of L_ctrl at changes of stance: about 2 (m g)^2 each for all weights."""
    trajectory = jax.tree.map(jnp.asarray, trajectory)
    changes = jnp.where(_switched(trajectory), command_changes(trajectory), 0.0)
    return jnp.sum(changes**2)


def total(loss: Loss, terms: Mapping[str, Any]) -> Float[Array, "*batch"]:
    """Sum the weighted terms to L. Source: Eq. 11.

    >>> total(PAPER_LOSS, {"L_Eul": 1.0, "L_pos": 2.0, "L_ctrl": 3e5}).item()
    800000.0
    """
    return jnp.asarray(reduce(add, (term.weight * terms[term.name] for term in loss)))


@jax.jit
def loss_of(loss: Loss, trajectory: Trajectory) -> Float[Array, ""]:
    """Compute L of a walk. Source: Eq. 11."""
    return total(loss, losses(loss, trajectory))


def check_loss(loss: Any) -> None:
    """Check the terms of a loss.

    Raises:
        InputError: no term, two terms of one name, a name that does not begin with `L_`, or a
            weight that is negative or not finite.
    """
    what = "TuneConfig.loss"
    if not all(isinstance(term, LossTerm) for term in loss):
        raise InputError(f"{what} must be a tuple of LossTerm, got {short_repr(loss)}")
    names = [term.name for term in loss]
    if not names or len(set(names)) < len(names) or not all(n.startswith("L_") for n in names):
        raise InputError(
            f"{what} must have terms of unlike names L_..., got {short_repr(tuple(names))}"
        )
    for term in loss:
        convert(term.weight, float, NOT_NEGATIVE, f"{what}: {term.name}")


_KEYS = {"L_Eul": "euler", "L_pos": "position"}  # keys of the weights in files


def alphas(loss: Loss) -> dict[str, float]:
    """Return the weights of a loss as JSON values, by their keys in files.

    >>> alphas(PAPER_LOSS)
    {'euler': 100000.0, 'position': 200000.0, 'L_ctrl': 1.0}
    """
    return {_KEYS.get(term.name, term.name): float(term.weight) for term in loss}


def with_alphas(weights: Mapping[str, Any], loss: Loss = PAPER_LOSS) -> Loss:
    """Replace weights of a loss, by the name of the term or its key in files.

    Raises:
        InputError: the loss has no such term, or a weight is negative or not finite.

    >>> [term.weight for term in with_alphas({"L_Eul": 3.0, "position": 5.0})]
    [3.0, 5.0, 1.0]
    """
    names = {key: t.name for t in loss for key in (t.name, _KEYS.get(t.name, t.name))}
    for key in weights:
        if key not in names:
            raise InputError(unknown("term", key, (term.name for term in loss)))
    by_name = {names[key]: weight for key, weight in weights.items()}
    weighted = tuple(t._replace(weight=by_name.get(t.name, t.weight)) for t in loss)
    check_loss(weighted)
    return weighted


def smoother(loss: Loss, price: float) -> Loss:
    """Return a loss to which changes of the command between switches of stance are added.

    They cost `price` times what they cost in L_ctrl, in addition to that; a loss without L_ctrl
    stays as it is.
    """
    added = (
        LossTerm("L_between", term.unit, price * term.weight, changes_between)
        for term in loss
        if price and term.name == "L_ctrl"
    )
    return (*loss, *added)


def named_loss(weights: Mapping[str, Any]) -> Loss:
    """Return the paper's loss with other weights, and the optional terms that have one.

    Raises:
        InputError: see `with_alphas`.

    >>> [term.name for term in named_loss({"L_pos": 0.0, "L_vel": 1e5})]
    ['L_Eul', 'L_pos', 'L_ctrl', 'L_vel']
    """
    loss = with_alphas(weights, PAPER_LOSS + OPTIONAL_TERMS)
    absent = {term.name for term in OPTIONAL_TERMS} - {*weights}
    return tuple(term for term in loss if term.name not in absent)


def loss_of_robot(description: Description) -> Loss:
    """Return the paper's loss with the weights of a robot's description, and terms that it adds.

    Raises:
        InputError: one line naming the file, for an unknown term or a wrong weight.
    """
    try:
        return named_loss(dict(description.loss))
    except InputError as error:
        raise InputError(f"{description.path}: loss: {error}") from None
