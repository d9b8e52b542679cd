"""Integral action of the MPC: accelerations missing in its model, estimated from tracking errors.

A body of another mass, or legs that return less force than commanded, cause a constant offset from
the reference, because the MPC relies on its model at each tick. Here the missing acceleration is
the integral of the error and is predicted to stay constant (offset-free MPC: Pannocchia and
Rawlings, AIChE Journal 49, 2003). It is stored in the yaw frame, in which a walk along a curve is
steady. With gains of zero, as in the paper, nothing is added.

It is bounded: a robot that is held, or put down elsewhere, has errors that no force of its feet
removes, and they must not grow into a plan that presses with nothing. It rests while no foot is
planned in stance. The controller has no contact sensors: more it does not know of the load.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import Disturbance, State

_LARGE = 0.05  # e0 [m] and [rad]: a larger error counts less the larger it is
_LEVER = 0.1  # [m] at which a missing acceleration is as large as a missing angular one


class IntegralGains(NamedTuple):
    """Acceleration per integral of an error [1/s^3], zero turns the integral action off; its bound.

    An angular acceleration is at most `limit` divided by 0.1 m.
    """

    horizontal: Any  # of x and y
    height: Any
    tilt: Any  # of roll and pitch
    yaw: Any
    limit: Any = np.inf  # [m/s^2]


NO_DISTURBANCE = Disturbance(np.zeros(3), np.zeros(3))
"""No missing acceleration: before the first plan, and in the MPC of the paper."""


def integrate_error(
    gains: IntegralGains, previous: Disturbance, state: State, reference: State, dt: Any
) -> Disturbance:
    """Update the disturbance estimate; call once a tick.

    Args:
        gains: with zeros the disturbance does not change.
        previous: disturbance of the previous tick.
        state, reference: current and desired base state.
        dt: length of a tick [s]; 0 while no foot is in stance.

    An error e counts e / (1 + (e / e0)^2) with e0 of 5 cm or 0.05 rad: the large error after
    a push is not an error of the model.
    """

    def increment(gain: tuple, error: Float[Array, "3"]) -> Float[Array, "3"]:
        return dt * jnp.stack(gain) * error / (1.0 + (error / _LARGE) ** 2)

    horizontal, height, tilt, yaw, limit = (jnp.asarray(gain, float) for gain in gains)
    offset = contract("xy,y->x", rot_z(-state.euler[2]), state.position - reference.position)
    linear = previous.linear + increment((horizontal, horizontal, height), offset)
    angular = previous.angular + increment((tilt, tilt, yaw), state.euler - reference.euler)
    most = limit / _LEVER
    return Disturbance(jnp.clip(linear, -limit, limit), jnp.clip(angular, -most, most))
