"""Workers of a scheduler of dask.distributed: the same bytes as here, though one is killed."""

import os
import re
import signal
import threading
import time
from pathlib import Path

import jax.numpy as jnp
import pytest
from pretend import call

from hector_jax.core import cluster
from hector_jax.core.console import Broken
from hector_jax.core.inputs import InputError
from hector_jax.core.pool import workers

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def two():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as started:
        yield started


def killed_once(path, number):
    """The number; whoever computes that of 3 first is killed."""
    if number == 3 and not path.exists():
        path.touch()
        signal.raise_signal(signal.SIGKILL)
    return number


def test_the_job_of_a_killed_worker_is_done_by_another_set_up_like_ours(two, tmp_path):
    with workers(1, two.scheduler_address) as pool:
        assert list(pool.map(killed_once, [tmp_path / "x"] * 8, range(8))) == list(range(8))
        assert (tmp_path / "x").exists()
        assert pool.submit(jnp.zeros, 3).result().dtype == jnp.float64
        assert {len(cores) for cores in pool.map(os.sched_getaffinity, [0] * 9)} == {1}


def test_a_job_that_ends_every_worker_is_one_line(two, monkeypatch):
    monkeypatch.setattr(two.scheduler, "allowed_failures", 0)
    with pytest.raises(Broken, match="--cluster .* on 1 different workers"):
        with workers(1, two.scheduler_address) as pool:
            pool.submit(signal.raise_signal, signal.SIGKILL).result()


def test_other_versions_are_refused_by_name(two, monkeypatch):
    own = dict(cluster._versions())
    assert {"python", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy"} < own.keys()
    for name in ("jax", "code of hector_jax (or XLA_FLAGS)"):
        monkeypatch.setattr(cluster, "_versions", lambda name=name: ((name, "0.9"),))
        line = f"--cluster .*: worker tcp:.* has {re.escape(name)} {own[name]}, expected 0.9"
        with pytest.raises(InputError, match=line), workers(1, two.scheduler_address):
            pass


@pytest.mark.parametrize("address", ["localhost:1", "no port"])
def test_an_address_where_nobody_answers_is_one_line(address, monkeypatch):
    monkeypatch.setattr(cluster, "_PATIENCE", 0.3)
    line = f"--cluster {address}: no scheduler of dask.distributed answers there"
    with pytest.raises(InputError, match=line), workers(1, address):
        pass


@pytest.mark.slow
def test_an_evaluation_is_the_same_where_a_worker_is_killed_on_the_way(two, monkeypatch, tmp_path):
    def kill():
        table = tmp_path / "cluster/runs/verdict/walks.jsonl"
        while not (table.exists() and table.stat().st_size):
            time.sleep(0.01)
        os.kill(two.workers[0].pid, signal.SIGKILL)

    killer, results = threading.Thread(target=kill, daemon=True), []
    killer.start()
    for name, address in (("cluster", ["--cluster", two.scheduler_address]), ("here", [])):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        flags = "--traj straight --seeds 4 --seconds 0.1 --out runs/verdict".split()
        assert call(monkeypatch, "evaluate", *flags, *address) == 0
        results.append(Path("runs/verdict/verdict.json").read_bytes())
    assert not killer.is_alive()
    assert results[0] == results[1]
