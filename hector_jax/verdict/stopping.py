"""When enough plants have walked: an interval of the median that holds at every number of them.

The interval of `metrics.fixed_rank` is for a number of plants that was chosen beforehand. Whoever
looks while walks come in, and stops when he likes the answer, needs one that holds at all numbers
of plants at once. That the median of the ratio x is not below m is tested by betting on the signs
of x - m at even odds: with a share q of the stake on "below", averaged over q, plants 1 to n leave

    K_n = mean over q of (2 q)^b (2 (1 - q))^(n - b),    b plants with x < m,

of a stake of 1, with q from Beta(1/4, 1/4) above 1/2. If P(x < m) <= 1/2, K_n is a nonnegative
supermartingale, so it ever reaches 1 / level with a probability of at most `level` (Ville),
whatever the distribution of x. All m that are excluded neither from below nor from above are the
interval: it ends at two order statistics, as the other one does. Plants have to be independent
draws; where one stops is free. Beta(1/4, 1/4) lets six plants be enough for one claim, as they are
for the other interval.

Source: Howard and Ramdas, arXiv:1906.09712 (quantiles), with this mixture in place of theirs.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
from jaxtyping import Float, Int

from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import COVERAGE, Comparison, Verdict

SAME = 5.0  # [%] a median change of L that is surely smaller than this is no difference
UNCLEAR = "unclear"

_SHAPE = 0.25  # of the Beta distribution of q


def log_wealth(
    below: int | Int[np.ndarray, "*n"], above: int | Int[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n"]:
    """Return log K_n after `below` plants with x < m, and `above` other ones.

    >>> round(float(np.exp(log_wealth(1, 0))), 3)  # 2 E[q]
    1.763
    """
    from scipy.special import betainc, betaln  # slow to import

    a, b = below + _SHAPE, above + _SHAPE
    mixture = betaln(a, b) - betaln(_SHAPE, _SHAPE) + np.log(2.0 * betainc(b, a, 0.5))
    return np.asarray((below + above) * np.log(2.0) + mixture)


@dataclass(frozen=True)
class StoppingRule:
    """Walk plants until every set is clearly better or worse than nominal, or no different."""

    claims: int = 1  # number of those that shall hold together, each with its share of the error
    batch: int = 1  # plants that walk at once, between two looks

    def rank(self, plants: int) -> int:
        """Return the `Rank` of an interval of a median that holds at every number of plants."""
        least = -np.log((1.0 - COVERAGE) / 2.0 / self.claims)
        above = np.arange(plants + 1)  # the wealth falls with it
        return int(np.sum(log_wealth(plants - above, above) >= least))

    @property
    def fewest(self) -> int:
        """Fewest plants that a claim can be made of."""
        return next(plants for plants in count(1) if self.rank(plants))

    def batches(self, plants: int) -> Iterator[range]:
        """Yield the plants that walk before each look; no look before a claim can be made."""
        first = -(-self.fewest // self.batch) * self.batch
        ends = [*range(first, plants, self.batch), plants]
        return map(range, [0, *ends], ends)


def claim_of(comparison: Comparison) -> str:
    """Return what may be said of a set against a baseline; `UNCLEAR` if falls make it void."""
    _, low, high = comparison.change["L"]
    if not comparison.counts:
        return UNCLEAR
    if high < 0.0:
        return "better"
    if low > 0.0:
        return "worse"
    return "no difference" if -SAME < low and high < SAME else UNCLEAR


def claims_of(verdict: Verdict) -> dict[str, dict[str, str]]:
    """Return the claim about each set against the baseline, by scene and set."""
    base = metrics.baseline_of(verdict.scores)
    return {
        scene: {
            name: claim_of(metrics.compare(verdict.of_scene(scene), name, base))
            for name in verdict.scores
            if name != base
        }
        for scene in verdict.scenes
    }


def is_clear(verdict: Verdict) -> bool:
    """Tell whether every set is clear in every scene."""
    return all(UNCLEAR not in by_set.values() for by_set in claims_of(verdict).values())
