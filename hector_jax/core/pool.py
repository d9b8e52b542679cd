"""Worker processes on this machine, and the workers of a cluster in their place."""

import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import active_children
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.runtime import Surroundings, start_worker, started_with


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
