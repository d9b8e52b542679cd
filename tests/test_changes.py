"""Plants that change while they are walked on, slips that are felt, and other models as plants."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from changes import Change, ChangingPlant, changed_world, walk_with_changes, worlds_by_step
from model import EXAMPLES, ROBOT
from oracles import mass_matrix
from pretend import instead, pretend_walk
from test_walk import walk_and_gain

from hector_jax import InputError, Job, TuneConfig, expert, load_robot, walk
from hector_jax.control import GaitConfig, WalkConfig, named_command, nominal, walk_config
from hector_jax.control.slip import SlipConfig, feel, first_grip
from hector_jax.control.weights_file import shipped
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.parallel import walk_batch
from hector_jax.sim.world import build_world, hfs, ideal, standing_qpos
from hector_jax.store.setup import Setup
from hector_jax.verdict import judging

CONFIG = WalkConfig()
ARMS, STRIDER = EXAMPLES / "hector-v2" / "arms.toml", EXAMPLES / "strider" / "robot.toml"
SLOPE = np.deg2rad(3.0)


def short(*changes, seconds=0.3):
    """A walk on a plant that changes, and what it gains in each millisecond [N]."""
    job = Job(expert(), named_command("straight"), ideal(), seconds)
    return walk_and_gain(job, build=partial(ChangingPlant, changes=changes))


@pytest.mark.parametrize("plant", [ideal(), hfs()._replace(trunk_com=np.array([0.01, 0.02, 0.0]))])
def test_a_payload_is_a_point_mass_on_the_trunk(plant):
    world, at = build_world(plant), np.array([0.03, -0.05, 0.1])
    before = world.model.body_mass.copy()
    loaded = changed_world(world, [Change(payload=2.0, payload_at=tuple(at))])
    J = np.hstack([np.eye(3), np.cross(np.eye(3), at).T])  # [1, -skew(at)]
    inertias = []
    for one in (world, loaded):
        data = mujoco.MjData(one.model)
        data.qpos[:] = standing_qpos(one, ROBOT.standing_joints, 1.0)
        mujoco.mj_forward(one.model, data)
        # of the robot with its legs held, about the trunk's origin
        inertias.append(mass_matrix(one.model, data)[:6, :6])
    np.testing.assert_allclose(inertias[1] - inertias[0], 2.0 * J.T @ J, atol=1e-9)
    assert loaded.model.body_subtreemass[0] - world.model.body_subtreemass[0] == pytest.approx(2.0)
    np.testing.assert_array_equal(world.model.body_mass, before)  # the plant itself stays


def test_on_a_slope_gravity_pulls_down_it_and_so_is_the_robot():
    """What the robot gains beside the ground's force is its weight, tilted."""
    pull = 9.81 * np.array([np.sin(SLOPE), np.cos(SLOPE)])
    uphill = changed_world(build_world(ideal()), [Change(slope=(SLOPE, 0.0))])
    np.testing.assert_allclose(uphill.model.opt.gravity, [-pull[0], 0.0, -pull[1]])
    walked, gained = short(Change(slope=(0.0, SLOPE)), seconds=0.1)
    assert not walked.fallen.any()
    rest = np.mean(gained - walked.effect.force.sum(axis=1)[:-1], axis=0)
    mass = build_world(ideal()).model.body_mass.sum()
    np.testing.assert_allclose(rest, mass * np.array([0.0, -pull[0], -pull[1]]), atol=0.5)


def test_changes_begin_and_end_at_their_milliseconds_and_add_up():
    world = build_world(ideal())
    changes = [Change(start=0.1, end=0.15, floor_friction=0.4), Change(start=0.12, payload=2.0)]
    changes += [Change(start=-5.0, slope=(0.01, 0.0)), Change(start=9.0, payload=9.0)]
    worlds = worlds_by_step(world, changes, -1100, 300)
    told = {
        step: (w.model.geom_friction[w.floor, 0], round(w.model.body_mass.sum() - 12.0))
        for step, w in worlds.items()
    }
    assert told == {-1100: (0.8, 0), 100: (0.4, 0), 120: (0.4, 2), 150: (0.8, 2)}
    assert all(w.model.opt.gravity[0] < 0.0 for w in worlds.values())
    assert worlds_by_step(world, (), -1100, 300) == {-1100: world}


def test_the_ground_pulls_no_harder_than_its_friction_and_a_payload_is_felt_from_its_arrival_on():
    force = short(Change(start=0.1, end=0.2, floor_friction=0.12))[0].effect.force
    pull, load = np.hypot(force[..., 0], force[..., 1]), force[..., 2]
    slippery = (np.arange(300) >= 100) & (np.arange(300) < 200)
    assert np.all(pull[slippery] <= 0.12 * load[slippery] + 1e-9)
    assert np.max(pull[~slippery] - 0.12 * load[~slippery]) > 5.0
    (free, _), (loaded, gained) = short(), short(Change(start=0.1, payload=2.0))
    np.testing.assert_array_equal(loaded.state.position[:100], free.state.position[:100])
    assert free.state.position[-1, 2] - loaded.state.position[-1, 2] > 0.003
    assert not loaded.fallen.any()
    weight = (loaded.effect.force.sum(axis=1)[:-1] - gained)[:, 2]
    steps = weight[105:].mean() - weight[:95].mean()
    assert steps == pytest.approx(2.0 * 9.81, rel=0.01)


SLIP, GAIT = SlipConfig(distance=0.05, share=0.4, recovery=0.6), GaitConfig()
FEET = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])


def course(moves, start=0):
    """Shares of the friction at each tick, with the left foot (0) that much ahead of its place."""
    grip, shares = first_grip(FEET), []
    for tick, move in enumerate(moves, start):
        feet = jnp.asarray(FEET).at[0, 0].add(move)
        grip = feel(SLIP, GAIT, 0.5, grip, feet=feet, tick=jnp.asarray(tick))
        shares.append(1.0 - float(grip.lost))
    return np.array(shares)


def test_a_foot_that_moves_far_in_its_stance_has_slipped_and_the_friction_grows_back_in_time():
    assert np.all(course([0.0] * 4 + [0.024] * 6) == 1.0)  # [m] 0.05 of the height are 0.025
    np.testing.assert_allclose(course([0.0] * 4 + [0.03] * 6), [1.0] * 4 + [0.88] * 6)
    np.testing.assert_allclose(course([0.0] * 4 + [0.2] * 6), [1.0] * 4 + [0.4] * 6)
    assert np.all(course([0.1, 0.1, 0.1, 0.1]) == 1.0)  # the first ticks of the stance
    assert np.all(course(np.linspace(0.0, 0.4, 20), start=GAIT.stance) == 1.0)  # it swings
    assert np.all(course([0.1] * 8, start=GAIT.first_tick - 8) == 1.0)  # it stands before the gait
    shares = course([0.0] * 4 + [0.05] + [0.0] * 75)
    assert shares[4] == 0.4
    np.testing.assert_allclose(np.diff(shares[4:64]), 0.6 * GAIT.tick / 0.6)
    assert np.all(shares[65:] == 1.0)


@pytest.mark.slow
def test_a_floor_that_turns_slippery_is_walked_with_less_friction():
    config, floor = walk_config(ROBOT), (Change(1.0, 3.0, floor_friction=0.45),)
    careless = replace(config, slip=replace(config.slip, share=1.0))
    job = Job(shipped(), named_command("s"), hfs())
    felt, not_felt = (walk_with_changes(c, ROBOT, job, floor) for c in (config, careless))
    assert not np.any(felt.fallen)

    def use(walk):
        force = np.sum(walk.command.force, axis=1)[1500:3000]  # while the floor is slippery
        return np.max(np.abs(force[:, :2]).sum(axis=1) / force[:, 2])

    assert use(felt) < use(not_felt)
    # two programs, which may round otherwise
    forces = (each.command.force[:1000] for each in (felt, not_felt))
    np.testing.assert_allclose(*forces, rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def arms():
    return load_robot(ARMS)


def test_the_world_is_the_plants_model_and_it_stands_in_its_own_pose(arms):
    # bent more, and lower, than the robot of the controller
    plant = arms._replace(
        standing_joints=ROBOT.standing_joints + 0.01, trunk_height=ROBOT.trunk_height - 0.002
    )
    seen = []
    look = lambda world, data: seen.append((world, data.qpos.copy()))  # noqa: E731
    job = Job(expert(), named_command("straight"), ideal(), 0.01, plant=plant)
    assert not walk(CONFIG, ROBOT, job, build=partial(MujocoPlant, on_step=look)).fallen.any()
    world, first = seen[0]
    assert world.model.body_mass.sum() == pytest.approx(float(arms.mass), rel=1e-6)
    assert arms.mass > 1.15 * ROBOT.mass
    np.testing.assert_allclose(first[world.joint_qpos], plant.standing_joints, atol=2e-3)
    assert first[2] == pytest.approx(float(plant.trunk_height), abs=1e-3)


@pytest.mark.slow
def test_both_engines_walk_the_plant_alike():
    plant = load_robot(ARMS.with_name("robot.toml"))
    job = Job(expert(), named_command("straight"), ideal(), 0.2, plant=plant)
    (batched,) = walk_batch(CONFIG, ROBOT, [job], fine=True)
    alone = walk(CONFIG, ROBOT, job)
    np.testing.assert_allclose(batched.state.position, alone.state.position, atol=1e-3)


@pytest.mark.parametrize("engine", [walk, lambda *known: walk_batch(*known[:2], [known[2]])])
def test_a_plant_of_other_joints_is_refused(engine):
    job = Job(expert(), named_command("straight"), ideal(), 0.1, plant=load_robot(STRIDER))
    told = "robot.toml: joints are left_yaw, .* as a plant of .*hector.toml expected left_hip_yaw"
    with pytest.raises(InputError, match=told):
        engine(CONFIG, ROBOT, job)


def test_scores_of_another_plant_are_others(monkeypatch, tmp_path, arms):
    walks_of = lambda setup, jobs, *others: (pretend_walk(job.seed) for job in jobs)  # noqa: E731
    instead(monkeypatch, judging, "walk_jobs", walks_of)
    job = Job(nominal(), named_command("straight"), hfs())
    # another file with the very same numbers
    renamed = arms._replace(description=replace(arms.description, name="other"))
    with ThreadPoolExecutor(1) as pool:
        for plant in (None, arms, arms, renamed):
            setup = Setup(pool, TuneConfig(), ROBOT)
            jobs = {("straight", "nominal", 0): job._replace(plant=plant)}
            judging.judge_jobs(setup, jobs, title="", folder=tmp_path)
    assert len((tmp_path / judging.TABLE).read_text().splitlines()) == 3
