"""Tuning while walking: the gradient of a window, the guards, a walk that asks for weights."""

from dataclasses import replace

import adaptation
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adaptation import OnlineConfig, follow, init_trace, retuner

from hector_jax.control.controller import WalkConfig
from hector_jax.control.legs import Measurement
from hector_jax.control.parameters import bounds
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import (
    directions,
    nominal,
    vector_to_weights,
    weights_to_vector,
)
from hector_jax.core.trajectory import State, zero_wrench
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import ideal
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import MeasuredState
from hector_jax.tuning.loss import PAPER_LOSS, losses, total
from hector_jax.tuning.rollout import Scenario, init_carry, step_carry

ROBOT, TUNE, S = load_robot(), TuneConfig(), named_command("s")
ANCHOR = standing_anchor(ROBOT)
SCENARIO = Scenario(ROBOT, S, ANCHOR, last_command)
TICKS = 16  # two windows of 8, with a change of stance in the first; begun as many ticks late


def vector(weights):
    return np.asarray(weights_to_vector(weights))


def stack(trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


# The gradient, where what is measured is the rigid body itself


@jax.jit
def ahead(theta, carry, start):
    """Carries at the start of each tick of a walk on the rigid body, the last one, and the loss.

    The loss has the change from the command before the walk too.
    """

    def one(now, tick):
        weights = vector_to_weights(theta)
        after, sample = step_carry(TUNE.rollout, SCENARIO, weights, now, tick)
        return after, (now, sample)

    last, (carries, samples) = jax.lax.scan(one, carry, start + jnp.arange(TICKS))
    walk = samples._replace(period=samples.period[0], initial=carry.state)
    change = jax.tree.map(lambda new, old: new[0] - old[0], samples.command, carry.commands)
    change = sum(jnp.sum(x**2) for x in change)
    return carries, last, total(TUNE.loss, losses(PAPER_LOSS, walk)) + change


@pytest.fixture(scope="module")
def begin():
    """What the rigid body hands on after as many ticks, before a change of stance."""
    return ahead(vector(nominal()), init_carry(SCENARIO), 0)[1]


@pytest.fixture(scope="module")
def carries(begin):
    """What it hands from tick to tick from then on."""
    found, last, _ = jax.device_get(ahead(vector(nominal()), begin, TICKS))
    return [*(jax.tree.map(lambda x, i=i: x[i], found) for i in range(TICKS)), last]


def gradient(carries, trace, first, last, **how):
    told = stack([MeasuredState(carry.state, carry.feet) for carry in carries[first : last + 1]])
    weights = stack([nominal()] * (last - first))
    tick = jnp.asarray(TICKS + first)
    return follow(TUNE, ROBOT, S, ANCHOR, last_command, trace, weights, tick, told, **how)


def begun(carry):
    trace = init_trace(ANCHOR, MeasuredState(carry.state, carry.feet), zero_wrench(), nominal())
    return trace._replace(commands=carry.commands)


def test_along_the_models_own_states_two_windows_have_the_gradient_of_differences(begin, carries):
    trace, one, _ = gradient(carries, begun(carries[0]), 0, TICKS // 2)
    _, other, _ = gradient(carries, trace, TICKS // 2, TICKS)
    theta = vector(nominal())
    shift = np.exp(1e-5 * np.eye(24))

    def loss(theta):
        return float(ahead(theta, begin, TICKS)[2])

    expected = np.array([loss(theta * by) - loss(theta / by) for by in shift]) / 2e-5
    whole = loss(theta)
    assert float(one.loss + other.loss) == pytest.approx(whole, rel=1e-9)
    error = (vector(one.gradient) + vector(other.gradient)) * theta - expected
    assert np.linalg.norm(error) <= 1e-6 * np.linalg.norm(expected)


@pytest.mark.slow  # two programs to compile
def test_a_measured_sag_is_seen_as_long_as_it_is_measured(carries):
    """A trunk that stays 2 cm low asks for a dearer height; the model's own walk would rise."""

    def low(carry):
        lower = carry.state.position - jnp.array([0.0, 0.0, 0.02])
        return carry._replace(state=carry.state._replace(position=lower))

    sagged = [low(carry) for carry in carries]
    _, found, _ = gradient(sagged, begun(sagged[0]), 0, TICKS)
    _, free, _ = gradient(sagged, begun(sagged[0]), 0, TICKS, measured=False)
    assert found.gradient.Q.position[2] < 0.0
    assert found.gradient.Q.position[2] < free.gradient.Q.position[2]
    assert found.loss > free.loss


# Guards, with gradients that nobody had to compute


def toy(gradient=None, **wrong):
    """`follow` that finds what it is told to, window by window."""
    gradient = vector_to_weights(1.0 / vector(nominal())) if gradient is None else gradient
    count = len(directions()) + len(gradient.others)
    told = {"loss": 1.0, "fallen": 0.0, "residual": 1e-12} | wrong

    def found(config, robot, command, anchor, effect, trace, weights, tick, told_, measured):
        loss, fallen, residual = (np.asarray(told[k], float) for k in told)
        terms = dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), loss)
        return trace, Evaluation(loss, terms, gradient, fallen, residual), np.zeros((count, count))

    return found


MEASURED = Measurement(
    State(np.zeros(3), np.array([0.0, 0.0, 0.5]), np.zeros(3), np.zeros(3)),
    np.asarray(ROBOT.standing_joints),
    np.zeros(10),
)


def course(monkeypatch, config, follows, windows, start=None):
    """Weights by tick, and the steps told; `follows` are used one after another."""
    start, steps, turn = start or nominal(), [], iter(follows)
    monkeypatch.setattr(adaptation, "follow", lambda *a, **how: next(turn)(*a, **how))
    retune = retuner(config, ROBOT, start, S, last_command, steps.append)
    weights = []
    for tick in range(config.window * windows + 2):
        weights.append(retune(tick, ANCHOR, MEASURED, zero_wrench()))
    return weights, steps


def test_other_numbers_are_tuned_while_walking(monkeypatch):
    slope = vector_to_weights(jnp.ones(24))._replace(others={"turn_lead": jnp.array(-3.0)})
    config = OnlineConfig(tune=replace(TUNE, others=("turn_lead",)), window=5)
    weights, steps = course(monkeypatch, config, [toy(slope)] * 2, 2)
    leads = [float(one.others["turn_lead"]) for one in weights]
    assert leads[5] == 0.5
    assert leads[6] == leads[10] > leads[5]
    assert leads[11] > leads[10]
    assert [float(one.weights.others["turn_lead"]) for one in steps] == leads[5:11:5]


def test_weights_change_once_a_window_by_at_most_the_radius(monkeypatch):
    config = OnlineConfig(window=5)
    weights, steps = course(monkeypatch, config, [toy()] * 3, 3)
    changed = [
        t
        for t in range(1, len(weights))
        if not np.array_equal(*map(vector, weights[t - 1 : t + 1]))
    ]
    assert changed == [6, 11, 16]
    assert [s.iteration for s in steps] == [0, 1, 2]
    points = [np.log(vector(weights[t])[directions().argmax(axis=1)]) for t in (5, 6, 11, 16)]
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), config.radius)


def test_a_late_step_comes_into_force_late(monkeypatch):
    weights, _ = course(monkeypatch, OnlineConfig(window=5, late=3), [toy()], 1)
    assert all(np.array_equal(vector(w), vector(nominal())) for w in weights)
    longer, _ = course(monkeypatch, OnlineConfig(window=5, late=3), [toy()] * 2, 2)
    assert np.array_equal(vector(longer[8]), vector(nominal()))
    assert not np.array_equal(vector(longer[9]), vector(nominal()))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"fallen": 0.1}, "the robot fell"),
        ({"residual": 1e-3}, "QP residual"),
        ({"loss": np.nan}, "not finite"),
        ({"gradient": vector_to_weights(jnp.full(24, jnp.nan))}, "not finite"),
    ],
)
def test_a_window_that_cannot_be_believed_takes_the_last_step_back_and_halves(
    monkeypatch, wrong, told
):
    config = OnlineConfig(window=5)
    weights, steps = course(monkeypatch, config, [toy(), toy(**wrong), toy()], 3)
    assert [s.accepted for s in steps] == [True, False, True]
    assert told in steps[1].reason
    np.testing.assert_array_equal(vector(weights[11]), vector(nominal()))
    full, half = (np.log(vector(weights[t]) / vector(nominal())) for t in (6, 16))
    np.testing.assert_allclose(half, full / 2, rtol=1e-9)


def test_weights_stay_in_the_box(monkeypatch):
    lower = bounds()[0]
    weights, _ = course(monkeypatch, OnlineConfig(window=2), [toy()] * 4, 4, lower)
    assert all((vector(w) == vector(lower)).all() for w in weights)


@pytest.mark.parametrize(
    "wrong", [{"window": 1}, {"late": 40}, {"late": -1}, {"radius": 0.0}, {"estimator": "guess"}]
)
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        OnlineConfig(**wrong)


# The walk


def same_bytes(one, other):
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.asarray(a).tobytes() == np.asarray(b).tobytes() for a, b in pairs)


def test_a_walk_without_a_gradient_is_the_plain_walk(monkeypatch):
    args = WalkConfig(), ROBOT, Job(nominal(), S, ideal(), 0.3)
    plain = walk(*args)
    for gradient, same in ((vector_to_weights(jnp.zeros(24)), True), (None, False)):
        monkeypatch.setattr(adaptation, "follow", toy(gradient))
        retune = retuner(OnlineConfig(window=10), ROBOT, nominal(), S, last_command)
        assert same_bytes(plain, walk(*args, retune=retune)) == same


@pytest.mark.slow
def test_the_model_commands_along_the_measured_states_what_the_walk_commanded():
    """What is differentiated is the controller that walked: its commands are found again."""
    seen, told = [], []

    def watch(tick, *measured):
        seen.append(measured)
        return nominal()

    walk(WalkConfig(), ROBOT, Job(nominal(), S, ideal(), 0.45), retune=watch)
    retune = retuner(OnlineConfig(), ROBOT, nominal(), S, last_command, told.append)
    for tick, row in enumerate(seen):
        retune(tick, *row)
    commands = stack([last for _, _, last in seen[1:42]])
    change = jax.tree.map(lambda w: jnp.sum(jnp.diff(w, axis=0) ** 2), commands)
    assert float(told[0].evaluation.terms["L_ctrl"]) == pytest.approx(float(sum(change)), rel=1e-6)
