"""A program of the user that walks, with his own controller in his own simulator, as an engine.

For each walk it is called, several at once, with the environment, the cores and the folder that
this program was started with, as

    FILE request.json log.npz

The request has `weights` (as in a weights file), `command` (periodic pieces: `duration` [s],
`velocity` forward and to the left [m/s], `yaw_rate` [rad/s]), `seconds`, `seed`, `push` (forces on
the trunk [N], start and duration [s]) and `plant`, the numbers of a drawn robot (`Imperfections`);
of these two the program takes what its simulator knows. It writes the log (`walk_file`) and ends
with code 0.
"""

import ast
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from functools import partial
from itertools import repeat
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.console import say
from hector_jax.core.environment import imported_names
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.runtime import started_with
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
    content: str  # hash of the files that it declares: tells its walks from those of others
    strict: bool = True  # a walk that the program does not make is an error, else a fall
    log: Path | None = None  # file for the log of its walk; None: it is not kept


def walker_of(path: Path, limit: float, uses: Sequence[Path] = ()) -> Walker:
    """Return the walker of a file.

    Args:
        path: an executable file, or a Python file, which this interpreter runs.
        limit: longest time that it may take for a walk [s].
        uses: other files and folders that decide its walks. Its own file does, and what that
            imports of the Python files and packages beside it.

    Raises:
        InputError: there is no such file or folder, or the program cannot be executed.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise InputError(f"walker {path}: no such file")
    if path.suffix != ".py" and not os.access(path, os.X_OK):
        raise InputError(f"walker {path}: expected a Python file or an executable one (chmod +x)")
    files = {file: file.relative_to(path.parent) for file in _imports(path)}
    for place in uses:
        if not place.exists():
            raise InputError(f"--walker-uses {place}: no such file or folder")
        files |= _files(place.resolve())
    named = sorted((name.parts, file.read_bytes()) for file, name in files.items())
    return Walker(path, limit, hashlib.sha256(repr(named).encode()).hexdigest()[:16])


def _imports(program: Path) -> set[Path]:
    """Return a program and the Python files in its folder that it imports, packages as a whole."""
    found, pending = set[Path](), [program]
    while pending:
        if (file := pending.pop()) in found:
            continue
        found.add(file)
        with suppress(SyntaxError, ValueError):  # it may be a binary
            for name in imported_names(ast.parse(file.read_bytes())):
                place = program.parent / name.partition(".")[0]
                pending += [
                    x for x in (place.with_suffix(".py"), *place.rglob("*.py")) if x.is_file()
                ]
    return found


def _files(place: Path) -> dict[Path, Path]:
    """Return names in a folder by file, without what is hidden or compiled by Python; or a file."""
    folder, inner = (place, place.rglob("*")) if place.is_dir() else (place.parent, [place])
    names = {file: file.relative_to(folder) for file in inner if file.is_file()}
    return {
        file: name
        for file, name in names.items()
        if file == place or not any(x[0] == "." or x == "__pycache__" for x in name.parts)
    }


def walker_engine(walker: Walker) -> Engine:
    """Return a walker as an engine."""
    name = walker.path.name
    return Engine(
        name=name,
        title=f"simulator of {name}",
        walk=partial(_walk, walker),
        bits=_bits,
        modules=("sim.walker",),
        content=walker.content,
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


# Starts a program and ends it with all that it started, in other sessions too: at its end, after a
# time limit, and when whoever holds the other end of its standard input ends or lets go of it. A
# time that is over is told by SIGALRM, since a program may end with any code.
_SUPERVISOR = """
import ctypes, os, select, signal, subprocess, sys, time
limit, cores, *words = sys.argv[1:]
signal.pthread_sigmask(signal.SIG_SETMASK, [])
if cores:
    os.sched_setaffinity(0, map(int, cores.split()))
if sys.platform == "linux":
    ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER: orphans become its children
try:
    program = subprocess.Popen(words, stdin=subprocess.DEVNULL, start_new_session=True)
except OSError as error:
    sys.exit(f"cannot be started: {error.strerror}")
end, left = time.monotonic() + float(limit), False
while (code := program.poll()) is None and not left and time.monotonic() < end:
    left = bool(select.select([0], [], [], 0.01)[0])
def kill(number, how=os.kill):
    try:
        how(number, signal.SIGKILL)
    except OSError:
        pass
kill(program.pid, os.killpg)
children, patience = f"/proc/self/task/{os.getpid()}/children", time.monotonic() + 5
while time.monotonic() < patience:  # some may be unkillable
    try:
        if sys.platform == "linux":
            [kill(int(child)) for child in open(children).read().split()]
        if os.waitpid(-1, os.WNOHANG)[0] == 0:
            time.sleep(0.001)
    except ChildProcessError:
        break
if code is None:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGALRM)
sys.exit(code if code >= 0 else 128 - code)
"""


def _call(walker: Walker, request: Path, log: Path) -> None:
    """Run the program, and end it with all that it started when its time is over."""
    path, start = walker.path, started_with()
    words = [str(path), str(request), str(log.resolve())]
    if path.suffix == ".py" and not (os.access(path, os.X_OK) and path.read_bytes()[:2] == b"#!"):
        words.insert(0, sys.executable)
    cores = " ".join(map(str, start.cores))
    inputs = [sys.executable, "-I", "-S", "-c", _SUPERVISOR, str(walker.limit), cores]
    streams: dict[str, Any] = {"stdin": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with TemporaryFile() as output:  # no pipe, which a process that is left could hold open
        options = {"env": start.environment, "start_new_session": True}
        with subprocess.Popen([*inputs, *words], stdout=output, **streams, **options) as supervisor:
            code = supervisor.wait()  # on an error `with` closes its input and waits
        output.seek(max(output.tell() - 10_000, 0))
        lines = [x for x in output.read().decode(errors="replace").split("\n") if x.strip()]
    if code == -signal.SIGALRM:
        raise InputError(f"{path}: took longer than {walker.limit:g} s; killed")
    if code:
        last = one_line(lines[-1]) if lines else "no output"
        raise InputError(f"{path}: ended with code {code}: {last}")
