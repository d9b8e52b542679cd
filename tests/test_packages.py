"""Packages that cannot be loaded, such as those of another Python: one line with their file."""

import os
import sys
from pathlib import Path

import pytest
from pretend import python

from hector_jax.core.inputs import InputError, outside_packages

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
