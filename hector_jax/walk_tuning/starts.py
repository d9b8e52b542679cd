"""The choice of the set that a tuning on walks begins with."""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import bar, say
from hector_jax.core.files import write_file
from hector_jax.core.journal import continue_journal
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.walks import (
    RECORD,
    bounded_logs,
    log_paths,
    record_head,
    remedy,
    walk_all,
    weights_path,
)

START_PLANTS = 3  # on which several starts walk


def with_best_start(
    pool: Executor, campaign: Campaign, starts: Mapping[str, Weights]
) -> tuple[str, Campaign]:
    """Return the name of that of several starts which walks best, and the campaign from it.

    Each walks on the first plants; of those that fall least often it is that with the least mean of
    log L, a fall bounded as in the tuning. Its walks are not made again.

    Args:
        pool, campaign: as for `tune_on_walks`; its own start does not matter.
        starts: weights by name.
    """
    tried, rows, few = [], [], campaign.plants[:START_PLANTS]
    with bar("walking with each set that the tuning on walks may begin with") as report_progress:
        for name, start in starts.items():
            report_progress(len(tried), len(starts), name)
            folder = campaign.folder / "starts" / name
            one = replace(campaign, folder=folder, start=start, plants=few)
            continue_journal(
                folder / RECORD, record_head(one), "walks of a start", dict, remedy(one)
            )
            save_weights(weights_path(folder, 0), one.start)
            rows.append([walked.loss for walked in walk_all(pool, one, 0, one.start)])
            tried.append(one)
    losses = np.array(rows)
    means = bounded_logs(losses, losses).mean(axis=1)
    best = tried[np.lexsort((means, (~np.isfinite(losses)).sum(axis=1)))[0]]
    name = best.folder.name
    say(f"it begins with `{name}`")
    for path, kept in zip(log_paths(best, 0), log_paths(campaign, 0), strict=False):
        write_file(kept, path.read_bytes())
    return name, replace(campaign, start=best.start)
