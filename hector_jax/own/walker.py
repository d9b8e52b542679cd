"""A program of the user that walks, with his own controller in his own simulator, as an engine.

For each walk it is called (`program`) as

    FILE request.json log.npz

The request has `weights` (as in a weights file), `command` (periodic pieces: `duration` [s],
`velocity` forward and to the left [m/s], `yaw_rate` [rad/s]), `seconds`, `seed`, `push` (forces on
the trunk [N], start and duration [s]) and `plant`, the numbers of a drawn robot (`Imperfections`);
of these two the program takes what its simulator knows. It writes the log (`walk_file`).
"""

import json
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from functools import partial
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.console import say
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory, no_samples
from hector_jax.own.program import Program, call_program
from hector_jax.own.walk_file import FLAGS, read_walk, reference_of
from hector_jax.robot.model import Robot
from hector_jax.sim.engine import Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host


class Walker(NamedTuple):
    """A program that walks."""

    program: Program
    strict: bool = True  # a walk that the program does not make is an error, else a fall
    log: Path | None = None  # file for the log of its walk; None: it is not kept


def walker_engine(walker: Walker) -> Engine:
    """Return a walker as an engine."""
    name = walker.program.path.name
    return Engine(
        name=name,
        title=f"simulator of {name}",
        walk=partial(_walk, walker),
        bits=_bits,
        modules=("own.walker",),
        content=walker.program.content,
        differs=f"the walks are those of {name}",
    )


def _bits(exact: bool) -> int:
    return 64  # of the log


def _walk(
    walker: Walker,
    pool: Executor | None,
    config: WalkConfig,
    robot: Robot,
    jobs: Sequence[Job],
    *,
    exact: bool = True,
    batch: int = 0,
) -> Iterator[Trajectory]:
    if any(job.plant is not None for job in jobs):
        raise InputError(f"{walker.program.path} has a robot of its own: Job.plant must be None")
    body, call = jax.tree.map(np.asarray, robot), map if pool is None else pool.map
    ends = call(_walk_once, repeat(walker), repeat(config), repeat(body), map(on_host, jobs))
    for job, (walk, end) in zip(jobs, ends, strict=True):
        if end:
            say(f"{walker.program.path.name}, seed {job.seed}: {end}")
        yield walk


def _walk_once(
    walker: Walker, config: WalkConfig, robot: Robot, job: Job
) -> tuple[Trajectory, str]:
    """Return a walk of the program, and how it ended; see `read_walk`.

    Raises:
        InputError: one line: the program ended with another code than 0, took too long, or wrote
            no log or a wrong one.
    """
    tick, seconds = config.gait.tick, float(job.seconds)
    with TemporaryDirectory(prefix="hector-walk-") as folder:
        log = Path(folder) / "log.npz"
        try:
            write_log(walker.program, job, log)
            if walker.log is not None:
                write_file(walker.log, log.read_bytes())
            walk, end = read_walk(log, robot, seconds, tick)
        except InputError as error:
            text = str(error).replace(f"{log}: ", f"{walker.program.path}: its log: ")
            if walker.strict:
                raise InputError(text) from None
            walk, end = _not_walked(robot, seconds, tick), f"{text}; counts as a fall"
    reference = jax.tree.map(np.asarray, reference_of(tick, robot, job.command, walk))
    return walk._replace(reference=reference), end


def _not_walked(robot: Robot, seconds: float, tick: float) -> Trajectory:
    """Return a walk of a robot that lies on the floor."""
    empty = no_samples(len(robot.joint_lower), len(robot.foot_point))
    count = round(seconds / tick)
    down = jax.tree.map(lambda x: np.zeros((count, *x.shape[1:]), x.dtype), empty)
    flags = {name: np.full_like(getattr(down, name), name == "fallen", bool) for name in FLAGS}
    return down._replace(period=np.asarray(tick), initial=empty.initial, **flags)


def write_log(walker: Program, job: Job, log: Path) -> None:
    """Let a program walk and write its log.

    Raises:
        InputError: see `program.call_program`.
    """
    with TemporaryDirectory(prefix="hector-walk-") as folder:
        request = Path(folder) / "request.json"
        request.write_text(json.dumps(_request(job)))
        call_program(walker, request, log)


def _request(job: Job) -> dict[str, Any]:
    """Return what the program is asked to walk, as JSON values."""
    as_lists = partial(jax.tree.map, lambda x: np.asarray(x).tolist())
    plant = as_lists(job.imperfections)
    return {
        "weights": weights_tree(job.weights),
        "command": as_lists(job.command)._asdict(),
        "seconds": float(job.seconds),
        "seed": int(job.seed),
        "push": as_lists(job.push)._asdict(),
        "plant": plant._asdict() | {"estimator": plant.estimator._asdict()},
    }
