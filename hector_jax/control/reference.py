"""The reference motion: a velocity command, integrated open loop from t = 0 (Eq. 14-16).

The reference does not depend on the robot's motion: the MPC and the loss use the same one. Yaw is
integrated first and the velocity rotated by it; on each piece of constant yaw rate the path is an
exact arc. Height, roll and pitch are constant.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Real

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, unknown
from hector_jax.core.trajectory import State
from hector_jax.robot.model import Robot


class Command(NamedTuple):
    """Periodic velocity command, constant on each of S pieces."""

    duration: Float[Any, "*batch S"]  # [s]
    velocity: Float[Any, "*batch S 2"]  # [m/s] forward and to the left
    yaw_rate: Float[Any, "*batch S"]  # [rad/s]


PIECES = 4  # least number in walks and collections, see `with_pieces`


def with_pieces(command: Command) -> Command:
    """Return the same command in at least PIECES pieces, so that programs and batches are shared.

    Pieces without duration are added at its end.
    """
    added = max(PIECES - len(command.duration), 0)
    padded = jax.tree.map(lambda x: np.concatenate([x, np.repeat(x[-1:], added, axis=0)]), command)
    padded.duration[len(command.duration) :] = 0.0
    return padded


class Anchor(NamedTuple):
    """Start pose of the reference, and its start t = 0 at gait tick `tick`."""

    position: Float[Any, "*batch 3"]  # of the centre of mass [m]
    yaw: Float[Any, "*batch"]  # [rad]
    tick: Int[Any, "*batch"]


def standing_anchor(robot: Robot, start_tick: int = 0) -> Anchor:
    """Return the anchor of a robot that stands with its trunk above the origin to `start_tick`."""
    position = jnp.append(jnp.asarray(robot.com_offset)[:2], robot.standing_height)
    return Anchor(position, jnp.zeros_like(position[0]), jnp.asarray(start_tick, jnp.int32))


def anchor_at(robot: Robot, state: State, start_tick: Int[Array, ""] | int) -> Anchor:
    """Return the anchor at the robot's pose at t = 0, at its standing height."""
    position = jnp.append(state.position[:2], robot.standing_height)
    return Anchor(position, state.euler[2], jnp.asarray(start_tick, jnp.int32))


COMMANDS = ("straight", "c", "s")
"""The paper's trajectories."""

_QUARTER, _HALF = 0.25 * np.pi, 0.5 * np.pi  # [rad/s]
# For two pieces: common duration [s]; velocities forward and to the left [m/s]; yaw rates [rad/s].
_PIECES = {
    "straight": (2.0, ((0.5, 0.0), (0.5, 0.0)), (0.0, 0.0)),
    "c": (2.0, ((0.25, 0.0), (0.25, 0.0)), (_QUARTER, _QUARTER)),
    "s": (2.0, ((0.5, 0.0), (0.5, 0.0)), (_HALF, -_HALF)),
    "sideways": (2.0, ((0.0, 0.2), (0.0, 0.2)), (0.0, 0.0)),
    "turn": (2.0, ((0.0, 0.0), (0.0, 0.0)), (_QUARTER, _QUARTER)),
    "eight": (4.0, ((0.3, 0.0), (0.3, 0.0)), (_HALF, -_HALF)),
    "stop-and-go": (1.0, ((0.5, 0.0), (0.0, 0.0)), (0.0, 0.0)),
}

UNSEEN = tuple(name for name in _PIECES if name not in COMMANDS)
"""Trajectories beyond the paper, to test weights that were tuned on others."""


def named_command(name: str) -> Command:
    """Return a trajectory of COMMANDS or UNSEEN.

    The paper's straight line, C curve and S curve (period 4 s); 0.2 m/s to the left; half a turn on
    the spot in 4 s; a figure of eight, two circles of 4 s each; one second at 0.5 m/s and one in
    place. All have two pieces, so that they can share a batch.

    >>> named_command("stop-and-go").velocity.tolist()
    [[0.5, 0.0], [0.0, 0.0]]

    Raises:
        InputError: the name is unknown.
    """
    if name not in _PIECES:
        raise InputError(unknown("trajectory", name, _PIECES))
    seconds, velocity, rates = _PIECES[name]
    return Command(np.full(2, seconds), np.array(velocity), np.array(rates))


def _turn(angle: Float[Array, "*batch"], v: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    left = jnp.stack([-v[..., 1], v[..., 0]], axis=-1)  # v turned by 90 degrees
    return jnp.cos(angle)[..., None] * v + jnp.sin(angle)[..., None] * left


def _displacement(command: Command, time: Float[Array, ""]) -> tuple[Array, Array]:
    """Return displacement (2,) and turn () from the start to `time` within the first period."""
    start = jnp.cumsum(command.duration) - command.duration
    elapsed = jnp.clip(time - start, 0.0, command.duration)
    turn = command.yaw_rate * elapsed
    heading = jnp.cumsum(turn) - turn
    # chord of an arc at unit speed; np.sinc is sin(pi x)/(pi x)
    chord = jnp.sinc(turn / (2 * jnp.pi)) * elapsed
    arcs = _turn(heading + turn / 2, command.velocity * chord[:, None])
    return arcs.sum(axis=0), turn.sum()


@partial(jax.jit, static_argnums=0)  # traced once for all callers
def reference_at(
    tick_length: float, command: Command, anchor: Anchor, tick: Real[Array, ""]
) -> State:
    """Return the reference state at a gait tick; before t = 0 it stands at the anchor.

    Args:
        tick_length: length of a tick [s].
        command: velocity command.
        anchor: start pose and start tick.
        tick: gait tick, may be fractional.

    Source: Eq. 14-16, repeated with the period of the command.
    """
    command = Command(*map(jnp.asarray, command))
    time = tick_length * (tick - anchor.tick)
    walking = time >= 0.0
    period = jnp.sum(command.duration)
    rounds = jnp.floor(jnp.maximum(time, 0.0) / period)
    inside = jnp.maximum(time, 0.0) - rounds * period
    lap, lap_turn = _displacement(command, period)
    # n laps are a geometric series of rotated displacements:
    # sum_i R(i a) = R((n-1) a/2) sin(n a/2)/sin(a/2).
    half = lap_turn / 2
    flat = jnp.abs(jnp.sin(half)) < 1e-9
    # if a lap turns by a multiple of 2 pi, sin(n a/2)/sin(a/2) tends to n cos((n-1) a/2)
    limit = rounds * jnp.cos((rounds - 1.0) * half)
    ratio = jnp.where(flat, limit, jnp.sin(rounds * half) / jnp.where(flat, 1.0, jnp.sin(half)))
    laps = _turn((rounds - 1.0) * half, lap * ratio)
    step, turn = _displacement(command, inside)
    heading = anchor.yaw + rounds * lap_turn
    plane = _turn(anchor.yaw, laps) + _turn(heading, step)
    yaw = heading + turn
    piece = jnp.minimum(jnp.sum(inside >= jnp.cumsum(command.duration)), command.duration.size - 1)
    velocity = jnp.where(walking, _turn(yaw, command.velocity[piece]), 0.0)
    yaw_rate = jnp.where(walking, command.yaw_rate[piece], 0.0)
    zero = jnp.zeros_like(yaw)
    return State(
        euler=jnp.stack([zero, zero, yaw]),
        position=anchor.position + jnp.concatenate([plane, zero[None]]),
        ang_velocity=jnp.stack([zero, zero, yaw_rate]),
        velocity=jnp.concatenate([velocity, zero[None]]),
    )
