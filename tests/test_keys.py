"""A stored result is used again only if all that made it is the same."""

import re
import sys
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType

import numpy as np
import optax
import pytest
from model import CONFIG, ROBOT, robot_with

from hector_jax.control.contact import InputConstraint, Rows
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.parameters import TUNABLES, Tunable
from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.core import environment, identity
from hector_jax.core.environment import code_hash
from hector_jax.core.identity import function_id
from hector_jax.qp import INTERIOR_POINT, QpConfig, Solver
from hector_jax.sim.engine import ENGINES, MUJOCO_C
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.store.cache import content_key
from hector_jax.store.nets import CollectConfig, collection_settings
from hector_jax.store.tunings import tune_config
from hector_jax.tuning.loss import PAPER_LOSS, LossTerm

key = partial(content_key, code=())
JOB = Job(nominal(), named_command("s"), hfs())


def loss_with(k):
    term = LossTerm("L_mine", "", 1.0, lambda walk: k * walk.residual)
    return replace(CONFIG, loss=(*PAPER_LOSS, term))


def constrained(k):
    mine = InputConstraint("a", of=lambda contact: Rows(contact.moment[2:], -1.0, float(k)))
    return MpcConfig(constraints=(*MpcConfig().constraints, mine))


def solved(k):
    def short(*inputs, max_iterations):
        return INTERIOR_POINT.approach(*inputs, max_iterations=k)

    return QpConfig(solver=Solver("a", approach=short, guess=None))


def collected(k=0, robot=ROBOT, engine="c"):
    return collection_settings(CollectConfig(seed=k, engine=engine), robot)


DEPENDS_ON = {
    "mass": lambda k: ROBOT._replace(mass=np.asarray(12.0 + k)),
    "TOML of the robot": lambda k: robot_with(estimate_noise=float(k)),
    "noise of a tuning": lambda k: tune_config(robot_with(estimate_noise=float(k))),
    "delay of a tuning": lambda k: tune_config(robot_with(delay=0.005 * k)),
    "rule": lambda k: replace(CONFIG, rule=("relative", "literal")[k]),
    "loss": loss_with,
    "constraint": constrained,
    "solver": solved,
    "weights": lambda k: nominal()._replace(others={"kp": np.full(5, 10.0 + k)}),
    "command": lambda k: JOB._replace(command=named_command("cs"[k])),
    "plant": lambda k: JOB._replace(imperfections=hfs()._replace(backlash=np.asarray(0.01 * k))),
    "seed of a walk": lambda k: JOB._replace(seed=k),
    "engine": lambda k: MUJOCO_C._replace(walk=lambda *inputs, **options: k).key,
    "seed of a collection": collected,
    "engine of a collection": lambda k: collected(engine=("c", "mjx")[k]),
}


@pytest.mark.parametrize("made", DEPENDS_ON.values(), ids=DEPENDS_ON)
def test_a_key_changes_with_what_the_result_depends_on(made):
    assert key(made(0)) == key(made(0)) != key(made(1))


def test_a_number_of_the_user_that_is_tuned_is_in_the_keys(monkeypatch):
    weights, mine = nominal()._replace(others={"mine": 500.0}), Tunable("mpc.max_force", 0.0, 800.0)

    def keys(**changed):
        monkeypatch.setitem(TUNABLES, "mine", mine._replace(**changed))
        tuned = replace(CONFIG, others=("mine",))
        return {*map(key, (tuned, weights, JOB._replace(weights=weights)))}

    assert keys() == keys()
    each = keys(), keys(path="mpc.friction"), keys(lower=0.1), keys(upper=900.0)
    assert len(set.union(*each)) == 12


# Functions of the user


SEEN = {
    "default": "def f(x, k=K): return k * x",
    "global": "k = K\ndef f(x): return k * x",
    "method": "class C:\n    def __call__(self, x): return K * x\ndef f(x): return C()(x)",
    "array": "a = np.array([1.0, K])\ndef f(x): return a * x",
    "vmap": "def h(x): return K * x\nf = jax.vmap(h)",
    "optax": "s = optax.linear_schedule(K, 0.0, 10)\ndef f(x): return s(x)",
    "base class": "class B:\n    k = K\nclass C(B):\n    def __call__(self, x): return x\nf = C()",
    "NamedTuple": "class N(NamedTuple):\n    a: float\nn = N(K)\ndef f(x): return n.a * x",
    "slots": "class S:\n    __slots__ = 'a'\ns = S()\ns.a = K\ndef f(x): return s.a * x",
    "property": "class C:\n    k = property(lambda self: K)\nc = C()\ndef f(x): return c.k * x",
    "other name": "a, b = np.sin, np.cos\nc = a if K < 2.5 else b\ndef f(x): return c(x)",
    "jit": "f = jax.jit(lambda x: K * x)",
    "dictionary": "f = {'k': K}",
    "nested list": "f = [[K], 2.0] if K < 2.5 else [[2.0, 2.0]]",
    "dataclass": "@dataclass\nclass D:\n    k: float\nf = D(K)",
    "partial": "f = functools.partial(pow, K)",
    "closure": "f = (lambda k: lambda x: k * x)(K)",
}
NOT_SEEN = {
    "comment": "def f(x): return x  # K",
    "docstring": "def f(x):\n    'K'\n    return x",
    "value of no use": "k = K\ndef f(x): return x",
}
IMPORTS = """
import functools
from dataclasses import dataclass
from typing import NamedTuple
import jax, optax, jax.numpy as jnp, numpy as np
"""


def module(patch, name, text):
    """A module of the user, loaded anew."""
    made = ModuleType(name)
    patch.setitem(sys.modules, name, made)
    exec(text, vars(made))
    return made


@pytest.mark.parametrize("name", [*SEEN, *NOT_SEEN])
def test_what_a_function_of_the_user_computes_is_of_its_content(monkeypatch, name):
    """In its own module, and where it is used from another one."""

    def made(k):
        text = IMPORTS + re.sub(r"\bK\b", str(k), (SEEN | NOT_SEEN)[name])
        other = module(monkeypatch, "other", text)
        user = module(monkeypatch, "mine", "import other\ndef f(x): return other.f")
        return [function_id(f) for f in (other.f, user.f) if callable(f)]

    one, again, two = made(2.0), made(2.0), made(3.0)
    assert one == again
    assert [x == y for x, y in zip(one, two, strict=True)] == len(one) * [name in NOT_SEEN]


# Code and packages


@pytest.fixture
def see(monkeypatch):
    """Changes what hashes of code and functions see."""

    def put(name=None, fake=None):
        for module in (environment, identity):
            if hasattr(module, name or ""):
                monkeypatch.setattr(module, name, fake)
        code_hash.cache_clear()
        for found in (identity._versions, identity._distributions, identity._is_installed):
            found.cache_clear()

    yield put
    monkeypatch.undo()
    put()


def test_a_key_has_the_versions_of_all_packages_that_compute(see):
    modules = ["grfm.training", "walk_tuning.walks", "sim.walk"]
    modules += [module for engine in ENGINES.values() for module in engine.modules]
    keys = {
        partial(code_hash, ("tuning.difftune",)): "jax jaxlib jaxopt numpy optax scipy",
        partial(code_hash, tuple(modules)): "flax mujoco mujoco-mjx drake pin",
        partial(function_id, optax.linear_schedule): "optax",
        partial(function_id, lambda x: optax.linear_schedule(x, 0.0, 1)): "optax",
        partial(function_id, np.linalg.norm): "numpy",
    }
    for key, packages in keys.items():
        before = key()
        for package in (*packages.split(), "msgspec"):
            see("version", lambda name, other=package: "0" if name == other else version(name))
            assert (key() != before) == (package != "msgspec"), package


def test_code_that_pip_put_into_any_folder_is_that_of_a_package(see, tmp_path, monkeypatch):
    """By --target or on PYTHONPATH; not a user's file there, nor what is installed to be edited."""

    def keys(k, number):
        (tmp_path / "pack.dist-info" / "METADATA").write_text(f"Name: pack\nVersion: {number}\n")
        (tmp_path / "pack.dist-info" / "top_level.txt").write_text("pack\nedited\n")
        made = []
        for folder, name in (("", "pack"), ("", "mine"), ("src", "edited")):
            path = tmp_path / folder / f"{name}.py"
            path.write_text(f"def f(x): return {k} * x")
            monkeypatch.delitem(sys.modules, name, raising=False)
            spec = spec_from_file_location(name, path)
            monkeypatch.setitem(sys.modules, name, module_from_spec(spec))
            exec(path.read_text(), vars(sys.modules[name]))
            made.append(function_id(sys.modules[name].f))
        return made

    for folder in ("pack.dist-info", "src"):
        (tmp_path / folder).mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    see()
    before, code = keys(2.0, 1), keys(3.0, 1)
    see()
    package = keys(2.0, 2)
    assert [x == y for x, y in zip(before, code, strict=True)] == [True, False, False]
    assert before[0] != package[0]


@pytest.mark.parametrize(
    ("module", "old", "new", "same"),
    [
        ("control.footstep", "config.ahead * stance", "config.travel * stance", False),
        ("control.footstep", "    points = (", "    # a comment\n    points = (", True),
        ("control.footstep", "Next touchdown of each foot", "Another docstring", True),
        ("core.numerics", "threadpool_limits(1,", "threadpool_limits(4,", False),
        ("core.console", "_QUIET = 15.0", "_QUIET = 16.0", True),
        ("export.export", "TOLERANCE = 1e-6", "TOLERANCE = 1e-7", True),
    ],
)
def test_a_result_holds_for_the_code_that_computes_it(see, tmp_path, module, old, new, same):
    source, edited = environment._source, tmp_path / "edited.py"
    text = source(module).read_text()
    assert old in text
    edited.write_text(text.replace(old, new))
    hashes = lambda: [code_hash(x) for x in (("sim.walk",), ("tuning.difftune", "grfm.network"))]  # noqa: E731
    before = hashes()
    see("_source", lambda name: edited if name == module else source(name))
    assert [x == y for x, y in zip(before, hashes(), strict=True)] == [same, same]
