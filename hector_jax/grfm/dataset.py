"""What to walk for learning phi, how walks are kept, and how they become samples.

A shard keeps whole walks at the plan interval, in the world frame, together with the jobs that
asked for them; windows, frames and labels are made from it anew each time, so another history or
another label needs no new data. A sample belongs to one tick: the commands of the tick and of those
before, the mean wrench that the ground returned over the tick, and the push that a rigid body would
have needed beside it to move as the trunk moved (that of the legs), all in the robot's yaw frame at
the start of the tick. Training and validation are split by walk: samples of one walk are too alike.
"""

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from hector_jax.control import gait
from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import COMMANDS, Command, named_command
from hector_jax.control.walking import walk_config
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.core.console import say
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.trajectory import Load, State, Trajectory, Wrench
from hector_jax.core.tree_file import check_settings, load_tree, read_card, save_tree
from hector_jax.grfm.effect import HISTORY, Window, from_yaw_frame, turn
from hector_jax.robot import srbm
from hector_jax.robot.model import Robot
from hector_jax.sim.walk import Job
from hector_jax.sim.world import NO_PUSH, Push, hfs, hfs_drawn

KINDS = (*COMMANDS, "random")  # of walks; job i is of kind i modulo their number
SPREAD = 3.0  # weights are drawn log-uniformly within x/SPREAD of their centre
NEAR = 1.5  # and within x/NEAR of what a tuning went through
ALONG = np.array([1.0, -1.0, 1.0])  # mirror, left for right: of positions, velocities, forces
ACROSS = -ALONG  # and of angles, angular velocities, moments
PIECES = 4  # of every command, so that jobs can be stacked
PUSHES = 2  # of every walk, likewise; most are of no force
PUSH_TIME = 0.1  # [s]

_UNITS = {
    "period": "s",
    "euler": "rad",
    "position": "m",
    "ang_velocity": "rad/s",
    "velocity": "m/s",
    "force": "N",
    "moment": "N m",
    "feet": "m",
    "joints": "rad",
    "duration": "s",
    "start": "s",
}


SOLVED = 1e-6  # worst relative KKT residual of a command that is learned from


class Walks(NamedTuple):
    """Walks with what was asked for, stacked; trajectories are sampled at the plan interval."""

    job: Job  # arrays with a leading axis; commands of PIECES pieces
    trajectory: Trajectory


class Dataset(NamedTuple):
    """Samples of phi, n of them; those of one walk follow one another in time."""

    window: Window  # what phi may look at, yaw frame
    label: Wrench  # (n, 2, 3) each, mean effect over the tick, yaw frame
    legs: Load  # (n, 3) each, what moved the rigid body beside the effect, yaw frame
    state: State  # (n, 3) each, true state at the start of the tick, world frame
    walk: Int[Array, " n"]  # which walk
    tick: Int[Array, " n"]  # which tick of it


def draw_jobs(
    seed: int,
    count: int,
    paths: Sequence[Weights] = (),
    seconds: float = 4.0,
    robot: Robot | None = None,
) -> list[Job]:
    """What to walk so that phi knows the ground that tuning will tread.

    Trajectories take turns: straight, c, s, random velocities. Weights take turns too: each of the
    24 log-uniform around nominal, around expert and, where tuning paths are given, a point of one.
    Each walk has a plant of its own, drawn around the hfs. A third of the walks, drawn too, is
    pushed once or twice: 10 to 30 N for 0.1 s, from any side. Job i depends on the seed and on i
    alone, so a longer list begins with the shorter one.

    Args:
        seed: of everything drawn.
        count: number of walks.
        paths: weights that tunings went through, stacked along a first axis each.
        seconds: length of each walk.
        robot: whose nominal and expert weights they are; HECTOR by default.

    Raises:
        ValueError: fewer than one walk.
    """
    if count < 1:
        raise ValueError(f"the number of walks must be at least 1, got {count}")
    centres = nominal(robot), expert(robot)
    return [
        _draw_job(np.random.default_rng([seed, i]), i, centres, paths, seconds)
        for i in range(count)
    ]


def _draw_job(
    rng: np.random.Generator,
    i: int,
    centres: tuple[Weights, Weights],
    paths: Sequence[Weights],
    seconds: float,
) -> Job:
    kind = KINDS[i % len(KINDS)]
    command = _random_command(rng) if kind == "random" else _split_last(named_command(kind))
    centre = (i // len(KINDS)) % (3 if paths else 2)
    if centre == 2:
        path = paths[int(rng.integers(len(paths)))]
        point = rng.integers(len(path.Q.euler))
        weights = jax.tree.map(lambda w: np.asarray(w)[point], path)
    else:
        weights = _draw_weights(rng, centres[centre], SPREAD)
    plant = hfs_drawn(int(rng.integers(2**31)))
    return Job(weights, command, plant, seconds, seed=i, push=_draw_push(rng, seconds))


def draw_jobs_near(
    seed: int, count: int, command: Command, path: Weights, seconds: float = 4.0
) -> list[Job]:
    """What to walk so that phi knows the ground where one tuning trod.

    Commands take turns: the given one, random velocities. Weights take turns too: each of the 24
    log-uniform within x/NEAR of a point of the path, drawn, and of its last point. Plants and
    pushes are drawn as in `draw_jobs`, and job i depends on the seed and on i alone.

    Args:
        seed: of everything drawn.
        count: number of walks.
        command: what was tuned for.
        path: weights that the tuning went through, stacked along a first axis.
        seconds: length of each walk.
    """
    return [
        _draw_job_near(np.random.default_rng([seed, i]), i, command, path, seconds)
        for i in range(count)
    ]


def _draw_job_near(
    rng: np.random.Generator, i: int, command: Command, path: Weights, seconds: float
) -> Job:
    command = _random_command(rng) if i % 2 else _split_last(command)
    point = -1 if i // 2 % 2 else int(rng.integers(len(path.Q.euler)))
    weights = _draw_weights(rng, jax.tree.map(lambda w: np.asarray(w)[point], path), NEAR)
    plant = hfs_drawn(int(rng.integers(2**31)))
    return Job(weights, command, plant, seconds, seed=i, push=_draw_push(rng, seconds))


def _draw_weights(rng: np.random.Generator, centre: Weights, spread: float) -> Weights:
    return jax.tree.map(lambda w: w * spread ** rng.uniform(-1.0, 1.0, w.shape), centre)


def _draw_push(rng: np.random.Generator, seconds: float) -> Push:
    number = rng.integers(1, PUSHES + 1) if rng.random() < 1.0 / 3.0 else 0
    size = rng.uniform(10.0, 30.0, PUSHES) * (np.arange(PUSHES) < number)
    side = rng.uniform(-np.pi, np.pi, PUSHES)
    force = size[:, None] * np.stack([np.cos(side), np.sin(side), np.zeros(PUSHES)], axis=1)
    start = rng.uniform(0.0, max(seconds - PUSH_TIME, 0.0), PUSHES)
    return Push(force, start, np.full(PUSHES, PUSH_TIME))


def _random_command(rng: np.random.Generator) -> Command:
    return Command(
        duration=rng.uniform(0.5, 1.5, PIECES),
        velocity=rng.uniform([-0.2, -0.2], [0.6, 0.2], (PIECES, 2)),
        yaw_rate=rng.uniform(-0.5 * np.pi, 0.5 * np.pi, PIECES),
    )


def _split_last(command: Command) -> Command:
    """The same command in PIECES pieces: the last one is walked in parts."""
    parts = np.ones(len(command.duration), int)
    parts[-1] += PIECES - len(parts)
    whole = jax.tree.map(lambda x: np.repeat(x, parts, axis=0), command)
    return whole._replace(duration=whole.duration / np.repeat(parts, parts))


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

    return Trajectory(
        period=np.asarray(interval),
        initial=jax.tree.map(np.asarray, walk.initial),
        state=jax.tree.map(last, walk.state),
        reference=jax.tree.map(last, walk.reference),
        command=jax.tree.map(mean, walk.command),
        effect=jax.tree.map(mean, walk.effect),
        contact=cut(walk.contact)[:, 0],
        feet=last(walk.feet),
        joints=last(walk.joints),
        fallen=cut(walk.fallen).any(axis=1),
        legs_touch=cut(walk.legs_touch).any(axis=1),
        residual=cut(walk.residual).max(axis=1),
    )


def collect(
    folder: Path,
    jobs: Sequence[Job],
    walk_jobs: Callable[[list[Job]], Iterable[Trajectory]],
    *,
    robot: Robot,
    settings: Mapping[str, Any] | None = None,
    about: Mapping[str, Any] | None = None,
    interval: float | None = None,
    shard: int = 16,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Walk all jobs and keep them under `folder` in shards, taking up what an earlier call left.

    A sound shard of the same jobs is kept, a missing or damaged one is made: each of its walks is
    kept in a file of its own until all are there. `card.json` appears when all shards are.

    Args:
        folder: where; made if missing.
        jobs: what to walk.
        walk_jobs: called once, with the jobs whose walks are missing; gives the walks in their
            order, from any world. An iterator that walks while it is asked loses least to a stop.
        robot: the body; shards of another one are refused.
        settings: JSON values of all that the walks follow from; shards of others are refused.
        about: JSON values for the card, such as the engine that walked.
        interval: the plan interval [s], that of the robot's gait by default.
        shard: walks in a file.
        progress: called with walks done and walks in all.

    Raises:
        InputError: a shard in the folder is of other jobs, another robot or other settings.
        ValueError: walks are missing or too short.
        InputError: the folder cannot be written.
    """
    interval = walk_config(robot).gait.tick if interval is None else interval
    settings = json.loads(
        json.dumps({"interval": interval, **(settings or {})})
    )  # as it is read back
    facts = {
        "units": _UNITS,
        "frames": "world; wrench of the ground on the foot at its foot point, left then right",
        "settings": settings,
        **(about or {}),
    }
    single = {start: Path(folder) / f"walk-{start:05d}.npz" for start in range(len(jobs))}
    chunks = {
        Path(folder) / f"shard-{start // shard:03d}.npz": range(len(jobs))[start : start + shard]
        for start in range(0, len(jobs), shard)
    }

    def take(path: Path, numbers: Sequence[int]) -> Walks | None:
        return _kept_shard(path, _stack([jobs[i] for i in numbers]), robot, settings)

    kept = {path: take(path, numbers) for path, numbers in chunks.items()}
    open_ = [i for path, numbers in chunks.items() if kept[path] is None for i in numbers]
    alone = {i: take(single[i], [i]) for i in open_}
    missing = [i for i, walk in alone.items() if walk is None]
    walks = iter(walk_jobs([jobs[i] for i in missing]) if missing else ())
    done, falls = len(jobs) - len(missing), 0
    progress(done, len(jobs))
    for path, numbers in chunks.items():
        shard_walks = kept[path]
        if shard_walks is None:
            asked = [i for i in numbers if alone[i] is None]
            for i, walk in zip(asked, walks, strict=False):
                alone[i] = Walks(_stack([jobs[i]]), _stack([at_interval(walk, interval)]))
                save_tree(single[i], alone[i], kind="walks", robot=robot, about=facts)
                done += 1
                progress(done, len(jobs))
            taken = [walk for i in numbers if (walk := alone[i]) is not None]
            if len(taken) != len(numbers):
                raise ValueError(f"{path}: {len(numbers)} walks asked for, {len(taken)} came")
            shard_walks = jax.tree.map(lambda *walks: np.concatenate(walks), *taken)
            save_tree(path, shard_walks, kind="walks", robot=robot, about=facts)
        for i in numbers:
            single[i].unlink(missing_ok=True)
        falls += int(np.any(shard_walks.trajectory.fallen, axis=1).sum())
    card = {"walks": len(jobs), "falls": falls, "shards": [p.name for p in chunks], **facts}
    write_file(Path(folder) / "card.json", (json.dumps(card, indent=2) + "\n").encode())


def load_walks(folder: Path, robot: Robot) -> Walks:
    """All walks that `collect` left in a folder.

    Raises:
        InputError: one line naming folder or file: nothing collected, not finished, damaged, or of
            another robot.
    """
    shards = [
        _load_shard(Path(folder) / name, robot) for name in _read_collection(folder)["shards"]
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts), *shards)


def walked_with(folder: Path) -> dict[str, Any]:
    """What tells one collection from another: a hash of its walks, and its settings.

    Raises:
        InputError: nothing collected, not finished, or a card that is none.
    """
    card = _read_collection(folder)
    digest = hashlib.sha256()
    for name in card["shards"]:
        digest.update((Path(folder) / name).read_bytes())
    return {"content": digest.hexdigest()[:16], **card["settings"]}


def _read_collection(folder: Path) -> dict[str, Any]:
    path = Path(folder) / "card.json"
    try:
        card = json.loads(path.read_text())
        shards, settings = card["shards"], dict(card["settings"])
        if not shards or not all(re.fullmatch(r"shard-\d+\.npz", name) for name in shards):
            raise ValueError(f"shards are {short_repr(shards)}")
    except FileNotFoundError:
        raise InputError(
            f"{folder}: no finished collection (no card.json); collect first"
        ) from None
    except (ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise InputError(f"{path}: no card of a collection; collect again") from error
    for name in shards:
        if not (Path(folder) / name).is_file():
            raise InputError(f"{path}: no file {name} beside it; collect again")
    return {"shards": shards, "settings": settings}


def _load_shard(path: Path, robot: Robot) -> Walks:
    walks = load_tree(path, _like(), kind="walks", robot=robot)[0]
    count, ticks = walks.trajectory.fallen.shape
    for name, tree in (("job", walks.job), ("trajectory", walks.trajectory)):
        if any(len(leaf) != count for leaf in jax.tree.leaves(tree)):
            raise InputError(f"{path}: {name} is not of {count} walks, as trajectory.fallen is")
    run = walks.trajectory._replace(initial=walks.trajectory.fallen, period=walks.trajectory.fallen)
    if not count or any(leaf.shape[1] != ticks for leaf in jax.tree.leaves(run)):
        raise InputError(f"{path}: its walks are not of one length, that of trajectory.fallen")
    return walks


def _kept_shard(path: Path, asked: Job, robot: Robot, settings: dict[str, Any]) -> Walks | None:
    if not path.exists():
        return None
    try:
        card = read_card(path)
    except InputError as error:
        say(f"made anew: {error}")
        return None
    check_settings(path, card["about"].get("settings", {}), settings)
    walks = _load_shard(path, robot)
    equal = jax.tree.map(np.array_equal, walks.job, asked)
    if not all(jax.tree.leaves(equal)):
        raise InputError(f"{path}: collected for other walks; choose another folder or seed")
    return walks


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *trees)


def _like() -> Walks:
    """Layout of a shard; axes of length 0 are walks and ticks."""

    def zeros(*shape: int) -> np.ndarray:
        return np.zeros(shape)

    state = State(*[zeros(0, 0, 3)] * 4)
    wrench = Wrench(zeros(0, 0, 2, 3), zeros(0, 0, 2, 3))
    job = Job(
        weights=Weights(State(*[zeros(0, 3)] * 4), Wrench(zeros(0, 2, 3), zeros(0, 2, 3))),
        command=Command(zeros(0, PIECES), zeros(0, PIECES, 2), zeros(0, PIECES)),
        imperfections=jax.tree.map(lambda x: zeros(0, *np.shape(x)), hfs()),
        seconds=zeros(0),
        seed=zeros(0),
        start_tick=zeros(0),
        push=Push(zeros(0, PUSHES, 3), zeros(0, PUSHES), zeros(0, PUSHES)),
    )
    trajectory = Trajectory(
        period=zeros(0),
        initial=State(*[zeros(0, 3)] * 4),
        state=state,
        reference=state,
        command=wrench,
        effect=wrench,
        contact=zeros(0, 0, 2),
        feet=zeros(0, 0, 2, 3),
        joints=zeros(0, 0, 10),
        fallen=zeros(0, 0),
        legs_touch=zeros(0, 0),
        residual=zeros(0, 0),
    )
    return Walks(job, trajectory)


def make_dataset(
    robot: Robot,
    walks: Trajectory,
    start_tick: Any = 0,
    push: Push = NO_PUSH,
    config: GaitConfig | None = None,
) -> tuple[Dataset, int]:
    """Samples from walks at the plan interval.

    Args:
        robot: the rigid body that is to move as the trunk did.
        walks: W walks of T ticks, stacked, from t = 0.
        start_tick: gait tick of t = 0, of all walks or of each (W,).
        push: pushes from outside, of all walks or of each (W, ...).
        config: the gait that was walked, that of the robot's description by default.

    Returns:
        The dataset, with numpy arrays, and how many samples were dropped because of a fall, an
        unsolved QP, or a push, which would pass for one by the legs. The first HISTORY - 1 ticks of
        a walk have no full history and are no samples.
    """
    config = config or walk_config(robot).gait
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
    config: GaitConfig,
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
    legs = jax.vmap(partial(srbm.unexplained, robot, dt=config.tick))(
        before,
        jax.tree.map(lambda s: s[first:], walk.state),
        jax.tree.map(lambda w: w[first:], walk.effect),
        0.5 * (walk.feet[first - 1 : -1] + walk.feet[first:]),
    )
    legs = to_yaw_frame(legs, before.euler[:, 2])
    tick = jnp.arange(first, ticks)
    window = Window(
        commands=commands,
        contact=walk.contact[first:],
        phase=gait.cycle_phase(config, start_tick + tick),
        since_switch=gait.since_switch(config, start_tick + tick),
        base=jax.vmap(from_yaw_frame)(before),
    )
    finite = [
        jnp.isfinite(w).reshape(len(tick), -1).all(axis=1)
        for w in jax.tree.leaves((commands, label, legs))
    ]
    solved = walk.residual[first:] <= SOLVED
    begin, end = config.tick * tick[:, None], config.tick * (tick[:, None] + 1)
    acts = (push.start < end) & (push.start + push.duration > begin) & push.force.any(axis=-1)
    usable = jnp.stack([~walk.fallen[first:], solved, ~acts.any(axis=1), *finite]).all(axis=0)
    return Dataset(window, label, legs, before, jnp.full_like(tick, number), tick), usable


def with_mirror(dataset: Dataset) -> Dataset:
    """The samples and their mirror images, left for right: a symmetric robot has both.

    The image of a sample belongs to the same walk, so that a split by walk stays one. What a plant
    has on one side only, such as the gain of a motor, it then has on the other.
    """

    def flip(wrench: Wrench) -> Wrench:
        return Wrench(wrench.force[..., ::-1, :] * ALONG, wrench.moment[..., ::-1, :] * ACROSS)

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
            contact=window.contact[:, ::-1],
            phase=(window.phase + 0.5) % 1.0,
            base=flip_state(window.base),
        ),
        label=flip(dataset.label),
        legs=Load(dataset.legs.force * ALONG, dataset.legs.torque * ACROSS),
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
