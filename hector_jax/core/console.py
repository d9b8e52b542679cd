"""Messages and progress on stderr, and the exit code of a program; stdout carries results only."""

import errno
import io
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
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from hector_jax.core.inputs import InputError, check_utf8, outside_packages, printable

console = Console(stderr=True, highlight=False)

ReportProgress = Callable[[int, int, str], None]  # (done, total, remark)

_QUIET = 15.0  # [s] between progress lines without a terminal


def say(text: str) -> None:
    """Print one line for the user on stderr."""
    console.print(printable(text), markup=False, soft_wrap=True)


@contextmanager
def say_if_slow(text: str) -> Iterator[None]:
    """Print the text if the block takes longer than a second."""
    timer = threading.Timer(1.0, say, [text])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def bar(title: str) -> Iterator[ReportProgress]:
    """Show a progress bar for work longer than two seconds; plain lines without a terminal.

    Yields:
        Function of the number done, the total and a short remark.
    """
    if console.is_terminal:
        head, end = "{task.description}", "{task.fields[remark]}"
        done, past, eta = MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
        with Progress(head, BarColumn(), done, past, "left", eta, end, console=console) as progress:
            task = progress.add_task(title, total=None, remark="")
            yield lambda done, total, remark="": progress.update(
                task, completed=done, total=total, remark=remark
            )
            # work that converged early counts as done
            total = progress.tasks[0].total or 1
            progress.update(task, completed=total, total=total)
        return
    start = last = time.monotonic()
    first: tuple[int, float] | None = None  # (done, time) of the first report after compiling
    say(f"{title} ...")

    def report_progress(done: int, total: int, remark: str = "") -> None:
        nonlocal first, last
        now = time.monotonic()
        if remark == "compiling":
            say("  compiling")
        elif first is None:
            first = done, now
        if now - last >= _QUIET and remark != "compiling":
            text, last = f"  {done}/{total} after {now - start:.0f} s", now
            if first and first[0] < done < total:
                left = (now - first[1]) / (done - first[0]) * (total - done)
                text += f", about {left:.0f} s left"
            say(f"{text}  {remark}".rstrip())

    yield report_progress
    say(f"{title}: done in {time.monotonic() - start:.0f} s")


class Broken(RuntimeError):  # noqa: N818, not an error of the program
    """The program works but its result is a failure, such as a machine that fails `doctor`."""


_SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_PATIENCE = 5.0  # [s] for compiled code to return; Python handles no signal meanwhile
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSALS = (
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE, errno.ENOLCK),
    *(errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN, errno.ENOSYS, errno.ENOTSUP),
)  # of the machine, whatever the program does


class Stopped(KeyboardInterrupt):
    """The first signal of `_SIGNALS` has arrived; the argument is its number."""


@contextmanager
def _stoppable(name: str) -> Iterator[None]:
    """Raise `Stopped` at the first signal; end the process immediately at the second.

    The process also ends immediately if the first signal is not handled within `_PATIENCE`. No data
    is lost: files are written atomically, and workers end with their parent.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may have handlers
        return
    handled = threading.Event()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def stop(number: int, frame: Any) -> None:
        if not handled.is_set():
            handled.set()
            raise Stopped(number)

    def next_signal() -> bytes:
        """Wait for a signal of `_SIGNALS`, even if the main thread is busy; b"" at the end."""
        while (number := os.read(reading, 1)) and number[0] not in _SIGNALS:
            pass  # another one, of a handler of the user
        return number

    def watch() -> None:
        number = next_signal()
        if number and not select.select([reading], [], [], _PATIENCE)[0] and handled.is_set():
            number = next_signal()
        if number:
            if console.is_terminal:
                os.write(2, b"\x1b[?25h")  # show the cursor, which a progress bar hides
            os.write(2, f"{name}: {_SIGNALS[signal.Signals(number[0])]}, at once\n".encode())
            os._exit(128 + number[0])
        os.close(reading)

    handlers = {number: signal.signal(number, stop) for number in _SIGNALS}
    wakeup = signal.set_wakeup_fd(writing)
    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        if not handled.is_set():  # else a second signal may arrive while the program ends
            signal.set_wakeup_fd(wakeup)
            os.close(writing)
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _open_streams() -> None:
    """Open /dev/null for closed standard streams; else the next file would take their number.

    What the encoding of the output lacks, such as a byte of a folder's name, is escaped.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _drop(stream: TextIO) -> None:
    """Discard unwritten output of a stream; Python would try to write it again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Run a program and return its exit code, with one line on stderr if that is not 0.

    Args:
        name: of the program, printed before the line.
        work: the program. `InputError` gives code 2; `Broken`, a full disk and a killed worker
            process give 1, SIGINT 130 and SIGTERM 143, each with its own line; a second signal ends
            the process immediately. A closed standard output gives 141 without a line. Any other
            exception is a bug: it propagates with its traceback, so a script exits with code 1.
    """
    _open_streams()
    try:
        for word in sys.argv[1:]:
            check_utf8("names", word)  # they go into messages, tables and files
        with _stoppable(name), outside_packages():
            try:
                work()
            except SystemExit:  # from a parser that has printed its help
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
        if error.errno not in (*_FULL, *_REFUSALS):
            raise
        if error.filename is None:
            _drop(sys.stdout)
        what = "cannot write" if error.errno in _FULL else "this machine refuses"
        code, text = 1, f"{what} {error.filename or 'the output'}: {error.strerror}"
    except BrokenExecutor as error:
        if error.__cause__ is not None:  # not a killed process: its exception cannot be unpickled
            raise
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
