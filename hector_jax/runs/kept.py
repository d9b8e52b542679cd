"""Scores of walks, each an artefact (cache.py): weight sets on plants, and groups of walks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar
from hector_jax.core.inputs import plural
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.grfm.dataset import at_interval
from hector_jax.robot.model import Robot
from hector_jax.runs import metrics, pipeline
from hector_jax.runs.cache import cached, content_key
from hector_jax.runs.metrics import Score
from hector_jax.sim.loop import Job
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import LossConfig

Tree = TypeVar("Tree")


class Walked(NamedTuple):
    """What is kept of one walk."""

    score: Score
    upright: Float[np.ndarray, ""]  # [s] until a fall, or the whole walk
    last: State  # the last one upright, or of the walk
    commit: str


class Judged(NamedTuple):
    """Walks of several sets on the same plants."""

    walks: dict[str, list[Walked]]  # by set, in the order of the plants
    shown: dict[str, Trajectory]  # by set, the walk on the first plant, at the plan interval


def _walked(config: LossConfig, walk: Trajectory, commit: str) -> Walked:
    up = int(np.sum(~np.asarray(walk.fallen)))
    last = jax.tree.map(lambda x: np.asarray(x)[max(up - 1, 0)], walk.state)
    return Walked(metrics.score(config, walk), np.asarray(up * float(walk.period)), last, commit)


def _walked_like() -> Walked:
    one, three = np.zeros(()), np.zeros(3)
    state = State(three, three, three, three)
    return Walked(metrics.score_like(), one, state, np.array(""))  # pyright: ignore


def _trajectory_like() -> Trajectory:
    rows, state = np.zeros((0, 3)), np.zeros(3)
    wrench = Wrench(np.zeros((0, 2, 3)), np.zeros((0, 2, 3)))
    return Trajectory(
        period=np.zeros(()),
        initial=State(state, state, state, state),
        state=State(rows, rows, rows, rows),
        reference=State(rows, rows, rows, rows),
        command=wrench,
        effect=wrench,
        contact=np.zeros((0, 2)),
        feet=np.zeros((0, 2, 3)),
        joints=np.zeros((0, 10)),
        fallen=np.zeros(0),
        legs_touch=np.zeros(0),
        residual=np.zeros(0),
    )


def judge(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    command: Command,
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
    folder: Path,
    commit: str,
    title: str,
    seconds: float = 4.0,
) -> Judged:
    """Scores of every weight set on every plant, walking what is not in `folder` yet.

    Args:
        pool: worker processes.
        config: controller and loss.
        robot: nominal body.
        sets: weights by name.
        command: what to walk.
        plants: of the seeds.
        seeds: of the plants and of the estimators.
        folder: of the scores, a file per walk; the walks of the first seed are kept themselves.
        commit: to note with what is made now.
        title: for the person who waits.
        seconds: of each walk.

    Raises:
        InputError: the folder cannot be written.
    """
    jobs = {
        (name, seed): Job(weights, command, plant, seconds, seed)
        for plant, seed in zip(plants, seeds, strict=True)
        for name, weights in sets.items()
    }
    scored, shown = _scored(pool, config, robot, jobs, seeds[0], folder, commit, title)
    return Judged(
        {name: [scored[name, seed] for seed in seeds] for name in sets},
        {name: shown[name] for name in sets},
    )


def _scored(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    jobs: Mapping[tuple[str, int], Job],
    first: int,
    folder: Path,
    commit: str,
    title: str,
) -> tuple[dict[tuple[str, int], Walked], dict[str, Trajectory]]:
    """What is kept of jobs by set and seed, and of those of the first seed the walks."""
    walk_config = config.rollout.walk
    code = ("sim.walk", "runs.metrics")

    def path(key: tuple[str, int]) -> Path:
        (name, seed), what = key, "walk" if key[1] == first else "score"
        ending = content_key(walk_config, config.loss, robot, jobs[key], code=code)
        return folder / f"{what}-{name}-{seed}-{ending}.npz"

    def make(missing: list[tuple[str, int]], found: Mapping[Any, Any]) -> Iterator[Any]:
        there = f"; {len(found)} of {plural(len(jobs), 'walk')} are there" if found else ""
        asked = [jobs[key] for key in missing]
        walks = pipeline.walks_of(pool, config, robot, asked, title + there)
        for key, walk in zip(missing, walks, strict=True):
            one = _walked(config.loss, walk, commit)
            yield key, (one, at_interval(walk, walk_config.gait.tick) if key[1] == first else None)

    taken = cached(
        {key: path(key) for key in jobs},
        make,
        like=lambda key: (_walked_like(), _trajectory_like() if key[1] == first else None),
        kind="walk",
        robot=robot,
    )
    walked = {key: one._replace(commit=str(one.commit)) for key, (one, _) in taken.items()}
    return walked, {name: walk for (name, seed), (_, walk) in taken.items() if seed == first}


def walk_groups(
    groups: Mapping[str, Sequence[Job]],
    walk: Callable[[Sequence[Job]], Iterator[Trajectory]],
    tell: Callable[[Trajectory], Tree],
    like: Tree,
    kind: str,
    robot: Robot,
    folder: Path,
    key: tuple[Any, ...],
    title: str,
) -> dict[str, Tree]:
    """What there is to say of each walk of groups of jobs, stacked; whole groups are kept.

    Args:
        groups: of jobs, by a name that may stand in a file's.
        walk: walks jobs, in their order.
        tell: what is kept of a walk, a NamedTuple of arrays.
        like: such a tuple.
        kind: of the files.
        robot: the body.
        folder: of the files.
        key: what the walks follow from beside the jobs, as `digest` takes it; noted in the files.
        title: for the person who waits, after the number of walks.
    """
    code = ("sim.walk", "sim.parallel", "runs.metrics")
    paths = {
        name: folder / f"{name}-{content_key(*key, robot, tuple(jobs), code=code)}.npz"
        for name, jobs in groups.items()
    }

    def make(missing: Sequence[str], _: Mapping[str, Tree]) -> Iterator[tuple[str, Tree]]:
        jobs = [job for name in missing for job in groups[name]]
        with bar(f"{plural(len(jobs), 'walk')}{title}") as on:
            on(0, len(jobs), "compiling")
            walks, done = walk(jobs), 0
            for name in missing:
                rows = []
                for _ in groups[name]:
                    rows.append(tell(next(walks)))
                    done += 1
                    on(done, len(jobs), name)
                yield name, jax.tree.map(lambda *x: np.stack(x), *rows)

    about = {"settings": [repr(part) for part in key]}
    return cached(paths, make, like=lambda _: like, kind=kind, robot=robot, about=about)
