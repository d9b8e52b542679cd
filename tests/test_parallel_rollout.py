"""A rollout of all ticks at once is that of one tick after the other."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lib import sample_weights
from model import ROBOT, small_effect

from hector_jax import RolloutConfig, Scenario, State, named_command, rollout, standing_anchor
from hector_jax.control.weights import nominal, vector_to_weights, weights_to_vector
from hector_jax.tuning.parallel_rollout import parallel_rollout
from hector_jax.tuning.variation import no_variation

EFFECT = small_effect()
SHORT = RolloutConfig(ticks=24)  # in which one falls
FIELDS = "initial", "state", "reference", "command", "effect", "feet"


@partial(jax.jit, static_argnums=(0, 1))
def walked(walk, config, robot, effect, weights, variation=None):
    """A trajectory, and the gradient of a sum that all its numbers are in."""
    anchor = standing_anchor(robot)
    scenario = Scenario(robot, named_command("s"), anchor, effect, variation)

    def mixed(weights):
        found = walk(config, scenario, weights)
        leaves = jax.tree.leaves([getattr(found, name) for name in FIELDS])
        rng = np.random.default_rng(0)
        return sum(jnp.sum(rng.normal(size=x.shape) * x) for x in leaves), found

    gradient, found = jax.grad(mixed, has_aux=True)(weights)
    return found, weights_to_vector(gradient)


def assert_same(config, robot, effect, weights, variation=None):
    (expected, gradient), (found, at_once) = (
        walked(walk, config, robot, effect, weights, variation)
        for walk in (rollout, parallel_rollout)
    )
    assert found.residual.max() < 1e-8
    same = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)
    jax.tree.map(same, found._replace(residual=0), expected._replace(residual=0))
    np.testing.assert_allclose(at_once, gradient, rtol=1e-6, atol=1e-7 * np.abs(gradient).max())


@pytest.mark.parametrize("weights", [nominal(), sample_weights(nominal(), 3.0, 1)[0]])
def test_at_once_is_one_after_the_other(weights):
    assert_same(SHORT, ROBOT, EFFECT, weights)


@pytest.mark.slow
def test_at_once_with_lead_noise_and_delay():
    noise = State(*(np.full(3, 2e-3) for _ in range(4)))
    other = no_variation()._replace(noise=noise, delay=np.asarray(0.005), mass=np.asarray(1.05))
    assert_same(RolloutConfig(ticks=30, lead=20), ROBOT, EFFECT, nominal(), other)


def test_a_fall_is_seen_at_the_same_tick():
    # effort so dear that the robot sinks
    weak = vector_to_weights(weights_to_vector(nominal()).at[12:].set(1.0))
    walks = rollout, parallel_rollout
    expected, found = (walked(walk, SHORT, ROBOT, EFFECT, weak)[0] for walk in walks)
    assert 0 < expected.fallen.sum() < SHORT.ticks
    np.testing.assert_array_equal(found.fallen, expected.fallen)
    assert found.residual.max() < 1e-8
    standing = ~np.asarray(expected.fallen)
    places = (each.state.position[standing] for each in (found, expected))
    np.testing.assert_allclose(*places, atol=1e-9)
