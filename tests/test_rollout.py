"""Closed loop on the rigid body: physics, compilation, the gradient two ways."""

from dataclasses import replace
from functools import cache, partial
from itertools import product

import jax
import jax.numpy as jnp
import model
import numpy as np
import pytest
import sensitivity
from lib import sample_weights
from model import ANCHOR, CONFIG, PLAIN, ROBOT, SHORT, random_weights, vector

from hector_jax import RolloutConfig, Scenario, last_command, rollout
from hector_jax.control.reference import COMMANDS, named_command, standing_anchor
from hector_jax.control.weights import expert, nominal, vector_to_weights, weights_to_vector
from hector_jax.core.geometry import rot_z
from hector_jax.core.tree import stack
from hector_jax.grfm.dataset import make_dataset
from hector_jax.tuning.curvature import least_squares_jit
from hector_jax.tuning.difftune import TuneConfig, init, step_status, tune_step
from hector_jax.tuning.evaluate import evaluate, evaluate_jit, gradient_norms
from hector_jax.tuning.loss import PAPER_LOSS, losses, total, with_alphas
from hector_jax.tuning.parallel_rollout import parallel_rollout
from hector_jax.tuning.status import StepStatus
from hector_jax.tuning.variation import drawn_variation

LONG = RolloutConfig(ticks=400)
STRAIGHT = Scenario(ROBOT, named_command("straight"), ANCHOR, PLAIN)
OTHERS = ("footstep_feedback", "friction", "turn_lead")  # tuned beside Q and R
walk = jax.jit(rollout, static_argnums=0)
propagate = jax.jit(sensitivity.propagate, static_argnums=0)


@cache
def long_walk(weights, name):
    """A walk of 4 s with named weights; several tests look at one."""
    return walk(LONG, STRAIGHT._replace(command=named_command(name)), weights())


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("weights", [nominal, expert])
def test_named_weights_walk_every_trajectory(name, weights):
    trajectory = long_walk(weights, name)
    assert not trajectory.fallen.any()
    assert trajectory.residual.max() < 1e-8
    assert total(PAPER_LOSS, losses(PAPER_LOSS, trajectory)) < 3e6


def test_a_foot_lands_where_phi_says_and_a_dataset_reads_it_back():
    shift = np.array([[0.03, -0.02, 0.0], [0.01, 0.02, 0.001]])

    def moved(shift, window):
        return last_command(window)._replace(touchdown_error=shift)

    effects = (jax.tree_util.Partial(moved, by) for by in (np.zeros((2, 3)), shift))
    planned, walked = (
        walk(SHORT, Scenario(ROBOT, named_command("c"), ANCHOR, effect), nominal())
        for effect in effects
    )
    lands = np.flatnonzero(np.diff(planned.contact[:, 1].astype(int)) == 1)[0] + 1
    yaw = planned.state.euler[lands - 2, 2]
    found = walked.feet[lands, 1] - planned.feet[lands, 1]
    np.testing.assert_allclose(found, rot_z(yaw) @ shift[1], atol=1e-9)

    stacked = jax.tree.map(lambda x: np.asarray(x)[None], walked)
    data, _ = make_dataset(model.LEARNS_TOUCHDOWNS, stacked)
    assert data.lands.sum(axis=0).tolist() == [1, 1]
    foot = np.nonzero(data.lands)[1]
    np.testing.assert_allclose(data.touchdown_error[data.lands], shift[foot], atol=1e-9)
    assert not make_dataset(ROBOT, stacked)[0].lands.any()  # as its description asks


def test_starting_half_a_cycle_later_mirrors_the_walk():
    mirror = jnp.array([1.0, -1.0, 1.0])
    later = standing_anchor(ROBOT, RolloutConfig().walk.gait.cycle // 2)
    # A robot that is its own mirror image: the products of inertia that yaw couples to vanish.
    one = long_walk(nominal, "straight")
    other = walk(LONG, STRAIGHT._replace(anchor=later), nominal())
    position, force = other.state.position * mirror, other.command.force[:, ::-1] * mirror
    np.testing.assert_allclose(one.state.position[:50], position[:50], atol=1e-9)
    np.testing.assert_allclose(one.command.force[:50], force[:50], atol=1e-6)


@cache
def start():
    """Nominal weights with other numbers, so that all gradients over 50 ticks share a program."""
    return jax.tree.map(np.asarray, init(replace(CONFIG, others=OTHERS), nominal()).start)


def differences(config, scenario, weights, *, step, directions):
    """Central differences of the loss along directions (n, 24) in log-weights."""
    theta, found = vector(weights), []
    for direction in step * directions:
        vectors = (jnp.asarray(theta * np.exp(side * direction)) for side in (1, -1))
        both = (vector_to_weights(v, weights)._replace(others=weights.others) for v in vectors)
        up, down = (float(tune_step(config, scenario, moved).loss) for moved in both)
        found.append((up - down) / (2 * step))
    return np.array(found)


def relative(found, expected):
    return float(jnp.linalg.norm(found - expected) / jnp.linalg.norm(expected))


# Each has a part of all 24 numbers: a wrong one shows in a few directions as in 24.
OBLIQUE = np.linalg.qr(np.random.default_rng(0).normal(size=(24, 24)))[0][:5]


def check_gradient(config, scenario, weights, bar, directions=None, case=""):
    directions = np.eye(24) if directions is None else directions
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
    assert errors[-1] <= bar, (case, errors)
    trajectory, columns = propagate(config, scenario, weights)
    _, forward = sensitivity.gradient(PAPER_LOSS, trajectory, columns, weights)
    forward = weights_to_vector(jax.tree.map(jnp.multiply, forward, weights))
    assert relative(forward, reverse) <= 1e-8, case


def test_gradient_over_50_ticks_is_that_of_differences():
    weights = random_weights(0, nominal, 2.0)._replace(others=start().others)
    scenario = STRAIGHT._replace(command=named_command("s"))
    check_gradient(SHORT, scenario, weights, 1e-6, OBLIQUE)


@pytest.fixture
def cases():
    """Random weights for each trajectory, with phi the identity and the net: of one program."""
    effects, made = {"plain": PLAIN, "net": model.small_effect()}, []
    for (seed, name), said in product(enumerate(COMMANDS), effects):
        scenario = Scenario(ROBOT, named_command(name), ANCHOR, effects[said])
        made.append(((name, said), random_weights(seed, nominal, 2.0), scenario))
    return made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "bar"), [(SHORT, 1e-6), pytest.param(LONG, 1e-4, marks=pytest.mark.long)]
)
def test_the_gradient_is_that_of_differences_from_anywhere(cases, config, bar):
    for case, weights, scenario in cases:
        assert not walk(config, scenario, weights).fallen.any(), case
        check_gradient(config, scenario, weights, bar, case=case)


@pytest.mark.slow
def test_a_walk_in_blocks_is_the_same_walk_with_the_same_gradient():
    whole, parts = (
        tune_step(TuneConfig(rollout=RolloutConfig(ticks=50, block=block)), STRAIGHT, start())
        for block in (500, 23)  # the last block is padded
    )
    assert float(parts.loss) == pytest.approx(float(whole.loss), rel=1e-12)
    for a, b in zip(jax.tree.leaves(parts.gradient), jax.tree.leaves(whole.gradient), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


@pytest.fixture(scope="module")
def recursion():
    """The walk from there and its sensitivities."""
    return propagate(SHORT, STRAIGHT, start())


def test_gradient_norms_are_those_of_the_parts(recursion):
    weights = start()
    evaluated = partial(evaluate_jit, SHORT, STRAIGHT, weights)
    norms = list(gradient_norms(evaluated, weights, PAPER_LOSS).values())

    def gradient(euler, position):
        loss = with_alphas({"L_Eul": euler, "L_pos": position})
        _, found = sensitivity.gradient(loss, *recursion, weights)
        return vector(found) * vector(weights)

    control = gradient(0.0, 0.0)
    expected = gradient(1e6, 0.0) - control, gradient(0.0, 1e6) - control, 1e6 * control
    np.testing.assert_allclose(norms, 1e-6 * np.linalg.norm(expected, axis=1), rtol=1e-6)


def test_the_derivatives_by_other_numbers_are_those_of_differences_and_of_the_recursion(recursion):
    found = tune_step(CONFIG, STRAIGHT, start())
    parts = 1e5 * found.terms["L_Eul"] + 2e5 * found.terms["L_pos"] + found.terms["L_ctrl"]
    assert found.loss == pytest.approx(float(parts))
    assert step_status(CONFIG, found) == StepStatus.ACCEPTED

    def loss(name, shift):
        others = {**start().others, name: start().others[name] + shift}
        moved = start()._replace(others=others)
        return float(tune_step(CONFIG, STRAIGHT, moved).loss)

    for name in OTHERS:
        expected = (loss(name, 1e-6) - loss(name, -1e-6)) / 2e-6
        assert float(found.gradient.others[name]) == pytest.approx(expected, rel=1e-5, abs=1e-3)
    _, forward = sensitivity.gradient(PAPER_LOSS, *recursion, start())
    close = partial(np.testing.assert_allclose, rtol=1e-8, atol=1e-9)
    jax.tree.map(close, forward.others, {name: found.gradient.others[name] for name in OTHERS})
    np.testing.assert_allclose(vector(forward), vector(found.gradient), rtol=1e-8)
    forward = sensitivity.matrix(PAPER_LOSS, *recursion, start(), OTHERS)
    _, matrix = least_squares_jit(SHORT, STRAIGHT, start(), PAPER_LOSS, others=OTHERS)
    np.testing.assert_allclose(forward, matrix, rtol=1e-8, atol=1e-9 * np.abs(matrix).max())


@pytest.mark.skipif(jax.default_backend() != "gpu", reason="there is no GPU")
@pytest.mark.parametrize("walked", [rollout, parallel_rollout])
def test_gradients_of_64_varied_rollouts_on_a_gpu_are_those_of_the_cpu(walked):
    commands = 16 * [named_command(name) for name in ("straight", "c", "s", "sideways")]
    drawn = (drawn_variation(SHORT.walk, ROBOT, seed) for seed in range(64))
    pairs = zip(commands, drawn, strict=True)
    scenarios = stack([STRAIGHT._replace(command=c, variation=v) for c, v in pairs])
    weights = stack(sample_weights(nominal(), 1.5, 64))
    one = partial(evaluate, SHORT, loss=PAPER_LOSS, walk=walked)
    found = {}
    for platform in ("cpu", "gpu"):
        with jax.default_device(jax.devices(platform)[0]):
            inputs = jax.device_put((scenarios, weights), jax.devices(platform)[0])
            found[platform] = jax.device_get(jax.jit(jax.vmap(lambda s, w: one(s, w)))(*inputs))
    gpu, cpu = (jax.vmap(weights_to_vector)(found[on].gradient) for on in ("gpu", "cpu"))
    size = np.linalg.norm(cpu, axis=1)
    assert np.max(np.linalg.norm(gpu - cpu, axis=1) / size) < 1e-6
    np.testing.assert_allclose(found["gpu"].loss, found["cpu"].loss, rtol=1e-9)
