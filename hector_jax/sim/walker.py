"""A program of the user that walks, with his own controller in his own simulator, as an engine.

For each walk it is called in its folder, several at once, as

    FILE request.json log.npz

The request has `weights` (as in a weights file), `command` (periodic pieces: `duration` [s],
`velocity` forward and to the left [m/s], `yaw_rate` [rad/s]), `seconds`, `seed`, `push` (forces on
the trunk [N], start and duration [s]) and `plant`, the numbers of a drawn robot (`Imperfections`);
of these two the program takes what its simulator knows. It writes the log (`walk_file`) and ends
with code 0.
"""

import hashlib
import json
import os
import subprocess
import sys
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
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.trajectory import Trajectory, no_samples
from hector_jax.robot.model import Robot
from hector_jax.sim.engine import Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.walk_file import FLAGS, read_walk, reference_of


class Walker(NamedTuple):
    """A program that walks."""

    path: Path
    limit: float  # [s] of a walk
    content: str  # hash of it and of Python files beside it: tells its walks from those of others
    strict: bool = True  # a walk that the program does not make is an error, else a fall
    log: Path | None = None  # file for the log of its walk; None: it is not kept


def walker_of(path: Path, limit: float) -> Walker:
    """Return the walker of a file.

    Args:
        path: an executable file, or a Python file, which this interpreter runs.
        limit: longest time that it may take for a walk [s].

    Raises:
        InputError: there is no such file, or it cannot be executed.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise InputError(f"walker {path}: no such file")
    if path.suffix != ".py" and not os.access(path, os.X_OK):
        raise InputError(f"walker {path}: expected a Python file or an executable one (chmod +x)")
    files = sorted({path, *path.parent.glob("*.py")})
    content = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:16]
    return Walker(path, limit, content)


def walker_engine(walker: Walker) -> Engine:
    """Return a walker as an engine."""
    name = walker.path.name
    return Engine(
        name=name,
        title=f"simulator of {name}",
        walk=partial(_walk, walker),
        bits=_bits,
        modules=("sim.walker",),
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
        raise InputError(f"{walker.path} has a robot of its own: Job.plant must be None")
    body, call = jax.tree.map(np.asarray, robot), map if pool is None else pool.map
    ends = call(_walk_once, repeat(walker), repeat(config), repeat(body), map(on_host, jobs))
    for job, (walk, end) in zip(jobs, ends, strict=True):
        if end:
            say(f"{walker.path.name}, seed {job.seed}: {end}")
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
            write_log(walker, job, log)
            if walker.log is not None:
                write_file(walker.log, log.read_bytes())
            walk, end = read_walk(log, robot, seconds, tick)
        except InputError as error:
            text = str(error).replace(f"{log}: ", f"{walker.path}: its log: ")
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


def write_log(walker: Walker, job: Job, log: Path) -> None:
    """Let the program walk and write its log.

    Raises:
        InputError: see `_walk_once`.
    """
    with TemporaryDirectory(prefix="hector-walk-") as folder:
        request = Path(folder) / "request.json"
        request.write_text(json.dumps(_request(job)))
        _call(walker, request, log)
    if not log.exists():
        raise InputError(f"{walker.path}: ended with code 0, but wrote no log")


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


# Starts a program in a session of its own, and ends it with all that it started: at its end, after
# a time limit, and if the process that waits for it was killed. Code 124 tells the limit.
_SUPERVISOR = """
import os, signal, subprocess, sys, time
limit, parent, *words = sys.argv[1:]
signal.pthread_sigmask(signal.SIG_SETMASK, [])
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, range(os.cpu_count()))
try:
    program = subprocess.Popen(words, start_new_session=True)
except OSError as error:
    sys.exit(f"cannot be started: {error.strerror}")
end = time.monotonic() + float(limit)
while program.poll() is None and os.getppid() == int(parent) and time.monotonic() < end:
    time.sleep(0.01)
code = program.poll()
try:
    os.killpg(program.pid, signal.SIGKILL)
except ProcessLookupError:
    pass
sys.exit(124 if code is None else code if code >= 0 else 128 - code)
"""


def _call(walker: Walker, request: Path, log: Path) -> None:
    """Run the program, and end it with all that it started when its time is over."""
    path = walker.path
    words = [str(path), str(request), str(log.resolve())]
    if path.suffix == ".py" and not (os.access(path, os.X_OK) and path.read_bytes()[:2] == b"#!"):
        words.insert(0, sys.executable)
    inputs = [sys.executable, "-I", "-S", "-c", _SUPERVISOR, str(walker.limit), str(os.getpid())]
    ran = subprocess.run(
        [*inputs, *words],
        cwd=path.parent,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        check=False,
    )
    if ran.returncode == 124:
        raise InputError(f"{path}: took longer than {walker.limit:g} s; killed")
    if ran.returncode:
        lines = [x for x in ran.stdout.decode(errors="replace").split("\n") if x.strip()]
        last = one_line(lines[-1]) if lines else "no output"
        raise InputError(f"{path}: ended with code {ran.returncode}: {last}")
