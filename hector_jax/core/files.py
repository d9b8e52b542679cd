"""Atomic file writes, folder locks and JSON.

A file is written under another name and renamed, so readers see the old or the new one in full.
"""

import fcntl
import json
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from hector_jax.core.console import Broken, say
from hector_jax.core.inputs import InputError

_PART = ".hector_jax-part"  # suffix of a file that is being written, and of no other


class WriteError(Broken):
    """A file cannot be written, for example on a full disk; the message names it."""


def cannot_write(path: Path, error: OSError) -> WriteError:
    """Return the error for a file that cannot be written."""
    # files are complete, and a run continues from them
    return WriteError(f"cannot write {path}: {error.strerror}; what was written before it is kept")


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically; missing folders are created.

    Args:
        path: the file, replaced if it exists; it keeps its mode, and a link to it stays. A device
            or a pipe is written to.
        data: its whole content.

    Raises:
        WriteError: one line with the path, if the folder or the disk cannot be written.
    """
    target = Path(os.path.realpath(path))
    part = target.with_name(f".{target.name}.{secrets.token_hex(4)}{_PART}")
    try:
        mode = os.stat(path).st_mode if os.path.exists(path) else None
        if mode is not None and not stat.S_ISREG(mode):
            Path(path).write_bytes(data)
            return
        target.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            with suppress(OSError):  # a disk without locks
                fcntl.flock(file, fcntl.LOCK_EX)  # tells `locked` that its writer lives
            file.write(data)
            if mode is not None:
                os.chmod(part, stat.S_IMODE(mode))
            file.flush()
            os.fsync(file.fileno())
            os.replace(part, target)
        folder = os.open(target.parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # make the rename durable as well
        finally:
            os.close(folder)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with suppress(OSError):
            part.unlink()  # still there after an error


def make_folder(folder: Path) -> None:
    """Create a folder and check that it is writable, before anything is computed for it.

    Raises:
        InputError: one line with the folder that cannot be created or written.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Create `folder` and lock it against other writers for the duration of the block.

    The block may lock it again. Waits, with a line on stderr, for another process that holds the
    lock. A killed process releases it; files that its `write_file` left incomplete are removed.
    The file `.lock` stays: another process may wait for it.

    Raises:
        InputError: one line with the folder that cannot be created or written.
    """
    make_folder(folder)
    lock = _lock(Path(folder))
    try:
        for part in Path(folder).glob(f".*{_PART}"):
            with suppress(OSError), part.open("r+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # fails while its writer lives
                part.unlink()
        yield
    finally:
        lock.release()


def _lock(folder: Path) -> BaseFileLock:
    """Lock a folder: by the system, or by a file that exists on a disk that has no locks."""
    reason = None
    for kind, name in ((FileLock, ".lock"), (SoftFileLock, ".lock-file")):
        lock = kind(folder.resolve() / name, is_singleton=True)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            say(f"{folder}: another process is writing there; waiting for it to end")
            lock.acquire()
        except OSError as error:
            reason = error.strerror
            continue
        return lock
    raise InputError(f"cannot lock {folder}: {reason}; name a folder on another disk")


def as_json(value: Any, indent: int | None = None) -> str:
    """Return nested values as JSON; non-finite numbers, which JSON lacks, become null.

    >>> as_json({"L": [1.0, float("nan")]})
    '{"L": [1.0, null]}'
    """
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def write_json(path: Path, value: Any) -> None:
    """Write nested values as indented JSON, see `as_json`.

    Raises:
        WriteError: if the file cannot be written.
    """
    write_file(path, (as_json(value, indent=2) + "\n").encode())


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
