"""Engines as values, and the others against MuJoCo C: masses, weight, nearly the same walk."""

import importlib
import json
import sys
from functools import cache
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import EXAMPLES, ROOT
from oracles import mass_matrix
from pretend import call

from hector_jax import PAPER_LOSS, Job, RolloutConfig, Scenario, last_command, rollout, walk
from hector_jax.control import expert, named_command, nominal, standing_anchor, walk_config
from hector_jax.control.weights_file import load_weights
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import ENGINES, MJX, MUJOCO_C, Engine, choose_engine
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.world import Push, build_world, hfs, ideal
from hector_jax.verdict.metrics import score
from hector_jax.view import pictures

HECTOR = load_robot()
CONFIG = walk_config(HECTOR)
WORLDS = {"ideal": ideal, "hfs": hfs}
FILES = [None, *(ROOT / "examples" / name / "robot.toml" for name in ("humanoid", "quadruped"))]


def job(imperfections, seconds=1.0, weights=None, **others):
    return Job(weights or expert(), named_command("s"), imperfections, seconds, **others)


@cache
def walked(build, plant):
    return walk(CONFIG, HECTOR, job(WORLDS[plant]()), build=build)


def mass_in_drake(plant, qpos):
    """Mass matrix in MuJoCo's order of joints; the trunk's velocities are those of the world."""
    hinges = sorted(plant.joints)
    order = [3, 4, 5, 0, 1, 2, *(plant.joints[dof].velocity_start() for dof in hinges)]
    plant.stand(qpos)
    return plant.plant.CalcMassMatrix(plant.context)[np.ix_(order, order)], False


def mass_in_pinocchio(plant, qpos):
    """The same; the trunk's velocities are those of its own frame."""
    import pinocchio

    plant.stand(qpos)
    upper = pinocchio.crba(plant.model, plant.data, plant.q)
    order = [*range(6), *plant.order]
    return (np.triu(upper) + np.triu(upper, 1).T)[np.ix_(order, order)], True


PARTS = {
    "drake": ("pydrake", "DrakePlant", mass_in_drake),
    "pinocchio": ("pinocchio", "PinocchioPlant", mass_in_pinocchio),
}


@pytest.fixture(params=PARTS)
def engine(request):
    package, plant, mass_matrix = PARTS[request.param]
    pytest.importorskip(package, reason=f"the extra {request.param} is not installed")
    Plant = getattr(importlib.import_module(f"hector_jax.sim.{request.param}"), plant)
    return SimpleNamespace(Plant=Plant, mass_matrix=mass_matrix)


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize(("backlash", "close"), [(0.0, 1e-12), (0.005, 1e-4)])
def test_the_mass_matrix_is_that_of_mujoco(engine, file, backlash, close):
    robot = load_robot(file)
    plant = hfs(robot.description)._replace(backlash=np.asarray(backlash))
    world, rng = build_world(plant, robot.description), np.random.default_rng(0)
    other = engine.Plant(job(plant), robot, 0, 1)
    model, data = world.model, mujoco.MjData(world.model)
    for _ in range(20):
        data.qpos[:] = rng.uniform(-1.0, 1.0, model.nq)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mj_forward(model, data)
        ours, turn, R = mass_matrix(model, data), np.eye(model.nv), np.zeros(9)
        mujoco.mju_quat2Mat(R, data.qpos[3:7])
        theirs, in_trunk = engine.mass_matrix(other, data.qpos)
        if in_trunk:
            turn[:3, :3] = R.reshape(3, 3)
        else:
            turn[3:6, 3:6] = R.reshape(3, 3).T
        np.testing.assert_allclose(theirs, turn.T @ ours @ turn, atol=close * np.abs(ours).max())


@pytest.mark.parametrize("plant", WORLDS)
def test_a_second_of_walking_is_nearly_that_of_mujoco(engine, plant):
    walks = [walked(one, plant) for one in (MujocoPlant, engine.Plant)]
    ours, theirs = (score(PAPER_LOSS, one) for one in walks)
    assert not theirs.fallen
    assert theirs.L == pytest.approx(ours.L, rel=0.25)
    carried = [np.asarray(one.effect.force)[:, :, 2].sum(axis=1).mean() for one in walks]
    assert carried[1] == pytest.approx(carried[0], rel=0.01)
    # moments are about the foot points, as in MuJoCo: a line foot carries little of them
    assert np.abs(walks[1].effect.moment).mean() < 2.0 * np.abs(walks[0].effect.moment).mean()


def test_a_walk_is_the_same_each_time_and_a_push_is_felt_as_in_mujoco(engine):
    push = Push(np.array([[0.0, 40.0, 0.0]]), np.zeros(1), np.full(1, 0.1))
    builds = (engine.Plant, engine.Plant, MujocoPlant)
    walks = [walk(CONFIG, HECTOR, job(hfs(), 0.2, push=push), build=build) for build in builds]
    jax.tree.map(np.testing.assert_array_equal, *walks[:2])
    here, _, there = (
        (pushed.state.velocity[100] - walked(build, "hfs").state.velocity[100])[1]
        for pushed, build in zip(walks, builds, strict=True)
    )
    assert here == pytest.approx(there, rel=0.1)


def test_an_engine_that_fails_says_so_and_stays_so(engine):
    plant = engine.Plant(job(ideal()), HECTOR, 0, 30)
    plant.step(np.zeros(10), np.zeros(3))
    assert not plant.broken
    for torque in (np.nan, 0.0):
        plant.step(np.full(10, torque), np.zeros(3))
        assert plant.broken
    assert len(plant.ground().force) == 3


@pytest.mark.slow
def test_four_sets_rank_as_in_mujoco(engine):
    files = (ROOT / "experiments" / "reports" / "best" / f"{n}.json" for n in ("without", "with"))
    sets = [nominal(), expert(), *map(load_weights, files)]
    ranks = []
    for build in (MujocoPlant, engine.Plant):
        walks = [walk(CONFIG, HECTOR, job(ideal(), 4.0, w), build=build) for w in sets]
        ranks.append(np.argsort([score(PAPER_LOSS, one).L for one in walks]))
    np.testing.assert_array_equal(*ranks)


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
