"""Samples of phi, made from walks.

A sample belongs to one tick: the commands of this and earlier ticks, the mean wrench that the
ground returned over the tick, the additional load under which a rigid body would have moved as the
trunk did (the load of the legs), and, in the last tick of a swing, the offset of the foot's
landing from its planned touchdown, all in the robot's yaw frame at the start of the tick. Training
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

ALONG = np.array([1.0, -1.0, 1.0])  # signs of mirrored positions, velocities, forces
ACROSS = -ALONG  # signs of mirrored angles, angular velocities, moments


def partners(feet: int) -> Int[np.ndarray, " feet"]:
    """Return the other foot of each foot's pair, its mirror image."""
    return np.arange(feet) ^ 1


class Dataset(NamedTuple):
    """Samples of phi, n of them; those of one walk follow one another in time."""

    window: Window  # input of phi, yaw frame
    # (n, feet, 3) each, mean effect over the tick, yaw frame; without moments for point feet
    label: Wrench
    legs: Load  # (n, 3) each, load on the rigid body in addition to the effect, yaw frame
    # [m] from the planned touchdown to the foot, yaw frame
    touchdown_error: Float[Array, "n feet 3"]
    lands: Bool[Array, "n feet"]  # the foot touches down at the end of the tick
    state: State  # (n, 3) each, true state at the start of the tick, world frame
    walk: Int[Array, " n"]  # index of the walk
    tick: Int[Array, " n"]  # tick within the walk
    moments: Bool[Array, " n"]  # the robot's feet can exert moments, the same for all samples

    @property
    def feet(self) -> int:
        """Number of feet."""
        return self.lands.shape[1]

    @property
    def axes(self) -> int:
        """Number of axes of a foot's wrench: 6, or 3 for feet without moments."""
        return 6 if np.all(self.moments) else 3


def at_interval(walk: Trajectory, interval: float) -> Trajectory:
    """Return the walk sampled every `interval` [s]: mean wrenches, states at the end.

    Args:
        walk: one walk, whose samples fill a whole number of intervals.
        interval: the plan interval, a multiple of the walk's period.

    Raises:
        ValueError: the samples do not fill whole intervals.
    """
    period, samples = float(walk.period), len(walk.fallen)
    size = round(interval / period)  # samples per interval
    if size < 1 or not math.isclose(size * period, interval, rel_tol=1e-6) or samples % size:
        raise ValueError(f"{samples} samples of {period} s do not fill intervals of {interval} s")

    def group(x: Any) -> np.ndarray:
        return np.asarray(x).reshape(-1, size, *np.shape(x)[1:])

    groups = jax.tree.map(group, walk._replace(period=None, initial=None))
    mean = partial(jax.tree.map, lambda x: x.mean(axis=1))
    return jax.tree.map(lambda x: x[:, -1], groups)._replace(
        period=np.asarray(interval),
        initial=jax.tree.map(np.asarray, walk.initial),
        command=mean(groups.command),
        effect=mean(groups.effect),
        contact=groups.contact[:, 0],
        fallen=groups.fallen.any(axis=1),
        legs_touch=groups.legs_touch.any(axis=1),
        residual=groups.residual.max(axis=1),
    )


def make_dataset(
    robot: Robot, walks: Trajectory, start_tick: Any = 0, *, push: Push = NO_PUSH
) -> tuple[Dataset, int]:
    """Make samples from walks at the plan interval.

    Args:
        robot: the rigid body that has to move as the trunk did.
        walks: W walks of T ticks, stacked, from t = 0.
        start_tick: gait tick of t = 0, of all walks or of each (W,).
        push: pushes from outside, of all walks or of each (W, ...).

    Returns:
        The dataset, with numpy arrays, and the number of samples dropped because of a fall, an
        unsolved QP, or a push, which would be mistaken for a push of the legs. The first
        HISTORY - 1 ticks of a walk have no full history and are no samples.
    """
    config = walk_config(robot)
    count = len(walks.fallen)
    starts = np.broadcast_to(np.asarray(start_tick, np.int32), (count,))
    pushes = jax.tree.map(
        lambda x, no_push: np.broadcast_to(x, (count, *np.shape(x)[-no_push.ndim :])), push, NO_PUSH
    )
    each = np.arange(count), starts, pushes, walks
    samples, usable = _all_samples(config, robot, each)
    usable = np.asarray(usable)
    return jax.tree.map(lambda x: np.asarray(x)[usable], samples), int((~usable).sum())


@partial(jax.jit, static_argnums=0)
def _all_samples(config: WalkConfig, robot: Robot, each: tuple) -> tuple[Dataset, Array]:
    return jax.vmap(partial(_samples, config, robot))(each)


def _samples(
    config: WalkConfig, robot: Robot, one: tuple[Int[Array, ""], Int[Array, ""], Push, Trajectory]
) -> tuple[Dataset, Bool[Array, " n"]]:
    """Return the samples of a walk and whether each is usable.

    Args:
        config: the gait.
        robot: the rigid body.
        one: number of the walk, gait tick of its t = 0, its push, and the walk.
    """
    number, start_tick, push, walk = one
    first, ticks = HISTORY - 1, walk.fallen.shape[0]
    current = jax.tree.map(lambda x: x[first:], walk._replace(period=None, initial=None))
    earlier = (walk.state, walk.reference, walk.feet)  # HISTORY > 1: the initial state is not used
    previous, reference, previous_feet = jax.tree.map(lambda x: x[first - 1 : -1], earlier)

    def newest_first(w: Array) -> Array:
        return jnp.stack([w[first - i : ticks - i] for i in range(HISTORY)], axis=1)

    def to_yaw_frame(vectors: Any) -> Any:
        return jax.vmap(lambda v, yaw: turn(v, -yaw))(vectors, previous.euler[:, 2])

    def next_tick(x: Array) -> Array:
        return jnp.concatenate([x[1:], x[-1:]])

    commands = to_yaw_frame(jax.tree.map(newest_first, walk.command))
    effect, has_moments = current.effect, config.mpc.contact.axes == 6
    if not has_moments:  # what a rolling ball adds belongs to the legs' load
        effect = effect._replace(moment=jnp.zeros_like(effect.moment))
    label = to_yaw_frame(effect)
    legs = jax.vmap(partial(srbm.unexplained, robot, dt=config.gait.tick))(
        previous, current.state, effect, 0.5 * (previous_feet + current.feet)
    )
    legs = to_yaw_frame(legs)
    tick = jnp.arange(first, ticks)
    planned = _planned_touchdowns(config, robot, previous, reference, start_tick + tick)
    error = to_yaw_frame(next_tick(current.feet) - planned)
    lands = next_tick(current.contact) & ~current.contact & ~next_tick(current.fallen)[:, None]
    lands &= jnp.isfinite(error).all(axis=-1) & robot.description.tuning.touchdown_error
    window = Window(
        commands=commands,
        contact=current.contact,
        since_switch=gait.since_switch(config.gait, start_tick + tick),
        base=jax.vmap(from_yaw_frame)(previous),
    )
    finite = [
        jnp.isfinite(w).reshape(len(tick), -1).all(axis=1)
        for w in jax.tree.leaves((commands, label, legs))
    ]
    solved = current.residual <= SOLVED
    begin, end = config.gait.tick * tick[:, None], config.gait.tick * (tick[:, None] + 1)
    pushed = (push.start < end) & (push.start + push.duration > begin) & push.force.any(axis=-1)
    usable = jnp.stack([~current.fallen, solved, ~pushed.any(axis=1), *finite]).all(axis=0)
    walk, moments = jnp.full_like(tick, number), jnp.full_like(tick, has_moments, dtype=bool)
    return Dataset(window, label, legs, error, lands, previous, walk, tick, moments), usable


def _planned_touchdowns(
    config: WalkConfig, robot: Robot, state: State, reference: State, tick: Int[Array, " n"]
) -> Float[Array, "n feet 3"]:
    """Return the touchdowns that the controller would plan from the true state at each tick."""
    period = config.gait.tick
    times = {"stance": period * config.gait.stance, "swing": period * config.gait.swing}

    def at(state: State, reference: State, tick: Int[Array, ""]) -> Float[Array, "feet 3"]:
        remaining = period * gait.ticks_to_touchdown(config.gait, tick)
        rule = partial(touchdown_points, config.footstep, robot, config.footstep.parameters)
        return rule(state=state, reference=reference, remaining=remaining, **times).position

    return jax.vmap(at)(state, reference, tick)


def with_mirror(dataset: Dataset) -> Dataset:
    """Return the samples and their mirror images, left for right: a symmetric robot has both.

    The image of a sample belongs to the same walk, so that a split by walk remains one. A property
    of one side of a plant, such as the gain of a motor, moves to the other side in the image.
    """
    other, window = partners(dataset.feet), dataset.window
    signs = State(euler=ACROSS, position=ALONG, ang_velocity=ACROSS, velocity=ALONG)

    def flip(wrench: Wrench) -> Wrench:
        force, moment = (part[..., other, :] for part in wrench)
        return Wrench(force * ALONG, moment * ACROSS)

    image = dataset._replace(
        window=window._replace(
            commands=flip(window.commands),
            contact=window.contact[:, other],
            base=jax.tree.map(np.multiply, window.base, signs),
        ),
        label=flip(dataset.label),
        legs=Load(dataset.legs.force * ALONG, dataset.legs.torque * ACROSS),
        touchdown_error=dataset.touchdown_error[:, other] * ALONG,
        lands=dataset.lands[:, other],
        state=jax.tree.map(np.multiply, dataset.state, signs),
    )
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), dataset, image)


def split_by_walk(
    dataset: Dataset, held_out: float = 0.2, seed: int = 0
) -> tuple[Dataset, Dataset]:
    """Split into training and held-out samples; no walk is in both.

    Args:
        dataset: samples of at least two walks.
        held_out: share of the walks to hold out, at least one walk and not all.
        seed: of the choice of walks.

    Raises:
        InputError: fewer than two walks.
    """
    walks = np.unique(dataset.walk)
    if len(walks) < 2:
        raise InputError(f"a split by walk needs samples of at least 2 walks, got {len(walks)}")
    number = int(np.clip(round(held_out * len(walks)), 1, len(walks) - 1))
    chosen = np.random.default_rng(seed).permutation(walks)[:number]
    test = np.isin(dataset.walk, chosen)
    return jax.tree.map(lambda x: x[~test], dataset), jax.tree.map(lambda x: x[test], dataset)
