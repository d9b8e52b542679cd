"""Faults planted inside a tuning: refused, reported, and never in the weights."""

from collections import Counter
from dataclasses import replace
from enum import IntEnum

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ROBOT, small_effect

from hector_jax import InputError, RolloutConfig, Scenario
from hector_jax.control.parameters import bounds
from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.tuning import difftune, rollout
from hector_jax.tuning.difftune import TuneConfig, descend
from hector_jax.tuning.evaluate import Evaluation, Objective
from hector_jax.tuning.status import Stop

pytestmark = pytest.mark.usefixtures("on_cpu")
AT = 9  # tick of the fault
CONFIG = TuneConfig(rollout=RolloutConfig(ticks=24), iterations=14)
EFFECT = small_effect()  # adds a newton or so to what was commanded


class Fault(IntEnum):
    """What is planted; told to the program in the command, so that all share one."""

    NONE = 0
    STATE = 1
    GRADIENT = 2
    QP = 3
    FALL = 4
    FLAT = 5


REASONS = dict.fromkeys((Fault.STATE, Fault.GRADIENT), "loss or gradient not finite")
REASONS |= dict.fromkeys((Fault.QP, Fault.FLAT), "QP residual inf too large")
REASONS |= {Fault.FALL: "the robot fell"}


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
    ratio = weights_to_vector(weights) / weights_to_vector(nominal())
    far = jnp.max(jnp.abs(jnp.log(ratio))) > command.velocity[1, 1]
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


RULES = {"gauss_newton": 8.0, "relative": 2.0}  # by how much a refusal shortens the step
REACH = {"gauss_newton": 0.3, "relative": 0.03}  # a full step goes beyond it, some share does not


def tune(command, rule="relative", robot=ROBOT, effect=EFFECT):
    scenario = Scenario(robot, command, standing_anchor(robot), effect)
    return difftune.tune(replace(CONFIG, rule=rule), scenario, nominal())


def inside(weights):
    lower, upper, at = (weights_to_vector(w) for w in (*bounds(), weights))
    return bool(((lower <= at) & (at <= upper)).all())  # NaN is not


def furthest(weights):
    """The largest change of a weight from nominal, in logs."""
    return np.abs(np.log(weights_to_vector(weights) / weights_to_vector(nominal()))).max()


@pytest.mark.parametrize("fault", REASONS)
@pytest.mark.parametrize("rule", RULES)
def test_a_fault_is_refused_and_shrunk_and_the_run_goes_on(fault, rule):
    reach = REACH[rule]
    found = tune(told(fault, reach), rule)
    rows = found.iterations
    assert [float(row.step_size) for row in rows[:2]] == [0.0, 1.0]
    assert [row.accepted for row in rows[:2]] == [True, False]
    first = next(i for i, row in enumerate(rows[1:], 1) if row.accepted)
    reason = REASONS[fault]
    if (fault, rule) == (Fault.STATE, "gauss_newton"):  # its derivatives end where the robot fell
        reason = REASONS[Fault.FALL]
    assert {row.reason for row in rows[1:first]} == {reason}
    for before, row in zip(rows[1:], rows[2:], strict=False):
        if not before.accepted:
            assert float(row.step_size) == pytest.approx(before.step_size / RULES[rule])
        elif rule == "relative":
            assert row.step_size == min(1.0, 2.0 * before.step_size)
    reasons = {row.reason for row in rows if not row.accepted}
    assert reasons <= {reason, "the loss did not fall as predicted"}
    assert all(inside(row.weights) for row in rows)
    assert all(furthest(row.weights) <= reach for row in rows if row.accepted)
    assert 0.0 < furthest(found.weights) <= reach
    assert np.isfinite(found.precision).all()


@pytest.mark.parametrize("rule", RULES)
def test_where_every_step_is_refused_the_run_ends_with_the_reason(rule):
    found = tune(told(Fault.FALL), rule)
    rows = found.iterations[1:]
    assert {row.reason for row in rows} == {REASONS[Fault.FALL]}
    steps = [RULES[rule] ** -i for i in range(len(rows))]
    np.testing.assert_allclose([row.step_size for row in rows], steps)
    assert Stop(int(found.stop)) == Stop.SMALL_STEP
    jax.tree.map(np.testing.assert_array_equal, found.weights, nominal())


def test_a_start_that_cannot_be_believed_ends_the_run():
    spoilt = jax.tree.map(lambda x: jnp.nan * x if x.dtype.kind == "f" else x, EFFECT)
    crouched = ROBOT._replace(standing_height=np.asarray(0.1))
    words = "the starting weights cannot be tuned from:"
    with pytest.raises(InputError, match=f"{words} loss or gradient not finite"):
        tune(told(), effect=spoilt)
    with pytest.raises(InputError, match=f"{words} the robot fell"):
        tune(told(), robot=crouched)


NUMBERS = [np.nan, np.inf, -np.inf, 1.7e308, -1.7e308, 1e-308, 5e-324, 0.0]


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("rule", ["gauss_newton", "relative", "literal"])
@pytest.mark.parametrize("where", ["loss", "gradient", "matrix"])
@pytest.mark.parametrize("begin", [1, 3])
def test_no_number_makes_weights_that_are_not_finite(number, rule, where, begin):
    """From the first evaluation or the third one on."""
    looks = Counter()

    def look(weights):
        looks["all"] += 1
        odd = {where: number} if looks["all"] >= begin else {}
        gradient = jax.tree.map(lambda w: np.full_like(w, odd.get("gradient", 1e-3)), nominal())
        loss = np.asarray(float(odd.get("loss", 1.0 / looks["all"])))
        matrix = np.full((18, 18), number) if "matrix" in odd else np.eye(18)
        return Evaluation(loss, {}, gradient, np.asarray(0.0), np.asarray(1e-12)), matrix

    config, refused = replace(CONFIG, rule=rule), not abs(number) < 1e150
    if where == "matrix":
        refused = rule == "gauss_newton" and not np.isfinite(number)
    if refused and begin == 1:
        with pytest.raises(InputError, match="loss or gradient not finite"):
            descend(config, nominal(), Objective(look))
        return
    found = descend(config, nominal(), Objective(look))
    assert all(inside(iteration.weights) for iteration in found.iterations)
    assert inside(found.weights)
    if refused:
        assert not any(iteration.accepted for iteration in found.iterations[2:])
        assert found.iterations[-1].reason == "loss or gradient not finite"
