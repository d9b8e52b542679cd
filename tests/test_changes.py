"""What becomes of a plant while it is walked on."""

from functools import partial

import jax
import mujoco
import numpy as np
import pytest
from changes import Change, ChangingPlant, changed_world, worlds_by_step

from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, hfs, ideal, standing_qpos

CONFIG, ROBOT = WalkConfig(), load_robot()
SLOPE = np.deg2rad(3.0)


def body_mass_matrix(world):
    """Inertia of trunk translation and rotation with the legs held, about the trunk's origin."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints, 1.0)
    mujoco.mj_forward(world.model, data)
    M = np.zeros((world.model.nv, world.model.nv))
    mujoco.mj_fullM(world.model, data, M)
    return M[:6, :6]


def held(world, steps=400, slide=0.0):
    """A stiff robot let down on the floor, after some milliseconds."""
    data = mujoco.MjData(world.model)
    data.qpos[:] = standing_qpos(world, ROBOT.standing_joints, float(ROBOT.trunk_height))
    data.qvel[1] = slide
    for _ in range(steps):
        error = ROBOT.standing_joints - data.qpos[world.joint_qpos]
        data.ctrl[:] = 400.0 * error - 4.0 * data.qvel[world.joint_dof]
        mujoco.mj_step(world.model, data)
    return data


def short(*changes, seconds=0.3, plant=None, on_step=None):
    command = named_command("straight")
    job = Job(expert(), command, plant or ideal(), seconds)
    return walk(CONFIG, ROBOT, job, build=partial(ChangingPlant, changes=changes, on_step=on_step))


@pytest.mark.parametrize("plant", [ideal(), hfs()._replace(trunk_com=np.array([0.01, 0.02, 0.0]))])
def test_a_payload_is_a_point_mass_on_the_trunk(plant):
    world, at = build_world(plant), np.array([0.03, -0.05, 0.1])
    loaded = changed_world(world, [Change(payload=2.0, payload_at=tuple(at))])
    cross = np.cross(np.eye(3), at)  # -skew(at)
    J = np.hstack([np.eye(3), cross.T])
    gained = body_mass_matrix(loaded) - body_mass_matrix(world)
    np.testing.assert_allclose(gained, 2.0 * J.T @ J, atol=1e-9)
    assert loaded.model.body_subtreemass[0] - world.model.body_subtreemass[0] == pytest.approx(2.0)


def test_a_change_leaves_the_plant_itself_alone():
    world = build_world(ideal())
    before = world.model.body_mass.copy(), world.model.geom_friction.copy()
    changed_world(world, [Change(payload=2.0, floor_friction=0.2, slope=(0.1, 0.0))])
    np.testing.assert_array_equal(world.model.body_mass, before[0])
    np.testing.assert_array_equal(world.model.geom_friction, before[1])
    np.testing.assert_array_equal(world.model.opt.gravity, [0.0, 0.0, -9.81])


def test_on_a_slope_gravity_pulls_down_it_and_the_robot_stands():
    world = build_world(ideal())
    uphill = changed_world(world, [Change(slope=(SLOPE, 0.0))])
    left = changed_world(world, [Change(slope=(0.0, SLOPE))])
    pull = 9.81 * np.array([np.sin(SLOPE), np.cos(SLOPE)])
    np.testing.assert_allclose(uphill.model.opt.gravity, [-pull[0], 0.0, -pull[1]])
    np.testing.assert_allclose(left.model.opt.gravity, [0.0, -pull[0], -pull[1]])
    flat, tilted = (held(w, 100) for w in (world, uphill))
    assert abs(flat.qpos[2] - tilted.qpos[2]) < 1e-3
    assert tilted.qvel[0] < flat.qvel[0] - 1e-3


def test_the_ground_pulls_no_harder_than_its_friction_of_the_moment():
    force = short(Change(start=0.1, end=0.2, floor_friction=0.12)).effect.force
    pull, load = np.hypot(force[..., 0], force[..., 1]), force[..., 2]
    slippery = (np.arange(300) >= 100) & (np.arange(300) < 200)
    assert np.all(pull[slippery] <= 0.12 * load[slippery] + 1e-9)
    assert np.max(pull[~slippery] - 0.12 * load[~slippery]) > 5.0


def test_changes_begin_and_end_at_their_milliseconds_and_add_up():
    world = build_world(ideal())
    changes = [
        Change(start=0.1, end=0.15, floor_friction=0.4),
        Change(start=0.12, payload=2.0),
        Change(start=-5.0, slope=(0.01, 0.0)),
        Change(start=9.0, payload=9.0),
    ]
    worlds = worlds_by_step(world, changes, -1100, 300)
    told = {
        step: (w.model.geom_friction[w.floor, 0], round(w.model.body_mass.sum() - 12.0))
        for step, w in worlds.items()
    }
    assert told == {-1100: (0.8, 0), 100: (0.4, 0), 120: (0.4, 2), 150: (0.8, 2)}
    assert all(w.model.opt.gravity[0] < 0.0 for w in worlds.values())
    assert worlds_by_step(world, (), -1100, 300) == {-1100: world}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (Change(payload=-1.0), "Change.payload must be finite and >= 0, got -1.0"),
        (Change(floor_friction=float("nan")), "Change.floor_friction must be"),
        (Change(start=1.0, end=1.0), "Change.end must be after its start, got 1.0"),
        (Change(slope=(0.4, 0.4)), "Change.slope must be at most 0.5 rad"),
    ],
)
def test_an_impossible_change_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        short(change)


def test_a_payload_that_arrives_is_felt_from_then_on_and_not_before():
    seen = []
    arrives = Change(start=0.1, payload=2.0)
    loaded = short(arrives, on_step=lambda world, _: seen.append(world.model.body_mass.sum()))
    free = short()
    before, after = (jax.tree.map(lambda x, s=s: x[s], loaded.state) for s in (99, -1))
    for one, other in zip(before, jax.tree.map(lambda x: x[99], free.state), strict=True):
        np.testing.assert_array_equal(one, other)
    assert free.state.position[-1, 2] - after.position[2] > 0.003
    weight = 9.81 * np.array(seen)[-300:]
    assert weight[100] - weight[99] == pytest.approx(2.0 * 9.81)
    assert not loaded.fallen.any()


def test_a_walk_on_a_slope_is_pulled_down_it():
    """What the robot gains beside the ground's force is its weight, tilted."""
    momentum = []

    def record(world, data):
        mujoco.mj_subtreeVel(world.model, data)
        momentum.append(data.subtree_linvel[0] * world.model.body_subtreemass[0])

    walked = short(Change(slope=(0.0, SLOPE)), seconds=0.1, on_step=record)
    assert not walked.fallen.any()
    # mj_step leaves the velocities of the step's start: sample j's own change is from j to j + 1.
    gained = np.diff(np.array(momentum), axis=0)[1100:] / 0.001
    rest = np.mean(gained - walked.effect.force.sum(axis=1)[:-1], axis=0)
    weight = 9.81 * build_world(ideal()).model.body_mass.sum()
    down = weight * np.array([0.0, -np.sin(SLOPE), -np.cos(SLOPE)])
    np.testing.assert_allclose(rest, down, atol=0.5)
