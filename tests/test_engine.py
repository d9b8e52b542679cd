"""Engines as values: what is chosen once and passed down, and how one is added."""

import json
import sys
from types import SimpleNamespace

import jax
import pytest
from model import EXAMPLES
from pretend import call

from hector_jax import InputError, RolloutConfig, Scenario, last_command, rollout, standing_anchor
from hector_jax.report import pictures
from hector_jax.sim.engine import ENGINES, MJX, MUJOCO_C, Engine, choose_engine

ARMS = EXAMPLES / "hector-v2" / "arms.toml"


def walk_rigid(pool, config, robot, jobs, *, exact=True, batch=0):
    """The plain single rigid body as an engine: it knows no plant, and samples once per tick."""
    walked = jax.jit(rollout, static_argnums=0)
    for job in jobs:
        rollout_config = RolloutConfig(config, ticks=round(job.seconds / config.gait.tick))
        anchor = standing_anchor(robot, job.start_tick)
        scenario = Scenario(robot, job.command, anchor, last_command)
        yield jax.device_get(walked(rollout_config, scenario, job.weights))


def test_auto_is_mjx_where_there_is_an_accelerator(monkeypatch):
    assert choose_engine("c") is MUJOCO_C
    assert choose_engine("mjx") is MJX
    for backend, engine, bits in (("cpu", MUJOCO_C, 64), ("gpu", MJX, 32)):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert choose_engine("auto") is engine
        assert (engine.bits(False), engine.bits(True)) == (bits, 64)


def test_an_engine_that_is_not_installed_or_of_other_people_is_named_with_the_remedy(monkeypatch):
    monkeypatch.setitem(ENGINES, "drake", ENGINES["drake"]._replace(package="no-such-package"))
    with pytest.raises(InputError, match=r"no-such-package, .*: pip install -e '.\[drake\]'"):
        choose_engine("drake")
    for name in ("pinocchio", "coal"):
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(__file__="other.py"))
    monkeypatch.delitem(sys.modules, "hector_jax.sim.pinocchio", raising=False)
    monkeypatch.setitem(ENGINES, "pinocchio", ENGINES["pinocchio"]._replace(package="mujoco"))
    with pytest.raises(InputError, match=r"pin>=4.1'\) is expected, other.py is another"):
        choose_engine("pinocchio")


def test_the_film_of_a_walk_shows_the_plant_that_walked(monkeypatch, capsys, tmp_path):
    filmed = []
    monkeypatch.setattr(pictures, "film", lambda path, robot, walks: filmed.append(robot))
    for flags in ([], ["--plant", str(ARMS)]):
        words = ("walk", "--world", "ideal", "--seconds", "0.1", "--video", tmp_path / "film.mp4")
        assert call(monkeypatch, *words, *flags) == 0
    assert [robot.description.name for robot in filmed] == ["hector", "hector-v2-arms"]


def test_a_walk_and_an_evaluation_take_an_engine_that_was_added(monkeypatch, capsys):
    monkeypatch.setitem(ENGINES, "mjx", Engine("mjx", "rigid body", walk_rigid, lambda exact: 64))
    flags = ["--engine", "mjx", "--seconds", "0.5", "--json"]
    for words in (["walk", "--world", "ideal"], ["evaluate", "--world", "hfs"]):
        assert call(monkeypatch, *words, "--weights", "nominal", *flags) == 0
        told = json.loads(capsys.readouterr().out)
        assert told.get("columns", [told])[0]["engine"] == "mjx"
