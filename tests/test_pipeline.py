"""A net is reused only for its own walks and controller; a loss is one number on either engine."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from pretend import pretend_history
from synthetic import synthetic_walk

from hector_jax import pipeline
from hector_jax.control.reference import named_command
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import expert, nominal
from hector_jax.evaluation.metrics import score
from hector_jax.grfm.dataset import collect, draw_jobs, draw_jobs_near
from hector_jax.grfm.network import NetParams
from hector_jax.grfm.training import TrainConfig
from hector_jax.pipeline import CollectConfig
from hector_jax.robot import load_robot
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.storage import read_card
from hector_jax.tuning.difftune import TuneConfig, Tuning
from hector_jax.tuning.rollout import RolloutConfig

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


def test_a_net_of_another_variant_is_refused_and_kept(tmp_path, robot):
    gather(tmp_path / "walks", robot)
    path = tmp_path / "grfm.npz"
    pipeline.train(TrainConfig("paper", epochs=1), robot, tmp_path / "walks", path)
    written = path.read_bytes()
    gather(tmp_path / "others", robot, seed=1)
    pool = ThreadPoolExecutor(1)
    expected = "grfm.npz: holds grfm-paper, expected grfm-residual"
    with pytest.raises(ValueError, match=expected):
        pipeline.ground(pool, TuneConfig(), robot, tmp_path)
    with pytest.raises(ValueError, match=expected):  # though it is stale too
        pipeline.learned(QUICK, robot, tmp_path / "others", path)
    assert path.read_bytes() == written


def test_a_net_is_kept_and_found_by_its_variant(tmp_path, robot, monkeypatch):
    assert pipeline.net_path(tmp_path, "residual") == tmp_path / "grfm.npz"
    path = pipeline.net_path(tmp_path, "paper")
    assert path == tmp_path / "grfm-paper.npz"
    gather(tmp_path / "walks", robot)
    pipeline.train(TrainConfig("paper", epochs=1), robot, tmp_path / "walks", path)
    monkeypatch.setattr(pipeline, "train", None)  # nothing is to be trained again
    found = pipeline.ground(ThreadPoolExecutor(1), TuneConfig(), robot, tmp_path, "paper")
    assert isinstance(found.params, NetParams)


def test_walks_of_another_controller_are_refused(tmp_path, robot):
    gather(tmp_path / "walks", robot, controller="another")
    pool = ThreadPoolExecutor(1)
    with pytest.raises(ValueError, match="walks: walked by another controller"):
        pipeline.ground(pool, TuneConfig(), robot, tmp_path)


@pytest.mark.slow
def test_what_a_search_is_told_is_the_loss_of_the_verdict_on_either_engine(robot):
    config = TuneConfig(rollout=RolloutConfig(ticks=4))
    sets = {"c": [nominal(), expert()], "s": [nominal()]}
    pool = ThreadPoolExecutor(1)
    told = {
        engine: pipeline.losses_on_hfs(pool, config, robot, engine, sets, at_once=3)
        for engine in ("c", "mjx")
    }
    for name, each in sets.items():
        for weights, loss in zip(each, told["c"][name], strict=True):
            walked = walk(WalkConfig(), robot, weights, named_command(name), hfs(), 0.04)
            assert loss == pytest.approx(float(score(config.loss, walked).L), rel=1e-12)
        np.testing.assert_allclose(told["mjx"][name], told["c"][name], rtol=1e-4)
