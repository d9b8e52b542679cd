"""Motors with a memory: what a torque command becomes at the joints.

A command is scaled by the motor's own gain, saturates at the motor's limit, arrives late (delay),
builds up slowly (first-order lag), and the ankle's linkage leaks a share of the ankle torque into
the knee (the ankle motor acts on knee + ankle; the public controllers compensate half of the map).
All of it is linear after the limit and cheap, and the same function serves MuJoCo and MJX.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim.world import MAX_DELAY, Imperfections

MEMORY = round(MAX_DELAY / TIME_STEP) + 1  # commands remembered, the present one included


class Motors(NamedTuple):
    """What the motors remember."""

    commands: Float[Array, "*batch m joints"]  # [N m] newest first
    torque: Float[Array, "*batch joints"]  # [N m] after the lag


def init_actuators(joints: int) -> Motors:
    """Motors at rest, one for each joint."""
    return Motors(jnp.zeros((MEMORY, joints)), jnp.zeros(joints))


def step_actuators(
    robot: Robot, imperfections: Imperfections, motors: Motors, command: Float[Array, " joints"]
) -> tuple[Motors, Float[Array, " joints"]]:
    """Torque at the joints [N m] over the next millisecond for what is commanded now.

    A delay between whole milliseconds is interpolated between two commands; a lag of zero
    passes the torque through.
    """
    limit = robot.torque_limit
    sent = jnp.clip(imperfections.torque_gain * command, -limit, limit)
    commands = jnp.concatenate([sent[None], motors.commands[:-1]])
    age = jnp.arange(MEMORY) - imperfections.delay / TIME_STEP
    arrived = jnp.maximum(1.0 - jnp.abs(age), 0.0) @ commands
    lag = jnp.maximum(imperfections.lag, 1e-9)
    torque = arrived + jnp.exp(-TIME_STEP / lag) * (motors.torque - arrived)
    motors = Motors(commands, torque)
    if robot.description.linkage is None:
        return motors, torque
    joints = robot.description.leg_joints
    for first in range(0, len(torque), joints):  # one by one: a scatter is a kernel of its own
        motor, turned = (first + i - 1 for i in robot.description.linkage)
        torque = torque.at[turned].add(imperfections.linkage * torque[motor])
    return motors, torque
