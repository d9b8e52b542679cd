"""phi: what the ground really returns for what was commanded (Eq. 13).

An effect is a function `Window -> Effect`, a pytree that can be called (`jax.tree_util.Partial`),
so that a rollout takes new network parameters without a new compilation. Wrenches enter and leave
it in the yaw frame of the robot at the tick, which makes what is learned on one heading true on all
others.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hector_jax.geometry import rot_z
from hector_jax.trajectory import Wrench

HISTORY = 3  # commands in a window: the current one and two before it


class Window(NamedTuple):
    """What phi may look at, in the robot's yaw frame at the tick."""

    commands: Wrench  # (HISTORY, 2, 3) each, newest first
    contact: Bool[Array, "*batch 2"]  # planned stance
    phase: Float[Array, "*batch"]  # of the gait cycle, 0 to 1
    since_switch: Float[Array, "*batch"]  # [s] since the last planned change of contact


class Effect(NamedTuple):
    """Wrench that the ground returns, yaw frame, with its spread where phi knows one, else zero."""

    wrench: Wrench
    spread: Wrench


def turn(wrench: Wrench, yaw: Float[Array, ""]) -> Wrench:
    """The wrench turned about z: by `yaw` from the yaw frame to the world, by `-yaw` back."""
    R = rot_z(yaw)
    return Wrench(wrench.force @ R.T, wrench.moment @ R.T)


def _last_command(window: Window) -> Effect:
    command = jax.tree.map(lambda w: w[0], window.commands)
    return Effect(command, jax.tree.map(jnp.zeros_like, command))


last_command = jax.tree_util.Partial(_last_command)
"""The plain single rigid body: the ground returns what was commanded."""
