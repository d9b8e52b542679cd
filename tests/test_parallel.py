"""The closed loop in MJX, against MuJoCo C."""

from functools import partial

import jax
import numpy as np
import pytest
from model import OTHERS

from hector_jax.control.controller import WalkConfig
from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.grfm.dataset import at_interval
from hector_jax.robot.description import MODEL_PATH
from hector_jax.robot.model import load_robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job, contact_effect
from hector_jax.sim.mjx_model import batched_model, mjx, mjx_contacts
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.parallel import walk_batch
from hector_jax.sim.standin import standin
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Push, build_world, build_worlds, hfs, hfs_drawn, ideal

CONFIG, ROBOT = WalkConfig(), load_robot()


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
            sensing.read_contacts(data, contacts, 0)
            rows.append(dict(before, ctrl=data.ctrl.copy(), after=now["qvel"], contacts=contacts))
        before.update(now)

    walk(
        CONFIG,
        ROBOT,
        Job(expert(), named_command("s"), hfs(), 0.8),
        build=partial(MujocoPlant, on_step=record),
    )
    return world, rows[-800::4]


@jax.jit
def wrench_of(row, contacts, floor, foot_of_geom):
    ground = sensing.ground_of(contacts, floor, foot_of_geom, feet=2)
    return contact_effect(ROBOT, row, ground)


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
        raw = jax.tree.map(lambda x: x[0], row["contacts"])
        theirs = wrench_of(flat, jax.jit(sensing.contacts_of)(raw, world.floor), *place)
        np.testing.assert_allclose(mine.force, theirs.force, atol=1e-3)
        np.testing.assert_allclose(mine.moment, theirs.moment, atol=1e-3)


UNUSED = ("cam_", "light_", "actuator_acc0")  # by MJX, in a robot without muscles


def test_only_what_differs_between_plants_is_batched():
    worlds = build_worlds([hfs_drawn(seed) for seed in range(3)])
    shared, varied = batched_model(worlds)
    for name in shared.__dataclass_fields__:
        values = [getattr(world.model, name, None) for world in worlds]
        if isinstance(values[0], np.ndarray) and not name.startswith(UNUSED):
            if name in varied:
                np.testing.assert_array_equal(varied[name], np.stack(values))
            else:
                np.testing.assert_array_equal(values[0], values[1], err_msg=name)
    assert shared.nq == worlds[0].model.nq


def test_mjx_looks_for_contacts_of_the_feet_and_between_the_legs_alone():
    world = build_world(hfs())
    model, _ = batched_model([world])
    found = jax.jit(lambda data: mjx.collision(model, mjx.kinematics(model, data)))
    geoms = np.asarray(found(mjx.make_data(model))._impl.contact.geom)
    with_floor = geoms[(geoms == world.floor).any(axis=1)]
    assert len(with_floor) == 4
    assert (world.foot_of_geom[with_floor.max(axis=1)] >= 0).all()
    assert len(geoms) == 13


def job(weights, name="s", plant=None, seconds=0.1, start_tick=0, push=(0.0, 0.0, 0.0)):
    push = Push(np.array([push]), np.array([0.02]), np.array([0.05]))
    command = named_command(name)
    return Job(weights, command, plant or hfs(), seconds, 0, start_tick, push)


TUNED = {"footstep_width": np.array(0.1), "foot_height": np.array(0.11), "kd": np.ones(5)}
ONE_PIECE = jax.tree.map(lambda x: x[:1], named_command("s"))


@pytest.mark.parametrize(
    ("jobs", "message"),
    [
        ([job(expert(), plant=ideal()), job(expert())], "all have backlash or none"),
        ([job(expert(), plant=standin(0))], "engine mjx knows its state exactly"),
        ([job(expert()), job(expert(), seconds=0.2)], r"agree in seconds, got \[0.1, 0.2\]"),
        ([job(expert()), job(expert())._replace(command=ONE_PIECE)], "the same shape"),
        ([job(expert()), job(expert(), start_tick=-110)], "start_tick -110 is not later"),
    ],
)
def test_jobs_that_make_no_batch_are_refused_at_once(jobs, message):
    with pytest.raises(ValueError, match=message):
        walk_batch(CONFIG, ROBOT, jobs)


def test_a_part_whose_height_over_the_floor_is_unknown_here_is_refused_by_name(tmp_path):
    path = tmp_path / "hector.xml"
    round_trunk = MODEL_PATH.read_text().replace('"trunk" type="box"', '"trunk" type="cylinder"')
    path.write_text(round_trunk)
    with pytest.raises(ValueError, match="geom trunk .* is a CYLINDER; .* BOX or CAPSULE"):
        walk_batch(CONFIG, load_robot(path), [job(expert())])


@pytest.fixture(scope="module")
def three():
    """Three jobs that differ in all that may differ, and their walks two at once."""
    jobs = [
        job(expert(), push=(10.0, 20.0, 0.0)),
        job(nominal()._replace(others=TUNED), "c", hfs_drawn(1), start_tick=7),
        job(expert()),
    ]
    return jobs, list(walk_batch(CONFIG, ROBOT, jobs, chunk=2))


def test_walks_of_a_batch_are_those_of_mujoco(three):
    """Weights, command, plant, start and push are each walk's own, in every chunk."""
    for asked, mine in zip(*three, strict=True):
        weights = CONFIG.with_others(asked.weights, OTHERS)  # the same, and of one program
        alone = at_interval(walk(CONFIG, ROBOT, asked._replace(weights=weights)), 0.01)
        for one, other in zip(jax.tree.leaves(mine), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-3)
            assert one.dtype == other.dtype
        np.testing.assert_allclose(mine.state.position, alone.state.position, atol=1e-6)
    pushed, _, free = three[1]
    assert (pushed.state.velocity - free.state.velocity)[-1, 1] > 0.05


@pytest.mark.slow
def test_fine_samples_are_milliseconds(three):
    fine = list(walk_batch(CONFIG, ROBOT, three[0][:2], fine=True))
    for mine, coarse in zip(fine, three[1][:2], strict=True):
        assert mine.fallen.shape == (100,)
        again = at_interval(mine, 0.01)
        for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(coarse), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.slow
def test_physics_in_32_bits_walks_as_in_64(three):
    """After 1.2 s of walking the trunk is within 2 mm; tick means of the wrench within 10 N rms."""
    single = walk_batch(CONFIG, ROBOT, three[0], chunk=2, single=True)
    for mine, double in zip(single, three[1], strict=True):
        np.testing.assert_allclose(mine.state.position, double.state.position, atol=2e-3)
        assert np.sqrt(np.mean((mine.effect.force - double.effect.force) ** 2)) < 10.0
        assert mine.state.position.dtype == double.state.position.dtype
        assert mine.residual.max() < 1e-6


@pytest.mark.slow
def test_both_engines_tell_when_the_legs_touch():
    """A gait so narrow that they do, and nobody falls."""
    narrow = WalkConfig(footstep=FootstepConfig(width=0.01))
    asked = job(expert(), "straight", seconds=0.4)
    mine = next(walk_batch(narrow, ROBOT, [asked]))
    alone = at_interval(walk(narrow, ROBOT, asked), 0.01)
    assert not alone.fallen.any()
    assert alone.legs_touch.any()
    assert not alone.legs_touch.all()
    assert (mine.legs_touch == alone.legs_touch).mean() > 0.9


@pytest.mark.slow
def test_a_fall_in_a_batch_is_held_and_marked():
    """Both engines see the same fall at the same time."""
    jobs = [job(expert(), seconds=1.0), job(expert(), seconds=1.0, push=(0.0, 600.0, 0.0))]
    upright, fall = walk_batch(CONFIG, ROBOT, jobs)
    assert not upright.fallen.any()
    first = int(np.argmax(fall.fallen))
    alone = at_interval(walk(CONFIG, ROBOT, jobs[1]), 0.01)
    assert fall.fallen[-1]
    assert alone.fallen[-1]
    assert first > 0
    assert abs(first - int(np.argmax(alone.fallen))) <= 2
    for leaf in jax.tree.leaves(fall._replace(period=None, initial=None, fallen=None)):
        assert np.isfinite(leaf).all()
        assert (leaf[first:] == leaf[first]).all()
