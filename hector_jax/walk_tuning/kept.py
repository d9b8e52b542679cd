"""Commands to keep: they walk too, and a set that makes one much worse is refused.

They have no part in value and slope. A set walks them once it is better in the commands that are
tuned; if it is refused, a shorter step follows, as after a fall.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

WORSE = 10.0  # [%] of L, from which on a kept command is too much worse


class Kept(NamedTuple):
    """What a set does to a kept command, over the plants."""

    change: float | None  # of the mean of log L against the start [%]; None: one always fell
    falls: int
    broken: bool  # WORSE, or it falls on more plants than with the start


def compare_kept(
    names: Sequence[str],
    start: Float[np.ndarray, " walks"],
    losses: Float[np.ndarray, " walks"],
) -> dict[str, Kept]:
    """Compare the walks of a set with those of the start, by name of the kept command.

    Args:
        names: of the commands.
        start, losses: L of each command on the first plant, then on the next; infinite of a fall.
    """
    found = {}
    for name, *walks in zip(
        names, *(x.reshape(-1, len(names)).T for x in (start, losses)), strict=True
    ):
        before, after = walks
        both = np.isfinite(before) & np.isfinite(after)
        logs = np.log(after[both] / before[both])
        change = 100.0 * float(np.expm1(logs.mean())) if both.any() else None
        fell = [int((~np.isfinite(x)).sum()) for x in walks]
        worse = change is not None and change > WORSE
        found[name] = Kept(change, fell[1], worse or fell[1] > fell[0])
    return found
