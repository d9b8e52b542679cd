"""phi: what the ground really returns for what was commanded (Eq. 13).

An effect is a function `Window -> Effect`, a pytree that can be called (`jax.tree_util.Partial`),
so that a rollout takes new network parameters without a new compilation. Wrenches enter and leave
it in the yaw frame of the robot at the tick, which makes what is learned on one heading true on all
others.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import Load, State, Wrench

HISTORY = 3  # commands in a window: the current one and two before it


class Window(NamedTuple):
    """What phi may look at, in the robot's yaw frame at the tick."""

    commands: Wrench  # (HISTORY, 2, 3) each, newest first
    contact: Bool[Array, "*batch 2"]  # planned stance
    phase: Float[Array, "*batch"]  # of the gait cycle, 0 to 1
    since_switch: Float[Array, "*batch"]  # [s] since the last planned change of contact
    base: State  # at the start of the tick, see `from_yaw_frame`


class Effect(NamedTuple):
    """What acts on the body over the tick, in the yaw frame."""

    wrench: Wrench  # that the ground returns
    spread: Wrench  # of it, where phi knows one, else zero
    legs: Load  # that the moving legs give the trunk, where phi knows it, else zero


Vectors = TypeVar("Vectors", Wrench, Load)


def turn(vectors: Vectors, yaw: Float[Array, ""]) -> Vectors:
    """Wrenches or pushes turned about z: by `yaw` from the yaw frame to the world, `-yaw` back."""
    R = rot_z(yaw)
    return jax.tree.map(lambda v: v @ R.T, vectors)


def from_yaw_frame(state: State) -> State:
    """The base as seen from its own yaw frame on the floor under it: no yaw, height only."""
    R = rot_z(-state.euler[2])
    return State(
        euler=state.euler * jnp.array([1.0, 1.0, 0.0]),
        position=state.position * jnp.array([0.0, 0.0, 1.0]),
        ang_velocity=R @ state.ang_velocity,
        velocity=R @ state.velocity,
    )


def sure(wrench: Wrench) -> Effect:
    """The effect of a wrench without spread, and of legs that do not push."""
    nothing = jnp.zeros_like(wrench.force[0])
    return Effect(wrench, jax.tree.map(jnp.zeros_like, wrench), Load(nothing, nothing))


def _last_command(window: Window) -> Effect:
    return sure(jax.tree.map(lambda w: w[0], window.commands))


last_command = jax.tree_util.Partial(_last_command)
"""The plain single rigid body: the ground returns what was commanded."""
