"""Plants: what each imperfection does, and who may be drawn how far from whom."""

import os

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hector_jax.robot.model import load_robot, quiet_mujoco
from hector_jax.sim.actuators import init_actuators, step_actuators
from hector_jax.sim.standin import standin
from hector_jax.sim.world import (
    MAX_DELAY,
    NO_PUSH,
    Push,
    build_world,
    build_worlds,
    hfs,
    hfs_drawn,
    hfs_even,
    hfs_varied,
    hfs_with_motors,
    ideal,
    noisy,
    push_force,
    standing_qpos,
    truth,
)

ROBOT = load_robot()
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
    """Motor-side and true travel [rad] of the left knee under a constant torque."""
    world, data = hung_up(imperfections)
    data.ctrl[KNEE] = torque
    start = data.qpos.copy()
    mujoco.mj_step(world.model, data, steps)
    moved = (data.qpos - start)[world.joint_qpos[KNEE]]
    slack = (
        (data.qpos - start)[world.model.jnt_qposadr[world.slack][KNEE]] if world.slack.size else 0.0
    )
    return moved, moved + slack


def torques(imperfections, commands):
    """Joint torques (T, 10) for commands (T, 10)."""
    step = lambda motors, command: step_actuators(ROBOT, imperfections, motors, command)  # noqa: E731
    return np.asarray(jax.lax.scan(step, init_actuators(10), jnp.asarray(commands))[1])


def test_the_ideal_plant_is_the_robot_of_the_file():
    world = build_world(ideal())
    assert (world.model.nq, world.model.nv, world.model.nu) == (17, 16, 10)
    assert world.model.body_mass.sum() == pytest.approx(float(ROBOT.mass), rel=1e-9)
    assert world.model.body_mass.sum() == pytest.approx(12.0, abs=0.05)


def test_a_push_lasts_from_its_start_on_and_pushes_add_up():
    force = np.array([[10.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    push = Push(force, start=np.array([0.1, 0.15]), duration=np.array([0.1, 0.01]))
    felt = np.stack([push_force(push, jnp.array(step)) for step in range(-5, 300)])[:, :2]
    at = np.arange(-5, 300)
    np.testing.assert_array_equal(felt[:, 0], np.where((at >= 100) & (at < 200), 10.0, 0.0))
    np.testing.assert_array_equal(felt[:, 1], np.where((at >= 150) & (at < 160), 5.0, 0.0))
    assert not np.any(push_force(NO_PUSH, jnp.array(0)))


def test_joints_are_found_by_name_with_and_without_backlash():
    for plant in (ideal(), hfs()):
        world = build_world(plant)
        qpos = standing_qpos(world, ROBOT.standing_joints, 1.0)
        np.testing.assert_array_equal(qpos[world.joint_qpos], ROBOT.standing_joints)
        driven = world.model.jnt_dofadr[world.model.actuator_trnid[:, 0]]
        np.testing.assert_array_equal(driven, world.joint_dof)


def test_backlash_adds_a_free_play_that_the_encoder_does_not_see():
    width = 0.02
    loose = ideal()._replace(backlash=np.array(width))
    world, data = hung_up(loose)
    assert world.model.nv == 26
    data.ctrl[KNEE] = 1.0
    mujoco.mj_step(world.model, data, 60)
    slack = data.qpos[world.model.jnt_qposadr[world.slack]]
    assert abs(slack[KNEE]) == pytest.approx(width, rel=0.15)
    assert np.abs(slack).max() < 1.2 * width


def test_the_play_of_a_joint_is_free_of_all_but_a_little_damping():
    world = build_world(hfs())
    joints = [world.model.joint(f"{name}_backlash") for name in ROBOT.description.joints]
    for joint in joints:
        assert (joint.stiffness[0], joint.frictionloss[0], joint.armature[0]) == (0.0, 0.0, 0.0)
        assert joint.damping[0] == 0.01


def test_joint_friction_holds_against_a_small_torque():
    free = knee_after(ideal(), torque=0.2)[0]
    held = knee_after(ideal()._replace(joint_friction=np.array(0.3)), torque=0.2)[0]
    assert abs(held) < 0.1 * abs(free)  # the solver lets it creep


@pytest.mark.parametrize(("name", "value"), [("joint_damping", 2.0), ("armature", 3.0)])
def test_damping_and_armature_slow_a_joint_down(name, value):
    free = knee_after(ideal())[0]
    slow = knee_after(ideal()._replace(**{name: np.array(value)}))[0]
    assert 0.0 < slow < 0.9 * free


def test_mass_and_trunk_com_are_those_of_the_plant():
    shift = np.array([0.01, -0.005, 0.015])
    plain = build_world(ideal()).model
    heavy = build_world(ideal()._replace(mass=np.array(1.05), trunk_com=shift)).model
    assert heavy.body_mass.sum() == pytest.approx(1.05 * plain.body_mass.sum())
    np.testing.assert_allclose(heavy.body_inertia, 1.05 * plain.body_inertia)
    np.testing.assert_allclose(heavy.body_ipos[1] - plain.body_ipos[1], shift)
    np.testing.assert_allclose(heavy.body_subtreemass[0], 1.05 * plain.body_subtreemass[0])


def dropped(imperfections, push=0.0, steps=150):
    """Deepest contact [m] and slide [m] of a stiff robot let go 5 mm above the floor."""
    world = build_world(imperfections)
    data = mujoco.MjData(world.model)
    height = float(ROBOT.trunk_height)
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints, height + 0.005)
    data.qvel[0] = push
    deep, slide, foot = 0.0, 0.0, world.model.site("left_foot_point").id
    for _ in range(steps):
        error = ROBOT.standing_joints - data.qpos[world.joint_qpos]
        data.ctrl[:] = 400.0 * error - 4.0 * data.qvel[world.joint_dof]
        before = data.site_xpos[foot, 0]
        mujoco.mj_step(world.model, data)
        if data.ncon:
            deep = min(deep, data.contact.dist.min())
            slide += data.site_xpos[foot, 0] - before
    return -deep, slide


def test_the_ground_is_as_soft_as_the_plant_says():
    firm = dropped(ideal()._replace(contact_time=np.array(0.006)))[0]
    soft = dropped(ideal()._replace(contact_time=np.array(0.03)))[0]
    assert soft > 1.5 * firm


def test_the_floor_is_as_slippery_as_the_plant_says():
    grip = dropped(ideal(), push=0.6)[1]
    slip = dropped(ideal()._replace(floor_friction=np.array(0.15)), push=0.6)[1]
    assert slip > 1.8 * grip


def test_a_perfect_motor_gives_what_it_is_told():
    commands = np.random.default_rng(0).normal(0.0, 5.0, (20, 10))
    np.testing.assert_allclose(torques(ideal(), commands), commands, atol=1e-12)


@pytest.mark.parametrize("delay", [0.001, 0.003, MAX_DELAY])
def test_a_delay_shifts_the_torque(delay):
    commands = np.random.default_rng(1).normal(0.0, 5.0, (30, 10))
    late = torques(ideal()._replace(delay=np.array(delay)), commands)
    steps = round(delay / 0.001)
    np.testing.assert_allclose(late[steps:], commands[:-steps], atol=1e-9)
    np.testing.assert_allclose(late[:steps], 0.0, atol=1e-9)


def test_a_delay_between_milliseconds_mixes_two_commands():
    commands = np.random.default_rng(2).normal(0.0, 5.0, (10, 10))
    late = torques(ideal()._replace(delay=np.array(0.0013)), commands)
    np.testing.assert_allclose(late[2:], 0.7 * commands[1:-1] + 0.3 * commands[:-2], atol=1e-9)


def test_a_lag_reaches_63_percent_after_its_time():
    slow = torques(ideal()._replace(lag=np.array(0.005)), np.full((6, 10), 10.0))
    np.testing.assert_allclose(slow[4], 10.0 * (1 - np.exp(-1.0)), rtol=1e-9)


def test_gain_scales_and_the_limit_saturates():
    gain = np.linspace(0.9, 1.0, 10)
    weak = torques(ideal()._replace(torque_gain=gain), np.full((1, 10), 10.0))[0]
    np.testing.assert_allclose(weak, 10.0 * gain)
    most = torques(ideal(), np.full((1, 10), 1e3))[0]
    np.testing.assert_allclose(most, ROBOT.torque_limit)


def test_the_linkage_leaks_ankle_torque_into_the_knee():
    leaky = torques(ideal()._replace(linkage=np.array(0.5)), np.full((1, 10), 4.0))[0]
    expected = np.full(10, 4.0)
    expected[[3, 8]] = 6.0
    np.testing.assert_allclose(leaky, expected)


def test_drawn_plants_stay_within_their_share():
    base = hfs()
    for share, seeds in ((0.2, range(30)), (0.4, range(20))):
        for seed in seeds:
            plant = hfs_drawn(seed, share)
            for name in ("joint_friction", "joint_damping", "backlash", "delay", "lag", "linkage"):
                assert abs(getattr(plant, name) / getattr(base, name) - 1) <= share
            assert 0.6 <= plant.floor_friction <= 0.8 * (1 + share)
            assert abs(plant.mass - 1) <= share / 10
            assert np.abs(plant.trunk_com).max() <= 0.025 * share
            assert not any(np.any(x) for x in plant.estimator)


def test_plants_with_motors_have_those_of_robots_and_else_are_as_drawn():
    plants = [hfs_with_motors(seed, 0.4) for seed in range(60)]
    for name, (low, high) in (("delay", (0.001, 0.005)), ("lag", (0.002, 0.006))):
        values = np.array([getattr(plant, name) for plant in plants])
        assert low <= values.min() < low + 0.0005
        assert high - 0.0005 < values.max() <= high
    for seed in (0, 1):
        motors = {"delay": plants[seed].delay, "lag": plants[seed].lag}
        same = jax.tree.map(np.array_equal, plants[seed], hfs_varied(seed)._replace(**motors))
        assert all(jax.tree.leaves(same))


def test_the_plants_of_hfs_even_have_masses_about_the_nominal_ones_and_a_noisy_estimate():
    plants = [hfs_even(seed) for seed in range(60)]
    masses = np.array([plant.mass for plant in plants])
    assert 0.85 <= masses.min() < 0.87 < 1.13 < masses.max() <= 1.15
    others = {"mass": np.asarray(1.0), "estimator": truth()}
    rest = [p._replace(**others) for p in (plants[3], hfs_with_motors(3, 0.4))]
    assert all(jax.tree.leaves(jax.tree.map(np.array_equal, *rest)))
    assert plants[3].estimator == noisy()


def test_standin_plants_stay_within_their_table():
    low = dict(joint_friction=0.3, joint_damping=0.1, armature=0.9, backlash=0.005, delay=0.001)
    low |= dict(lag=0.002, linkage=0.3, contact_time=0.006, floor_friction=0.65, mass=0.95)
    high = dict(joint_friction=0.7, joint_damping=0.4, armature=1.4, backlash=0.015, delay=0.005)
    high |= dict(lag=0.006, linkage=1.0, contact_time=0.02, floor_friction=1.0, mass=1.08)
    plants = [standin(seed) for seed in range(100)]
    for name in low:
        values = np.array([getattr(plant, name) for plant in plants])
        assert low[name] <= values.min()
        assert values.max() <= high[name]
        assert np.ptp(values) > 0.8 * (high[name] - low[name])
    gains = np.stack([plant.torque_gain for plant in plants])
    assert 0.9 <= gains.min() < gains.max() <= 1.0
    assert np.abs(np.stack([plant.trunk_com for plant in plants])).max() <= 0.015


def test_a_seed_is_a_plant():
    for draw in (hfs_drawn, hfs_varied, hfs_with_motors, hfs_even, standin):
        same = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(draw(s))]) for s in (3, 3, 4)]
        np.testing.assert_array_equal(same[0], same[1])
        assert (same[0] != same[2]).any()


def test_plants_built_together_equal_plants_built_alone():
    plants = [hfs_varied(0), ideal(), hfs_varied(1)]
    for plant, world in zip(plants, build_worlds(plants), strict=True):
        alone = build_world(plant).model
        for field in ("dof_damping", "dof_frictionloss", "body_mass", "jnt_range", "geom_solref"):
            np.testing.assert_array_equal(getattr(world.model, field), getattr(alone, field))


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
