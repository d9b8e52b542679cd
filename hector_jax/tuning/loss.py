"""Tracking and smoothness of a walk as one number (Eq. 11), the same in every world.

    L = alpha_1 sum |e - e_ref|^2 + alpha_2 sum |p - p_ref|^2 + sum |u_j - u_{j-1}|^2      over 1
    kHz samples

A world that ticks slower weighs its tracking sums by the milliseconds a tick stands for; the
smoothness counts the changes of the held command. A fall is a fall: every missing sample is charged
the larger of the last error and a fixed one, and smoothness stops.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hector_jax.core.settings import NOT_NEGATIVE, check
from hector_jax.core.trajectory import Trajectory, Wrench

SAMPLE = 1e-3  # [s] the rate at which the paper sums
FALL_POSITION = 0.5  # [m] least error charged after a fall
FALL_EULER = 0.8  # [rad]


class LossWeights(NamedTuple):
    """Weights of the three parts as arrays, so that one program serves them all."""

    euler: Float[Array, "*batch"]  # alpha_1 [1/rad^2]
    position: Float[Array, "*batch"]  # alpha_2 [1/m^2]
    control: Float[Array, "*batch"]  # 1 in the paper


@dataclass(frozen=True)
class LossConfig:
    """Weights of the parts."""

    euler: float = 1e5  # alpha_1 [1/rad^2]
    position: float = 2e5  # alpha_2 [1/m^2]

    def __post_init__(self) -> None:
        check(self, euler=NOT_NEGATIVE, position=NOT_NEGATIVE)

    @property
    def control(self) -> float:
        """Weight of L_ctrl, by which the others are measured."""
        return 1.0

    def as_arrays(self) -> LossWeights:
        """The weights as arguments of a compiled program."""
        return LossWeights(*(np.asarray(getattr(self, name)) for name in LossWeights._fields))


class Losses(NamedTuple):
    """Unweighted parts of the loss."""

    euler: Float[Array, "*batch"]  # L_Eul [rad^2]
    position: Float[Array, "*batch"]  # L_pos [m^2]
    control: Float[Array, "*batch"]  # L_ctrl [N^2 and (N m)^2]


def _charged(
    error: Float[Array, " T"], fallen: Bool[Array, " T"], least: float
) -> Float[Array, " T"]:
    """Squared errors with those after the fall replaced by what a fall is charged."""
    before = jnp.where(fallen, 0.0, error)
    last = jnp.maximum(jnp.sum(~fallen) - 1, 0)
    return jnp.where(fallen, jnp.maximum(before[last], least**2), before)


def _squared_changes(command: Wrench, fallen: Bool[Array, " T"]) -> Float[Array, " T-1"]:
    change = jnp.sum(jnp.diff(command.force, axis=0) ** 2, axis=(1, 2))
    change = change + jnp.sum(jnp.diff(command.moment, axis=0) ** 2, axis=(1, 2))
    return jnp.where(fallen[1:], 0.0, change)


def losses(trajectory: Trajectory) -> Losses:
    """Parts of the loss of one walk. Source: Eq. 11."""
    trajectory = jax.tree.map(jnp.asarray, trajectory)  # MuJoCo's walks come as numpy
    state, reference, fallen = trajectory.state, trajectory.reference, trajectory.fallen
    euler = jnp.sum((state.euler - reference.euler) ** 2, axis=-1)
    position = jnp.sum((state.position - reference.position) ** 2, axis=-1)
    samples = trajectory.period / SAMPLE
    return Losses(
        euler=samples * jnp.sum(_charged(euler, fallen, FALL_EULER)),
        position=samples * jnp.sum(_charged(position, fallen, FALL_POSITION)),
        control=jnp.sum(_squared_changes(trajectory.command, fallen)),
    )


def switch_loss(trajectory: Trajectory) -> Float[Array, ""]:
    """The part of L_ctrl at changes of stance: about 2 (m g)^2 each, whatever the weights."""
    trajectory = jax.tree.map(jnp.asarray, trajectory)
    switched = jnp.any(trajectory.contact[1:] != trajectory.contact[:-1], axis=-1)
    return jnp.sum(jnp.where(switched, _squared_changes(trajectory.command, trajectory.fallen), 0))


def total(weights: LossWeights | LossConfig, parts: Losses) -> Float[Array, "*batch"]:
    """L of its parts. Source: Eq. 11.

    >>> total(LossConfig(), Losses(*map(jnp.asarray, (1.0, 2.0, 3e5)))).item()
    800000.0
    """
    return (
        weights.euler * parts.euler
        + weights.position * parts.position
        + weights.control * parts.control
    )


@partial(jax.jit, static_argnums=0)
def loss_of(config: LossConfig, trajectory: Trajectory) -> Float[Array, ""]:
    """L of one walk. Source: Eq. 11."""
    return total(config, losses(trajectory))
