"""Who walks better, and how sure are we: scores of walks, paired over seeds.

A walk becomes a `Score`, the scores of one weight set over the seeds of a world are stacked, and a
`Verdict` holds those of all sets. The headline is the median over seeds of the ratio of two sets'
losses on the same seed (the same plant), told as a change in %; means stand beside it. Intervals
are percentile bootstraps over seeds: plants are redrawn, both sets with them; fewer than four have
none.

A fall stays in the numbers, charged as the loss charges it. A comparison counts only where neither
set falls more often than the other by 2 of 32 seeds or the same share of fewer.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from hector_jax.core.trajectory import Trajectory
from hector_jax.tuning.loss import LossConfig, losses, switch_loss, total

BASELINES = ("nominal", "expert")
PARTS = ("L", "L_Eul", "L_pos", "L_ctrl")

COVERAGE = 0.95
RESAMPLES, FEWEST = 10_000, 4  # draws; samples that have an interval
FALL_MARGIN = 2 / 32  # a difference in the share of falls from here on makes losses incomparable

_TINY = 1e-9


class Score(NamedTuple):
    """What one walk, or with a first axis each of several, is worth; losses of parts unweighted."""

    L: Float[np.ndarray, "*seeds"]  # with the loss weights
    L_Eul: Float[np.ndarray, "*seeds"]  # [rad^2]
    L_pos: Float[np.ndarray, "*seeds"]  # [m^2]
    L_ctrl: Float[np.ndarray, "*seeds"]  # [N^2 and (N m)^2]
    switching: Float[np.ndarray, "*seeds"]  # the share of L_ctrl owed at changes of stance
    rms_euler: Float[np.ndarray, "*seeds 3"]  # roll, pitch, yaw [rad], up to a fall
    rms_position: Float[np.ndarray, "*seeds 3"]  # x, y, z [m], up to a fall
    fallen: Bool[np.ndarray, "*seeds"]
    legs_touch: Float[np.ndarray, "*seeds"]  # [s] one leg touches the other, up to a fall
    residual: Float[np.ndarray, "*seeds"]  # worst relative KKT residual of a plan


class Interval(NamedTuple):
    """A value with the ends of its 95 % bootstrap interval, NaN where there is none."""

    value: float
    low: float
    high: float

    def text(self, write: Callable[[float], str]) -> str:
        """`value [low, high]`, each as `write` has it; the value alone without an interval."""
        ends = f" [{write(self.low)}, {write(self.high)}]" if np.isfinite(self.low) else ""
        return write(self.value) + ends


class Comparison(NamedTuple):
    """One set against a baseline on the same seeds."""

    change: dict[str, Interval]  # by part: median of the paired ratio, as a change in %
    wins: float  # share of seeds on which the set's L is below the baseline's
    counts: bool  # neither falls more often than the other allows


class Verdict(NamedTuple):
    """All sets on the same seeds of one world."""

    seeds: Int[np.ndarray, " seeds"]
    scores: dict[str, Score]  # by set, stacked over seeds
    alpha: LossConfig


def score(config: LossConfig, walk: Trajectory) -> Score:
    """Losses, falls and tracking errors of one walk of any world.

    Args:
        config: weights of the loss.
        walk: without batch axes.

    Source: Eq. 11.
    """
    parts = losses(walk)
    fallen = np.asarray(walk.fallen)
    whole = jax.tree.map(lambda x: np.asarray(x, float), (total(config, parts), parts))
    return Score(
        whole[0],
        *whole[1],
        switching=np.asarray(switch_loss(walk), float),
        rms_euler=_rms(np.asarray(walk.state.euler) - walk.reference.euler, fallen),
        rms_position=_rms(np.asarray(walk.state.position) - walk.reference.position, fallen),
        fallen=np.asarray(fallen.any()),
        legs_touch=np.asarray(float(walk.period) * np.sum(np.asarray(walk.legs_touch) & ~fallen)),
        residual=np.asarray(walk.residual, float).max(),
    )


def _rms(error: Float[np.ndarray, "T 3"], fallen: Bool[np.ndarray, " T"]) -> np.ndarray:
    walked = error[~fallen]
    return np.sqrt(np.mean(walked**2, axis=0)) if len(walked) else np.full(3, np.nan)


def judge(
    config: LossConfig, seeds: Sequence[int], scores: Mapping[str, Sequence[Score]]
) -> Verdict:
    """Put the walks of all sets together.

    Args:
        config: the loss weights the scores were made with.
        seeds: the plants, in the order of the scores.
        scores: by set, one score per seed.

    Raises:
        ValueError: no seeds, a set with another number of walks, a loss that is not a number.
    """
    if not len(seeds):
        raise ValueError("a verdict needs at least one seed, got none")
    stacked = {}
    for name, walks in scores.items():
        if len(walks) != len(seeds):
            raise ValueError(f"set '{name}' has {len(walks)} walks for {len(seeds)} seeds")
        stacked[name] = Score(*(np.stack(rows) for rows in zip(*walks, strict=True)))
        wrong = [s for s, loss in zip(seeds, stacked[name].L, strict=True) if not np.isfinite(loss)]
        if wrong:
            raise ValueError(f"set '{name}': the loss on seeds {wrong} is not a finite number")
    return Verdict(np.asarray(seeds, int), stacked, config)


def bootstrap(statistic: Callable[..., Any], *samples: Shaped[np.ndarray, "n ..."]) -> Interval:
    """A statistic with its percentile bootstrap interval, the same each time.

    Args:
        statistic: of arrays like `samples`, with any axes before theirs.
        samples: redrawn along their first axis, all in the same way.

    Returns:
        NaN as the ends of the interval of fewer than `FEWEST` samples.

    >>> found = bootstrap(lambda x: np.median(x, axis=-1), np.array([1.0, 2.0, 3.0, 10.0]))
    >>> found.low <= found.value == 2.5 <= found.high
    True
    """
    value, count = float(statistic(*samples)), len(samples[0])
    if count < FEWEST:
        return Interval(value, np.nan, np.nan)
    draws = np.random.default_rng(0).integers(count, size=(RESAMPLES, count))
    tail = 50 * (1 - COVERAGE)
    low, high = np.percentile(statistic(*(x[draws] for x in samples)), [tail, 100 - tail])
    return Interval(value, float(low), float(high))


@lru_cache(maxsize=4096)  # a report tells the same interval in many places
def _of_bytes(values: bytes, statistic: Callable[..., Any]) -> Interval:
    return bootstrap(partial(statistic, axis=-1), np.frombuffer(values))


def _over_seeds(values: Float[np.ndarray, " seeds"], statistic: Callable[..., Any]) -> Interval:
    return _of_bytes(np.asarray(values, float).tobytes(), statistic)


def mean(verdict: Verdict, name: str, part: str = "L") -> Interval:
    """Mean of a part of the loss over seeds."""
    return _over_seeds(getattr(verdict.scores[name], part), np.mean)


def falls(verdict: Verdict, name: str) -> int:
    """Number of seeds on which the set falls."""
    return int(verdict.scores[name].fallen.sum())


def compare(verdict: Verdict, name: str, baseline: str) -> Comparison:
    """A set against a baseline, seed by seed."""
    ours, theirs = verdict.scores[name], verdict.scores[baseline]
    change = {}
    for part in PARTS:
        # a walk that falls at once has no L_ctrl: keep its ratio a number
        ratio = (getattr(ours, part) + _TINY) / (getattr(theirs, part) + _TINY)
        change[part] = Interval(*(100.0 * (r - 1.0) for r in _over_seeds(ratio, np.median)))
    gap = abs(ours.fallen.mean() - theirs.fallen.mean())
    return Comparison(change, float(np.mean(ours.L < theirs.L)), bool(gap < FALL_MARGIN - 1e-12))


def as_result(verdict: Verdict, world: str = "standin") -> dict[str, Any]:
    """The verdict as JSON values: the content of result.json.

    `sets.<name>.<world>.<part>.{mean,low,high}`, `.falls`, `.seeds`, `.legs_touch` [s, all
    walks together], `.L_ctrl_switching` and `.rms`, and
    `sets.<name>.<world>.change.<baseline>.{median,low,high,wins,counts}` in %, of L, with those of
    the other parts under `.parts`.
    """
    return {
        "alpha": {"euler": verdict.alpha.euler, "position": verdict.alpha.position},
        "sets": {name: {world: _set_result(verdict, name)} for name in verdict.scores},
    }


def _set_result(verdict: Verdict, name: str) -> dict[str, Any]:
    found: dict[str, Any] = {
        part: dict(zip(("mean", "low", "high"), mean(verdict, name, part), strict=True))
        for part in PARTS
    }
    one = verdict.scores[name]
    found["falls"] = falls(verdict, name)
    found["seeds"] = verdict.seeds.tolist()
    found["legs_touch"] = float(one.legs_touch.sum())
    found["residual"] = float(one.residual.max())
    found["L_ctrl_switching"] = float(one.switching.mean())
    found["rms"] = {
        key: [x if np.isfinite(x) else None for x in values.tolist()]
        for key, values in zip(("euler", "position"), rms(verdict, name), strict=True)
    }
    found["change"] = {}
    for baseline in BASELINES:
        if baseline in verdict.scores and baseline != name:
            found["change"][baseline] = change_result(compare(verdict, name, baseline))
    return found


def change_result(comparison: Comparison) -> dict[str, Any]:
    """A comparison as JSON values: the change of L, wins, counts, and the parts' changes."""
    keys = ("median", "low", "high")
    rows = {p: dict(zip(keys, c, strict=True)) for p, c in comparison.change.items()}
    return rows.pop("L") | {"wins": comparison.wins, "counts": comparison.counts, "parts": rows}


def _quadratic_mean(rms: Float[np.ndarray, "seeds 3"]) -> Float[np.ndarray, "3"]:
    """RMS over the walks of all seeds but those that fell at once, which have none."""
    known = rms[np.isfinite(rms).all(axis=-1)]
    return np.sqrt(np.mean(known**2, axis=0)) if len(known) else np.full(3, np.nan)


def rms(verdict: Verdict, name: str) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """RMS error over all seeds: roll, pitch, yaw [rad], and x, y, z [m]."""
    one = verdict.scores[name]
    return _quadratic_mean(one.rms_euler), _quadratic_mean(one.rms_position)
