"""What a person sees while waiting: one line or one bar on stderr; stdout carries results only."""

import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from hector_jax.inputs import InputError

console = Console(stderr=True, highlight=False)

Tell = Callable[[int, int, str], None]  # (done, all, remark)

_QUIET = 15.0  # [s] between lines where there is no terminal to draw a bar on


def say(text: str) -> None:
    """One line to the person who waits."""
    console.print(text, markup=False, soft_wrap=True)


@contextmanager
def bar(title: str) -> Iterator[Tell]:
    """A progress bar for anything longer than two seconds; plain lines where there is no terminal.

    Yields:
        Function to be told how many are done of how many, with a short remark.
    """
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[remark]}"),
        )
        with Progress(*columns, console=console) as progress:
            task = progress.add_task(title, total=None, remark="")
            yield lambda done, of, remark="": progress.update(
                task, completed=done, total=of, remark=remark
            )
        return
    start = last = time.monotonic()
    say(f"{title} ...")

    def tell(done: int, of: int, remark: str = "") -> None:
        nonlocal last
        now = time.monotonic()
        if remark == "compiling":
            say("  compiling")
        elif now - last >= _QUIET:
            say(f"  {done}/{of} after {now - start:.0f} s  {remark}".rstrip())
            last = now

    yield tell
    say(f"{title}: done in {time.monotonic() - start:.0f} s")


class Broken(RuntimeError):  # noqa: N818, it is no fault of the program
    """What was to be found out is bad news, such as a machine that fails the doctor's tests."""


_SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Stopped(KeyboardInterrupt):
    """The first of `_SIGNALS`; its argument is the number."""


@contextmanager
def _stoppable(name: str) -> Iterator[None]:
    """Raise `Stopped` at the first signal, end the process on the spot at the second.

    Nothing is lost by the second: files appear whole, and workers leave with their parent.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may have handlers
        return
    came: list[int] = []

    def stop(number: int, frame: Any) -> None:
        came.append(number)
        if len(came) == 1:
            raise Stopped(number)
        if console.is_terminal:
            os.write(2, b"\x1b[?25h")  # the cursor, which a bar hides
        os.write(2, f"{name}: {_SIGNALS[signal.Signals(number)]}, at once\n".encode())
        os._exit(128 + number)

    handlers = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        yield
    finally:
        if not came:  # else a second one may come while the program ends
            for number, handler in handlers.items():
                signal.signal(number, handler)


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Do the work of a program; its exit code, with one line on stderr where that is not 0.

    Args:
        name: of the program, before the line.
        work: `InputError` is bad input (2); `Broken` and a worker process that was killed are told
            as such (1), SIGINT (130) and SIGTERM (143) too; a second signal does not wait. Where
            nobody reads standard output any more, it ends without a word (141). Any other exception
            is a fault of the program: it goes on to the caller with its traceback, which for a
            script means exit code 1.
    """
    try:
        with _stoppable(name):
            work()
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing is left to flush
        return 141
    except InputError as error:
        code, text = 2, " ".join(str(error).split())
    except Broken as error:
        code, text = 1, str(error)
    except BrokenExecutor:
        code, text = 1, "a worker process was killed, perhaps for want of memory"
    except Stopped as stopped:
        number = signal.Signals(stopped.args[0])
        code, text = 128 + number, _SIGNALS[number]
    except KeyboardInterrupt:
        code, text = 130, _SIGNALS[signal.SIGINT]
    else:
        return 0
    print(f"{name}: {text}", file=sys.stderr)
    return code


def made_at(environment: Mapping[str, str]) -> str:
    """Line of a report that tells where it comes from: the commit, and the script with its flags.

    Args:
        environment: `evaluation.report.environment`; without a commit outside of a checkout.
    """
    script = "/".join(Path(sys.argv[0]).resolve().parts[-2:])
    command = shlex.join(["python", script, *sys.argv[1:]])
    return f"Made at {environment.get('commit', 'an unknown commit')} by `{command}`."
