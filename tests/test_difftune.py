"""DiffTune: how far it steps, what it refuses, when it stops; on a toy and on the rigid body."""

from dataclasses import replace
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import mean_of

from hector_jax.cli.flags import Tunables
from hector_jax.control.controller import WalkConfig
from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.parameters import GROUPS, TUNABLES, bounds, step_bounds, step_names, stepped
from hector_jax.control.reference import COMMANDS, named_command, standing_anchor
from hector_jax.control.weights import (
    directions,
    expert,
    nominal,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Wrench
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.tuning.difftune import (
    LEAST_GAIN,
    TuneConfig,
    descend,
    init,
    step_status,
    trial_weights,
    tune,
    update,
)
from hector_jax.tuning.evaluate import Evaluation, Objective, aligned
from hector_jax.tuning.loss import PAPER_LOSS, with_alphas
from hector_jax.tuning.rollout import RolloutConfig, Scenario
from hector_jax.tuning.status import StepStatus, Stop, status_text

ROBOT = load_robot()
ANCHOR = standing_anchor(ROBOT)


def vector(weights):
    return np.asarray(weights_to_vector(weights))


def random_tree(seed, scale=1.0):
    return vector_to_weights(jnp.asarray(scale * np.random.default_rng(seed).normal(size=24)))


def evaluation(loss=1.0, gradient=None, fallen=0.0, residual=1e-12):
    gradient = random_tree(0) if gradient is None else gradient
    loss, fallen, residual = (np.asarray(x, float) for x in (loss, fallen, residual))
    return Evaluation(
        loss, dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), loss), gradient, fallen, residual
    )


# One step


def stepped_once(gradient, config, start=None, others=()):
    """The weights after one step from a start, by `init` and `update`."""
    state = init(config, nominal() if start is None else start)
    after, _ = update(config, state, evaluation(gradient=gradient), state.rule.matrix)
    return trial_weights(config, after)


RELATIVE = TuneConfig(rule="relative")


def mean_over_feet(gradient):
    return gradient._replace(R=jax.tree.map(lambda g: jnp.stack([g.mean(axis=0)] * 2), gradient.R))


def test_the_relative_step_is_theta_less_beta_theta_g_over_the_largest_g_of_its_block():
    for start in (nominal(), expert()):
        gradient, theta = random_tree(1), vector(start)
        g = vector(mean_over_feet(gradient)) * theta  # in log-weights
        largest = np.repeat([np.abs(g[:12]).max(), np.abs(g[12:]).max()], 12)
        expected = theta - np.repeat([0.05, 0.08], 12) * theta * g / largest
        moved = stepped_once(gradient, RELATIVE, start)
        np.testing.assert_allclose(vector(moved), expected, rtol=1e-12)


def test_the_literal_step_is_theta_less_beta_times_the_gradient():
    gradient = random_tree(5, 1e-4)
    moved = stepped_once(gradient, TuneConfig(rule="literal"))
    expected = vector(nominal()) - np.repeat([0.05, 0.08], 12) * vector(mean_over_feet(gradient))
    np.testing.assert_allclose(vector(moved), np.clip(expected, *map(vector, bounds())), rtol=1e-12)


@pytest.mark.parametrize("rule", ["gauss_newton", "relative", "literal"])
@pytest.mark.parametrize("side", [0, 1])
def test_a_step_out_of_the_box_ends_exactly_on_its_wall(side, rule):
    config, edge = TuneConfig(rule=rule), bounds()[side]
    gradient = jax.tree.map(lambda w: np.full_like(w, 1.0 if side == 0 else -1.0), edge)
    there = stepped_once(gradient, config, edge)
    np.testing.assert_array_equal(vector(there), vector(edge))
    back = stepped_once(jax.tree.map(np.negative, gradient), config, edge)
    assert (vector(back) != vector(edge)).all()
    near = jax.tree.map(lambda w: w * (1.001 if side == 0 else 0.999), edge)
    huge = jax.tree.map(lambda g, w: 1e9 * g / w, gradient, near)
    np.testing.assert_array_equal(vector(stepped_once(huge, config, near)), vector(edge))


def test_steps_and_their_bounds_meet_the_box_and_come_back():
    others = ("turn_lead", "footstep_feedback")
    start = WalkConfig().with_others(expert(), others)
    names = step_names(start, others)
    assert names[-2:] == others
    assert len(names) == 20
    for edge, limit in zip(step_bounds(start, others), bounds(others, start), strict=True):
        reached = stepped(start, edge, others)
        np.testing.assert_allclose(vector(reached), vector(limit), rtol=1e-12)
        for name in others:
            assert float(reached.others[name]) == pytest.approx(limit.others[name], abs=1e-15)
    steps = np.random.default_rng(0).normal(size=20)
    moved = stepped(start, steps, others)
    np.testing.assert_allclose(
        directions().T @ steps[:18], np.log(vector(moved) / vector(start)), rtol=1e-12
    )
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-12), stepped(moved, -steps, others), start
    )


# Refusals


def rejection_reason(found):
    return status_text(StepStatus(int(step_status(TuneConfig(), found))), found)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"loss": np.nan}, "not finite"),
        ({"gradient": random_tree(0, np.inf)}, "not finite"),
        ({"fallen": 0.01}, "the robot fell"),
        ({"residual": 2e-3}, r"QP residual 2.0e-03 too large"),
        ({"residual": np.nan}, "QP residual nan"),
    ],
)
def test_what_cannot_be_believed_is_refused_and_told(wrong, told):
    assert told in rejection_reason(evaluation(**wrong))


# The loop, on a quadratic in log-weights whose optimum is known

OPTIMUM = vector(nominal()) * np.exp(
    np.r_[np.linspace(-0.7, 0.9, 12), np.tile([0.3, -0.5, 0.8], 2), np.tile([0.2, 0.6, -0.4], 2)]
)
EXACT = TuneConfig(ridge=0.0)


def quadratic(fixed=0.0, optimum=OPTIMUM, falls=lambda weights: False, stiffness=1.0):
    """1e6 |log(theta / optimum)|^2; the model takes it to be `stiffness` times as curved."""

    def evaluate(weights):
        away = np.log(vector(weights) / optimum)
        gradient = vector_to_weights(jnp.asarray(2e6 * away / vector(weights)))
        return evaluation(fixed + 1e6 * away @ away, gradient, float(falls(weights)))

    return Objective(evaluate, lambda weights: stiffness * 2e6 * directions() @ directions().T)


def tune_toy(toy, config=EXACT, start=None, **more):
    return descend(config, nominal() if start is None else start, toy, **more)


def distance(weights):
    return np.abs(np.log(vector(weights) / OPTIMUM)).max()


def test_a_quadratic_is_tuned_to_its_optimum_in_a_few_steps():
    found = tune_toy(quadratic())
    assert distance(found.weights) < 1e-6
    assert float(found.iterations[4].evaluation.loss) < 1e-6


@pytest.mark.parametrize("rule", ["relative", "literal"])
def test_the_papers_ten_steps_are_taken_uphill_too(rule):
    start = vector_to_weights(jnp.asarray(OPTIMUM * 1.01))
    found = tune_toy(quadratic(), TuneConfig(rule=rule), start)
    assert found.reason == "10 iterations"
    losses = [float(i.evaluation.loss) for i in found.iterations]
    assert all(i.accepted for i in found.iterations)
    assert len(losses) == 11
    assert (np.diff(losses) > 0).any()


def test_a_ridge_keeps_the_optimum_nearer_to_the_start_as_its_formula_has_it():
    """Of L / L(0) + ridge / 2 |z|^2 with L = 1e6 |z_feet - z*|^2."""
    ridge = 0.5
    found = tune_toy(quadratic(), TuneConfig(ridge=ridge, iterations=30))
    aim, spread = np.log(OPTIMUM / vector(nominal())), directions() @ directions().T
    first = aim @ aim
    expected = np.linalg.solve(
        2 * spread / first + ridge * np.eye(18), 2 * directions() @ aim / first
    )
    np.testing.assert_allclose(
        directions().T @ expected, np.log(vector(found.weights) / vector(nominal())), atol=1e-3
    )
    np.testing.assert_allclose(
        found.precision, 2 * spread / first + ridge * np.eye(18), rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize(("share", "ended"), [(0.99, True), (1.01, False)])
def test_it_stops_where_the_next_step_is_predicted_to_gain_too_little(share, ended):
    """Of the whole loss, of which no weight changes the largest part."""
    start = vector_to_weights(jnp.asarray(OPTIMUM * 1.1))
    gain = 1e6 * 24 * np.log(1.1) ** 2
    found = tune_toy(quadratic(fixed=gain * (1.0 / (share * LEAST_GAIN) - 1.0)), start=start)
    assert (len(found.iterations) == 1) == ended
    assert Stop(int(found.stop)) == Stop.NO_GAIN
    assert found.reason.endswith("predicted to gain less than 0.5%")


def test_two_wrong_predictions_in_a_row_end_it():
    """The gradient is so much too large that the gains are an eighth, however short the step."""
    toy = quadratic()

    def evaluate(weights):
        found = toy.evaluate(weights)
        return found._replace(gradient=jax.tree.map(lambda g: 8.0 * g, found.gradient))

    found = tune_toy(toy._replace(evaluate=evaluate))
    assert Stop(int(found.stop)) == Stop.ROUGH
    assert [i.accepted for i in found.iterations] == [True, True, True]
    assert found.reason == "2 steps in a row did not gain what was predicted"


def test_a_limit_ends_it():
    found = tune_toy(quadratic(stiffness=3.0), TuneConfig(iterations=2, ridge=0.0))
    assert [int(i.iteration) for i in found.iterations] == [0, 1, 2]
    assert Stop(int(found.stop)) == Stop.LIMIT
    assert found.reason == "2 iterations"


def test_a_fall_shortens_the_step_goes_back_is_told_and_is_no_wrong_prediction():
    wall = 1.12 * nominal().Q.velocity[2]
    toy = quadratic(falls=lambda weights: weights.Q.velocity[2] > wall)
    seen = []
    found = tune_toy(toy, TuneConfig(ridge=0.0, iterations=30), on_iteration=seen.append)
    history = found.iterations
    refused = [i for i in history if not i.accepted]
    jax.tree.map(np.testing.assert_array_equal, seen, history)
    assert len(refused) >= 3
    assert {i.reason for i in refused} == {"the robot fell"}
    assert Stop(int(found.stop)) != Stop.ROUGH
    for before, now in zip(history[1:], history[2:], strict=False):
        if not before.accepted:
            assert float(now.step_size) == pytest.approx(float(before.step_size) / 8)
    at = history[0]
    for now in history[1:]:
        away = np.linalg.lstsq(directions().T, np.log(vector(now.weights) / vector(at.weights)))[0]
        assert np.linalg.norm(away) <= now.step_size * (1 + 1e-9)
        at = now if now.accepted else at
    np.testing.assert_array_equal(vector(found.weights), vector(at.weights))
    assert found.weights.Q.velocity[2] <= wall
    assert float(found.loss) == float(at.evaluation.loss)


def test_a_step_that_gains_less_than_a_hundredth_of_the_prediction_is_refused():
    level = quadratic()._replace(evaluate=lambda weights: evaluation(1.0, random_tree(1)))
    level = level._replace(matrix=lambda weights: jnp.eye(18))
    found = tune_toy(level)
    assert [i.accepted for i in found.iterations] == [True, False, False]
    assert found.iterations[-1].reason == "the loss did not fall as predicted"
    assert Stop(int(found.stop)) == Stop.ROUGH
    np.testing.assert_array_equal(vector(found.weights), vector(nominal()))


def test_the_matrix_is_taken_where_a_step_was_accepted_and_nowhere_else():
    wall, taken = 1.12 * nominal().Q.velocity[2], []
    toy = quadratic(falls=lambda weights: weights.Q.velocity[2] > wall)

    def matrix(weights):
        taken.append(vector(weights))
        return toy.matrix(weights)

    config = TuneConfig(iterations=30)
    found = tune_toy(toy._replace(matrix=matrix), config)
    np.testing.assert_array_equal(
        taken, [vector(i.weights) for i in found.iterations if i.accepted]
    )
    taken.clear()
    tune_toy(toy._replace(matrix=matrix), RELATIVE)
    assert taken == []


@pytest.mark.parametrize("rule", ["gauss_newton", "relative"])
def test_an_optimum_outside_the_box_ends_on_its_wall(rule):
    outside = OPTIMUM.copy()
    outside[3] = 1e6
    start = vector_to_weights(jnp.asarray(OPTIMUM).at[3].set(9e3))
    found = tune_toy(quadratic(optimum=outside), TuneConfig(rule=rule, ridge=0.0), start)
    assert found.weights.Q.position[0] == 1e4
    assert max(i.weights.Q.position[0] for i in found.iterations) == 1e4
    others = np.delete(np.log(vector(found.weights) / OPTIMUM), 3)
    assert np.abs(others).max() < 0.1


# On the rigid body


def test_a_start_whose_feet_differ_is_tied_and_stays_tied():
    start = nominal()._replace(R=Wrench(*(w * np.array([[2.0], [0.5]]) for w in nominal().R)))
    at = init(TuneConfig(), start).start
    np.testing.assert_allclose(vector(at), vector(nominal()), rtol=1e-12)
    found = tune_toy(quadratic(), start=start)
    for iteration in found.iterations:
        assert all(np.array_equal(w[0], w[1]) for w in iteration.weights.R)
    equal = init(TuneConfig(), expert()).start
    np.testing.assert_array_equal(vector(equal), vector(expert()))  # to the last bit


def test_aligned_loss_weights_are_powers_of_ten_that_level_the_gradients():
    config = aligned(PAPER_LOSS, {"L_Eul": 0.3, "L_pos": 4e-3, "L_ctrl": 2e4})
    assert config == with_alphas({"L_Eul": 1e5, "L_pos": 1e7})
    for gradient, term in zip((0.3, 4e-3), config, strict=False):
        alpha = term.weight
        assert 10**-0.5 <= alpha * gradient / 2e4 <= 10**0.5


def test_the_mean_of_objectives_begins_at_the_mean_of_their_losses_with_equal_parts():
    losses = np.array([1.0, 3.0, 8.0])
    each = [
        Objective(
            lambda weights, k=k: evaluation(k, fallen=k / 10), lambda weights, k=k: k * np.eye(2)
        )
        for k in losses
    ]
    mean = mean_of(each, losses)
    found = mean.evaluate(nominal())
    assert found.loss == pytest.approx(4.0)
    assert found.fallen == 0.8  # the worst
    parts = [vector(random_tree(0)) * 4.0 / loss for loss in losses]
    np.testing.assert_allclose(vector(found.gradient), np.mean(parts, axis=0))
    np.testing.assert_allclose(mean.matrix(nominal()), 4.0 * np.eye(2))
    plain = mean_of(each)
    np.testing.assert_allclose(plain.matrix(nominal()), losses.mean() * np.eye(2))
    np.testing.assert_allclose(
        vector(plain.evaluate(nominal()).gradient), vector(random_tree(0)), rtol=1e-12
    )


@pytest.mark.slow
def test_ten_iterations_go_below_a_hundred_of_the_papers_inside_the_box():
    lower, upper = map(vector, bounds())
    papers = TuneConfig(rule="relative", iterations=100)
    for name in COMMANDS:
        inputs = Scenario(ROBOT, named_command(name), ANCHOR, last_command), nominal()
        found, with_ridge = tune(TuneConfig(ridge=0.0), *inputs), tune(TuneConfig(), *inputs)
        history = found.iterations
        assert len(history) <= 11, name
        assert float(found.loss) <= float(tune(papers, *inputs).loss), name
        # a fifth was asked for
        assert float(with_ridge.loss) <= 0.8 * float(history[0].evaluation.loss), name
        for iteration in (*history, *with_ridge.iterations):
            at = vector(iteration.weights)
            assert ((lower <= at) & (at <= upper)).all(), (name, at)


# Numbers of the controller beside Q and R

PAPERS = RolloutConfig(WalkConfig(footstep=FootstepConfig(rule="paper")))
SLIPPERY = RolloutConfig(WalkConfig(mpc=MpcConfig(friction=0.05)))


def test_other_numbers_step_by_a_share_of_their_box_and_what_is_not_tuned_stays():
    config = TuneConfig(rule="relative", others=("turn_lead", "footstep_feedback"))
    start = nominal()._replace(others={"friction": 0.4})
    assert {name: float(x) for name, x in init(config, start).start.others.items()} == {
        "footstep_feedback": 0.12,
        "friction": 0.4,
        "turn_lead": 0.5,
    }
    slopes = {"footstep_feedback": jnp.array(4.0), "friction": 1e9, "turn_lead": jnp.array(-2.0)}
    gradient = random_tree(1)._replace(others=jax.tree.map(jnp.asarray, slopes))
    moved = stepped_once(gradient, config, start)
    without = stepped_once(random_tree(1), RELATIVE)
    np.testing.assert_array_equal(vector(moved), vector(without))
    # slope times width of the box is 2 and -4: the second takes the whole step
    assert float(moved.others["turn_lead"]) == pytest.approx(0.5 + 0.02 * 2.0)
    assert float(moved.others["footstep_feedback"]) == pytest.approx(0.12 - 0.02 * 0.25)
    assert moved.others["friction"] == 0.4
    far = stepped_once(gradient, replace(config, beta_others=10.0), start)
    assert far.others["turn_lead"] == 2.0


def test_a_trust_region_holds_shares_of_boxes_as_it_holds_logs():
    config = TuneConfig(others=("turn_lead",))
    slope = random_tree(0, 0.0)._replace(others={"turn_lead": jnp.array(-100.0)})
    moved = stepped_once(slope, config)
    # a gradient without curvature: to the radius of 1, a whole box, and so to the wall
    assert moved.others["turn_lead"] == 2.0
    np.testing.assert_allclose(vector(moved), vector(nominal()), rtol=1e-12)


@pytest.mark.parametrize(
    ("wrong", "fault"),
    [
        ({"others": ("turn_laed",)}, "did you mean 'turn_lead'"),
        ({"others": ("foot_height",)}, "foot_height cannot be tuned by gradients"),
        (
            {"others": ("friction",), "rule": "literal"},
            "others must be empty with the rule literal",
        ),
        (
            {"others": ("turn_lead",), "rollout": PAPERS},
            "turn_lead has no part in the paper's rule",
        ),
        (
            {"others": ("friction",), "rollout": SLIPPERY},
            "friction starts at 0.05, expected from 0",
        ),
    ],
)
def test_what_cannot_be_tuned_is_named(wrong, fault):
    with pytest.raises(InputError, match=fault):
        TuneConfig(**wrong)


def test_the_line_takes_all_numbers_that_a_gradient_or_walks_can_tune():
    assert {*get_args(Tunables)} == {*GROUPS, *TUNABLES} - {"position_limit"}
    assert {*GROUPS["legs"]} == {name for name, one in TUNABLES.items() if one.of_legs}
    for group in GROUPS.keys() - {"legs"}:
        assert TuneConfig(others=GROUPS[group]).others == GROUPS[group]
