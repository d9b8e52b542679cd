"""Integral action: what the errors say that the model lacks, and the walk with it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ANCHOR, ROBOT

from hector_jax import PAPER_LOSS, RolloutConfig, Scenario, State, named_command, nominal, rollout
from hector_jax.control.disturbance import NO_DISTURBANCE, IntegralGains, integrate_error
from hector_jax.control.parameters import GROUPS, TUNABLES
from hector_jax.grfm.effect import Window, ground_effect
from hector_jax.tuning.evaluate import evaluate_jit

GAINS = {"horizontal_gain": 10.0, "height_gain": 40.0, "tilt_gain": 100.0, "yaw_gain": 50.0}
INTEGRAL = IntegralGains(*GAINS.values())
integrate = jax.jit(integrate_error, static_argnums=4)
AT_REST = State(*np.zeros((4, 3)))


@jax.tree_util.Partial
def weak(window: Window):
    """The ground returns less than what was commanded, and a moment more."""
    wrench = jax.tree.map(lambda w: w[0], window.commands)
    stands = window.contact[:, None]
    moment = wrench.moment + stands * jnp.array([0.0, 0.5, 0.0])
    return ground_effect(wrench._replace(force=0.9 * wrench.force, moment=moment))


def test_a_robot_too_low_lacks_force_in_its_yaw_frame_and_a_push_counts_less_than_a_steady_error():
    heading = np.array([0.0, 0.0, np.pi / 2])  # it looks along y
    there = AT_REST._replace(euler=heading, position=np.array([0.0, -0.01, -0.02]))
    wanted = AT_REST._replace(euler=heading)
    found = integrate(INTEGRAL, NO_DISTURBANCE, there, wanted, 0.01)
    assert max(found.linear[0], found.linear[2]) < 0
    np.testing.assert_allclose(found.linear[1], 0.0, atol=1e-15)
    np.testing.assert_allclose(found.angular, 0.0, atol=1e-15)

    def counts(error):
        tilted = AT_REST._replace(euler=np.full(3, error))
        return integrate(INTEGRAL, NO_DISTURBANCE, tilted, AT_REST, 0.01).angular

    assert (0.0 < counts(0.3)).all()
    assert (counts(0.3) < counts(0.02)).all()


def test_steady_errors_go():
    """On ground that returns 90 % of the forces, and a moment that the model does not have."""
    walk, last = jax.jit(rollout, static_argnums=0), []
    scenario = Scenario(ROBOT, named_command("straight"), ANCHOR, weak)
    for gains in (dict.fromkeys(GAINS, 0.0), GAINS):
        walked = walk(RolloutConfig(), scenario, nominal()._replace(others=gains))
        assert not walked.fallen.any()
        off = jax.tree.map(lambda x, y: np.mean((x - y)[-80:], 0), walked.state, walked.reference)
        last.append((off.position[2], off.euler[1]))
    (low, pitch), (low_with, pitch_with) = last
    assert low < -0.01
    assert abs(low_with) < 0.2 * abs(low)
    assert abs(pitch) > 0.01
    assert abs(pitch_with) < 0.2 * abs(pitch)


def test_gradients_of_all_numbers_are_those_of_differences():
    config = RolloutConfig(ticks=50)
    names = GROUPS["all"]
    others = {"effort_reference": 0.3, **GAINS}
    start = config.walk.with_others(nominal()._replace(others=others), names)

    scenario = Scenario(ROBOT, named_command("s"), ANCHOR, weak)

    def evaluate(others):
        return evaluate_jit(config, scenario, start._replace(others=others), PAPER_LOSS)

    found = evaluate(start.others).gradient.others
    assert set(found) == set(names)
    for name in names:
        step = 1e-5 * (TUNABLES[name].upper - TUNABLES[name].lower)
        ends = [evaluate({**start.others, name: start.others[name] + s}) for s in (step, -step)]
        slope = (ends[0].loss - ends[1].loss) / (2 * step)
        assert float(found[name]) == pytest.approx(float(slope), rel=1e-4), name
