"""The closed loop in MJX, against MuJoCo C."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.control.reference import named_command
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import expert, nominal
from hector_jax.robot import load_robot
from hector_jax.sim import sensing
from hector_jax.sim.parallel import batched_model, mjx, mjx_contacts, walk_batch
from hector_jax.sim.standin import standin
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, build_worlds, hfs, hfs_drawn, ideal

CONFIG, ROBOT = WalkConfig(), load_robot()


def stacked(trees):
    return jax.tree.map(lambda *x: np.stack(x), *trees)


@pytest.fixture(scope="module")
def recorded():
    """200 steps of a walk on the hfs: state and torque before, velocity and contacts after."""
    world, rows = build_world(hfs()), []
    before = {}

    def record(world, data):
        now = dict(qpos=data.qpos, qvel=data.qvel, qacc_warmstart=data.qacc_warmstart)
        now = {name: value.copy() for name, value in now.items()}
        if before:
            contacts = sensing.empty_contacts(1)
            sensing.read_contacts(world, data, contacts, 0)
            rows.append(dict(before, ctrl=data.ctrl.copy(), after=now["qvel"], contacts=contacts))
        before.update(now)

    walk(CONFIG, ROBOT, expert(), named_command("s"), hfs(), 0.8, on_sample=record)
    return world, rows[-800::4]


@jax.jit
def wrench_of(row, contacts, floor, foot_of_geom):
    foot, _ = sensing.foot_contacts(contacts, floor, foot_of_geom)
    points = sensing.foot_points(ROBOT, sensing.unpack_reading(row))
    return sensing.ground_wrench(contacts, foot, floor, points)


@pytest.mark.slow
def test_one_step_of_mjx_is_one_step_of_mujoco(recorded):
    world, rows = recorded
    model = mjx.put_model(world.model)
    template = mjx.make_data(model)

    @jax.jit
    @jax.vmap
    def step(start):
        data = mjx.step(model, template.replace(**start))
        return data.qvel, mjx_contacts(data)

    names = ("qpos", "qvel", "qacc_warmstart", "ctrl")
    qvel, contacts = step({name: np.stack([row[name] for row in rows]) for name in names})
    assert len(rows) == 200
    after = np.stack([row["after"] for row in rows])
    np.testing.assert_allclose(qvel, after, atol=1e-4)
    where, place = sensing.coordinates(world), (world.floor, world.foot_of_geom)
    for i, row in enumerate(rows):
        flat = np.concatenate([row["qpos"], row["qvel"], [0.0]])[where]
        mine = wrench_of(flat, jax.tree.map(lambda x, i=i: x[i], contacts), *place)
        theirs = wrench_of(flat, jax.tree.map(lambda x: x[0], row["contacts"]), *place)
        np.testing.assert_allclose(mine.force, theirs.force, atol=1e-3)
        np.testing.assert_allclose(mine.moment, theirs.moment, atol=1e-3)


def test_only_what_differs_between_plants_is_batched():
    plants = [hfs_drawn(seed) for seed in range(3)]
    worlds = build_worlds(plants)
    shared, varied = batched_model(worlds)
    assert {"dof_damping", "body_mass", "geom_friction", "jnt_range"} <= set(varied)
    assert not {"qpos0", "body_pos", "jnt_axis"} & set(varied)
    for name, leaf in varied.items():
        expected = np.stack([getattr(world.model, name) for world in worlds])
        np.testing.assert_allclose(leaf, expected)
    assert batched_model([worlds[0], worlds[0]])[1] == {}
    assert shared.nq == worlds[0].model.nq


def test_a_batch_of_unlike_plants_is_refused():
    two = stacked([expert(), expert()])
    commands = stacked([named_command("c"), named_command("s")])
    with pytest.raises(ValueError, match="all have backlash or none"):
        walk_batch(CONFIG, ROBOT, two, commands, [ideal(), hfs()])
    with pytest.raises(ValueError, match="estimator errors must be zero"):
        walk_batch(CONFIG, ROBOT, two, commands, [standin(0), standin(1)])
    with pytest.raises(ValueError, match=r"weights has batch sizes \[2\] for 3 plants"):
        walk_batch(CONFIG, ROBOT, two, commands, [hfs()] * 3)


@pytest.mark.slow
def test_a_batch_walks_as_mujoco_does():
    """Over 100 ms after the start-up each trunk is within 1 cm of its twin in C."""
    plants = [hfs(), hfs_drawn(1)]
    weights, commands = [expert(), nominal()], [named_command("straight"), named_command("s")]
    args = (CONFIG, ROBOT, stacked(weights), stacked(commands), plants)
    batch = walk_batch(*args, seconds=0.1, fine=True)
    coarse = walk_batch(*args, seconds=0.1)
    assert coarse.state.position.shape == (2, 10, 3)
    for i in range(2):
        alone = walk(CONFIG, ROBOT, weights[i], commands[i], plants[i], seconds=0.1)
        mine = jax.tree.map(lambda x, i=i: np.asarray(x[i]), batch)
        np.testing.assert_allclose(mine.state.position, alone.state.position, atol=0.01)
        np.testing.assert_array_equal(mine.contact, alone.contact)
        means = mine.effect.force.reshape(10, 10, 2, 3).mean(axis=1)
        np.testing.assert_allclose(coarse.effect.force[i], means, atol=1e-6)
        np.testing.assert_allclose(coarse.state.euler[i], mine.state.euler[9::10], atol=1e-9)


@pytest.mark.slow
def test_a_fall_in_a_batch_is_held_and_marked():
    ice = hfs()._replace(floor_friction=np.array(0.1))
    weights, commands = stacked([expert()] * 2), stacked([named_command("s")] * 2)
    batch = walk_batch(CONFIG, ROBOT, weights, commands, [hfs(), ice], seconds=2.0)
    assert np.asarray(batch.fallen).any(axis=1).tolist() == [False, True]
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(batch))
