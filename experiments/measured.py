"""DiffTune along measured walks, of a better simulator or of the robot (Eq. 9, 10).

The tracking errors in the loss are measured, and dynamics, phi and controller are differentiated at
the measured states: the model gives only the derivative of a state by the weights, not the state.
The changes of the command in the loss are those of commands planned anew from the true states and
joints; the commands of the walk were planned from an estimate, so the two differ on a plant with
backlash or with errors of the estimator. Tuning on rollouts of the model is limited by the model's
error; this method continues from there and costs a walk for every step.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from adaptation import follow, init_trace
from jaxtyping import Float

from hector_jax.control.reference import Command, anchor_at
from hector_jax.control.weights import Weights
from hector_jax.core.trajectory import Trajectory, Wrench
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import Iteration, TuneConfig, Tuning, descend
from hector_jax.tuning.evaluate import Evaluation, mean_objective
from hector_jax.tuning.grounded import measured_states

_measured_states = jax.jit(measured_states)


def evaluate_walk(
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    walk: Trajectory,
    start_tick: int = 0,
) -> tuple[Evaluation, Float[Any, "n n"]]:
    """Compute the loss of a measured walk, its gradient and matrix through the model along it.

    The first tick is left out: the reference is anchored in it.

    Args:
        config: controller and loss.
        robot: nominal body.
        weights, command: of the walk.
        effect: phi; its Jacobian is used.
        walk: of `config.rollout.ticks` ticks, sampled at the plan interval or finer.
        start_tick: gait tick of t = 0.

    Raises:
        ValueError: the walk's samples do not fill the ticks.
    """
    ticks, samples = config.rollout.ticks, len(walk.fallen)
    if samples % ticks:
        raise ValueError(
            f"a measured walk must have a whole number of samples in each of its {ticks} ticks, "
            f"got {samples} samples"
        )
    ends = slice(samples // ticks - 1, None, samples // ticks)
    states = _measured_states(robot, jax.tree.map(lambda x: x[ends], walk.state), walk.joints[ends])
    first = Wrench(*(w[0] for w in walk.command))
    anchor = anchor_at(robot, walk.initial, start_tick)
    trace = init_trace(anchor, jax.tree.map(lambda x: x[0], states), first, weights)
    stacked = jax.tree.map(lambda w: np.broadcast_to(w, (ticks - 1, *np.shape(w))), weights)
    tick = np.asarray(start_tick + 1, np.int32)
    window = trace, stacked, tick, states
    _, evaluation, matrix = follow(config, robot, command, anchor, effect, *window)
    fallen = jnp.maximum(evaluation.fallen, jnp.mean(1.0 * jnp.asarray(walk.fallen)))
    residual = jnp.maximum(evaluation.residual, jnp.max(jnp.asarray(walk.residual)))
    evaluation = evaluation._replace(fallen=fallen, residual=residual)
    return jax.tree.map(np.asarray, (evaluation, matrix))


def tune_measured(
    config: TuneConfig,
    weights: Weights,
    evaluate: Callable[[Weights], Sequence[tuple[Evaluation, Float[Any, "n n"]]]],
    on_iteration: Callable[[Iteration], None] = lambda iteration: None,
) -> Tuning:
    """Tune on measured walks, from weights that have been tuned on the model.

    Args:
        config: the settings.
        weights: the start.
        evaluate: walks with the weights on each plant and differentiates, see `evaluate_walk`.
        on_iteration: called after each iteration.

    Raises:
        InputError: a walk with the starting weights falls or is not solved.
    """
    matrices = []  # of the walks evaluated last, which `descend` asks for: a walk is dear

    def evaluations(weights: Weights) -> list[Evaluation]:
        found, matrices[:] = zip(*evaluate(weights), strict=True)
        return list(found)

    objective = mean_objective(evaluations, lambda weights: matrices)
    return descend(config, weights, objective, on_iteration)
