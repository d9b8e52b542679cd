"""theta: the 24 diagonal weights of the MPC and what is tuned beside them; the sets with a name.

The diagonal of Q has the shape of a state and that of R the shape of a wrench (Eq. 3); the three
gravity weights of the paper's 15-state cost are zero and not tuned. Trees of this shape also carry
bounds, step sizes and gradients.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Wrench
from hector_jax.robot.model import Robot


class Weights(NamedTuple):
    """Diagonals of the stage cost |x - x_ref|^2_Q + |u|^2_R, and numbers tuned beside them."""

    Q: State  # of the error of each state
    R: Wrench  # of the input of each foot
    others: Mapping[str, Any] = {}  # by the names of `parameters.TUNABLES`; else the config's


_STATES = "roll pitch yaw x y z wx wy wz vx vy vz".split()
WEIGHT_NAMES = tuple(
    [f"Q_{name}" for name in _STATES]
    + [f"R_{kind}{axis}_{foot}" for kind in "FM" for foot in ("left", "right") for axis in "xyz"]
)
"""Names of the entries of `weights_to_vector`."""

DIRECTION_NAMES = tuple(
    name.removesuffix("_left") for name in WEIGHT_NAMES if not name.endswith("_right")
)
"""Names of the 18 directions in which the weights move when the feet share one R."""


def _weights(rows: tuple) -> Weights:
    """Of the diagonals by three, in the order of State and Wrench, one R for both feet."""
    Q, R = np.array(rows[:4], float), np.array(rows[4:], float)
    return Weights(State(*Q), Wrench(*(np.stack([row, row]) for row in R)))


_NOMINAL = ((50.0,) * 3, (50.0,) * 3, (1.0,) * 3, (1.0,) * 3, (1e-4,) * 3, (1e-3,) * 3)
_EXPERT = ((100.0, 100.0, 250.0), (200.0, 200.0, 300.0), (1.0,) * 3, (1.0,) * 3)
_EXPERT += ((1e-4, 1e-4, 5e-4), (1e-2,) * 3)


def nominal(robot: Robot | None = None) -> Weights:
    """Flat, untuned weights that still walk: what an engineer writes down before tuning.

    Those of a robot are in its description; without one, HECTOR's.
    """
    return _weights(robot and robot.description.nominal or _NOMINAL)


def expert(robot: Robot | None = None) -> Weights:
    """The weights that the robot's own laboratory published for its walking controller.

    Those of a robot are in its description; without one, HECTOR's.
    """
    return _weights(robot and robot.description.expert or _EXPERT)


def weights_to_vector(weights: Weights) -> Float[Array, "*batch 24"]:
    """Q and R in the order of WEIGHT_NAMES; for gradients and other such trees too."""
    flat = [*weights.Q, *(w.reshape(*w.shape[:-2], 6) for w in weights.R)]
    return jnp.concatenate([jnp.asarray(w) for w in flat], axis=-1)


def vector_to_weights(vector: Float[Array, "*batch 24"]) -> Weights:
    """Weights from the 24 numbers of `weights_to_vector`."""
    rows = [vector[..., 3 * i : 3 * i + 3] for i in range(4)]
    feet = vector[..., 12:].reshape(*vector.shape[:-1], 2, 2, 3)
    return Weights(State(*rows), Wrench(feet[..., 0, :, :], feet[..., 1, :, :]))


def directions() -> Float[np.ndarray, "18 24"]:
    """The 18 unit steps in the log-weights of `weights_to_vector`."""
    eye = np.eye(24)
    feet = [eye[k + axis] + eye[k + 3 + axis] for k in (12, 18) for axis in range(3)]
    return np.concatenate([eye[:12], feet])


def scale_weights(weights: Weights, logs: Float[np.ndarray, "18"]) -> Weights:
    """Weights after a step in the 18 directions; `others` stay.

    >>> steps = np.zeros(18)
    >>> steps[DIRECTION_NAMES.index("Q_yaw")] = np.log(2.0)
    >>> scale_weights(nominal(), steps).Q.euler.round(6).tolist()
    [50.0, 50.0, 100.0]
    """
    vector = weights_to_vector(weights) * jnp.exp(logs @ directions())
    moved = vector_to_weights(vector)._replace(others=weights.others)
    return jax.tree.map(np.asarray, moved)


def sample_weights(weights: Weights, factor: float, count: int) -> list[Weights]:
    """Draw weight sets log-uniformly within x/factor of some weights, always the same ones."""
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(DIRECTION_NAMES)))
    return [scale_weights(weights, np.log(factor) * row) for row in draws]
