"""What the logs of a tuning foretell of the set that walks next, and whether that came true."""

from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from itertools import repeat
from pathlib import Path

import numpy as np

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.own.planner import call_planner
from hector_jax.verdict import foretell
from hector_jax.verdict.metrics import Interval
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.added_logs import AddedLogs
from hector_jax.walk_tuning.campaign import Campaign

_NEXT = "the next set"


def foretell_next(
    pool: Executor, campaign: Campaign, found: AddedLogs
) -> dict[str, Interval | str]:
    """Foretell the waiting set from the logs of the best one, with which it is compared.

    Args:
        pool: worker processes.
        campaign: whose walks are made elsewhere.
        found: the walks so far.

    Returns:
        By trajectory the log ratio of L to that of the best set, or why it is not foretold; empty
        if no set has walked, or the best one walks again.
    """
    tuning = found.tuning
    if not tuning.sets or tuning.waiting is None:
        return {}
    paths, best = walks.log_paths(campaign, tuning.best), tuning.sets[tuning.best].weights
    sets = repeat(best), repeat(tuning.waiting)
    told = pool.map(_foretell, repeat(campaign), *sets, campaign.commands.values(), paths)
    return dict(zip(campaign.commands, told, strict=True))


def _foretell(
    campaign: Campaign, walked: Weights, waiting: Weights, command: Command, path: Path
) -> Interval | str:
    config, robot, planner = campaign.config, campaign.robot, campaign.planner
    call = planner and partial(call_planner, planner)
    try:
        log, _ = foretell.read_logged(path, config, robot, command)
        found = foretell.foretell(
            config, robot, command, log, {_NEXT: waiting}, walked=walked, call=call
        )
        group = foretell.group_of(robot, [path], called=call is not None)
        if found.scores[_NEXT].fallen:
            return f"{_NEXT} falls in its foretold walk"
        return foretell.forecast(found, _NEXT, group)["L"]
    except InputError as error:
        return str(error)


def walked_next(
    before: AddedLogs, after: AddedLogs, names: Mapping[str, object]
) -> dict[str, float]:
    """Return the log ratios of L, by trajectory, that the set which waited has walked.

    Args:
        before, after: the walks without and with its logs.
        names: the trajectories; a fall is infinite, and where the best set fell nothing is told.
    """
    number, best = len(before.tuning.sets), before.tuning.best
    sets = after.tuning.sets
    if number >= len(sets):
        return {}
    each = zip(names, sets[number].losses, sets[best].losses, strict=True)
    return {name: float(np.log(x / base)) for name, x, base in each if np.isfinite(base)}
