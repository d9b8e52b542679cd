"""The step `judge`: walks of weight sets on plants, each score an artefact (cache.py)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar, say
from hector_jax.core.inputs import plural
from hector_jax.core.trajectory import SOLVED, State, Trajectory
from hector_jax.grfm.collection import walks_like
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import Robot
from hector_jax.runs import metrics
from hector_jax.runs.cache import content_key, load_or_make
from hector_jax.sim.diagnosis import startup_fall
from hector_jax.sim.engine import MUJOCO_C, Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import Loss
from hector_jax.tuning.rollout import rollout, rollout_config

# modules that decide the numbers, for `content_key`
_CODE = ("sim.diagnosis", "runs.metrics")

Case = tuple[str, int]
"""A set, with what else tells its walk from others on the same plant, and a seed."""


class ScoredWalk(NamedTuple):
    """What is kept of one walk."""

    score: metrics.Score
    upright: Float[np.ndarray, ""]  # [s] until a fall, below zero in the start-up; or all of it
    last: State  # the last one upright, or of the walk
    commit: str  # at which it was walked; empty where that is not known
    startup: str  # what is to be said of a fall in the start-up; empty where there is none


class ScoredWalks(NamedTuple):
    """Walks of several sets on the same plants."""

    walks: dict[str, list[ScoredWalk]]  # by set, in the order of the plants
    first: dict[str, Trajectory]  # by set, the walk on the first plant; empty where none is kept

    @property
    def scores(self) -> dict[str, list[metrics.Score]]:
        """Scores by set, in the order of the plants."""
        return {name: [walk.score for walk in walks] for name, walks in self.walks.items()}


def walk_jobs(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    jobs: Sequence[Job],
    title: str,
    engine: Engine = MUJOCO_C,
) -> Iterator[Trajectory]:
    """The walks of jobs, in order, as they come."""
    with bar(title) as tell:
        tell(0, len(jobs), "compiling")
        for done, walk in enumerate(engine.walk(pool, config.rollout.walk, robot, jobs), 1):
            yield walk
            tell(done, len(jobs), "")


def walk_rigid_body(robot: Robot, weights: Weights, command: Command, seconds: float) -> Trajectory:
    """A walk on the plain single rigid body, `seconds` long, begun as a rollout of a tuning."""
    config = rollout_config(robot, round(seconds / walk_config(robot).gait.tick))
    roll_out = jax.jit(rollout, static_argnums=0)
    anchor = standing_anchor(robot)
    return jax.device_get(roll_out(config, robot, weights, command, anchor, last_command))


def _score_walk(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    job: Job,
    walk: Trajectory,
    commit: str,
    engine: Engine,
) -> ScoredWalk:
    up, text = int(np.sum(~np.asarray(walk.fallen))), ""
    upright = up * float(walk.period)
    if not up and not engine.differs:  # the fall is walked once more, in MuJoCo C
        inputs = config.rollout.walk, jax.tree.map(np.asarray, robot), on_host(job)
        if startup := pool.submit(startup_fall, *inputs).result():
            upright, text = startup.time, str(startup)
    last = jax.tree.map(lambda x: np.asarray(x)[max(up - 1, 0)], walk.state)
    score = metrics.score(config.loss, walk)
    return ScoredWalk(score, np.asarray(upright), last, commit, text)


def _like(robot: Robot, loss: Loss, with_walk: bool) -> Any:
    """Layout of the artefact of one walk, with its trajectory or without."""
    walk = jax.tree.map(lambda x: np.zeros(np.shape(x)[1:]), walks_like(robot).trajectory)
    last = jax.tree.map(lambda x: np.zeros(np.shape(x)[1:]), walk.state)
    one: Any = ScoredWalk(metrics.score_like(loss=loss), np.zeros(()), last, *[np.array("")] * 2)  # pyright: ignore
    return one, walk if with_walk else None


def _file_name(
    config: TuneConfig, robot: Robot, case: Case, job: Job, with_walk: bool, engine: Engine
) -> str:
    parts = engine.name, engine.version, config.rollout.walk, repr(config.loss), robot, job
    key = content_key(*parts, *([job.plant] if job.plant else []), code=(*engine.modules, *_CODE))
    (name, seed), stem = case, "walk" if with_walk else "score"
    return f"{stem}-{name}-{seed}-{key}.npz"


def say_faults(walks: Mapping[str, Sequence[ScoredWalk]]) -> None:
    """Say which sets have walks with an unsolved QP or a fall in the start-up."""
    for name, each in walks.items():
        worst = np.max([walk.score.residual for walk in each])
        if not worst <= SOLVED:
            say(f"{name}: at least one QP of its walks was not solved (residual {worst:.0e})")
        if falls := [walk.startup for walk in each if walk.startup]:
            say(f"{name}: {len(falls)} of {plural(len(each), 'walk')} {falls[0]}")


def _restored(one: ScoredWalk) -> ScoredWalk:
    """A walk from a file, where texts are arrays."""
    return one._replace(commit=str(one.commit), startup=str(one.startup))


def score_jobs(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    jobs: Mapping[Case, Job],
    *,
    title: str,
    folder: Path | None = None,
    commit: str = "",
    engine: Engine = MUJOCO_C,
    with_walk: Callable[[Case], bool] = lambda case: False,
) -> dict[Case, tuple[ScoredWalk, Trajectory | None]]:
    """Walk jobs and score the walks; those that are in the folder are not walked again.

    Args:
        pool: worker processes.
        config, robot: controller and loss, nominal body.
        jobs: by case; the names of cases are parts of the names of files.
        title: for the person who waits.
        folder: of the scores; None: keep none.
        commit: to note with what is walked now.
        engine: that walks.
        with_walk: whether the walk of a case is kept beside its score.

    Raises:
        InputError: the folder cannot be written, or the engine cannot walk a job.
    """
    tick = config.rollout.walk.gait.tick

    def make(missing: list[Case], stored: Mapping[Case, Any]) -> Iterator[tuple[Case, Any]]:
        there = f"; {len(stored)} of {plural(len(jobs), 'walk')} are there" if stored else ""
        asked = [jobs[case] for case in missing]
        walks = walk_jobs(pool, config, robot, asked, title + there, engine)
        for case, walk in zip(missing, walks, strict=True):
            samples = at_interval(walk, tick) if with_walk(case) else None
            score = _score_walk(pool, config, robot, jobs[case], walk, commit, engine)
            yield case, (score, samples)

    if folder is None:
        return dict(make(list(jobs), {}))
    paths = {
        case: folder / _file_name(config, robot, case, job, with_walk(case), engine)
        for case, job in jobs.items()
    }
    like = lambda case: _like(robot, config.loss, with_walk(case))  # noqa: E731
    results = load_or_make(paths, make, like=like, kind="walk", robot=robot)
    return {case: (_restored(one), walk) for case, (one, walk) in results.items()}


def judge(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    command: Command,
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
    *,
    title: str,
    seconds: float = 4.0,
    folder: Path | None = None,
    commit: str = "",
    plant: Robot | None = None,
    engine: Engine = MUJOCO_C,
) -> ScoredWalks:
    """Walk every weight set on every plant and score the walks.

    Args:
        pool: worker processes.
        config, robot: controller and loss, nominal body.
        sets: weights by name.
        command, seconds: what to walk, and how long.
        plants, seeds: the plants, and the seeds of their estimators.
        title: for the person who waits.
        folder: of the scores, where walks that are there are not walked again; None: keep none.
        commit: to note with what is walked now.
        plant: another model of the robot, of which the plants are.
        engine: that walks.

    Raises:
        InputError: the folder cannot be written, or the engine cannot walk a plant.
    """
    jobs = {
        (name, seed): Job(weights, command, imperfections, seconds, seed, plant=plant)
        for imperfections, seed in zip(plants, seeds, strict=True)
        for name, weights in sets.items()
    }
    with_walk = lambda case: folder is not None and case[1] == seeds[0]  # noqa: E731
    notes: dict[str, Any] = {"title": title, "folder": folder, "commit": commit}
    results = score_jobs(pool, config, robot, jobs, engine=engine, with_walk=with_walk, **notes)
    by_set = {name: [results[name, seed][0] for seed in seeds] for name in sets}
    say_faults(by_set)
    kept = {name: results[name, seeds[0]][1] for name in sets}
    return ScoredWalks(by_set, {name: walk for name, walk in kept.items() if walk is not None})
