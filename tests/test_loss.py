"""The loss: sums by hand, the same number in every world, what a fall costs."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pretend import pretend_walk

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.grfm.effect import last_command
from hector_jax.report.report import render
from hector_jax.robot.model import load_robot
from hector_jax.store.folder import as_line
from hector_jax.tuning.difftune import TuneConfig, tune
from hector_jax.tuning.loss import PAPER_LOSS, LossTerm, losses, switch_loss, total, with_alphas
from hector_jax.tuning.rollout import RolloutConfig, Scenario
from hector_jax.verdict import metrics

NAMES = ["L_Eul", "L_pos", "L_ctrl"]
parts_of, switches_of = jax.jit(partial(losses, PAPER_LOSS)), jax.jit(switch_loss)


def walk(count=6, period=0.01):
    """A walk without any error under a constant command; numpy arrays."""
    zero = np.zeros((count, 3))
    state = State(zero, zero, zero, zero)
    load = np.tile([0.0, 0.0, 60.0], (count, 2, 1))
    wrench = Wrench(load, np.zeros((count, 2, 3)))
    return Trajectory(
        period=np.array(period),
        initial=State(*np.zeros((4, 3))),
        state=state,
        reference=state,
        command=wrench,
        effect=wrench,
        contact=np.ones((count, 2), bool),
        feet=np.zeros((count, 2, 3)),
        joints=np.zeros((count, 10)),
        fallen=np.zeros(count, bool),
        legs_touch=np.zeros(count, bool),
        residual=np.zeros(count),
    )


def off_by(trajectory, euler=None, position=None):
    state = trajectory.state
    state = state._replace(
        euler=state.euler + (0.0 if euler is None else euler),
        position=state.position + (0.0 if position is None else position),
    )
    return trajectory._replace(state=state)


def fallen_from(trajectory, sample):
    return trajectory._replace(fallen=np.arange(len(trajectory.fallen)) >= sample)


def test_a_perfect_walk_under_a_constant_command_costs_nothing():
    assert parts_of(walk()) == dict.fromkeys(NAMES, 0.0)


def test_errors_are_squared_and_summed_over_milliseconds():
    error = np.zeros((6, 3))
    error[2], error[4] = [0.1, 0.2, 0.0], [0.0, 0.0, -0.3]
    parts = parts_of(off_by(walk(), euler=error, position=2 * error))
    # a tick of 10 ms stands for ten samples
    assert parts["L_Eul"] == pytest.approx(10 * (0.01 + 0.04 + 0.09))
    assert parts["L_pos"] == pytest.approx(4 * parts["L_Eul"])
    assert parts["L_ctrl"] == 0.0


def test_control_counts_each_change_of_the_command_once():
    trajectory = walk()
    force, moment = (w.copy() for w in trajectory.command)
    force[3:, 0, 2] += 3.0
    force[3:, 1, 0] -= 4.0
    moment[5:, 1, 1] += 2.0
    parts = parts_of(trajectory._replace(command=Wrench(force, moment)))
    assert parts["L_ctrl"] == pytest.approx(9 + 16 + 4)


def test_the_same_errors_cost_the_same_at_any_sampling():
    rng = np.random.default_rng(0)
    slow = off_by(walk(20), rng.normal(size=(20, 3)), rng.normal(size=(20, 3)))
    command = Wrench(*(rng.normal(size=(20, 2, 3)) for _ in range(2)))
    contact = np.repeat([[True, False], [False, True]], 10, axis=0)
    slow = slow._replace(command=command, contact=contact)
    rows = jax.tree.map(
        lambda x: np.repeat(x, 10, axis=0), slow._replace(initial=None, period=None)
    )
    fast = rows._replace(initial=slow.initial, period=np.array(0.001))
    close = partial(jax.tree.map, partial(np.testing.assert_allclose, rtol=1e-6))
    close(parts_of(slow), parts_of(fast))
    assert switches_of(slow) == pytest.approx(switches_of(fast))
    for sample in (7, 15):
        close(parts_of(fallen_from(slow, sample)), parts_of(fallen_from(fast, 10 * sample)))


def test_after_a_fall_each_sample_is_charged_a_fixed_error_at_least():
    trajectory = fallen_from(off_by(walk(), euler=0.1, position=0.1), 4)
    parts = parts_of(trajectory)
    assert parts["L_Eul"] == pytest.approx(10 * (4 * 3 * 0.01 + 2 * 0.8**2))
    assert parts["L_pos"] == pytest.approx(10 * (4 * 3 * 0.01 + 2 * 0.5**2))


def test_what_a_fallen_robot_does_is_not_looked_at():
    trajectory = fallen_from(walk(), 3)
    nonsense = np.where(trajectory.fallen[:, None], np.nan, 0.0)
    wild = Wrench(*(w + nonsense[:, None] for w in trajectory.command))
    parts = parts_of(off_by(trajectory, nonsense, nonsense)._replace(command=wild))
    assert parts == parts_of(trajectory)
    assert parts["L_ctrl"] == 0.0


def test_falling_earlier_costs_more():
    trajectory = off_by(walk(), 0.05, 0.05)
    costs = [float(total(PAPER_LOSS, parts_of(fallen_from(trajectory, k)))) for k in range(7)]
    assert (np.diff(costs) < 0).all()


def test_yaw_errors_are_not_wrapped():
    whole_turn = np.array([0.0, 0.0, 2 * np.pi])
    parts = parts_of(off_by(walk(), euler=whole_turn))
    assert parts["L_Eul"] == pytest.approx(10 * 6 * (2 * np.pi) ** 2)
    turned = walk()
    both = turned.state._replace(euler=np.tile(3 * whole_turn, (6, 1)))
    assert parts_of(turned._replace(state=both, reference=both))["L_Eul"] == 0.0


def test_switch_loss_is_the_share_at_changes_of_stance():
    trajectory = walk()
    force = trajectory.command.force.copy()
    force[2:, 0, 0] += 5.0  # no switch here
    force[4:, 0, 2] = 0.0  # the left foot lifts
    contact = trajectory.contact.copy()
    contact[4:, 0] = False
    trajectory = trajectory._replace(
        command=trajectory.command._replace(force=force), contact=contact
    )
    assert switches_of(trajectory) == pytest.approx(60.0**2)
    assert parts_of(trajectory)["L_ctrl"] == pytest.approx(60.0**2 + 25.0)


def test_the_total_is_weighted_by_the_alphas():
    parts = parts_of(off_by(walk(), 0.1, 0.2)) | {"L_ctrl": jnp.array(7.0)}
    expected = 3.0 * parts["L_Eul"] + 5.0 * parts["L_pos"] + 7.0
    assert total(with_alphas({"L_Eul": 3.0, "L_pos": 5.0}), parts) == pytest.approx(expected)


def sway_loss(trajectory):
    """A term of one's own: squared sideways velocity."""
    return jnp.sum(trajectory.state.velocity[:, 1] ** 2)


def test_a_fourth_term_is_tuned_told_and_written_from_one_place():
    loss = (*PAPER_LOSS, LossTerm("L_sway", "m^2/s^2", 1e4, sway_loss))
    config = TuneConfig(rollout=RolloutConfig(ticks=20), loss=loss, iterations=1)
    robot = load_robot()
    scenario = Scenario(robot, named_command("s"), standing_anchor(robot), last_command)
    tuning = tune(config, scenario, nominal())
    first = tuning.iterations[0]
    terms = first.evaluation.terms
    assert terms["L_sway"] > 0.0
    assert first.evaluation.loss == pytest.approx(float(total(loss, terms)))
    line = json.loads(as_line("mine", first))
    assert line["L_sway"] == pytest.approx(float(terms["L_sway"]))
    walks = [metrics.score(loss, pretend_walk())] * 2
    verdict = metrics.make_verdict(loss, [0, 1], {"s": {"nominal": walks, "mine": walks}})
    result = metrics.verdict_result(verdict)
    assert result["alpha"]["L_sway"] == 1e4
    mean = result["sets"]["mine"]["standin"]["L_sway"]["mean"]
    assert mean == walks[0].losses["L_sway"]
    text = render("verdict.md.j2", verdict=verdict)
    assert "L_sway" in text.splitlines()[0]
    assert "L_sway [m^2/s^2]" in text


def test_terms_that_cannot_be_told_apart_are_refused():
    with pytest.raises(InputError, match="unlike names"):
        TuneConfig(loss=(*PAPER_LOSS, PAPER_LOSS[0]))
    with pytest.raises(InputError, match="unlike names"):
        TuneConfig(loss=(LossTerm("sway", "", 1.0, sway_loss),))


def test_after_a_fall_a_larger_error_stays():
    parts = parts_of(fallen_from(off_by(walk(), euler=2.0, position=2.0), 4))
    assert parts["L_Eul"] == parts["L_pos"] == pytest.approx(10 * 6 * 3 * 4.0)
