"""A stored result is used again only if all that made it is the same."""

import importlib.util
import json
import re
import sys
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import optax
import pytest
from model import CONFIG, ROBOT
from pretend import instead

from hector_jax.control.contact import InputConstraint, Rows
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.parameters import TUNABLES, Tunable
from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.core import environment, identity
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError
from hector_jax.qp import INTERIOR_POINT, QpConfig, Solver
from hector_jax.robot.description import TuningSettings
from hector_jax.search.cmaes import SearchConfig
from hector_jax.sim.engine import ENGINES, MUJOCO_C
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.store.cache import content_key, robot_hash
from hector_jax.store.nets import CollectConfig, collection_settings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import tune_config
from hector_jax.tuning.loss import PAPER_LOSS, LossTerm
from hector_jax.tuning.rollout import Scenario, with_variation
from hector_jax.verdict import judging
from hector_jax.walk_tuning import searches, walks
from hector_jax.walk_tuning.campaign import Campaign

key = partial(content_key, code=())


def robot_with(**settings):
    description = replace(ROBOT.description, tuning=TuningSettings(**settings))
    return ROBOT._replace(description=description)


@pytest.mark.parametrize("setting", [{"delay": 0.005}, {"estimate_noise": 1.0}])
def test_noise_and_delay_of_a_tuning_are_in_its_settings_and_keys(setting):
    noisy = robot_with(**setting)
    one, other = tune_config(ROBOT), tune_config(noisy)
    scenario = Scenario(ROBOT, None, None, None)
    assert with_variation(one.rollout, scenario).variation is None
    assert with_variation(other.rollout, scenario).variation is not None
    assert key(one) != key(other)
    assert robot_hash(ROBOT) != robot_hash(noisy)
    config = CollectConfig(engine="c")
    paths = [collection_settings(config, robot)["paths"] for robot in (ROBOT, noisy)]
    assert paths[0] != paths[1]


def test_the_plants_of_the_choice_are_in_no_key():
    assert robot_hash(robot_with(choice_plants=4)) == robot_hash(ROBOT)


# Functions of the user


def module(tmp_path, text, name="mine"):
    """A module of the user, loaded anew."""
    path = tmp_path / f"{name}.py"
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


AROUND = {
    "vmap": "def h(x): return K * x\nf = jax.vmap(h)",
    "checkpoint": "def h(x): return K * x\nf = jax.checkpoint(h)",
    "value_and_grad": "def h(x): return K * x\nf = jax.value_and_grad(h)",
    "jit of vmap": "def h(x): return K * x\nf = jax.jit(jax.vmap(h))",
    "used inside": "@jax.jit\ndef h(x): return K * x\ndef f(x): return jax.vmap(h)(x)",
    "optax": "s = optax.linear_schedule(K, 0.0, 10)\ndef f(x): return s(x)",
    "np.vectorize": "def h(x): return K * x\nf = np.vectorize(h)",
    "base class": "class B:\n    k = K\nclass C(B):\n    def __call__(self, x): return x\nf = C()",
    "NamedTuple": "class N(NamedTuple):\n    a: float\nn = N(K)\ndef f(x): return n.a * x",
    "slots": "class S:\n    __slots__ = 'a'\ns = S()\ns.a = K\ndef f(x): return s.a * x",
    "property": "class C:\n    k = property(lambda self: K)\nc = C()\ndef f(x): return c.k * x",
    "range": "r = range(int(K))\ndef f(x): return len(r) * x",
    "path": "p = Path(str(K))\ndef f(x): return p",
    "other name": "a, b = np.sin, np.cos\nc = a if K < 2.5 else b\ndef f(x): return c(x)",
}
VALUES = {
    "jit": "jax.jit(lambda x: K * x)",
    "jax array": "jnp.array(K)",
    "dictionary": "{'k': K}",
    "list": "[K]",
    "nested list": "[[K], 2.0] if K < 2.5 else [[2.0, 2.0]]",
    "deque": "deque([K])",
    "dataclass": "D(K)",
    "partial": "functools.partial(pow, K)",
    "closure": "(lambda k: lambda x: k * x)(K)",
}
IMPORTS = """
import functools
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
import jax, optax, jax.numpy as jnp, numpy as np
@dataclass
class D:
    k: float
"""


BEHIND = {**AROUND, **{name: f"f = {value}" for name, value in VALUES.items()}}


@pytest.mark.parametrize("text", BEHIND.values(), ids=BEHIND)
def test_what_a_module_of_the_user_holds_is_of_the_content(tmp_path, monkeypatch, text):
    def made(k):
        of_k = re.sub(r"\bK\b", str(k), text)
        monkeypatch.setitem(sys.modules, "other", module(tmp_path, IMPORTS + of_k))
        return function_id(module(tmp_path, "import other\ndef f(x): return other.f").f)

    assert made(2.0) == made(2.0) != made(3.0)


MINE = Tunable("mpc.max_force", 0.0, 800.0)


def with_mine(weights):
    return weights._replace(others={"mine": 500.0})


@pytest.mark.parametrize("changed", [{"path": "mpc.friction"}, {"lower": 0.1}, {"upper": 900.0}])
def test_a_number_of_the_user_that_is_tuned_is_in_the_keys(monkeypatch, changed):
    def keys(tunable):
        monkeypatch.setitem(TUNABLES, "mine", tunable)
        job = Job(with_mine(nominal()), named_command("s"), hfs())
        return list(map(key, (tunings_of("mine"), with_mine(nominal()), job, tunings_of())))

    def tunings_of(*others):
        return replace(CONFIG, others=others)

    before, again, after = keys(MINE), keys(MINE), keys(MINE._replace(**changed))
    assert before == again
    assert [x == y for x, y in zip(before, after, strict=True)] == [False, False, False, True]


INSTALLED = (np.linalg.norm, optax.linear_schedule, lambda x: optax.linear_schedule(x, 0.0, 1))


@pytest.mark.parametrize("function", INSTALLED)
def test_another_version_of_an_installed_package_makes_another_function(monkeypatch, function):
    def at(version):
        monkeypatch.setattr(identity, "version", lambda name: f"{version} of {name}")
        monkeypatch.setattr(identity, "_versions", versions.__wrapped__)  # not cached
        return function_id(function)

    versions = identity._versions
    assert at(1) == at(1) != at(2)


def walk_alone(pool, config, robot, jobs, **options):
    raise NotImplementedError


def walk_otherwise(pool, config, robot, jobs, **options):
    raise NotImplementedError("otherwise")


walk_otherwise.__name__ = walk_otherwise.__qualname__ = "walk_alone"


def test_parts_whose_body_changed_have_other_keys():
    def term(walk):
        return 2.0 * jnp.sum(walk.residual)

    def other(walk):
        return 3.0 * jnp.sum(walk.residual)

    def rows(contact):
        return Rows(contact.moment[2:], -2.0, 2.0)

    def other_rows(contact):
        return Rows(contact.moment[2:], -1.0, 1.0)

    def short(*inputs, max_iterations):
        return INTERIOR_POINT.approach(*inputs, max_iterations=3)

    def shorter(*inputs, max_iterations):
        return INTERIOR_POINT.approach(*inputs, max_iterations=2)

    for one, two in ((term, other), (rows, other_rows), (short, shorter)):
        two.__qualname__ = one.__qualname__  # as if its body was edited
    losses = [(*PAPER_LOSS, LossTerm("L_mine", "", 1.0, f)) for f in (term, other)]
    assert key(replace(CONFIG, loss=losses[0])) != key(replace(CONFIG, loss=losses[1]))
    constraints = MpcConfig().constraints
    mpcs = [
        MpcConfig(constraints=(*constraints, InputConstraint("a", of=f)))
        for f in (rows, other_rows)
    ]
    assert key(mpcs[0]) != key(mpcs[1])
    solvers = [QpConfig(solver=Solver("a", approach=f, guess=None)) for f in (short, shorter)]
    assert key(solvers[0]) != key(solvers[1])
    engines = [MUJOCO_C._replace(walk=walk) for walk in (walk_alone, walk_otherwise)]
    job = Job(nominal(), named_command("s"), hfs())
    names = {
        judging._file_name(Setup(Executor(), CONFIG, ROBOT), ("a", 0), job, False, engine)
        for engine in engines
    }
    assert len(names) == 2


# Journals and collections


def search(folder, engine, monkeypatch):
    losses = lambda setup, sets, **_: {name: np.arange(4.0) for name in sets}  # noqa: E731
    instead(monkeypatch, searches, "losses_on_hfs", losses)
    config = SearchConfig(budget=4, population=4)
    commands = {"s": named_command("s")}
    setup = Setup(Executor(), CONFIG, ROBOT)
    options = {"commands": commands, "engine": engine, "folder": folder}
    return searches.search_all(setup, config, nominal(), **options)


def journal(folder, engine, monkeypatch):
    inputs = folder, CONFIG, ROBOT, nominal(), {"s": named_command("s")}, [hfs()]
    return walks.read_history(Campaign(*inputs, engine=engine))


@pytest.fixture(params=[search, journal])
def record(request, tmp_path, monkeypatch):
    """A record that a search or a tuning on walks began; what continues it with an engine."""
    folder = tmp_path / "record"
    begin = partial(request.param, folder, monkeypatch=monkeypatch)
    begin(MUJOCO_C)
    files = {path: path.read_bytes() for path in folder.rglob("*.jsonl")}
    yield begin
    assert {path: path.read_bytes() for path in files} == files


def test_a_record_goes_on_with_the_same_engine_and_code_only(record, monkeypatch):
    record(MUJOCO_C)
    with pytest.raises(InputError, match="its engine is c .*, expected other"):
        record(MUJOCO_C._replace(name="other"))
    with pytest.raises(InputError, match="its engine is c .*, expected c "):
        record(MUJOCO_C._replace(walk=walk_alone))
    for file in (searches, walks):
        monkeypatch.setattr(file, "code_hash", lambda *modules: "another")
    with pytest.raises(
        InputError, match="record of another .*: by other code or other versions of"
    ):
        record(MUJOCO_C)


# Code and packages


@pytest.fixture
def version_of(monkeypatch):
    """Pretends another version of a package."""
    installed = environment.version

    def pretend(package):
        other = lambda name: "0.0.1" if name == package else installed(name)  # noqa: E731
        monkeypatch.setattr(environment, "version", other)
        environment.code_hash.cache_clear()

    environment.code_hash.cache_clear()
    yield pretend
    monkeypatch.undo()
    environment.code_hash.cache_clear()


@pytest.mark.parametrize(
    ("modules", "packages"),
    [
        (("grfm.training",), ("flax", "optax", "jax", "jaxlib", "numpy")),
        (("tuning.difftune",), ("optax", "jaxopt", "scipy")),
        (("walk_tuning.searches", "sim.walk"), ("cmaes", "mujoco")),
        (("walk_tuning.walks",), ("cmaes", "tinygp", "scipy")),
        (ENGINES["mjx"].modules, ("mujoco-mjx",)),
        (ENGINES["drake"].modules, ("drake",)),
        (ENGINES["pinocchio"].modules, ("pin",)),
    ],
)
def test_the_code_of_a_result_has_the_versions_of_all_packages_that_compute(
    version_of, modules, packages
):
    before = environment.code_hash(*modules)
    for package in packages:
        if importlib.util.find_spec({"pin": "pinocchio", "drake": "pydrake"}.get(package, "jax")):
            version_of(package)
            assert environment.code_hash(*modules) != before, package
    version_of("msgspec")
    assert environment.code_hash(*modules) == before


TEXT = """
import functools
import jax
import numpy as np

GAIN = {gain}
TABLE = np.array([1.0, {entry}])

class Scale:
    def __call__(self, x):
        return {scale} * x

def helper(x):
    return {inner} * x

def made(factor):
    return lambda walk: factor * walk.period

@jax.jit
def term(walk, power={power}):
    # {comment}
    return Scale()(helper(GAIN * walk.period ** power)) + TABLE[1]

closure = made({closure})
bound = functools.partial(helper, {bound})
"""


SAME = dict(gain=2.0, entry=3.0, scale=4.0, inner=5.0, power=1, closure=6.0, bound=7.0, comment="a")


@pytest.mark.parametrize("changed", ["gain", "entry", "scale", "inner", "power"])
def test_a_function_that_computes_something_else_is_another_one(tmp_path, changed):
    before = module(tmp_path, TEXT.format(**SAME))
    again = module(tmp_path, TEXT.format(**SAME | {"comment": "another"}))
    after = module(tmp_path, TEXT.format(**SAME | {changed: 9}))
    assert function_id(before.term) == function_id(again.term) != function_id(after.term)
    assert function_id(before.closure) == function_id(after.closure)


@pytest.mark.parametrize("name", ["closure", "bound"])
def test_values_that_a_function_holds_are_of_its_content(tmp_path, name):
    one, other = (module(tmp_path, TEXT.format(**SAME | {name: x})) for x in (6.0, 8.0))
    assert function_id(getattr(one, name)) != function_id(getattr(other, name))
    assert function_id(one.made) == function_id(other.made)


@pytest.mark.parametrize("text", AROUND.values(), ids=AROUND)
def test_a_function_of_the_user_is_seen_through_what_holds_it(tmp_path, text):
    ids = [function_id(module(tmp_path, f"{IMPORTS}K = {k}\n{text}\n").f) for k in (2.0, 2.0, 3.0)]
    assert ids[0] == ids[1] != ids[2]


def test_walks_of_two_engines_are_two_collections():
    settings = {
        name: collection_settings(CollectConfig(engine=name), ROBOT)
        for name in ("c", "mjx", "auto")
    }
    assert settings["c"] != settings["mjx"]
    assert settings["auto"] == settings["c"]  # on a CPU
    assert json.loads(json.dumps(settings)) == settings
