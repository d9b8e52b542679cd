"""JAX's options on which numbers depend or by which programs break: ours while a program runs.

`PINNED` gets values of ours, whoever set it before. Any other option that the environment sets goes
back to JAX's default, whether this module knows it or not, except those in `_FREE`. Where compiled
programs are kept is up to `core.runtime`.
"""

import os
import pickle
import subprocess
import sys
from functools import cache
from typing import Any

from threadpoolctl import threadpool_limits

PINNED = {
    "jax_enable_x64": True,  # the QP mixes weights of 1e2 and 1e-5
    "jax_default_matmul_precision": "highest",  # else a GPU rounds numbers of 32 bits before
    # one seed gives one net, one data set and one plant
    "jax_default_prng_impl": "threefry2x32",
    "jax_random_seed_offset": 0,
    "jax_threefry_partitionable": True,
    # shapes and dtypes mix as in NumPy, and NumPy's arrays go into compiled programs
    "jax_numpy_rank_promotion": "allow",
    "jax_numpy_dtype_promotion": "standard",
    "jax_transfer_guard": None,
    "jax_disable_jit": False,  # a walk would take hours
    # NaN and infinity are data: a walk that fell, a bound that is none
    "jax_debug_nans": False,
    "jax_debug_infs": False,
}
# beginnings of the names of options that are the user's
_FREE = tuple(
    (
        # devices; not jax_default_device: programs ask for the default backend and compute there
        "jax_platform jax_backend_target jax_xla_backend jax_num_cpu_devices jax_pjrt_"
        " jax_cuda_visible jax_rocm_visible jax_oneapi_visible jax_mock_gpu"
        # hosts
        " jax_distributed jax_mtls jax_check_proxy jax_cpu_collectives jax_cpu_get_"
        " jax_cross_host jax_force_dcn jax_share_binary jax_sort_devices"
        " jax_enable_preemption jax_enable_recoverability"
        # whether and how many compiled programs are kept
        " jax_enable_compilation_cache jax_compilation_cache_max_size"
        # logs, dumps and tracebacks
        " jax_log jax_debug_log jax_explain jax_captured_constants jax_pallas_verbose"
        " jax_compiler_detailed_logging jax_dump jax_include jax_source_url jax_pprint"
        " jax_traceback jax_tracer_error jax_send_traceback jax_hlo_source"
    ).split()
)
# XLA's flags with the versions of jaxlib, from the first to before the second, that know
# them: an unknown flag ends a process
_FLAGS = {
    # No YNNPACK: its sums read memory that nothing has written. With jaxlib 0.12 a third of the
    # programs of the plain net gave NaN, and 0.10.2 has wrong sums (jax-ml/jax issue 39103).
    "--xla_cpu_experimental_ynn_fusion_type=": ((0, 10, 2), (0, 13)),
    # No MLIR for fused kernels: programs are as quick and compile in half the time.
    "--xla_cpu_use_fusion_emitters=false": ((0, 10), (0, 11)),
    # A GPU's programs compile in XLA's pool too, which has one thread: three times as long.
    "--xla_gpu_force_compilation_parallelism=16": ((0, 10), (0, 13)),
}


def pin_options() -> None:
    """Give JAX's options the values that programs are made for; call before the first array.

    Linear algebra on a CPU (NumPy's too) gets one thread, and so does XLA's pool.
    """
    import jax
    import scipy.linalg  # noqa: F401  # loads the LAPACK that XLA calls

    # Its threads would wait for each other in small systems, and the number of cores would change
    # the rounding of results.
    threadpool_limits(1, user_api="blas")
    # From jaxlib 0.10.0 to 0.11.0 a batch of factorisations waits for parts of it that threads of
    # XLA's pool compute: batches that begin together can wait in all of them, for ever. With one
    # thread a batch is computed where it begins, and our programs are no slower. A value of the
    # user's own gives way: it would hang, and change the rounding.
    os.environ["PJRT_NPROC"] = "1"
    add_flags()
    values = (_defaults() if not_used() else {}) | PINNED
    for name in jax.config.values:  # which differ between versions
        if name in PINNED or name.upper() in not_used():
            jax.config.update(name, values[name])


@cache  # the environment sets JAX's options once, when JAX is imported
def not_used() -> dict[str, str]:
    """Take the variables that set an option of ours out of the environment, and return them."""
    import jax

    ours = {name.upper() for name in jax.config.values if not name.startswith(_FREE)}
    return {name: os.environ.pop(name) for name in sorted(ours & os.environ.keys())}


def _defaults() -> dict[str, Any]:
    """Return JAX's defaults, which only a process without the variables knows."""
    program = "import pickle, sys, jax; sys.stdout.buffer.write(pickle.dumps(jax.config.values))"
    # -P: without the working directory, where a file may have the name of a module
    return pickle.loads(subprocess.check_output([sys.executable, "-P", "-c", program]))


def without_our_flags(flags: str) -> str:
    """Return XLA_FLAGS as the user set them."""
    return " ".join(word for word in flags.split() if word not in _FLAGS)


def add_flags() -> None:
    """Set our flags of XLA, but those that the user set; call before JAX starts, which reads them.

    XLA reads XLA_FLAGS once.
    """
    from jaxlib.version import __version_info__ as version

    flags = os.environ.get("XLA_FLAGS", "")
    if flags.strip()[:1] not in ("", "-"):
        return  # it names a file of flags
    ours = [
        flag
        for flag, (first, end) in _FLAGS.items()
        if first <= version < end and flag.partition("=")[0] not in flags
    ]
    # first, because XLA ignores what follows a word without a dash
    os.environ["XLA_FLAGS"] = " ".join([*ours, *flags.split()])
