"""A program of the user, which is asked by a file and answers by a file.

It is called, several times at once, with the environment, the cores and the folder that this
program was started with, as `FILE asked answer`, and ends with code 0.
"""

import ast
import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

from hector_jax.core.environment import imported_names
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.runtime import started_with


class Program(NamedTuple):
    """A program of the user."""

    path: Path
    limit: float  # [s] of a call
    content: str  # hash of the files that it declares: tells its answers from those of others


def program_of(path: Path, limit: float, uses: Sequence[Path] = ()) -> Program:
    """Return the program of a file.

    Args:
        path: an executable file, or a Python file, which this interpreter runs.
        limit: longest time that it may take for an answer [s].
        uses: other files and folders that decide its answers. Its own file does, and what that
            imports of the Python files and packages beside it.

    Raises:
        InputError: there is no such file or folder, or the program cannot be executed.
    """
    path = Path(path).resolve()
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix != ".py" and not os.access(path, os.X_OK):
        raise InputError(f"{path}: expected a Python file or an executable one (chmod +x)")
    files = {file: file.relative_to(path.parent) for file in _imports(path)}
    for place in uses:
        if not place.exists():
            raise InputError(f"--walker-uses {place}: no such file or folder")
        files |= _files(place.resolve())
    named = sorted((name.parts, file.read_bytes()) for file, name in files.items())
    return Program(path, limit, hashlib.sha256(repr(named).encode()).hexdigest()[:16])


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


def call_program(program: Program, asked: Path, answer: Path) -> None:
    """Run a program, and end it with all that it started when its time is over.

    Raises:
        InputError: one line: it ended with another code than 0, took too long, or wrote no answer.
    """
    path, start = program.path, started_with()
    words = [str(path), str(asked), str(answer.resolve())]
    if path.suffix == ".py" and not (os.access(path, os.X_OK) and path.read_bytes()[:2] == b"#!"):
        words.insert(0, sys.executable)
    cores = " ".join(map(str, start.cores))
    inputs = [sys.executable, "-I", "-S", "-c", _SUPERVISOR, str(program.limit), cores]
    streams: dict[str, Any] = {"stdin": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with TemporaryFile() as output:  # no pipe, which a process that is left could hold open
        options = {"env": start.environment, "start_new_session": True}
        with subprocess.Popen([*inputs, *words], stdout=output, **streams, **options) as supervisor:
            code = supervisor.wait()  # on an error `with` closes its input and waits
        output.seek(max(output.tell() - 10_000, 0))
        lines = [x for x in output.read().decode(errors="replace").split("\n") if x.strip()]
    if code == -signal.SIGALRM:
        raise InputError(f"{path}: took longer than {program.limit:g} s; killed")
    if code:
        last = one_line(lines[-1]) if lines else "no output"
        raise InputError(f"{path}: ended with code {code}: {last}")
    if not answer.exists():
        raise InputError(f"{path}: ended with code 0, but wrote no {answer.name}")
