"""The closed loop on the single rigid body, with phi between command and effect (Eq. 12, 13).

This is the only world that is differentiated. A tick solves the MPC, asks phi what the ground
returns and moves the body; in between, nothing is remembered but what `Carry` holds. A foot in the
air is carried at its planned touchdown point, where an early touchdown that phi predicts acts too.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from hector_jax.control import gait, qp
from hector_jax.control.reference import Anchor, Command, anchor_at, reference_at
from hector_jax.control.walking import Feet, WalkConfig, plan, slots_needed
from hector_jax.control.weights import Weights
from hector_jax.model import srbm
from hector_jax.model.effect import HISTORY, Window, from_yaw_frame, turn
from hector_jax.model.kinematics import foot_poses
from hector_jax.robot import Robot
from hector_jax.trajectory import State, Trajectory, Wrench, has_fallen


@dataclass(frozen=True)
class RolloutConfig:
    """What a rollout is compiled for."""

    walk: WalkConfig = WalkConfig()
    ticks: int = 400  # T; 4 s
    lead: int = 0  # ticks in place before t = 0, outside the loss
    block: int = 500  # ticks whose solves are kept for the gradient; longer walks are walked twice

    def __post_init__(self) -> None:
        if self.ticks < 2:
            raise ValueError(f"RolloutConfig.ticks must be at least 2, got {self.ticks}")
        if self.block < 1:
            raise ValueError(f"RolloutConfig.block must be at least 1 tick, got {self.block}")
        if self.lead < 0:
            raise ValueError(f"RolloutConfig.lead must be at least 0 ticks, got {self.lead}")
        if self.lead > -self.walk.gait.first_tick:
            raise ValueError(
                "RolloutConfig.lead must not reach back before the gait starts "
                f"({-self.walk.gait.first_tick} ticks), got {self.lead}"
            )


class Carry(NamedTuple):
    """What one tick hands to the next."""

    state: State
    feet: Feet
    commands: Wrench  # (HISTORY, 2, 3) each, world frame, newest first
    anchor: Anchor  # taken anew at t = 0
    fallen: Bool[Array, ""]


def init_carry(robot: Robot, anchor: Anchor) -> Carry:
    """A robot that stands still at its standing anchor, its feet commanded to share the weight."""
    zero = jnp.zeros(3)
    trunk = anchor.position - robot.com_offset
    local = foot_poses(robot, jnp.asarray(robot.standing_joints)).position
    half = 0.5 * robot.mass * jnp.asarray(robot.gravity)
    standing = jnp.broadcast_to(half, (HISTORY, 2, 3))
    return Carry(
        state=State(zero, anchor.position, zero, zero),
        feet=Feet(trunk + local, jnp.zeros(2)),
        commands=Wrench(standing, jnp.zeros_like(standing)),
        anchor=anchor,
        fallen=jnp.asarray(False),
    )


def step_carry(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    carry: Carry,
    tick: Int[Array, ""],
) -> tuple[Carry, Trajectory]:
    """One tick of the closed loop: plan, effect, motion.

    Returns the next carry and the tick's sample of the trajectory (its `initial` and `period` are
    filled in by `rollout`).
    """
    walk, ticks = config.walk, config.walk.gait
    state, feet = carry.state, carry.feet
    here = anchor_at(robot, state, carry.anchor.tick)
    anchor = jax.tree.map(lambda x, y: jnp.where(tick == here.tick, x, y), here, carry.anchor)
    decided = plan(
        walk, robot, weights, command, anchor, tick, state, feet, slots=slots_needed(walk, 0)
    )
    commands = jax.tree.map(
        lambda new, old: jnp.concatenate([new[None], old[:-1]]), decided.wrench, carry.commands
    )
    yaw = state.euler[2]
    window = Window(
        commands=turn(commands, -yaw),
        contact=decided.contact,
        phase=gait.cycle_phase(ticks, tick),
        since_switch=gait.since_switch(ticks, tick),
        base=from_yaw_frame(state),
    )
    found = effect(window)
    returned = turn(found.wrench, yaw)
    stands = decided.contact
    feet = Feet(
        jnp.where(stands[:, None], feet.position, decided.touchdown.position),
        jnp.where(stands, feet.yaw, decided.touchdown.yaw),
    )
    moved = srbm.step(robot, state, returned, feet.position, ticks.tick, turn(found.legs, yaw))
    fallen = carry.fallen | has_fallen(moved)
    sample = Trajectory(
        period=jnp.asarray(ticks.tick),
        initial=state,
        state=moved,
        reference=reference_at(ticks.tick, command, anchor, tick + 1.0),
        command=decided.wrench,
        effect=returned,
        contact=stands,
        feet=feet.position,
        joints=jnp.asarray(robot.standing_joints),
        fallen=fallen,
        legs_touch=jnp.zeros_like(fallen),  # a rigid body has none
        residual=decided.residual,
    )
    return Carry(moved, feet, commands, anchor, fallen), sample


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
) -> Trajectory:
    """Walk on the single rigid body: `lead` ticks in place from standing, then the command.

    Args:
        config: what is compiled.
        robot: the body.
        weights: theta; the gradient is taken with respect to these.
        command: what to walk.
        anchor: where it stands and the gait tick of t = 0, see `reference.standing_anchor`.
        effect: phi, `Window -> Effect`.

    Returns:
        Trajectory of T samples from t = 0. Nothing raises: read `fallen` and `residual` before
        believing it.

    Source: Eq. 12, 13.
    """

    @partial(jax.checkpoint, policy=jax.checkpoint_policies.save_only_these_names(qp.SAVED))
    def tick(carry: Carry, j: Int[Array, ""]) -> tuple[Carry, Trajectory]:
        return step_carry(config, robot, weights, command, effect, carry, j)

    def walk(carry: Carry, ticks: Int[Array, " block"]) -> tuple[Carry, Trajectory]:
        return jax.lax.scan(tick, carry, ticks)

    start, ticks = init_carry(robot, anchor), walked_ticks(config, anchor)
    blocks = _blocks(config)
    if blocks == 1:
        _, samples = walk(start, ticks)
    else:
        _, samples = jax.lax.scan(jax.checkpoint(walk), start, ticks.reshape(blocks, -1))
        samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)
    return from_start(config, samples)


def _blocks(config: RolloutConfig) -> int:
    """Equal parts, of at most `block` ticks, that a rollout is kept in."""
    ticks = config.lead + config.ticks
    fewest = -(-ticks // config.block)
    return next(count for count in range(fewest, ticks + 1) if ticks % count == 0)
