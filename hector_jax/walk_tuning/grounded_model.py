"""The model that proposes the next walk: the rigid body grounded on walks (tuning/grounded.py)."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from itertools import repeat
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.grfm import network
from hector_jax.search.few_walks import Model, Space
from hector_jax.store import tunings
from hector_jax.tuning.difftune import step_status
from hector_jax.tuning.grounded import Grounding, fit_grounding, grounded_rollout
from hector_jax.tuning.rollout import Scenario
from hector_jax.tuning.status import StepStatus
from hector_jax.walk_tuning.campaign import Campaign, matrix_of, slope_of, weights_at
from hector_jax.walk_tuning.walk_log import Log, trajectory_of


def model_of(
    pool: Executor,
    campaign: Campaign,
    space: Space,
    walked: Sequence[tuple[Float[np.ndarray, " n"], Sequence[Log]]],
    ratios: Float[np.ndarray, " cases"],
) -> Model:
    """Return the mean loss of the rigid body grounded on walks, relative to the start.

    With the model "every_walk" each walk counts twice: as it was, and with the noise of the next
    one (`replayed`).

    Args:
        pool: worker processes.
        campaign: settings.
        space: coordinates of the points.
        walked: point of each weight set, and the logs of its walks, one for each case.
        ratios: losses of the first of them relative to those at the start; the model's are scaled
            to these.
    """
    groundings: list[Grounding] = []
    commands = [command for _, command in campaign.cases]
    for point, logs in walked:
        weights = weights_at(campaign, space, point)
        groundings += pool.map(_ground_job, repeat(campaign), repeat(weights), commands, logs)
    every_walk = campaign.model == "every_walk"
    if every_walk:
        cycle = campaign.config.rollout.walk.gait.cycle
        groundings += [
            grounding._replace(residuals=replayed(grounding.residuals, other.residuals, cycle))
            for grounding, other in zip(groundings, [*groundings[1:], groundings[0]], strict=True)
        ]

    def of_all(job: Callable[..., Any], weights: Weights) -> list[Any]:
        running = [
            pool.submit(job, campaign.config, grounding, weights, grounded_rollout)
            for grounding in groundings
        ]
        return [job.result() for job in running]

    first = walked[0][0]
    at_first = of_all(tunings.evaluation_job, weights_at(campaign, space, first))
    losses = np.array([case.loss for case in at_first])
    scales = np.resize(ratios, len(losses)) / losses / len(losses)

    def evaluate(point: Float[np.ndarray, " n"]) -> tuple[float, Float[np.ndarray, " n"]]:
        weights = weights_at(campaign, space, point)
        known = np.array_equal(point, first)
        cases = at_first if known else of_all(tunings.evaluation_job, weights)
        if any(step_status(campaign.config, case) != StepStatus.ACCEPTED for case in cases):
            return np.inf, np.zeros_like(point)
        slopes = [slope_of(campaign, space, weights, case.gradient) for case in cases]
        return float(scales @ [float(case.loss) for case in cases]), scales @ np.array(slopes)

    def matrix(point: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n n"]:
        matrices = of_all(tunings.matrix_job, weights_at(campaign, space, point))
        return matrix_of(campaign, space, np.tensordot(scales, matrices, axes=1))

    return Model(evaluate, matrix, every_walk)


def _ground_job(campaign: Campaign, weights: Weights, command: Command, log: Log) -> Grounding:
    """Ground the plain rigid body on a walk, unless the campaign has no use for residuals."""
    config, robot = campaign.config.rollout, campaign.robot
    effect = network.effect_of(None, config.walk)
    trajectory = trajectory_of(log)
    scenario = Scenario(robot, command, standing_anchor(robot), effect)
    grounding = fit_grounding(config, scenario, weights, trajectory)
    if campaign.model == "plain":
        grounding = grounding._replace(residuals=jax.tree.map(jnp.zeros_like, grounding.residuals))
    return jax.device_get(grounding)


def replayed(residuals: Any, others: Any, cycle: int) -> Any:
    """Return the residuals of a walk with the noise of another, half a walk later.

    The mean at each phase of the gait cycle stays. The noise is what deviates from it: weights that
    fit that of one walk gain nothing in a replay with another.

    Args:
        residuals, others: trees of the same shapes (T, ...).
        cycle: ticks of the gait cycle.
    """
    ticks = len(jax.tree.leaves(residuals)[0])
    phase, late = np.arange(ticks) % cycle, cycle * (ticks // (2 * cycle))

    def mean(x: Any) -> Any:
        """Return the mean at the phase of each tick."""
        return np.stack([x[phase == i].mean(axis=0) for i in range(min(cycle, ticks))])[phase]

    def replay(own: Any, other: Any) -> Any:
        return mean(own) + np.roll(other - mean(other), late, axis=0)

    return jax.tree.map(replay, residuals, others)
