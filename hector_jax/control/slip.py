"""A slip that the legs feel lowers the plan's friction for a while.

The plan trusts its friction coefficient. On a floor that has less, a foot slips whenever the plan
uses all of it, step after step, until the robot falls. State estimate and encoders show a slip: a
foot in stance moves in the world. Then the plan takes a share of its friction, the smaller the
further the foot has moved, which grows back.
"""

from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hector_jax.control import gait
from hector_jax.control.gait import GaitConfig
from hector_jax.core.arrays import Array
from hector_jax.core.settings import POSITIVE, SHARE, check

_LANDING = 0.03  # [s] of a stance until the foot has come to rest


@dataclass(frozen=True)
class SlipConfig:
    """What counts as a slip, and what follows from it."""

    distance: Annotated[float, POSITIVE] = 0.06  # of a foot's motion, by the standing height
    share: Annotated[float, SHARE] = 0.5  # of the plan's friction after twice that; 1: no reaction
    recovery: Annotated[float, POSITIVE] = 2.0  # [s] until the plan has all of its friction again

    def __post_init__(self) -> None:
        check(self)


class Grip(NamedTuple):
    """What the controller knows about the floor; see `first_grip`."""

    planted: Float[Array, "*batch feet 3"]  # [m] where each foot came to rest, in the world
    lost: Float[Array, "*batch"]  # share of the plan's friction that it does not use


def first_grip(feet: Float[Array | np.ndarray, "feet 3"]) -> Grip:
    """Return the grip of a robot that stands with its feet at these points [m]."""
    return Grip(jnp.asarray(feet), jnp.zeros(()))


def feel(
    config: SlipConfig,
    ticks: GaitConfig,
    height: Any,
    grip: Grip,
    *,
    feet: Float[Array, "feet 3"],
    tick: Int[Array, ""],
) -> Grip:
    """Compare the feet with the points where they came to rest; call once a tick.

    Args:
        config, ticks: of the controller.
        height: of the centre of mass of the standing robot [m].
        grip: of the tick before.
        feet: measured foot points in the world [m].
        tick: current gait tick.
    """
    since = ticks.tick * gait.since_touchdown(ticks, tick)
    rests = gait.contact(ticks, tick) & (since > _LANDING - 0.5 * ticks.tick)
    planted = jnp.where(rests[:, None], grip.planted, feet)
    moved = jnp.linalg.norm((feet - planted)[:, :2], axis=-1)
    slip = jnp.clip(jnp.max(moved) / (config.distance * height) - 1.0, 0.0, 1.0)
    most = 1.0 - config.share
    return Grip(planted, jnp.maximum(grip.lost - most * ticks.tick / config.recovery, most * slip))
