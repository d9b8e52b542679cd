"""Rollouts grounded on measured walks, and tuning on with walks."""

import json
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from pretend import pretend_history

from hector_jax.cli import tune as command
from hector_jax.cli.flags import Tune
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import expert, nominal, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.grfm.effect import last_command
from hector_jax.report.run import tuning_section
from hector_jax.robot.description import TuningSettings
from hector_jax.robot.model import load_robot
from hector_jax.runs import walks
from hector_jax.runs.tunings import Problem, Tuned
from hector_jax.sim.world import hfs, hfs_drawn
from hector_jax.tuning.difftune import PAPER_ITERATIONS, TuneConfig, Tuning
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import Grounding, evaluate_grounded, fit_grounding, grounded_rollout
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.tuning.measured import evaluate_walk
from hector_jax.tuning.rollout import RolloutConfig, rollout

CONFIG = RolloutConfig(ticks=6)
WALKED = named_command("s"), last_command


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def measured(robot):
    """A walk that the model does not explain: joints of a stance, and a drift and a shake."""
    anchor = standing_anchor(robot)
    roll_out = jax.jit(rollout, static_argnums=0)
    command, effect = WALKED
    walk = jax.device_get(roll_out(CONFIG, robot, nominal(), command, anchor, effect))
    shake = 1e-3 * np.random.default_rng(0).standard_normal((6, 3))
    state = jax.tree.map(lambda x: x + shake, walk.state)
    return walk._replace(state=state, joints=np.broadcast_to(robot.standing_joints, (6, 10)))


def test_with_the_weights_that_were_walked_a_grounded_rollout_is_the_walk(robot, measured):
    missed = fit_grounding(CONFIG, robot, nominal(), *WALKED, measured)
    again = jax.jit(grounded_rollout, static_argnums=0)(CONFIG, robot, nominal(), *WALKED, missed)
    for found, there in zip(again.state, measured.state, strict=True):
        np.testing.assert_allclose(found, there[1:], atol=1e-12)
    assert not again.fallen.any()


def test_its_gradient_is_that_along_the_walk_by_forward_recursion(robot, measured):
    missed = fit_grounding(CONFIG, robot, nominal(), *WALKED, measured)
    # that one prices the change from the command before its first tick too
    tracking = tuple(t._replace(weight=t.weight * (t.name != "L_ctrl")) for t in PAPER_LOSS)
    found = evaluate_grounded(CONFIG, robot, nominal(), *WALKED, missed, tracking)
    config = TuneConfig(rollout=CONFIG, loss=tracking)
    along = evaluate_walk(config, robot, nominal(), *WALKED, measured)
    gradients = [weights_to_vector(one.gradient) for one in (found, along)]
    np.testing.assert_allclose(*gradients, rtol=1e-7, atol=1e-7 * np.abs(gradients[1]).max())


def test_a_walk_of_another_length_is_refused(robot, measured):
    with pytest.raises(ValueError, match="a walk of 5 ticks has 6 samples"):
        fit_grounding(RolloutConfig(ticks=5), robot, nominal(), *WALKED, measured)


def _loss(weights, imperfections):
    """A quadratic in the log-weights, larger on a heavier plant, and its gradient."""
    others = weights.others
    weights = weights._replace(others={})
    away = jax.tree.map(lambda w, n: np.log(w / n) - 1.0, weights, nominal())
    size = float(imperfections.mass) * 1e6
    loss = size * (1.0 + sum(float(np.sum(a**2)) for a in jax.tree.leaves(away)))
    gradient = jax.tree.map(lambda a, w: 2.0 * size * a / w, away, weights)
    gradient = gradient._replace(others=jax.tree.map(np.zeros_like, others))
    terms = {term.name: np.asarray(loss) for term in PAPER_LOSS}
    return Evaluation(np.asarray(loss), terms, gradient, np.zeros(()), np.asarray(1e-12))


def _tune(monkeypatch, robot, folder, truth, rounds=6, others=(), start=None):
    """Tune where the model is `_loss` and a walk costs `truth` of it; how often it was walked."""
    count = []

    def walk_job(config, robot, problem, job):
        count.append(job)
        return truth(_loss(job.weights, job.imperfections), job.weights), Grounding(*[None] * 3)

    def evaluate_job(config, robot, problem, weights, job, ground):
        return _loss(weights, job.imperfections)

    monkeypatch.setattr(walks, "_walk_job", walk_job)
    monkeypatch.setattr(walks, "_evaluate_job", evaluate_job)
    plants = [hfs()._replace(mass=np.asarray(m)) for m in (1.0, 5.0)]
    with ThreadPoolExecutor(1) as pool:
        problem = Problem(named_command("s"), None)
        inputs = pool, TuneConfig(others=others), robot, start or nominal(), problem, plants, folder
        return walks.tune_on_walks(*inputs, rounds=rounds, seconds=4.0).tuning, count


def test_walks_that_gain_lead_on_and_what_is_there_is_not_walked_again(
    monkeypatch, robot, tmp_path
):
    tuning, count = _tune(monkeypatch, robot, tmp_path, lambda seen, weights: seen, 2)
    assert [int(i.iteration) for i in tuning.history] == [PAPER_ITERATIONS + k for k in range(3)]
    losses = [float(i.evaluation.loss) for i in tuning.history]
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 0.9 * losses[0]
    assert all(i.accepted for i in tuning.history)
    assert (tuning.stop, len(count)) == ("2 rounds", 6)
    again, count = _tune(monkeypatch, robot, tmp_path, lambda seen, weights: seen, 2)
    assert not count
    np.testing.assert_array_equal(again.converged.Q.euler, tuning.converged.Q.euler)


def test_where_walks_lose_steps_are_halved_until_none_is_left(monkeypatch, robot, tmp_path):
    def worse(seen, weights):
        moved = float(np.abs(np.log(weights.Q.euler / nominal().Q.euler)).max())
        return seen._replace(loss=seen.loss * (1.0 + 10.0 * moved))

    tuning, count = _tune(monkeypatch, robot, tmp_path, worse)
    assert [bool(i.accepted) for i in tuning.history] == [True, False, False, False, False]
    assert [float(i.step_scale) for i in tuning.history[1:]] == [1.0, 0.5, 0.25, 0.125]
    np.testing.assert_array_equal(tuning.converged.Q.euler, nominal().Q.euler)
    assert len(count) == 10


def test_a_start_that_falls_is_walked_once(monkeypatch, robot, tmp_path):
    fell = lambda seen, weights: seen._replace(fallen=np.asarray(0.2))  # noqa: E731
    tuning, count = _tune(monkeypatch, robot, tmp_path, fell)
    assert len(tuning.history) == 1
    assert "fell" in tuning.stop
    assert len(count) == 2
    assert tuning.converged.Q.euler.tolist() == nominal().Q.euler.tolist()
    # the report of such a tuning can be written
    assert "1 refused: " in tuning_section("with_walks", tuning)


def test_what_is_walked_first_has_equal_feet_and_the_other_numbers(monkeypatch, robot, tmp_path):
    force = np.array([[1e-4] * 3, [4e-4] * 3])
    start = nominal()._replace(R=nominal().R._replace(force=force))
    same = lambda seen, weights: seen  # noqa: E731
    tuning, _ = _tune(monkeypatch, robot, tmp_path, same, 1, ("footstep_feedback",), start)
    for one in (i.weights for i in tuning.history):
        np.testing.assert_array_equal(one.R.force[0], one.R.force[1])
        assert set(one.others) == {"footstep_feedback"}


def test_where_the_model_gains_nothing_no_walk_is_repeated(monkeypatch, robot, tmp_path):
    model = _loss
    monkeypatch.setitem(globals(), "_loss", lambda w, plant: _flat(model(w, plant)))
    tuning, count = _tune(monkeypatch, robot, tmp_path, lambda seen, weights: seen)
    assert len(tuning.history) == 1
    assert tuning.stop == "no step gains on the grounded model"
    assert len(count) == 2


def _flat(evaluation):
    return evaluation._replace(loss=np.asarray(1e6))


def test_a_run_has_the_row_and_its_journal_where_the_robot_asks_for_it(
    monkeypatch, robot, tmp_path
):
    asked = TuningSettings(choice_plants=2, walk_rounds=3)
    robot = robot._replace(description=replace(robot.description, tuning=asked))
    there = Tuned(Tuning(pretend_history(3), nominal(), expert(), "done"), "")
    seen = {}

    def on_walks(pool, config, robot, start, problem, plants, folder, **notes):
        seen.update(notes, plants=len(plants), params=problem.params, start=start)
        return there

    monkeypatch.setattr(command.tunings, "tune", lambda *_, **__: {"without": there, "with": there})
    monkeypatch.setattr(command.choice, "choose", lambda *_, **__: {})
    monkeypatch.setattr(command.choice, "answer", lambda *_, **__: nominal())
    monkeypatch.setattr(command, "tune_on_walks", on_walks)
    net = SimpleNamespace(params="a net")
    course = NamedCommand("straight", named_command("straight"))
    notes = {"seconds": 4.0, "config": TuneConfig(), "net": net, "commit": ""}
    run = command._Run(tmp_path, Tune(), robot, nominal(), (course,), **notes)
    tuned = command._tune_sets(Executor(), run)
    assert list(tuned.tunings) == ["without", "with", "with_walks"]
    assert (seen["rounds"], seen["plants"], seen["params"]) == (3, 2, None)
    assert (tmp_path / "weights" / "with_walks.json").exists()
    sets = [json.loads(line)["set"] for line in (tmp_path / "metrics.jsonl").open()]
    assert sets == ["with_walks"] * len(there.tuning.history)


def test_rounds_of_walks_need_plants():
    with pytest.raises(InputError, match="walk_rounds needs plants to walk on"):
        TuningSettings(walk_rounds=2)


def test_a_round_on_the_simulator_gains_there(robot, tmp_path):
    config, problem = TuneConfig(rollout=CONFIG), Problem(named_command("s"), None)
    with ThreadPoolExecutor(1) as pool:
        inputs = pool, config, robot, nominal(), problem, [hfs_drawn(7000, 0.4)], tmp_path
        tuning = walks.tune_on_walks(*inputs, rounds=1, seconds=0.06).tuning
    first, last = (float(one.evaluation.loss) for one in tuning.history)
    assert last < 0.99 * first
    assert tuning.history[-1].accepted
