"""Slopes by walks: of the numbers of a user's controller that its legs use, and of Q and R.

No plan has the former, and without a planner or a twin no model has the latter. So a set that is
accepted walks again on the same plants with one of them moved, or with a few weights by one factor
(`GROUPS`); the change of the residuals from walk to walk (`changed_by`), divided by the step, is a
column of the derivative that `curvature.least_squares` takes. In the first set all are moved. A
column changes little from set to set: later ones move one, by age and curvature of its column.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import Other, Tunable, step_names
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, nominal
from hector_jax.own.walk_file import reference_of
from hector_jax.own.walk_log import Log, trajectory_of
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import TuneConfig

STEP = 0.05  # of a number, see `parameters.stepped`; back in every second case
FACTOR_STEP = 0.2  # [e-folds] of a group of weights
SPAN = 1.0  # [s] of which the mean of a residual changes as it is: some gait cycles
GROUPS = (
    ("Q_roll", "Q_pitch"),
    ("Q_yaw",),
    ("Q_x", "Q_y"),
    ("Q_z",),
    ("Q_wx", "Q_wy", "Q_wz"),
    ("Q_vx", "Q_vy", "Q_vz"),
    ("R_Mx", "R_My", "R_Mz"),
)
"""Weights that are moved by one factor. Those of the forces are none: all Q and R by one factor
change no plan, so they are moved against all others."""


class Along(NamedTuple):
    """A direction of a slope by walks: coordinates that move by one step."""

    name: str
    at: tuple[int, ...]  # of `parameters.step_names`
    size: float  # of the step


def along_of(like: Weights, others: Sequence[Other], groups: bool) -> list[Along]:
    """Return the directions of a tuning whose slopes are by walks.

    Args:
        like: its weights.
        others: numbers that are tuned.
        groups: whether those of Q and R are among them.
    """
    names = step_names(like, others)
    members = [[name for name in group if name in names] for group in GROUPS if groups]
    found = [(group, FACTOR_STEP) for group in members if group]
    found += [([of.name], STEP) for of in numbers_by_walks(others)]
    return [Along("+".join(x), tuple(map(names.index, x)), size) for x, size in found]


class Moved(NamedTuple):
    """Walks of a case before and after a move."""

    at: tuple[int, ...]  # see `Along`
    step: float
    before: Log
    after: Log


def numbers_by_walks(others: Iterable[Other]) -> list[Tunable]:
    """Return the numbers of a tuning whose slopes are by walks."""
    return [x for x in others if isinstance(x, Tunable) and x.of_legs]


class MovedWalks:
    """The latest walks along each direction that stood."""

    def __init__(self, along: Sequence[Along]) -> None:
        self.along = along
        self.sets: dict[str, int] = {}  # that walked last, by direction
        self.walks: dict[tuple[str, int], Moved] = {}  # by direction and case
        self.matrix = np.zeros((0, 0))  # the latest one

    def due(self, at: int) -> Sequence[Along]:
        """Return the directions of a set: all, later the one of most age times curvature."""

        def urgency(of: Along) -> float:
            return (at - self.sets[of.name]) * float(self.matrix[np.ix_(of.at, of.at)].sum())

        return [max(self.along, key=urgency)] if self.along and self.sets else self.along

    def of_case(self, case: int) -> dict[str, Moved]:
        """Return the walks of a case by direction."""
        return {name: walk for (name, at), walk in self.walks.items() if at == case}


def walks_needed(cases: int, numbers: int) -> tuple[int, int]:
    """Return how many walks the first set, and a later one that is accepted, takes.

    Args:
        cases: commands times plants.
        numbers: how many directions have their slopes by walks.
    """
    return cases * (1 + numbers), cases * (1 + min(numbers, 1))


def residuals_of(
    config: TuneConfig, robot: Robot, command: Command, log: Log
) -> list[Float[np.ndarray, "T channels"]]:
    """Return the residuals of each term, of all ticks but the first as in `grounded_rollout`."""
    reference = reference_of(config.rollout.walk.gait.tick, robot, command, log)
    walk = trajectory_of(log)._replace(reference=reference)
    later = jax.tree.map(lambda x: jnp.asarray(x)[1:], walk._replace(period=None, initial=None))
    later = later._replace(period=jnp.asarray(walk.period), initial=walk.initial)
    terms = [np.sqrt(term.weight) * np.asarray(term.of(later)) for term in config.loss]
    return [x.reshape(len(x), -1) for x in terms]


def changed_by(
    now: Float[np.ndarray, "T channels"],
    before: Float[np.ndarray, "T channels"],
    after: Float[np.ndarray, "T channels"],
    span: int,
) -> Float[np.ndarray, "T channels"]:
    """Return by how much a move changes the residuals of a walk, from its changes in two walks.

    Within each span of samples their mean changes as it did, and what is left, the ripple of the
    steps, by its size alone: two walks with other steps are out of step after some of them, and the
    difference of their ripples would tell that and not which is larger.
    """
    changes = []
    for rows in np.array_split(np.arange(len(now)), max(len(now) // span, 1)):
        means = [x[rows].mean(axis=0) for x in (now, before, after)]
        ripple, *others = (x[rows] - m for x, m in zip((now, before, after), means, strict=True))
        size, moved = (np.linalg.norm(x, axis=0) for x in others)
        growth = np.where(size > 0.0, moved / np.where(size > 0.0, size, 1.0) - 1.0, 0.0)
        changes.append(means[2] - means[1] + growth * ripple)
    return np.concatenate(changes)


def columns_by_walks(
    config: TuneConfig,
    robot: Robot,
    command: Command,
    log: Log,
    moved: Mapping[str, Moved],
) -> Float[np.ndarray, "rows n"]:
    """Return the columns by the walks of a case, and zeros for all other coordinates.

    Args:
        config, robot, command: of the case.
        log: at which the derivative is wanted.
        moved: by name of the direction.
    """
    of_log = partial(residuals_of, config, robot, command)
    span, now = round(SPAN / float(log.period)), of_log(log)
    names = step_names(nominal(robot), config.others)
    J = np.zeros((sum(x.size for x in now), len(names)))
    for at, step, *logs in moved.values():
        if not step:  # a group that has no room in its boxes stays where it is
            continue
        terms = zip(now, *map(of_log, logs), strict=True)
        changes = [changed_by(here, before, after, span).ravel() for here, before, after in terms]
        J[:, at] = np.concatenate(changes)[:, None] / step / len(at)
    return J
