"""The whole controller: `plan` decides the wrench, `actuate` turns it into joint torques.

One controller in all worlds: the rigid-body rollout calls `plan` with the feet that it carries
along; the MuJoCo worlds call `step_plan` and `actuate` with what they measure. The controller knows
the nominal robot only, never the plant's own numbers.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.control import gait, legs
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance, integrate_error
from hector_jax.control.footstep import (
    Feet,
    FootstepConfig,
    FootstepParameters,
    feet_where,
    touchdown_points,
)
from hector_jax.control.gait import PATTERNS, GaitConfig
from hector_jax.control.legs import LegConfig, LegParameters, Measurement
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, solve_mpc
from hector_jax.control.parameters import TUNABLES, Parameters
from hector_jax.control.reference import Anchor, Command, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rotation_from_euler, wrap_angle
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import check, from_table
from hector_jax.core.trajectory import State, Wrench
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot


@dataclass(frozen=True)
class WalkConfig:
    """What the walking controller is compiled for."""

    gait: GaitConfig = GaitConfig()
    mpc: MpcConfig = MpcConfig()
    footstep: FootstepConfig = FootstepConfig()
    legs: LegConfig = LegConfig()

    def __post_init__(self) -> None:
        check(self)
        if 2 * self.gait.tick > self.mpc_step + 1e-12:
            raise InputError(
                "WalkConfig.gait.tick must be at most half the MPC step, "
                f"got tick {self.gait.tick} s and step {self.mpc_step} s"
            )

    def parameters(self, weights: Weights) -> Parameters:
        """The controller's numbers, to be traced: those of the weights, else of this config."""
        mpc = self.mpc.parameters(weights._replace(others={}))
        parameters = Parameters(mpc, self.footstep.parameters, self.legs.parameters)
        for name, value in weights.others.items():
            parameters = TUNABLES[name].write(parameters, value)
        return parameters

    def with_others(self, weights: Weights, names: Iterable[str]) -> Weights:
        """The weights with `others` of these names, from this config where they have none."""
        parameters = self.parameters(weights)
        missing = [name for name in names if name not in weights.others]
        more = {name: np.asarray(TUNABLES[name].read(parameters), float) for name in missing}
        return weights._replace(others={**weights.others, **more})

    @property
    def mpc_step(self) -> float:
        """MPC step dt [s]."""
        return self.mpc.step_ticks * self.gait.tick

    @property
    def touchdowns(self) -> int:
        """Most touchdowns of one foot within the horizon."""
        return -(-self.mpc.horizon * self.mpc.step_ticks // self.gait.cycle)


def walk_config(robot: Robot) -> WalkConfig:
    """The controller that a robot's description asks for, and its feet.

    Raises:
        InputError: one line naming the file, the key and what was expected.
    """
    path = str(robot.description.path)
    given = {name: dict(section) for name, section in robot.description.control}
    given["mpc"] = {"contact": robot.structure.contact, **given.get("mpc", {})}
    config = from_table(path, WalkConfig, given)
    feet = len(robot.foot_point)
    if len(config.gait.offsets) != feet:
        fitting = [name for name, offsets in PATTERNS.items() if len(offsets) == feet]
        raise InputError(
            f"{path}: gait.pattern must be one of {feet} feet ({', '.join(fitting)}, or {feet} "
            f"numbers), got {short_repr(config.gait.pattern)}"
        )
    try:
        config.legs.check_joints(robot.description.leg_joints)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return config


class Memory(NamedTuple):
    """What the controller remembers: where each foot last stood, and what its model lacks."""

    liftoff: Feet
    disturbance: Disturbance


class Plan(NamedTuple):
    """What holds over a tick."""

    wrench: Wrench  # commanded, world frame
    contact: Bool[Array, "*batch feet"]
    touchdown: Feet  # where each foot next comes down
    swing_ticks: Int[Array, "*batch feet"]  # since lift-off
    residual: Float[Array, "*batch"]  # worst relative KKT residual of the QP
    status: Int[Array, "*batch"]  # of the QP, see `qp.Status`


class Retune(NamedTuple):
    """Weights that change while they walk: a carry, and what gives those of the next tick."""

    init: Any  # carry before t = 0
    # carry, gait tick, anchor, what is measured, wrench commanded over the tick before
    step: Callable[[Any, int, Anchor, Measurement, Wrench], tuple[Any, Weights]]


def contacts_needed(config: WalkConfig, tick: int) -> int:
    """Feet that may stand at once in a plan: all of them before the gait starts."""
    gait = config.gait
    return len(gait.offsets) if tick < gait.first_tick else gait.most_contacts


def plan_horizon(
    config: WalkConfig,
    robot: Robot,
    parameters: FootstepParameters,
    *,
    command: Command,
    anchor: Anchor,
    tick: Int[Array, ""],
    state: State,
    feet: Feet,
) -> tuple[Horizon, Feet]:
    """What the MPC is to plan about, and where each foot next comes down.

    Args:
        config, robot, parameters: the controller.
        command, anchor: what to walk.
        tick: gait tick now.
        state: base now.
        feet: foot points now; of a foot in the air they are not used.

    Source: Eq. 6, 14-16.
    """
    ticks = config.gait
    steps = tick + config.mpc.step_ticks * jnp.arange(config.mpc.horizon + 1)
    reference = jax.vmap(lambda t: reference_at(ticks.tick, command, anchor, t))(steps)
    now = jax.tree.map(lambda r: r[0], reference)

    # The contact of step 0 is the present one, of a later step that at the middle of its interval.
    middles = jnp.concatenate([tick[None], steps[1:-1] + config.mpc.step_ticks // 2])
    count = gait.touchdowns(ticks, tick, middles)
    wait = gait.ticks_to_touchdown(ticks, tick)
    times = {"stance": ticks.tick * ticks.stance, "swing": ticks.tick * ticks.swing}
    touch = partial(touchdown_points, config.footstep, robot, parameters, **times)
    touchdowns = [
        touch(state=state, reference=now, remaining=ticks.tick * (wait + number * ticks.cycle))
        for number in range(config.touchdowns)
    ]
    foot_points, foot_yaw = feet
    for number, touchdown in enumerate(touchdowns):
        landed = count > number
        foot_points = jnp.where(landed[..., None], touchdown.position, foot_points)
        foot_yaw = jnp.where(landed, touchdown.yaw, foot_yaw)

    # Linearised about the reference's motion carried on from where the robot is: levers stay true
    # under a tracking error.
    start = jax.tree.map(lambda r: r[:-1], reference)
    path = state.position + start.position - now.position
    heading = state.euler[2] + start.euler[:, 2] - now.euler[2]
    horizon = Horizon(
        reference=jax.tree.map(lambda r: r[1:], reference),
        euler=jnp.zeros_like(start.euler).at[:, 2].set(heading),
        lever=foot_points - path[:, None],
        foot_yaw=foot_yaw,
        contact=gait.contact(ticks, middles),
    )
    return horizon, touchdowns[0]


def plan(
    config: WalkConfig,
    robot: Robot,
    parameters: Parameters,
    *,
    command: Command,
    anchor: Anchor,
    tick: Int[Array, ""],
    state: State,
    feet: Feet,
    disturbance: Disturbance = NO_DISTURBANCE,
    max_contacts: int = 1,
) -> tuple[Plan, Disturbance]:
    """Solve the MPC for one tick.

    Args:
        config, robot, parameters: the controller.
        command, anchor: what to walk.
        tick: gait tick now.
        state: base now.
        feet: foot points now; of a foot in the air they are not used.
        disturbance: of the plan before.
        max_contacts: from `contacts_needed` (static).

    Returns:
        The commanded wrench with the planned touchdowns, and the disturbance for the next plan.

    Source: Eq. 3-6.
    """
    horizon, touchdown = plan_horizon(
        config,
        robot,
        parameters.footstep,
        command=command,
        anchor=anchor,
        tick=tick,
        state=state,
        feet=feet,
    )
    here, dt = reference_at(config.gait.tick, command, anchor, tick), config.gait.tick
    disturbance = integrate_error(parameters.mpc.integral, disturbance, state, here, dt)
    problem = MpcProblem(robot, parameters.mpc, state, horizon, disturbance)
    wrench, solution = solve_mpc(config.mpc, problem, dt=config.mpc_step, max_contacts=max_contacts)
    residual = jnp.maximum(solution.primal_residual, solution.dual_residual)
    residual = jnp.maximum(residual, solution.gap)
    stands, since = gait.contact(config.gait, tick), gait.swing_ticks(config.gait, tick)
    planned = Plan(wrench, stands, touchdown, since, residual, solution.status)
    return planned, disturbance


def measured_feet(robot: Robot, measurement: Measurement) -> Feet:
    """Foot points in the world, from the estimate and the encoders."""
    R_wb = rotation_from_euler(measurement.state.euler)
    local = foot_poses(robot, measurement.joints)
    axes = R_wb @ local.rotation[:, :, 0].T  # the feet's x axes, as columns
    offset = wrap_angle(jnp.arctan2(axes[1], axes[0]) - measurement.state.euler[2])
    position = legs.trunk_position(robot, measurement.state) + local.position @ R_wb.T
    return Feet(position, measurement.state.euler[2] + offset)


def init_memory(robot: Robot, measurement: Measurement) -> Memory:
    """Memory of a robot that stands."""
    return Memory(measured_feet(robot, measurement), NO_DISTURBANCE)


def step_plan(
    config: WalkConfig,
    robot: Robot,
    parameters: Parameters,
    *,
    command: Command,
    anchor: Anchor,
    tick: Int[Array, ""],
    memory: Memory,
    measurement: Measurement,
    max_contacts: int = 1,
) -> tuple[Memory, Plan]:
    """`plan` from what is measured; remembers where the standing feet are. Once a tick."""
    feet = measured_feet(robot, measurement)
    planned, disturbance = plan(
        config,
        robot,
        parameters,
        command=command,
        anchor=anchor,
        tick=tick,
        state=measurement.state,
        feet=feet,
        disturbance=memory.disturbance,
        max_contacts=max_contacts,
    )
    return Memory(feet_where(planned.contact, feet, memory.liftoff), disturbance), planned


def actuate(
    config: WalkConfig,
    robot: Robot,
    parameters: LegParameters,
    *,
    plan: Plan,
    memory: Memory,
    substep: Int[Array, ""],
    measurement: Measurement,
) -> Float[Array, " joints"]:
    """Joint torque commands [N m] of a millisecond.

    Args:
        config, robot, parameters: the controller.
        plan, memory: of the tick.
        substep: whole milliseconds since the plan.
        measurement: of this millisecond.

    Source: Eq. 5.
    """
    target, target_rates = legs.swing_joints(
        robot,
        parameters,
        measurement,
        start=memory.liftoff,
        end=plan.touchdown,
        elapsed=plan.swing_ticks * config.gait.tick + TIME_STEP * substep,
        swing=config.gait.tick * max(config.gait.swing, 1),  # at 0 no foot follows its path
    )
    return legs.joint_torques(
        robot,
        parameters,
        measurement,
        contact=plan.contact,
        wrench=plan.wrench,
        target=target,
        target_rates=target_rates,
    )
