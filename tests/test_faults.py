"""Faults planted inside a tuning: refused, reported, and never in the weights."""

import json
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
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
from hector_jax.report.run import tuning_section
from hector_jax.robot.model import load_robot
from hector_jax.runs import tunings
from hector_jax.runs.folder import Journal
from hector_jax.runs.setup import Setup
from hector_jax.runs.tunings import Problem
from hector_jax.tuning import rollout
from hector_jax.tuning.difftune import TuneConfig, descend
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.rollout import RolloutConfig
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


@jax.custom_vjp
def spoiled(x, flag):
    """`x`, with a gradient that is not a number where the flag is set."""
    return x


spoiled.defvjp(lambda x, flag: (x, flag), lambda flag, g: (jnp.where(flag, jnp.nan, g), None))

step_carry = rollout.step_carry


def planted(config, robot, weights, command, effect, carry, tick, variation=None):
    """`step_carry` with the fault that the command names."""
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
    return step_carry(config, robot, weights, walked, effect, carry, tick, variation)


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


def tune(command, params, config=CONFIG, robot=ROBOT):
    """The tuning as a run does it; with the lines that it left."""
    with ThreadPoolExecutor(1) as pool, TemporaryDirectory() as kept:
        found = tunings.tune(
            Setup(pool, config, robot),
            {"with": Problem((command,), params)},
            Path(kept),
            title="tuning",
            journal=Journal(Path(kept) / "metrics.jsonl"),
        )
        lines = (Path(kept) / "metrics.jsonl").read_text().splitlines()
    return found["with"].tuning, [json.loads(line) for line in lines]


def call(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["hector", *map(str, arguments)])
    return main()


def inside(weights):
    lower, upper, vector = (np.asarray(weights_to_vector(w)) for w in (*bounds(), weights))
    return bool(((lower <= vector) & (vector <= upper)).all())  # NaN is not


def test_without_a_fault_nothing_is_refused(params):
    found, lines = tune(told(), params)
    assert all(line["accepted"] for line in lines)
    assert len(lines) == 15
    assert found.stop == "14 iterations"


@pytest.mark.parametrize("fault", REASONS)
def test_a_fault_is_refused_and_shrunk_and_the_run_goes_on(params, fault):
    """It shows beyond 0.03 in log-weights: a full step is 0.08, a quarter of it stays within."""
    found, lines = tune(told(fault, 0.03), params)
    assert [line["step"] for line in lines[:4]] == [0.0, 1.0, 0.5, 0.25]
    assert [line["accepted"] for line in lines[:4]] == [True, False, False, True]
    for before, line in zip(lines[1:], lines[2:], strict=False):
        grown = min(1.0, 2.0 * before["step"])
        assert line["step"] == (grown if before["accepted"] else before["step"] / 2)
    reasons = Counter(line["reason"] for line in lines if not line["accepted"])
    assert reasons.keys() <= {REASONS[fault], "the loss rose"}
    assert reasons[REASONS[fault]] >= 3
    refused = sum(not line["accepted"] for line in lines)
    assert f"{len(lines) - 1} iterations, {refused} refused" in tuning_section("with", found)
    assert all(inside(weights) for weights in (found.ten, found.converged))
    assert all(inside(iteration.weights) for iteration in found.history)
    assert weights_to_vector(found.converged)[0] != weights_to_vector(nominal())[0]


@pytest.mark.parametrize("fault", [Fault.FALL])
def test_where_every_step_is_refused_the_run_ends_with_the_reason(params, fault):
    found, lines = tune(told(fault), params)
    assert not any(line["accepted"] for line in lines[1:])
    assert [line["step"] for line in lines[1:]] == [0.5**i for i in range(len(lines) - 1)]
    expected = f"the step became too small to gain, the last refused: {REASONS[fault]}"
    assert found.stop == expected
    for weights in (found.ten, found.converged):
        jax.tree.map(np.testing.assert_array_equal, weights, nominal())


def spoilt_net(params):
    kernel = params.force["Dense_0"]["kernel"].at[0, 0, 0].set(jnp.nan)
    force = {**params.force, "Dense_0": {**params.force["Dense_0"], "kernel": kernel}}
    return told(), params._replace(force=force), ROBOT


def crouched(params):
    return told(), params, ROBOT._replace(standing_height=np.asarray(0.1))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [(spoilt_net, "loss or gradient not finite"), (crouched, "the robot fell")],
)
def test_a_start_that_cannot_be_believed_ends_the_run(params, spoil, reason):
    command, net, robot = spoil(params)
    with pytest.raises(ValueError, match=f"the starting weights cannot be tuned from: {reason}"):
        tune(command, net, robot=robot)


# Numbers that no rollout gives


def evaluated(loss, gradient):
    one = np.asarray(1.0)
    loss = np.asarray(float(loss))
    tree = jax.tree.map(lambda w: np.full_like(w, gradient), nominal())
    terms = dict.fromkeys(("L_Eul", "L_pos", "L_ctrl"), one)
    return Evaluation(loss, terms, tree, np.asarray(0.0), np.asarray(1e-12))


@pytest.mark.parametrize(
    "number", [np.nan, np.inf, -np.inf, 1.7e308, -1.7e308, 1e-308, 5e-324, 0.0]
)
@pytest.mark.parametrize("update", ["relative", "literal"])
@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_no_number_makes_weights_that_are_not_finite(number, update, where):
    """From the third evaluation on."""
    looks = Counter()

    def look(weights):
        looks["all"] += 1
        odd = {where: number} if looks["all"] > 2 else {}
        return evaluated(**{"loss": 1.0 / looks["all"], "gradient": 1e3, **odd})

    found = descend(TuneConfig(update=update, iterations=14), nominal(), look)
    assert all(inside(iteration.weights) for iteration in found.history)
    assert inside(found.ten)
    assert inside(found.converged)
    if not abs(number) < 1e150:
        assert not any(iteration.accepted for iteration in found.history[2:])
        assert found.stop.endswith("the last refused: loss or gradient not finite")
