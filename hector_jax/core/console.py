"""Messages and progress on stderr, and the exit code of a program; stdout carries results only."""

import errno
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from typing import Any, TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from hector_jax.core.inputs import InputError, printable

console = Console(stderr=True, highlight=False)

Tell = Callable[[int, int, str], None]  # (done, all, remark)

_QUIET = 15.0  # [s] between lines where there is no terminal to draw a bar on


def say(text: str) -> None:
    """One line to the person who waits."""
    console.print(printable(text), markup=False, soft_wrap=True)


@contextmanager
def say_if_slow(text: str) -> Iterator[None]:
    """Say what goes on within if it takes longer than a second."""
    timer = threading.Timer(1.0, say, [text])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def bar(title: str) -> Iterator[Tell]:
    """A progress bar for anything longer than two seconds; plain lines where there is no terminal.

    Yields:
        Function of how many are done, of how many, and a short remark.
    """
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[remark]}"),
        )
        with Progress(*columns, console=console) as progress:
            task = progress.add_task(title, total=None, remark="")
            yield lambda done, of, remark="": progress.update(
                task, completed=done, total=of, remark=remark
            )
            # what converged early is done, too
            total = progress.tasks[0].total or 1
            progress.update(task, completed=total, total=total)
        return
    start = last = time.monotonic()
    first: tuple[int, float] | None = None  # done, and when; what was before it is compiling
    say(f"{title} ...")

    def tell(done: int, of: int, remark: str = "") -> None:
        nonlocal first, last
        now = time.monotonic()
        if remark == "compiling":
            say("  compiling")
        elif first is None:
            first = done, now
        if now - last >= _QUIET and remark != "compiling":
            text, last = f"  {done}/{of} after {now - start:.0f} s", now
            if first and done > first[0]:
                left = (now - first[1]) / (done - first[0]) * (of - done)
                text += f", about {left:.0f} s left"
            say(f"{text}  {remark}".rstrip())

    yield tell
    say(f"{title}: done in {time.monotonic() - start:.0f} s")


class Broken(RuntimeError):  # noqa: N818, it is no fault of the program
    """The result is bad news, such as a machine that fails the doctor's tests."""


_SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_PATIENCE = 5.0  # [s] for compiled code, in which Python hears no signal, to come to an end
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Stopped(KeyboardInterrupt):
    """The first of `_SIGNALS`; its argument is the number."""


@contextmanager
def _stoppable(name: str) -> Iterator[None]:
    """Raise `Stopped` at the first signal; end the process on the spot at the second.

    On the spot, too, if the first is not heard within `_PATIENCE`. Nothing is lost by that: files
    appear whole, and workers leave with their parent.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may have handlers
        return
    heard = threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def stop(number: int, frame: Any) -> None:
        if not heard.is_set():
            heard.set()
            raise Stopped(number)

    def watch() -> None:
        number = os.read(reading, 1)  # comes at once, whatever the main thread does
        if number and not select.select([reading], [], [], _PATIENCE)[0] and heard.is_set():
            number = os.read(reading, 1)
        if number:
            if console.is_terminal:
                os.write(2, b"\x1b[?25h")  # the cursor, which a bar hides
            os.write(2, f"{name}: {_SIGNALS[signal.Signals(number[0])]}, at once\n".encode())
            os._exit(128 + number[0])
        os.close(reading)

    handlers = {number: signal.signal(number, stop) for number in _SIGNALS}
    wakeup = signal.set_wakeup_fd(writing)
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        if not heard.is_set():  # else a second one may come while the program ends
            signal.set_wakeup_fd(wakeup)
            os.close(writing)
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _open_streams() -> None:
    """Give closed standard streams /dev/null; else the next file would take their number."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115


def _drop(stream: TextIO) -> None:
    """Let what a stream could not write go, or Python would try again as it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Do the work of a program; its exit code, with one line on stderr where that is not 0.

    Args:
        name: of the program, before the line.
        work: `InputError` is bad input (2); `Broken`, a full disk and a killed worker process end
            in a line of their own (1), SIGINT (130) and SIGTERM (143) too; a second signal does not
            wait. Where nobody reads standard output any more, it ends without a word (141). Any
            other exception is a fault of the program: it goes on to the caller with its traceback,
            which for a script means exit code 1.
    """
    _open_streams()
    try:
        with _stoppable(name):
            try:
                work()
            except SystemExit:  # of a parser that has printed its help
                sys.stdout.flush()
                raise
            sys.stdout.flush()
    except BrokenPipeError:
        _drop(sys.stdout)
        return 141
    except InputError as error:
        code, text = 2, str(error)
    except Broken as error:
        code, text = 1, str(error)
    except OSError as error:
        if error.errno not in _FULL:
            raise
        _drop(sys.stdout)
        code, text = 1, f"cannot write {error.filename or 'the output'}: {error.strerror}"
    except BrokenExecutor:
        code, text = 1, "a worker process was killed, perhaps for want of memory"
    except Stopped as stopped:
        number = signal.Signals(stopped.args[0])
        code, text = 128 + number, _SIGNALS[number]
    except KeyboardInterrupt:
        code, text = 130, _SIGNALS[signal.SIGINT]
    else:
        return 0
    try:
        print(f"{name}: {printable(' '.join(text.split()))}", file=sys.stderr, flush=True)
    except OSError:
        _drop(sys.stderr)
    return code
