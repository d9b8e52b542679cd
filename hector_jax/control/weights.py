"""theta: the diagonal weights of the MPC and what is tuned beside them; the sets with a name.

The diagonal of Q has the shape of a state and that of R the shape of a wrench (Eq. 3), without
moments where the feet exert none; the three gravity weights of the paper's 15-state cost are zero
and not tuned. HECTOR has 24 weights. Trees of this shape also carry bounds, step sizes and
gradients.
"""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import FEET, State, Wrench
from hector_jax.robot.model import Robot


class Weights(NamedTuple):
    """Diagonals of the stage cost |x - x_ref|^2_Q + |u|^2_R, and numbers tuned beside them."""

    Q: State  # of the error of each state
    R: Wrench  # of the input of each foot; of point feet the moment is (feet, 0)
    others: Mapping[str, Any] = {}  # by the names of `parameters.TUNABLES`; else the config's


_STATES = "roll pitch yaw x y z wx wy wz vx vy vz".split()


def weight_names(like: Weights | None = None) -> tuple[str, ...]:
    """Names of the entries of `weights_to_vector`; of HECTOR's weights by default."""
    force, moment = (nominal() if like is None else like).R
    kinds = "FM" if moment.size else "F"
    feet = FEET[force.shape[-2]]
    R = [f"R_{kind}{axis}_{foot}" for kind in kinds for foot in feet for axis in "xyz"]
    return (*(f"Q_{name}" for name in _STATES), *R)


def _direction(name: str) -> str:
    """Name of a weight without its foot."""
    return name if name.startswith("Q_") else "_".join(name.split("_")[:2])


def direction_names(like: Weights | None = None) -> tuple[str, ...]:
    """Names of the directions in which the weights move when the feet share one R."""
    return tuple(dict.fromkeys(map(_direction, weight_names(like))))


def _weights(rows: tuple, feet: int = 2, moments: bool = True) -> Weights:
    """Of the diagonals by three, in the order of State and Wrench, one R for all feet."""
    Q, (force, moment) = np.array(rows[:4], float), np.array(rows[4:], float)
    moment = moment if moments else moment[:0]
    return Weights(State(*Q), Wrench(np.tile(force, (feet, 1)), np.tile(moment, (feet, 1))))


def named_like(names: Collection[str]) -> Weights:
    """Weights of the shape that has these `weight_names` among other names."""
    feet = sum(name.startswith("R_Fx") for name in names)
    return _weights(_NOMINAL, feet, any(name.startswith("R_M") for name in names))


def _weights_of(robot: Robot | None, rows: Any) -> Weights:
    if robot is None:
        return _weights(rows)
    return _weights(rows, len(robot.foot_point), robot.structure.contact != "point")


_NOMINAL = ((50.0,) * 3, (50.0,) * 3, (1.0,) * 3, (1.0,) * 3, (1e-4,) * 3, (1e-3,) * 3)
_EXPERT = ((100.0, 100.0, 250.0), (200.0, 200.0, 300.0), (1.0,) * 3, (1.0,) * 3)
_EXPERT += ((1e-4, 1e-4, 5e-4), (1e-2,) * 3)


def nominal(robot: Robot | None = None) -> Weights:
    """Flat, untuned weights that still walk: what an engineer writes down before tuning.

    Those of a robot are in its description; without one, HECTOR's.
    """
    return _weights_of(robot, robot and robot.description.nominal or _NOMINAL)


def expert(robot: Robot | None = None) -> Weights:
    """The weights that the robot's own laboratory published for its walking controller.

    Those of a robot are in its description; without one, HECTOR's.
    """
    return _weights_of(robot, robot and robot.description.expert or _EXPERT)


def weights_to_vector(weights: Weights) -> Float[Array, "*batch weights"]:
    """Q and R in the order of `weight_names`; for gradients and other such trees too."""
    flat = [*weights.Q, *(w.reshape(*w.shape[:-2], -1) for w in weights.R if w.size)]
    return jnp.concatenate([jnp.asarray(w) for w in flat], axis=-1)


def vector_to_weights(
    vector: Float[Array, "*batch weights"], like: Weights | None = None
) -> Weights:
    """Weights from the numbers of `weights_to_vector`, shaped as others, by default HECTOR's."""
    R = (nominal() if like is None else like).R
    ends = np.cumsum([3, 3, 3, 3, *(int(np.prod(w.shape[-2:])) for w in R)])[:-1]
    *Q, force, moment = jnp.split(vector, ends, axis=-1)
    shaped = (
        x.reshape(*x.shape[:-1], *w.shape[-2:]) for x, w in zip((force, moment), R, strict=True)
    )
    return Weights(State(*Q), Wrench(*shaped))


def directions(like: Weights | None = None) -> Float[np.ndarray, "directions weights"]:
    """Unit steps in the log-weights of `weights_to_vector`, in the order of `direction_names`."""
    of_weight = np.array([_direction(name) for name in weight_names(like)])
    return np.array([of_weight == name for name in direction_names(like)], float)


def scale_weights(weights: Weights, logs: Float[Array | np.ndarray, " directions"]) -> Weights:
    """Weights after a step in the `directions`; `others` stay.

    >>> steps = np.zeros(18)
    >>> steps[direction_names().index("Q_yaw")] = np.log(2.0)
    >>> scale_weights(nominal(), steps).Q.euler.round(6).tolist()
    [50.0, 50.0, 100.0]
    """
    vector = weights_to_vector(weights) * jnp.exp(logs @ directions(weights))
    return vector_to_weights(vector, weights)._replace(others=weights.others)


def between(one: Weights, other: Weights, share: float = 0.5) -> Weights:
    """Weights between two sets: their geometric mean, in which `share` counts the other one.

    Numbers beside Q and R, which may be zero, are on the straight line from one to the other.

    Raises:
        InputError: they do not have the same numbers beside Q and R.

    >>> between(nominal(), expert()).Q.euler.round(1).tolist()
    [70.7, 70.7, 111.8]
    """
    if one.others.keys() != other.others.keys():
        each = (", ".join(x.others) or "none" for x in (one, other))
        raise InputError(f"weights to mix have unlike numbers beside Q and R: {' and '.join(each)}")
    Q, R = jax.tree.map(lambda x, y: x ** (1.0 - share) * y**share, one[:2], other[:2])
    line = jax.tree.map(lambda x, y: (1.0 - share) * x + share * y, one.others, other.others)
    return jax.tree.map(np.asarray, Weights(Q, R, line))


def sample_weights(weights: Weights, factor: float, count: int) -> list[Weights]:
    """Draw weight sets log-uniformly within x/factor of some weights, always the same ones."""
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(direction_names(weights))))
    scaled = [scale_weights(weights, np.log(factor) * row) for row in draws]
    return jax.device_get(scaled)


def moved_most(start: Weights, weights: Weights) -> str:
    """The three directions in which weights lie farthest from a start, as text.

    >>> moved_most(nominal(), scale_weights(nominal(), 0.5 * np.eye(18)[1]))
    'Q_pitch 1.6 times, Q_roll 1 times, Q_yaw 1 times'
    """
    sizes = [np.asarray(weights_to_vector(one)) for one in (start, weights)]
    farthest = directions(start).argmax(axis=1)  # of the first foot
    logs = np.log(sizes[1] / sizes[0])[farthest]
    order = sorted(range(len(logs)), key=lambda i: -abs(logs[i]))[:3]
    names = direction_names(start)
    return ", ".join(f"{names[i]} {np.exp(logs[i]):.2g} times" for i in order)
