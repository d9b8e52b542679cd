"""A net is reused only for its own walks and controller; a loss is one number on either engine."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pretend import instead
from synthetic import synthetic_walk

from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import (
    directions,
    expert,
    nominal,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import read_card
from hector_jax.grfm import dataset
from hector_jax.grfm.collection import collect
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import ENGINES
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.store import nets, tunings
from hector_jax.store.nets import CollectConfig
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.rollout import RolloutConfig, Scenario
from hector_jax.verdict.metrics import score
from hector_jax.walk_tuning import searches


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def gather(folder, robot, /, draw=0, **others):
    """Toy walks with the card of those that a command would collect, but for `others`."""
    collect(
        folder,
        draw_jobs(draw, 5),
        lambda jobs: (synthetic_walk(10 * draw + job.seed, 12) for job in jobs),
        robot=robot,
        settings=nets.collection_settings(CollectConfig(), robot) | others,
    )


def ground(folder, robot, variant="residual"):
    return nets.load_or_train(ThreadPoolExecutor(1), robot, folder, variant)


@dataclass(frozen=True)
class Quick(TrainConfig):
    """A training of one epoch."""

    epochs: int = 1


@pytest.fixture
def quick(monkeypatch):
    """Nets are trained for one epoch, by every command."""
    monkeypatch.setattr(nets, "TrainConfig", Quick)


def test_no_walk_is_in_two_parts(tmp_path, robot):
    gather(tmp_path, robot)
    parts = nets.samples(robot, tmp_path)
    walks = [set(np.unique(part.walk)) for part in parts[:3]]
    assert all(walks)
    assert sum(map(len, walks)) == len(set.union(*walks)) == 5
    net = nets.train_net(TrainConfig("paper", epochs=1), robot, tmp_path, tmp_path / "net.npz")
    held = nets.held_out_walks(robot, net)
    assert set(np.asarray(held.job.seed)) == walks[2]


def test_a_net_is_trained_once(tmp_path, robot, quick, monkeypatch):
    gather(tmp_path / "walks", robot)
    first = ground(tmp_path, robot)
    written = (tmp_path / "grfm.npz").read_bytes()
    monkeypatch.setattr(dataset, "make_dataset", None)  # nor are the walks made samples again
    again = ground(tmp_path, robot)
    assert (tmp_path / "grfm.npz").read_bytes() == written
    for one, other in ((first.params, again.params), (first.linear, again.linear)):
        jax.tree.map(np.testing.assert_array_equal, one, other)
    assert again.errors == first.errors
    assert again.held_out_walks == first.held_out_walks
    card = read_card(tmp_path / "grfm.npz")["about"]
    assert card["settings"]["variant"] == "residual"
    assert card["made_of"]["controller"] == repr(WalkConfig())


@pytest.mark.parametrize(
    ("others", "message"),
    [
        (
            {"seed": 5},
            "walks: made with seed 5, this command expects 0; remove it, or name another",
        ),
        ({"paths": "short"}, "walks: made with paths 'short', this command expects"),
        ({"code": "older"}, "walks: made by other code or other versions of jax, jaxlib, mujoco"),
    ],
)
def test_walks_of_other_settings_are_refused(tmp_path, robot, others, message):
    gather(tmp_path / "walks", robot, **others)
    with pytest.raises(InputError, match=message):
        ground(tmp_path, robot)


def test_a_net_of_other_settings_or_other_walks_is_refused_and_stays(tmp_path, robot, quick):
    path = tmp_path / "grfm.npz"
    gather(tmp_path / "walks", robot)
    nets.train_net(TrainConfig(epochs=2), robot, tmp_path / "walks", path)
    written = path.read_bytes()
    with pytest.raises(InputError, match="grfm.npz: made with epochs 2, this command expects 1;"):
        ground(tmp_path, robot)
    assert path.read_bytes() == written
    gather(tmp_path / "others", robot, draw=1)
    nets.train_net(TrainConfig(epochs=1), robot, tmp_path / "others", path)
    with pytest.raises(InputError, match="grfm.npz: made with content"):
        ground(tmp_path, robot)


@pytest.mark.parametrize("falls", [{1}, {0, 1, 2}])
def test_drawn_models_with_which_the_start_falls_are_left_out(robot, monkeypatch, capsys, falls):
    def tune_step(config, scenario, weights):
        seed = int(scenario.variation.seed)
        loss, fallen = np.array(1.0 + seed), np.array(float(seed in falls))
        return Evaluation(loss, {}, nominal(), fallen, np.array(0.0))

    instead(monkeypatch, tunings.difftune, "tune_step", tune_step)
    setup = Setup(ThreadPoolExecutor(2), TuneConfig(), robot)
    problem = tunings.Problem((named_command("s"),), None, 3)
    found = tunings._objective(setup, nominal(), problem).evaluate(nominal())
    said = capsys.readouterr().err
    assert found.loss == pytest.approx(2.0)  # the mean of 1 and 3, or of all
    if len(falls) == 1:
        assert found.fallen == 0.0
        assert "1 of 3 drawn models left out of the tuning: the weights at the start fall" in said
    else:  # `descend` refuses the start
        assert (found.fallen, said) == (1.0, "")


def test_a_tuning_that_fails_is_told_while_others_go_on(tmp_path, monkeypatch, robot):
    told = threading.Event()

    def tune(setup, start, problem, put):
        if problem.commands is falls:
            raise InputError("the starting weights fall")
        told.wait(60.0)

    instead(monkeypatch, tunings, "_tune_on_cpu", tune)
    falls, walks = (named_command("s"),), (named_command("c"),)
    problems = {"without": tunings.Problem(walks, None), "with": tunings.Problem(falls, None)}
    begin, pool = time.monotonic(), ThreadPoolExecutor(2)
    with pytest.raises(InputError, match="the starting weights fall"):
        tunings.tune_all(Setup(pool, TuneConfig(), robot), problems, tmp_path, title="tuning")
    assert time.monotonic() - begin < 30.0
    told.set()
    pool.shutdown()


@pytest.mark.slow
def test_what_a_search_is_told_is_the_loss_of_the_verdict_on_either_engine(robot):
    config = TuneConfig(rollout=RolloutConfig(ticks=4))
    sets = {"c": [nominal(), expert()], "s": [nominal()]}
    commands = {name: named_command(name) for name in sets}
    pool = ThreadPoolExecutor(1)
    told = {
        name: searches.losses_on_hfs(
            Setup(pool, config, robot), sets, commands=commands, engine=engine, at_once=3
        )
        for name, engine in ENGINES.items()
        if name in ("c", "mjx")
    }
    for name, each in sets.items():
        for weights, loss in zip(each, told["c"][name], strict=True):
            walked = walk(WalkConfig(), robot, Job(weights, named_command(name), hfs(), 0.04))
            assert loss == pytest.approx(float(score(config.loss, walked).L), rel=1e-12)
        np.testing.assert_allclose(told["mjx"][name], told["c"][name], rtol=1e-4)


SHARED = directions() @ directions().T  # curvature of |log(theta)|^2 / 2 in the log-steps


def test_one_set_for_several_lowers_the_mean_of_losses_that_count_alike(robot, monkeypatch):
    """Quadratics of the log-weights, of very different size."""
    sizes = {"c": 1.0, "s": 1e3}
    commands = [named_command(name)._replace(duration=np.array([k])) for name, k in sizes.items()]

    def tune_step(config, scenario, weights):
        vector = np.asarray(weights_to_vector(weights))
        (size,) = scenario.command.duration
        logs = np.log(vector) - (1.0 if size > 1.0 else -1.0)
        gradient = vector_to_weights(jnp.asarray(2.0 * size * logs / vector))
        loss = np.array(size * (logs @ logs))
        terms = dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), loss)
        return Evaluation(loss, terms, gradient, np.array(0.0), np.array(0.0))

    def matrix(config, scenario, weights, loss, *, others):
        return 2.0 * float(scenario.command.duration[0]) * SHARED

    monkeypatch.setattr(tunings.difftune, "tune_step", tune_step)
    monkeypatch.setattr(tunings.difftune, "gauss_newton_jit", matrix)
    config = TuneConfig(iterations=12)
    setup = Setup(ThreadPoolExecutor(2), config, robot)
    for others in ((), (commands[1],)):
        problem = tunings.Problem((commands[0], *others), None)
        found = tunings._tune_on_cpu(setup, nominal(), problem, lambda iteration: None)
        first = found.iterations[0].evaluation
        scenarios = [Scenario(robot, c, None, None) for c in (commands[0], *others)]
        each = [tune_step(config, scenario, nominal()) for scenario in scenarios]
        mean = np.mean([one.loss for one in each])
        assert first.loss == pytest.approx(mean, rel=1e-12)
        scales = [one.loss / mean for one in each]
        for i, gradient in enumerate(jax.tree.leaves(first.gradient)):
            parts = [jax.tree.leaves(e.gradient)[i] / k for e, k in zip(each, scales, strict=True)]
            np.testing.assert_allclose(gradient, np.mean(parts, axis=0), rtol=1e-12)
        assert found.loss < first.loss
        curved = [*sizes.values()][: len(scales)] / np.array(scales if others else [1.0])
        expected = 2.0 * curved.mean() * SHARED / first.loss + config.ridge * np.eye(18)
        np.testing.assert_allclose(found.precision, expected, rtol=1e-12)
        if not others:  # a single one to the last bit
            jax.tree.map(np.testing.assert_array_equal, first, each[0])
