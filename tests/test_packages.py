"""Packages that cannot be loaded, such as those of another Python: one line with their file."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hector_jax.core.inputs import InputError, outside_packages

# as numpy's message, which begins with an empty line and has many
COMPILED = """
try:
    from {name} import _core
except ImportError as error:
    raise ImportError('''

IMPORTANT: PLEASE READ THIS FOR ADVICE ON HOW TO SOLVE THIS ISSUE!

Importing the {name} C-extensions failed.''') from error
"""
OF_ANOTHER_PYTHON = "from {name}._core import *"
PLAIN = "x = 1"


def place(folder, name, text):
    """Put a package or, without a text, a module of its name into a folder; return its file."""
    if text is None:
        (folder / f"{name}.py").write_text(PLAIN)
        return folder / f"{name}.py"
    (folder / name).mkdir()
    (folder / name / "_core.cpython-310-x86_64-linux-gnu.so").write_bytes(b"\x7fELF")
    (folder / name / "__init__.py").write_text(text.format(name=name))
    return folder / name / "__init__.py"


def hector(folder, *words):
    paths = [f"{folder}/", str(Path(__file__).parents[1])]
    return subprocess.run(
        [sys.executable, "-m", "hector_jax.cli.main", *words],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("numpy", COMPILED),
        ("numpy", OF_ANOTHER_PYTHON),
        ("tyro", None),
        ("jaxlib", COMPILED),
        pytest.param("flax", COMPILED, marks=pytest.mark.slow),  # after JAX, so it takes seconds
    ],
)
def test_a_package_of_another_python_is_named_with_its_file(tmp_path, name, text):
    file = place(tmp_path, name, text)
    done = hector(tmp_path, "walk")
    lines = [line for line in done.stderr.splitlines() if line != "loading JAX and MuJoCo"]
    assert (done.returncode, done.stdout, len(lines)) == (2, "", 1), done.stderr
    assert lines[0].startswith(f"hector: {name} cannot be loaded from {file}: ")
    assert lines[0].endswith(f"take {tmp_path} out of PYTHONPATH")


def raised(source, module="hector_jax.sim.some"):
    """The exception of source text that a module of this name has at its top."""
    with pytest.raises(Exception) as raised, outside_packages():  # noqa: PT011
        exec(compile(source, module, "exec"), {"__name__": module})
    return raised.value


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("from jax import nonsense", ImportError),
        ("import jax; jax.nonsense", AttributeError),
        ("import hector_jax.nonsense", ModuleNotFoundError),
        ("raise RuntimeError('x') from ImportError('y', name='jax')", RuntimeError),
        (
            "from hector_jax.core.inputs import InputError; raise InputError('x') from OSError()",
            InputError,
        ),
    ],
)
def test_a_fault_of_ours_stays_what_it_is(source, kind):
    assert type(raised(source)) is kind


def test_a_package_that_is_missing_or_broken_where_it_belongs_is_named(monkeypatch, tmp_path):
    assert str(raised("import absent")) == "absent is not installed: No module named 'absent'"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "script")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "script"), str(tmp_path), *sys.path[2:]])
    (tmp_path / "half.py").write_text("import absent")
    line = f"half cannot be loaded from {tmp_path}/half.py: No module named 'absent'"
    assert str(raised("import half")) == line
    (tmp_path / "torn.py").write_text("raise ImportError('libtorn.so: no such file')")
    line = f"torn cannot be loaded from {tmp_path}/torn.py: libtorn.so: no such file"
    assert str(raised("import torn")) == line
    (tmp_path / "old.py").write_text("from half2 import new")
    (tmp_path / "half2.py").write_text("")
    assert str(raised("import old")).startswith(f"half2 cannot be loaded from {tmp_path}/half2.py")
