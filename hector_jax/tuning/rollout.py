"""The closed loop on the single rigid body, with phi between command and effect (Eq. 12, 13).

This is the only world that is differentiated. A tick solves the MPC, evaluates phi for the reaction
of the ground and moves the body; its only memory is `Carry`. A foot in the air moves to the
touchdown that phi predicts, and an early touchdown that phi predicts acts there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int

from hector_jax import qp
from hector_jax.control import gait
from hector_jax.control.controller import (
    Plan,
    WalkConfig,
    contacts_needed,
    plan,
    standing_wrench,
    walk_config,
)
from hector_jax.control.disturbance import NO_DISTURBANCE
from hector_jax.control.footstep import Feet, feet_where
from hector_jax.control.mpc import solve_mpc
from hector_jax.control.mpc_by_rows import solve_mpc_by_rows
from hector_jax.control.reference import Anchor, Command, anchor_at, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, Range, check
from hector_jax.core.trajectory import Disturbance, State, Trajectory, Wrench, has_fallen
from hector_jax.core.tree import layout, pack, unpack, where
from hector_jax.grfm.effect import HISTORY, Effect, Window, from_yaw_frame, ground_effect, turn
from hector_jax.robot import srbm
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.model import Robot
from hector_jax.tuning.variation import (
    Variation,
    estimate_error,
    moved_by,
    noise_and_delay,
    within_friction,
)


@dataclass(frozen=True)
class RolloutConfig:
    """Static settings of a rollout."""

    walk: WalkConfig = WalkConfig()
    ticks: int = 400  # T; 4 s
    lead: int = 0  # ticks in place before t = 0, outside the loss
    block: int = 500  # most ticks with stored solves; longer rollouts are computed twice
    estimate_noise: float = 0.0  # factor on the noise of a real robot's estimate
    delay: float = 0.0  # [s] of the ground's reaction, at most a tick
    forward: bool = False  # for derivatives by many numbers in forward mode, see `mpc_by_rows`

    def __post_init__(self) -> None:
        not_negative = dict.fromkeys(("lead", "estimate_noise"), NOT_NEGATIVE)
        check(self, ticks=Range(2), block=AT_LEAST_ONE, **not_negative)
        check(self, delay=Range(0.0, self.walk.gait.tick))
        if self.lead > -self.walk.gait.first_tick:
            raise InputError(
                "RolloutConfig.lead must not reach back before the gait starts "
                f"({-self.walk.gait.first_tick} ticks), got {self.lead}"
            )


def rollout_config(robot: Robot, seconds: float = 4.0) -> RolloutConfig:
    """Return the settings of a rollout of this length [s] from a robot's description.

    Raises:
        InputError: one line naming the file, the key and what was expected.
    """
    walk, tuning = walk_config(robot), robot.description.tuning
    settings = {name: getattr(tuning, name) for name in ("lead", "estimate_noise", "delay")}
    try:
        return RolloutConfig(walk=walk, ticks=round(seconds / walk.gait.tick), **settings)
    except InputError as error:
        raise InputError(f"{robot.description.path}: tuning: {error}") from None


class Carry(NamedTuple):
    """State of the closed loop between two ticks."""

    state: State
    feet: Feet
    commands: Wrench  # (HISTORY, feet, 3) each, world frame, newest first
    anchor: Anchor  # reset at t = 0
    disturbance: Disturbance  # of the controller
    fallen: Bool[Array, ""]
    before: Effect | None = None  # of the last tick, world frame; None without a variation


def varied(carry: Carry) -> Carry:
    """Return the parts of a carry that depend on the weights, with None for the others.

    Tangents of a carry have the same structure.
    """
    return carry._replace(anchor=carry.anchor._replace(tick=None), fallen=None)


def with_constants(parts: Carry, carry: Carry) -> Carry:
    """Undo `varied`: put the constant parts of a carry back."""
    anchor = parts.anchor._replace(tick=carry.anchor.tick)
    return parts._replace(anchor=anchor, fallen=carry.fallen)


def command_history(command: Wrench) -> Wrench:
    """Return past commands (HISTORY, feet, 3) that all equal `command`."""
    return jax.tree.map(lambda w: jnp.broadcast_to(w, (HISTORY, *jnp.shape(w))), command)


class Scenario(NamedTuple):
    """What a rollout walks, beside its settings and the weights."""

    robot: Robot  # the body that the controller assumes
    command: Command  # velocities
    anchor: Anchor  # standing pose and gait tick of t = 0, see `reference.standing_anchor`
    effect: jax.tree_util.Partial  # phi, `Window -> Effect`
    variation: Variation | None = None  # None: the noise and the delay of the settings


def init_carry(scenario: Scenario) -> Carry:
    """Return the carry of a robot standing at its anchor, its weight shared by all feet."""
    robot, anchor, zero = scenario.robot, scenario.anchor, jnp.zeros(3)
    trunk = anchor.position - robot.com_offset
    local = foot_poses(robot, jnp.asarray(robot.standing_joints)).position
    standing = standing_wrench(robot)
    state = State(zero, anchor.position, zero, zero)
    feet = Feet(trunk + local, jnp.zeros(len(local)))
    commands = command_history(standing)
    before = None if scenario.variation is None else ground_effect(standing)
    return Carry(state, feet, commands, anchor, NO_DISTURBANCE, jnp.asarray(False), before)


def _estimate(
    carry: Carry, tick: Int[Array, ""], variation: Variation | None
) -> tuple[State, Feet, State | None]:
    """Return the estimated state and feet, and the error of the state; None without variation."""
    if variation is None:
        return carry.state, carry.feet, None
    error = estimate_error(variation, carry.state, tick)
    # the legs measure the feet relative to the body, not to the world
    feet = carry.feet._replace(position=carry.feet.position + error.position)
    return jax.tree.map(jnp.add, carry.state, error), feet, error


def _on_real_ground(
    carry: Carry, response: Effect, planned: Plan, error: State | None, variation: Variation | None
) -> tuple[Effect, Feet]:
    """Return the effect on the body within the ground's friction, and the true feet."""
    position = planned.touchdown.position + response.touchdown_error
    if variation is not None and error is not None:
        position = position - error.position
        response = response._replace(wrench=within_friction(response.wrench, variation.friction))
    return response, feet_where(planned.contact, carry.feet, Feet(position, planned.touchdown.yaw))


def _move(scenario: Scenario, carry: Carry, response: Effect, feet: Feet, dt: float) -> State:
    """Return the state of the body after a tick of an effect at the feet."""
    robot, variation, state = scenario.robot, scenario.variation, carry.state
    if variation is None:
        return srbm.step(robot, state, response.wrench, feet.position, dt, load=response.legs)
    assert carry.before is not None  # `init_carry` starts with the effect of standing
    now, before = (response, feet.position), (carry.before, carry.feet.position)
    return moved_by(variation, robot, state, dt=dt, now=now, before=before)


def _sample(
    config: RolloutConfig,
    robot: Robot,
    *,
    before: Carry,
    after: Carry,
    effect: Wrench,
    planned: Plan,
    reference: State,
) -> Trajectory:
    """Return the sample of a tick."""
    return Trajectory(
        period=jnp.asarray(config.walk.gait.tick),
        initial=before.state,
        state=after.state,
        reference=reference,
        command=planned.wrench,
        effect=effect,
        contact=planned.contact,
        feet=after.feet.position,
        joints=jnp.asarray(robot.standing_joints),
        fallen=after.fallen,
        legs_touch=jnp.zeros_like(after.fallen),  # a rigid body has no legs
        # A plan whose QP has no unique minimiser can be walked, so `plan` and the simulators keep
        # its residual. It has no derivative, which tuning needs: an infinite residual is rejected.
        residual=jnp.where(planned.status == qp.Status.NOT_UNIQUE, jnp.inf, planned.residual),
    )


def _own_planner(
    config: RolloutConfig,
    scenario: Scenario,
    weights: Weights,
    carry: Carry,
    tick: Int[Array, ""],
) -> Callable[..., Plan]:
    """Return this project's controller as a function of the estimated `state` and `feet`."""
    walk = config.walk
    return partial(
        plan,
        walk,
        scenario.robot,
        walk.parameters(weights),
        command=scenario.command,
        anchor=carry.anchor,
        tick=tick,
        disturbance=carry.disturbance,
        last=jax.tree.map(lambda w: w[0], carry.commands),
        max_contacts=contacts_needed(walk, 0),
        solver=solve_mpc_by_rows if config.forward else solve_mpc,
    )


def step_carry(
    config: RolloutConfig,
    scenario: Scenario,
    weights: Weights,
    carry: Carry,
    tick: Int[Array, ""],
    *,
    error: tuple[State, Feet] | None = None,
    planner: Callable[..., Plan] | None = None,
) -> tuple[Carry, Trajectory]:
    """Walk one tick of the closed loop: plan, effect, motion.

    Returns the next carry and the tick's sample of the trajectory. The `error` is that of the
    estimated state and feet in place of a variation's. A `planner` of `state` and `feet` plans in
    place of this controller. The anchor is that of the carry.
    """
    robot, command, _, effect, variation = scenario
    walk, dt = config.walk, config.walk.gait.tick
    new_anchor = anchor_at(robot, carry.state, carry.anchor.tick)
    anchor = where(tick == new_anchor.tick, new_anchor, carry.anchor)
    state, feet, drift = _estimate(carry, tick, variation)
    if error is not None:
        state, feet = jax.tree.map(jnp.add, (carry.state, carry.feet), tuple(error))
    planner = planner or _own_planner(
        config, scenario, weights, carry._replace(anchor=anchor), tick
    )
    planned = planner(state=state, feet=feet)
    commands = jax.tree.map(
        lambda new, old: jnp.concatenate([new[None], old[:-1]]), planned.wrench, carry.commands
    )
    since = gait.since_switch(walk.gait, tick)
    yaw = carry.state.euler[2]  # the frame of phi turns with it
    window = Window(turn(commands, -yaw), planned.contact, since, from_yaw_frame(carry.state))
    response = turn(effect(window), yaw)
    response, feet = _on_real_ground(carry, response, planned, drift, variation)
    state = _move(scenario, carry, response, feet, dt)
    fallen = carry.fallen | has_fallen(state, *robot.description.limits)
    before = None if variation is None else response
    after = Carry(state, feet, commands, anchor, planned.disturbance, fallen, before)
    sample = _sample(
        config,
        robot,
        before=carry,
        after=after,
        effect=response.wrench,
        planned=planned,
        reference=reference_at(dt, command, anchor, tick + 1.0),
    )
    return after, sample


def walked_ticks(config: RolloutConfig, anchor: Anchor) -> Int[Array, " ticks"]:
    """Return the gait ticks of a rollout, including those before t = 0."""
    return anchor.tick - config.lead + jnp.arange(config.lead + config.ticks)


def without_lead(config: RolloutConfig, samples: Trajectory) -> Trajectory:
    """Cut the samples of all ticks to the trajectory from t = 0 on."""
    initial = jax.tree.map(lambda x: x[config.lead], samples.initial)
    walk = jax.tree.map(lambda x: x[config.lead :], samples)
    return walk._replace(initial=initial, period=jnp.asarray(config.walk.gait.tick))


def with_variation(config: RolloutConfig, scenario: Scenario) -> Scenario:
    """Return a scenario with its variation, or with the noise and delay of the settings."""
    if scenario.variation is not None or not (config.estimate_noise or config.delay):
        return scenario
    return scenario._replace(variation=noise_and_delay(config.estimate_noise, config.delay))


def rollout(config: RolloutConfig, scenario: Scenario, weights: Weights) -> Trajectory:
    """Walk on the single rigid body: `lead` ticks in place from standing, then the command.

    Args:
        config: static settings.
        scenario: robot, command, start, phi and variation.
        weights: theta; the gradient is taken with respect to these.

    Returns:
        Trajectory of T samples from t = 0. Nothing raises: check `fallen` and `residual` before
        using it.

    Source: Eq. 12, 13.
    """
    policy = jax.checkpoint_policies.save_only_these_names(qp.SAVED)
    scenario = with_variation(config, scenario)
    first, ticks = init_carry(scenario), walked_ticks(config, scenario.anchor)

    # A GPU copies one array of all numbers in a tick faster than many small ones. How to unpack a
    # sample is known only while a tick is traced: the scan returns it as a tree without arrays.
    def tick(packed: jax.Array, number: Int[Array, ""]) -> tuple:
        carry = unpack(layout(first), packed)
        after, sample = step_carry(config, scenario, weights, carry, number)
        assert layout(after) == layout(first)
        return pack(after), (pack(sample), jax.tree_util.Partial(partial(unpack, layout(sample))))

    walk = partial(jax.lax.scan, jax.checkpoint(tick, policy=policy))
    start = pack(first)
    blocks = -(-len(ticks) // config.block)
    if blocks == 1:
        _, (samples, to_samples) = walk(start, ticks)
    else:
        # equal blocks compile to one loop: the last block has a few more ticks, which are dropped
        size = -(-len(ticks) // blocks)
        padded = ticks[0] + jnp.arange(blocks * size).reshape(blocks, size)
        _, (samples, to_samples) = jax.lax.scan(jax.checkpoint(walk), start, padded)
        samples = samples.reshape(-1, samples.shape[-1])[: len(ticks)]
    return without_lead(config, to_samples(samples))
