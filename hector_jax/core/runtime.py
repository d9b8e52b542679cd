"""Set-up of a process: JAX's options, the persistent compilation cache and worker processes.

The library itself leaves `jax.config` alone; programs (cli, experiments, benchmarks, tests, worker
processes) call `setup_jax` once, before the first array.
"""

import errno
import gc
import os
import signal
import socket
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from importlib import import_module
from itertools import product
from multiprocessing import active_children, parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import Any, NamedTuple

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


class _Process(SpawnProcess):
    """A process with SIGINT blocked, which a terminal sends to all processes of a program."""

    def start(self) -> None:
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the child inherits it
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


class _Spawn(SpawnContext):
    Process = _Process


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


def _work(parent: Surroundings, work: Callable[..., None], inputs: tuple) -> None:
    start_worker(parent)
    with suppress(EOFError, BrokenPipeError):  # the other end of a pipe is gone
        work(*inputs)


def start_process(work: Callable[..., None], *inputs: Any) -> SpawnProcess:
    """Start a process that does one work, set up by `start_worker`, and ends with this one."""
    process = _Process(target=_work, args=(started_with(), work, inputs), daemon=True)
    process.start()
    return process


class _Here(Executor):
    """Calls in this process."""

    def map(self, fn: Callable[..., Any], *iterables: Iterable[Any], **_: Any) -> Iterator[Any]:
        return map(fn, *iterables)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done = Future()
        try:
            done.set_result(fn(*args, **kwargs))
        except Exception as error:
            done.set_exception(error)
        return done


def _local_pool(processes: int) -> Executor:
    """Return the pool of `workers`; one without a process where a machine allows no pool of one."""
    start = {"initializer": start_worker, "initargs": (started_with(),)}
    try:
        return ProcessPoolExecutor(processes, _Spawn(), **start)
    except (OSError, ImportError, NotImplementedError) as error:  # of its semaphores
        if processes == 1:
            return _Here()
        text = f"no worker processes: {one_line(error)} (is /dev/shm there and writable?)"
        raise InputError(f"{text}; --processes 1 needs none") from None


@contextmanager
def workers(processes: int, cluster: str | None = None) -> Iterator[Executor]:
    """Start worker processes, each set up by `start_worker`; on an error they are killed.

    The caller's script has to be importable (`if __name__ == "__main__"`), because the processes
    are spawned.

    Args:
        processes: their number; where no pool can be made, 1 computes in this process.
        cluster: address of a scheduler, whose workers are used instead (`core.cluster`).

    Raises:
        InputError: this machine allows no pool of several processes.
    """
    if cluster is not None:
        from hector_jax.core.cluster import cluster_workers  # which starts with JAX

        with cluster_workers(cluster) as pool:
            yield pool
        return
    others = active_children()
    with _local_pool(processes) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(active_children()) - set(others):
                worker.kill()
            raise
