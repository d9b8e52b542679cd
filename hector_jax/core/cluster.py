# pyright: reportMissingImports=false
"""Worker processes of other machines: those of a scheduler of dask.distributed (extra `cluster`).

A job is pure, so the scheduler gives that of a worker that ends to another one. Every worker, also
one that joins later, is checked and set up like a local one before its first job.
"""

import logging
import pickle
import platform
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager
from functools import cache
from typing import Any

from hector_jax.core.console import Broken
from hector_jax.core.environment import code_hash, versions
from hector_jax.core.inputs import InputError, one_line, require_package
from hector_jax.core.runtime import start_worker

_PATIENCE = 5.0  # [s] for a scheduler to answer
# modules of the jobs
_CODE = tuple(
    "store.tunings verdict.judging walk_tuning.walks own.walker sim.drake sim.pinocchio".split()
)

_Versions = tuple[tuple[str, str], ...]


@cache
def _versions() -> _Versions:
    """Return what must be the same on all machines, by name."""
    code = {"code of hector_jax (or XLA_FLAGS)": code_hash(_CODE)}
    machine = {"platform": f"{platform.system()} {platform.machine()}"}
    return tuple((versions() | machine | code).items())


def _check_worker(expected: _Versions, dask_worker: Any) -> None:
    """Raise an InputError that says what this worker has of another version."""
    own, worker = dict(_versions()), f"worker {dask_worker.address}"
    for name, version in expected:
        if (other := own.get(name, "none")) != version:
            raise InputError(f"{worker} has {name} {other}, expected {version}")
    if (threads := dask_worker.state.nthreads) != 1:
        raise InputError(f"{worker} has {threads} threads, expected 1 (--nthreads 1)")


@cache  # once in a process
def _start(expected: _Versions) -> None:
    from distributed import get_worker

    _check_worker(expected, get_worker())
    start_worker()


def _run(expected: _Versions, job: bytes) -> Any:
    _start(expected)
    function, args, options = pickle.loads(job)
    return function(*args, **options)


class _Pool(Executor):
    """Jobs of a client; pickled here, since dask would take our trees apart for tasks in them."""

    def __init__(self, client: Any) -> None:
        self._pool = client.get_executor(pure=False)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return self._pool.submit(_run, _versions(), pickle.dumps((fn, args, kwargs)))


@contextmanager
def cluster_workers(address: str) -> Iterator[Executor]:
    """Connect to a scheduler; at the end its workers drop the jobs that are left.

    Raises:
        InputError: one line: dask.distributed is not installed, no scheduler answers, it has no
            workers, or a worker has other versions.
        Broken: the scheduler has ended, or a job has ended several workers.
    """
    flag = f"--cluster {address}"
    require_package("distributed", "cluster", flag)
    from distributed import Client, KilledWorker
    from distributed.comm.addressing import parse_address, parse_host_port

    try:
        parse_host_port(parse_address(address)[1])  # of a wrong one, `Client` leaves a thread
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{flag}: no scheduler of dask.distributed answers there") from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # one line of ours is enough
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
            client.run(_check_worker, _versions())
        except Exception as error:  # of a worker: it may have no hector_jax at all
            raise InputError(f"{flag}: {one_line(error)}") from None
        try:
            yield _Pool(client)
        except (KilledWorker, CancelledError) as error:
            text = one_line(error) or "the scheduler has ended"
            raise Broken(f"{flag}: {text}; what was done is kept") from None
