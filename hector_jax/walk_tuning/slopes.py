"""The slope of a walk: that of the rigid body grounded on it (tuning/grounded.py), or by walks."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import Tunable, gradient_by_weights
from hector_jax.control.reference import standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.grfm import network
from hector_jax.own.planner import call_planner, called_plans, plan_inputs
from hector_jax.own.walk_log import Log, trajectory_of
from hector_jax.tuning.curvature import least_squares_jit
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.grounded import fit_grounding, grounded_rollout
from hector_jax.tuning.rollout import Scenario
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.moved import Moved, columns_by_walks, numbers_by_walks, residuals_of


def slope_of_walk(
    campaign: Campaign,
    weights: Weights,
    case: int,
    log: Log,
    moved: Mapping[str, Moved] = {},
) -> tuple[Evaluation, Float[np.ndarray, "n n"]] | InputError:
    """Return loss, gradient and matrix of the plain rigid body grounded on a walk.

    By the numbers that were `moved` they are by walks, see `columns_by_walks`. If the planner of
    the user gives no plans of it this returns its error: others may go on.
    """
    if campaign.groups:
        return _slope_by_walks(campaign, weights, case, log, moved)
    config, robot = campaign.config, campaign.robot
    effect = network.effect_of(None, config.rollout.walk)
    scenario = Scenario(robot, campaign.cases[case][1], standing_anchor(robot), effect)
    walk, called = trajectory_of(log), None
    if campaign.planner is not None:
        controller = config.rollout.walk
        inputs = plan_inputs(controller, robot, weights, scenario.command, walk)
        try:
            plans = partial(call_planner, campaign.planner)
            numbers = [x for x in config.others if isinstance(x, Tunable) and not x.of_legs]
            called = called_plans(plans, controller, inputs, numbers)
        except InputError as error:
            return error
    grounding = fit_grounding(config.rollout, scenario, weights, walk, called=called)
    options: dict[str, Any] = {"walk": grounded_rollout, "others": config.others}
    if numbers_by_walks(config.others):
        options["columns"] = columns_by_walks(config, robot, scenario.command, log, moved)
    found = least_squares_jit(config.rollout, grounding, weights, config.loss, **options)
    return jax.device_get(found)


def _slope_by_walks(
    campaign: Campaign, weights: Weights, case: int, log: Log, moved: Mapping[str, Moved]
) -> tuple[Evaluation, Float[np.ndarray, "n n"]]:
    """Return loss, gradient and matrix of a walk, all of them by `columns_by_walks`."""
    inputs = campaign.config, campaign.robot, campaign.cases[case][1], log
    r = np.concatenate([x.ravel() for x in residuals_of(*inputs)])
    J, zero = columns_by_walks(*inputs, moved), np.zeros(())
    gradient = gradient_by_weights(weights, 2.0 * r @ J, campaign.config.others)
    found = Evaluation(r @ r, {}, gradient, fallen=zero, residual=zero)
    return jax.device_get((found, 2.0 * J.T @ J))
