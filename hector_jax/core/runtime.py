"""Set-up of a process: JAX's options, the persistent compilation cache, its core.

The library itself leaves `jax.config` alone; programs (cli, experiments, benchmarks, tests, worker
processes) call `setup_jax` once, before the first array.
"""

import errno
import gc
import os
import socket
import tempfile
import threading
import warnings
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from itertools import product
from multiprocessing import parent_process
from pathlib import Path
from typing import NamedTuple

from hector_jax.core.inputs import InputError, check_utf8, one_line, outside_packages
from hector_jax.core.numerics import pin_options


def cache_folder() -> Path:
    """Return the folder of the compilation cache, which is made.

    Raises:
        InputError: it cannot be written, or its name is not UTF-8.
    """
    base = os.path.expanduser(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    folder = Path(base) / "hector_jax" / "jax"
    check_utf8("XDG_CACHE_HOME or the folder of the cache", str(folder))  # JAX takes no other name
    try:
        if base[0] == "~":
            raise FileNotFoundError(errno.ENOENT, "this user has no home")
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(
            f"no folder for compiled programs: {folder}: {error.strerror}; "
            "set XDG_CACHE_HOME to a folder that can be written"
        ) from None
    return folder


def start_jax(on_cpu: bool = False) -> None:
    """Start JAX with the options of `setup_jax` and the variables of the environment.

    Args:
        on_cpu: compute on the CPU even if there are accelerators.

    Raises:
        InputError: one line with the variables that prevent it.
    """
    variables = [f"{name}={os.environ[name]}" for name in sorted(os.environ) if name[:4] == "JAX_"]
    try:
        with outside_packages():
            import_module("numpy.linalg")  # first: where it is broken, jaxlib prints a traceback
            import jax

            if on_cpu:
                jax.config.update("jax_platforms", "cpu")
            setup_jax()  # before the devices start, which read some options once
            jax.devices()
    except InputError:
        raise
    except Exception as error:  # of several types, some without a message
        what = f"JAX does not start{' with ' if variables else ''}{', '.join(variables)}"
        raise InputError(f"{what}: {one_line(error) or 'no such device here'}") from None


class Surroundings(NamedTuple):
    """What a program was started with, before `setup_jax` and `start_worker` change it."""

    environment: dict[str, str]
    cores: frozenset[int]  # empty where processes have none of their own


_start: Surroundings | None = None


def started_with(parent: Surroundings | None = None) -> Surroundings:
    """Return what this program, or the parent of this worker, was started with."""
    global _start  # noqa: PLW0603
    if _start is None:
        cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else ()
        _start = parent or Surroundings(dict(os.environ), frozenset(cores))
    return _start


def setup_jax() -> None:
    """Turn on 64 bits and the compilation cache; call before the first array.

    All options that could change numbers are pinned (`core.numerics`). CPU programs are dispatched
    synchronously, and Python's garbage collector runs less often.
    """
    import jax

    started_with()
    pin_options()
    # Run a CPU program in the calling thread: waking another thread takes as long as the small
    # programs of a walk.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # Tracing creates millions of long-lived objects: collecting garbage takes a fifth of its time.
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)


def _leave_with_parent() -> None:
    """End this process when the one that started it ends for any reason.

    Without this, workers outlive a killed parent: each keeps the queue open on which it waits.
    """
    if (parent := parent_process()) is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _claim_core(cores: Sequence[int]) -> int | None:
    """Return the core that the fewest worker processes of this machine have; now this one has it.

    A claim is a name of a socket. It is no file: the name is free when the process ends. Where no
    name can be claimed the answer is None.
    """
    for turn, core in product(range(64), cores):
        with socket.socket(socket.AF_UNIX) as claim, suppress(OSError):
            claim.bind(f"\0hector_jax core {core}, {turn}")
            claim.detach()
            return core
    return None


def start_worker(parent: Surroundings | None = None) -> None:
    """Set up a worker process like its parent, which alone handles interrupts and accelerators.

    It is bound to a core: the XLA threads of several workers would wait for each other, which takes
    several times as long, and their number would change the rounding of results.

    Args:
        parent: what it was started with; by default what this process was started with.
    """
    _leave_with_parent()
    cores = started_with(parent).cores
    if cores and (core := _claim_core(sorted(cores))) is not None:
        os.sched_setaffinity(0, {core})
    # MuJoCo's about a robot's file, which the parent has read too
    warnings.filterwarnings("ignore", category=UserWarning, module="hector_jax")
    import jax

    jax.config.update("jax_platforms", "cpu")
    setup_jax()
