"""Journals: JSON lines that are only appended to, so that work that is killed goes on from them.

A journal may begin with the settings of its work; that of work with other settings is refused.
"""

import json
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from hector_jax.core.files import as_json, cannot_write, write_file
from hector_jax.core.inputs import InputError, read_text, short_reprs

_OTHER_ROBOT = "for another robot of this name (`name` in its TOML), or before its files changed"
_OTHER_CODE = "by other code or other versions of jax, jaxlib, mujoco or another package"
_MAX_BYTES = 100_000_000

Row = TypeVar("Row")


def check_settings(
    path: Path,
    made: Mapping[str, Any],
    expected: Mapping[str, Any],
    remedy: str = "remove it, or name another folder",
) -> None:
    """Check that the settings recorded in a file or folder equal those of the current command.

    Raises:
        InputError: one line naming the file, the first setting that differs, and the remedy.
    """
    for name in {**expected, **made}:
        before, now = made.get(name), expected.get(name)
        if before == now:
            continue
        was, asked = short_reprs(before, now)
        what = f"with {name} {was}, this command expects {asked}"
        what = {"robot": _OTHER_ROBOT, "code": _OTHER_CODE}.get(name, what)
        raise InputError(f"{path}: made {what}; {remedy}")


def read_rows(
    path: Path, what: str, parse: Callable[[Any], Row], lines: slice = slice(0, None)
) -> list[Row]:
    """Read the rows of a journal; an incomplete last line is skipped.

    Args:
        path: of the journal.
        what: kind of the rows, for error messages.
        parse: converts a line's value to a row.
        lines: those that are read.

    Raises:
        InputError: one line naming the file and the line that is damaged.
    """
    rows, text = [], read_text(path, f"the journal of {what}", _MAX_BYTES).rpartition("\n")[0]
    for number, line in enumerate(text.splitlines()[lines], lines.start + 1):
        try:
            rows.append(parse(json.loads(line)))
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(
                f"{path}, line {number}: a row of {what} was expected ({error!r})"
            ) from None
    return rows


def continue_journal(
    path: Path,
    settings: Mapping[str, Any] | None,
    what: str,
    parse: Callable[[Any], Row],
    remedy: str = "choose another folder",
) -> list[Row]:
    """Read the rows of a journal with these settings, to append to it; begin it if it is missing.

    Args:
        path: of the journal.
        settings: JSON values that its first line must have; None: it has rows of any work.
        what, parse: see `read_rows`.
        remedy: what to do if the settings are others.

    Raises:
        InputError: the file is no journal, has other settings, or is damaged.
        WriteError: the file cannot be written.
    """
    head = [] if settings is None else [settings]
    if not path.exists():
        write_rows(path, head)
        return []
    if settings is not None:
        recorded = read_rows(path, what, dict, slice(0, 1)) or [{}]
        check_settings(path, recorded[0], settings, remedy)
    rows = read_rows(path, what, parse, slice(len(head), None))
    os.truncate(path, path.read_bytes().rfind(b"\n") + 1)  # after an interruption
    return rows


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a journal anew; numbers that are not finite become null.

    Raises:
        WriteError: the file cannot be written; the old file stays.
    """
    write_file(path, "".join(as_json(row) + "\n" for row in rows).encode())


def add_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row to a journal; an interruption may leave part of it.

    Raises:
        WriteError: the file cannot be written.
    """
    try:
        with path.open("ab") as file:
            file.write((as_json(row) + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(path, error) from error
