"""The set `best`: the settings of its tuning, and its choice on plants that no evaluation uses.

The rigid-body model is inexact: a tuning can gain on the model and lose on the robot, and a tuning
on the walks of a few plants fits them better and better, at the expense of others. So for a robot
with `choice_plants` in its file, points of the path of a tuning, its start among them, walk on so
many drawn plants with a noisy state estimate, and the one that walks best is taken; for others, as
HECTOR, it is the last accepted one.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from hector_jax.control.parameters import GROUPS, TUNABLES
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.console import say
from hector_jax.core.inputs import InputError, plural
from hector_jax.robot.model import Robot
from hector_jax.sim.world import Imperfections, hfs, hfs_with_motors, noisy
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig, Tuning
from hector_jax.tuning.loss import smoother
from hector_jax.verdict import judging

DRAWS = 4  # variations of the model for each command of `best`
LIMIT, WIDTH, FEEDBACK = 0.19, 7 / 8, 2 / 3
"""Numbers of `best` beside its weights: limit of the position error as a share of the height of the
centre of mass, unless one is given; width and velocity feedback of the steps as shares of the
controller's. With them fewer walks fall under pushes and on slippery floors."""
SHARES = (0.0, 0.25, 0.5, 1.0)  # of the accepted iterations: the points of a path that walk
_FIRST_SEED = 7000  # of plants that a tuning may walk on; those of a path have the seeds before
SETS, MOST_PLANTS = 8, 16  # that a budget of walks is spent on, unless plants are given
HELD_OUT = range(8000, 8008)
"""Seeds of the plants that compare the sets of a tuning on walks: those of a path have chosen the
start of these walks already, and there it is lucky."""


def drawn_plants(robot: Robot, count: int, first_seed: int = _FIRST_SEED) -> list[Imperfections]:
    """Return plants drawn around the hfs, by default the first of a tuning on walks."""
    return [
        hfs_with_motors(seed, 0.4, robot.description)._replace(estimator=noisy())
        for seed in range(first_seed, first_seed + count)
    ]


def walk_plants(robot: Robot, count: int | None, walks: int, commands: int) -> list[Imperfections]:
    """Return the plants of a tuning on walks.

    Args:
        robot: that walks.
        count: their number, 0 for the hfs itself; None: as many as leave SETS sets to walk.
        walks: budget.
        commands: number of commands.

    Raises:
        InputError: the budget is less than two walks in each case.
    """
    if count is None:
        count = int(np.clip(walks // (SETS * commands), 1, MOST_PLANTS))
    plants = drawn_plants(robot, count) or [hfs(robot.description)]
    if walks < (least := 2 * len(plants) * commands):
        cases = f"{plural(commands, 'trajectory')} on {plural(len(plants), 'plant')}"
        raise InputError(f"--walks must be at least {least}, two sets for {cases}, got {walks}")
    return plants


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
    others = tuple(dict.fromkeys((*config.others, *GROUPS["integral"])))
    walk = config.rollout.walk
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


def points_of(tuning: Tuning) -> dict[str, Weights]:
    """Return the points of the path of a tuning that walk, the start first."""
    path = [iteration for iteration in tuning.iterations if iteration.accepted]
    indices = sorted({round(share * (len(path) - 1)) for share in SHARES})
    return {f"iteration {int(path[i].iteration)}": path[i].weights for i in indices}


def walks_best(
    setup: Setup,
    sets: dict[str, Weights],
    commands: Sequence[Command],
    plants: int | range,
    **notes: Any,
) -> str:
    """Return the name of the set that walks best on drawn plants; the last one without plants.

    That is the least mean of log L over commands and plants.

    Args:
        setup: workers, controller and loss, nominal body.
        sets: sets by name in the order in which they were made, the start first.
        commands: commands to walk, which count alike.
        plants: number of plants, which get the seeds of a path, or the seeds themselves.
        notes: of `judging.judge`: `seconds`, `folder` of the scores, which are not walked again,
            `engine`.
    """
    first, last = next(iter(sets)), next(reversed(sets))
    seeds = range(_FIRST_SEED - plants, _FIRST_SEED) if isinstance(plants, int) else plants
    if not seeds or first == last:
        return last
    drawn = drawn_plants(setup.robot, len(seeds), seeds[0])
    on_plants = f"on {plural(len(seeds), 'plant')} drawn around the hfs"
    judge = partial(judging.judge, setup, sets, title=f"choosing `best` {on_plants}", **notes)
    results = [judge(command, drawn, range(len(seeds))).scores for command in commands]
    logs = {
        name: np.mean([np.log(score.L) for scores in results for score in scores[name]])
        for name in sets
    }
    best = min(logs, key=logs.__getitem__)
    change = [100.0 * np.expm1(logs[name] - logs[first]) for name in (best, last)]
    say(
        f"best: {best} of {first} to {last} walks best {on_plants}: L {change[0]:+.0f} % against "
        f"{first}, the last {change[1]:+.0f} %"
    )
    return best
