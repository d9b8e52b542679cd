"""Whatever the environment is, a program works, or one line says what of it is wrong."""

import signal
import subprocess
import sys
import time
from unittest import mock

import pytest
from pretend import USUAL, python

from hector_jax.core.console import exit_code


@pytest.mark.parametrize(
    ("wrong", "words", "told"),
    [
        ("JAX_PLATFORMS=tpu", "walk", "JAX does not start with JAX_PLATFORMS=tpu: "),
        ("JAX_NUM_CPU_DEVICES=x", "walk", "JAX does not start with JAX_NUM_CPU_DEVICES=x: Invalid"),
        ("MUJOCO_GL=crayon", "view . --out shown", "MUJOCO_GL must be 'egl', 'osmesa', 'glfw' or"),
    ],
)
def test_what_does_not_work_with_the_environment_is_one_line(wrong, words, told):
    name, value = wrong.split("=")
    done = python("-m", "hector_jax.cli.main", *words.split(), env=USUAL | {name: value})
    assert (done.returncode, done.stdout) == (2, "")
    (said,) = [text for text in done.stderr.splitlines() if text != "loading JAX and MuJoCo"]
    assert said.startswith(f"hector: {told}")


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


@pytest.mark.parametrize("error", [ValueError("zip() argument 2"), OSError("odd")])
def test_a_fault_of_the_program_keeps_its_traceback(error):
    with pytest.raises(type(error), match=str(error)[:3]):
        exit_code("toy", mock.Mock(side_effect=error))


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
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    toy = subprocess.Popen([sys.executable, "-c", DEAF], text=True, **pipes)
    assert toy.stdout.readline() == "deaf\n"
    time.sleep(0.3)  # until it is
    start = time.monotonic()
    toy.send_signal(signal.SIGTERM)
    assert toy.wait(timeout=10) == 128 + signal.SIGTERM
    assert 0.4 < time.monotonic() - start
    assert toy.stderr.read() == "toy: terminated, at once\n"
