"""Comparison of weight sets and its uncertainty: scores of walks, paired over plants and scenes.

Each walk has a `Score`. A `Verdict` holds those of all sets on the same plants (one per seed) and
in the same scenes (trajectories). The main result is the median over plants of the ratio of the
losses of two sets, of which a plant with several scenes gives its own median, as a change in %;
means are given beside it.

Plants are the sample: walks of one plant are not independent. The interval of a median is that of
two order statistics, which covers it for any distribution; that of a mean is Student's. Below six
plants there is none: the whole range of five holds the median in 94 % of cases only. Where walks
decide how many plants walk, the order statistics are those of `verdict.stopping`.

A fall stays in the numbers with the charge of the loss. A comparison counts only if neither set
falls more often than the other by 2 of 32 walks or the same share.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import stack
from hector_jax.tuning.loss import Loss, alphas, losses, switch_loss, total

BASELINES = ("nominal", "expert", "start")

COVERAGE = 0.95  # of an interval
FEWEST = 6  # plants for an interval
FALL_MARGIN = 2 / 32  # from this difference in the share of falls on, losses are not comparable

_TINY = 1e-9


class Score(NamedTuple):
    """Losses and errors of one walk or, with leading axes, of several."""

    losses: dict[str, Float[np.ndarray, "*walks"]]  # L, and its unweighted terms
    switching: Float[np.ndarray, "*walks"]  # the share of L_ctrl due to changes of stance
    rms_euler: Float[np.ndarray, "*walks 3"]  # roll, pitch, yaw [rad], up to a fall
    rms_position: Float[np.ndarray, "*walks 3"]  # x, y, z [m], up to a fall
    fallen: Bool[np.ndarray, "*walks"]
    legs_touch: Float[np.ndarray, "*walks"]  # [s] of contact between the legs, up to a fall
    residual: Float[np.ndarray, "*walks"]  # largest relative KKT residual of a plan

    @property
    def L(self) -> Float[np.ndarray, "*walks"]:  # noqa: D102, N802
        return self.losses["L"]


def percent(x: float) -> str:
    """Format a change in %, with two digits."""
    return f"{x:+.1f}" if abs(x) < 9.95 else f"{x:+.0f}"


class Interval(NamedTuple):
    """A value with the ends of its 95 % interval, NaN if there is none."""

    value: float
    low: float
    high: float

    def text(self, write: Callable[[float], str] = percent) -> str:
        """Format as `value [low, high]` with `write`; without an interval the value alone."""
        ends = f" [{write(self.low)}, {write(self.high)}]" if np.isfinite(self.low) else ""
        return write(self.value) + ends


class Comparison(NamedTuple):
    """Comparison of two sets on the same plants and scenes."""

    change: dict[str, Interval]  # by part: median over plants of the ratio, as a change in %
    wins: float  # share of walks in which the first set has the lower L
    counts: bool  # neither set falls so much more often that losses are not comparable


Rank = Callable[[int], int]
"""Number of values, of so many plants, up to each end of an interval; zero if there is none."""


def fixed_rank(plants: int) -> int:
    """Return the `Rank` of an interval of a median if the number of plants is chosen beforehand.

    >>> fixed_rank(5), fixed_rank(6), fixed_rank(16)
    (0, 1, 4)
    """
    from scipy.special import bdtr  # slow to import

    return int(np.searchsorted(bdtr(np.arange(plants), plants, 0.5), (1 - COVERAGE) / 2))


class Verdict(NamedTuple):
    """Scores of all sets on the same plants of one world, in the same scenes."""

    seeds: Int[np.ndarray, " plants"]
    scenes: tuple[str, ...]  # names of the trajectories
    scores: dict[str, Score]  # by set, (plants, scenes) each
    loss: Loss
    rank: Rank = fixed_rank  # of the intervals of medians

    def of_scene(self, *scenes: str) -> "Verdict":
        """Return the walks of one scene, or of some."""
        at = [self.scenes.index(scene) for scene in scenes]
        scores = {
            name: jax.tree.map(lambda x: np.take(x, at, axis=1), score)
            for name, score in self.scores.items()
        }
        return self._replace(scenes=scenes, scores=scores)

    @property
    def each(self) -> dict[str, "Verdict"]:
        """The walks of all scenes by their names, and, of several, of each scene."""
        several = self.scenes if len(self.scenes) > 1 else ()
        return {", ".join(self.scenes): self, **{name: self.of_scene(name) for name in several}}

    @property
    def walks(self) -> int:
        """Number of walks of each set."""
        return len(self.seeds) * len(self.scenes)

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the terms of the loss, and of their sum."""
        return parts_of(self.loss)


class Summary(NamedTuple):
    """Results of one set of a verdict."""

    means: dict[str, Interval]  # over plants and scenes, by part
    falls: int  # walks in which it falls
    against: dict[str, Comparison]  # by the other set


def parts_of(loss: Loss) -> tuple[str, ...]:
    """Return the names of the terms of a loss, and of their sum."""
    return (*(term.name for term in loss), "L")


def score(loss: Loss, walk: Trajectory) -> Score:
    """Compute losses, falls and tracking errors of one walk in any world.

    Args:
        loss: terms and weights.
        walk: trajectory without batch axes.

    Source: Eq. 11.
    """
    terms = losses(loss, walk)
    fallen = np.asarray(walk.fallen)
    named = {**terms, "L": total(loss, terms)}
    return Score(
        losses={part: np.asarray(value, float) for part, value in named.items()},
        switching=np.asarray(switch_loss(walk), float),
        rms_euler=_rms(np.asarray(walk.state.euler) - walk.reference.euler, ~fallen),
        rms_position=_rms(np.asarray(walk.state.position) - walk.reference.position, ~fallen),
        fallen=np.asarray(fallen.any()),
        legs_touch=np.asarray(float(walk.period) * np.sum(np.asarray(walk.legs_touch) & ~fallen)),
        residual=np.asarray(walk.residual, float).max(),
    )


def _rms(error: Float[np.ndarray, "*n 3"], rows: Bool[np.ndarray, "*n"]) -> Float[np.ndarray, "3"]:
    """Return the root mean square over some rows; NaN without rows."""
    return np.sqrt(np.mean(error[rows] ** 2, axis=0)) if rows.any() else np.full(3, np.nan)


def make_verdict(
    loss: Loss,
    seeds: Sequence[int],
    scores: Mapping[str, Mapping[str, Sequence[Score]]],
    rank: Rank = fixed_rank,
) -> Verdict:
    """Combine the walks of all sets into a verdict.

    Args:
        loss: loss of the scores.
        seeds: seeds of the plants, in the order of the scores.
        scores: scores by scene and set, one per seed; all scenes have the same sets.
        rank: of the intervals of medians.

    Raises:
        ValueError: there are no seeds, or a set has another number of walks or a loss that is not
            finite.
    """
    if not len(seeds):
        raise ValueError("a verdict needs at least one seed, got none")
    stacked = {}
    for name in next(iter(scores.values())):
        by_scene = [sets[name] for sets in scores.values()]
        by_plant = zip(seeds, *by_scene, strict=True)
        stacked[name] = stack([stack(walks) for _, *walks in by_plant])
        if wrong := np.asarray(seeds)[~np.isfinite(stacked[name].L).all(axis=1)].tolist():
            raise ValueError(f"set '{name}': the loss on seeds {wrong} is not a finite number")
    return Verdict(np.asarray(seeds, int), tuple(scores), stacked, loss, rank)


def interval_of_median(values: Float[np.ndarray, " plants"], rank: Rank = fixed_rank) -> Interval:
    """Return the median with the narrowest symmetric pair of values that covers it in 95 %.

    >>> interval_of_median(np.array([1.0, 2.0, 3.0, 4.0, 5.0, 60.0]))
    Interval(value=3.5, low=1.0, high=60.0)
    """
    value, at = float(np.median(values)), rank(len(values))
    if not at:
        return Interval(value, np.nan, np.nan)
    ordered = np.sort(values)
    return Interval(value, float(ordered[at - 1]), float(ordered[-at]))


def interval_of_mean(values: Float[np.ndarray, " plants"]) -> Interval:
    """Return the mean with Student's interval of its logarithm; that of zeros has no width."""
    from scipy.special import stdtrit  # slow to import

    count, value = len(values), float(np.mean(values))
    if count < FEWEST:
        return Interval(value, np.nan, np.nan)
    error = np.std(values, ddof=1) / (np.sqrt(count) * max(abs(value), _TINY))
    width = float(np.exp(stdtrit(count - 1, (1 + COVERAGE) / 2) * error))
    return Interval(value, *sorted((value / width, value * width)))


def mean(verdict: Verdict, name: str, part: str = "L") -> Interval:
    """Return the mean over plants and scenes of a part of the loss."""
    return interval_of_mean(verdict.scores[name].losses[part].mean(axis=1))


def falls_comparable(first: Bool[np.ndarray, "*walks"], second: Bool[np.ndarray, "*walks"]) -> bool:
    """Tell whether the shares of falls of two sets are close enough to compare their losses."""
    return bool(abs(first.mean() - second.mean()) < FALL_MARGIN - 1e-12)


def compare(verdict: Verdict, name: str, baseline: str) -> Comparison:
    """Compare a set with a baseline on the same plants and scenes."""
    score, base = verdict.scores[name], verdict.scores[baseline]
    change = {}
    for part in verdict.parts:
        # a walk that falls at once has no L_ctrl: keep its ratio finite
        ratio = (score.losses[part] + _TINY) / (base.losses[part] + _TINY)
        median = interval_of_median(np.median(ratio, axis=1), verdict.rank)
        change[part] = Interval(*(100.0 * (r - 1.0) for r in median))
    wins = float(np.mean(score.L < base.L))
    return Comparison(change, wins, falls_comparable(score.fallen, base.fallen))


def summarize(verdict: Verdict, name: str, others: Sequence[str] = BASELINES) -> Summary:
    """Return means and falls of a set and its comparison with those `others` in the verdict."""
    against = [other for other in others if other in verdict.scores and other != name]
    return Summary(
        {part: mean(verdict, name, part) for part in verdict.parts},
        int(verdict.scores[name].fallen.sum()),
        {other: compare(verdict, name, other) for other in against},
    )


def baseline_of(names: Collection[str]) -> str:
    """Return the first of BASELINES among the names of sets, which claims are made against.

    >>> baseline_of(["start", "best"])
    'start'
    """
    return next(name for name in BASELINES if name in names)


def family_of(world: str) -> str | None:
    """Return the family of plants of a world of the stand-in; None for another world.

    >>> family_of("standin"), family_of("standin-even"), family_of("hfs")
    ('standin', 'even', None)
    """
    name, _, family = world.partition("-")
    return (family or name) if name == "standin" else None


def verdict_result(verdicts: Mapping[str, Verdict]) -> dict[str, Any]:
    """Return the verdict in each world as JSON values: the content of result.json.

    `sets.<name>.<world>.<part>.{mean,low,high}`, `.falls` of walks, `.seeds` of the plants,
    `.scenes`, `.legs_touch` [s, all walks together], `.L_ctrl_switching` and `.rms`, and
    `sets.<name>.<world>.change.<baseline>.{median,low,high,wins,counts}` in %, of L, with those of
    the other parts under `.parts`; of several scenes, the same of each under `trajectories`.
    """
    first = next(iter(verdicts.values()))
    result = {
        "alpha": alphas(first.loss),
        "sets": {
            name: {world: set_result(verdict, name) for world, verdict in verdicts.items()}
            for name in first.scores
        },
    }
    if len(first.scenes) > 1:
        result["trajectories"] = {
            scene: verdict_result({world: v.of_scene(scene) for world, v in verdicts.items()})
            for scene in first.scenes
        }
    return result


def set_result(verdict: Verdict, name: str) -> dict[str, Any]:
    """Return the results of one set of a verdict as JSON values."""
    scores, summary = verdict.scores[name], summarize(verdict, name)
    euler, position = rms(verdict, name)
    return {
        **_intervals("mean", summary.means),
        "falls": summary.falls,
        "seeds": verdict.seeds.tolist(),
        "scenes": list(verdict.scenes),
        "legs_touch": float(scores.legs_touch.sum()),
        "residual": float(scores.residual.max()),
        "L_ctrl_switching": float(scores.switching.mean()),
        "rms": {"euler": euler.tolist(), "position": position.tolist()},
        "change": {other: change_result(row) for other, row in summary.against.items()},
    }


def _intervals(value: str, parts: Mapping[str, Interval]) -> dict[str, dict[str, float]]:
    """Return intervals by part as JSON values; `value` is the key of their value."""
    keys = value, "low", "high"
    return {part: dict(zip(keys, interval, strict=True)) for part, interval in parts.items()}


def change_result(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON values: the change of L, wins, counts, and that of the parts."""
    rows = _intervals("median", comparison.change)
    return rows.pop("L") | {"wins": comparison.wins, "counts": comparison.counts, "parts": rows}


def rms(verdict: Verdict, name: str) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the RMS errors over all walks: roll, pitch, yaw [rad], and x, y, z [m]."""
    # walks that fell at once have no errors
    mean = lambda x: _rms(x, np.isfinite(x).all(axis=-1))  # noqa: E731
    return mean(verdict.scores[name].rms_euler), mean(verdict.scores[name].rms_position)
