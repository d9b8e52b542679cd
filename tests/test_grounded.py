"""Rollouts grounded on a measured walk: the walk itself, and its slope."""

import jax
import numpy as np
import pytest
from model import AHEAD, BRIEF, PLAIN

from hector_jax.control.reference import standing_anchor
from hector_jax.control.weights import nominal, vector_to_weights, weights_to_vector
from hector_jax.core.trajectory import State, Wrench, no_samples
from hector_jax.robot.model import load_robot
from hector_jax.tuning.grounded import (
    evaluate_grounded,
    fit_grounding,
    grounded_matrix,
    grounded_rollout,
)
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.tuning.rollout import RolloutConfig, Scenario


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def scenario(robot):
    return Scenario(robot, AHEAD, standing_anchor(robot), PLAIN)


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


@pytest.fixture(scope="module")
def grounding(scenario, measured):
    return fit_grounding(BRIEF, scenario, nominal(), measured)


def test_with_the_weights_that_were_walked_a_grounded_rollout_is_the_walk(grounding, measured):
    again = jax.jit(grounded_rollout, static_argnums=0)(BRIEF, grounding, nominal())
    for found, there in zip(again.state, measured.state, strict=True):
        np.testing.assert_allclose(found, there[1:], atol=1e-12)
    assert not again.fallen.any()


def test_its_gradient_is_that_of_differences(grounding):
    theta = np.asarray(weights_to_vector(nominal()))

    def loss(logs):
        weights = vector_to_weights(theta * np.exp(logs))
        return float(evaluate_grounded(BRIEF, grounding, weights, PAPER_LOSS).loss)

    found = evaluate_grounded(BRIEF, grounding, nominal(), PAPER_LOSS)
    slope = theta * np.asarray(weights_to_vector(found.gradient))
    for direction in np.linalg.qr(np.random.default_rng(0).normal(size=(24, 3)))[0].T:
        expected = (loss(1e-5 * direction) - loss(-1e-5 * direction)) / 2e-5
        assert slope @ direction == pytest.approx(expected, rel=1e-5)


def test_its_matrix_has_a_row_for_each_tuned_number_and_is_positive(grounding):
    weights = BRIEF.walk.with_others(nominal(), ["turn_lead"])
    matrix = np.asarray(grounded_matrix(BRIEF, grounding, weights, PAPER_LOSS, ("turn_lead",)))
    assert matrix.shape == (19, 19)
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[0] > -1e-9 * np.abs(matrix).max()


def test_a_walk_of_another_length_is_refused(scenario, measured):
    with pytest.raises(ValueError, match="different leading axis sizes"):
        fit_grounding(RolloutConfig(ticks=4), scenario, nominal(), measured)
