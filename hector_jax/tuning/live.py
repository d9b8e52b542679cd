"""One step of the tuner from the walk just seen, and what of the weights matters in it.

The rigid body is grounded on the last seconds of the walk (`grounded`). Steps, acceptance and trust
region are those of `difftune`; the state goes on from step to step while the weights are those that
it proposed.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control import parameters
from hector_jax.control.reference import with_pieces
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.arrays import Array
from hector_jax.grfm import network
from hector_jax.grfm.dataset import at_interval
from hector_jax.robot.model import Robot
from hector_jax.sim.live import WINDOW, Walked
from hector_jax.tuning import difftune
from hector_jax.tuning.curvature import determined, least_squares_jit
from hector_jax.tuning.difftune import TuneConfig, TuneState
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import Grounding, fit_grounding, grounded_rollout
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout_config

_SHOWN = 3  # directions
_ERRORS = ("x", "y", "z", "roll", "pitch", "yaw")

Found = tuple[TuneState, Weights | None, str]
"""State of the tuner, for a step the next weights, and what was found, in Markdown."""
Work = Callable[[Robot, TuneState | None, Walked], Found]


def take_step(robot: Robot, state: TuneState | None, walked: Walked) -> Found:
    """Do one step of the tuner, from its state after the step before."""
    config, state, _, (evaluation, matrix) = _slope(robot, state, walked)
    weights = difftune.trial_weights(config, state)
    state, iteration = difftune.update(config, state, evaluation, matrix)
    after = jax.device_get(difftune.trial_weights(config, state))
    changes = np.asarray(parameters.steps_between(weights, after))
    pairs = zip(parameters.step_names(after), changes, strict=True)
    largest = sorted(pairs, key=lambda pair: -abs(pair[1]))[:6]
    moved = ", ".join(f"{name} x {np.exp(change):.2f}" for name, change in largest)
    loss = f"L of these {WINDOW:g} s: {float(evaluation.loss) / 1e6:.3f}e6."
    refused = iteration.reason
    lead = f"Refused ({refused}), so a shorter step: " if refused else "One step: "
    return jax.device_get(state), after, f"{loss} {lead}{moved}."


def what_matters(robot: Robot, state: TuneState | None, walked: Walked) -> Found:
    """Say which directions of the weights matter most in a walk, and what they would change."""
    config, state, grounding, (evaluation, matrix) = _slope(robot, state, walked)
    weights = difftune.trial_weights(config, state)
    precision = matrix / float(evaluation.loss) + config.ridge * np.eye(len(matrix))
    names = parameters.step_names(weights)
    now, lines = np.asarray(_rms(config.rollout, grounding, weights)), []
    for direction in determined(precision, config.ridge, names).directions[:_SHOWN]:
        steps = np.array([direction.steps[name] for name in names])
        steps *= np.log(2.0) * np.sign(steps[np.argmax(np.abs(steps))])
        doubled = parameters.weights_after(weights, steps)
        change = 100.0 * (np.asarray(_rms(config.rollout, grounding, doubled)) / now - 1.0)
        most = np.argsort(-np.abs(change))[:2]
        said = ", ".join(f"{_ERRORS[k]} {change[k]:+.0f} %" for k in most)
        lines.append(f"- {direction.text}, doubled: {said}")
    text = "\n".join(["What the model of this walk foretells of its errors:", "", *lines])
    return jax.device_get(state), None, text


def _slope(
    robot: Robot, state: TuneState | None, walked: Walked
) -> tuple[TuneConfig, TuneState, Grounding, tuple[Evaluation, Float[np.ndarray, "n n"]]]:
    """Return the tuner at the weights of a walk, the grounded body, and its slope there."""
    loss = loss_of_robot(robot.description)
    config = TuneConfig(rollout=rollout_config(robot, WINDOW), loss=loss)
    proposed = None if state is None else weights_tree(difftune.trial_weights(config, state))
    if state is None or proposed != weights_tree(walked.weights):
        state = difftune.init(config, walked.weights)
    walk = at_interval(walked.walk, config.rollout.walk.gait.tick)
    effect = network.effect_of(None, config.rollout.walk)
    scenario = Scenario(robot, with_pieces(walked.command), walked.anchor, effect)
    fit = partial(fit_grounding, config.rollout, scenario, walked.weights, walk)
    grounding = fit(np.int32(walked.start_tick), anchor=walked.anchor)
    weights = difftune.trial_weights(config, state)
    slope = least_squares_jit(
        config.rollout, grounding, weights, config.loss, walk=grounded_rollout
    )
    return config, state, grounding, jax.device_get(slope)


@partial(jax.jit, static_argnums=0)
def _rms(config: RolloutConfig, grounding: Grounding, weights: Weights) -> Float[Array, "6"]:
    """Return the RMS errors of position [m] and Euler angles [rad] in a grounded rollout."""
    walk = grounded_rollout(config, grounding, weights)
    state, reference = (jnp.hstack([x.position, x.euler]) for x in (walk.state, walk.reference))
    return jnp.sqrt(jnp.mean((state - reference) ** 2, axis=0))
