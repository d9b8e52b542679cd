"""Rollouts grounded on measured walks."""

import jax
import numpy as np
import pytest

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.grounded import evaluate_grounded, fit_grounding, grounded_rollout
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.tuning.measured import evaluate_walk
from hector_jax.tuning.rollout import RolloutConfig, rollout

CONFIG = RolloutConfig(ticks=6)
WALKED = named_command("s"), last_command


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def measured(robot):
    """A walk that the model does not explain: joints of a stance, and a drift and a shake."""
    anchor = standing_anchor(robot)
    roll_out = jax.jit(rollout, static_argnums=0)
    command, effect = WALKED
    walk = jax.device_get(roll_out(CONFIG, robot, nominal(), command, anchor, effect))
    shake = 1e-3 * np.random.default_rng(0).standard_normal((6, 3))
    state = jax.tree.map(lambda x: x + shake, walk.state)
    return walk._replace(state=state, joints=np.broadcast_to(robot.standing_joints, (6, 10)))


def test_with_the_weights_that_were_walked_a_grounded_rollout_is_the_walk(robot, measured):
    missed = fit_grounding(CONFIG, robot, nominal(), *WALKED, measured)
    again = jax.jit(grounded_rollout, static_argnums=0)(CONFIG, robot, nominal(), *WALKED, missed)
    for found, there in zip(again.state, measured.state, strict=True):
        np.testing.assert_allclose(found, there[1:], atol=1e-12)
    assert not again.fallen.any()


def test_its_gradient_is_that_along_the_walk_by_forward_recursion(robot, measured):
    missed = fit_grounding(CONFIG, robot, nominal(), *WALKED, measured)
    # that one prices the change from the command before its first tick too
    tracking = tuple(t._replace(weight=t.weight * (t.name != "L_ctrl")) for t in PAPER_LOSS)
    found = evaluate_grounded(CONFIG, robot, nominal(), *WALKED, missed, tracking)
    config = TuneConfig(rollout=CONFIG, loss=tracking)
    along = evaluate_walk(config, robot, nominal(), *WALKED, measured)
    gradients = [weights_to_vector(one.gradient) for one in (found, along)]
    np.testing.assert_allclose(*gradients, rtol=1e-7, atol=1e-7 * np.abs(gradients[1]).max())


def test_a_walk_of_another_length_is_refused(robot, measured):
    with pytest.raises(ValueError, match="a walk of 5 ticks has 6 samples"):
        fit_grounding(RolloutConfig(ticks=5), robot, nominal(), *WALKED, measured)
