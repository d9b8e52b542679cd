"""Plants: what each imperfection does, who may be drawn how far from whom, and of what size."""

import os
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model import ROBOT
from pretend import pretend_walk
from test_walk import stand

from hector_jax import hfs, ideal
from hector_jax.core.settings import from_table, to_table
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.robot.description import HECTOR, Description, PlantSizes, read_description
from hector_jax.robot.model import load_robot, quiet_mujoco
from hector_jax.sim import world as worlds
from hector_jax.sim.actuators import init_actuators, step_actuators
from hector_jax.sim.standin import standin
from hector_jax.sim.world import Push, build_world, push_force, standing_qpos
from hector_jax.tuning.loss import PAPER_LOSS, losses

KNEE = 3


def hung_up(imperfections):
    """A plant hung high above the floor by a trunk of ten tonnes, gravity off."""
    world = build_world(imperfections)
    world.model.opt.gravity[:] = 0.0
    world.model.body_mass[1] = world.model.body_inertia[1] = 1e4
    data = mujoco.MjData(world.model)
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints, 2.0)
    return world, data


def knee_after(imperfections, torque=1.0, steps=20):
    """Travel [rad] of the left knee's motor under a constant torque."""
    world, data = hung_up(imperfections)
    data.ctrl[KNEE] = torque
    start = data.qpos.copy()
    mujoco.mj_step(world.model, data, steps)
    return (data.qpos - start)[world.joint_qpos[KNEE]]


def torques(imperfections, commands):
    """Joint torques (T, 10) for commands (T, 10)."""
    step = lambda motors, command: step_actuators(ROBOT, imperfections, motors, command)  # noqa: E731
    return np.asarray(jax.lax.scan(step, init_actuators(10), jnp.asarray(commands))[1])


def test_a_push_lasts_from_its_start_on_and_pushes_add_up():
    force = np.array([[10.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    push = Push(force, start=np.array([0.1, 0.15]), duration=np.array([0.1, 0.01]))
    felt = np.stack([push_force(push, jnp.array(step)) for step in range(-5, 300)])[:, :2]
    at = np.arange(-5, 300)
    np.testing.assert_array_equal(felt[:, 0], np.where((at >= 100) & (at < 200), 10.0, 0.0))
    np.testing.assert_array_equal(felt[:, 1], np.where((at >= 150) & (at < 160), 5.0, 0.0))
    assert not np.any(push_force(worlds.NO_PUSH, jnp.array(0)))


def test_backlash_adds_a_free_play_that_the_encoder_does_not_see():
    width = 0.02
    world, data = hung_up(ideal()._replace(backlash=np.array(width)))
    assert world.model.nv == 26
    for name in ROBOT.description.joints:
        joint = world.model.joint(f"{name}_backlash")
        assert (joint.stiffness[0], joint.frictionloss[0], joint.armature[0]) == (0.0, 0.0, 0.0)
        assert joint.damping[0] == 0.01
    data.ctrl[KNEE] = 1.0
    mujoco.mj_step(world.model, data, 60)
    slack = data.qpos[world.model.jnt_qposadr[world.slack]]
    assert abs(slack[KNEE]) == pytest.approx(width, rel=0.15)
    assert np.abs(slack).max() < 1.2 * width


def test_friction_holds_a_joint_and_damping_and_armature_slow_it_down():
    for name, value, torque, most in (
        ("joint_friction", 0.3, 0.2, 0.1),  # the solver lets it creep
        ("joint_damping", 2.0, 1.0, 0.9),
        ("armature", 3.0, 1.0, 0.9),
    ):
        plants = ideal(), ideal()._replace(**{name: np.array(value)})
        free, slow = (knee_after(plant, torque) for plant in plants)
        assert -0.1 < slow / free < most, name


def test_masses_trunk_and_floor_are_those_of_the_plant():
    shift = np.array([0.01, -0.005, 0.015])
    plain = build_world(ideal()).model
    heavy = build_world(ideal()._replace(mass=np.array(1.05), trunk_com=shift)).model
    assert heavy.body_mass.sum() == pytest.approx(1.05 * plain.body_mass.sum())
    np.testing.assert_allclose(heavy.body_inertia, 1.05 * plain.body_inertia)
    np.testing.assert_allclose(heavy.body_ipos[1] - plain.body_ipos[1], shift)
    np.testing.assert_allclose(heavy.body_subtreemass[0], 1.05 * plain.body_subtreemass[0])
    plant = ideal()._replace(contact_time=np.array(0.03), floor_friction=np.array(0.15))
    contact = stand(plant, steps=100)[1].contact
    assert len(contact.dist) == 4
    np.testing.assert_array_equal(contact.solref[:, 0], 0.03)
    np.testing.assert_array_equal(contact.friction[:, 0], 0.15)


@pytest.mark.parametrize("delay", [0.0, 0.0013, 0.003, worlds.MAX_DELAY])
def test_a_delay_shifts_the_torque_and_between_milliseconds_mixes_two_commands(delay):
    commands, now = np.random.default_rng(1).normal(0.0, 5.0, (30, 10)), np.arange(30)
    late = torques(ideal()._replace(delay=np.array(delay)), commands)
    for told, given in zip(commands.T, late.T, strict=True):
        expected = np.interp(now - delay / 0.001, [-1, *now], [0.0, *told])
        np.testing.assert_allclose(given, expected, atol=1e-9)


def test_a_motor_lags_is_weaker_than_told_saturates_and_its_linkage_leaks_into_the_knee():
    slow = torques(ideal()._replace(lag=np.array(0.005)), np.full((6, 10), 10.0))
    np.testing.assert_allclose(slow[4], 10.0 * (1 - np.exp(-1.0)), rtol=1e-9)
    gain = np.linspace(0.9, 1.0, 10)
    weak = torques(ideal()._replace(torque_gain=gain), np.full((1, 10), 10.0))[0]
    np.testing.assert_allclose(weak, 10.0 * gain)
    linked, limit = ideal()._replace(linkage=np.array(0.5)), ROBOT.torque_limit
    for plant in (ideal(), linked):  # of the sum, as MuJoCo's actuators limit it
        most = torques(plant, np.outer([1.0, -1.0], np.full(10, 1e3)))
        np.testing.assert_allclose(most, np.outer([1.0, -1.0], limit))
        np.testing.assert_array_equal(build_world(plant).model.actuator_ctrlrange[:, 1], limit)
    leaky = torques(linked, np.full((1, 10), 4.0))[0]
    np.testing.assert_allclose(leaky, [4.0, 4.0, 4.0, 6.0, 4.0] * 2)


def around(share):
    names = ("joint_friction", "joint_damping", "backlash", "delay", "lag", "linkage")
    base = {name: float(getattr(hfs(), name)) for name in names}
    table = {name: (value * (1 - share), value * (1 + share)) for name, value in base.items()}
    table["floor_friction"] = max(0.6, 0.8 * (1 - share)), 0.8 * (1 + share)
    table["mass"] = 1 - share / 10, 1 + share / 10
    table["torque_gain"] = 1 - share / 4, 1.0
    return table | {"trunk_com": (-0.025 * share, 0.025 * share)}


MOTORS = {"delay": (0.001, 0.005), "lag": (0.002, 0.006)}
DRAWS = [(worlds.hfs_drawn, around(0.2)), (worlds.hfs_varied, around(0.4))]
DRAWS += [(worlds.hfs_with_motors, around(0.2) | MOTORS)]
DRAWS += [(worlds.hfs_even, around(0.4) | MOTORS | {"mass": (0.85, 1.15)})]


@pytest.mark.parametrize(("draw", "table"), DRAWS)
def test_drawn_plants_fill_their_ranges_and_a_seed_is_a_plant(draw, table):
    plants = [draw(seed) for seed in range(100)]
    for name, (low, high) in table.items():
        values = np.array([getattr(plant, name) for plant in plants])
        assert low <= values.min(), name
        assert values.max() <= high, name
        assert np.ptp(values) > 0.8 * (high - low), name
    same = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(draw(s))]) for s in (3, 3, 4)]
    np.testing.assert_array_equal(same[0], same[1])
    assert (same[0] != same[2]).any()


def test_plants_with_other_motors_masses_or_estimates_are_else_as_drawn():
    drawn, motors, even = worlds.hfs_varied(3), worlds.hfs_with_motors(3, 0.4), worlds.hfs_even(3)
    own = drawn._replace(delay=motors.delay, lag=motors.lag)
    jax.tree.map(np.testing.assert_array_equal, motors, own)
    own = motors._replace(mass=even.mass, estimator=worlds.noisy())
    jax.tree.map(np.testing.assert_array_equal, even, own)
    assert drawn.estimator == worlds.truth()


def test_a_wrong_number_is_refused_by_name():
    for name, value in (("joint_friction", -1.0), ("mass", 0.0), ("delay", 0.1), ("lag", np.nan)):
        with pytest.raises(ValueError, match=f"Imperfections.{name}"):
            build_world(ideal()._replace(**{name: np.array(value)}))


def test_a_blown_up_state_stays_blown_up_and_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    world, before = build_world(ideal()), mujoco.get_mju_user_warning()
    data = mujoco.MjData(world.model)
    data.qvel[0] = np.nan
    with quiet_mujoco():
        mujoco.mj_step(world.model, data)
    assert mujoco.get_mju_user_warning() is before
    assert data.warning.number.sum() > 0
    assert not np.isfinite(data.qvel).all()
    assert os.listdir(tmp_path) == []


SIZES = PlantSizes(joint_friction=3.0, joint_damping=2.0, push=5.0, trunk_com=1.5, payload=4.0)
LARGE = replace(HECTOR, plants=SIZES)


def described(folder, text):
    path = folder / "robot.toml"
    path.write_text(f'model = "hector.xml"\n{text}')
    return path


def exactly(plant):
    flat = plant._asdict() | {f"estimator.{k}": v for k, v in plant.estimator._asdict().items()}
    del flat["estimator"]
    return {name: [float(x).hex() for x in np.ravel(value)] for name, value in flat.items()}


def factories(description):
    yield from (worlds.named_world(name, 2, description) for name in worlds.WORLDS)
    yield worlds.hfs_drawn(3, description=description)
    yield standin(1, description)


def test_plants_and_pushes_of_the_data_have_the_sizes_of_the_robot():
    for ours, theirs in zip(factories(LARGE), factories(HECTOR), strict=True):
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
    assert hash(description) != hash(HECTOR)  # static under jit
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
