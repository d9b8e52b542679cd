"""Slopes by walks, of the numbers of a user's controller that its legs use.

No plan has them. So a set that is accepted walks again on the same plants with one of them moved;
the difference of the residuals of the two walks, divided by the step, is a column of the
derivative that `curvature.least_squares` takes. In the first set all are moved. A column changes
little from set to set: later ones move the number whose walks are the oldest.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import Other, Tunable, step_names
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.own.walk_file import reference_of
from hector_jax.own.walk_log import Log, trajectory_of
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import residuals

STEP = 0.1  # of a number, see `parameters.stepped`


class Moved(NamedTuple):
    """Walks of a set before and after one number was moved, by case."""

    step: float
    before: Mapping[int, Log]
    after: Mapping[int, Log]


def numbers_by_walks(others: Iterable[Other]) -> list[Tunable]:
    """Return the numbers of a tuning whose slopes are by walks."""
    return [x for x in others if isinstance(x, Tunable) and x.of_legs]


def walks_needed(cases: int, numbers: int) -> tuple[int, int]:
    """Return how many walks the first set, and a later one that is accepted, takes.

    Args:
        cases: commands times plants.
        numbers: how many have their slopes by walks.
    """
    return cases * (1 + numbers), cases * (1 + min(numbers, 1))


def residual_rows(
    config: TuneConfig, robot: Robot, command: Command, log: Log
) -> Float[np.ndarray, " rows"]:
    """Return the residuals of a log, of all ticks but the first as in `grounded_rollout`."""
    reference = reference_of(config.rollout.walk.gait.tick, robot, command, log)
    walk = trajectory_of(log)._replace(reference=reference)
    later = jax.tree.map(lambda x: jnp.asarray(x)[1:], walk._replace(period=None, initial=None))
    later = later._replace(period=jnp.asarray(walk.period), initial=walk.initial)
    return np.asarray(residuals(config.loss, later))


def columns(
    config: TuneConfig,
    robot: Robot,
    command: Command,
    weights: Weights,
    moved: Mapping[str, tuple[float, Log, Log]],
) -> Float[np.ndarray, "rows n"] | float:
    """Return the columns of numbers by their walks in a case, and zeros for all other coordinates.

    Args:
        config, robot, command, weights: of the case.
        moved: step, log before and log after it, by name of the number.
    """
    names, found = step_names(weights, config.others), []
    for step, *logs in moved.values():
        before, after = (residual_rows(config, robot, command, log) for log in logs)
        found.append((after - before) / step)
    if not found:
        return 0.0
    J = np.zeros((len(found[0]), len(names)))
    J[:, [names.index(name) for name in moved]] = np.stack(found, axis=1)
    return J
