"""The closed loop in MJX, against MuJoCo C."""

from functools import partial

import jax
import numpy as np
import pytest
from model import OTHERS, ROBOT

from hector_jax import Job, WalkConfig, expert, load_robot, named_command, nominal, walk
from hector_jax.grfm.dataset import at_interval
from hector_jax.robot.description import MODEL_PATH
from hector_jax.sim.mjx_model import batched_model, mjx
from hector_jax.sim.parallel import walk_batch
from hector_jax.sim.standin import standin
from hector_jax.sim.world import Push, build_world, build_worlds, hfs, hfs_drawn, ideal

CONFIG = WalkConfig()
UNUSED = ("cam_", "light_", "actuator_acc0")  # by MJX, in a robot without muscles


def test_only_what_differs_is_batched_and_contacts_are_of_feet_and_between_legs_alone():
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
    toml = tmp_path / "hector.toml"
    toml.write_text('model = "hector.xml"')
    with pytest.raises(ValueError, match="geom trunk .* is a CYLINDER; .* BOX or CAPSULE"):
        walk_batch(CONFIG, load_robot(toml), [job(expert())])


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
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-3), mine, alone)
        np.testing.assert_allclose(mine.state.position, alone.state.position, atol=1e-6)
    pushed, _, free = three[1]
    assert (pushed.state.velocity - free.state.velocity)[-1, 1] > 0.05


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
def test_both_engines_see_a_fall_at_the_same_time_and_hold_it():
    jobs = [job(expert(), seconds=1.0), job(expert(), seconds=1.0, push=(0.0, 600.0, 0.0))]
    upright, fall = walk_batch(CONFIG, ROBOT, jobs)
    alone = at_interval(walk(CONFIG, ROBOT, jobs[1]), 0.01)
    assert not upright.fallen.any()
    assert fall.fallen[-1]
    assert alone.fallen[-1]
    first = int(np.argmax(fall.fallen))
    assert first > 0
    assert abs(first - int(np.argmax(alone.fallen))) <= 2
    for leaf in jax.tree.leaves(fall._replace(period=None, initial=None, fallen=None)):
        assert np.isfinite(leaf).all()
        assert (leaf[first:] == leaf[first]).all()
