"""The wheel works by itself: outside the checkout, with the robot from inside."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_wheel_walks_in_an_environment_of_its_own(tmp_path):
    """Built from a copy without git, installed without network; packages are the running ones."""
    pytest.importorskip("hatchling")

    # nothing of the checkout may be found by the programs
    known = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def call(*words, **more):
        words = [str(word) for word in words]
        done = subprocess.run(words, capture_output=True, text=True, env=known, **more)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    source, wheels, home = tmp_path / "source", tmp_path / "wheels", tmp_path / "elsewhere"
    for name in ("hector_jax", "assets"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    home.mkdir()
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    alone = ("--no-deps", "--no-index")
    call(*pip, "wheel", *alone, "--no-build-isolation", "-w", wheels, source)
    (wheel,) = wheels.iterdir()
    call(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    packages = call(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    # a path in a .pth file is searched, but its own .pth files, the editable install, are not read
    running = sysconfig.get_path("purelib")
    paths = [running, *(path for path in sys.path if path.startswith(f"{running}/"))]
    (Path(packages) / "running.pth").write_text("\n".join(paths) + "\n")
    call(*pip, "--python", python, "install", *alone, "--ignore-installed", wheel)
    shutil.rmtree(source)

    hector = python.parent / "hector"
    told = json.loads(call(hector, "doctor", "--json", cwd=home))
    assert told["faults"] == []
    assert told["robot"].startswith(f"{packages}/hector_jax/assets/hector.xml")
    assert "commit" not in told
    words = ("walk", "--world", "hfs", "--seconds", "1", "--weights", "shipped", "--json")
    walked = json.loads(call(hector, *words, cwd=home))
    assert (walked["seconds"], walked["fell"]) == (pytest.approx(1.0), False)
    assert list(home.iterdir()) == []
