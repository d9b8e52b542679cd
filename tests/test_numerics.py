"""The set-up of a process: 64 bits, workers, flags of XLA; JAX's options change nothing."""

import json
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pretend import USUAL, python
from threadpoolctl import threadpool_info

from hector_jax.cli import doctor
from hector_jax.core import numerics, runtime
from hector_jax.core.inputs import InputError
from hector_jax.core.numerics import add_flags, without_our_flags
from hector_jax.core.pool import workers

# a net's parameters and draws of the kinds that we use; a reference, whose ranks and dtypes are
# promoted and which takes NumPy's arrays; and one that is NaN
PROGRAM = """
import hashlib, json
import jax, numpy as np
import jax.numpy as jnp
from hector_jax.control.reference import Anchor, named_command, reference_at
from hector_jax.core import numerics
from hector_jax.core.runtime import setup_jax
from hector_jax.grfm.network import VARIANTS
setup_jax()
key = jax.random.key(3)
net = VARIANTS["residual"].init(key, feet=2, axes=6, hidden=(4,))
draws = jax.random.normal(key, 5), jax.random.permutation(key, 9), jax.random.uniform(key, 5)
anchor = Anchor(np.zeros(3), np.float32(0.3), np.int32(2))
reference = reference_at(0.01, named_command("s"), anchor, 77)
lost = reference_at(0.01, named_command("s"), anchor._replace(yaw=np.nan), 77)
ranks = jnp.ones((2, 3)) + jnp.ones(3, jnp.float32) * jnp.arange(3)
content = hashlib.sha256()
for leaf in jax.tree.leaves((net, draws, reference, lost, ranks)):
    content.update(f"{leaf.dtype}{leaf.shape}".encode() + np.asarray(leaf).tobytes())
options = {name: repr(value) for name, value in jax.config.values.items()}
print(json.dumps([content.hexdigest(), numerics.not_used(), options]))
"""


def computed(**variables):
    """The hash of the numbers, the variables that were not used, and JAX's options."""
    done = python("-c", PROGRAM, env=USUAL | variables)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def usual():
    return computed()


def another(option):
    """Text for a value of an option that is not its default, for any that JAX has or will have."""
    kind, _, known = jax.config.meta[option]
    value = getattr(jax.config, option, None) or jax.config.values[option]
    if kind == "enum":
        return next(word for word in known["enum_values"] if word != value)
    if kind == "enum_class":
        return next(x.name.lower() for x in known["enum_class"] if x != value)
    if kind is bool:
        return str(not value)
    return "/tmp/other" if kind is str else str((value or 0) + 1)


def test_options_of_devices_and_logs_are_the_users_and_no_other_can_be_set_from_outside(usual):
    options = [name for name in jax.config.values if not name.startswith(numerics._FREE)]
    words = {"jax_default_device": "cpu", "jax_pjrt_client_create_options": ""}
    variables = {name.upper(): words.get(name) or another(name) for name in options}
    numbers, not_used, after = computed(**variables)
    assert len(options) > 50
    assert not_used == variables
    assert {n: (after[n], usual[2][n]) for n in after if after[n] != usual[2][n]} == {}
    assert numbers == usual[0]
    free = {"JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "3", "JAX_LOG_COMPILES": "0"}
    numbers, not_used, options = computed(**free)
    assert (numbers, not_used) == (usual[0], {})
    assert options["jax_num_cpu_devices"] == "3"


def test_the_doctor_lists_what_the_environment_sets(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    monkeypatch.setattr(doctor, "not_used", lambda: {"JAX_DEBUG_NANS": "1"})
    monkeypatch.setattr(doctor, "load_robot", lambda: json.loads("no robot"))  # nor a walk
    facts, _ = doctor.examine()
    assert facts["JAX_PLATFORMS"] == "cpu (used)"
    assert facts["XLA_FLAGS"] == "--xla_backend_optimization_level=0 (used)"
    assert facts["JAX_DEBUG_NANS"] == "1 (not used: jax_debug_nans is False)"


def test_a_worker_computes_in_64_bits_and_draws_what_its_parent_draws(monkeypatch):
    monkeypatch.setenv("JAX_RANDOM_SEED_OFFSET", "1")
    monkeypatch.setenv("JAX_DEFAULT_PRNG_IMPL", "rbg")
    with workers(1) as pool:
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
    with workers(1) as pool:
        assert len(pool.submit(os.sched_getaffinity, 0).result(timeout=60)) == 1


def test_without_semaphores_one_process_computes_and_several_are_refused(monkeypatch):
    refused = mock.Mock(side_effect=OSError(30, "Read-only file system"))
    monkeypatch.setattr("_multiprocessing.SemLock", refused)
    with workers(1) as pool:
        assert list(pool.map(pow, (2, 3), (2, 2))) == [4, 9]
        assert pool.submit(os.getpid).result() == os.getpid()
        assert isinstance(pool.submit(int, "x").exception(), ValueError)
    with pytest.raises(InputError, match="no worker processes: .* --processes 1 needs none"):
        with workers(2):
            pass


def test_importing_the_library_computes_nothing_and_linear_algebra_has_one_thread():
    told = "import hector_jax.tuning.difftune; from jax._src import xla_bridge"
    told += "; assert not xla_bridge.backends_are_initialized()"
    root = Path(runtime.__file__).parents[2]
    subprocess.run([sys.executable, "-c", told], cwd=root, check=True)
    assert {x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"} <= {1}


TWO_BATCHES = """
from concurrent.futures import ThreadPoolExecutor
from hector_jax.core.runtime import setup_jax
setup_jax()
import jax, numpy as np
from hector_jax.qp import QP, QpConfig, solve_qp
from hector_jax.qp.method import Solver
config, rng = QpConfig(Solver.named("SOLVER")), np.random.default_rng(0)
P, A, q = (rng.normal(size=(8, *shape)) for shape in ((60, 60), (100, 60), (60,)))
qp = QP(P @ P.swapaxes(1, 2) + np.eye(60), q, A, -np.ones((8, 100)), np.ones((8, 100)))
slope = jax.vmap(jax.grad(lambda q, qp: solve_qp(qp._replace(q=q), config).x.sum()))
solve = jax.jit(slope).lower(q, qp).compile()
with ThreadPoolExecutor(2) as threads:
    for each in threads.map(lambda _: [solve(q, qp).sum() for _ in range(COUNT)], range(2)):
        assert np.isfinite(each).all()
"""


@pytest.mark.parametrize(
    ("solver", "count"),
    [("interior_point", 20), pytest.param("jaxopt", 1, marks=pytest.mark.slow)],
)
def test_batches_of_factorisations_in_two_threads_do_not_wait_for_each_other(solver, count):
    """With XLA's pool as it is, jaxlib 0.10.2 waited for ever in the first or second solve."""
    program = TWO_BATCHES.replace("SOLVER", solver).replace("COUNT", str(count))
    done = python("-c", program, env=USUAL, timeout=240)
    assert done.returncode == 0, done.stderr


FLAGS = {
    "YNN": "--xla_cpu_experimental_ynn_fusion_type=",
    "EMITTERS": "--xla_cpu_use_fusion_emitters=false",
    "COMPILERS": "--xla_gpu_force_compilation_parallelism=16",
}
SET = [("", "YNN EMITTERS COMPILERS")]
SET += [("--xla_a=1 word", "YNN EMITTERS COMPILERS --xla_a=1 word"), ("flags.txt", "flags.txt")]
SET += [("YNNdot --xla_a=1", "EMITTERS COMPILERS YNNdot --xla_a=1")]


@pytest.mark.parametrize(("before", "after"), SET)
@pytest.mark.parametrize("version", [(0, 10, 1), (0, 10, 2), (0, 12, 0, 1), (0, 13, 0)])
def test_flags_are_set_where_they_are_known(monkeypatch, version, before, after):
    known = {"YNN": (0, 10, 2) <= version < (0, 13), "EMITTERS": version < (0, 11)}
    known["COMPILERS"] = version < (0, 13)
    after = " ".join(word for word in after.split() if known.get(word, True))
    for name, flag in FLAGS.items():
        before, after = before.replace(name, flag), after.replace(name, flag)
    assert without_our_flags(after) == before  # in the keys, the user's alone
    monkeypatch.setattr("jaxlib.version.__version_info__", version)
    monkeypatch.setenv("XLA_FLAGS", before)
    add_flags()
    assert os.environ["XLA_FLAGS"] == after
