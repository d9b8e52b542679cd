"""Shared set-up of the tests, before the first array: 64 bits, compiling that is quick and kept."""

import os
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path

# A test runs most programs once, so what it waits for is the compiler. Without optimisation it
# takes a quarter of the time, and programs twice theirs; `make bench` and the golden results are
# for programs as the user has them. Not on a GPU, where such a program ends with an illegal address
# (jax 0.11). What XLA_FLAGS says already stays.
_QUICK = []
if not any(Path("/dev").glob("nvidia[0-9]*")):
    _QUICK.append("--xla_backend_optimization_level=0")
os.environ["XLA_FLAGS"] = " ".join(_QUICK + os.environ.get("XLA_FLAGS", "").split())  # last wins
# The matrices of the tests are small: threads of NumPy and SciPy would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Several processes share a GPU: none takes most of its memory in advance.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import configuration, settings  # noqa: E402

from hector_jax.core.runtime import setup_jax  # noqa: E402

setup_jax()
sys.path.append(str(Path(__file__).parents[1] / "experiments"))  # scripts import their helpers so
# what it notes about the code names the machine's paths: not into the checkout
configuration.set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")
# the same examples in each run, however slow the machine
settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")


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


@pytest.fixture(scope="module")
def on_cpu():
    """Compute on the CPU although there is a GPU, as the processes do that tune and export."""
    if jax.default_backend() == "cpu":
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "cpu")
        jax.config.update("jax_default_device", jax.devices("cpu")[0])
        yield
        jax.config.update("jax_default_device", None)


@pytest.fixture(autouse=True, scope="session")
def _no_machine_is_slow():
    """What a command prints in a test does not depend on how long JAX takes to load."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hector_jax.cli.main.say_if_slow", lambda text: nullcontext())
        yield


def has_name(axes, which):
    """Whether a reader can tell what an axis is: from its label, title or ticks that are words."""
    siblings = getattr(axes, f"get_shared_{which}_axes")().get_siblings(axes)
    words = [getattr(one, f"get_{which}label")() for one in siblings]
    for one in siblings:
        words += [label.get_text() for label in getattr(one, f"get_{which}ticklabels")()]
    if which == "y":
        words += [axes.get_title(), axes.get_title("left")]
    return any(letter.isalpha() for letter in "".join(words))


@pytest.fixture
def drawn(monkeypatch):
    """The figures as they were written, in order; all of their axes have names."""
    from matplotlib.figure import Figure  # loads much that few tests need

    figures, save = [], Figure.savefig

    def savefig(figure, path, **kwargs):
        save(figure, path, **kwargs)
        figures.append(figure)

    monkeypatch.setattr(Figure, "savefig", savefig)
    yield figures
    assert figures
    every = [axes for figure in figures for axes in figure.axes if axes.axison]
    assert all(has_name(axes, which) for axes in every for which in "xy")
