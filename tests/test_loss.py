"""The loss: sums by hand, the same number in every world, what a fall costs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.core.trajectory import State, Trajectory, Wrench
from hector_jax.tuning.loss import LossConfig, losses, switch_loss, total

parts_of, switches_of = jax.jit(losses), jax.jit(switch_loss)


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
    assert parts_of(walk()) == (0.0, 0.0, 0.0)


def test_errors_are_squared_and_summed_over_milliseconds():
    error = np.zeros((6, 3))
    error[2], error[4] = [0.1, 0.2, 0.0], [0.0, 0.0, -0.3]
    parts = parts_of(off_by(walk(), euler=error, position=2 * error))
    # a tick of 10 ms stands for ten samples
    assert parts.euler == pytest.approx(10 * (0.01 + 0.04 + 0.09))
    assert parts.position == pytest.approx(4 * parts.euler)
    assert parts.control == 0.0


def test_control_counts_each_change_of_the_command_once():
    trajectory = walk()
    force, moment = (w.copy() for w in trajectory.command)
    force[3:, 0, 2] += 3.0
    force[3:, 1, 0] -= 4.0
    moment[5:, 1, 1] += 2.0
    parts = parts_of(trajectory._replace(command=Wrench(force, moment)))
    assert parts.control == pytest.approx(9 + 16 + 4)


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
    for a, b in zip(parts_of(slow), parts_of(fast), strict=True):
        assert a == pytest.approx(b)
    assert switches_of(slow) == pytest.approx(switches_of(fast))
    for sample in (7, 15):
        a, b = parts_of(fallen_from(slow, sample)), parts_of(fallen_from(fast, 10 * sample))
        np.testing.assert_allclose(a, b)


def test_after_a_fall_each_sample_is_charged_a_fixed_error_at_least():
    trajectory = fallen_from(off_by(walk(), euler=0.1, position=0.1), 4)
    parts = parts_of(trajectory)
    assert parts.euler == pytest.approx(10 * (4 * 3 * 0.01 + 2 * 0.8**2))
    assert parts.position == pytest.approx(10 * (4 * 3 * 0.01 + 2 * 0.5**2))


def test_after_a_fall_a_larger_error_stays():
    parts = parts_of(fallen_from(off_by(walk(), euler=2.0, position=2.0), 4))
    assert parts.euler == parts.position == pytest.approx(10 * 6 * 3 * 4.0)


def test_what_a_fallen_robot_does_is_not_looked_at():
    trajectory = fallen_from(walk(), 3)
    nonsense = np.where(trajectory.fallen[:, None], np.nan, 0.0)
    wild = Wrench(*(w + nonsense[:, None] for w in trajectory.command))
    parts = parts_of(off_by(trajectory, nonsense, nonsense)._replace(command=wild))
    assert parts == parts_of(trajectory)
    assert parts.control == 0.0


def test_falling_earlier_costs_more():
    trajectory = off_by(walk(), 0.05, 0.05)
    costs = [float(total(LossConfig(), parts_of(fallen_from(trajectory, k)))) for k in range(7)]
    assert (np.diff(costs) < 0).all()


def test_yaw_errors_are_not_wrapped():
    whole_turn = np.array([0.0, 0.0, 2 * np.pi])
    parts = parts_of(off_by(walk(), euler=whole_turn))
    assert parts.euler == pytest.approx(10 * 6 * (2 * np.pi) ** 2)
    turned = walk()
    both = turned.state._replace(euler=np.tile(3 * whole_turn, (6, 1)))
    assert parts_of(turned._replace(state=both, reference=both)).euler == 0.0


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
    assert parts_of(trajectory).control == pytest.approx(60.0**2 + 25.0)


def test_the_total_is_weighted_by_the_alphas():
    parts = parts_of(off_by(walk(), 0.1, 0.2))._replace(control=jnp.array(7.0))
    expected = 3.0 * parts.euler + 5.0 * parts.position + 7.0
    assert total(LossConfig(euler=3.0, position=5.0), parts) == pytest.approx(expected)


@pytest.mark.parametrize("wrong", [{"euler": -1.0}, {"position": float("nan")}])
def test_negative_weights_are_refused(wrong):
    with pytest.raises(ValueError, match="must be a number of at least 0"):
        LossConfig(**wrong)
