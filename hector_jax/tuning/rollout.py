"""The closed loop on the single rigid body, with phi between command and effect (Eq. 12, 13).

This is the only world that is differentiated. A tick solves the MPC, asks phi what the ground
returns and moves the body; in between, nothing is remembered but what `Carry` holds. A foot in the
air is carried where phi says that it lands, and an early touchdown that phi predicts acts there.

A `Variation` makes the body and its ground differ from what the controller believes, for weights
that have to bear with that.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax import qp
from hector_jax.control import gait
from hector_jax.control.controller import Plan, WalkConfig, contacts_needed, plan, walk_config
from hector_jax.control.disturbance import NO_DISTURBANCE, Disturbance
from hector_jax.control.footstep import Feet, feet_where
from hector_jax.control.reference import Anchor, Command, anchor_at, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, Range, check
from hector_jax.core.trajectory import State, Trajectory, Wrench, has_fallen
from hector_jax.core.tree import where
from hector_jax.grfm.effect import HISTORY, Effect, Window, from_yaw_frame, ground_effect, turn
from hector_jax.robot import srbm
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.model import Robot


@dataclass(frozen=True)
class RolloutConfig:
    """What a rollout is compiled for."""

    walk: WalkConfig = WalkConfig()
    ticks: int = 400  # T; 4 s
    lead: int = 0  # ticks in place before t = 0, outside the loss
    block: int = 500  # most ticks whose solves are stored; longer rollouts are computed twice

    def __post_init__(self) -> None:
        check(self, ticks=Range(2), lead=NOT_NEGATIVE, block=AT_LEAST_ONE)
        if self.lead > -self.walk.gait.first_tick:
            raise InputError(
                "RolloutConfig.lead must not reach back before the gait starts "
                f"({-self.walk.gait.first_tick} ticks), got {self.lead}"
            )


def rollout_config(robot: Robot, ticks: int = RolloutConfig.ticks) -> RolloutConfig:
    """The rollout that a robot's description asks for.

    Raises:
        InputError: one line naming the file, the key and what was expected.
    """
    walk, lead = walk_config(robot), robot.description.tuning.lead
    try:
        return RolloutConfig(walk=walk, ticks=ticks, lead=lead)
    except InputError as error:
        raise InputError(f"{robot.description.path}: tuning: {error}") from None


class Variation(NamedTuple):
    """How the world differs from what the controller believes; see `no_variation`."""

    mass: Float[Array, "*batch"]  # times the robot's
    inertia: Float[Array, "*batch"]  # likewise, all of it
    com: Float[Array, "*batch 3"]  # true centre of mass from the believed one, trunk axes [m]
    friction: Float[Array, "*batch"]  # of the ground: most |F_x| + |F_y| by F_z, as in the plants
    delay: Float[Array, "*batch"]  # by which effects come late [s], at most a tick
    noise: State  # standard deviations of what the controller sees, white from tick to tick
    seed: Int[Array, "*batch"]  # of the noise


def no_variation() -> Variation:
    """The world is as the controller believes."""
    one, zero, none = np.asarray(1.0), np.asarray(0.0), np.zeros(3)
    grips = np.asarray(1e3)
    return Variation(one, one, none, grips, zero, State(none, none, none, none), np.asarray(0))


class Carry(NamedTuple):
    """What one tick hands to the next."""

    state: State
    feet: Feet
    commands: Wrench  # (HISTORY, feet, 3) each, world frame, newest first
    anchor: Anchor  # taken anew at t = 0
    disturbance: Disturbance  # of the controller
    fallen: Bool[Array, ""]
    before: Effect | None = None  # of the last tick, world frame; where there is a variation


def init_carry(robot: Robot, anchor: Anchor) -> Carry:
    """A robot that stands still at its standing anchor, its feet commanded to share the weight."""
    zero = jnp.zeros(3)
    trunk = anchor.position - robot.com_offset
    local = foot_poses(robot, jnp.asarray(robot.standing_joints)).position
    share = robot.mass / len(local) * jnp.asarray(robot.gravity)
    standing = jnp.broadcast_to(share, (HISTORY, *local.shape))
    return Carry(
        state=State(zero, anchor.position, zero, zero),
        feet=Feet(trunk + local, jnp.zeros(len(local))),
        commands=Wrench(standing, jnp.zeros_like(standing)),
        anchor=anchor,
        disturbance=NO_DISTURBANCE,
        fallen=jnp.asarray(False),
    )


def _estimate_error(variation: Variation, state: State, tick: Int[Array, ""]) -> State:
    """Error of what the controller sees of the base."""
    key = jax.random.fold_in(jax.random.key(variation.seed), tick)
    drawn = jax.random.normal(key, (4, 3), state.position.dtype)
    return State(*(sigma * error for sigma, error in zip(variation.noise, drawn, strict=True)))


def _within_friction(wrench: Wrench, friction: Float[Array, ""]) -> Wrench:
    """A foot slips: its horizontal force is cut to what the friction pyramid can hold."""
    across = jnp.sum(jnp.abs(wrench.force[:, :2]), axis=-1)
    held = friction * jnp.maximum(wrench.force[:, 2], 0.0)
    slips = across > held
    share = jnp.where(slips, held / jnp.where(slips, across, 1.0), 1.0)
    return wrench._replace(force=wrench.force.at[:, :2].multiply(share[:, None]))


def _moved_by(
    variation: Variation,
    robot: Robot,
    state: State,
    now: Effect,
    feet: Float[Array, "feet 3"],
    before: Effect,
    feet_before: Float[Array, "feet 3"],
    dt: float,
) -> State:
    """`srbm.step` of the body as it is; what is delayed acts where the feet were."""
    share = variation.delay / dt
    mixed = jax.tree.map(lambda new, old: (1.0 - share) * new + share * old, now, before)
    lever = share * jnp.cross(feet_before - feet, before.wrench.force)
    wrench = mixed.wrench._replace(moment=mixed.wrench.moment + lever)
    body = robot._replace(
        mass=variation.mass * robot.mass, inertia=variation.inertia * jnp.asarray(robot.inertia)
    )

    def seen_from(state: State, offset: Float[Array, "3"]) -> State:
        arm = rotation_from_euler(state.euler) @ offset
        velocity = state.velocity + jnp.cross(state.ang_velocity, arm)
        return state._replace(position=state.position + arm, velocity=velocity)

    moved = srbm.step(body, seen_from(state, variation.com), wrench, feet, dt, mixed.legs)
    return seen_from(moved, -variation.com)


def _respond(
    effect: jax.tree_util.Partial,
    state: State,
    commands: Wrench,
    contact: Bool[Array, " feet"],
    since_switch: Float[Array, ""],
) -> Effect:
    """What acts on the body by phi, which sees and answers in the yaw frame."""
    yaw = state.euler[2]
    seen = Window(
        commands=turn(commands, -yaw),
        contact=contact,
        since_switch=since_switch,
        base=from_yaw_frame(state),
    )
    answer = effect(seen)
    return turn(answer, yaw)


def _move(
    robot: Robot,
    carry: Carry,
    acting: Effect,
    feet: Float[Array, "feet 3"],
    dt: float,
    variation: Variation | None,
) -> State:
    """State at the end of a tick."""
    if variation is None:
        return srbm.step(robot, carry.state, acting.wrench, feet, dt, acting.legs)
    before, there = carry.before, carry.feet.position
    assert before is not None  # `rollout` begins with what acts in standing
    return _moved_by(variation, robot, carry.state, acting, feet, before, there, dt)


class _Belief(NamedTuple):
    """What the controller sees of a carry."""

    state: State
    feet: Feet
    error: State | None  # of `state`; None without a variation


def _believe(carry: Carry, tick: Int[Array, ""], variation: Variation | None) -> _Belief:
    if variation is None:
        return _Belief(carry.state, carry.feet, None)
    error = _estimate_error(variation, carry.state, tick)
    # the legs know where the feet are from the body, not from the world
    feet = carry.feet._replace(position=carry.feet.position + error.position)
    return _Belief(jax.tree.map(jnp.add, carry.state, error), feet, error)


def _on_real_ground(
    carry: Carry, acting: Effect, planned: Plan, belief: _Belief, variation: Variation | None
) -> tuple[Effect, Feet]:
    """What acts on the body within the ground's friction, and where the feet really are."""
    position = planned.touchdown.position + acting.touchdown_error
    if variation is not None:
        assert belief.error is not None  # see `_believe`
        position = position - belief.error.position
        acting = acting._replace(wrench=_within_friction(acting.wrench, variation.friction))
    return acting, feet_where(planned.contact, carry.feet, Feet(position, planned.touchdown.yaw))


def _sample(
    config: RolloutConfig,
    robot: Robot,
    before: Carry,
    after: Carry,
    acting: Effect,
    planned: Plan,
    reference: State,
) -> Trajectory:
    """The sample of a tick."""
    return Trajectory(
        period=jnp.asarray(config.walk.gait.tick),
        initial=before.state,
        state=after.state,
        reference=reference,
        command=planned.wrench,
        effect=acting.wrench,
        contact=planned.contact,
        feet=after.feet.position,
        joints=jnp.asarray(robot.standing_joints),
        fallen=after.fallen,
        legs_touch=jnp.zeros_like(after.fallen),  # a rigid body has none
        # A plan whose QP has no unique minimiser can be walked, so `plan` and the simulators keep
        # its residual. It has no derivative, for which alone a rollout is walked: whoever tunes
        # looks at the residual and refuses.
        residual=jnp.where(planned.status == qp.Status.NOT_UNIQUE, jnp.inf, planned.residual),
    )


def step_carry(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    carry: Carry,
    tick: Int[Array, ""],
    variation: Variation | None = None,
) -> tuple[Carry, Trajectory]:
    """Walk one tick of the closed loop: plan, effect, motion.

    Returns the next carry and the tick's sample of the trajectory.
    """
    walk, ticks = config.walk, config.walk.gait
    here = anchor_at(robot, carry.state, carry.anchor.tick)
    anchor = where(tick == here.tick, here, carry.anchor)
    belief = _believe(carry, tick, variation)
    planned, disturbance = plan(
        walk,
        robot,
        walk.parameters(weights),
        command=command,
        anchor=anchor,
        tick=tick,
        state=belief.state,
        feet=belief.feet,
        disturbance=carry.disturbance,
        max_contacts=contacts_needed(walk, 0),
    )
    commands = jax.tree.map(
        lambda new, old: jnp.concatenate([new[None], old[:-1]]), planned.wrench, carry.commands
    )
    since = gait.since_switch(ticks, tick)
    acting = _respond(effect, carry.state, commands, planned.contact, since)
    acting, feet = _on_real_ground(carry, acting, planned, belief, variation)
    moved = _move(robot, carry, acting, feet.position, ticks.tick, variation)
    fallen = carry.fallen | has_fallen(moved, *robot.description.limits)
    before = None if variation is None else acting
    after = Carry(moved, feet, commands, anchor, disturbance, fallen, before)
    reference = reference_at(ticks.tick, command, anchor, tick + 1.0)
    return after, _sample(config, robot, carry, after, acting, planned, reference)


def walked_ticks(config: RolloutConfig, anchor: Anchor) -> Int[Array, " ticks"]:
    """Gait ticks of a rollout, those before t = 0 included."""
    return anchor.tick - config.lead + jnp.arange(config.lead + config.ticks)


def from_start(config: RolloutConfig, samples: Trajectory) -> Trajectory:
    """Trajectory from t = 0 on, of the samples of all ticks."""
    initial = jax.tree.map(lambda x: x[config.lead], samples.initial)
    later = jax.tree.map(lambda x: x[config.lead :], samples)
    return later._replace(initial=initial, period=jnp.asarray(config.walk.gait.tick))


def rollout(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    variation: Variation | None = None,
) -> Trajectory:
    """Walk on the single rigid body: `lead` ticks in place from standing, then the command.

    Args:
        config: what is compiled.
        robot: the body.
        weights: theta; the gradient is taken with respect to these.
        command: what to walk.
        anchor: where it stands and the gait tick of t = 0, see `reference.standing_anchor`.
        effect: phi, `Window -> Effect`.
        variation: what the controller does not know; None is compiled without any.

    Returns:
        Trajectory of T samples from t = 0. Nothing raises: read `fallen` and `residual` before
        believing it.

    Source: Eq. 12, 13.
    """

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(qp.SAVED))
    def tick(carry: Carry, j: Int[Array, ""]) -> tuple[Carry, Trajectory]:
        return step_carry(config, robot, weights, command, effect, carry, j, variation)

    def walk(carry: Carry, ticks: Int[Array, " block"]) -> tuple[Carry, Trajectory]:
        return jax.lax.scan(tick, carry, ticks)

    start, ticks = init_carry(robot, anchor), walked_ticks(config, anchor)
    if variation is not None:
        standing = jax.tree.map(lambda w: w[0], start.commands)
        start = start._replace(before=ground_effect(standing))
    blocks = -(-len(ticks) // config.block)
    if blocks == 1:
        _, samples = walk(start, ticks)
    else:
        # equal blocks compile to one loop: the last one walks on for a few ticks that are dropped
        size = -(-len(ticks) // blocks)
        more = ticks[0] + jnp.arange(blocks * size).reshape(blocks, size)
        _, samples = jax.lax.scan(jax.checkpoint(walk), start, more)
        flat = lambda x: x.reshape(-1, *x.shape[2:])[: len(ticks)]  # noqa: E731
        samples = jax.tree.map(flat, samples)
    return from_start(config, samples)
