"""How walks become samples of phi.

A sample belongs to one tick: the commands of the tick and of those before, the mean wrench that the
ground returned over the tick, the load on the trunk that a rigid body would have needed beside it
to move as the trunk moved (that of the legs), and, in the last tick of a swing, how far from its
planned touchdown the foot landed, all in the robot's yaw frame at the start of the tick. Training
and validation are split by walk: samples of one walk are too alike.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.control import gait
from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.control.footstep import touchdown_points
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import SOLVED, Load, State, Trajectory, Wrench
from hector_jax.grfm.effect import HISTORY, Window, from_yaw_frame, turn
from hector_jax.robot import srbm
from hector_jax.robot.model import Robot
from hector_jax.sim.world import NO_PUSH, Push

ALONG = np.array([1.0, -1.0, 1.0])  # mirror, left for right: of positions, velocities, forces
ACROSS = -ALONG  # and of angles, angular velocities, moments


def partners(feet: int) -> Int[np.ndarray, " feet"]:
    """The other foot of each foot's pair, which is its mirror image."""
    return np.arange(feet) ^ 1


class Dataset(NamedTuple):
    """Samples of phi, n of them; those of one walk follow one another in time."""

    window: Window  # what phi may look at, yaw frame
    label: Wrench  # (n, feet, 3) each, mean effect over the tick, yaw frame
    legs: Load  # (n, 3) each, what moved the rigid body beside the effect, yaw frame
    touchdown_error: Float[
        Array, "n feet 3"
    ]  # [m] from planned touchdown to where it is, yaw frame
    lands: Bool[Array, "n feet"]  # whether the foot touches down at the end of the tick
    state: State  # (n, 3) each, true state at the start of the tick, world frame
    walk: Int[Array, " n"]  # which walk
    tick: Int[Array, " n"]  # which tick of it


def at_interval(walk: Trajectory, interval: float) -> Trajectory:
    """The same walk sampled every `interval` [s]: mean wrenches, states at the end.

    Args:
        walk: one walk, whose samples fill a whole number of intervals.
        interval: the plan interval, a multiple of the walk's period.

    Raises:
        ValueError: the samples do not fill whole intervals.
    """
    period, samples = float(walk.period), len(walk.fallen)
    each = round(interval / period)
    if each < 1 or not math.isclose(each * period, interval, rel_tol=1e-6) or samples % each:
        raise ValueError(f"{samples} samples of {period} s do not fill intervals of {interval} s")

    def cut(x: Any) -> np.ndarray:
        return np.asarray(x).reshape(-1, each, *np.shape(x)[1:])

    def mean(x: Any) -> np.ndarray:
        return cut(x).mean(axis=1)

    def last(x: Any) -> np.ndarray:
        return cut(x)[:, -1]

    ends = walk._replace(period=None, initial=None)
    return jax.tree.map(last, ends)._replace(
        period=np.asarray(interval),
        initial=jax.tree.map(np.asarray, walk.initial),
        command=jax.tree.map(mean, walk.command),
        effect=jax.tree.map(mean, walk.effect),
        contact=cut(walk.contact)[:, 0],
        fallen=cut(walk.fallen).any(axis=1),
        legs_touch=cut(walk.legs_touch).any(axis=1),
        residual=cut(walk.residual).max(axis=1),
    )


def make_dataset(
    robot: Robot,
    walks: Trajectory,
    start_tick: Any = 0,
    *,
    push: Push = NO_PUSH,
) -> tuple[Dataset, int]:
    """Samples from walks at the plan interval.

    Args:
        robot: the rigid body that is to move as the trunk did.
        walks: W walks of T ticks, stacked, from t = 0.
        start_tick: gait tick of t = 0, of all walks or of each (W,).
        push: pushes from outside, of all walks or of each (W, ...).

    Returns:
        The dataset, with numpy arrays, and how many samples were dropped because of a fall, an
        unsolved QP, or a push, which would pass for one by the legs. The first HISTORY - 1 ticks of
        a walk have no full history and are no samples.
    """
    config = walk_config(robot)
    count = len(walks.fallen)
    starts = np.broadcast_to(np.asarray(start_tick, np.int32), (count,))
    pushes = jax.tree.map(
        lambda given, one: np.broadcast_to(given, (count, *np.shape(given)[-one.ndim :])),
        push,
        NO_PUSH,
    )
    samples, usable = _all_samples(config, robot, np.arange(count), starts, pushes, walks)
    usable = np.asarray(usable)
    return jax.tree.map(lambda x: np.asarray(x)[usable], samples), int((~usable).sum())


@partial(jax.jit, static_argnums=0)
def _all_samples(config, robot, numbers, starts, pushes, walks):
    return jax.vmap(partial(_samples, config, robot))(numbers, starts, pushes, walks)


def _samples(
    config: WalkConfig,
    robot: Robot,
    number: Int[Array, ""],
    start_tick: Int[Array, ""],
    push: Push,
    walk: Trajectory,
) -> tuple[Dataset, Bool[Array, " n"]]:
    """Samples of one walk and whether each is of a robot on its feet."""
    first, ticks = HISTORY - 1, walk.fallen.shape[0]
    before = jax.tree.map(
        lambda start, later: jnp.concatenate([start[None], later[:-1]])[first:],
        walk.initial,
        walk.state,
    )

    def newest_first(w: Array) -> Array:
        return jnp.stack([w[first - i : ticks - i] for i in range(HISTORY)], axis=1)

    to_yaw_frame = jax.vmap(lambda vectors, yaw: turn(vectors, -yaw))
    commands = to_yaw_frame(jax.tree.map(newest_first, walk.command), before.euler[:, 2])
    label = to_yaw_frame(jax.tree.map(lambda w: w[first:], walk.effect), before.euler[:, 2])
    legs = jax.vmap(partial(srbm.unexplained, robot, dt=config.gait.tick))(
        before,
        jax.tree.map(lambda s: s[first:], walk.state),
        jax.tree.map(lambda w: w[first:], walk.effect),
        0.5 * (walk.feet[first - 1 : -1] + walk.feet[first:]),
    )
    legs = to_yaw_frame(legs, before.euler[:, 2])
    tick = jnp.arange(first, ticks)
    contact, later = walk.contact[first:], lambda x: jnp.concatenate([x[first + 1 :], x[-1:]])
    planned = _planned_touchdowns(
        config,
        robot,
        before,
        jax.tree.map(lambda r: r[first - 1 : -1], walk.reference),
        start_tick + tick,
    )
    error = to_yaw_frame(later(walk.feet) - planned, before.euler[:, 2])
    lands = later(walk.contact) & ~contact & ~later(walk.fallen)[:, None]
    lands &= jnp.isfinite(error).all(axis=-1) & robot.description.tuning.touchdown_error
    window = Window(
        commands=commands,
        contact=contact,
        since_switch=gait.since_switch(config.gait, start_tick + tick),
        base=jax.vmap(from_yaw_frame)(before),
    )
    finite = [
        jnp.isfinite(w).reshape(len(tick), -1).all(axis=1)
        for w in jax.tree.leaves((commands, label, legs))
    ]
    solved = walk.residual[first:] <= SOLVED
    begin, end = config.gait.tick * tick[:, None], config.gait.tick * (tick[:, None] + 1)
    acts = (push.start < end) & (push.start + push.duration > begin) & push.force.any(axis=-1)
    usable = jnp.stack([~walk.fallen[first:], solved, ~acts.any(axis=1), *finite]).all(axis=0)
    walks = jnp.full_like(tick, number)
    return Dataset(window, label, legs, error, lands, before, walks, tick), usable


def _planned_touchdowns(
    config: WalkConfig, robot: Robot, state: State, reference: State, tick: Int[Array, " n"]
) -> Float[Array, "n feet 3"]:
    """Where the controller would have had the feet touch down, by the true state at each tick."""
    period = config.gait.tick
    times = {"stance": period * config.gait.stance, "swing": period * config.gait.swing}

    def at(state: State, reference: State, tick: Int[Array, ""]) -> Float[Array, "feet 3"]:
        remaining = period * gait.ticks_to_touchdown(config.gait, tick)
        rule = partial(touchdown_points, config.footstep, robot, config.footstep.parameters)
        return rule(state=state, reference=reference, remaining=remaining, **times).position

    return jax.vmap(at)(state, reference, tick)


def with_mirror(dataset: Dataset) -> Dataset:
    """The samples and their mirror images, left for right: a symmetric robot has both.

    The image of a sample belongs to the same walk, so that a split by walk stays one. What a plant
    has on one side only, such as the gain of a motor, it then has on the other.
    """
    other = partners(dataset.lands.shape[1])

    def flip(wrench: Wrench) -> Wrench:
        force, moment = (part[..., other, :] for part in wrench)
        return Wrench(force * ALONG, moment * ACROSS)

    def flip_state(state: State) -> State:
        return State(
            euler=state.euler * ACROSS,
            position=state.position * ALONG,
            ang_velocity=state.ang_velocity * ACROSS,
            velocity=state.velocity * ALONG,
        )

    window = dataset.window
    image = dataset._replace(
        window=window._replace(
            commands=flip(window.commands),
            contact=window.contact[:, other],
            base=flip_state(window.base),
        ),
        label=flip(dataset.label),
        legs=Load(dataset.legs.force * ALONG, dataset.legs.torque * ACROSS),
        touchdown_error=dataset.touchdown_error[:, other] * ALONG,
        lands=dataset.lands[:, other],
        state=flip_state(dataset.state),
    )
    return jax.tree.map(lambda *both: np.concatenate(both), dataset, image)


def split_by_walk(
    dataset: Dataset, held_out: float = 0.2, seed: int = 0
) -> tuple[Dataset, Dataset]:
    """Training and held-out samples; no walk is in both.

    Args:
        dataset: samples of at least two walks.
        held_out: share of the walks to hold out, at least one and not all.
        seed: which ones.

    Raises:
        InputError: fewer than two walks.
    """
    walks = np.unique(dataset.walk)
    if len(walks) < 2:
        raise InputError(f"a split by walk needs samples of at least 2 walks, got {len(walks)}")
    number = int(np.clip(round(held_out * len(walks)), 1, len(walks) - 1))
    chosen = np.random.default_rng(seed).permutation(walks)[:number]
    held = np.isin(dataset.walk, chosen)
    return jax.tree.map(lambda x: x[~held], dataset), jax.tree.map(lambda x: x[held], dataset)
