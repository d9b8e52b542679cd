"""Tuning on walks: the folder, the logs, and files against walks in process."""

import pickle
from concurrent.futures import Executor, Future
from dataclasses import replace

import jax
import numpy as np
import pytest
from model import AHEAD, BRIEF

from hector_jax.cli import run_folder
from hector_jax.cli.flags import Tune
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import save_tree
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import loss_of
from hector_jax.walk_tuning import campaign as campaigns
from hector_jax.walk_tuning import reported_walks, walk_log, walks
from hector_jax.walk_tuning.grounded_model import replayed

# all walks of this file are of these ticks and this command: one set of programs for all tests
CONFIG, COMMAND, SECONDS = TuneConfig(rollout=BRIEF), {"short": AHEAD}, 0.05
WALKS = 8  # so many that each of the methods proposes one
SHORT = """
name = "short"
[[segment]]
seconds = 0.05
v_x = 0.3
"""


class HandsOver(Executor):
    """Does each job at once in this process, on what pickling leaves of it."""

    def submit(self, job, *inputs):
        """Return the result, which was pickled too."""
        job, inputs = pickle.loads(pickle.dumps((job, inputs)))
        done = Future()
        done.set_result(pickle.loads(pickle.dumps(job(*inputs))))
        return done


@pytest.fixture(scope="module")
def robot():
    return jax.tree.map(np.asarray, load_robot())


@pytest.fixture(scope="module")
def pool():
    return HandsOver()


def campaign(folder, robot, plants=(None,), seed=0):
    inputs = folder, CONFIG, robot, nominal(robot), COMMAND, plants, seed
    return campaigns.Campaign(*inputs, leg_numbers=("foot_height",))


@pytest.fixture(scope="module")
def in_process(robot, pool, tmp_path_factory):
    one = campaign(tmp_path_factory.mktemp("walked"), robot, [hfs()])
    rows = walks.tune_on_walks(pool, one, WALKS)
    return one, walks.answer(one, walks.campaign_space(pool, one), rows)[0], rows


def walked(robot, weights, path):
    job = Job(weights, AHEAD, hfs(), SECONDS)
    save_tree(path, walk(CONFIG.rollout.walk, robot, job), kind="trajectory", robot=robot)
    return path


def test_eight_walks_through_files_equal_eight_in_process_to_the_last_bit(
    robot, pool, in_process, tmp_path
):
    one, (_, _, rows) = campaign(tmp_path, robot), in_process
    space, again = walks.campaign_space(pool, one), []
    for number in range(WALKS):
        again = reported_walks.read_reports(pool, one)  # as a new process would
        proposal, weights = walks.next_proposal(pool, one, space, again)
        log = walked(robot, weights, tmp_path / f"{number}.npz")
        again = reported_walks.add_report(pool, one, proposal, [log])
    assert len(again) == len(rows) == WALKS
    for mine, theirs in zip(again, rows, strict=True):
        np.testing.assert_array_equal(mine.point, theirs.point)
        np.testing.assert_array_equal(mine.losses, theirs.losses)
        assert (mine.method, mine.predicted) == (theirs.method, theirs.predicted)
    assert {row.method for row in rows} == {"start", "model", "surrogate"}
    assert min(row.losses[0] for row in rows) < 0.9 * rows[0].losses[0]


def test_what_was_walked_is_not_walked_again(monkeypatch, pool, in_process):
    one, weights, _ = in_process
    monkeypatch.setattr(walks, "walk_case", None)
    again = walks.tune_on_walks(pool, one, WALKS)
    weights_again, _ = walks.answer(one, walks.campaign_space(pool, one), again)
    np.testing.assert_array_equal(weights_again.Q.euler, weights.Q.euler)


def test_a_model_of_every_walk_is_grounded_on_each(monkeypatch, robot, pool, tmp_path):
    seen, model_of = [], walks.grounded_model.model_of

    def watched(*inputs):
        seen.append(len(inputs[3]))
        return model_of(*inputs)

    monkeypatch.setattr(walks.grounded_model, "model_of", watched)
    one = replace(campaign(tmp_path, robot, [hfs()]), model="every_walk")
    rows = walks.tune_on_walks(pool, one, 3)
    assert [row.method for row in rows] == ["start", "model", "model"]
    assert rows[1].losses[0] < 0.95 * rows[0].losses[0]
    assert max(row.predicted for row in rows[1:]) < 0.0
    assert seen == [1, 2]


def test_any_engine_walks_and_is_recorded(robot, in_process, tmp_path):
    jobs = []

    def walk_in(pool, config, robot, some, **options):
        jobs.extend(some)
        return (walk(config, robot, job) for job in some)

    engine = MUJOCO_C._replace(name="mine", walk=walk_in)
    one = replace(campaign(tmp_path, robot, [hfs()]), engine=engine)
    score, _ = walks.walk_case(one, nominal(robot), 0)
    assert len(jobs) == 1
    assert score.loss == in_process[2][0].losses[0]
    walks.read_record(one)
    with pytest.raises(InputError, match="made with engine .mine"):
        walks.read_record(replace(one, engine=MUJOCO_C))


def test_the_record_of_another_tuning_is_refused(robot, in_process):
    one = replace(in_process[0], seed=1)
    with pytest.raises(InputError, match=r"made with seed 0, this command expects 1"):
        walks.read_record(one)


def test_a_start_that_falls_is_refused(robot, pool, in_process, tmp_path):
    one, space = campaign(tmp_path, robot), walks.campaign_space(pool, in_process[0])
    row = walks.Row(np.zeros(19), "start", None, np.array([np.inf]), 1.0)
    with pytest.raises(InputError, match="the start fell"):
        walks.next_proposal(pool, one, space, [row])


@pytest.fixture
def with_legs(robot, pool, tmp_path):
    config = replace(CONFIG, others=("turn_lead",))
    one = replace(campaign(tmp_path, robot), config=config, leg_numbers=("foot_height", "kp"))
    save_tree(tmp_path / "metric.npz", {"matrix": np.eye(19)}, kind="metric", robot=robot)
    return one, walks.campaign_space(pool, one)


def test_numbers_of_the_legs_are_coordinates_of_their_own_within_their_boxes(with_legs):
    one, space = with_legs
    assert space.box.shape == (25, 2)
    point = np.zeros(25)
    point[[19, 21, 24]] = 1.0, -1.0, 1e3
    start, moved = one.start.others, campaigns.weights_at(one, space, point).others
    assert moved["foot_height"] == pytest.approx(start["foot_height"] + 0.018)
    assert moved["kp"] == pytest.approx(
        start["kp"] * [1.0, 0.5, 1.0, 1.0, 1.0] + [0, 0, 0, 0, 2980]
    )
    assert moved["turn_lead"] == start["turn_lead"]
    assert campaigns.weights_at(one, space, point).Q.euler == pytest.approx(one.start.Q.euler)


def test_the_slope_of_the_model_is_zero_along_the_numbers_of_the_legs(with_legs):
    one, space = with_legs

    def loss(point):
        weights = campaigns.weights_at(one, space, point)
        return weights_to_vector(weights).sum() + weights.others["turn_lead"]

    point = np.linspace(-0.1, 0.1, 25)
    weights = campaigns.weights_at(one, space, point)
    gradient = jax.tree.map(np.ones_like, weights)
    slope = campaigns.slope_of(one, space, weights, gradient)
    steps = 1e-5 * np.eye(25)
    differences = [(loss(point + step) - loss(point - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(slope, differences, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(slope[19:], 0.0)


def test_the_numbers_of_the_legs_are_tuned_by_walks_alone(robot):
    with pytest.raises(InputError, match="--tune kp foot_height: only --walks can tune"):
        run_folder.trajectories(Tune(tune=("kp", "foot_height")), robot)


def test_the_reference_of_a_log_is_that_of_its_walk(robot):
    walked = walk(CONFIG.rollout.walk, robot, Job(nominal(robot), AHEAD, hfs(), SECONDS))
    seen, _ = walk_log.evaluate_log(CONFIG, robot, AHEAD, walk_log.log_of(walked))
    assert seen.loss == pytest.approx(float(loss_of(CONFIG.loss, walked)), rel=1e-9)
    assert 0.0 < seen.margin < 0.2


def test_the_sets_to_choose_from_are_the_start_each_gain_and_the_answer(pool, in_process):
    one, weights, rows = in_process
    sets, losses = walks.candidates(pool, one, rows), [row.losses[0] for row in rows]
    numbers = [int(name.removeprefix("set ")) for name in sets]
    assert numbers[0] == 0
    assert numbers == sorted(numbers)
    gains = {n for n in range(1, WALKS) if losses[n] < 0.99 * min(losses[:n])}
    assert gains < set(numbers)
    assert len(set(numbers) - gains) <= 2  # the start and the answer
    assert any(np.array_equal(each.Q.euler, weights.Q.euler) for each in sets.values())


def test_a_replay_keeps_the_mean_over_the_gait_cycle_and_takes_the_deviations_of_another():
    own, other = np.random.default_rng(0).standard_normal((2, 4, 50, 3))  # cycle, phase
    [replay] = replayed([own.reshape(200, 3)], [other.reshape(200, 3)], cycle=50)
    replay = replay.reshape(own.shape)
    np.testing.assert_allclose(replay.mean(0), own.mean(0), atol=1e-12)
    deviations = np.roll(other - other.mean(0), 2, axis=0)  # half a walk later
    np.testing.assert_allclose(replay - replay.mean(0), deviations, atol=1e-12)
