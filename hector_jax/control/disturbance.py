"""Integral action of the MPC: accelerations missing in its model, estimated from tracking errors.

A body of another mass, or legs that return less force than commanded, cause a constant offset from
the reference, because the MPC relies on its model at each tick. Here the missing acceleration is
the integral of the error and is predicted to stay constant (offset-free MPC: Pannocchia and
Rawlings, AIChE Journal 49, 2003). It is stored in the yaw frame, in which a walk along a curve is
steady. With gains of zero, as in the paper, nothing is added.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import Disturbance, State

_LARGE = 0.05  # e0 [m] and [rad]: a larger error counts less the larger it is


class IntegralGains(NamedTuple):
    """Acceleration per integral of an error [1/s^3]; zero turns the integral action off."""

    horizontal: Any  # of x and y
    height: Any
    tilt: Any  # of roll and pitch
    yaw: Any


NO_DISTURBANCE = Disturbance(np.zeros(3), np.zeros(3))
"""No missing acceleration: before the first plan, and in the MPC of the paper."""


def integrate_error(
    gains: IntegralGains, previous: Disturbance, state: State, reference: State, dt: float
) -> Disturbance:
    """Update the disturbance estimate; call once a tick.

    Args:
        gains: with zeros the disturbance does not change.
        previous: disturbance of the previous tick.
        state, reference: current and desired base state.
        dt: length of a tick [s].

    An error e counts e / (1 + (e / e0)^2) with e0 of 5 cm or 0.05 rad: the large error after
    a push is not an error of the model.
    """

    def increment(gain: tuple, error: Float[Array, "3"]) -> Float[Array, "3"]:
        return dt * jnp.stack(gain) * error / (1.0 + (error / _LARGE) ** 2)

    horizontal, height, tilt, yaw = (jnp.asarray(gain, float) for gain in gains)
    offset = contract("xy,y->x", rot_z(-state.euler[2]), state.position - reference.position)
    return Disturbance(
        previous.linear + increment((horizontal, horizontal, height), offset),
        previous.angular + increment((tilt, tilt, yaw), state.euler - reference.euler),
    )
