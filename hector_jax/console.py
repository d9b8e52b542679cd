"""What a person sees while waiting: one line or one bar on stderr; stdout carries results only."""

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

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


def exit_code(name: str, work: Callable[[], None]) -> int:
    """Do the work of a program; its exit code, with one line on stderr where that is not 0.

    Args:
        name: of the program, before the line.
        work: ValueError and OSError are told as bad input (2), `Broken` (1) and an interrupt (130)
            as such. Where nobody reads standard output any more, it ends without a word (141).
    """
    try:
        work()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing is left to flush
        return 141
    except (ValueError, OSError) as error:
        code, text = 2, " ".join(str(error).split())
    except Broken as error:
        code, text = 1, str(error)
    except KeyboardInterrupt:
        code, text = 130, "interrupted"
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
