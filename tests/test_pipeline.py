"""A net is reused only for its own walks and controller; a loss is one number on either engine."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from synthetic import synthetic_walk

from hector_jax import pipeline
from hector_jax.control.reference import named_command
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import expert, nominal
from hector_jax.evaluation.metrics import score
from hector_jax.grfm.dataset import collect, draw_jobs
from hector_jax.grfm.network import NetParams, ResidualParams
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot import load_robot
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.storage import read_card
from hector_jax.tuning.difftune import TuneConfig
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
