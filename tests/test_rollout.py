"""Closed loop on the rigid body: physics, compilation, the gradient two ways."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sensitivity
from model import CONFIG, LEARNS_TOUCHDOWNS, PLAIN, SHORT, small_effect

from hector_jax.control.reference import COMMANDS, named_command, standing_anchor
from hector_jax.control.weights import expert, nominal, vector_to_weights, weights_to_vector
from hector_jax.core.geometry import rot_z
from hector_jax.grfm.dataset import make_dataset
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.tuning.curvature import gauss_newton_jit
from hector_jax.tuning.difftune import TuneConfig, init, step_status, tune, tune_step
from hector_jax.tuning.evaluate import evaluate_jit, gradient_norms
from hector_jax.tuning.loss import PAPER_LOSS, losses, total, with_alphas
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.tuning.status import StepStatus

LONG = RolloutConfig(ticks=400)
STRAIGHT = named_command("straight")
OTHERS = ("footstep_feedback", "friction", "turn_lead")  # tuned beside Q and R
walk = jax.jit(rollout, static_argnums=0)
propagate = jax.jit(sensitivity.propagate, static_argnums=0)


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def anchor(robot):
    return standing_anchor(robot)


@cache
def long_walk(weights, name):
    """A walk of 4 s with named weights; several tests look at one."""
    robot = load_robot()
    scenario = Scenario(robot, named_command(name), standing_anchor(robot), PLAIN)
    return walk(LONG, scenario, weights())


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("weights", [nominal, expert])
def test_named_weights_walk_every_trajectory(name, weights):
    trajectory = long_walk(weights, name)
    assert not trajectory.fallen.any()
    assert trajectory.residual.max() < 1e-8
    assert total(PAPER_LOSS, losses(PAPER_LOSS, trajectory)) < 3e6


def test_a_foot_lands_where_phi_says_and_a_dataset_reads_it_back(robot, anchor):
    shift = np.array([[0.03, -0.02, 0.0], [0.01, 0.02, 0.001]])

    def moved(shift, window):
        return last_command(window)._replace(touchdown_error=shift)

    effects = (jax.tree_util.Partial(moved, by) for by in (np.zeros((2, 3)), shift))
    planned, walked = (
        walk(SHORT, Scenario(robot, named_command("c"), anchor, effect), nominal())
        for effect in effects
    )
    lands = np.flatnonzero(np.diff(planned.contact[:, 1].astype(int)) == 1)[0] + 1
    yaw = planned.state.euler[lands - 2, 2]
    found = walked.feet[lands, 1] - planned.feet[lands, 1]
    np.testing.assert_allclose(found, rot_z(yaw) @ shift[1], atol=1e-9)

    stacked = jax.tree.map(lambda x: np.asarray(x)[None], walked)
    data, _ = make_dataset(LEARNS_TOUCHDOWNS, stacked)
    assert data.lands.sum(axis=0).tolist() == [1, 1]
    foot = np.nonzero(data.lands)[1]
    np.testing.assert_allclose(data.touchdown_error[data.lands], shift[foot], atol=1e-9)
    assert not make_dataset(robot, stacked)[0].lands.any()  # as its description asks


def test_a_foot_in_the_air_gets_no_wrench():
    trajectory = long_walk(expert, "s")
    swing = ~np.asarray(trajectory.contact)
    assert not np.asarray(trajectory.command.force)[swing].any()
    assert not np.asarray(trajectory.command.moment)[swing].any()


def test_commands_respect_friction_force_and_line_foot():
    trajectory = long_walk(nominal, "s")
    force = np.asarray(trajectory.command.force)[np.asarray(trajectory.contact)]
    assert (force[:, 2] >= -1e-6).all()
    assert (force[:, 2] <= 500).all()
    grip = np.abs(force[:, :2]).sum(axis=1) / force[:, 2]  # of MuJoCo's diamond
    assert grip.max() == pytest.approx(0.6, abs=1e-6)  # a bound that is reached


def test_a_line_foot_is_pressed_between_heel_and_toe_and_has_no_moment_about_its_length(robot):
    trajectory = long_walk(nominal, "straight")
    stands = np.asarray(trajectory.contact)
    force = np.asarray(trajectory.command.force)[stands]
    moment = np.asarray(trajectory.command.moment)[stands]
    ratio = moment[:, 1] / force[:, 2]  # the feet point ahead to within a degree
    assert (-robot.toe - 1e-4 <= ratio).all()
    assert (ratio <= robot.heel + 1e-4).all()
    assert ratio.max() > 0.99 * robot.heel  # a bound that is reached
    assert np.abs(moment[:, 0]).max() <= 0.02 * np.abs(moment[:, 1]).max()


def test_falling_is_seen_and_charged(robot, anchor):
    weak = vector_to_weights(
        weights_to_vector(nominal()).at[12:].set(1.0)
    )  # effort so dear that it sinks
    trajectory = walk(LONG, Scenario(robot, STRAIGHT, anchor, PLAIN), weak)
    assert trajectory.fallen[-1]
    fallen = float(trajectory.fallen.sum())
    assert losses(PAPER_LOSS, trajectory)["L_pos"] >= 10 * fallen * 0.5**2
    assert losses(PAPER_LOSS, trajectory)["L_Eul"] >= 10 * fallen * 0.8**2
    assert np.isfinite(total(PAPER_LOSS, losses(PAPER_LOSS, trajectory)))


def test_starting_half_a_cycle_later_mirrors_the_walk(robot):
    mirror = jnp.array([1.0, -1.0, 1.0])
    half = RolloutConfig().walk.gait.cycle // 2
    later = standing_anchor(robot, half)
    # A robot that is its own mirror image: the products of inertia that yaw couples to vanish.
    one = long_walk(nominal, "straight")
    other = walk(LONG, Scenario(robot, STRAIGHT, later, PLAIN), nominal())
    position, force = other.state.position * mirror, other.command.force[:, ::-1] * mirror
    np.testing.assert_allclose(one.state.position[:50], position[:50], atol=1e-9)
    np.testing.assert_allclose(one.command.force[:50], force[:50], atol=1e-6)


@cache
def start():
    """Nominal weights with other numbers, so that all gradients over 50 ticks share a program."""
    return jax.tree.map(np.asarray, init(replace(CONFIG, others=OTHERS), nominal()).start)


def vector(weights):
    return np.asarray(weights_to_vector(weights))


def random_weights(seed):
    draws = np.random.default_rng(seed).uniform(-np.log(2), np.log(2), 24)
    return vector_to_weights(weights_to_vector(nominal()) * np.exp(draws))


def loss_of(config, scenario, weights):
    """The loss by the program that has the gradient too, so that no other one is compiled."""
    return float(tune_step(config, scenario, weights).loss)


def differences(config, scenario, weights, *, step, directions):
    """Central differences of the loss along directions (n, 24) in log-weights."""
    theta, found = np.asarray(weights_to_vector(weights)), []
    for direction in step * directions:
        vectors = (jnp.asarray(theta * np.exp(side * direction)) for side in (1, -1))
        both = (vector_to_weights(v, weights)._replace(others=weights.others) for v in vectors)
        up, down = (loss_of(config, scenario, moved) for moved in both)
        found.append((up - down) / (2 * step))
    return np.array(found)


def relative(found, expected):
    return float(jnp.linalg.norm(found - expected) / jnp.linalg.norm(expected))


@pytest.fixture(scope="module")
def net():
    """A net that is part of the answer, and of the same program as the plain rigid body."""
    return small_effect()


# Each has a part of all 24 numbers: a wrong one shows in a few directions as in 24.
OBLIQUE = np.linalg.qr(np.random.default_rng(0).normal(size=(24, 24)))[0][:5]


def check_gradient(
    config,
    scenario,
    weights,
    bar,
    directions=np.eye(24),  # noqa: B008
    case="",
):
    tuning = TuneConfig(rollout=config)
    evaluation = tune_step(tuning, scenario, weights)
    reverse = weights_to_vector(jax.tree.map(jnp.multiply, evaluation.gradient, weights))
    # Halving the step tells a change of the active set inside it from a wrong derivative.
    errors = []
    for step in (1e-5, 5e-6, 2.5e-6):
        expected = differences(tuning, scenario, weights, step=step, directions=directions)
        errors.append(relative(directions @ reverse, expected))
        if errors[-1] <= bar:
            break
    print(f"error against differences {errors}", end=" ")
    assert errors[-1] <= bar, (case, errors)
    trajectory, columns = propagate(config, scenario, weights)
    _, forward = sensitivity.gradient(PAPER_LOSS, trajectory, columns, weights)
    forward = weights_to_vector(jax.tree.map(jnp.multiply, forward, weights))
    print(f"forward against reverse {relative(forward, reverse):.1e}")
    assert relative(forward, reverse) <= 1e-8, case


def test_gradient_over_50_ticks_is_that_of_differences(robot, anchor):
    weights = random_weights(0)._replace(others=start().others)
    scenario = Scenario(robot, named_command("s"), anchor, PLAIN)
    check_gradient(SHORT, scenario, weights, 1e-6, OBLIQUE)


@pytest.fixture
def cases(robot, anchor, net):
    """Random weights for each trajectory, with phi the identity and the net."""
    return [
        ((name, said), random_weights(seed), Scenario(robot, named_command(name), anchor, effect))
        for seed, name in enumerate(COMMANDS)
        for said, effect in (("plain", PLAIN), ("net", net))
    ]


@pytest.mark.slow
def test_gradient_over_50_ticks_is_that_of_differences_from_anywhere(cases):
    for case, weights, scenario in cases:
        check_gradient(SHORT, scenario, weights, 1e-6, case=case)


@pytest.mark.slow
def test_gradient_over_400_ticks_is_that_of_differences(cases):
    for case, weights, scenario in cases:
        assert not walk(LONG, scenario, weights).fallen.any(), case
        check_gradient(LONG, scenario, weights, 1e-4, case=case)


@pytest.mark.slow
def test_a_walk_in_blocks_is_the_same_walk_with_the_same_gradient(robot, anchor):
    scenario = Scenario(robot, named_command("s"), anchor, PLAIN)
    whole, parts = (
        tune_step(TuneConfig(rollout=RolloutConfig(ticks=50, block=block)), scenario, start())
        for block in (500, 23)  # the last block is padded
    )
    assert float(parts.loss) == pytest.approx(float(whole.loss), rel=1e-12)
    for a, b in zip(jax.tree.leaves(parts.gradient), jax.tree.leaves(whole.gradient), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_the_way_back_solves_no_qp_again(robot, anchor):
    lowered = jax.jit(tune_step, static_argnums=0).lower(
        CONFIG, Scenario(robot, named_command("s"), anchor, PLAIN), start()
    )
    functions = lowered.as_text().split("func.func")
    solving = [f for f in functions if "solve_normal" in f.splitlines()[0] and ".while" in f]
    assert len(solving) == 1


# Numbers of the controller beside Q and R


@pytest.fixture(scope="module")
def straight(robot, anchor):
    return Scenario(robot, STRAIGHT, anchor, PLAIN)


@pytest.fixture(scope="module")
def recursion(straight):
    """The walk from there and its sensitivities."""
    return propagate(SHORT, straight, start())


def test_gradient_norms_are_those_of_the_parts(straight, recursion):
    weights = start()
    norms = list(gradient_norms(SHORT, straight, weights, PAPER_LOSS).values())

    def gradient(euler, position):
        loss = with_alphas({"L_Eul": euler, "L_pos": position})
        _, found = sensitivity.gradient(loss, *recursion, weights)
        return vector(found) * vector(weights)

    control = gradient(0.0, 0.0)
    expected = gradient(1e6, 0.0) - control, gradient(0.0, 1e6) - control, 1e6 * control
    np.testing.assert_allclose(norms, 1e-6 * np.linalg.norm(expected, axis=1), rtol=1e-6)


def test_the_derivatives_by_other_numbers_are_those_of_differences_and_of_the_recursion(
    straight, recursion
):
    found = tune_step(CONFIG, straight, start())

    def loss(name, shift):
        others = {**start().others, name: start().others[name] + shift}
        moved = start()._replace(others=others)
        return float(tune_step(CONFIG, straight, moved).loss)

    for name in OTHERS:
        expected = (loss(name, 1e-6) - loss(name, -1e-6)) / 2e-6
        assert float(found.gradient.others[name]) == pytest.approx(expected, rel=1e-5, abs=1e-3)
    _, forward = sensitivity.gradient(PAPER_LOSS, *recursion, start())
    np.testing.assert_allclose(vector(forward), vector(found.gradient), rtol=1e-8)
    for name in OTHERS:
        np.testing.assert_allclose(
            forward.others[name], found.gradient.others[name], rtol=1e-8, atol=1e-9
        )
    forward = sensitivity.matrix(PAPER_LOSS, *recursion, start(), OTHERS)
    matrix = gauss_newton_jit(SHORT, straight, start(), PAPER_LOSS, others=OTHERS)
    np.testing.assert_allclose(forward, matrix, rtol=1e-8, atol=1e-9 * np.abs(matrix).max())
    config = replace(CONFIG, others=OTHERS, iterations=5, rule="relative")
    result = tune(config, straight, nominal())
    assert result.loss < found.loss
    assert set(result.weights.others) == set(OTHERS)


def test_new_weights_commands_and_effects_need_no_compilation(robot, anchor):
    tune_step(CONFIG, Scenario(robot, named_command("s"), anchor, PLAIN), start())
    before = evaluate_jit._cache_size()
    other = TuneConfig(rollout=SHORT, loss=with_alphas({"L_Eul": 1.0}), beta_q=0.1, iterations=20)
    weights = expert()._replace(others=start().others)
    tune_step(other, Scenario(robot, named_command("c"), anchor, PLAIN), weights)
    assert evaluate_jit._cache_size() == before


def test_the_loss_is_that_of_its_parts(straight):
    found = tune_step(CONFIG, straight, start())
    expected = 1e5 * found.terms["L_Eul"] + 2e5 * found.terms["L_pos"] + found.terms["L_ctrl"]
    assert found.loss == pytest.approx(float(expected))
    assert step_status(CONFIG, found) == StepStatus.ACCEPTED
