"""The step `judge`: walks of weight sets on plants, and the table of their scores.

In a folder the table is `walks.jsonl`, a row for each walk, written as it ends. The column `key` is
a `content_key` of all that determines the walk: what is there is not walked again, and another
robot, engine or code adds rows of its own.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar, say
from hector_jax.core.files import locked
from hector_jax.core.inputs import plural
from hector_jax.core.journal import add_row, continue_journal
from hector_jax.core.trajectory import SOLVED, Trajectory, no_samples
from hector_jax.core.tree_file import save_tree
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import Robot
from hector_jax.sim.diagnosis import fall_of
from hector_jax.sim.engine import MUJOCO_C, Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import Imperfections
from hector_jax.store.cache import content_key, load_stored
from hector_jax.store.setup import Setup
from hector_jax.tuning.loss import Loss
from hector_jax.tuning.rollout import Scenario, rollout, rollout_config
from hector_jax.verdict import metrics
from hector_jax.verdict.stopping import StoppingRule, is_clear

TABLE = "walks.jsonl"
# modules that determine the numbers, for `content_key`
_CODE = ("verdict.judging", "sim.diagnosis", "verdict.metrics")

Case = tuple[str, str, int]
"""Trajectory, weight set and seed of the plant of a walk."""


class ScoredWalk(NamedTuple):
    """Results of one walk."""

    score: metrics.Score
    upright: float  # [s] until a fall or the end; below zero in the start-up
    startup: str  # description of a fall in the start-up; empty if there is none


class Judged(NamedTuple):
    """Walks of several sets on the same plants and trajectories."""

    walks: dict[Case, ScoredWalk]
    verdict: metrics.Verdict
    stored: dict[Case, Trajectory]  # the walks that are saved beside their scores

    def first(self, trajectory: str) -> dict[str, Trajectory]:
        """Return the stored walk of each set on a trajectory."""
        found = self.stored.items()
        return {name: walk for (scene, name, _), walk in found if scene == trajectory}


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
    return ScoredWalk(metrics.score(config.loss, walk), upright, text)


def _as_row(walked: ScoredWalk) -> dict[str, Any]:
    """Return the columns of the table that a walk decides; angles in rad, lengths in m."""
    score = jax.tree.map(lambda x: x.tolist(), walked.score)._asdict()
    return score.pop("losses") | score | {"upright": walked.upright, "startup": walked.startup}


def _from_row(loss: Loss, row: Mapping[str, Any]) -> ScoredWalk:
    """Return the walk of a row; null, for a number that is not finite, is NaN."""
    number = partial(np.array, dtype=float)  # NaN of None
    columns = {name: number(row[name]) for name in metrics.Score._fields if name in row}
    losses = {part: number(row[part]) for part in metrics.parts_of(loss)}
    score = metrics.Score(losses, **columns | {"fallen": np.array(row["fallen"], bool)})
    return ScoredWalk(score, float(number(row["upright"])), str(row["startup"]))


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
    with_walk: Collection[Case] = (),
    about: Mapping[str, str] | None = None,
) -> dict[Case, tuple[ScoredWalk, Trajectory | None]]:
    """Walk jobs and score the walks; walks that are in the table of the folder are not repeated.

    Args:
        setup: workers, controller and loss, nominal body.
        jobs: jobs by case, whose labels are columns of the table.
        title: title of the progress bar.
        folder: folder of the table; None: nothing is saved.
        engine: engine of the walks.
        with_walk: cases whose walks are saved beside the table.
        about: other columns of the table, the same for all walks, such as `world`.

    Raises:
        InputError: the folder cannot be written, its table is damaged, or the engine cannot walk a
            job.
    """
    keys = {case: _key(setup, job, engine) for case, job in jobs.items()}
    files, found, stored = {}, {}, {}
    with nullcontext() if folder is None else locked(folder):
        if folder is not None:
            found = _read_table(folder, setup.config.loss, keys)
            files = {case: folder / _file_name(case, keys[case]) for case in with_walk}
            like = no_samples(len(setup.robot.joint_lower), len(setup.robot.foot_point))
            stored = load_stored(files, lambda _: like, kind="walk", robot=setup.robot)
        missing = [x for x in jobs if x not in found or (x in files and x not in stored)]
        there = len(jobs) - len(missing)
        remark = f"; {there} of {plural(len(jobs), 'walk')} are there" if there else ""
        new_jobs = [jobs[case] for case in missing]
        walks = walk_jobs(setup, new_jobs, title + remark, engine) if missing else ()
        for case, walk in zip(missing, walks, strict=True):
            trajectory, name, seed = case
            row = {"trajectory": trajectory, "set": name, "seed": seed, "engine": engine.name}
            row |= dict(about or {}) | {"key": keys[case]}
            row |= _as_row(_score_walk(setup, jobs[case], walk, engine))
            if case in files:
                stored[case] = at_interval(walk, setup.config.rollout.walk.gait.tick)
                save_tree(files[case], stored[case], kind="walk", robot=setup.robot)
            if folder is not None:
                add_row(folder / TABLE, row)
            found[case] = _from_row(setup.config.loss, row)  # as it is read again
    return {case: (found[case], stored.get(case)) for case in jobs}


def _read_table(folder: Path, loss: Loss, keys: Mapping[Case, str]) -> dict[Case, ScoredWalk]:
    """Return the walks that are in the table of a folder, which is begun if it is missing."""

    def parse(row: Mapping[str, Any]) -> tuple[Case, ScoredWalk | None]:
        case = row["trajectory"], row["set"], row["seed"]
        return case, _from_row(loss, row) if keys.get(case) == row["key"] else None

    rows = continue_journal(folder / TABLE, None, "the table of walks", parse)
    return {case: walked for case, walked in rows if walked}


def _key(setup: Setup, job: Job, engine: Engine) -> str:
    """Return the key of all that determines the row of a walk."""
    _, config, robot = setup
    parts = [engine.key, config.rollout.walk, repr(config.loss), robot, job]
    return content_key(*parts, *([job.plant] if job.plant else []), code=(*engine.modules, *_CODE))


def _file_name(case: Case, key: str) -> str:
    """Return the file of a walk; labels that become equal are told apart by their key."""
    labels = (re.sub(r"[^\w.-]+", "_", str(label)) for label in case)
    return "-".join(["walk", *labels, f"{key}.npz"])


def judge_jobs(
    setup: Setup,
    jobs: Mapping[Case, Job],
    *,
    title: str,
    where: str = "",
    rule: StoppingRule | None = None,
    **options: Any,
) -> Judged:
    """Walk every set on every trajectory and plant, score the walks and say their faults.

    Args:
        setup, title, options: see `score_jobs`.
        jobs: a job for each trajectory, set and seed.
        where: what follows the name of a set where its faults are said.
        rule: says when the other plants, in the order of the jobs, need not walk; None: all walk.
    """
    seeds, walks, stored = _seeds_of(jobs), {}, {}
    for batch in rule.batches(len(seeds)) if rule else [range(len(seeds))]:
        plants = seeds[batch.start : batch.stop]
        next_jobs = {case: job for case, job in jobs.items() if case[2] in plants}
        remark = f", plants {batch.start + 1} to {batch.stop} of {len(seeds)}" if rule else ""
        results = score_jobs(setup, next_jobs, title=title + remark, **options)
        walks |= {case: walk for case, (walk, _) in results.items()}
        stored |= {case: walk for case, (_, walk) in results.items() if walk is not None}
        if rule and is_clear(_verdict_of(setup, walks, rule)):
            break
    verdict = _verdict_of(setup, walks, rule)
    for scene, by_set in _by_set(walks).items():
        on = f" on {scene}{where}" if len(verdict.scenes) > 1 else where
        say_faults({f"{name}{on}": group for name, group in by_set.items()})
    return Judged(walks, verdict, stored)


def _seeds_of(cases: Iterable[Case]) -> list[int]:
    return list(dict.fromkeys(seed for *_, seed in cases))


def _by_set(walks: Mapping[Case, ScoredWalk]) -> dict[str, dict[str, list[ScoredWalk]]]:
    """Return the walks by trajectory and set, in the order of their plants."""
    groups: dict[str, dict[str, list[ScoredWalk]]] = {}
    for (trajectory, name, _), walk in walks.items():
        groups.setdefault(trajectory, {}).setdefault(name, []).append(walk)
    return groups


def _verdict_of(
    setup: Setup, walks: Mapping[Case, ScoredWalk], rule: StoppingRule | None
) -> metrics.Verdict:
    scores = {
        scene: {name: [walk.score for walk in group] for name, group in by_set.items()}
        for scene, by_set in _by_set(walks).items()
    }
    rank = rule.rank if rule else metrics.fixed_rank
    return metrics.make_verdict(setup.config.loss, _seeds_of(walks), scores, rank)


def judge(
    setup: Setup,
    sets: Mapping[str, Weights],
    commands: Mapping[str, Command],
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
    *,
    title: str,
    seconds: float = 4.0,
    folder: Path | None = None,
    engine: Engine = MUJOCO_C,
    about: Mapping[str, str] | None = None,
) -> Judged:
    """Walk every weight set on every trajectory and plant, and score the walks.

    Args:
        setup: workers, controller and loss, nominal body.
        sets: weights by name.
        commands, seconds: command of each trajectory, and length of the walks.
        plants, seeds: plants, and the seeds of their estimators.
        title: title of the progress bar.
        folder: folder of the table, and of the walks on the first plant; walks that are in it are
            not repeated; None: nothing is saved.
        engine: engine of the walks.
        about: other columns of the table, the same for all walks, such as `world`.

    Raises:
        InputError: the folder cannot be written, or the engine cannot walk a plant.
    """
    jobs = {
        (scene, name, seed): Job(weights, command, plant, seconds, seed)
        for scene, command in commands.items()
        for plant, seed in zip(plants, seeds, strict=True)
        for name, weights in sets.items()
    }
    first = [case for case in jobs if case[2] == seeds[0]] if folder else []
    options = {"title": title, "folder": folder, "engine": engine, "about": about}
    return judge_jobs(setup, jobs, with_walk=first, **options)
