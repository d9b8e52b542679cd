"""The closed loop in MuJoCo C, and what is sensed in it: state, wrench, falls, errors."""

import json
from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model import OTHERS, ROBOT
from pretend import USUAL, python

from hector_jax import Job, WalkConfig, expert, walk
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.sim import sensing
from hector_jax.sim.loop import contact_effect
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.standin import standin
from hector_jax.sim.world import Push, build_world, hfs, ideal, standing_qpos, truth
from hector_jax.tuning.loss import PAPER_LOSS, losses, total


@jax.jit
def sensed(robot, row, ground):
    reading = sensing.unpack_reading(row)
    points = sensing.foot_points(robot, reading)
    state = sensing.base_state(robot, reading, jnp.zeros(()))
    return state, contact_effect(points, ground), points, ground.touches


def flat_reading(world, data):
    return np.concatenate([data.qpos, data.qvel, [0.0]])[sensing.coordinates(world)]


def sense(world, data, row):
    """State, wrench, foot points and touch of the last step, which started at `row`."""
    ground = sensing.sensed_ground(data.sensordata[None], feet=2)
    return sensed(ROBOT, row, jax.tree.map(lambda x: x[0], ground))


def stand(plant, height=0.0, steps=1500):
    """A robot held in its standing pose by a joint PD, let go `height` [m] above the floor."""
    world = build_world(plant, sensors=True)
    data = mujoco.MjData(world.model)
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints, float(ROBOT.trunk_height) + height)
    row = flat_reading(world, data)
    for _ in range(steps):
        row = flat_reading(world, data)
        error = ROBOT.standing_joints - data.qpos[world.joint_qpos]
        data.ctrl[:] = 400.0 * error - 6.0 * data.qvel[world.joint_dof]
        mujoco.mj_step(world.model, data)
    return world, data, row


def momentum(world, data):
    """Of all links together, at the start of the last step [kg m/s]."""
    mujoco.mj_subtreeVel(world.model, data)
    return data.subtree_linvel[0] * world.model.body_subtreemass[0]


@pytest.mark.parametrize("plant", [ideal(), hfs()], ids=["ideal", "hfs"])
def test_at_rest_the_ground_carries_the_weight_inside_the_feet(plant):
    world, data, row = stand(plant)
    _, wrench, _, touches = sense(world, data, row)
    force, moment = np.asarray(wrench.force), np.asarray(wrench.moment)
    weight = world.model.body_mass.sum() * 9.81
    before = momentum(world, data)
    mujoco.mj_step(world.model, data)
    wanted = (momentum(world, data) - before) / 0.001 + [0.0, 0.0, weight]
    assert np.linalg.norm(force.sum(axis=0) - wanted) <= 0.01 * weight  # m (a + g) of all links
    assert force[:, 2].sum() == pytest.approx(weight, rel=0.005)
    ahead, aside = -moment[:, 1] / force[:, 2], moment[:, 0] / force[:, 2]
    assert (-ROBOT.heel <= ahead).all()
    assert (ahead <= ROBOT.toe).all()
    assert np.abs(aside).max() < 1e-3
    assert not any(touches)


def test_the_wrench_is_the_sum_of_mujocos_contact_forces():
    world, data, row = stand(ideal(), height=0.01, steps=60)
    assert data.ncon > 0
    force, moment, out = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(6)
    _, wrench, points, _ = sense(world, data, row)
    for i in range(data.ncon):
        contact = data.contact[i]
        mujoco.mj_contactForce(world.model, data, i, out)
        foot = world.foot_of_geom[[g for g in contact.geom if g != world.floor][0]]
        pushed = contact.frame.reshape(3, 3).T @ out[:3]
        force[foot] += pushed
        moment[foot] += np.cross(contact.pos - np.asarray(points)[foot], pushed)
    np.testing.assert_allclose(wrench.force, force, atol=1e-9)
    np.testing.assert_allclose(wrench.moment, moment, atol=1e-9)


def test_base_state_is_that_of_a_point_fixed_to_the_trunk():
    (world, data, _), rng = stand(ideal(), steps=0), np.random.default_rng(3)
    data.qpos[3:7] = rng.normal(size=4)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qvel[:6] = rng.normal(size=6)
    state, *_ = sense(world, data, flat_reading(world, data))
    mujoco.mj_forward(world.model, data)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(world.model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)
    R_wb = data.xmat[1].reshape(3, 3)
    offset = R_wb @ ROBOT.com_offset
    np.testing.assert_allclose(state.position, data.subtree_com[0], atol=1e-4)
    np.testing.assert_allclose(state.position, data.xpos[1] + offset, atol=1e-9)
    np.testing.assert_allclose(state.ang_velocity, velocity[:3], atol=1e-9)
    expected = velocity[3:] + np.cross(velocity[:3], offset)
    np.testing.assert_allclose(state.velocity, expected, atol=1e-9)


def test_foot_points_count_the_backlash():
    world, data, _ = stand(hfs(), steps=0)
    data.qpos[world.model.jnt_qposadr[world.slack]] = np.linspace(-0.005, 0.005, 10)
    mujoco.mj_kinematics(world.model, data)
    points = sense(world, data, flat_reading(world, data))[2]
    for foot, ankle in enumerate(world.joint_dof[[4, 9]]):
        body = world.model.dof_bodyid[ankle]
        expected = data.xpos[body] + data.xmat[body].reshape(3, 3) @ ROBOT.foot_point[foot]
        np.testing.assert_allclose(points[foot], expected, atol=1e-9)


def test_yaw_goes_on_past_half_a_turn():
    yaw_of = jax.jit(lambda reading, yaw: sensing.base_state(ROBOT, reading, yaw).euler[2])
    row, before = np.zeros(43), jnp.zeros(())
    for yaw in np.linspace(0.0, 9.0, 40):
        row[3:7] = np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        before = yaw_of(sensing.unpack_reading(jnp.asarray(row)), before)
        assert before == pytest.approx(yaw, abs=1e-9)


@pytest.mark.parametrize(
    ("height", "inwards", "floor", "legs"),
    [(0.2, 0.0, True, False), (1.0, 0.0, False, False), (1.0, 0.3, False, True)],
    ids=["knees on the floor", "in the air", "legs crossed"],
)
def test_what_touches_is_told_and_only_feet_on_the_floor_push(height, inwards, floor, legs):
    world, data, _ = stand(ideal(), steps=0)
    roll = inwards * np.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints + roll, height)
    mujoco.mj_forward(world.model, data)
    _, wrench, _, touches = sense(world, data, flat_reading(world, data))
    assert (touches.floor, touches.legs) == (floor, legs)
    assert floor or not (np.any(wrench.force) or np.any(wrench.moment))


def test_the_controller_is_told_the_truth_plus_errors_of_their_stated_sizes():
    assert not sensing.draw_errors(truth(), 10, 0, 10, 20).any()
    estimator = standin(0).estimator
    runs = np.stack([sensing.draw_errors(estimator, 10, seed, 100, 4000) for seed in range(60)])
    start = runs[:, :100]
    sizes = np.repeat([0.005, 0.003, 0.03, 0.03, 0.001], [3, 3, 3, 3, 10])
    np.testing.assert_allclose(start.std(axis=(0, 1)), sizes, rtol=0.1)
    end = runs[:, -100:].mean(axis=1)  # the noise averages out, the drift stays
    np.testing.assert_allclose(end[:, [2, 3, 4]].std(axis=0), 0.01, rtol=0.3)
    assert np.abs(end[:, [0, 1, 5]]).max() < 0.003
    reading = jnp.asarray(stand(ideal(), steps=0)[2])
    true, _ = sensing.measure(ROBOT, reading, jnp.zeros(()), sensing.no_error(ROBOT))
    error = jnp.linspace(0.01, 0.22, 22)
    told, yaw = sensing.measure(ROBOT, reading, jnp.zeros(()), error)
    off = jax.tree.map(jnp.subtract, told, true)
    np.testing.assert_allclose(np.concatenate(off.state), error[:12], atol=1e-12)
    np.testing.assert_allclose(off.joints, error[12:], atol=1e-12)
    assert not np.any(off.joint_rates)
    assert yaw == 0.0  # the true one


CONFIG = WalkConfig()


@pytest.fixture(scope="module")
def short():
    """Half a second of the straight line in `ideal`."""
    return walk(CONFIG, ROBOT, Job(expert(), named_command("straight"), ideal(), seconds=0.5))


def walk_and_gain(job, build=MujocoPlant):
    """A walk, and what the momentum of all links gains in each of its milliseconds [N]."""
    momenta = []
    record = lambda world, data: momenta.append(momentum(world, data))  # noqa: E731
    walked = walk(CONFIG, ROBOT, job, build=partial(build, on_step=record))
    # mj_step leaves the velocities of the step's start: sample j's own change is from j to j + 1.
    return walked, np.diff(np.array(momenta), axis=0)[1100:] / 0.001


def rms(error):
    return np.sqrt(np.mean(np.asarray(error) ** 2, axis=0))


def test_the_numbers_of_the_weights_are_those_of_plan_and_legs(short):
    def walked(**others):
        weights = CONFIG.with_others(expert()._replace(others=others), OTHERS)
        return walk(CONFIG, ROBOT, Job(weights, named_command("straight"), ideal(), seconds=0.2))

    for leaf, other in zip(jax.tree.leaves(walked()), jax.tree.leaves(short), strict=True):
        np.testing.assert_array_equal(leaf, other[: len(leaf)] if np.ndim(leaf) else other)
    higher = walked(foot_height=0.12).feet - short.feet[:200]
    assert 0.02 < higher[..., 2].max() < 0.05
    wider = walked(footstep_width=0.1).feet - short.feet[:200]
    assert np.abs(wider[..., 1]).max() > 0.005


def test_the_robot_walks_upright_from_where_it_is_in_step_a_sample_each_millisecond(short):
    assert short.period == 0.001
    samples = jax.tree.leaves(short._replace(period=None, initial=None))
    assert all(leaf.shape[:1] == (500,) for leaf in samples)
    assert not short.fallen.any()
    assert short.residual.max() < 1e-6
    assert np.abs(short.state.position - short.reference.position).max() < 0.08
    assert np.abs(short.state.euler - short.reference.euler).max() < 0.1
    assert short.state.position[-1, 0] - short.initial.position[0] > 0.15
    start = short.reference.position[0] - 0.001 * short.reference.velocity[0]
    np.testing.assert_allclose(start[:2], short.initial.position[:2], atol=1e-9)
    assert start[2] == pytest.approx(float(ROBOT.standing_height))
    left, right = short.contact.T
    np.testing.assert_array_equal(left, np.arange(500) % 400 < 200)
    np.testing.assert_array_equal(right, ~left)
    assert not np.any(short.command.force[~short.contact])
    assert not np.any(short.command.moment[~short.contact])


def test_a_walk_as_the_user_has_it_has_the_losses_that_are_noted():
    """From the command line, with the optimisations that the tests leave out."""
    words = "walk --traj s --seconds 0.5 --world hfs --weights expert --json".split()
    told = json.loads(python("-m", "hector_jax", *words, env=USUAL, check=True).stdout)
    noted = {"L_Eul": 1.2055268, "L_pos": 2.4811933, "L_ctrl": 61943.913}
    assert {name: told[name] for name in noted} == pytest.approx(noted, rel=1e-3)
    assert (told["fell"], told["plans"], told["unsolved"]) == (False, 50, 0)


def test_a_seed_gives_the_same_bytes():
    plant, command = standin(1), named_command("s")
    runs = [walk(CONFIG, ROBOT, Job(expert(), command, plant, 0.1, seed)) for seed in (5, 5, 6)]
    first, same, other = (np.concatenate([np.ravel(x) for x in jax.tree.leaves(r)]) for r in runs)
    assert first.tobytes() == same.tobytes()
    assert first.tobytes() != other.tobytes()


def test_a_fall_is_held_and_marked():
    ice = ideal()._replace(floor_friction=np.array(0.11))
    fall = walk(CONFIG, ROBOT, Job(expert(), named_command("s"), ice, seconds=3.0))
    assert fall.fallen[-1]
    first = int(np.argmax(fall.fallen))
    assert fall.fallen[first:].all()
    for leaf in jax.tree.leaves(fall._replace(period=None, initial=None, fallen=None)):
        assert np.isfinite(leaf).all()
        assert (leaf[first:] == leaf[max(first - 1, 0)]).all()


class Breaks(MujocoPlant):
    """A plant whose engine warns 33 ms after t = 0."""

    @property
    def broken(self):  # noqa: D102
        return self.data.time > 1.1335


def test_a_plant_that_breaks_ends_the_walk_a_tick_before(short):
    job = Job(expert(), named_command("straight"), ideal(), seconds=0.2)
    walked = walk(CONFIG, ROBOT, job, build=Breaks)
    np.testing.assert_array_equal(walked.fallen, np.arange(200) >= 30)
    np.testing.assert_array_equal(walked.joints[:30], short.joints[:30])
    assert (walked.joints[30:] == short.joints[29]).all()


def test_a_walk_may_start_at_another_phase():
    job = Job(expert(), named_command("c"), ideal(), 0.2)
    late = walk(CONFIG, ROBOT, job._replace(start_tick=10))
    np.testing.assert_array_equal(late.contact[:, 0], np.arange(200) < 100)
    start = late.reference.position[0] - 0.001 * late.reference.velocity[0]
    np.testing.assert_allclose(start[:2], late.initial.position[:2], atol=1e-6)
    with pytest.raises(ValueError, match="start_tick -110 is not later"):
        walk(CONFIG, ROBOT, job._replace(start_tick=-110))


@pytest.mark.slow
def test_expert_weights_walk_far_in_ideal():
    for name, seconds in (("straight", 12.0), ("c", 12.0), ("s", 8.0)):
        walked = walk(CONFIG, ROBOT, Job(expert(), named_command(name), ideal(), seconds))
        assert not walked.fallen.any(), name
        assert rms(walked.state.position - walked.reference.position).max() <= 0.06, name
        assert np.rad2deg(rms(walked.state.euler - walked.reference.euler)).max() <= 3.0, name
        four = jax.tree.map(lambda x: x[:4000] if np.ndim(x) and len(x) > 4000 else x, walked)
        assert total(PAPER_LOSS, losses(PAPER_LOSS, four)) <= 4e6, name


@pytest.mark.slow
def test_expert_weights_walk_in_hfs_and_on_the_standin():
    plants = [(hfs(), 0), *((standin(seed), seed) for seed in range(8))]
    for (plant, seed), name in product(plants, COMMANDS):
        job = Job(expert(), named_command(name), plant, seed=seed)
        assert not walk(CONFIG, ROBOT, job).fallen.any(), (name, seed)


def test_a_push_moves_the_robot_and_the_sensed_wrench_stays_the_grounds(short):
    """What the whole robot gains is from the ground, its weight and the push, in every sample."""
    push = Push(np.array([[0.0, 30.0, 0.0]]), start=np.array([0.02]), duration=np.array([0.05]))
    job = Job(expert(), named_command("straight"), ideal(), 0.1, push=push)
    pushed, gained = walk_and_gain(job)
    assert (pushed.state.velocity[70] - short.state.velocity[70])[1] > 0.05
    rest = gained[:, 1] - pushed.effect.force.sum(axis=1)[:99, 1]
    on = (np.arange(99) >= 20) & (np.arange(99) < 70)
    np.testing.assert_allclose(np.mean(rest[on]), 30.0, atol=1.0)
    np.testing.assert_allclose(np.mean(rest[~on]), 0.0, atol=1.0)


def test_the_ground_carries_and_moves_the_whole_robot():
    """On the hfs the forces of the ground are m (a + g) of all links, in means over 10 ms."""
    walked, gained = walk_and_gain(Job(expert(), named_command("s"), hfs(), 1.0))
    assert not walked.fallen.any()
    wanted = gained + [0.0, 0.0, build_world(hfs()).model.body_mass.sum() * 9.81]
    ticks = lambda x: x[:990].reshape(99, 10, 3).mean(axis=1)  # noqa: E731
    wanted, sensed = ticks(wanted), ticks(walked.effect.force.sum(axis=1))
    error = np.linalg.norm(sensed - wanted, axis=1)
    assert error.mean() <= 0.05 * np.linalg.norm(wanted, axis=1).mean()
