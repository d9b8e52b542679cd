"""From jobs to walks, shards and samples; nets and scales that are for their own walks only."""

import traceback
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ROBOT
from pretend import HandsOver, call, elsewhere
from synthetic import CYCLE, synthetic_walk, turns

from hector_jax import InputError, TuneConfig, named_command
from hector_jax.cli import tune
from hector_jax.control import mpc
from hector_jax.control.weights import nominal, vector_to_weights, weights_to_vector
from hector_jax.control.weights_file import save_weights
from hector_jax.core.tree import stack
from hector_jax.grfm import dataset
from hector_jax.grfm.dataset import at_interval, make_dataset, with_mirror
from hector_jax.grfm.effect import HISTORY, turn
from hector_jax.grfm.jobs import KINDS, draw_jobs
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot import srbm
from hector_jax.sim.world import Push
from hector_jax.store import nets, tunings
from hector_jax.store.collection import Walks, collect, load_walks
from hector_jax.store.nets import CollectConfig
from hector_jax.store.setup import Setup
from hector_jax.tuning.evaluate import Evaluation

TICKS = 40


def walks_of(*walks):
    return stack([at_interval(walk, 0.01) for walk in walks])


@pytest.fixture(scope="module")
def three():
    return walks_of(*[synthetic_walk(i, TICKS) for i in range(3)])


@pytest.fixture(scope="module")
def data(three):
    return make_dataset(ROBOT, three)[0]


def leaves_close(a, b, atol):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


def test_jobs_take_turns_and_a_longer_list_begins_with_the_shorter():
    short, long = draw_jobs(3, 8), draw_jobs(3, 12)
    leaves_close(short, long[:8], 0.0)
    assert len({float(job.imperfections.backlash) for job in long}) == 12
    assert [np.ptp(job.command.yaw_rate) > 0 for job in short] == [False, False, True, True] * 2
    other = draw_jobs(4, 1)[0]
    assert not np.array_equal(other.weights.Q.euler, short[0].weights.Q.euler)


def test_weights_on_the_log_lines_of_tuning_paths_are_walked_where_paths_are_given():
    """A third of the walks: at the end of a path without a step, and all along a longer one."""
    start, order = np.asarray(weights_to_vector(nominal())), np.arange(24)
    corners = 0.3 * np.clip(np.arange(5)[:, None] - order, 0.0, 1.0)  # a step moves one weight
    paths = [
        stack([vector_to_weights(start * np.exp(row)) for row in path])
        for path in (corners, np.ones((1, 24)))
    ]
    jobs = draw_jobs(0, 300, paths)
    logs = np.log([np.asarray(weights_to_vector(job.weights)) / start for job in jobs])
    places = logs.sum(axis=1) / 0.3
    at_end = np.isclose(logs, 1.0).all(axis=1)
    on_line = np.isclose(logs, 0.3 * np.clip(places[:, None] - order, 0.0, 1.0)).all(axis=1)
    assert list(at_end | on_line) == [i // len(KINDS) % 3 == 2 for i in range(300)]
    assert at_end.sum() > 15
    found = np.sort(places[on_line])
    assert len(found) > 15
    assert np.abs(found - np.linspace(0, 4, len(found))).max() < 1.0  # even along the path
    assert (np.abs(found - np.round(found)) > 1e-3).mean() > 0.9


def test_an_interval_keeps_mean_wrenches_and_last_states():
    walk = synthetic_walk(0, 4)
    fallen = walk.fallen.copy()
    fallen[25:] = True
    coarse = at_interval(walk._replace(fallen=fallen), 0.01)
    np.testing.assert_allclose(coarse.effect.force[1], walk.effect.force[10:20].mean(axis=0))
    np.testing.assert_array_equal(coarse.state.euler[1], walk.state.euler[19])
    np.testing.assert_array_equal(coarse.fallen, [False, False, True, True])
    assert coarse.period == 0.01
    leaves_close(at_interval(coarse, 0.01), coarse, 0.0)


def test_the_time_since_a_switch_counts_from_the_start_and_a_heading_changes_no_sample(three):
    for starts in ([0, 0, 0], [0, 10, 30]):
        data, _ = make_dataset(ROBOT, three, start_tick=starts)
        ticks = data.tick + np.array(starts)[data.walk]
        np.testing.assert_allclose(data.window.since_switch, 0.01 * (ticks % 20))
    walk = synthetic_walk(5, TICKS)
    here, _ = make_dataset(ROBOT, walks_of(walk))
    there, _ = make_dataset(ROBOT, walks_of(elsewhere(walk, (0.0, 0.0), 2.1)))
    leaves_close(here.window, there.window, 1e-10)
    leaves_close(here.label, there.label, 1e-10)
    leaves_close(here.legs, there.legs, 1e-8)


def test_ticks_of_a_push_and_after_a_fall_are_no_samples(three, data):
    push = Push(np.array([[0.0, 9.0, 0.0]]), np.array([0.05]), np.array([0.021]))
    rest, dropped = make_dataset(ROBOT, three, push=push)
    assert dropped == 9
    assert set(data.tick) - set(rest.tick) == {5, 6, 7}
    fallen = three.fallen.copy()
    fallen[2, 30:] = True
    broken = three._replace(fallen=fallen, effect=jax.tree.map(np.copy, three.effect))
    broken.effect.force[2, 35:] = np.nan
    rest, dropped = make_dataset(ROBOT, broken)
    assert dropped == 10
    assert rest.tick[rest.walk == 2].max() == 29
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(rest))


def test_a_mirror_image_has_the_other_foot_s_turn_and_is_its_own_inverse(data):
    second = lambda both: jax.tree.map(lambda x: x[len(data.walk) :], both)  # noqa: E731
    image = second(with_mirror(data))
    np.testing.assert_array_equal(image.window.contact, data.window.contact[:, ::-1])
    np.testing.assert_array_equal(image.walk, data.walk)
    np.testing.assert_allclose(image.label.force[:, 0], data.label.force[:, 1] * [1, -1, 1])
    moment = data.label.moment[:, 0] * [-1, 1, -1]  # as of a mirrored force and lever
    np.testing.assert_allclose(image.label.moment[:, 1], moment)
    leaves_close(second(with_mirror(image)), data, 1e-12)


def walker(walked, stop=None):
    """Walks jobs, one when asked for one, and notes in a list which ones; interrupted at one."""

    def walk_jobs(jobs):
        for job in jobs:
            if job.seed == stop:
                raise KeyboardInterrupt
            walked.append(job.seed)
            yield synthetic_walk(job.seed, 4)

    return walk_jobs


def test_a_collection_takes_up_where_it_stopped_and_has_all_walks_in_order(tmp_path):
    jobs, walked = draw_jobs(0, 6), []
    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path, jobs, walker(walked, stop=5), robot=ROBOT)
    with pytest.raises(ValueError, match="no finished collection"):
        load_walks(tmp_path, ROBOT)
    first = tmp_path / "walk-00001.npz"
    first.write_bytes(first.read_bytes()[:-1])  # damaged: made again
    for _ in range(2):
        collect(tmp_path, jobs, walker(walked), robot=ROBOT)
        assert walked == [0, 1, 2, 3, 4, 1, 5]
    expected = [Walks(job, at_interval(synthetic_walk(i, 4), 0.01)) for i, job in enumerate(jobs)]
    leaves_close(load_walks(tmp_path, ROBOT), stack(expected), 0.0)


def test_a_collection_of_something_else_is_not_overwritten(tmp_path):
    collect(tmp_path, draw_jobs(0, 2), walker([]), robot=ROBOT, settings={"ticks": 4})
    before = (tmp_path / "walk-00000.npz").read_bytes()
    for seed, ticks, fault in (
        (1, 4, "made with jobs"),
        (0, 5, "made with ticks 4, this command expects 5; remove it, or name another"),
    ):
        jobs, settings = draw_jobs(seed, 2), {"ticks": ticks}
        with pytest.raises(ValueError, match=f": {fault}"):
            collect(tmp_path, jobs, walker([]), robot=ROBOT, settings=settings)
    assert (tmp_path / "walk-00000.npz").read_bytes() == before
    with pytest.raises(ValueError, match="walk-00000.npz: made for another robot"):
        load_walks(tmp_path, ROBOT._replace(mass=np.asarray(13.0)))
    (tmp_path / "card.json").unlink()  # nothing tells whose walks these are
    with pytest.raises(ValueError, match="has walks but no card.json"):
        collect(tmp_path, draw_jobs(0, 2), walker([]), robot=ROBOT)


def test_a_sample_is_the_newest_commands_the_effect_of_its_tick_and_what_the_legs_get(three, data):
    assert len(data.walk) == 3 * (TICKS - HISTORY + 1)
    row = np.flatnonzero((data.walk == 1) & (data.tick == 7))[0]
    to_world = turns(three.state.euler[1, 6, 2])
    newest = three.command.force[1, [7, 6, 5]]
    np.testing.assert_allclose(data.window.commands.force[row] @ to_world.T, newest, atol=1e-12)
    label = data.label.moment[row] @ to_world.T
    np.testing.assert_allclose(label, three.effect.moment[1, 7], atol=1e-12)
    np.testing.assert_array_equal(data.state.velocity[row], three.state.velocity[1, 6])
    np.testing.assert_array_equal(data.window.contact[:, 0], data.tick % CYCLE < CYCLE // 2)
    before, after = (jax.tree.map(lambda s, t=t: jnp.asarray(s[1, t]), three.state) for t in (6, 7))
    wrench = jax.tree.map(lambda w: jnp.asarray(w[1, 7]), three.effect)
    feet = jnp.asarray(three.feet[1, 6:8].mean(axis=0))
    push = srbm.unexplained(ROBOT, before, after, wrench, feet, dt=0.01)
    leaves_close(turn(push, -before.euler[2]), jax.tree.map(lambda x: x[row], data.legs), 1e-8)


ONCE = TrainConfig("linear")  # the command's variant here: its fit takes no time


def gather(folder, draw=0, **others):
    """Toy walks with the card of those that a command would collect, but for `others`."""
    walk = lambda jobs: (synthetic_walk(10 * draw + job.seed, 12) for job in jobs)  # noqa: E731
    settings = nets.collection_settings(CollectConfig(), ROBOT) | others
    collect(folder, draw_jobs(draw, 5), walk, robot=ROBOT, settings=settings)


def ground(folder):
    return nets.load_or_train(ThreadPoolExecutor(1), ROBOT, folder, "linear")


def test_no_walk_is_in_two_parts(tmp_path):
    gather(tmp_path)
    parts = nets.samples(ROBOT, tmp_path)
    walks = [set(np.unique(part.walk)) for part in parts[:3]]
    assert all(walks)
    assert sum(map(len, walks)) == len(set.union(*walks)) == 5
    net = nets.train_net(ONCE, ROBOT, tmp_path, tmp_path / "net.npz")
    assert set(np.asarray(nets.held_out_walks(ROBOT, net).job.seed)) == walks[2]


def test_a_net_is_trained_once(tmp_path, monkeypatch):
    gather(tmp_path / "walks")
    first = ground(tmp_path)
    monkeypatch.setattr(dataset, "make_dataset", None)  # nor are the walks made samples again
    again = ground(tmp_path)
    jax.tree.map(np.testing.assert_array_equal, first[:2], again[:2])
    assert (again.errors, again.held_out_walks) == (first.errors, first.held_out_walks)


def test_walks_of_other_code_and_nets_of_other_settings_or_walks_are_refused(tmp_path):
    gather(tmp_path / "old" / "walks", code="older")
    message = "walks: made by other code or other versions of jax, jaxlib, mujoco"
    with pytest.raises(InputError, match=message):
        ground(tmp_path / "old")
    path = tmp_path / "grfm-linear.npz"
    gather(tmp_path / "walks")
    gather(tmp_path / "others", draw=1)
    for config, walks, fault in (
        (TrainConfig("linear", epochs=2), "walks", "epochs 2, this command expects"),
        (ONCE, "others", "content"),
    ):
        nets.train_net(config, ROBOT, tmp_path / walks, path)
        written = path.read_bytes()
        with pytest.raises(InputError, match=f"grfm-linear.npz: made with {fault}"):
            ground(tmp_path)
        assert path.read_bytes() == written


@pytest.mark.parametrize(
    ("sizes", "draws", "stand", "counted"),
    [
        ((1.0, 1e3), 0, 0, [1.0, 1e3]),
        ((1.0,), 3, 2, [1.0, 2.0]),
        ((1.0,), 3, 0, [1.0, 2.0, 3.0]),  # all fall: the tuning refuses the start
    ],
)
def test_losses_count_alike_and_falls_do_not(monkeypatch, capsys, sizes, draws, stand, counted):
    """The loss is the duration of the command, times more for a model of a higher seed."""

    def slope(config, scenario, weights):
        seed = 0 if scenario.variation is None else int(scenario.variation.seed)
        loss = scenario.command.duration[0] * (1.0 + seed)
        fallen = np.array(float(draws > 0 and seed >= stand))
        return Evaluation(loss, {}, nominal(), fallen, np.array(0.0)), np.eye(18)

    monkeypatch.setattr(tunings.difftune, "model_slope", slope)
    commands = [named_command("s")._replace(duration=np.array([size])) for size in sizes]
    problem = tunings.Problem(tuple(commands), None, draws)
    setup = Setup(ThreadPoolExecutor(2), TuneConfig(), ROBOT)
    objective = tunings._objective(setup, nominal(), problem)
    found, matrix = objective.slope(nominal())
    said = " ".join(capsys.readouterr().err.split())
    if draws and not stand:
        with pytest.raises(InputError, match="weights cannot be tuned from: the robot fell"):
            tunings._tune_on_cpu(setup, nominal(), problem, print)
    else:
        assert float(found.fallen) == 0.0
    relative = np.mean(1.0 / np.array(counted)) * np.eye(18)
    np.testing.assert_allclose(matrix / float(found.loss), relative)
    told = "1 of 3 drawn models left out of the tuning: the weights at the start fall"
    assert (told in said) == (stand == 2)


def test_from_the_command_to_the_qp_the_stack_has_14_frames(monkeypatch, tmp_path):
    """Where the programs of a tuning are compiled, in one process; the table is in CONTRIBUTING."""
    frames, package = [], str(Path(tunings.__file__).parents[1])

    def solve_qp(*_):
        frames.extend(f for f in traceback.extract_stack() if f.filename.startswith(package))
        raise InputError("the QP")

    monkeypatch.setattr(mpc, "solve_qp", solve_qp)
    monkeypatch.setattr(tunings, "not_the_weights", slice)  # any function of three
    monkeypatch.setattr(tune, "workers", lambda *_: nullcontext(HandsOver()))
    trajectory, start = tmp_path / "brief.toml", tmp_path / "start.json"
    trajectory.write_text('name = "brief"\n[[segment]]\nseconds = 0.15\nv_x = 0.2\n')
    save_weights(start, nominal())
    flags = ("--traj", trajectory, "--start", start, "--out", tmp_path / "run")
    assert call(monkeypatch, "tune", *flags) == 2
    assert len(frames) + 1 == 14  # with that of `solve_qp`
