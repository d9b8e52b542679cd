"""Faults planted inside a tuning: refused, reported, and never in the weights."""

import json
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.cli.main import main
from hector_jax.control.parameters import bounds
from hector_jax.control.reference import Command
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.report.run import tuning_section
from hector_jax.robot.model import load_robot
from hector_jax.store import tunings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem
from hector_jax.tuning import rollout
from hector_jax.tuning.difftune import TuneConfig, descend
from hector_jax.tuning.evaluate import Evaluation, Objective
from hector_jax.tuning.rollout import RolloutConfig
from hector_jax.tuning.status import Stop
from tests.model import small_net

pytestmark = pytest.mark.usefixtures("on_cpu")
ROBOT = load_robot()
TICKS, AT = 24, 9  # of the walk, of the fault
CONFIG = TuneConfig(rollout=RolloutConfig(ticks=TICKS), iterations=14)


class Fault(IntEnum):
    """What is planted; told to the program in the command, so that all share one."""

    NONE = 0
    STATE = 1
    GRADIENT = 2
    QP = 3
    FALL = 4
    FLAT = 5


REASONS = {
    Fault.STATE: "loss or gradient not finite",
    Fault.GRADIENT: "loss or gradient not finite",
    Fault.QP: "QP residual inf too large",
    Fault.FALL: "the robot fell",
    Fault.FLAT: "QP residual inf too large",
}


def told(fault=Fault.NONE, reach=0.0):
    """A straight line whose last piece, never walked, names the fault.

    It shows in weights that are further than `reach`, in log-weights, from the nominal ones.
    """
    seconds, velocity = np.array([1e3, 1.0]), np.array([[0.5, 0.0], [float(AT), reach]])
    return Command(*(np.concatenate([x, x[:1]]) for x in (seconds, velocity, [0.0, fault])))


@jax.custom_jvp
def spoiled(x, flag):
    """`x`, with a derivative that is not a number where the flag is set."""
    return x


@spoiled.defjvp
def _(primals, tangents):
    (x, flag), (tangent, _) = primals, tangents
    return x, jnp.where(flag, jnp.nan, 1.0) * tangent


step_carry = rollout.step_carry


def planted(config, scenario, weights, carry, tick, *, wrench=None):
    """`step_carry` with the fault that the command names."""
    command = scenario.command
    flat = [weights_to_vector(w) for w in (weights, nominal())]
    far = jnp.max(jnp.abs(jnp.log(flat[0] / flat[1]))) > command.velocity[1, 1]
    now = far & (tick == command.velocity[1, 0])
    is_now = lambda fault: now & (command.yaw_rate[1] == fault)  # noqa: E731
    walked = command._replace(yaw_rate=jnp.zeros_like(command.yaw_rate))
    position = spoiled(carry.state.position, is_now(Fault.GRADIENT))
    position = jnp.where(is_now(Fault.STATE), jnp.nan, position)
    position = position.at[2].set(jnp.where(is_now(Fault.FALL), 0.1, position[2]))
    carry = carry._replace(state=carry.state._replace(position=position))
    curved = jnp.where(is_now(Fault.QP), -1.0, weights.R.force)  # a QP that is not convex
    weights = weights._replace(R=weights.R._replace(force=curved))
    # a QP without a price, solved by any wrench
    weights = jax.tree.map(lambda w: jnp.where(is_now(Fault.FLAT), 0.0, w), weights)
    return step_carry(config, scenario._replace(command=walked), weights, carry, tick)


@pytest.fixture(scope="module", autouse=True)
def plant():
    """The commands of this file have a shape of their own, so that no other test meets it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "step_carry", planted)
        yield


@pytest.fixture(scope="module")
def params():
    """A small net that adds a newton or so to what was commanded."""
    return small_net()


RULES = {"gauss_newton": 8.0, "relative": 2.0}  # by how much a refusal shortens the step
REACH = {"gauss_newton": 0.3, "relative": 0.03}  # a full step goes beyond it, some share does not


def tune(command, params, config=CONFIG, robot=ROBOT):
    """The tuning as a run does it; with the lines that it left."""
    with ThreadPoolExecutor(1) as pool, TemporaryDirectory() as kept:
        found = tunings.tune_all(
            Setup(pool, config, robot),
            {"with": Problem((command,), params)},
            Path(kept),
            title="tuning",
            metrics=Path(kept) / "metrics.jsonl",
        )
        lines = (Path(kept) / "metrics.jsonl").read_text().splitlines()
    return found["with"].tuning, [json.loads(line) for line in lines]


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["hector", *map(str, arguments)])
    return main()


def inside(weights):
    lower, upper, vector = (np.asarray(weights_to_vector(w)) for w in (*bounds(), weights))
    return bool(((lower <= vector) & (vector <= upper)).all())  # NaN is not


def furthest(weights):
    """The largest change of a weight from nominal, in logs."""
    vector, start = (np.asarray(weights_to_vector(w)) for w in (weights, nominal()))
    return np.abs(np.log(vector / start)).max()


@pytest.mark.parametrize("rule", RULES)
def test_without_a_fault_nothing_is_refused_as_one(params, rule):
    found, lines = tune(told(), params, replace(CONFIG, rule=rule))
    assert len(lines) == len(found.iterations) > 1
    if rule == "relative":
        assert all(line["accepted"] for line in lines)
        assert found.reason == "14 iterations"
    assert {line["reason"] for line in lines} <= {"", "the loss did not fall as predicted"}


@pytest.mark.parametrize("fault", REASONS)
@pytest.mark.parametrize("rule", RULES)
def test_a_fault_is_refused_and_shrunk_and_the_run_goes_on(params, fault, rule):
    reach = REACH[rule]
    found, lines = tune(told(fault, reach), params, replace(CONFIG, rule=rule))
    assert [line["step"] for line in lines[:2]] == [0.0, 1.0]
    assert [line["accepted"] for line in lines[:2]] == [True, False]
    first = next(i for i, line in enumerate(lines[1:], 1) if line["accepted"])
    assert {line["reason"] for line in lines[1:first]} == {REASONS[fault]}
    for before, line in zip(lines[1:], lines[2:], strict=False):
        if not before["accepted"]:
            assert line["step"] == pytest.approx(before["step"] / RULES[rule])
        elif rule == "relative":
            assert line["step"] == min(1.0, 2.0 * before["step"])
    reasons = Counter(line["reason"] for line in lines if not line["accepted"])
    assert reasons.keys() <= {REASONS[fault], "the loss did not fall as predicted"}
    assert reasons[REASONS[fault]] >= first - 1
    refused = sum(not line["accepted"] for line in lines)
    section = tuning_section("with", found)
    assert f"{len(lines) - 1} iterations, {refused} refused" in section
    assert all(inside(iteration.weights) for iteration in found.iterations)
    assert all(furthest(i.weights) <= reach for i in found.iterations if i.accepted)
    assert 0.0 < furthest(found.weights) <= reach
    assert np.isfinite(found.precision).all()


@pytest.mark.parametrize("rule", RULES)
def test_where_every_step_is_refused_the_run_ends_with_the_reason(params, rule):
    config = replace(CONFIG, rule=rule)
    found, lines = tune(told(Fault.FALL), params, config)
    assert not any(line["accepted"] for line in lines[1:])
    assert {line["reason"] for line in lines[1:]} == {REASONS[Fault.FALL]}
    steps = [RULES[rule] ** -i for i in range(len(lines) - 1)]
    np.testing.assert_allclose([line["step"] for line in lines[1:]], steps)
    expected = Stop.NO_GAIN if rule == "gauss_newton" else Stop.SMALL_STEP
    assert Stop(int(found.stop)) == expected
    jax.tree.map(np.testing.assert_array_equal, found.weights, nominal())


def spoilt_net(params):
    kernel = params.force["Dense_0"]["kernel"].at[0, 0, 0].set(jnp.nan)
    force = {**params.force, "Dense_0": {**params.force["Dense_0"], "kernel": kernel}}
    return told(), params._replace(force=force), ROBOT


def crouched(params):
    return told(), params, ROBOT._replace(standing_height=np.asarray(0.1))


@pytest.mark.parametrize(
    ("spoil", "reason"), [(spoilt_net, "loss or gradient not finite"), (crouched, "the robot fell")]
)
def test_a_start_that_cannot_be_believed_ends_the_run(params, spoil, reason):
    command, net, robot = spoil(params)
    with pytest.raises(ValueError, match=f"the starting weights cannot be tuned from: {reason}"):
        tune(command, net, robot=robot)


# Numbers that no rollout gives

NUMBERS = [np.nan, np.inf, -np.inf, 1.7e308, -1.7e308, 1e-308, 5e-324, 0.0]


def evaluated(loss, gradient):
    one = np.asarray(1.0)
    loss = np.asarray(float(loss))
    tree = jax.tree.map(lambda w: np.full_like(w, gradient), nominal())
    terms = dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), one)
    return Evaluation(loss, terms, tree, np.asarray(0.0), np.asarray(1e-12))


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("rule", ["gauss_newton", "relative", "literal"])
@pytest.mark.parametrize("where", ["loss", "gradient", "matrix"])
@pytest.mark.parametrize("begin", [1, 3])
def test_no_number_makes_weights_that_are_not_finite(number, rule, where, begin):
    """From the first evaluation or the third one on."""
    looks = Counter()

    def look(weights):
        looks["all"] += 1
        odd = {where: number} if looks["all"] >= begin and where != "matrix" else {}
        return evaluated(**{"loss": 1.0 / looks["all"], "gradient": 1e-3, **odd})

    def matrix(weights):
        odd = where == "matrix" and looks["all"] >= begin
        return np.full((18, 18), number) if odd else np.eye(18)

    config, refused = replace(CONFIG, rule=rule), not abs(number) < 1e150
    if where == "matrix":
        refused = rule == "gauss_newton" and not np.isfinite(number)
    if refused and begin == 1:
        with pytest.raises(InputError, match="loss or gradient not finite"):
            descend(config, nominal(), Objective(look, matrix))
        return
    found = descend(config, nominal(), Objective(look, matrix))
    assert all(inside(iteration.weights) for iteration in found.iterations)
    assert inside(found.weights)
    if refused:
        assert not any(iteration.accepted for iteration in found.iterations[2:])
        assert found.iterations[-1].reason == "loss or gradient not finite"
