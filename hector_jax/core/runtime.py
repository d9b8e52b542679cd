"""How a process of this project is set up: 64 bits and the persistent compilation cache.

The library itself leaves `jax.config` alone; programs (cli, experiments, benchmarks, tests, worker
processes) call `setup_jax` once, before the first array.
"""

import gc
import os
import pickle
import resource
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.managers import SyncManager
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple, cast

from hector_jax.core.inputs import InputError, one_line

_LEAST_MEMORY = 3e9  # [B] of addresses: JAX alone takes 1.3 GB, compiling a walk 2.3 GB


def home_cache() -> Path:
    """Folder of the compilation cache in the user's home."""
    base = os.environ.get("XDG_CACHE_HOME")
    folder = Path(base) if base else Path(os.path.expanduser("~")) / ".cache"
    return folder / "hector_jax" / "jax"


def cache_folder() -> Path:
    """Folder of the user's compilation cache; a temporary one where the home cannot be written.

    Raises:
        InputError: there is none that this user alone can write.
    """
    folder = home_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = tempfile.TemporaryFile(dir=folder)
        probe.close()
    except OSError as refused:
        own = Path(tempfile.gettempdir()) / f"hector_jax-{os.getuid()}"
        try:
            own.mkdir(mode=0o700, exist_ok=True)
        except OSError:
            raise InputError(
                f"no folder for compiled programs: {folder}: {refused.strerror}, and {own} cannot "
                "be made; set XDG_CACHE_HOME to a folder that can be written"
            ) from None
        # compiled programs are run: nobody else may have put them there
        if own.is_symlink() or own.stat().st_uid != os.getuid() or own.stat().st_mode & 0o077:
            raise InputError(
                f"{own} is open to others or of another user, so no programs are loaded from it; "
                "remove it, or set XDG_CACHE_HOME to a folder that can be written"
            ) from None
        folder = own / "jax"
        folder.mkdir(exist_ok=True)
    return folder


def check_jax(on_cpu: bool = False) -> None:
    """Find out whether JAX can compute with what the environment asks of it.

    Args:
        on_cpu: compute on the CPU, whatever accelerators there are.

    Raises:
        InputError: one line with the limit or variable that it cannot work with.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < _LEAST_MEMORY:  # it would hang or abort
        raise InputError(
            f"the limit on virtual memory (ulimit -v) is {limit / 1e9:.1f} GB, expected at least "
            f"{_LEAST_MEMORY / 1e9:g} GB"
        )
    if "XLA_FLAGS" in os.environ:  # one that XLA does not know ends the process
        done = subprocess.run(
            [sys.executable, "-c", "from jaxlib.xla_client import make_cpu_client as c; c()"],
            capture_output=True,
            text=True,
            errors="replace",
        )
        if done.returncode:
            reason = done.stderr.strip().rpartition("\n")[2].rpartition("] ")[2]
            raise InputError(f"XLA_FLAGS={os.environ['XLA_FLAGS']}: {one_line(reason)}")
    variables = [f"{name}={os.environ[name]}" for name in sorted(os.environ) if name[:4] == "JAX_"]
    try:
        import jax

        if on_cpu:
            jax.config.update("jax_platforms", "cpu")
        jax.devices()
    except Exception as error:  # of several kinds, some without a word
        what = f"JAX does not start{' with ' if variables else ''}{', '.join(variables)}"
        raise InputError(f"{what}: {one_line(error) or 'no such device here'}") from None


def setup_jax() -> None:
    """Turn on 64 bits, full precision and the compilation cache; call before the first array.

    Programs on the CPU run at once, and Python's garbage collector runs less often.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_default_matmul_precision", "highest")
    # A program on the CPU runs in the thread that calls it: to wake another one takes as long as
    # the small programs of a walk.
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # Tracing makes millions of small objects that live on: looking them over takes a fifth of it.
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)


def all_devices() -> None:
    """Make every CPU core a device of its own, and join the hosts of a cluster.

    Call after `setup_jax` and before the first array. Hosts are joined where the environment names
    a coordinator (`JAX_COORDINATOR_ADDRESS`, with `JAX_NUM_PROCESSES` and `JAX_PROCESS_ID` where no
    cluster that JAX knows tells them) or a step of Slurm or Open MPI runs.
    """
    import jax

    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
        jax.config.update("jax_num_cpu_devices", len(cores))
    clusters = ("JAX_COORDINATOR_ADDRESS", "SLURM_STEP_NODELIST", "OMPI_MCA_orte_hnp_uri")
    if any(name in os.environ for name in clusters):
        count, own = (os.environ.get(f"JAX_{name}") for name in ("NUM_PROCESSES", "PROCESS_ID"))
        jax.distributed.initialize(
            num_processes=None if count is None else int(count),
            process_id=None if own is None else int(own),
        )


class _Process(SpawnProcess):
    """A process that interrupts of the terminal, which reach all of a program, do not reach."""

    def start(self) -> None:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the child keeps it
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Spawn(SpawnContext):
    Process = _Process


def _leave_with_parent() -> None:
    """End this process when its parent ends, by whatever end.

    Without it workers outlive a parent that was killed: each holds the queue open that it waits on.
    """

    def watch() -> None:
        cast(BaseProcess, parent_process()).join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class _Messages(NamedTuple):
    """A queue whose own process sees bytes only: it would load JAX to know what they are."""

    queue: Any

    def put(self, message: Any) -> None:
        self.queue.put(pickle.dumps(message))

    def get(self) -> Any:
        return pickle.loads(self.queue.get())

    def empty(self) -> bool:
        return self.queue.empty()


@contextmanager
def message_queue() -> Iterator[Any]:
    """A queue that can be an argument of jobs in worker processes."""
    manager = SyncManager(ctx=_Spawn())
    manager.start(_leave_with_parent)
    with manager:
        yield _Messages(manager.Queue())


def start_worker(cores: Any) -> None:
    """Set up a worker process as its parent is, with interrupts and accelerators left to it.

    Several workers stay on a core each, the next of the queue `cores`: XLA's threads of one would
    otherwise wait for those of the others, which costs several times the work.
    """
    _leave_with_parent()
    core = cores.get()
    if core is not None:
        os.sched_setaffinity(0, {core})
    import jax

    jax.config.update("jax_platforms", "cpu")
    setup_jax()


def _cores(processes: int) -> list[int | None]:
    """A core for each of several processes; None where a process is alone or cannot be held."""
    if processes < 2 or not hasattr(os, "sched_getaffinity"):
        return [None] * processes
    mine = sorted(os.sched_getaffinity(0))
    first = os.getpid()  # two programs at once begin at different cores
    return [mine[(first + i) % len(mine)] for i in range(processes)]


@contextmanager
def workers(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Worker processes, each set up by `start_worker`; on an error they end in the midst of a job.

    The caller's own script has to be importable (`if __name__ == "__main__"`), because the
    processes are spawned.

    Raises:
        ValueError: fewer than one.
    """
    if processes < 1:
        raise ValueError(f"the number of processes must be at least 1, got {processes}")
    spawn, others = _Spawn(), active_children()
    cores = spawn.SimpleQueue()
    for core in _cores(processes):
        cores.put(core)
    with ProcessPoolExecutor(processes, spawn, initializer=start_worker, initargs=(cores,)) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(active_children()) - set(others):
                worker.kill()
            raise
