"""The closed loop of controller and plant, for every physics engine.

A walk starts with double stance under the MPC, then gait cycles in place; at t = 0 the reference is
anchored at the true centre of mass and yaw. Per tick `step_plan` solves the MPC, per millisecond
`actuate` turns the plan into torques, the engine steps its physics and reads its contacts,
and `sample` returns the true state. An engine gives its coordinates as a flat reading
(`sensing.unpack_reading`); the continuous yaw is passed separately.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.controller import Plan, WalkConfig
from hector_jax.control.reference import Anchor, Command, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, expect
from hector_jax.core.trajectory import Belief, State, Trajectory, Wrench, has_fallen
from hector_jax.robot.description import Description
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.sensing import Ground, Touches
from hector_jax.sim.world import NO_PUSH, Imperfections, Push


class Job(NamedTuple):
    """A walk to simulate."""

    weights: Weights
    command: Command
    imperfections: Imperfections
    seconds: float = 4.0  # from t = 0
    seed: int = 0  # of the estimator's errors
    start_tick: int = 0  # gait tick of t = 0: the phase at which the command starts
    push: Push = NO_PUSH
    plant: Robot | None = None  # another model that walks in place of the controller's own

    def body(self, robot: Robot) -> Robot:
        """Return the robot of the plant's file and standing pose; by default the controller's.

        Raises:
            InputError: its joints are not those of the controller's robot.
        """
        if self.plant is None:
            return robot
        check_plant(robot.description, self.plant.description)
        return self.plant


def check_plant(robot: Description, plant: Description) -> None:
    """Check that a robot can be the plant of the controller of another robot.

    Raises:
        InputError: the plant has other joints, or in another order.
    """
    text = f"joints are {', '.join(plant.joints)}; as a plant of {robot.path} expected "
    expect(plant.path, robot.joints == plant.joints, text + ", ".join(robot.joints))


class Sample(NamedTuple):
    """The true values of one sample; see Trajectory."""

    state: State
    reference: State
    effect: Wrench
    feet: Float[Array, "*batch feet 3"]
    joints: Float[Array, "*batch joints"]
    fallen: Bool[Array, "*batch"]
    legs_touch: Bool[Array, "*batch"]


def contact_effect(points: Float[Array, "feet 3"], ground: Ground) -> Wrench:
    """Return the ground's wrench over a millisecond, its moments about the foot points.

    Args:
        points: of the feet at the start of the millisecond [m].
        ground: contacts in the millisecond.
    """
    return Wrench(ground.force, ground.moment - jnp.cross(points - ground.centre, ground.force))


def sample(
    config: WalkConfig,
    robot: Robot,
    *,
    command: Command,
    anchor: Anchor,
    time: Float[Array, ""],
    yaw: Float[Array, ""],
    after: Float[Array, " reading"],
    feet: Float[Array, "feet 3"],
    effect: Wrench,
    touches: Touches,
) -> Sample:
    """Return the true values of one sample.

    Args:
        config: the gait's tick.
        robot: nominal robot.
        command, anchor: command, and where its reference starts.
        time: gait time at the end of the sample, in ticks.
        yaw: a true yaw [rad] shortly before.
        after: coordinates at the end of the sample.
        feet: foot points there [m].
        effect: mean wrench of the ground over the sample.
        touches: contacts in the sample other than feet on the floor.
    """
    reading = sensing.unpack_reading(after)
    state = sensing.base_state(robot, reading, yaw)
    return Sample(
        state=state,
        reference=reference_at(config.gait.tick, command, anchor, time),
        effect=effect,
        feet=feet,
        joints=reading.joints + reading.slack,
        fallen=has_fallen(state, *robot.description.limits) | touches.floor,
        legs_touch=touches.legs,
    )


def as_trajectory(
    period: Float[Array | np.ndarray, ""], plans: Plan, samples: Sample, rate: int
) -> Trajectory:
    """Return the trajectory of the samples after the first, each with the plan in force.

    Args:
        period: of the samples [s].
        plans: of the ticks.
        samples: that before the first tick, then those of the ticks.
        rate: number of samples in a tick.
    """
    measured = plans.measured
    assert measured is not None  # by `step_plan`
    starts = jax.tree.map(lambda x: x[:-1:rate], samples)
    errors = jax.tree.map(lambda x, true: x - true, measured.state, starts.state)
    belief = Belief(errors, measured.joints - starts.joints, plans.disturbance)
    held = plans.wrench, plans.contact, plans.residual, belief
    command, contact, residual, belief = jax.tree.map(lambda x: x.repeat(rate, axis=0), held)
    return Trajectory(
        period=period,
        initial=jax.tree.map(lambda x: x[0], samples.state),
        command=command,
        contact=contact,
        residual=residual,
        belief=belief,
        **jax.tree.map(lambda x: x[1:], samples)._asdict(),
    )


def substeps(config: WalkConfig) -> int:
    """Return the number of milliseconds in a tick.

    Raises:
        InputError: a tick is no whole number of milliseconds.
    """
    count = round(config.gait.tick / TIME_STEP)
    if count < 1 or abs(count * TIME_STEP - config.gait.tick) > 1e-9:
        raise InputError(
            f"GaitConfig.tick must be a multiple of {TIME_STEP} s, got {config.gait.tick}"
        )
    return count


def first_tick(config: WalkConfig) -> int:
    """Return the tick at which a simulated walk begins, standing."""
    return config.gait.first_tick - config.gait.stand


def walk_ticks(config: WalkConfig, seconds: float, start_tick: int) -> int:
    """Return the number of ticks of a walk from t = 0 on.

    Raises:
        InputError: the number is zero, or t = 0 is not after the walk's first tick.
    """
    ticks = round(seconds / config.gait.tick)
    if ticks < 1:
        raise InputError(f"a walk needs at least one tick of {config.gait.tick} s, got {seconds} s")
    if start_tick <= first_tick(config):
        raise InputError(
            f"a walk stands from tick {first_tick(config)} on; start_tick {start_tick} is not later"
        )
    return ticks
