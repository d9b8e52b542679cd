"""The model that tests of tunings share: a rollout of 50 ticks, compiled once for all of them."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from synthetic import synthetic_walk

from hector_jax import RolloutConfig, TuneConfig, WalkConfig, load_robot
from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import expert, vector_to_weights, weights_to_vector
from hector_jax.grfm.dataset import at_interval, make_dataset
from hector_jax.grfm.network import as_effect, effect_of
from hector_jax.grfm.residual import init, with_statistics
from hector_jax.robot.description import TuningSettings
from hector_jax.tuning.evaluate import mean_objective

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
ROBOT, QUADRUPED = load_robot(), load_robot(EXAMPLES / "quadruped" / "robot.toml")
WEIGHT, HEIGHT = float(ROBOT.mass * ROBOT.gravity[2]), float(ROBOT.standing_height)


def robot_with(**settings):
    """HECTOR with settings of its tunings, see `TuningSettings`."""
    description = replace(ROBOT.description, tuning=TuningSettings(**settings))
    return ROBOT._replace(description=description)


LEARNS_TOUCHDOWNS = robot_with(touchdown_error=True)
ANCHOR = standing_anchor(ROBOT)
SHORT = RolloutConfig(ticks=50)
CONFIG = TuneConfig(rollout=SHORT)
# of the set `best`
BEST_OTHERS = {"position_limit": 0.08, "footstep_width": 0.07, "footstep_feedback": 0.08}
# the numbers beside Q and R of tests that have some: in MJX other names are another program
OTHERS = ("footstep_width", "foot_height", "kp", "kd")
PLAIN = effect_of(None, WalkConfig())
BRIEF = RolloutConfig(ticks=5)  # where a few ticks are enough, with one command
AHEAD = Command(np.array([0.05]), np.array([[0.3, 0.0]]), np.zeros(1))


def small_net(seed=0):
    """An untrained net that adds a newton or so to what was commanded."""
    walks = [at_interval(synthetic_walk(i, 60), 0.01) for i in range(2)]
    data = make_dataset(ROBOT, jax.tree.map(lambda *x: np.stack(x), *walks))[0]
    made = with_statistics(init(jax.random.key(seed)), data)
    quiet = jax.tree.map(jnp.zeros_like, made.linear)
    linear = quiet._replace(ticks=made.linear.ticks, gates=made.linear.gates)
    return made._replace(linear=linear, residual_rms=jnp.ones_like(made.residual_rms))


def small_effect(seed=0):
    return as_effect(small_net(seed))


def vector(weights):
    """The 24 numbers of weights."""
    return np.asarray(weights_to_vector(weights))


def random_weights(seed, about=expert, factor=3.0):
    """Twenty-four different numbers, left and right too, within a factor of a named set."""
    draws = np.random.default_rng(seed).uniform(-1, 1, 24)
    return vector_to_weights(weights_to_vector(about()) * factor**draws)


def mean_of(objectives, losses=None):
    return mean_objective(lambda weights: [one.slope(weights) for one in objectives], losses)
