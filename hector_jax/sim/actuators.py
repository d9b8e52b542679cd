"""Motor dynamics: from commanded torques to torques at the joints.

A command is scaled by the motor's own gain, saturates at the motor's limit, is delayed, passes a
first-order lag, and the ankle's linkage adds a share of the ankle torque at the knee (the ankle
motor acts on knee + ankle; the public controllers compensate half of the map). The sum is limited
once more, as MuJoCo's own actuators do, so that all engines apply the same torque.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim.world import MAX_DELAY, Imperfections

MEMORY = round(MAX_DELAY / TIME_STEP) + 1  # stored commands, the present one included


class Motors(NamedTuple):
    """State of the motors."""

    commands: Float[Array, "*batch m joints"]  # [N m] newest first
    torque: Float[Array, "*batch joints"]  # [N m] after the lag


def init_actuators(joints: int) -> Motors:
    """Return motors at rest, one for each joint."""
    return Motors(jnp.zeros((MEMORY, joints)), jnp.zeros(joints))


def step_actuators(
    robot: Robot, imperfections: Imperfections, motors: Motors, command: Float[Array, " joints"]
) -> tuple[Motors, Float[Array, " joints"]]:
    """Return the motors and the torque at the joints [N m] over the next millisecond.

    A delay between whole milliseconds is interpolated between two commands; a lag of zero
    passes the torque through.
    """
    limit = robot.torque_limit
    limited = jnp.clip(imperfections.torque_gain * command, -limit, limit)
    commands = jnp.concatenate([limited[None], motors.commands[:-1]])
    age = jnp.arange(MEMORY) - imperfections.delay / TIME_STEP
    delayed = jnp.maximum(1.0 - jnp.abs(age), 0.0) @ commands
    lag = jnp.maximum(imperfections.lag, 1e-9)
    torque = delayed + jnp.exp(-TIME_STEP / lag) * (motors.torque - delayed)
    motors = Motors(commands, torque)
    if robot.description.linkage is None:
        return motors, torque
    # leg by leg: one scatter over all legs would be a kernel of its own
    for first in range(0, len(torque), robot.description.leg_joints):
        driving, driven = (first + i - 1 for i in robot.description.linkage)
        torque = torque.at[driven].add(imperfections.linkage * torque[driving])
    return motors, jnp.clip(torque, -limit, limit)
