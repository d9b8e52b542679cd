"""The whole controller: `plan` computes the wrench, `actuate` converts it into joint torques.

All worlds share it: the rigid-body rollout calls `plan` with the feet of its own state, the MuJoCo
worlds `step_plan` and `actuate` with measurements. It knows the nominal robot, never the plant.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.control import footstep, gait, legs
from hector_jax.control.disturbance import NO_DISTURBANCE, integrate_error
from hector_jax.control.footstep import Feet, FootstepConfig, FootstepParameters
from hector_jax.control.gait import PATTERNS, GaitConfig
from hector_jax.control.legs import LegConfig, LegParameters, Measurement
from hector_jax.control.mpc import Horizon, MpcConfig, MpcProblem, solve_mpc
from hector_jax.control.parameters import (
    COST,
    Other,
    Parameters,
    is_ours,
    name_of,
    tunable,
    without_numbers,
)
from hector_jax.control.reference import Anchor, Command, reference_at
from hector_jax.control.slip import Grip, SlipConfig, feel, first_grip
from hector_jax.control.twin import ReferenceInputs, TwinConfig
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rotation_from_euler, wrap_angle
from hector_jax.core.inputs import InputError, short_repr, unknown
from hector_jax.core.settings import check, from_table
from hector_jax.core.trajectory import Disturbance, State, Wrench
from hector_jax.qp import Solution
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot


@dataclass(frozen=True)
class WalkConfig:
    """Static configuration of the walking controller."""

    gait: GaitConfig = GaitConfig()
    mpc: MpcConfig = MpcConfig()
    footstep: FootstepConfig = FootstepConfig()
    legs: LegConfig = LegConfig()
    slip: SlipConfig = SlipConfig()
    twin: TwinConfig = TwinConfig()

    def __post_init__(self) -> None:
        check(self)
        if 2 * self.gait.tick > self.mpc_step + 1e-12:
            text = f"got tick {self.gait.tick} s and step {self.mpc_step} s"
            raise InputError(f"WalkConfig.gait.tick must be at most half the MPC step, {text}")

    def parameters(self, weights: Weights) -> Parameters:
        """Return the traced numbers of the controller, from the weights, else from this config."""
        mpc = self.mpc.parameters(weights._replace(others={}))
        parameters = Parameters(mpc, self.footstep.parameters, self.legs.parameters)
        for name, value in weights.others.items():
            if not is_ours(name):
                text = "is a number of a controller of your own, which walks with --walker"
                raise InputError(f"{name} {text}")
            if name.startswith(COST) and name.removeprefix(COST) not in mpc.costs:
                costs = (f"{COST}{cost}" for cost in mpc.costs)
                raise InputError(unknown("cost of the MPC", name, costs))
            parameters = tunable(name).write(parameters, value)
        return parameters

    def with_others(self, weights: Weights, others: Iterable[Other]) -> Weights:
        """Return the weights with these numbers added from this config if missing."""
        parameters = self.parameters(without_numbers(weights))
        missing = [name for name in map(name_of, others) if name not in weights.others]
        added = {name: np.asarray(tunable(name).read(parameters), float) for name in missing}
        return weights._replace(others={**weights.others, **added})

    @property
    def mpc_step(self) -> float:
        """MPC step dt [s]."""
        return self.mpc.step_ticks * self.gait.tick

    @property
    def plan_interval(self) -> float:
        """Time from plan to plan [s]."""
        return self.twin.plan_ticks * self.gait.tick

    @property
    def touchdowns(self) -> int:
        """Largest number of touchdowns of one foot within the horizon."""
        return -(-self.mpc.horizon * self.mpc.step_ticks // self.gait.cycle)


def walk_config(robot: Robot) -> WalkConfig:
    """Return the controller configuration from a robot's description and its feet.

    Raises:
        InputError: one line naming the file, the key and what was expected.
    """
    path = str(robot.description.path)
    table = {name: dict(section) for name, section in robot.description.control}
    table["mpc"] = {"contact": robot.structure.contact, **table.get("mpc", {})}
    table.setdefault("slip", {"share": 1.0})  # the feet of other robots may move without a slip
    config = from_table(path, WalkConfig, table)
    feet = len(robot.foot_point)
    if len(config.gait.offsets) != feet:
        patterns = [name for name, offsets in PATTERNS.items() if len(offsets) == feet]
        raise InputError(
            f"{path}: gait.pattern must be one of {feet} feet ({', '.join(patterns)}, or {feet} "
            f"numbers), got {short_repr(config.gait.pattern)}"
        )
    joints = robot.description.leg_joints
    for name in ("kp", "kd", *(("armature",) if config.legs.armature else ())):
        if len(numbers := getattr(config.legs, name)) != joints:
            raise InputError(
                f"{path}: legs.{name} must be a number for each of the {joints} joints of a leg, "
                f"got {short_repr(numbers)}"
            )
    return config


class Memory(NamedTuple):
    """State of the controller between ticks."""

    liftoff: Feet  # last stance of each foot
    disturbance: Disturbance
    grip: Grip
    wrench: Wrench  # planned last


class Plan(NamedTuple):
    """Output of the planner, constant over a tick."""

    wrench: Wrench  # commanded, world frame
    contact: Bool[Array, "*batch feet"]
    touchdown: Feet  # next touchdown of each foot
    swing_ticks: Int[Array, "*batch feet"]  # since lift-off
    residual: Float[Array, "*batch"]  # largest relative KKT residual of the QP
    status: Int[Array, "*batch"]  # of the QP, see `qp.Status`
    disturbance: Disturbance  # for the next plan
    measured: Measurement | None = None  # from which `step_plan` planned


def contacts_needed(config: WalkConfig, tick: int) -> int:
    """Return the largest number of feet with inputs in a plan: all before the gait starts."""
    gait, every = config.gait, config.twin.air_moments or config.twin.contact_at < 0.0
    return len(gait.offsets) if every or tick < gait.first_tick else gait.most_contacts


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
    desired: State | None = None,
) -> tuple[Horizon, State, Feet]:
    """Return the horizon of the MPC, its reference now, and the next touchdown of each foot.

    Args:
        config, robot, parameters: the controller.
        command, anchor: the commanded motion.
        tick: current gait tick.
        state: current base state.
        feet: current foot points; those of feet in the air are used by a frozen twin only.
        desired: pose at the start of the reference; None: by the rule of the twin.

    Source: Eq. 6, 14-16.
    """
    ticks, twin = config.gait, config.twin
    steps = tick + config.mpc.step_ticks * jnp.arange(config.mpc.horizon + 1)
    reference = twin.reference.of(ticks.tick, ReferenceInputs(command, anchor, steps, state))
    reference = twin.target(reference, reference_at(ticks.tick, command, anchor, tick), desired)
    current = jax.tree.map(lambda r: r[0], reference)

    shift = int(twin.contact_at * config.mpc.step_ticks)
    # step 0 takes the current contact
    times = jnp.concatenate([steps[:1] + min(shift, 0), steps[1:-1] + shift])
    count = gait.touchdowns(ticks, tick, times)
    wait = gait.ticks_to_touchdown(ticks, tick)
    lengths = {"stance": ticks.tick * ticks.stance, "swing": ticks.tick * ticks.swing}
    touch = partial(footstep.touchdown_points, config.footstep, robot, parameters, **lengths)
    touchdowns = [
        touch(state=state, reference=current, remaining=ticks.tick * (wait + number * ticks.cycle))
        for number in range(config.touchdowns)
    ]
    points, yaw = feet
    for number, touchdown in enumerate(touchdowns):
        landed = count > number
        points = jnp.where(landed[..., None], touchdown.position, points)
        yaw = jnp.where(landed, touchdown.yaw, yaw)
    targets = np.maximum(np.arange(1, len(steps)) - twin.late, 0)
    contact = gait.contact(ticks, times)
    horizon = Horizon(
        jax.tree.map(lambda r: r[targets], reference),
        *twin.linearisation.of(state, feet, reference, Feet(points, yaw)),
        contact=contact,
        inputs=jnp.ones_like(contact) if twin.air_moments else None,
        frame=rotation_from_euler(state.euler) if twin.frame == "trunk" else None,
    )
    return horizon, current, touchdowns[0]


def limit_errors(
    horizon: Horizon, state: State, reference: State, position: Any, yaw: Any = np.inf
) -> Horizon:
    """Shift and turn the reference so that it is at most so far away from the robot now.

    A push, a slip or a hand moves the robot further than tracking ever does. Weights that track
    tightly would ask for all the friction there is to pull it back, and it would fall.

    Args:
        horizon: of the MPC.
        state, reference: current and desired base state.
        position: largest horizontal distance [m]; infinite: no shift.
        yaw: largest heading error [rad].
    """
    away = (state.position - reference.position).at[2].set(0.0)
    distance = jnp.sqrt(jnp.sum(away**2) + 1e-12)  # has a derivative at zero
    shift = away * (jnp.maximum(distance - position, 0.0) / distance)
    error = state.euler[2] - reference.euler[2]
    wanted = horizon.reference
    euler = wanted.euler.at[:, 2].add(error - jnp.clip(error, -yaw, yaw))
    moved = wanted._replace(position=wanted.position + shift, euler=euler)
    return horizon._replace(reference=moved)


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
    last: Wrench | None = None,
    desired: State | None = None,
    max_contacts: int = 1,
    solver: Callable[..., tuple[Wrench, Solution]] = solve_mpc,
) -> Plan:
    """Solve the MPC for one tick.

    Args:
        config, robot, parameters: the controller.
        command, anchor: the commanded motion.
        tick, state: current gait tick and base state.
        feet: current foot points; those of feet in the air are used by a frozen twin only.
        disturbance: from the previous plan.
        last: wrench of the previous plan, which is kept between plans of several ticks; None: plan.
        desired: pose at the start of the reference of a log; None: by the rule of the twin.
        max_contacts: from `contacts_needed` (static).
        solver: `solve_mpc` or `mpc_by_rows.solve_mpc_by_rows`.

    Returns:
        The commanded wrench, the planned touchdowns, and the disturbance for the next plan.

    Source: Eq. 3-6.
    """
    state = config.twin.state(robot, state)
    horizon, reference, touchdown = plan_horizon(
        config,
        robot,
        parameters.footstep,
        command=command,
        anchor=anchor,
        tick=tick,
        state=state,
        feet=feet,
        desired=desired,
    )
    mpc, every = parameters.mpc, config.twin.plan_ticks
    horizon = limit_errors(horizon, state, reference, mpc.position_limit, mpc.yaw_limit)
    contact, swing_ticks = gait.contact(config.gait, tick), gait.swing_ticks(config.gait, tick)
    loaded = config.gait.tick * jnp.any(contact)
    disturbance = integrate_error(mpc.integral, disturbance, state, reference, loaded)
    mpc = mpc._replace(weights=config.twin.weights(mpc.weights))
    problem = MpcProblem(config.twin.body(robot), mpc, state, horizon, disturbance)
    solve = partial(solver, config.mpc, problem, config.mpc_step, max_contacts)
    held = last is not None and every > 1
    wrench, solution = _solve_or_keep(solve, last, tick % every == 0) if held else solve()
    residual = reduce(jnp.maximum, (solution.primal_residual, solution.dual_residual, solution.gap))
    if config.twin != TwinConfig():  # a foot in the air exerts nothing
        wrench = jax.tree.map(lambda x: contact[:, None] * x, wrench)
    return Plan(wrench, contact, touchdown, swing_ticks, residual, solution.status, disturbance)


def _solve_or_keep(
    solve: Callable[[], tuple[Wrench, Solution]], last: Wrench | None, now: Bool[Array, ""]
) -> tuple[Wrench, Solution]:
    """Return a new plan, or between plans the last wrench with the solution of a solved QP."""
    like, zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(solve))
    kept = jax.tree.map(lambda wrench, x: wrench.astype(x.dtype), last, like)
    return jax.lax.cond(now, solve, lambda: (kept, zero))


def measured_feet(robot: Robot, measurement: Measurement) -> Feet:
    """Return the foot points in the world, from the state estimate and the encoders."""
    R_wb = rotation_from_euler(measurement.state.euler)
    local = foot_poses(robot, measurement.joints)
    axes = R_wb @ local.rotation[:, :, 0].T  # x axes of the feet as columns
    offset = wrap_angle(jnp.arctan2(axes[1], axes[0]) - measurement.state.euler[2])
    position = legs.trunk_position(robot, measurement.state) + local.position @ R_wb.T
    return Feet(position, measurement.state.euler[2] + offset)


def standing_wrench(robot: Robot) -> Wrench:
    """Return the wrench (feet, 3) of the ground on a standing robot, shared by all feet."""
    feet = len(robot.foot_point)
    share = robot.mass / feet * jnp.asarray(robot.gravity)
    force = jnp.broadcast_to(share, (feet, 3))
    return Wrench(force, jnp.zeros_like(force))


def init_memory(robot: Robot, measurement: Measurement) -> Memory:
    """Return the memory of a standing robot."""
    feet = measured_feet(robot, measurement)
    return Memory(feet, NO_DISTURBANCE, first_grip(feet.position), standing_wrench(robot))


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
    """Run `plan` on a measurement and remember feet and grip; call once a tick."""
    feet = measured_feet(robot, measurement)
    now = {"feet": feet.position, "tick": tick}
    grip = feel(config.slip, config.gait, robot.standing_height, memory.grip, **now)
    mpc = parameters.mpc._replace(friction=(1.0 - grip.lost) * parameters.mpc.friction)
    planned = plan(
        config,
        robot,
        parameters._replace(mpc=mpc),
        command=command,
        anchor=anchor,
        tick=tick,
        state=measurement.state,
        feet=feet,
        disturbance=memory.disturbance,
        last=memory.wrench,
        max_contacts=max_contacts,
    )
    liftoff = footstep.feet_where(planned.contact, feet, memory.liftoff)
    memory = Memory(liftoff, planned.disturbance, grip, planned.wrench)
    return memory, planned._replace(measured=measurement)


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
    """Return the joint torque commands [N m] for a millisecond.

    Args:
        config, robot, parameters: the controller.
        plan, memory: plan and memory of the tick.
        substep: whole milliseconds since the plan.
        measurement: measurement in this millisecond.

    Source: Eq. 5.
    """
    target = legs.swing_joints(
        robot,
        parameters,
        measurement,
        start=memory.liftoff,
        end=plan.touchdown,
        elapsed=plan.swing_ticks * config.gait.tick + TIME_STEP * substep,
        swing=config.gait.tick * max(config.gait.swing, 1),  # with swing 0 no foot follows its path
    )
    return legs.joint_torques(
        robot, parameters, measurement, contact=plan.contact, wrench=plan.wrench, target=target
    )
