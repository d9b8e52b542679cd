"""phi: the wrench that the ground really returns for a command (Eq. 13).

An effect is a function `Window -> Effect`, a pytree that can be called (`jax.tree_util.Partial`),
so that a rollout takes new parameters without a new compilation. Wrenches enter and leave it in the
yaw frame of the robot at the tick, so that what is learned on one heading holds on all others.
A `Phi` is a family of such functions, fitted to walks; network.VARIANTS holds them by name.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import Load, State, Wrench

HISTORY = 3  # commands in a window: the current one and two before it


class Window(NamedTuple):
    """Input of phi, in the robot's yaw frame at the tick."""

    commands: Wrench  # (HISTORY, feet, 3) each, newest first
    contact: Bool[Array, "*batch feet"]  # planned stance
    since_switch: Float[Array, "*batch"]  # [s] since the last planned change of contact
    base: State  # at the start of the tick, see `from_yaw_frame`


class Effect(NamedTuple):
    """Loads on the body over the tick, and errors of touchdowns, in the yaw frame."""

    wrench: Wrench  # of the ground on each foot
    legs: Load  # of the moving legs on the trunk; zero if phi does not model it
    touchdown_error: Float[Array, "*batch feet 3"]  # [m] from planned touchdown to true one


class Phi(NamedTuple):
    """A family of effects: functions that make its parameters, fit them to walks and apply them.

    `init` fixes the shapes of the parameters and depends on no data, so that a file can be checked
    against it; an axis whose length depends on the data has length 0 in it.
    """

    name: str  # in flags; a file of its parameters is of the kind `grfm-<name>`
    params: type  # of the parameters, a NamedTuple that no other variant uses
    init: Callable[..., Any]  # (key, feet, axes=3 or 6, hidden=widths of the layers) -> params
    # (nets.FitConfig, training, validation Dataset, progress) -> (params, nets.History)
    fit: Callable[..., tuple[Any, Any]]
    apply: Callable[[Any, Window], Effect]
    widths: Callable[[Any], tuple[int, ...]] = lambda params: ()  # `hidden` of the params
    # (params, number) -> params of one net of an ensemble; without an ensemble they stay
    member: Callable[[Any, int], Any] = lambda params, number: params


Vectors = TypeVar("Vectors")  # a tree of arrays whose last axis is x, y, z


def turn(vectors: Vectors, yaw: Float[Array, ""]) -> Vectors:
    """Turn vectors about z: by `yaw` [rad] from the yaw frame to the world."""
    R = rot_z(yaw)
    return jax.tree.map(lambda v: jnp.sum(v[..., None, :] * R, axis=-1), vectors)


def from_yaw_frame(state: State) -> State:
    """Return the base in its own yaw frame on the floor under it: no yaw, height only."""
    R = rot_z(-state.euler[2])
    return State(
        euler=state.euler * jnp.array([1.0, 1.0, 0.0]),
        position=state.position * jnp.array([0.0, 0.0, 1.0]),
        ang_velocity=contract("xy,y->x", R, state.ang_velocity),
        velocity=contract("xy,y->x", R, state.velocity),
    )


def ground_effect(wrench: Wrench) -> Effect:
    """Return the effect of a ground wrench alone: no load of moving legs, feet land as planned."""
    zero = jnp.zeros_like(wrench.force[0])
    return Effect(wrench, Load(zero, zero), jnp.zeros_like(wrench.force))


def in_dtype_of(window: Window, tree: Any) -> Any:
    """Return a tree on the device, floating-point leaves in the dtype of a window's commands."""
    dtype = window.commands.force.dtype
    return jax.tree.map(
        lambda x: jnp.asarray(x, dtype if jnp.issubdtype(x.dtype, jnp.floating) else None), tree
    )


def _last_command(window: Window) -> Effect:
    return ground_effect(jax.tree.map(lambda w: w[0], window.commands))


last_command = jax.tree_util.Partial(_last_command)  # no decorator: it could not be pickled
"""The plain single rigid body: the ground returns what was commanded."""
