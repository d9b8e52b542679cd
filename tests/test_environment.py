"""Whatever the environment is, a program works, or one line says what of it is wrong."""

import os
import signal
import subprocess
import sys
import time

import pytest

# without the flags of the tests
USUAL = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
WRONG = [
    ({"JAX_PLATFORMS": "abacus"}, "JAX does not start with JAX_PLATFORMS=abacus: "),
    ({"JAX_PLATFORMS": "tpu"}, "JAX does not start with JAX_PLATFORMS=tpu: "),
    ({"JAX_NUM_CPU_DEVICES": "x"}, "JAX does not start with JAX_NUM_CPU_DEVICES=x: Invalid value"),
]


def hector(*words, **options):
    return subprocess.run(
        [sys.executable, "-m", "hector_jax.cli.main", *map(str, words)],
        capture_output=True,
        text=True,
        **options,
    )


@pytest.mark.parametrize(("wrong", "line"), WRONG, ids=[next(iter(w)) for w, _ in WRONG])
def test_what_jax_cannot_start_with_is_one_line(wrong, line):
    environment = USUAL | wrong
    done = hector("walk", env=environment)
    assert (done.returncode, done.stdout) == (2, "")
    said = [text for text in done.stderr.splitlines() if text != "loading JAX and MuJoCo"]
    assert len(said) == 1
    assert said[0].startswith(f"hector: {line}")


def test_a_renderer_is_needed_for_a_film_alone(tmp_path):
    """And not for a report, as a home that cannot be written shows below."""
    environment = USUAL | {"MUJOCO_GL": "crayon"}
    done = hector("view", tmp_path, "--headless", env=environment)
    line = "hector: MUJOCO_GL must be 'egl', 'osmesa', 'glfw' or 'disable', got 'crayon'"
    assert (done.returncode, done.stderr.splitlines()[-1]) == (2, line)


# Streams and signals

TOY = """
import sys
from hector_jax.core.console import exit_code, say
def work():
    say("working")
    print("result")
sys.exit(exit_code("toy", work))
"""


@pytest.mark.parametrize(
    ("redirected", "code", "out", "err"),
    [
        (">&-", 0, "", "working\n"),
        ("<&- >&- 2>&-", 0, "", ""),
        (">/dev/full", 1, "", "working\ntoy: cannot write the output: No space left on device\n"),
    ],
)
def test_streams_that_are_closed_or_full_cost_at_most_a_line(redirected, code, out, err):
    line = f'"$0" -c "$1" {redirected}'
    done = subprocess.run(["bash", "-c", line, sys.executable, TOY], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (code, out, err)


DEAF = """
import ctypes, sys
from hector_jax.core import console
console._PATIENCE = 0.5
def work():
    mutex = ctypes.create_string_buffer(64)
    lock = ctypes.CDLL(None).pthread_mutex_lock
    lock(mutex)
    print("deaf", flush=True)
    lock(mutex)  # for ever, as compiled code may
sys.exit(console.exit_code("toy", work))
"""


def test_a_signal_ends_a_program_that_hangs_in_compiled_code():
    toy = subprocess.Popen(
        [sys.executable, "-c", DEAF], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert toy.stdout.readline() == "deaf\n"
    time.sleep(0.3)  # until it is
    start = time.monotonic()
    toy.send_signal(signal.SIGTERM)
    assert toy.wait(timeout=10) == 128 + signal.SIGTERM
    assert 0.4 < time.monotonic() - start
    assert toy.stderr.read() == "toy: terminated, at once\n"


IMPORTS = """
import io, os, pkgutil, sys, warnings
import jax, flax, optax, mujoco, matplotlib.figure, scipy.spatial, rich.progress
import jaxtyping, imageio_ffmpeg
import hector_jax
sys.stdout = stream = io.StringIO()
import mujoco.mjx
seen = lambda: (
    mujoco.get_mju_user_warning(), sys.stdout, sys.stderr, list(warnings.filters),
    dict(jax.config.values), matplotlib.rcParams._get_backend_or_none(), dict(os.environ),
)
before = seen()
for module in pkgutil.walk_packages(hector_jax.__path__, "hector_jax."):
    if module.name not in ("hector_jax.sim.drake", "hector_jax.sim.pinocchio"):  # extras
        __import__(module.name)
after = seen()
for one, other in zip(before, after):
    assert one is other or one == other, (one, other)
"""


def test_importing_every_module_leaves_the_process_as_it_was():
    done = subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
