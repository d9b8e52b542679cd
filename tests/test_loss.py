"""The loss: sums by hand, the same number in every world, what a fall costs."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from model import ANCHOR, ROBOT
from pretend import pretend_walk, still_walk

from hector_jax import PAPER_LOSS, InputError, LossTerm, last_command, named_command, nominal
from hector_jax.core.trajectory import State, Wrench, has_fallen
from hector_jax.report.report import render
from hector_jax.store.run import as_row
from hector_jax.tuning import loss as loss_terms
from hector_jax.tuning.difftune import TuneConfig, tune
from hector_jax.tuning.loss import changes_between, losses, residuals, total
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.verdict import metrics

parts_of, switches_of = jax.jit(partial(losses, PAPER_LOSS)), jax.jit(loss_terms.switch_loss)


def walk(count=6, period=0.01):
    """A walk without any error under a constant command; numpy arrays."""
    zero = np.zeros((count, 3))
    state = State(zero, zero, zero, zero)
    load = np.tile([0.0, 0.0, 60.0], (count, 2, 1))
    parts = {"command": Wrench(load, np.zeros_like(load)), "initial": State(*np.zeros((4, 3)))}
    parts |= {"contact": np.ones((count, 2), bool), "state": state, "reference": state}
    return still_walk(count, period=np.array(period), **parts)


def off_by(trajectory, euler=0.0, position=0.0):
    state = trajectory.state
    moved = state._replace(euler=state.euler + euler, position=state.position + position)
    return trajectory._replace(state=moved)


def fallen_from(trajectory, sample):
    return trajectory._replace(fallen=np.arange(len(trajectory.fallen)) >= sample)


def test_errors_are_squared_and_summed_over_milliseconds_and_yaw_is_not_wrapped():
    error = np.zeros((6, 3))
    error[2], error[4] = [0.1, 0.2, 0.0], [0.0, 0.0, -2.0 * np.pi]
    parts = parts_of(off_by(walk(), euler=error, position=2 * error))
    # a tick of 10 ms stands for ten samples
    assert parts["L_Eul"] == pytest.approx(10 * (0.01 + 0.04 + 4.0 * np.pi**2))
    assert parts["L_pos"] == pytest.approx(4 * parts["L_Eul"])
    assert parts["L_ctrl"] == 0.0


def test_the_same_errors_cost_the_same_at_any_sampling():
    rng = np.random.default_rng(0)
    slow = off_by(walk(20), rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    command = Wrench(*(rng.normal(size=(20, 2, 3)) for _ in range(2)))
    contact = np.repeat([[True, False], [False, True]], 10, axis=0)
    slow = slow._replace(command=command, contact=contact)
    rows = slow._replace(initial=None, period=None)
    rows = jax.tree.map(lambda x: np.repeat(x, 10, axis=0), rows)
    fast = rows._replace(initial=slow.initial, period=np.array(0.001))
    close = partial(jax.tree.map, partial(np.testing.assert_allclose, rtol=1e-6))
    close(parts_of(slow), parts_of(fast))
    assert switches_of(slow) == pytest.approx(switches_of(fast))
    for sample in (7, 15):
        close(parts_of(fallen_from(slow, sample)), parts_of(fallen_from(fast, 10 * sample)))


def test_after_a_fall_each_sample_is_charged_a_fixed_error_whatever_the_robot_does():
    for error, euler, position in ((0.1, 0.8**2, 0.5**2), (2.0, 3 * 4.0, 3 * 4.0)):
        parts = parts_of(fallen_from(off_by(walk(), error, error), 4))
        assert parts["L_Eul"] == pytest.approx(10 * (4 * 3 * error**2 + 2 * euler))
        assert parts["L_pos"] == pytest.approx(10 * (4 * 3 * error**2 + 2 * position))
    trajectory = fallen_from(walk(), 3)
    nonsense = np.where(trajectory.fallen[:, None], np.nan, 0.0)
    wild = Wrench(*(w + nonsense[:, None] for w in trajectory.command))
    parts = parts_of(off_by(trajectory, nonsense, nonsense)._replace(command=wild))
    assert parts == parts_of(trajectory)
    assert parts["L_ctrl"] == 0.0


def test_control_counts_each_change_once_and_those_at_changes_of_stance_are_its_switch_loss():
    trajectory = walk()
    contact, force, moment = (x.copy() for x in (trajectory.contact, *trajectory.command))
    force[2:, 0, 0] += 5.0
    force[3:, 1, 2] -= 4.0
    moment[5:, 1, 1] += 2.0
    force[4:, 0, 2] = 0.0  # the left foot lifts
    contact[4:, 0] = False
    trajectory = trajectory._replace(command=Wrench(force, moment), contact=contact)
    assert switches_of(trajectory) == pytest.approx(60.0**2)
    assert np.sum(changes_between(trajectory) ** 2) == pytest.approx(25.0 + 16.0 + 4.0)
    assert parts_of(trajectory)["L_ctrl"] == pytest.approx(60.0**2 + 45.0)


def sway(trajectory):
    """A term of one's own: sideways velocity."""
    return trajectory.state.velocity[:, 1]


def test_a_fourth_term_is_tuned_told_and_written_from_one_place():
    loss = (*PAPER_LOSS, LossTerm("L_sway", "m^2/s^2", 1e4, sway))
    config = TuneConfig(rollout=RolloutConfig(ticks=20), loss=loss, iterations=1)
    scenario = Scenario(ROBOT, named_command("s"), ANCHOR, last_command)
    tuning = tune(config, scenario, nominal())
    first = tuning.iterations[0]
    terms = first.evaluation.terms
    assert terms["L_sway"] > 0.0
    assert first.evaluation.loss == pytest.approx(float(total(loss, terms)))
    walked = rollout(config.rollout, scenario, nominal())
    assert first.evaluation.loss == pytest.approx(float(np.sum(residuals(loss, walked) ** 2)))
    assert as_row("mine", first)["L_sway"] == pytest.approx(float(terms["L_sway"]))
    walks = [metrics.score(loss, pretend_walk())] * 2
    verdict = metrics.make_verdict(loss, [0, 1], {"s": {"nominal": walks, "mine": walks}})
    result = metrics.verdict_result({"standin": verdict})
    assert result["alpha"]["L_sway"] == 1e4
    assert result["sets"]["mine"]["standin"]["L_sway"]["mean"] == walks[0].losses["L_sway"]
    assert "L_sway [m^2/s^2]" in render("verdict.md.j2", verdict=verdict)


def test_a_robot_that_is_elsewhere_can_still_go_as_fast_as_it_should():
    """Velocities count along the robot's own yaw; a file adds the terms by their names."""
    weights = (("L_vel", 2.0), ("L_yaw_rate", 3.0))
    loss = loss_terms.loss_of_robot(replace(ROBOT.description, loss=weights))
    assert loss[:3] == PAPER_LOSS
    ahead, aside = np.tile([0.5, 0.0, 0.0], (6, 1)), np.tile([0.0, 0.5, 0.0], (6, 1))
    quarter, there = np.tile([0.0, 0.0, np.pi / 2], (6, 1)), walk()
    there = there._replace(reference=there.reference._replace(velocity=ahead))
    moved = State(quarter, 7.0 + 0.0 * quarter, 0.0 * quarter, aside)
    found = losses(loss, there._replace(state=moved))
    np.testing.assert_allclose([found["L_vel"], found["L_yaw_rate"]], 0.0, atol=1e-12)
    slow = moved._replace(velocity=0.5 * aside, ang_velocity=0.1 * quarter)
    found = losses(loss, there._replace(state=slow))
    np.testing.assert_allclose(found["L_vel"], 60 * 0.25**2)
    np.testing.assert_allclose(found["L_yaw_rate"], 60 * (0.1 * np.pi / 2) ** 2)


def test_terms_that_cannot_be_told_apart_are_refused():
    for loss in ((*PAPER_LOSS, PAPER_LOSS[0]), (LossTerm("sway", "", 1.0, sway),)):
        with pytest.raises(InputError, match="unlike names"):
            TuneConfig(loss=loss)


def test_a_fall_is_a_fall():
    zero = np.zeros(3)
    upright = State(zero, np.array([0.0, 0.0, 0.41]), zero, zero)
    assert not has_fallen(upright)
    assert not has_fallen(upright._replace(euler=np.array([0.7, -0.7, 3.0])))
    assert has_fallen(upright._replace(position=np.array([0.0, 0.0, 0.24])))
    assert has_fallen(upright._replace(euler=np.array([0.0, -0.81, 0.0])))
    assert has_fallen(upright._replace(euler=np.array([0.81, 0.0, 0.0])))
    assert has_fallen(upright._replace(velocity=np.array([0.0, np.nan, 0.0])))
