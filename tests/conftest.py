"""Shared set-up of the tests: 64 bits and the compilation cache, before the first array."""

import tempfile
from pathlib import Path

import jax
import pytest
from hypothesis import configuration

from hector_jax.runtime import setup_jax

setup_jax()
# what it notes about the code names the machine's paths: not into the checkout
configuration.set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")


@pytest.fixture(autouse=True, scope="module")
def _forget_programs():
    """Let go of compiled programs before a process has no room for more.

    Each takes memory maps, of which Linux gives a process 65530; beyond them LLVM aborts it.
    """
    yield
    try:
        with open("/proc/self/maps") as maps:
            crowded = sum(1 for _ in maps) > 25_000
    except OSError:  # no Linux
        return
    if crowded:
        jax.clear_caches()
