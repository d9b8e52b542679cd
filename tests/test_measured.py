"""Tuning on along measured walks, and rollouts grounded on them."""

import jax
import numpy as np
import pytest
from measured import evaluate_walk, tune_measured
from model import AHEAD, BRIEF, PLAIN

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import directions, nominal, weights_to_vector
from hector_jax.core.trajectory import State, Wrench, no_samples
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import ideal
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import (
    evaluate_grounded,
    fit_grounding,
    grounded_matrix,
    grounded_rollout,
)
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.tuning.rollout import RolloutConfig, Scenario

CONFIG, WALKED = TuneConfig(rollout=BRIEF), (AHEAD, PLAIN)


def scenario(robot):
    return Scenario(robot, AHEAD, standing_anchor(robot), PLAIN)


@pytest.fixture(scope="module")
def robot():
    return load_robot()


def standing(robot, ticks=BRIEF.ticks):
    """A walk of a robot that only stands, as if it had been measured."""
    place = np.append(np.asarray(robot.com_offset)[:2], robot.standing_height)
    zero, weight = np.zeros((ticks, 3)), np.asarray(robot.mass * robot.gravity)
    state = State(zero, zero + place, zero, zero)
    force = np.broadcast_to(weight / 2, (ticks, 2, 3))
    return no_samples(10, 2)._replace(
        period=np.array(0.01),
        initial=jax.tree.map(lambda x: x[0], state),
        state=state,
        command=Wrench(force, np.zeros_like(force)),
        joints=np.broadcast_to(robot.standing_joints, (ticks, 10)),
        fallen=np.zeros(ticks, bool),
        residual=np.zeros(ticks),
    )


@pytest.fixture(scope="module")
def measured(robot):
    """A walk that the model does not explain: joints of a stance, and a shake."""
    walk = standing(robot)
    shake = 1e-3 * np.random.default_rng(0).standard_normal((BRIEF.ticks, 3))
    return walk._replace(state=jax.tree.map(lambda x: x + shake, walk.state))


def test_a_measured_walk_is_judged_by_its_own_errors(robot):
    still = standing(robot)
    found, matrix = evaluate_walk(CONFIG, robot, nominal(), *WALKED, still)
    ahead = still.state.position + np.array([0.1, 0.0, 0.0])
    worse = still._replace(state=still.state._replace(position=ahead))
    told, _ = evaluate_walk(CONFIG, robot, nominal(), *WALKED, worse)
    assert found.fallen == 0.0
    assert told.terms["L_pos"] > found.terms["L_pos"]
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(told.gradient))
    assert np.linalg.eigvalsh(matrix).min() > -1e-9 * np.linalg.norm(matrix)
    fell = still._replace(fallen=np.arange(BRIEF.ticks) > 3)
    told, _ = evaluate_walk(CONFIG, robot, nominal(), *WALKED, fell)
    assert told.fallen > 0.0


def test_samples_that_do_not_fill_the_ticks_are_refused(robot):
    walked = standing(robot, ticks=7)
    with pytest.raises(ValueError, match="each of its 5 ticks, got 7 samples"):
        evaluate_walk(CONFIG, robot, nominal(), *WALKED, walked)


def pretend(weights, slope=1.0, fallen=0.0):
    """A loss that is a quadratic in the log-weights, all of it in L_ctrl."""
    away = jax.tree.map(lambda w, n: np.log(w / n) - 1.0, weights, nominal())
    loss = slope * sum(float(np.sum(a**2)) for a in jax.tree.leaves(away))
    gradient = jax.tree.map(lambda a, w: 2.0 * slope * a / w, away, weights)
    terms = {"L_Eul": np.zeros(()), "L_pos": np.zeros(()), "L_ctrl": np.asarray(loss)}
    evaluation = Evaluation(
        np.asarray(loss), terms, gradient, np.asarray(fallen), np.asarray(1e-12)
    )
    return evaluation, 2.0 * slope * directions() @ directions().T


def test_the_mean_over_the_plants_goes_down_and_no_point_is_walked_twice():
    seen, told = [], []

    def look(weights):
        seen.append(weights)
        return [pretend(weights), pretend(weights, 3.0)]

    found = tune_measured(TuneConfig(), nominal(), look, told.append)
    losses = [float(i.evaluation.loss) for i in found.iterations if i.accepted]
    assert len(found.iterations) == len(told) == len(seen)
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 0.01 * losses[0]
    np.testing.assert_allclose(losses[0], 2.0 * pretend(nominal())[0].loss)


def test_a_walk_that_falls_at_the_start_is_told():
    with pytest.raises(ValueError, match="cannot be tuned from: the robot fell"):
        tune_measured(TuneConfig(), nominal(), lambda weights: [pretend(weights, fallen=0.1)])


@pytest.mark.slow
def test_a_walk_in_mujoco_gives_a_slope_that_leads_down(robot):
    """A step along the gradient of one short walk on the ideal plant lowers its own loss."""
    config = TuneConfig(rollout=RolloutConfig(ticks=80), iterations=3)
    command = named_command("straight")

    def look(weights):
        walked = walk(config.rollout.walk, robot, Job(weights, command, ideal(), 0.8))
        return [evaluate_walk(config, robot, weights, command, last_command, walked)]

    found = tune_measured(config, nominal(), look)
    losses = [float(i.evaluation.loss) for i in found.iterations if i.accepted]
    assert len(losses) > 1
    assert losses[-1] < losses[0]
    assert np.any(weights_to_vector(found.weights) != weights_to_vector(nominal()))


# Grounded rollouts


def test_with_the_weights_that_were_walked_a_grounded_rollout_is_the_walk(robot, measured):
    missed = fit_grounding(BRIEF, scenario(robot), nominal(), measured)
    again = jax.jit(grounded_rollout, static_argnums=0)(BRIEF, missed, nominal())
    for found, there in zip(again.state, measured.state, strict=True):
        np.testing.assert_allclose(found, there[1:], atol=1e-12)
    assert not again.fallen.any()


def test_its_gradient_is_that_along_the_walk_by_forward_recursion(robot, measured):
    missed = fit_grounding(BRIEF, scenario(robot), nominal(), measured)
    # that one prices the change from the command before its first tick too
    tracking = tuple(t._replace(weight=t.weight * (t.name != "L_ctrl")) for t in PAPER_LOSS)
    found = evaluate_grounded(BRIEF, missed, nominal(), tracking)
    config = TuneConfig(rollout=BRIEF, loss=tracking)
    along, _ = evaluate_walk(config, robot, nominal(), *WALKED, measured)
    gradients = [weights_to_vector(one.gradient) for one in (found, along)]
    np.testing.assert_allclose(*gradients, rtol=1e-7, atol=1e-7 * np.abs(gradients[1]).max())


def test_the_matrix_of_a_grounded_rollout_has_a_row_for_each_tuned_number(robot, measured):
    missed = fit_grounding(BRIEF, scenario(robot), nominal(), measured)
    weights = BRIEF.walk.with_others(nominal(), ["turn_lead"])
    matrix = grounded_matrix(BRIEF, missed, weights, PAPER_LOSS, ("turn_lead",))
    assert matrix.shape == (19, 19)
    assert np.isfinite(matrix).all()


def test_a_walk_of_another_length_is_refused(robot, measured):
    with pytest.raises(ValueError, match="different leading axis sizes"):
        fit_grounding(RolloutConfig(ticks=4), scenario(robot), nominal(), measured)
