"""The set `best`: the settings of its tuning, and the plants on whose walks it is tuned further.

The rigid-body model is inexact: a tuning can gain on the model and lose on the robot. So what
the tunings on the model have found is tuned on, with the walks of drawn plants.
"""

from dataclasses import replace

import numpy as np

from hector_jax.control.parameters import GROUPS, TUNABLES
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError, plural
from hector_jax.robot.model import Robot
from hector_jax.sim.world import Imperfections, hfs, hfs_with_motors, noisy
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import smoother
from hector_jax.walk_tuning.moved import walks_needed

DRAWS = 4  # variations of the model for each command of `best`
LIMIT, WIDTH, FEEDBACK = 0.19, 7 / 8, 2 / 3
"""Numbers of `best` beside its weights: limit of the position error as a share of the height of the
centre of mass, unless one is given; width and velocity feedback of the steps as shares of the
controller's. With them fewer walks fall under pushes and on slippery floors."""
PLANTS, SETS = 12, 4
"""Drawn plants on which `best` walks, and sets that walk there: the start and three steps."""
MANY_SETS, MOST_PLANTS = 8, 16  # of a larger budget of walks, unless plants are given
_FIRST_SEED = 7000  # of the plants on which `best` walks


def drawn_plants(robot: Robot, count: int, first_seed: int = _FIRST_SEED) -> list[Imperfections]:
    """Return plants drawn around the hfs, by default the first of a tuning on walks."""
    return [
        hfs_with_motors(seed, 0.4, robot.description)._replace(estimator=noisy())
        for seed in range(first_seed, first_seed + count)
    ]


def walk_plants(
    robot: Robot,
    count: int | None,
    walks: int | None,
    commands: int,
    *,
    along: int = 0,
    kept: int = 0,
) -> tuple[list[Imperfections], int]:
    """Return the plants of a tuning on walks, and its budget of walks.

    Args:
        robot: that walks.
        count: number of plants, 0 for the hfs itself; None: so that MANY_SETS sets can walk.
        walks: budget; None: that of `best`.
        commands: number of commands.
        along: number of directions whose slopes are by walks.
        kept: number of commands to keep.

    Raises:
        InputError: the budget is less than two walks in each case, and those for the slopes.
    """
    first, later = (x + kept for x in walks_needed(commands, along))  # on one plant
    if walks is None:
        count = PLANTS if count is None else count
        walks = SETS * max(count, 1) * commands
    elif count is None:
        count = int(np.clip(walks // (first + (MANY_SETS - 1) * later), 1, MOST_PLANTS))
    plants = drawn_plants(robot, count) or [hfs(robot.description)]
    if 0 < walks < (least := (first + commands + kept) * len(plants)):
        cases = plural(commands, "command") + f" and {kept} to keep" * (kept > 0)
        cases += f" on {plural(len(plants), 'plant')}, twice"
        cases += f", and with {plural(along, 'number')} moved" * (along > 0)
        raise InputError(f"--walks must be 0 or at least {least} ({cases}), got {walks}")
    return plants, walks


def on_walks(config: TuneConfig) -> TuneConfig:
    """Return settings for a tuning on walks: they are the robot's own, so it may go further."""
    return replace(config, ridge=config.ridge / 3.0, least_gain=config.least_gain / 5.0)


def settings_of_best(
    config: TuneConfig, robot: Robot, start: Weights, *, smooth: float, safe: float | None
) -> tuple[TuneConfig, Weights]:
    """Return settings and start of the tuning of `best` from those of `without` and `with`.

    It tunes the gains of the integral action too.

    Args:
        config, robot, start: of those tunings.
        smooth: price of changes of the command between switches of stance, see `loss.smoother`.
        safe: limit of the position error [m]; None: the controller's, else `LIMIT`.
    """
    walk = config.rollout.walk
    others = tuple(dict.fromkeys((*config.others, *GROUPS["integral"])))
    limit = safe or walk.mpc.position_limit or round(LIMIT * float(robot.standing_height), 3)
    numbers = {
        "position_limit": limit,
        "footstep_width": round(WIDTH * walk.footstep.width, 4),
        "footstep_feedback": round(FEEDBACK * walk.footstep.feedback, 4),
    }
    boxes = {name: (TUNABLES[name].lower, TUNABLES[name].upper) for name in numbers}
    clipped = {name: float(np.clip(numbers[name], *boxes[name])) for name in numbers}
    start = start._replace(others={**clipped, **start.others})
    return replace(config, loss=smoother(config.loss, smooth), others=others), start
