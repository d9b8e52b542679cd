"""Four jobs, kept as the program keeps them, and a killer: `python killed.py JOB FOLDER KILLS`.

A job of many artefacts (collection, table) is begun again and again and killed after a few saves
more, at a moment drawn evenly from the time between two saves, so that some kills fall inside a
save. A job that is one artefact (tuning, training) begins anew each time, also where it had ended,
and is killed at a moment drawn evenly from the time that it takes. The last one is left alone.
Models are toys: what is tried here is what is kept. FOLDER.done has a line for each piece of work
that was done, whether it was kept or not.
"""

import os
import shutil
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from pretend import pretend_walk
from synthetic import synthetic_walk

from hector_jax.control.reference import named_command
from hector_jax.control.weights import (
    directions,
    expert,
    nominal,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.files import locked
from hector_jax.core.runtime import setup_jax
from hector_jax.grfm.collection import collect
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot.model import load_robot
from hector_jax.sim.world import hfs
from hector_jax.store import nets, tunings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem
from hector_jax.tuning.difftune import TuneConfig, descend
from hector_jax.tuning.evaluate import Evaluation, Objective
from hector_jax.verdict import judging

ROBOT, S = load_robot(), named_command("s")
WALKS = 160  # so many that 25 kills come before the last one is saved


def done(folder: Path, what) -> None:
    with (folder.parent / f"{folder.name}.done").open("a") as file:
        file.write(f"{what}\n")


def look(folder: Path, weights) -> Evaluation:
    """A quadratic in log-weights."""
    vector = np.asarray(weights_to_vector(weights), float)
    logs = np.log(vector) - 1.0
    gradient = vector_to_weights(jnp.asarray(2.0 * logs / vector))
    done(folder, f"{logs.sum():.17g}")
    time.sleep(0.01)
    loss = np.array(logs @ logs)
    none = np.array(0.0)
    terms = dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), loss)
    return Evaluation(loss, terms, gradient, none, none)


def toy(folder: Path) -> Objective:
    """A quadratic, which is taken for a steeper one so that there are more steps."""
    return Objective(partial(look, folder), lambda weights: 6.0 * directions() @ directions().T)


def tune_toys(folder: Path, setup, start, problems, title, on_iteration):
    """In the place of `tunings._tunings`."""
    for name in problems:
        tuning = descend(setup.config, start, toy(folder), partial(on_iteration, name))
        yield name, tunings.Tuned(tuning, setup.commit)


def tuning(folder: Path) -> None:
    tunings._tunings = partial(tune_toys, folder)
    tunings.tune_all(
        Setup(ThreadPoolExecutor(1), TuneConfig(iterations=60), ROBOT),
        {"toy": Problem((S,), None)},
        folder,
        title="",
        metrics=folder / "metrics.jsonl",
    )


def walk_jobs(folder: Path, jobs):
    for job in jobs:
        done(folder, job.seed)
        yield synthetic_walk(job.seed, 12)


def collection(folder: Path) -> None:
    with locked(folder):
        jobs = draw_jobs(0, WALKS)
        collect(folder, jobs, partial(walk_jobs, folder), robot=ROBOT)


def training(folder: Path) -> None:
    walks = folder.parent / "walks"
    with locked(walks):
        jobs = draw_jobs(0, 5)
        collect(walks, jobs, partial(walk_jobs, walks), robot=ROBOT)
    config = TrainConfig(os.environ.get("VARIANT", "paper"), epochs=60, batch=16)
    if not (folder / "net.npz").exists():
        nets.train_net(config, ROBOT, walks, folder / "net.npz")


def table(folder: Path) -> None:
    def walks_of(setup, jobs, title, engine):
        for job in jobs:
            done(folder, f"{job.seed} {float(job.weights.Q.euler[0])}")
            yield pretend_walk(job.seed, float(job.weights.Q.euler[0]) / 1e4, 1.0)

    judging.walk_jobs, tunings._tunings = walks_of, partial(tune_toys, folder)
    setup = Setup(ThreadPoolExecutor(1), TuneConfig(iterations=20), ROBOT)
    problems = {"without": Problem((S,), None)}
    with locked(folder):
        tuned = tunings.tune_all(setup, problems, folder / "s", title="")["without"]
        sets = {"nominal": nominal(), "expert": expert(), "without": tuned.tuning.weights}
        seeds = range(WALKS // 2)
        plants = [hfs()] * len(seeds)
        judging.judge(setup, sets, S, plants, seeds, title="", folder=folder / "s")


JOBS = {job.__name__: job for job in (tuning, collection, training, table)}


def newest(folder: Path) -> tuple[int, ...]:
    """Times of the last change of all folders below: each save changes one."""
    return tuple(sorted(f.stat().st_mtime_ns for f in (folder, *folder.glob("*/")) if f.is_dir()))


ONE = ("tuning", "training")  # jobs that are one artefact


def killed(start, folder: Path, saves: int, wait: float) -> bool:
    """Start the job, let it save a few times and wait; whether it was still there to be killed."""
    child = start()
    try:
        for _ in range(saves):
            before = newest(folder)
            while newest(folder) == before:
                if os.waitpid(child, os.WNOHANG)[0]:
                    return False
                time.sleep(0.0005)
        time.sleep(wait)
        os.kill(child, signal.SIGKILL)
        return os.waitpid(child, 0)[1] == signal.SIGKILL
    except ChildProcessError:
        return False


def main(name: str, folder: Path, kills: int) -> None:
    def start(folder: Path = folder) -> int:
        child = os.fork()  # before JAX has threads; spares importing all again
        if child == 0:
            setup_jax()
            JOBS[name](folder)
            os._exit(0)
        return child

    folder.mkdir(parents=True)
    rng, hits, seconds = np.random.default_rng(len(name)), 0, 0.03
    if name in ONE and kills:
        for trial in ("compiled", "timed"):
            begin = time.monotonic()
            os.waitpid(start(folder.parent / trial / name), 0)
            seconds = time.monotonic() - begin
    for _ in range(kills):
        saves = 0 if name in ONE else int(rng.integers(1, 4))
        hit = killed(start, folder, saves, rng.uniform(0.0, seconds))
        hits += hit
        if name in ONE and not hit:  # it had ended
            shutil.rmtree(folder, ignore_errors=True)
    code = os.waitpid(start(), 0)[1]
    print(f"{name}: {hits} kills", flush=True)
    sys.exit(code != 0)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
