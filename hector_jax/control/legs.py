"""Joint torques for a plan: stance torques, swing foot path and joint PD (Eq. 5).

A stance leg pushes with tau = -J^T wrench, because the wrench is that of the ground on the robot
(the paper prints no minus). A swing leg follows a smooth path from lift-off to touchdown by inverse
kinematics and a joint PD with feedforward of the path's joint rates, of the leg's weight and, where
it is given, of the motors' inertia: without that, legs with heavy motors lag behind, and each step
lands short. The target lies slightly below the ground so that the foot does land.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.footstep import Feet
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rotation_from_euler, wrap_angle
from hector_jax.core.settings import NOT_NEGATIVE, check
from hector_jax.core.trajectory import State, Wrench
from hector_jax.robot.kinematics import foot_jacobians, inverse_legs, leg_gravity
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot


class Measurement(NamedTuple):
    """Measurements that the robot has of itself."""

    state: State  # estimate of the base
    joints: Float[Array, "*batch joints"]  # [rad], motor side
    joint_rates: Float[Array, "*batch joints"]  # [rad/s]


class LegParameters(NamedTuple):
    """Traced numbers of the swing path and the joints, which the tuner's model does not have."""

    height: Any  # [m] apex of the swing foot
    landing: Any  # [m] target height at touchdown
    kp: Any  # (j,) [N m/rad] for the joints of a leg
    kd: Any  # (j,) [N m s/rad]
    armature: Any  # (j,) [kg m^2] of the motors, at the joint; None: not fed forward
    gravity_compensation: Any  # share of the leg's own weight in the stance torque


@dataclass(frozen=True)
class LegConfig:
    """Defaults of the swing path and the joint gains."""

    height: float = 0.08  # [m] apex of the swing foot
    landing: float = -0.005  # [m] target height at touchdown
    kp: tuple[float, ...] = (60.0, 60.0, 60.0, 60.0, 20.0)  # [N m/rad] from hip yaw to ankle
    kd: tuple[float, ...] = (1.5, 1.5, 1.5, 1.5, 0.5)  # [N m s/rad]
    armature: tuple[float, ...] = ()  # [kg m^2] of the motors, fed forward; empty: not
    gravity_compensation: bool = False  # add the leg's own weight to the stance torque

    def __post_init__(self) -> None:
        check(self, height=NOT_NEGATIVE, kp=NOT_NEGATIVE, kd=NOT_NEGATIVE, armature=NOT_NEGATIVE)

    @property
    def parameters(self) -> LegParameters:
        """The traced numbers."""
        kp, kd, weight = np.array(self.kp), np.array(self.kd), float(self.gravity_compensation)
        armature = np.array(self.armature) if self.armature else None
        return LegParameters(self.height, self.landing, kp, kd, armature, weight)


class SwingTarget(NamedTuple):
    """Motion of the joints that moves swinging feet along their paths."""

    angles: Float[Array, " joints"]  # [rad]
    rates: Float[Array, " joints"]  # [rad/s]
    accelerations: Float[Array, " joints"] | None = None  # [rad/s^2]; None: not fed forward


def trunk_position(robot: Robot, state: State) -> Float[Array, "3"]:
    """Return the trunk origin [m]: p_c minus the constant offset of the centre of mass."""
    return state.position - rotation_from_euler(state.euler) @ robot.com_offset


def stance_torques(
    robot: Robot, state: State, joints: Float[Array, " joints"], wrench: Wrench
) -> Float[Array, " joints"]:
    """Return joint torques [N m] for the wrench on the feet, world frame. Source: Eq. 5, signed."""
    R_wb = rotation_from_euler(state.euler)
    Jv, Jw = foot_jacobians(robot, joints)
    force, moment = wrench.force @ R_wb, wrench.moment @ R_wb
    return -(jnp.einsum("fxj,fx->fj", Jv, force) + jnp.einsum("fxj,fx->fj", Jw, moment)).reshape(-1)


def swing_path(
    parameters: LegParameters,
    start: Float[Array, "feet 3"],
    end: Float[Array, "feet 3"],
    s: Float[Array, " feet"],
) -> Float[Array, "feet 3"]:
    """Return foot points [m] at share s of the swing: smooth in the plane, down to `landing`."""
    smooth = (s * s * (3.0 - 2.0 * s))[:, None]
    point = start + smooth * (end - start)
    half = jnp.where(s < 0.5, 2.0 * s, 2.0 - 2.0 * s)
    rise = half * half * (3.0 - 2.0 * half)
    ends = jnp.where(s < 0.5, start[:, 2], end[:, 2] + parameters.landing)
    apex = jnp.maximum(start[:, 2], end[:, 2]) + parameters.height
    height = ends + rise * (apex - ends)
    return jnp.concatenate([point[:, :2], height[:, None]], axis=1)


def swing_joints(
    robot: Robot,
    parameters: LegParameters,
    measurement: Measurement,
    *,
    start: Feet,
    end: Feet,
    elapsed: Float[Array, " feet"],
    swing: float,
) -> SwingTarget:
    """Return the motion of the joints that moves the feet along their swing paths.

    `elapsed` is the time since each foot's lift-off [s]. The rates are the derivative of the angles
    along the path while the trunk continues with its current velocity; the accelerations are the
    change of the rates in the next millisecond.
    """
    state = measurement.state

    def angles(time: Float[Array, ""]) -> Float[Array, " joints"]:
        s = jnp.clip((elapsed + time) / swing, 0.0, 1.0)
        R_wb = rotation_from_euler(state.euler)
        trunk = trunk_position(robot, state) + time * state.velocity
        target = swing_path(parameters, start.position, end.position, s)
        local = (target - trunk) @ R_wb
        turn = wrap_angle(end.yaw - start.yaw)
        yaw = wrap_angle(start.yaw + s * s * (3.0 - 2.0 * s) * turn - state.euler[2])
        up = jnp.broadcast_to(R_wb[2], local.shape)  # the soles are level
        return inverse_legs(robot, local, yaw, up, measurement.joints)

    def motion(time: Float[Array, ""]) -> tuple[Float[Array, " joints"], Float[Array, " joints"]]:
        return jax.jvp(angles, (time,), (jnp.ones(()),))

    if parameters.armature is None:
        return SwingTarget(*motion(jnp.zeros(())))
    at, rates = jax.vmap(motion)(jnp.array([0.0, TIME_STEP]))
    return SwingTarget(at[0], rates[0], (rates[1] - rates[0]) / TIME_STEP)


def joint_torques(
    robot: Robot,
    parameters: LegParameters,
    measurement: Measurement,
    *,
    contact: Bool[Array, " feet"],
    wrench: Wrench,
    target: SwingTarget,
) -> Float[Array, " joints"]:
    """Return torques [N m] within the limits: stance legs push, swing legs follow the target."""
    state, joints, joint_rates = measurement
    weight = leg_gravity(robot, joints, robot.gravity @ rotation_from_euler(state.euler))
    by_joint = partial(jnp.tile, reps=len(contact))
    kp, kd = by_joint(jnp.asarray(parameters.kp)), by_joint(jnp.asarray(parameters.kd))
    swing = kp * (target.angles - joints) + kd * (target.rates - joint_rates) + weight
    if target.accelerations is not None:
        swing += by_joint(jnp.asarray(parameters.armature)) * target.accelerations
    stance = stance_torques(robot, state, joints, wrench) + parameters.gravity_compensation * weight
    torque = jnp.where(jnp.repeat(contact, robot.description.leg_joints), stance, swing)
    return jnp.clip(torque, -robot.torque_limit, robot.torque_limit)
