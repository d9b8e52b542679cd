"""Whatever environment and packages are, a program works, or one line says what is wrong."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import pytest
from pretend import USUAL, python

from hector_jax.core.console import exit_code
from hector_jax.core.inputs import InputError, outside_packages


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


# as numpy's message, which begins with an empty line and has many
COMPILED = """
try:
    from {name} import _core
except ImportError as error:
    raise ImportError('''

IMPORTANT: PLEASE READ THIS FOR ADVICE ON HOW TO SOLVE THIS ISSUE!''') from error
"""


# the last after JAX, so it takes seconds
@pytest.mark.parametrize("name", ["numpy", "jaxlib", pytest.param("flax", marks=pytest.mark.slow)])
def test_a_package_of_another_python_is_named_with_its_file(tmp_path, name):
    file = tmp_path / name / "__init__.py"
    file.parent.mkdir()
    file.write_text(COMPILED.format(name=name))
    (file.parent / "_core.cpython-310-x86_64-linux-gnu.so").write_bytes(b"\x7fELF")
    path = os.pathsep.join([f"{tmp_path}/", str(Path(__file__).parents[1])])
    done = python("-m", "hector_jax.cli.main", "walk", env=os.environ | {"PYTHONPATH": path})
    lines = [line for line in done.stderr.splitlines() if line != "loading JAX and MuJoCo"]
    assert (done.returncode, done.stdout, len(lines)) == (2, "", 1), done.stderr
    assert lines[0].startswith(f"hector: {name} cannot be loaded from {file}: ")
    assert lines[0].endswith(f"take {tmp_path} out of PYTHONPATH")


def raised(source):
    """The exception of source text that a module of ours has at its top."""
    names = {"__name__": "hector_jax.sim.some"}
    with pytest.raises(Exception) as raised, outside_packages():  # noqa: PT011
        exec(compile(source, names["__name__"], "exec"), names)
    return raised.value


def test_a_fault_of_ours_stays_what_it_is():
    own = "from hector_jax.core.inputs import InputError; raise InputError('x') from OSError()"
    kinds = {"from jax import nonsense": ImportError, "import jax; jax.nonsense": AttributeError}
    kinds |= {"import hector_jax.nonsense": ModuleNotFoundError, own: InputError}
    kinds["raise RuntimeError('x') from ImportError('y', name='jax')"] = RuntimeError
    for source, kind in kinds.items():
        assert type(raised(source)) is kind


def test_a_package_that_is_missing_or_broken_where_it_belongs_is_named(monkeypatch, tmp_path):
    assert str(raised("import absent")) == "absent is not installed: No module named 'absent'"
    monkeypatch.setattr(sys, "path", [str(tmp_path / "script"), str(tmp_path), *sys.path])
    (tmp_path / "plain.py").write_text("")
    for name, source, named, reason in (
        ("half", "import absent", "half", "No module named 'absent'"),
        ("torn", "raise ImportError('libtorn.so')", "torn", "libtorn.so"),
        ("old", "from plain import new", "plain", "cannot import name 'new' from 'plain'"),
    ):
        (tmp_path / f"{name}.py").write_text(source)
        line = f"{named} cannot be loaded from {tmp_path}/{named}.py: {reason}"
        assert str(raised(f"import {name}")).startswith(line)
