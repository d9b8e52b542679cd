"""From jobs to walks, shards and samples."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import CYCLE, synthetic_walk, turn_walk

from hector_jax.control.reference import Anchor, named_command, reference_at
from hector_jax.control.weights import expert, nominal, vector_to_weights, weights_to_vector
from hector_jax.core.tree import stack
from hector_jax.grfm.collection import collect, load_walks
from hector_jax.grfm.dataset import at_interval, make_dataset, split_by_walk, with_mirror
from hector_jax.grfm.effect import HISTORY, turn
from hector_jax.grfm.jobs import KINDS, PIECES, draw_jobs
from hector_jax.robot import srbm
from hector_jax.robot.model import load_robot
from hector_jax.sim.world import Push

TICKS = 40


def walks_of(*walks):
    return jax.tree.map(lambda *x: np.stack(x), *[at_interval(w, 0.01) for w in walks])


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def three():
    return walks_of(*[synthetic_walk(i, TICKS) for i in range(3)])


def leaves_close(a, b, atol):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


# --- jobs ---


def test_jobs_take_turns_and_a_longer_list_begins_with_the_shorter():
    short, long = draw_jobs(3, 8), draw_jobs(3, 12)
    leaves_close(short, long[:8], 0.0)
    assert len({float(job.imperfections.backlash) for job in long}) == 12
    assert [np.ptp(job.command.yaw_rate) > 0 for job in short] == [False, False, True, True] * 2
    other = draw_jobs(4, 1)[0]
    assert not np.array_equal(other.weights.Q.euler, short[0].weights.Q.euler)


def test_drawn_weights_lie_within_a_third_and_three_times_of_their_centres():
    jobs = draw_jobs(0, 64)
    for i, job in enumerate(jobs):
        centre = (nominal(), expert())[i // len(KINDS) % 2]
        ratio = np.asarray(weights_to_vector(job.weights) / weights_to_vector(centre))
        assert np.all((ratio > 1 / 3.001) & (ratio < 3.001))
    logs = np.log([np.asarray(weights_to_vector(j.weights)) for j in jobs[:4] + jobs[8:12]])
    assert np.all(logs.std(axis=0) > 0.1)


def test_a_third_of_the_walks_is_pushed_once_or_twice():
    pushes = [job.push for job in draw_jobs(0, 300)]
    size = np.array([np.linalg.norm(push.force, axis=1) for push in pushes])
    number = (size > 0.0).sum(axis=1)
    assert 0.25 < np.mean(number > 0) < 0.42
    assert set(number) == {0, 1, 2}
    assert size[size > 0.0].min() >= 10.0
    assert size.max() <= 30.0
    for push in pushes:
        assert np.all((push.start >= 0.0) & (push.start + push.duration <= 4.0))
        assert not push.force[:, 2].any()


def test_weights_on_the_log_lines_of_tuning_paths_are_walked_where_paths_are_given():
    """A third of the walks; between the accepted points of one path, and all along it."""
    rng = np.random.default_rng(0)
    logs = [np.cumsum(rng.normal(size=(n, 24)) * 0.3, axis=0) for n in (5, 2, 1)]
    start = np.asarray(weights_to_vector(nominal()))
    paths = [stack([vector_to_weights(start * np.exp(row)) for row in path]) for path in logs]

    def place(weights):
        """Path and position of weights on its lines; none if they lie on no line."""
        at = np.log(np.asarray(weights_to_vector(weights)) / start)
        for number, path in enumerate(logs):
            for i, (a, b) in enumerate(zip(path, path[1:], strict=False)):
                share = (at - a) @ (b - a) / ((b - a) @ (b - a))
                if 0.0 <= share <= 1.0 and np.allclose(at, a + share * (b - a), atol=1e-9):
                    return number, i + share
            if np.allclose(at, path[-1], atol=1e-9):
                return number, len(path) - 1.0
        return None

    found = [place(job.weights) for job in draw_jobs(0, 300, paths)]
    assert [p is not None for p in found] == [i // len(KINDS) % 3 == 2 for i in range(300)]
    places = {k: np.array([p[1] for p in found if p and p[0] == k]) for k in range(3)}
    assert min(map(len, places.values())) > 15
    assert set(places[2]) == {0.0}  # a path that ended at its start
    whole = np.sort(places[0])
    assert np.abs(whole - np.linspace(0, 4, len(whole))).max() < 1.0  # even along the path
    assert (np.abs(whole - np.round(whole)) > 1e-3).mean() > 0.9


def test_named_commands_are_walked_unchanged():
    anchor = Anchor(jnp.zeros(3), jnp.array(0.0), jnp.array(0))
    for name, job in zip(KINDS, draw_jobs(0, 3), strict=False):
        assert job.command.duration.shape == (PIECES,)
        for tick in (0.0, 150.0, 250.0, 399.0, 530.0):
            leaves_close(
                reference_at(0.01, job.command, anchor, jnp.array(tick)),
                reference_at(0.01, named_command(name), anchor, jnp.array(tick)),
                1e-12,
            )


# --- walks at the plan interval ---


def test_an_interval_keeps_mean_wrenches_and_last_states():
    walk = synthetic_walk(0, 4)
    fallen = walk.fallen.copy()
    fallen[25:] = True
    coarse = at_interval(walk._replace(fallen=fallen), 0.01)
    np.testing.assert_allclose(coarse.effect.force[1], walk.effect.force[10:20].mean(axis=0))
    np.testing.assert_array_equal(coarse.state.euler[1], walk.state.euler[19])
    np.testing.assert_array_equal(coarse.fallen, [False, False, True, True])
    assert coarse.period == 0.01
    again = at_interval(coarse, 0.01)
    leaves_close(again, coarse, 0.0)


@pytest.mark.parametrize("interval", [0.0004, 0.0015, 0.012])
def test_samples_that_do_not_fill_intervals_are_refused(interval):
    with pytest.raises(ValueError, match="40 samples of 0.001 s do not fill"):
        at_interval(synthetic_walk(0, 4), interval)


# --- samples ---


def test_a_sample_is_the_newest_commands_and_the_effect_of_its_tick(three, robot):
    data, dropped = make_dataset(robot, three)
    assert dropped == 0
    assert len(data.walk) == 3 * (TICKS - HISTORY + 1)
    row = np.flatnonzero((data.walk == 1) & (data.tick == 7))[0]
    yaw = three.state.euler[1, 6, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    to_world = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    for age in range(HISTORY):
        np.testing.assert_allclose(
            data.window.commands.force[row, age] @ to_world.T,
            three.command.force[1, 7 - age],
            atol=1e-12,
        )
    np.testing.assert_allclose(
        data.label.moment[row] @ to_world.T, three.effect.moment[1, 7], atol=1e-12
    )
    np.testing.assert_array_equal(data.state.velocity[row], three.state.velocity[1, 6])
    np.testing.assert_array_equal(data.window.contact[row], three.contact[1, 7])
    np.testing.assert_allclose(data.window.since_switch, 0.01 * (data.tick % 20))


def test_the_window_agrees_with_the_planned_contact(three, robot):
    data, _ = make_dataset(robot, three)
    np.testing.assert_array_equal(data.window.contact[:, 0], data.tick % CYCLE < CYCLE // 2)


def test_the_time_since_a_switch_counts_from_the_start_tick(three, robot):
    data, _ = make_dataset(robot, three, start_tick=[0, 10, 30])
    starts = np.array([0, 10, 30])[data.walk]
    np.testing.assert_allclose(data.window.since_switch, 0.01 * ((data.tick + starts) % 20))


def test_a_walk_on_another_heading_makes_the_same_samples(robot):
    walk = synthetic_walk(5, TICKS)
    here, _ = make_dataset(robot, walks_of(walk))
    there, _ = make_dataset(robot, walks_of(turn_walk(walk, 2.1)))
    leaves_close(here.window, there.window, 1e-10)
    leaves_close(here.label, there.label, 1e-10)
    leaves_close(here.legs, there.legs, 1e-8)


def test_samples_after_a_fall_are_dropped_and_counted(three, robot):
    fallen = three.fallen.copy()
    fallen[2, 30:] = True
    broken = three._replace(fallen=fallen)
    broken.effect.force[2, 35:] = np.nan
    data, dropped = make_dataset(robot, broken)
    assert dropped == 10
    assert data.tick[data.walk == 2].max() == 29
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(data))


def test_a_mirror_image_has_the_other_foot_s_turn_and_is_its_own_inverse(three, robot):
    data, _ = make_dataset(robot, three)
    n = len(data.walk)
    both = with_mirror(data)
    image = jax.tree.map(lambda x: x[n:], both)
    np.testing.assert_array_equal(image.window.contact, data.window.contact[:, ::-1])
    np.testing.assert_array_equal(image.walk, data.walk)
    np.testing.assert_allclose(image.label.force[:, 0], data.label.force[:, 1] * [1, -1, 1])
    # the moment of a mirrored force about a mirrored point
    lever, force = np.array([0.02, 0.03, 0.01]), np.array([5.0, -7.0, 90.0])
    along, across = np.array([1, -1, 1]), np.array([-1, 1, -1])
    np.testing.assert_allclose(
        np.cross(lever * along, force * along), np.cross(lever, force) * across
    )
    np.testing.assert_allclose(image.label.moment[:, 1], data.label.moment[:, 0] * across)
    again = jax.tree.map(lambda x: x[n:], with_mirror(image))
    leaves_close(again, data, 1e-12)


def test_ticks_of_a_push_are_no_samples(three, robot):
    none, dropped_anyway = make_dataset(robot, three)
    push = Push(np.array([[0.0, 9.0, 0.0]]), np.array([0.05]), np.array([0.021]))
    data, dropped = make_dataset(robot, three, push=push)
    assert dropped == dropped_anyway + 9
    assert set(none.tick) - set(data.tick) == {5, 6, 7}


def test_no_walk_is_in_both_parts_of_a_split(three, robot):
    data, _ = make_dataset(robot, three)
    for share in (0.01, 0.4, 0.99):
        train, held = split_by_walk(data, share, seed=1)
        assert not set(train.walk) & set(held.walk)
        assert set(train.walk) | set(held.walk) == {0, 1, 2}
        assert len(train.walk) + len(held.walk) == len(data.walk)


# --- collection ---


def walker(walked=None):
    """Walks jobs, one when asked for one, and notes in a list which ones."""

    def walk_jobs(jobs):
        for job in jobs:
            if walked is not None:
                walked.append(job.seed)
            yield synthetic_walk(job.seed, 4)

    return walk_jobs


def test_collected_walks_come_back_in_order_with_their_jobs(tmp_path, robot):
    jobs, steps = draw_jobs(0, 5), []
    note = lambda *done: steps.append(done)  # noqa: E731
    collect(tmp_path / "data", jobs, walker(), robot=robot, progress=note)
    assert steps == [(i, 5) for i in range(6)]
    walks = load_walks(tmp_path / "data", robot)
    np.testing.assert_array_equal(walks.job.seed, range(5))
    leaves_close(jax.tree.map(lambda x: x[3], walks.job), jobs[3], 0.0)
    expected = at_interval(synthetic_walk(3, 4), 0.01)
    leaves_close(jax.tree.map(lambda x: x[3], walks.trajectory), expected, 0.0)


def test_collection_takes_up_where_it_stopped(tmp_path, robot):
    jobs, walked = draw_jobs(0, 6), []

    def stops(chunk):
        yield from itertools.islice(walker(walked)(chunk), 5)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect(tmp_path, jobs, stops, robot=robot)
    with pytest.raises(ValueError, match="no finished collection"):
        load_walks(tmp_path, robot)
    first = tmp_path / "walk-00001.npz"
    first.write_bytes(first.read_bytes()[:-1])  # damaged: made again
    walked.clear()
    collect(tmp_path, jobs, walker(walked), robot=robot)
    assert walked == [1, 5]
    collect(tmp_path, jobs, walker(walked), robot=robot)
    assert len(walked) == 2
    assert len(load_walks(tmp_path, robot).job.seed) == 6


def test_a_collection_of_something_else_is_not_overwritten(tmp_path, robot):
    collect(tmp_path, draw_jobs(0, 2), walker(), robot=robot, settings={"ticks": 4})
    before = (tmp_path / "walk-00000.npz").read_bytes()
    heavier = robot._replace(mass=np.asarray(robot.mass) + 1.0)
    for jobs, body, ticks, message in (
        (draw_jobs(1, 2), robot, 4, "walk-00000.npz: collected for other walks"),
        (draw_jobs(0, 2), robot, 5, "walk-00000.npz: made with ticks 4, this command expects 5"),
        (draw_jobs(0, 2), heavier, 4, "walk-00000.npz: made for robot"),
    ):
        with pytest.raises(ValueError, match=message):
            collect(tmp_path, jobs, walker(), robot=body, settings={"ticks": ticks})
    assert (tmp_path / "walk-00000.npz").read_bytes() == before
    with pytest.raises(ValueError, match="walk-00000.npz: made for robot"):
        load_walks(tmp_path, heavier)


def test_the_legs_get_what_the_wrench_does_not_explain(three, robot):
    data, _ = make_dataset(robot, three)
    row, walk, j = np.flatnonzero((data.walk == 1) & (data.tick == 7))[0], 1, 7
    before, after = (
        jax.tree.map(lambda s, t=t: jnp.asarray(s[walk, t]), three.state) for t in (j - 1, j)
    )
    wrench = jax.tree.map(lambda w: jnp.asarray(w[walk, j]), three.effect)
    feet = jnp.asarray(three.feet[walk, j - 1 : j + 1].mean(axis=0))
    push = srbm.unexplained(robot, before, after, wrench, feet, dt=0.01)
    leaves_close(turn(push, -before.euler[2]), jax.tree.map(lambda x: x[row], data.legs), 1e-8)
