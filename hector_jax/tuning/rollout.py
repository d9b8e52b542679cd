"""The closed loop on the single rigid body, with phi between command and effect (Eq. 12, 13).

This is the only world that is differentiated. A tick solves the MPC, asks phi what the ground
returns and moves the body; in between, nothing is remembered but what `Carry` holds. A foot in the
air is carried at its planned touchdown point, where an early touchdown that phi predicts acts too.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from hector_jax.control import gait
from hector_jax.control.reference import Anchor, Command, reference_at
from hector_jax.control.walking import Feet, WalkConfig, plan, slots_needed
from hector_jax.control.weights import Weights
from hector_jax.model import srbm
from hector_jax.model.effect import HISTORY, Window, turn
from hector_jax.model.kinematics import foot_poses
from hector_jax.robot import Robot
from hector_jax.trajectory import State, Trajectory, Wrench

MIN_HEIGHT = 0.25  # [m] of the centre of mass; below it the robot has fallen
MAX_TILT = 0.8  # [rad] of roll or pitch


@dataclass(frozen=True)
class RolloutConfig:
    """What a rollout is compiled for."""

    walk: WalkConfig = WalkConfig()
    ticks: int = 400  # T; 4 s
    lead: int = 0  # ticks in place before t = 0, outside the loss

    def __post_init__(self) -> None:
        if self.ticks < 2:
            raise ValueError(f"RolloutConfig.ticks must be at least 2, got {self.ticks}")
        if self.lead < 0:
            raise ValueError(f"RolloutConfig.lead must be at least 0 ticks, got {self.lead}")


class Carry(NamedTuple):
    """What one tick hands to the next."""

    state: State
    feet: Feet
    commands: Wrench  # (HISTORY, 2, 3) each, world frame, newest first
    anchor: Anchor  # taken anew at t = 0
    fallen: Bool[Array, ""]


def has_fallen(state: State) -> Bool[Array, "*batch"]:
    """Whether a base state is that of a fallen robot: too low, too tilted, or not finite."""
    low = state.position[..., 2] < MIN_HEIGHT
    tilted = jnp.any(jnp.abs(state.euler[..., :2]) > MAX_TILT, axis=-1)
    finite = jnp.all(jnp.array([jnp.isfinite(x).all(axis=-1) for x in state]), axis=0)
    return low | tilted | ~finite


def standing_anchor(robot: Robot, start_tick: int = 0) -> Anchor:
    """Reference that starts under a robot standing at the origin, at gait tick `start_tick`."""
    height = jnp.asarray(robot.standing_height)
    zero = jnp.zeros_like(height)
    return Anchor(jnp.stack([zero, zero, height]), zero, jnp.asarray(start_tick))


def init_carry(robot: Robot, anchor: Anchor) -> Carry:
    """A robot that stands still at the origin, its feet commanded to share the weight."""
    zero = jnp.zeros(3)
    position = zero.at[2].set(robot.standing_height)
    local = foot_poses(robot, jnp.asarray(robot.standing_joints)).position
    half = 0.5 * robot.mass * jnp.asarray(robot.gravity)
    standing = jnp.broadcast_to(half, (HISTORY, 2, 3))
    return Carry(
        state=State(zero, position, zero, zero),
        feet=Feet(position + local - robot.com_offset, jnp.zeros(2)),
        commands=Wrench(standing, jnp.zeros_like(standing)),
        anchor=anchor,
        fallen=jnp.asarray(False),
    )


def _anchor_at(robot: Robot, carry: Carry, tick: Int[Array, ""]) -> Anchor:
    """The anchor in force: at t = 0 where the robot is, at the height at which it stands."""
    here = carry.state.position.at[2].set(robot.standing_height)
    now = Anchor(here, carry.state.euler[2], carry.anchor.tick)
    return jax.tree.map(lambda new, old: jnp.where(tick == now.tick, new, old), now, carry.anchor)


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
    anchor = _anchor_at(robot, carry, tick)
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
    )
    returned = turn(effect(window).wrench, yaw)
    stands = decided.contact
    feet = Feet(
        jnp.where(stands[:, None], feet.position, decided.touchdown.position),
        jnp.where(stands, feet.yaw, decided.touchdown.yaw),
    )
    moved = srbm.step(robot, state, returned, feet.position, ticks.tick)
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
        anchor: where it stands and the gait tick of t = 0, see `standing_anchor`.
        effect: phi, `Window -> Effect`.

    Returns:
        Trajectory of T samples from t = 0. Nothing raises: read `fallen` and `residual` before
        believing it.

    Source: Eq. 12, 13.
    """

    @jax.checkpoint
    def tick(carry: Carry, j: Int[Array, ""]) -> tuple[Carry, Trajectory]:
        return step_carry(config, robot, weights, command, effect, carry, j)

    _, samples = jax.lax.scan(tick, init_carry(robot, anchor), walked_ticks(config, anchor))
    return from_start(config, samples)
