"""What depends on the size of a robot: its plants, the weights of its loss, what a fall costs."""

from dataclasses import replace

import numpy as np
import pytest
from pretend import pretend_walk

from hector_jax.core.settings import from_table, to_table
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.robot.description import Description, PlantSizes, read_description
from hector_jax.robot.model import load_robot
from hector_jax.sim.standin import standin
from hector_jax.sim.world import WORLDS, hfs_drawn, named_world
from hector_jax.tuning.loss import PAPER_LOSS, losses

SIZES = PlantSizes(joint_friction=3.0, joint_damping=2.0, push=5.0, trunk_com=1.5, payload=4.0)
LARGE = Description(plants=SIZES)


def described(folder, text):
    path = folder / "robot.toml"
    path.write_text(f'model = "hector.xml"\n{text}')
    return path


def exactly(plant):
    flat = plant._asdict() | {f"estimator.{k}": v for k, v in plant.estimator._asdict().items()}
    del flat["estimator"]
    return {name: [float(x).hex() for x in np.ravel(value)] for name, value in flat.items()}


def factories(description):
    yield from (named_world(name, 2, description) for name in WORLDS)
    yield hfs_drawn(3, description=description)
    yield standin(1, description)


def test_plants_and_pushes_of_the_data_have_the_sizes_of_the_robot():
    for ours, theirs in zip(factories(LARGE), factories(Description()), strict=True):
        np.testing.assert_allclose(ours.joint_friction, 3.0 * theirs.joint_friction)
        np.testing.assert_allclose(ours.joint_damping, 2.0 * theirs.joint_damping)
        np.testing.assert_allclose(ours.trunk_com, 1.5 * theirs.trunk_com)
        named = {"joint_friction": 0, "joint_damping": 0, "trunk_com": 0}
        assert exactly(ours) | named == exactly(theirs) | named  # and nothing else
    robot = load_robot()
    large = robot._replace(description=replace(robot.description, plants=SIZES))
    ours, theirs = draw_jobs(0, 12, robot=large), draw_jobs(0, 12)
    assert any(np.any(job.push.force) for job in theirs)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one.push.force, 5.0 * other.push.force)
        friction = other.imperfections.joint_friction
        np.testing.assert_allclose(one.imperfections.joint_friction, 3.0 * friction)


def test_sizes_and_loss_are_sections_of_the_robots_file(tmp_path):
    path = described(tmp_path, "[plants]\npush = 4\njoint_friction = 2.5\n[loss]\nL_ctrl = 0.05")
    description = read_description(path)
    assert description.plants == PlantSizes(push=4.0, joint_friction=2.5)
    assert description.loss == (("L_ctrl", 0.05),)
    assert hash(description) != hash(Description())  # static under jit
    assert from_table("here", Description, to_table(description)) == description  # as in a dump
    plain = read_description(described(tmp_path, ""))
    assert (plain.plants, plain.loss) == (PlantSizes(), ())


def test_a_fall_from_higher_up_costs_more():
    walk = pretend_walk(error=0.0, seconds=1.0)
    for height in (1.0, 2.0):
        reference = walk.reference._replace(position=walk.reference.position * [1, 1, height])
        fallen = walk._replace(fallen=np.ones_like(walk.fallen), reference=reference)
        found = float(losses(PAPER_LOSS, fallen)["L_pos"])
        assert found == pytest.approx(1000 * (0.5 * height) ** 2)
