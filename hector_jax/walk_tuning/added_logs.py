"""Walks that were made elsewhere, on a robot or in another simulator, and whose logs are added.

They are data: the files that were added are kept as they came, and each call scores them anew,
so that all are of one code and one loss. When the tuning has ended the best set is walked again:
what is said of it then does not rest on the walk that chose it.
"""

import hashlib
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import tree_hash
from hector_jax.own.walk_log import ScoredLog, evaluate_log, read_log
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.walks import WalkTuning

_MOST = 10_000  # iterations: a person ends the tuning
_CLEAR = 2.0  # standard deviations of a change that is no chance


class Again(NamedTuple):
    """What the walks of the best set tell that did not choose it."""

    # [%] mean change of log L against the start, over the cases in which all stood; None: no case
    change: float | None
    clear: bool  # against the spread of its walks


class AddedLogs(NamedTuple):
    """The walks of a folder."""

    tuning: WalkTuning
    waiting: Weights  # the set to walk next
    number: int  # of that set
    again: Again | None  # None: the best set has not walked again


def read_campaign(pool: Executor, campaign: Campaign) -> AddedLogs:
    """Return the walks so far, scored by the present code; begin the record if it is new.

    Raises:
        InputError: see `walks.tune_on_walks`; the weights or a log of a walk are damaged; or the
            start fell.
    """
    campaign = replace(campaign, config=replace(campaign.config, iterations=_MOST))
    ask = partial(_scored, pool, campaign)
    tuning = walks.tune_on_walks(pool, campaign, ask)
    number = len(tuning.sets)
    if number and not tuning.sets[0].accepted:
        raise InputError(f"{campaign.folder}: {tuning.reason}; tune from another")
    if tuning.waiting is not None:
        return AddedLogs(tuning, tuning.waiting, number, None)
    best, again = tuning.sets[tuning.best].weights, []
    while all(path.exists() for path in walks.log_paths(campaign, number)):
        walked = load_weights(walks.weights_path(campaign.folder, number), campaign.robot)
        if tree_hash(walked) == tree_hash(best):  # else a step of a tuning by another loss
            again.append(np.array([log.loss for log in ask(number, best)]))
        number += 1
    save_weights(walks.weights_path(campaign.folder, number), best)
    return AddedLogs(tuning, best, number, _again(tuning, again) if again else None)


def _again(tuning: WalkTuning, again: Sequence[np.ndarray]) -> Again:
    chosen = [tuning.sets[0].losses, tuning.sets[tuning.best].losses]
    stood = np.isfinite([*chosen, *again]).all(axis=0)
    if not stood.any():
        return Again(None, False)
    start, best, *logs = np.log([*chosen, *again])[:, stood].mean(axis=1)
    spread = np.std([best, *logs], ddof=1) * np.sqrt(1.0 + 1.0 / len(logs))
    change = np.mean(logs) - start
    return Again(100.0 * float(np.expm1(change)), bool(abs(change) > _CLEAR * spread))


def _scored(
    pool: Executor, campaign: Campaign, number: int, weights: Weights
) -> Sequence[ScoredLog]:
    """Return the scored logs of a set that has them; `Waiting` if it has none."""
    paths = walks.log_paths(campaign, number)
    if not all(path.exists() for path in paths):
        raise walks.Waiting
    config, robot, running = campaign.config, campaign.robot, []
    for path, (_, command) in zip(paths, campaign.cases, strict=True):
        log = read_log(path, robot, campaign.seconds, config.rollout.walk.gait.tick)
        running.append(pool.submit(evaluate_log, config, robot, command, log))
    return [job.result() for job in running]


def add_logs(campaign: Campaign, number: int, files: Sequence[Path]) -> None:
    """Save the logs of a set in the folder, the last one last: with it the set has walked."""
    logs = [file.read_bytes() for file in files]
    paths = walks.log_paths(campaign, number)
    _set_aside(paths)  # logs of a call that was interrupted
    for path, log in zip(paths, logs, strict=True):
        write_file(path, log)


def undo_logs(campaign: Campaign) -> tuple[int, list[Path]]:
    """Take back the last logs; their set waits for its walk again.

    Returns:
        Number of the set, and its logs under the names that they have from now on.

    Raises:
        InputError: there is none.
    """
    number = 0
    while all(path.exists() for path in walks.log_paths(campaign, number)):
        number += 1
    if not number:
        raise InputError(f"{campaign.folder}: no logs to take back")
    for path in walks.weights_path(campaign.folder, number).parent.glob("*.json"):
        if path.stem.isdigit() and int(path.stem) >= number:
            path.unlink()  # of the set that this walk has led to
    return number - 1, _set_aside(walks.log_paths(campaign, number - 1))


def _set_aside(paths: Sequence[Path]) -> list[Path]:
    """Rename logs that no longer count; return their new names."""
    logs = {path: path.read_bytes() for path in paths if path.exists()}
    hashes = {path: hashlib.sha256(data).hexdigest()[:8] for path, data in logs.items()}
    return [path.replace(path.with_stem(f"{path.stem}-undone-{x}")) for path, x in hashes.items()]
