"""Two jobs, kept as the program keeps them, and a killer: `python killed.py JOB FOLDER KILLS`.

A job is begun again and again and killed after a few saves more, at a moment drawn evenly from the
time between two saves, so that some kills fall inside a save. The last one is left alone. Models
are toys: what is tried here is what is kept. FOLDER.done has a line for each piece of work that was
done, whether it was kept or not.
"""

import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
from pretend import pretend_history, pretend_walk, tuning_of
from synthetic import synthetic_walk

from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.files import locked
from hector_jax.core.runtime import setup_jax
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.robot.model import load_robot
from hector_jax.sim.world import hfs
from hector_jax.store import tunings
from hector_jax.store.collection import collect
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging

ROBOT, S = load_robot(), named_command("s")
WALKS = 160  # so many that 25 kills come before the last one is saved


def done(folder: Path, what) -> None:
    with (folder.parent / f"{folder.name}.done").open("a") as file:
        file.write(f"{what}\n")


def collection(folder: Path) -> None:
    def walk_jobs(jobs):
        for job in jobs:
            done(folder, job.seed)
            yield synthetic_walk(job.seed, 12)

    with locked(folder):
        collect(folder, draw_jobs(0, WALKS), walk_jobs, robot=ROBOT)


def table(folder: Path) -> None:
    """A tuning, and walks with its result."""

    def tune_toys(setup, start, problems, title, on_iteration):
        tuning = tuning_of(pretend_history(20))  # here: nothing is computed before the fork
        for name in problems:
            for iteration in tuning.iterations:
                on_iteration(name, iteration)
            yield name, tuning

    def walks_of(setup, jobs, title, engine):
        for job in jobs:
            done(folder, f"{job.seed} {float(job.weights.Q.euler[0])}")
            yield pretend_walk(job.seed, float(job.weights.Q.euler[0]) / 1e4, 1.0)

    judging.walk_jobs, tunings._tunings = walks_of, tune_toys
    setup = Setup(ThreadPoolExecutor(1), TuneConfig(), ROBOT)
    problems, metrics = {"without": Problem((S,), None)}, folder / "metrics.jsonl"
    with locked(folder):
        tuned = tunings.tune_all(setup, problems, folder / "s", title="", metrics=metrics)
        sets = {"nominal": nominal(), "expert": expert()}
        sets["without"] = tuned["without"].weights
        seeds = range(WALKS // 2)
        plants = [hfs()] * len(seeds)
        judging.judge(setup, sets, {"s": S}, plants, seeds, title="", folder=folder / "s")


JOBS = {job.__name__: job for job in (collection, table)}


def newest(folder: Path) -> tuple[int, ...]:
    """Times of the last change of all that is below: each save changes one."""
    times = []
    for place in (folder, *folder.rglob("*")):
        with suppress(FileNotFoundError):  # a part that has been renamed
            times.append(place.stat().st_mtime_ns)
    return tuple(sorted(times))


def killed(child: int, folder: Path, saves: int, wait: float) -> bool:
    """Let the job save a few times and wait; whether it was still there to be killed."""
    for _ in range(saves):
        before = newest(folder)
        while newest(folder) == before:
            if os.waitpid(child, os.WNOHANG)[0]:
                return False
            time.sleep(0.0005)
    time.sleep(wait)
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1] == signal.SIGKILL


def main(name: str, folder: Path, kills: int) -> None:
    def start() -> int:
        child = os.fork()  # before JAX has threads; spares importing all again
        if child == 0:
            setup_jax()
            JOBS[name](folder)
            os._exit(0)
        return child

    folder.mkdir(parents=True)
    rng, hits = np.random.default_rng(len(name)), 0
    for _ in range(kills):
        saves, wait = int(rng.integers(1, 4)), rng.uniform(0.0, 0.03)
        hits += killed(start(), folder, saves, wait)
    code = os.waitpid(start(), 0)[1]
    print(f"{name}: {hits} kills", flush=True)
    sys.exit(code != 0)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
