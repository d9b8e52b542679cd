"""One step of the tuner from the walk just seen, and what of the weights matters in it.

The rigid body is grounded on the last seconds of the walk (`tuning.grounded`), in a process beside
the walk. Steps, acceptance and trust region are those of `difftune`; the state goes on from step to
step while the weights are those that it proposed.
"""

from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control import parameters
from hector_jax.control.reference import with_pieces
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.inputs import InputError
from hector_jax.grfm import network
from hector_jax.grfm.dataset import at_interval
from hector_jax.robot.model import Robot
from hector_jax.sim.live import WINDOW
from hector_jax.tuning import difftune
from hector_jax.tuning.curvature import determined, least_squares_jit
from hector_jax.tuning.difftune import TuneConfig, TuneState
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import Grounding, fit_grounding, grounded_rollout
from hector_jax.tuning.loss import PAPER_LOSS, loss_of_robot
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout_config
from hector_jax.view.live import Walked

_SHOWN = 3  # directions
_ERRORS = ("x", "y", "z", "roll", "pitch", "yaw")


class Found(NamedTuple):
    """What was computed, in Markdown, and for a step the weights of a set."""

    text: str
    set: int
    weights: Weights | None = None


def settings(robot: Robot) -> TuneConfig:
    """Return the settings of the tuner for a robot."""
    rollout = rollout_config(robot, WINDOW)
    return TuneConfig(rollout=rollout, loss=loss_of_robot(robot.description))


def grounded(config: TuneConfig, robot: Robot, walked: Walked) -> Grounding:
    """Ground the rigid body on a walk."""
    walk = at_interval(walked.walk, config.rollout.walk.gait.tick)
    effect = network.effect_of(None, config.rollout.walk)
    scenario = Scenario(robot, with_pieces(walked.command), walked.anchor, effect)
    fit = partial(fit_grounding, config.rollout, scenario, walked.weights, walk)
    return fit(np.int32(walked.start_tick), anchor=walked.anchor)


def grounded_slope(
    config: TuneConfig, grounding: Grounding, weights: Weights
) -> tuple[Evaluation, np.ndarray]:
    """Return loss, gradient and Gauss-Newton matrix of a walk."""
    found = least_squares_jit(
        config.rollout, grounding, weights, config.loss, walk=grounded_rollout
    )
    return jax.device_get(found)


def take_step(
    robot: Robot, state: TuneState | None, walked: Walked
) -> tuple[TuneState, Weights, str]:
    """Do one step of the tuner; return its state, the next weights, and what happened."""
    config = settings(robot)
    if state is None:
        state = difftune.init(config, walked.weights)
    weights = jax.tree.map(np.asarray, difftune.trial_weights(config, state))
    evaluation, matrix = grounded_slope(config, grounded(config, robot, walked), weights)
    fixed = replace(config, loss=PAPER_LOSS)
    state, iteration = difftune.update(fixed, state, evaluation, matrix)
    after = jax.device_get(difftune.trial_weights(config, state))
    changes = np.asarray(parameters.steps_between(weights, after))
    names = parameters.step_names(weights)
    largest = sorted(zip(names, changes, strict=True), key=lambda pair: -abs(pair[1]))[:6]
    moved = ", ".join(f"{name} x {np.exp(change):.2f}" for name, change in largest)
    loss = f"L of these {WINDOW:g} s: {float(evaluation.loss) / 1e6:.3f}e6."
    refused = iteration.reason
    lead = f"Refused ({refused}), so a shorter step: " if refused else "One step: "
    return jax.device_get(state), after, f"{loss} {lead}{moved}."


def errors_of(config: RolloutConfig, grounding: Grounding, weights: Weights) -> Any:
    """Return the RMS of position and Euler angles over a grounded rollout, (6,)."""
    walk = grounded_rollout(config, grounding, weights)
    pairs = (walk.state.position, walk.reference.position), (walk.state.euler, walk.reference.euler)
    away = jax.numpy.hstack([true - wanted for true, wanted in pairs])
    return jax.numpy.sqrt(jax.numpy.mean(away**2, axis=0))


_errors = jax.jit(errors_of, static_argnums=0)


def what_matters(robot: Robot, walked: Walked) -> str:
    """Say which directions of the weights matter most in a walk, and what they would change."""
    config = settings(robot)
    start = difftune.init(config, walked.weights).start
    grounding = grounded(config, robot, walked)
    evaluation, matrix = grounded_slope(config, grounding, jax.tree.map(np.asarray, start))
    precision = matrix / float(evaluation.loss) + config.ridge * np.eye(len(matrix))
    names = parameters.step_names(start)
    now, lines = np.asarray(_errors(config.rollout, grounding, start)), []
    for direction in determined(precision, config.ridge, names).directions[:_SHOWN]:
        steps = np.array([direction.steps[name] for name in names])
        steps *= np.log(2.0) * np.sign(steps[np.argmax(np.abs(steps))])
        there = np.asarray(
            _errors(config.rollout, grounding, parameters.weights_after(start, steps))
        )
        change = 100.0 * (there / now - 1.0)
        most = np.argsort(-np.abs(change))[:2]
        said = ", ".join(f"{_ERRORS[k]} {change[k]:+.0f} %" for k in most)
        lines.append(f"- {direction.text}, doubled: {said}")
    return "\n".join(["What the model of this walk foretells of its errors:", "", *lines])


class Tuner:
    """Steps and directions, computed in a process beside the page."""

    def __init__(self, pool: Executor, robot: Robot) -> None:
        """Compute by a process of the pool."""
        self._pool, self._robot = pool, robot
        self._states: dict[int, tuple[TuneState, Weights]] = {}
        self._running: tuple[Future[Any], str, int] | None = None

    def start(self, what: str, i: int, walked: Walked) -> None:
        """Begin to compute a step, or what matters, for set `i`, unless it is being computed."""
        if self._running is not None:
            return
        if what == "matter":
            job = self._pool.submit(what_matters, self._robot, walked)
        else:
            state, proposed = self._states.get(i, (None, None))
            if proposed is None or weights_tree(proposed) != weights_tree(walked.weights):
                state = None
            job = self._pool.submit(take_step, self._robot, state, walked)
        self._running = job, what, i

    def found(self) -> Found | None:
        """Return what was computed since, or None."""
        if self._running is None or not self._running[0].done():
            return None
        (job, what, i), self._running = self._running, None
        if isinstance(error := job.exception(), InputError):
            return Found(str(error), i)
        if what == "matter":
            return Found(job.result(), i)
        state, weights, text = job.result()
        self._states[i] = state, weights
        return Found(text, i, weights)
