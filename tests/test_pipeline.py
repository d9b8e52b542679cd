"""A net is reused only for the walks and the controller that it was made of."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from pretend import pretend_history
from synthetic import synthetic_walk

from hector_jax import pipeline
from hector_jax.control.reference import named_command
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import nominal
from hector_jax.grfm.dataset import collect, draw_jobs, draw_jobs_near
from hector_jax.grfm.network import NetParams, ResidualParams
from hector_jax.grfm.training import TrainConfig
from hector_jax.pipeline import CollectConfig
from hector_jax.robot import load_robot
from hector_jax.storage import read_card
from hector_jax.tuning.difftune import TuneConfig, Tuning

QUICK = TrainConfig(epochs=1)


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def gather(folder, robot, seed=0, controller=None):
    collect(
        folder,
        draw_jobs(seed, 5),
        lambda jobs: (synthetic_walk(10 * seed + job.seed, 12) for job in jobs),
        robot=robot,
        about={"controller": controller or repr(WalkConfig())},
    )


def test_no_walk_is_in_two_parts(tmp_path, robot):
    gather(tmp_path, robot)
    parts = pipeline.samples(robot, tmp_path)
    walks = [set(np.unique(part.walk)) for part in parts[:3]]
    assert all(walks)
    assert sum(map(len, walks)) == len(set.union(*walks)) == 5
    held = pipeline.held_out(robot, tmp_path)
    assert set(np.asarray(held.job.seed)) == walks[2]


def test_a_net_is_trained_once_and_again_for_other_walks(tmp_path, robot):
    path = tmp_path / "grfm.npz"
    gather(tmp_path / "one", robot)
    first = pipeline.learned(QUICK, robot, tmp_path / "one", path)
    written = path.read_bytes()
    again = pipeline.learned(QUICK, robot, tmp_path / "one", path)
    assert path.read_bytes() == written
    jax.tree.map(np.testing.assert_array_equal, first.params, again.params)
    assert again.errors.keys() == {"raw", "linear", "net"}
    card = read_card(path)["about"]
    assert card["settings"]["variant"] == "residual"
    assert card["made_of"]["controller"] == repr(WalkConfig())
    gather(tmp_path / "two", robot, seed=1)
    pipeline.learned(QUICK, robot, tmp_path / "two", path)
    assert read_card(path)["about"]["made_of"] != card["made_of"]


def test_what_was_held_out_stays_held_out_beside_other_walks(tmp_path, robot):
    one, two = tmp_path / "one", tmp_path / "two"
    gather(one, robot)
    gather(two, robot, seed=1)
    alone = [pipeline.samples(robot, folder) for folder in (one, two)]
    both = pipeline.samples(robot, one, two)
    joined = jax.tree.map(lambda *x: np.concatenate(x), *(part[:3] for part in alone))
    jax.tree.map(np.testing.assert_array_equal, tuple(both[:3]), joined)
    assert both.dropped == sum(part.dropped for part in alone)


def test_a_refresh_walks_where_the_tuning_went_and_tells_the_shift(tmp_path, robot, monkeypatch):
    old, folder, few = tmp_path / "walks", tmp_path / "refresh-1", CollectConfig(5, engine="c")
    gather(old, robot)
    before = pipeline.train(TrainConfig("paper", epochs=1), robot, old, tmp_path / "grfm.npz")
    history = pretend_history(14, refused=(12,))
    tuning = Tuning(history, history[10].weights, history[-1].weights, "")
    walked, trained = [], []

    def walk_many(pool, config, robot, jobs):
        walked.extend(jobs)
        return (synthetic_walk(100 + job.seed, 12) for job in jobs)

    def train(config, robot, folder, path, more):
        trained.append((config, folder, path, *more))
        return before._replace(folders=(folder, *more))

    monkeypatch.setattr(pipeline, "walk_many", walk_many)
    monkeypatch.setattr(pipeline, "train", train)
    for _ in range(2):  # the second time takes up the walks
        after, shift = pipeline.refresh(
            ThreadPoolExecutor(1),
            few,
            TuneConfig(),
            robot,
            named_command("s"),
            tuning,
            before,
            folder,
        )
    new = folder / "walks"
    path = jax.tree.map(lambda w: np.stack(4 * [w]), nominal())  # ten, 11, 13 and 14
    jobs = draw_jobs_near(0, 5, named_command("s"), path)
    jax.tree.map(np.testing.assert_array_equal, walked, jobs)
    assert trained == 2 * [(before.config, old, folder / "refreshed.npz", new)]
    assert after.folders == (old, new)
    assert shift.keys() == {"old", "new"}
    assert all(errors.keys() == {"raw", "before", "after"} for errors in shift.values())
    assert shift["old"]["before"] == before.errors["net"]
    assert shift["new"]["before"] != shift["old"]["before"]


def test_the_variant_that_was_trained_is_the_one_that_is_used(tmp_path, robot):
    gather(tmp_path / "walks", robot)
    paper = TrainConfig("paper", epochs=1)
    pipeline.train(paper, robot, tmp_path / "walks", tmp_path / "grfm.npz")
    found = pipeline.learned(QUICK, robot, tmp_path / "walks", tmp_path / "grfm.npz")
    assert isinstance(found.params, NetParams)
    other = pipeline.learned(QUICK, robot, tmp_path / "walks", tmp_path / "other.npz")
    assert isinstance(other.params, ResidualParams)


def test_walks_of_another_controller_are_refused(tmp_path, robot):
    gather(tmp_path / "walks", robot, controller="another")
    pool = ThreadPoolExecutor(1)
    with pytest.raises(ValueError, match="walks: walked by another controller"):
        pipeline.ground(pool, TuneConfig(), robot, tmp_path)
