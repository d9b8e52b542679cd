"""The set-up of a process: who turns on 64 bits, what a worker is, which flags XLA gets."""

import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from threadpoolctl import threadpool_info

from hector_jax.core import runtime
from hector_jax.core.inputs import InputError
from hector_jax.core.numerics import add_flags, without_our_flags


def test_a_worker_computes_in_64_bits_and_draws_what_its_parent_draws(monkeypatch):
    monkeypatch.setenv("JAX_RANDOM_SEED_OFFSET", "1")
    monkeypatch.setenv("JAX_DEFAULT_PRNG_IMPL", "rbg")
    with runtime.workers(1) as pool:
        assert pool.submit(jnp.zeros, 3).result(timeout=60).dtype == jnp.float64
        drawn = pool.submit(jax.random.PRNGKey, 3).result(timeout=60)
    np.testing.assert_array_equal(drawn, jax.random.PRNGKey(3))


def test_where_no_core_can_be_claimed_a_worker_keeps_all(monkeypatch):
    monkeypatch.setattr(runtime.socket.socket, "bind", mock.Mock(side_effect=PermissionError))
    monkeypatch.setattr(os, "sched_setaffinity", mock.Mock(), raising=False)
    runtime.start_worker()
    os.sched_setaffinity.assert_not_called()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no binding to cores")
def test_workers_share_out_the_cores_and_a_single_one_has_one_too():
    """Else the number of processes would change the rounding of results."""
    assert [runtime._claim_core([-1, -2]) for _ in range(4)] == [-1, -2, -1, -2]
    with runtime.workers(1) as pool:
        assert len(pool.submit(os.sched_getaffinity, 0).result(timeout=60)) == 1


def test_without_semaphores_one_process_computes_and_several_are_refused(monkeypatch):
    refused = mock.Mock(side_effect=OSError(30, "Read-only file system"))
    monkeypatch.setattr("_multiprocessing.SemLock", refused)
    with runtime.workers(1) as pool:
        assert list(pool.map(pow, (2, 3), (2, 2))) == [4, 9]
        assert pool.submit(os.getpid).result() == os.getpid()
        assert isinstance(pool.submit(int, "x").exception(), ValueError)
    with pytest.raises(InputError, match="no worker processes: .* --processes 1 needs none"):
        with runtime.workers(2):
            pass


def test_importing_the_library_computes_nothing_and_linear_algebra_has_one_thread():
    told = "import hector_jax.tuning.difftune; from jax._src import xla_bridge"
    told += "; assert not xla_bridge.backends_are_initialized()"
    root = Path(runtime.__file__).parents[2]
    subprocess.run([sys.executable, "-c", told], cwd=root, check=True)
    assert {x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"} <= {1}


YNN, EMITTERS = "--xla_cpu_experimental_ynn_fusion_type=", "--xla_cpu_use_fusion_emitters=false"
BOTH = [("", "YNN EMITTERS"), ("--xla_a=1 word", "YNN EMITTERS --xla_a=1 word")]
BOTH += [("YNNdot --xla_a=1", "EMITTERS YNNdot --xla_a=1"), ("flags.txt", "flags.txt")]


@pytest.mark.parametrize(("before", "after"), BOTH)
@pytest.mark.parametrize("version", [(0, 10, 1), (0, 10, 2), (0, 12, 0, 1), (0, 13, 0)])
def test_flags_are_set_where_they_are_known(monkeypatch, version, before, after):
    known = {"YNN": (0, 10, 2) <= version < (0, 13), "EMITTERS": version < (0, 11)}
    after = " ".join(word for word in after.split() if known.get(word, True))
    before, after = (t.replace("YNN", YNN).replace("EMITTERS", EMITTERS) for t in (before, after))
    assert without_our_flags(after) == before  # in the keys, the user's alone
    monkeypatch.setattr("jaxlib.version.__version_info__", version)
    monkeypatch.setenv("XLA_FLAGS", before)
    add_flags()
    assert os.environ["XLA_FLAGS"] == after
