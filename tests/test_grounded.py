"""Rollouts grounded on a measured walk: the walk itself, and its slope."""

import jax
import numpy as np
import pytest
from model import AHEAD, ANCHOR, BRIEF, PLAIN, ROBOT
from pretend import elsewhere, still_walk

from hector_jax import PAPER_LOSS, Job, Scenario, State, Wrench, hfs, named_command, walk
from hector_jax.control.weights import nominal, vector_to_weights, weights_to_vector
from hector_jax.control.weights_file import best
from hector_jax.tuning.curvature import least_squares_jit
from hector_jax.tuning.evaluate import evaluate_jit
from hector_jax.tuning.grounded import fit_grounding, grounded_rollout
from hector_jax.walk_tuning.best_set import drawn_plants

SCENARIO = Scenario(ROBOT, AHEAD, ANCHOR, PLAIN)


def shaking(size):
    """A walk that the model does not explain: a robot that only stands, and shakes."""
    ticks, rng = BRIEF.ticks, np.random.default_rng(0)
    place = np.append(np.asarray(ROBOT.com_offset)[:2], ROBOT.standing_height)
    shake = size * rng.standard_normal((ticks, 3))
    state = State(shake, shake + place, shake, shake)
    force = np.broadcast_to(np.asarray(ROBOT.mass * ROBOT.gravity) / 2, (ticks, 2, 3))
    parts = {"period": np.array(0.01), "initial": jax.tree.map(lambda x: x[0] - shake[0], state)}
    parts["joints"] = np.broadcast_to(ROBOT.standing_joints, (ticks, 10))
    return still_walk(ticks, state=state, command=Wrench(force, np.zeros_like(force)), **parts)


@pytest.fixture(scope="module")
def measured():
    return shaking(1e-3)


@pytest.fixture(scope="module")
def grounding(measured):
    return fit_grounding(BRIEF, SCENARIO, nominal(), measured)


def evaluate(grounding, weights):
    return evaluate_jit(BRIEF, grounding, weights, PAPER_LOSS, walk=grounded_rollout)


def test_a_grounded_rollout_is_its_walk_with_the_slope_of_differences_and_a_matrix(
    grounding, measured
):
    again = jax.jit(grounded_rollout, static_argnums=0)(BRIEF, grounding, nominal())
    for found, there in zip(again.state, measured.state, strict=True):
        np.testing.assert_allclose(found, there[1:], atol=1e-12)
    assert not again.fallen.any()
    theta = np.asarray(weights_to_vector(nominal()))

    def loss(logs):
        weights = vector_to_weights(theta * np.exp(logs))
        return float(evaluate(grounding, weights).loss)

    found = evaluate(grounding, nominal())
    slope = theta * np.asarray(weights_to_vector(found.gradient))
    for direction in np.linalg.qr(np.random.default_rng(0).normal(size=(24, 3)))[0].T:
        expected = (loss(1e-5 * direction) - loss(-1e-5 * direction)) / 2e-5
        assert slope @ direction == pytest.approx(expected, rel=1e-5)
    weights = BRIEF.walk.with_others(nominal(), ["turn_lead"])
    options = {"walk": grounded_rollout, "others": ("turn_lead",)}
    matrix = np.asarray(least_squares_jit(BRIEF, grounding, weights, PAPER_LOSS, **options)[1])
    assert matrix.shape == (19, 19)
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[0] > -1e-9 * np.abs(matrix).max()


@pytest.mark.parametrize("noise", [False, True])
def test_with_the_weights_of_a_log_the_planned_commands_are_those_of_the_log(noise):
    """With integral action, whose memory is not empty when the log begins, and a wrong estimate."""
    config, weights, command = BRIEF.walk, best(), named_command("s")
    plant = drawn_plants(ROBOT, 1)[0] if noise else hfs()
    seconds = BRIEF.ticks * config.gait.tick
    walked = walk(config, ROBOT, Job(weights, command, plant, seconds, seed=3))
    stride = round(config.gait.tick / float(walked.period))
    rows = walked._replace(period=None, initial=None)
    log = jax.tree.map(lambda x: x[stride - 1 :: stride], rows)
    log = log._replace(period=np.array(config.gait.tick), initial=walked.initial)
    assert np.abs(log.belief.disturbance.linear).max() > 0.1
    assert np.any(log.belief.state.position) == noise
    grounding = fit_grounding(BRIEF, Scenario(ROBOT, command, ANCHOR, PLAIN), weights, log)
    again = jax.jit(grounded_rollout, static_argnums=0)(BRIEF, grounding, weights)
    for found, there in zip(again.command, log.command, strict=True):
        np.testing.assert_allclose(found, there[1:], atol=1e-6)


def test_residuals_turn_with_the_robot():
    """An error of the model that is the same for the robot is the same at each heading."""
    walks = shaking(1e-2), elsewhere(shaking(1e-2), (0.0, 0.0), 0.7)
    found, there = (fit_grounding(BRIEF, SCENARIO, nominal(), x) for x in walks)
    assert np.abs(there.residuals.state.velocity).max() > 1e-2
    for a, b in zip(found.residuals.state[1:], there.residuals.state[1:], strict=True):
        assert np.linalg.norm(a - b) < 0.1 * np.linalg.norm(b)  # 0.7 in the world's axes
