"""Gradient and Gauss-Newton matrix by the steps of a tuning, also of rollouts that are grounded."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import AHEAD, ANCHOR, BRIEF, PLAIN, ROBOT, mean_of
from pretend import elsewhere, still_walk

from hector_jax import InputError, Job, RolloutConfig, Scenario, TuneConfig, hfs, rollout, walk
from hector_jax.control import MpcConfig, Squares, StateCost, named_command, nominal
from hector_jax.control.parameters import gradient_by_steps, stepped
from hector_jax.control.weights import direction_names, expert, vector_to_weights, weights_to_vector
from hector_jax.control.weights_file import load_weights, save_weights, shipped
from hector_jax.core.trajectory import State, Wrench
from hector_jax.tuning.curvature import determined, least_squares_jit
from hector_jax.tuning.difftune import init, model_slope, trial_weights, tune, tune_step, update
from hector_jax.tuning.evaluate import Objective, evaluate_jit
from hector_jax.tuning.grounded import fit_grounding, grounded_rollout
from hector_jax.tuning.loss import PAPER_LOSS, losses, residuals, total
from hector_jax.walk_tuning.best_set import drawn_plants

NAMES = direction_names()
OTHERS = ("turn_lead", "footstep_feedback", "horizontal_gain", "yaw_gain")
# past a switch of stance, with what is not believed of the world
BLIND = RolloutConfig(ticks=24, lead=10, estimate_noise=0.5, delay=0.004)
CONFIG = TuneConfig(BLIND, others=OTHERS)
COMMANDS = ("c", "s")
START = expert()._replace(
    others={"turn_lead": 0.6, "footstep_feedback": 0.1, "horizontal_gain": 3.0, "yaw_gain": 40.0}
)
Z = 0.2 * np.random.default_rng(1).normal(size=22) * np.r_[np.ones(18), 0.1 * np.ones(4)]


@jax.jit
def _rolled(command, z, direction):
    def walk(z):
        at = stepped(init(CONFIG, START).start, z, OTHERS)
        found = rollout(CONFIG.rollout, Scenario(ROBOT, command, ANCHOR, PLAIN), at)
        return total(PAPER_LOSS, losses(PAPER_LOSS, found)), found

    return jax.jvp(walk, (z,), (direction,), has_aux=True)


SCENARIOS = [Scenario(ROBOT, named_command(name), ANCHOR, PLAIN) for name in COMMANDS]
OBJECTIVES = [Objective(partial(model_slope, CONFIG, scenario)) for scenario in SCENARIOS]


def point(objective):
    """Gradient and matrix that a tuning has at Z."""
    state = init(CONFIG, START)._replace(steps=jnp.asarray(Z))
    at = trial_weights(CONFIG, state)
    after, _ = update(CONFIG, state, *objective.slope(at))
    return after.rule


def rolled(name, z, direction=np.zeros(22)):  # noqa: B008
    """The loss after steps from the start, its derivative along a direction, and the walk."""
    return jax.tree.map(np.asarray, _rolled(named_command(name), z, direction))


def test_the_gradient_by_steps_is_that_of_differences_and_of_the_forward_mode():
    """Of the mean of two commands, with tied feet and other numbers, noise and a delay."""
    scales = np.array([2.0, 0.5])
    found = point(mean_of(OBJECTIVES, scales / scales.mean()))
    shares = scales.mean() / scales / 2.0
    size = np.linalg.norm(found.gradient)
    random = np.linalg.qr(np.random.default_rng(0).normal(size=(22, 22)))[0]
    for direction in (*random[:6], *np.eye(22)[18:]):

        def mean(z, part, along=direction):
            parts = [float(rolled(name, z, along)[part]) for name in COMMANDS]
            return shares @ np.array(parts)

        h, reverse = np.array([1e-5, 3e-6]), float(direction @ found.gradient)
        rises = [mean(Z + x * direction, 0) - mean(Z - x * direction, 0) for x in h]
        assert np.abs(rises / (2 * h) - reverse).min() <= 1e-6 * size
        assert abs(mean(Z, 1) - reverse) <= 1e-9 * size
    value = shares @ np.array([float(rolled(name, Z)[0]) for name in COMMANDS])
    assert float(found.value) == pytest.approx(value, rel=1e-10)


def test_the_matrix_is_the_curvature_of_the_loss_along_the_change_of_the_residuals():
    """2 J'J, with J by central differences: the reference moves too, which the lead resets."""
    matrix = np.asarray(point(OBJECTIVES[0]).matrix)
    rows = jax.jit(partial(residuals, PAPER_LOSS))

    def column(direction, h=1e-5):
        after, before = (rows(rolled("c", Z + sign * h * direction)[2]) for sign in (1.0, -1.0))
        return np.asarray(after - before) / (2 * h)

    J = np.stack([column(direction) for direction in np.eye(22)], axis=1)
    expected = 2.0 * J.T @ J
    # the entries of weights that matter little too
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(matrix / size, expected / size, atol=1e-5)


def test_loss_and_gradient_come_with_the_matrix():
    scenario, at = Scenario(ROBOT, named_command("s"), ANCHOR, PLAIN), init(CONFIG, START).start
    found, matrix = least_squares_jit(CONFIG.rollout, scenario, at, PAPER_LOSS, others=OTHERS)
    expected = evaluate_jit(CONFIG.rollout, scenario, at, PAPER_LOSS)
    assert float(found.loss) == pytest.approx(float(expected.loss), rel=1e-12)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-9), found.terms, expected.terms)
    slopes = [gradient_by_steps(at, each.gradient, OTHERS) for each in (found, expected)]
    np.testing.assert_allclose(*slopes, rtol=1e-7, atol=1e-7 * abs(slopes[1]).max())
    assert matrix.shape == (22, 22)


def speed(step):
    """A cost of one's own: the velocity ahead, at 0.3 m/s whatever the command."""
    return Squares(step.state.velocity[:1], target=0.3, weight=2.0)


def test_the_weight_of_a_cost_of_ones_own_is_tuned_and_saved(tmp_path):
    walk = replace(CONFIG.rollout.walk, mpc=MpcConfig(costs=(StateCost("speed", of=speed),)))
    config = TuneConfig(RolloutConfig(walk, ticks=24), others=("cost_speed",), iterations=2)
    scenario = Scenario(ROBOT, named_command("c"), ANCHOR, PLAIN)
    found = tune(config, scenario, expert())
    first = found.iterations[0]
    slope = gradient_by_steps(first.weights, first.evaluation.gradient, config.others)[-1]
    steps = 1e-5 * np.eye(19)[18] * np.array([[1.0], [-1.0]])
    moved = (stepped(first.weights, step, config.others) for step in steps)
    at = [float(tune_step(config, scenario, weights).loss) for weights in moved]
    assert float(slope) == pytest.approx((at[0] - at[1]) / 2e-5, rel=1e-5)
    assert abs(np.log(found.weights.others["cost_speed"])) > 0.1
    save_weights(tmp_path / "mine.json", found.weights)
    again = load_weights(tmp_path / "mine.json", ROBOT)
    assert again.others["cost_speed"] == found.weights.others["cost_speed"]
    with pytest.raises(InputError, match=r"unknown cost of the MPC 'cost_speed'"):
        CONFIG.rollout.walk.parameters(again)
    with pytest.raises(InputError, match=r"unknown tunable 'cost_sped'; did you mean 'cost_speed'"):
        replace(config, others=("cost_sped",))


def test_directions_are_said_with_the_weights_that_matter_in_them():
    vector, ridge = np.zeros(18), 0.05
    vector[[NAMES.index("Q_pitch"), NAMES.index("Q_x"), NAMES.index("R_Fz")]] = 0.9, -0.43, 0.05
    found = determined(np.outer(vector, vector) + ridge * np.eye(18), ridge, NAMES)
    (one,) = found.directions
    curved = vector @ vector
    assert one.text == "`Q_pitch` against `Q_x`"
    assert one.change == pytest.approx(0.5 * np.log(2.0) ** 2 * curved)
    assert one.fixed == pytest.approx(curved / (curved + ridge))
    assert found.number == 18
    flat = {*NAMES} - {"Q_pitch", "Q_x", "R_Fz"}
    assert flat < set(found.left_open)
    assert {found.weights[name] for name in flat} == {0.0}
    # of the variance 1 / ridge of the ridge alone, the walk takes what lies along its direction
    share = vector[NAMES.index("Q_pitch")] ** 2 / curved * one.fixed
    assert found.weights["Q_pitch"] == pytest.approx(share)
    assert "Q_pitch" not in found.left_open
    nothing = determined(ridge * np.eye(18), ridge, NAMES)
    assert (nothing.directions, nothing.left_open) == ([], [*NAMES])


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
    config, weights, command = BRIEF.walk, shipped(), named_command("s")
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
