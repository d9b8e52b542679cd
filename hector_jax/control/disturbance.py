"""Integral action of the MPC: the accelerations that its model lacks, estimated from its errors.

A body of another mass, or legs that return less than they are asked for, leave the robot beside its
reference for as long as it walks, because the MPC believes its model anew at each tick. Here what
is missing is the integral of the error, and is predicted to stay (offset-free MPC: Pannocchia and
Rawlings, AIChE Journal 49, 2003). It is kept in the yaw frame, in which a walk along a curve is
steady. With gains of zero, as in the paper, nothing is added.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import State

_LARGE = 0.05  # e0 [m] and [rad]: above it an error counts less the larger it is


class IntegralGains(NamedTuple):
    """Acceleration by the integral of an error [1/s^3]; at zero there is none."""

    horizontal: Any  # of x and y
    height: Any
    tilt: Any  # of roll and pitch
    yaw: Any


class Disturbance(NamedTuple):
    """Accelerations that the model lacks."""

    linear: Float[Array, "*batch 3"]  # yaw frame [m/s^2]
    angular: Float[Array, "*batch 3"]  # likewise [rad/s^2]


NO_DISTURBANCE = Disturbance(np.zeros(3), np.zeros(3))
"""The model lacks nothing: before the first plan, and in the MPC of the paper."""


def integrate_error(
    gains: IntegralGains, before: Disturbance, state: State, reference: State, dt: float
) -> Disturbance:
    """What the model lacks, once a tick.

    Args:
        gains: at zero the disturbance stays as it is.
        before: of the tick before.
        state, reference: base now, and where it is to be.
        dt: length of a tick [s].

    An error e counts e / (1 + (e / e0)^2), e0 being 5 cm and 0.05 rad: what a push leaves is not
    missing in the model.
    """

    def added(gain: tuple, error: Float[Array, "3"]) -> Float[Array, "3"]:
        return dt * jnp.stack(gain) * error / (1.0 + (error / _LARGE) ** 2)

    horizontal, height, tilt, yaw = (jnp.asarray(gain, float) for gain in gains)
    away = rot_z(-state.euler[2]) @ (state.position - reference.position)
    return Disturbance(
        before.linear + added((horizontal, horizontal, height), away),
        before.angular + added((tilt, tilt, yaw), state.euler - reference.euler),
    )
