"""Files that appear whole, folders with one writer, and JSON.

A file appears by rename, so that a reader finds the old one or the new one and never a part.
"""

import json
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from hector_jax.core.console import Broken, say
from hector_jax.core.inputs import InputError

_PART = ".hector_jax-part"  # ends the name of a file that is being written, and of no other


class WriteError(Broken):
    """A file cannot be written, such as on a full disk; the one line names it."""


def _cannot_write(path: Path, error: OSError) -> WriteError:
    # files appear whole, and a run goes on from them
    return WriteError(f"cannot write {path}: {error.strerror}; what was written before it is kept")


def write_file(path: Path, data: bytes) -> None:
    """Put `data` under `path`, whole or not at all; missing folders are made.

    Args:
        path: the file, replaced if it is there.
        data: all of it.

    Raises:
        WriteError: one line with the path, where the folder or the disk refuses.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{_PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # of the name too; without it a rename may outlive its data
        finally:
            os.close(folder)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise


def append_file(path: Path, data: bytes) -> None:
    """Add `data` to a file; a stop in the midst may leave part of it.

    Raises:
        WriteError: one line with the path, where the folder or the disk refuses.
    """
    try:
        with Path(path).open("ab") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise _cannot_write(path, error) from error


def make_folder(folder: Path) -> None:
    """Make a folder, and find out that it can be written before anything is computed for it.

    Raises:
        InputError: one line with the folder, where it cannot be made or written.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Be the only process that writes to `folder`, which is made, as long as the block lasts.

    Waits, with a line on stderr, for another process that has the lock. A process that is killed
    lets go of it; what `write_file` left half-written there is removed here.

    Raises:
        InputError: one line with the folder, where it cannot be made or written.
    """
    make_folder(folder)
    lock = FileLock(Path(folder) / ".lock")
    try:
        lock.acquire(blocking=False)
    except Timeout:
        say(f"{folder}: another process is writing there; waiting for it to end")
        lock.acquire()
    try:
        for part in Path(folder).glob(f".*{_PART}"):
            part.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def as_json(value: Any, indent: int | None = None) -> str:
    """JSON of nested values; numbers that are not finite, which JSON does not have, are null.

    >>> as_json({"L": [1.0, float("nan")]})
    '{"L": [1.0, null]}'
    """
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def write_json(path: Path, value: Any) -> None:
    """Write nested values as JSON, `as_json` with line breaks.

    Raises:
        WriteError: where the file cannot be written.
    """
    write_file(path, (as_json(value, indent=2) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
