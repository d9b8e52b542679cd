"""The step `judge`: walks of weight sets on plants, each score an artefact (cache.py)."""

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar, say
from hector_jax.core.inputs import plural
from hector_jax.core.trajectory import SOLVED, State, Trajectory, no_samples
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import Robot
from hector_jax.sim.diagnosis import fall_of
from hector_jax.sim.engine import MUJOCO_C, Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import Imperfections
from hector_jax.store.cache import content_key, load_or_make
from hector_jax.store.setup import Setup
from hector_jax.tuning.rollout import Scenario, rollout, rollout_config
from hector_jax.verdict import metrics

# modules that determine the numbers, for `content_key`
_CODE = ("verdict.judging", "sim.diagnosis", "verdict.metrics")

Case = tuple[str | int, ...]
"""Labels of a walk, the last the seed of its plant."""


class ScoredWalk(NamedTuple):
    """Stored results of one walk."""

    score: metrics.Score
    upright: Float[np.ndarray, ""]  # [s] until a fall or the end; below zero in the start-up
    last: State  # last upright state
    startup: str  # description of a fall in the start-up; empty if there is none


class ScoredWalks(NamedTuple):
    """Walks of several sets on the same plants."""

    walks: dict[str, list[ScoredWalk]]  # by set, in the order of the plants
    first: dict[str, Trajectory]  # by set, the walk on the first plant; empty if none is stored

    @property
    def scores(self) -> dict[str, list[metrics.Score]]:
        """Scores by set, in the order of the plants."""
        return {name: [walk.score for walk in walks] for name, walks in self.walks.items()}


def walk_jobs(
    setup: Setup, jobs: Sequence[Job], title: str, engine: Engine = MUJOCO_C
) -> Iterator[Trajectory]:
    """Yield the walks of jobs in order, each when it is available."""
    pool, config, robot = setup
    with bar(title) as report_progress:
        report_progress(0, len(jobs), "compiling")
        for done, walk in enumerate(engine.walk(pool, config.rollout.walk, robot, jobs), 1):
            yield walk
            report_progress(done, len(jobs), "")


def walk_rigid_body(robot: Robot, weights: Weights, command: Command, seconds: float) -> Trajectory:
    """Return a walk of `seconds` on the plain rigid body, without a tuning's noise and delay."""
    config = rollout_config(robot, seconds)
    config = replace(config, estimate_noise=0.0, delay=0.0)
    scenario = Scenario(robot, command, standing_anchor(robot), last_command)
    return jax.device_get(jax.jit(rollout, static_argnums=0)(config, scenario, weights))


def _score_walk(setup: Setup, job: Job, walk: Trajectory, engine: Engine) -> ScoredWalk:
    """Score a walk; simulate it again in MuJoCo C if it fell in the start-up."""
    pool, config, robot = setup
    samples, text = int(np.sum(~np.asarray(walk.fallen))), ""  # upright samples
    upright = samples * float(walk.period)
    if not samples and not engine.differs:
        body, host_job = jax.tree.map(np.asarray, robot), on_host(job)
        if fall := pool.submit(fall_of, config.rollout.walk, body, host_job).result():
            upright, text = fall.time, str(fall)
    last = jax.tree.map(lambda x: np.asarray(x)[max(samples - 1, 0)], walk.state)
    score = metrics.score(config.loss, walk)
    return ScoredWalk(score, np.asarray(upright), last, text)


def _like(setup: Setup, with_walk: bool) -> Any:
    """Return the structure of the artefact of one walk, with or without its trajectory."""
    walk = no_samples(len(setup.robot.joint_lower), len(setup.robot.foot_point))
    score = metrics.score_like(loss=setup.config.loss)
    return ScoredWalk(score, np.zeros(()), walk.initial, ""), walk if with_walk else None


def _file_name(setup: Setup, case: Case, job: Job, with_walk: bool, engine: Engine) -> str:
    _, config, robot = setup
    parts = [engine.key, config.rollout.walk, repr(config.loss), robot, job]
    key = content_key(*parts, *([job.plant] if job.plant else []), code=(*engine.modules, *_CODE))
    labels = (
        re.sub(r"[^\w.-]+", "_", str(label)) for label in case
    )  # the key tells equal ones apart
    return "-".join(["walk" if with_walk else "score", *labels, f"{key}.npz"])


def say_faults(walks: Mapping[str, Sequence[ScoredWalk]]) -> None:
    """Print which sets have walks with an unsolved QP or a fall in the start-up."""
    for name, group in walks.items():
        worst = np.max([walk.score.residual for walk in group])
        if not worst <= SOLVED:
            say(f"{name}: at least one QP of its walks was not solved (residual {worst:.0e})")
        if falls := [walk.startup for walk in group if walk.startup]:
            say(f"{name}: {len(falls)} of {plural(len(group), 'walk')} {falls[0]}")


def score_jobs(
    setup: Setup,
    jobs: Mapping[Case, Job],
    *,
    title: str,
    folder: Path | None = None,
    engine: Engine = MUJOCO_C,
    with_walk: Container[Case] = (),
) -> dict[Case, tuple[ScoredWalk, Trajectory | None]]:
    """Walk jobs and score the walks; walks whose scores are in the folder are not repeated.

    Args:
        setup: workers, controller and loss, nominal body.
        jobs: jobs by case; its labels are parts of the names of files.
        title: title of the progress bar.
        folder: folder of the scores; None: nothing is saved.
        engine: engine of the walks.
        with_walk: cases whose walks are saved beside their scores.

    Raises:
        InputError: the folder cannot be written, or the engine cannot walk a job.
    """
    tick = setup.config.rollout.walk.gait.tick

    def make(missing: list[Case], stored: Mapping[Case, Any]) -> Iterator[tuple[Case, Any]]:
        remark = f"; {len(stored)} of {plural(len(jobs), 'walk')} are there" if stored else ""
        new_jobs = [jobs[case] for case in missing]
        walks = walk_jobs(setup, new_jobs, title + remark, engine)
        for case, walk in zip(missing, walks, strict=True):
            samples = at_interval(walk, tick) if case in with_walk else None
            yield case, (_score_walk(setup, jobs[case], walk, engine), samples)

    if folder is None:
        return dict(make(list(jobs), {}))
    paths = {
        case: folder / _file_name(setup, case, job, case in with_walk, engine)
        for case, job in jobs.items()
    }
    like = lambda case: _like(setup, case in with_walk)  # noqa: E731
    return load_or_make(paths, make, like=like, kind="walk", robot=setup.robot)


def judge(
    setup: Setup,
    sets: Mapping[str, Weights],
    command: Command,
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
    *,
    title: str,
    seconds: float = 4.0,
    folder: Path | None = None,
    plant: Robot | None = None,
    engine: Engine = MUJOCO_C,
) -> ScoredWalks:
    """Walk every weight set on every plant and score the walks.

    Args:
        setup: workers, controller and loss, nominal body.
        sets: weights by name.
        command, seconds: command to walk, and length of the walks.
        plants, seeds: plants, and the seeds of their estimators.
        title: title of the progress bar.
        folder: folder of the scores; walks whose scores are in it are not repeated; None: nothing
            is saved.
        plant: another model of the robot, to which the plants belong.
        engine: engine of the walks.

    Raises:
        InputError: the folder cannot be written, or the engine cannot walk a plant.
    """
    jobs = {
        (name, seed): Job(weights, command, imperfections, seconds, seed, plant=plant)
        for imperfections, seed in zip(plants, seeds, strict=True)
        for name, weights in sets.items()
    }
    first = [(name, seeds[0]) for name in sets] if folder else []
    results = score_jobs(setup, jobs, title=title, folder=folder, engine=engine, with_walk=first)
    by_set = {name: [results[name, seed][0] for seed in seeds] for name in sets}
    say_faults(by_set)
    firsts = ((name, results[name, seeds[0]][1]) for name in sets)
    walks = {name: walk for name, walk in firsts if walk is not None}
    return ScoredWalks(by_set, walks)
