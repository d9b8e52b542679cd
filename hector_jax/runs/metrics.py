"""Which weight set walks better, and how sure that is: scores of walks, paired over seeds.

Each walk has a `Score`. The scores of one weight set over the seeds of a world are stacked, and a
`Verdict` holds those of all sets. The headline is the median over seeds of the ratio of the losses
of two sets on the same seed (the same plant), as a change in %; means stand beside it. Intervals
are percentile bootstraps over seeds: plants are redrawn, each with the walks of both sets. Fewer
than four plants have no interval.

A fall stays in the numbers, charged as the loss charges it. A comparison counts only where neither
set falls more often than the other by 2 of 32 seeds or the same share of fewer.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import stack
from hector_jax.tuning.loss import PAPER_LOSS, Loss, alphas, losses, switch_loss, total

BASELINES = ("nominal", "expert")

COVERAGE = 0.95  # of an interval
RESAMPLES, FEWEST = 10_000, 4  # resamples of a bootstrap; samples that have an interval
FALL_MARGIN = 2 / 32  # a difference in the share of falls from here on makes losses incomparable

_TINY = 1e-9


class Score(NamedTuple):
    """Losses and errors of one walk or, with a first axis, of several."""

    losses: dict[str, Float[np.ndarray, "*seeds"]]  # L and its parts, these without their weights
    switching: Float[np.ndarray, "*seeds"]  # the share of L_ctrl due to changes of stance
    rms_euler: Float[np.ndarray, "*seeds 3"]  # roll, pitch, yaw [rad], up to a fall
    rms_position: Float[np.ndarray, "*seeds 3"]  # x, y, z [m], up to a fall
    fallen: Bool[np.ndarray, "*seeds"]
    legs_touch: Float[np.ndarray, "*seeds"]  # [s] one leg touches the other, up to a fall
    residual: Float[np.ndarray, "*seeds"]  # largest relative KKT residual of a plan

    @property
    def L(self) -> Float[np.ndarray, "*seeds"]:  # noqa: D102, N802
        return self.losses["L"]


def percent(x: float) -> str:
    """A change in %, in two digits."""
    return f"{x:+.1f}" if abs(x) < 9.95 else f"{x:+.0f}"


class Interval(NamedTuple):
    """A value with the ends of its 95 % bootstrap interval, NaN where there is none."""

    value: float
    low: float
    high: float

    def text(self, write: Callable[[float], str] = percent) -> str:
        """`value [low, high]`, each formatted by `write`; without an interval the value alone."""
        ends = f" [{write(self.low)}, {write(self.high)}]" if np.isfinite(self.low) else ""
        return write(self.value) + ends


class Comparison(NamedTuple):
    """One set against another on the same seeds."""

    change: dict[str, Interval]  # by part: median of the paired ratio, as a change in %
    wins: float  # share of seeds on which the set's L is below the other's
    counts: bool  # neither falls more often than the other allows


class Verdict(NamedTuple):
    """All sets on the same seeds of one world."""

    seeds: Int[np.ndarray, " seeds"]
    scores: dict[str, Score]  # by set, stacked over seeds
    loss: Loss

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the terms of the loss, and of their sum."""
        return (*(term.name for term in self.loss), "L")


class Summary(NamedTuple):
    """One set of a verdict."""

    means: dict[str, Interval]  # over seeds, by part
    falls: int  # seeds on which it falls
    against: dict[str, Comparison]  # by the other set


def score(loss: Loss, walk: Trajectory) -> Score:
    """Compute losses, falls and tracking errors of one walk of any world.

    Args:
        loss: terms and weights.
        walk: without batch axes.

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


def score_like(*axes: int, loss: Loss = PAPER_LOSS) -> Score:
    """Return a score of zeros with some first axes, for `load_tree`."""
    one, three = np.zeros(axes), np.zeros((*axes, 3))
    parts = dict.fromkeys((*(term.name for term in loss), "L"), one)
    return Score(parts, one, three, three, one.astype(bool), one, one)


def _rms(error: Float[np.ndarray, "T 3"], rows: Bool[np.ndarray, " T"]) -> Float[np.ndarray, "3"]:
    """Root mean square over some rows; NaN where there are none."""
    return np.sqrt(np.mean(error[rows] ** 2, axis=0)) if rows.any() else np.full(3, np.nan)


def make_verdict(
    loss: Loss, seeds: Sequence[int], scores: Mapping[str, Sequence[Score]]
) -> Verdict:
    """Put the walks of all sets together.

    Args:
        loss: that the scores were made with.
        seeds: the plants, in the order of the scores.
        scores: by set, one score per seed.

    Raises:
        ValueError: no seeds, a set with another number of walks, a loss that is not finite.
    """
    if not len(seeds):
        raise ValueError("a verdict needs at least one seed, got none")
    stacked = {}
    for name, walks in scores.items():
        if len(walks) != len(seeds):
            raise ValueError(f"set '{name}' has {len(walks)} walks for {len(seeds)} seeds")
        stacked[name] = stack(walks)
        if wrong := np.asarray(seeds)[~np.isfinite(stacked[name].L)].tolist():
            raise ValueError(f"set '{name}': the loss on seeds {wrong} is not a finite number")
    return Verdict(np.asarray(seeds, int), stacked, loss)


def bootstrap(statistic: Callable[..., Any], *samples: Shaped[np.ndarray, "n ..."]) -> Interval:
    """Compute a statistic with its percentile bootstrap interval, the same each time.

    Args:
        statistic: of arrays like `samples`, with any axes before theirs.
        samples: redrawn along their first axis, all in the same way.

    Returns:
        NaN as the ends of the interval of fewer than `FEWEST` samples.

    >>> interval = bootstrap(lambda x: np.median(x, axis=-1), np.array([1.0, 2.0, 3.0, 10.0]))
    >>> interval.low <= interval.value == 2.5 <= interval.high
    True
    """
    value, count = float(statistic(*samples)), len(samples[0])
    if count < FEWEST:
        return Interval(value, np.nan, np.nan)
    from scipy import stats  # takes most of a second to import

    ends = stats.bootstrap(
        (np.arange(count),),  # rows, so that all samples are redrawn in the same way
        lambda rows, axis: statistic(*(x[rows] for x in samples)),
        n_resamples=RESAMPLES,
        confidence_level=COVERAGE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value, float(ends.low), float(ends.high))


@lru_cache(maxsize=4096)  # table, report and JSON need the same intervals
def _cached_bootstrap(values: bytes, statistic: Callable[..., Any]) -> Interval:
    return bootstrap(partial(statistic, axis=-1), np.frombuffer(values))


def mean(verdict: Verdict, name: str, part: str = "L") -> Interval:
    """Mean of a part of the loss over seeds."""
    return _cached_bootstrap(verdict.scores[name].losses[part].tobytes(), np.mean)


def falls_comparable(ours: Bool[np.ndarray, "*walks"], others: Bool[np.ndarray, "*walks"]) -> bool:
    """Whether neither of two sets falls so much more often that their losses do not compare."""
    return bool(abs(ours.mean() - others.mean()) < FALL_MARGIN - 1e-12)


def compare(verdict: Verdict, name: str, baseline: str) -> Comparison:
    """Compare a set with a baseline, seed by seed."""
    ours, theirs = verdict.scores[name], verdict.scores[baseline]
    change = {}
    for part in verdict.parts:
        # a walk that falls at once has no L_ctrl: keep its ratio a number
        ratio = (ours.losses[part] + _TINY) / (theirs.losses[part] + _TINY)
        median = _cached_bootstrap(ratio.tobytes(), np.median)
        change[part] = Interval(*(100.0 * (r - 1.0) for r in median))
    wins = float(np.mean(ours.L < theirs.L))
    return Comparison(change, wins, falls_comparable(ours.fallen, theirs.fallen))


def summarize(verdict: Verdict, name: str, others: Sequence[str] = BASELINES) -> Summary:
    """Means and falls of a set, compared with those of some others that are in the verdict."""
    against = [other for other in others if other in verdict.scores and other != name]
    return Summary(
        {part: mean(verdict, name, part) for part in verdict.parts},
        int(verdict.scores[name].fallen.sum()),
        {other: compare(verdict, name, other) for other in against},
    )


def family_of(world: str) -> str | None:
    """The family of plants of a world of the stand-in; None of another world.

    >>> family_of("standin"), family_of("standin-even"), family_of("hfs")
    ('standin', 'even', None)
    """
    name, _, family = world.partition("-")
    return (family or name) if name == "standin" else None


def as_result(verdict: Verdict, world: str = "standin") -> dict[str, Any]:
    """The verdict as JSON values: the content of result.json.

    `family` is that of the plants; results without one are of the family `standin`.
    `sets.<name>.<world>.<part>.{mean,low,high}`, `.falls`, `.seeds`, `.legs_touch` [s, all
    walks together], `.L_ctrl_switching` and `.rms`, and
    `sets.<name>.<world>.change.<baseline>.{median,low,high,wins,counts}` in %, of L, with those of
    the other parts under `.parts`.
    """
    return {
        "alpha": alphas(verdict.loss),
        "family": family_of(world),
        "sets": {name: {world: _set_result(verdict, name)} for name in verdict.scores},
    }


def _set_result(verdict: Verdict, name: str) -> dict[str, Any]:
    scores, summary = verdict.scores[name], summarize(verdict, name)
    euler, position = rms(verdict, name)
    return {
        **_intervals("mean", summary.means),
        "falls": summary.falls,
        "seeds": verdict.seeds.tolist(),
        "legs_touch": float(scores.legs_touch.sum()),
        "residual": float(scores.residual.max()),
        "L_ctrl_switching": float(scores.switching.mean()),
        "rms": {"euler": euler.tolist(), "position": position.tolist()},
        "change": {other: change_result(one) for other, one in summary.against.items()},
    }


def _intervals(value: str, parts: Mapping[str, Interval]) -> dict[str, dict[str, float]]:
    """Intervals by part as JSON values; `value` is the name of their middle."""
    return {
        part: dict(zip((value, "low", "high"), one, strict=True)) for part, one in parts.items()
    }


def change_result(comparison: Comparison) -> dict[str, Any]:
    """A comparison as JSON values: the change of L, wins, counts, and the changes of the parts."""
    rows = _intervals("median", comparison.change)
    return rows.pop("L") | {"wins": comparison.wins, "counts": comparison.counts, "parts": rows}


def rms(verdict: Verdict, name: str) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """RMS error over all seeds: roll, pitch, yaw [rad], and x, y, z [m]."""
    # walks that fell at once have no errors
    mean = lambda x: _rms(x, np.asarray(np.isfinite(x).all(axis=-1)))  # noqa: E731
    return mean(verdict.scores[name].rms_euler), mean(verdict.scores[name].rms_position)
