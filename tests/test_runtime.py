"""The set-up of a process: where the cache lies, who turns on 64 bits, what a worker is."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.control.reference import named_command
from hector_jax.control.trajectories import command_of
from hector_jax.control.weights import nominal
from hector_jax.core import runtime
from hector_jax.core.numerics import without_our_flag, without_ynnpack
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk_many
from hector_jax.sim.world import hfs
from hector_jax.store import tunings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.rollout import RolloutConfig


def test_the_cache_lies_in_the_users_cache_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = runtime.cache_folder()
    assert folder.is_dir()
    assert folder.is_relative_to(tmp_path)
    assert not any(folder.iterdir())  # the probe is gone


def test_importing_the_library_leaves_jax_alone_and_computes_nothing():
    told = (
        "import jax, hector_jax.tuning.difftune, hector_jax.core.runtime\n"
        "from jax._src import xla_bridge\n"
        "print(jax.config.jax_enable_x64, jax.config.jax_compilation_cache_dir,"
        " xla_bridge.backends_are_initialized())"
    )
    root = Path(runtime.__file__).parents[1]
    ran = subprocess.run(
        [sys.executable, "-c", told], cwd=root, capture_output=True, text=True, check=True
    )
    assert ran.stdout.split() == ["False", "None", "False"]
    assert ran.stderr == ""


def test_a_worker_computes_in_64_bits():
    with runtime.workers(1) as pool:
        assert pool.submit(jnp.zeros, 3).result(timeout=60).dtype == jnp.float64


def test_a_worker_draws_what_its_parent_draws(monkeypatch):
    monkeypatch.setenv("JAX_RANDOM_SEED_OFFSET", "1")
    monkeypatch.setenv("JAX_DEFAULT_PRNG_IMPL", "rbg")
    with runtime.workers(1) as pool:
        drawn = pool.submit(jax.random.PRNGKey, 3).result(timeout=60)
    np.testing.assert_array_equal(drawn, jax.random.PRNGKey(3))


@pytest.mark.slow
def test_processes_load_the_programs_that_one_of_them_compiled(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    robot, config = load_robot(), TuneConfig(rollout=RolloutConfig(ticks=10), iterations=1)
    straight = command_of("straight")._replace(seconds=0.1)
    problems = {name: Problem((named_command(name),), None) for name in ("straight", "c")}
    with runtime.workers(2) as pool:
        setup = Setup(pool, config, robot)
        tunings.compile_programs(setup, nominal(), straight)
        tunings.tune_all(setup, problems, tmp_path / "tunings", title="")
        weights = config.rollout.walk.with_others(nominal(), ["friction"])
        jobs = [Job(weights, command, hfs(), 0.1) for (command,), *_ in problems.values()]
        list(walk_many(pool, config.rollout.walk, robot, jobs))
    programs = [path.name.split("-")[0] for path in (tmp_path / "hector_jax" / "jax").iterdir()]
    assert programs.count("jit_plan") == 2  # for all feet on the ground, and for one
    assert programs.count("jit_evaluate") == 1


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", "FLAG="),
        ("--xla_a=1 word", "FLAG= --xla_a=1 word"),
        ("FLAG=dot --xla_a=1", "FLAG=dot --xla_a=1"),
        ("flags.txt", "flags.txt"),
    ],
)
@pytest.mark.parametrize("version", [(0, 10, 1), (0, 10, 2), (0, 12, 0, 1), (0, 13, 0)])
def test_ynnpack_is_turned_off_where_the_flag_is_known(monkeypatch, version, before, after):
    flag = "--xla_cpu_experimental_ynn_fusion_type"
    before, after = (text.replace("FLAG", flag) for text in (before, after))
    monkeypatch.setattr("jaxlib.version.__version_info__", version)
    monkeypatch.setenv("XLA_FLAGS", before)
    without_ynnpack()
    known = (0, 10, 2) <= version < (0, 13)
    assert os.environ["XLA_FLAGS"] == (after if known else before)


@pytest.mark.parametrize(
    ("flags", "of_user"),
    [("FLAG= --xla_a=1 word", "--xla_a=1 word"), ("FLAG=dot word", "FLAG=dot word")],
)
def test_a_ynnpack_that_the_user_set_is_in_the_keys(flags, of_user):
    flags, of_user = (
        text.replace("FLAG", "--xla_cpu_experimental_ynn_fusion_type") for text in (flags, of_user)
    )
    assert without_our_flag(flags) == of_user
