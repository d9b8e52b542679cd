"""Another model of the robot as the plant: the controller keeps its own numbers."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pretend import instead, pretend_walk

from hector_jax.cli import arguments
from hector_jax.cli.main import main
from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.inputs import InputError
from hector_jax.robot.description import PlantSizes
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.parallel import walk_batch
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs, ideal
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging

EXAMPLES = Path(__file__).parents[1] / "examples"
ARMS, STRIDER = EXAMPLES / "hector-v2" / "arms.toml", EXAMPLES / "strider" / "robot.toml"
STRAIGHT, CONFIG, ROBOT = named_command("straight"), WalkConfig(), load_robot()


@pytest.fixture(scope="module")
def arms():
    return load_robot(ARMS)


def call(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["hector", *map(str, words)])
    return main()


def test_the_world_is_the_plants_model_and_it_stands_in_its_own_pose(arms):
    # bent more, and lower, than the robot of the controller
    plant = arms._replace(
        standing_joints=ROBOT.standing_joints + 0.01, trunk_height=ROBOT.trunk_height - 0.002
    )
    seen = []

    def look(world, data):
        if not seen:
            seen.append((world.model.body_mass.sum(), data.qpos[world.joint_qpos], data.qpos[2]))

    job = Job(expert(), STRAIGHT, ideal(), 0.01, plant=plant)
    walked = walk(CONFIG, ROBOT, job, build=partial(MujocoPlant, on_step=look))
    ((mass, joints, height),) = seen
    assert mass == pytest.approx(float(arms.mass), rel=1e-6)
    assert mass > 1.15 * ROBOT.mass
    np.testing.assert_allclose(joints, plant.standing_joints, atol=2e-3)
    assert height == pytest.approx(float(plant.trunk_height), abs=1e-3)
    assert not walked.fallen.any()


@pytest.mark.slow
def test_both_engines_walk_the_plant_alike():
    plant = load_robot(ARMS.with_name("robot.toml"))
    job = Job(expert(), STRAIGHT, ideal(), 0.2, plant=plant)
    (batched,) = walk_batch(CONFIG, ROBOT, [job], fine=True)
    alone = walk(CONFIG, ROBOT, job)
    np.testing.assert_allclose(batched.state.position, alone.state.position, atol=1e-3)


@pytest.mark.parametrize("engine", [walk, lambda *known: walk_batch(*known[:2], [known[2]])])
def test_a_plant_of_other_joints_is_refused(engine):
    job = Job(expert(), STRAIGHT, ideal(), 0.1, plant=load_robot(STRIDER))
    message = (
        "robot.toml: joints are left_yaw, .* as a plant of .*hector.toml expected left_hip_yaw"
    )
    with pytest.raises(InputError, match=message):
        engine(CONFIG, ROBOT, job)


def test_scores_of_another_plant_are_others(monkeypatch, tmp_path, arms):
    instead(
        monkeypatch,
        judging,
        "walk_jobs",
        lambda *known: (pretend_walk(job.seed) for job in known[1]),
    )
    known = {"nominal": nominal()}, STRAIGHT, [hfs()], [0]
    # another file with the very same numbers
    renamed = arms._replace(description=replace(arms.description, name="other"))
    with ThreadPoolExecutor(1) as pool:
        for plant in (None, arms, arms, renamed):
            setup = Setup(pool, TuneConfig(), ROBOT)
            judging.judge(setup, *known, title="", folder=tmp_path, plant=plant)
    assert len(list(tmp_path.glob("*.npz"))) == 3


def test_a_plant_has_its_own_sizes(monkeypatch, arms):
    sizes = replace(arms.description, plants=PlantSizes(joint_friction=2.0))
    plant = arms._replace(description=sizes)
    args = arguments.Walk()
    job = arguments.job_of(
        args, ROBOT, arguments.load_trajectory("straight", ROBOT), nominal(), plant
    )
    assert job.imperfections.joint_friction == 2.0 * hfs().joint_friction


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["walk", "--plant", ARMS, "--world", "srbm"], "--plant needs a world of MuJoCo"),
        (["walk", "--plant", STRIDER], "as a plant of"),
    ],
)
def test_what_cannot_be_a_plant_is_one_line(monkeypatch, capsys, words, message):
    assert call(monkeypatch, *words) == 2
    said = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("hector:") for line in said) == 1
    assert message in said[-1]
