"""Walks that were made elsewhere, on a robot or in another simulator, and whose logs are reported.

They are data: the files that were reported are kept as they came, and each call scores them anew,
so that all are of one code and one loss.
"""

import hashlib
from collections.abc import Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np

from hector_jax.control.weights_file import load_weights
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError
from hector_jax.search.few_walks import Proposal
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.campaign import Campaign, point_of


def read_reports(pool: Executor, campaign: Campaign) -> list[walks.Row]:
    """Return the walks so far, scored by the present code; begin the record if it is new.

    Raises:
        InputError: see `walks.read_record`; or the weights or a log of a walk are damaged.
    """
    (rows, _), space = walks.read_record(campaign), walks.campaign_space(pool, campaign)
    for number, old in enumerate(rows):
        weights = load_weights(walks.weights_path(campaign.folder, number), campaign.robot)
        point = point_of(campaign, space, weights)
        if np.allclose(point, old.point, rtol=0.0, atol=1e-9):  # else the code places it elsewhere
            point = old.point
        proposal = Proposal(point, old.method, old.predicted)
        row = walks.row_of(proposal, walks.evaluate_logs(pool, campaign, number))
        same_loss = np.allclose(row.losses, old.losses, rtol=1e-6)  # as was predicted
        rows[number] = row if same_loss else row._replace(predicted=None)
    return rows


def add_report(
    pool: Executor, campaign: Campaign, proposal: Proposal, files: Sequence[Path]
) -> list[walks.Row]:
    """Save a walk in the folder, first copies of its logs, then its line; return all rows."""
    rows, _ = walks.read_record(campaign)
    number, logs = len(rows), [file.read_bytes() for file in files]
    _set_aside(campaign, number)  # logs of a report that was undone or interrupted
    for path, log in zip(walks.log_paths(campaign, number), logs, strict=True):
        write_file(path, log)
    walks.add_walk(campaign, rows, proposal, walks.evaluate_logs(pool, campaign, number))
    return read_reports(pool, campaign)


def undo_report(campaign: Campaign) -> tuple[int, list[Path]]:
    """Take back the last report; its proposal, which is still there, waits for its walk again.

    Returns:
        Number of the walk, and its logs under the names that they have from now on.

    Raises:
        InputError: there is none, or see `walks.read_record`.
    """
    (rows, _), path = walks.read_record(campaign), campaign.folder / walks.RECORD
    if not rows:
        raise InputError(f"{campaign.folder}: no report to undo")
    # The one step that counts. Settings, proposals and walks stay up to the last proposal walked.
    lines = path.read_bytes().splitlines(keepends=True)
    write_file(path, b"".join(lines[: 2 * len(rows)]))
    number = len(rows) - 1
    return number, _set_aside(campaign, number)


def _set_aside(campaign: Campaign, number: int) -> list[Path]:
    """Rename the logs of a walk that is not in the record; return their new names."""
    logs = {path: path.read_bytes() for path in walks.log_paths(campaign, number) if path.exists()}
    hashes = {path: hashlib.sha256(data).hexdigest()[:8] for path, data in logs.items()}
    return [path.replace(path.with_stem(f"{path.stem}-undone-{x}")) for path, x in hashes.items()]
