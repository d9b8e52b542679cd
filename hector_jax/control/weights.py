"""theta: the diagonal weights of the MPC and other tuned numbers; the named weight sets.

The diagonal of Q has the shape of a state and that of R the shape of a wrench (Eq. 3), without
moments for point feet; the three gravity weights of the paper's 15-state cost are zero and not
tuned. HECTOR has 24 weights. Bounds, step sizes and gradients are trees of the same shape.
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
    """Diagonals of the stage cost |x - x_ref|^2_Q + |u|^2_R, and other tuned numbers."""

    Q: State  # weight of each state error
    R: Wrench  # weight of each input of each foot; the moment of point feet is (feet, 0)
    others: Mapping[str, Any] = {}  # by names in `parameters.TUNABLES`; the config has the rest


_STATES = "roll pitch yaw x y z wx wy wz vx vy vz".split()


def weight_names(like: Weights | None = None) -> tuple[str, ...]:
    """Return the names of the entries of `weights_to_vector`, by default for HECTOR."""
    force, moment = (nominal() if like is None else like).R
    kinds = "FM" if moment.size else "F"
    feet = FEET[force.shape[-2]]
    R = [f"R_{kind}{axis}_{foot}" for kind in kinds for foot in feet for axis in "xyz"]
    return (*(f"Q_{name}" for name in _STATES), *R)


def _direction(name: str) -> str:
    """Return the name of a weight without its foot."""
    return name if name.startswith("Q_") else "_".join(name.split("_")[:2])


def direction_names(like: Weights | None = None) -> tuple[str, ...]:
    """Return the names of the directions in which weights change when all feet share one R."""
    return tuple(dict.fromkeys(map(_direction, weight_names(like))))


def _weights(rows: tuple, feet: int = 2, moments: bool = True) -> Weights:
    """Build weights from six triples in the order of State and Wrench, one R for all feet."""
    euler, position, turning, moving, force, moment = np.array(rows, float)
    moment = moment if moments else moment[:0]
    Q = State(euler, position, turning, moving)
    return Weights(Q, Wrench(np.tile(force, (feet, 1)), np.tile(moment, (feet, 1))))


def named_like(names: Collection[str]) -> Weights:
    """Return weights of the shape that the `weight_names` among these names describe."""
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
    """Return uniform, untuned weights that still walk, as an engineer chooses before tuning.

    They are read from the robot's description; without a robot they are HECTOR's.
    """
    return _weights_of(robot, robot and robot.description.nominal or _NOMINAL)


def expert(robot: Robot | None = None) -> Weights:
    """Return the weights that the robot's laboratory published for its walking controller.

    They are read from the robot's description; without a robot they are HECTOR's.
    """
    return _weights_of(robot, robot and robot.description.expert or _EXPERT)


def weights_to_vector(weights: Weights) -> Float[Array, "*batch weights"]:
    """Return Q and R in the order of `weight_names`; also of gradients and other such trees."""
    flat = [*weights.Q, *(w.reshape(*w.shape[:-2], -1) for w in weights.R if w.size)]
    return jnp.concatenate([jnp.asarray(w) for w in flat], axis=-1)


def vector_to_weights(
    vector: Float[Array | np.ndarray, "*batch weights"], like: Weights | None = None
) -> Weights:
    """Return weights from a vector of `weights_to_vector`, shaped like `like`, default HECTOR's."""
    R = (nominal() if like is None else like).R
    ends = np.cumsum([3, 3, 3, 3, *(int(np.prod(w.shape[-2:])) for w in R)])[:-1]
    euler, position, ang_velocity, velocity, force, moment = jnp.split(vector, ends, axis=-1)
    pairs = zip((force, moment), R, strict=True)
    R = Wrench(*(x.reshape(*x.shape[:-1], *w.shape[-2:]) for x, w in pairs))
    return Weights(State(euler, position, ang_velocity, velocity), R)


def directions(like: Weights | None = None) -> Float[np.ndarray, "directions weights"]:
    """Return unit steps of the log-weights of `weights_to_vector`, ordered as `direction_names`."""
    of_weights = np.array([_direction(name) for name in weight_names(like)])
    return np.array([of_weights == name for name in direction_names(like)], float)


def scale_weights(weights: Weights, logs: Float[Array | np.ndarray, " directions"]) -> Weights:
    """Return weights after a log-step in the `directions`; `others` do not change.

    >>> steps = np.zeros(18)
    >>> steps[direction_names().index("Q_yaw")] = np.log(2.0)
    >>> scale_weights(nominal(), steps).Q.euler.round(6).tolist()
    [50.0, 50.0, 100.0]
    """
    vector = weights_to_vector(weights) * jnp.exp(logs @ directions(weights))
    return vector_to_weights(vector, weights)._replace(others=weights.others)


def between(first: Weights, second: Weights, share: float = 0.5) -> Weights:
    """Return the weighted geometric mean of two weight sets; `share` is the weight of the second.

    The `others`, which may be zero, are interpolated linearly.

    Raises:
        InputError: the sets have different `others`.

    >>> between(nominal(), expert()).Q.euler.round(1).tolist()
    [70.7, 70.7, 111.8]
    """
    if first.others.keys() != second.others.keys():
        names = (", ".join(x.others) or "none" for x in (first, second))
        raise InputError(f"weights to mix differ in numbers beside Q and R: {' and '.join(names)}")
    Q, R = jax.tree.map(lambda x, y: x ** (1.0 - share) * y**share, first[:2], second[:2])
    others = jax.tree.map(lambda x, y: (1.0 - share) * x + share * y, first.others, second.others)
    return jax.tree.map(np.asarray, Weights(Q, R, others))
