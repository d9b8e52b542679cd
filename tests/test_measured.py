"""Tuning on along measured walks: gradient, guards, and that it goes down."""

import jax
import numpy as np
import pytest

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import ideal
from hector_jax.tuning.difftune import PAPER_ITERATIONS, TuneConfig
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.measured import evaluate_walk, tune_measured
from hector_jax.tuning.rollout import RolloutConfig, rollout

CONFIG = TuneConfig(rollout=RolloutConfig(ticks=6))


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def modelled(robot, ticks=6):
    """The model's own walk, as if it had been measured."""
    config = RolloutConfig(ticks=ticks)
    found = jax.jit(rollout, static_argnums=0)(
        config, robot, nominal(), named_command("s"), standing_anchor(robot), last_command
    )
    return jax.tree.map(np.asarray, found)


def test_a_measured_walk_is_judged_by_its_own_errors(robot):
    walked = modelled(robot)
    # the model stands on joints that do not move; the feet that are measured follow from them
    still = walked._replace(joints=np.broadcast_to(robot.standing_joints, (6, 10)))
    found = evaluate_walk(CONFIG, robot, nominal(), named_command("s"), last_command, still)
    ahead = still.state.position + np.array([0.1, 0.0, 0.0])
    worse = still._replace(state=still.state._replace(position=ahead))
    told = evaluate_walk(CONFIG, robot, nominal(), named_command("s"), last_command, worse)
    assert found.fallen == 0.0
    assert told.terms["L_pos"] > found.terms["L_pos"]
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(told.gradient))
    fell = still._replace(fallen=np.arange(6) > 3)
    told = evaluate_walk(CONFIG, robot, nominal(), named_command("s"), last_command, fell)
    assert told.fallen > 0.0


def test_samples_that_do_not_fill_the_ticks_are_refused(robot):
    walked = modelled(robot, ticks=7)
    with pytest.raises(ValueError, match="each of its 6 ticks, got 7 samples"):
        evaluate_walk(CONFIG, robot, nominal(), named_command("s"), last_command, walked)


def pretend(weights, slope=1.0, fallen=0.0):
    """A loss that is a quadratic in the log-weights, all of it in L_ctrl."""
    away = jax.tree.map(lambda w, n: np.log(w / n) - 1.0, weights, nominal())
    loss = slope * sum(float(np.sum(a**2)) for a in jax.tree.leaves(away))
    gradient = jax.tree.map(lambda a, w: 2.0 * slope * a / w, away, weights)
    terms = {"L_Eul": np.zeros(()), "L_pos": np.zeros(()), "L_ctrl": np.asarray(loss)}
    return Evaluation(np.asarray(loss), terms, gradient, np.asarray(fallen), np.asarray(1e-12))


def test_the_mean_over_the_plants_goes_down_and_iterations_count_from_the_papers_ten():
    seen = []

    def look(weights):
        return [pretend(weights), pretend(weights, 3.0)]

    config = TuneConfig(iterations=PAPER_ITERATIONS + 15)
    found = tune_measured(config, nominal(), look, seen.append)
    losses = [float(i.evaluation.loss) for i in found.history if i.accepted]
    assert found.history[0].iteration == PAPER_ITERATIONS
    assert len(found.history) == len(seen) == 16
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 0.5 * losses[0]
    np.testing.assert_allclose(losses[0], 2.0 * pretend(nominal()).loss)


def test_a_walk_that_falls_at_the_start_is_told():
    with pytest.raises(ValueError, match="cannot be tuned from: the robot fell"):
        tune_measured(TuneConfig(), nominal(), lambda weights: [pretend(weights, fallen=0.1)])


@pytest.mark.slow
def test_a_walk_in_mujoco_gives_a_slope_that_leads_down(robot):
    """A step along the gradient of one short walk on the ideal plant lowers its own loss."""
    config = TuneConfig(rollout=RolloutConfig(ticks=80), iterations=PAPER_ITERATIONS + 3)
    command = named_command("straight")

    def look(weights):
        walked = walk(config.rollout.walk, robot, Job(weights, command, ideal(), 0.8))
        return [evaluate_walk(config, robot, weights, command, last_command, walked)]

    found = tune_measured(config, nominal(), look)
    losses = [float(i.evaluation.loss) for i in found.history if i.accepted]
    assert len(losses) > 1
    assert losses[-1] < losses[0]
    assert np.any(weights_to_vector(found.converged) != weights_to_vector(nominal()))
