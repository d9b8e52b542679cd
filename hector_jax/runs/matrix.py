"""What weight sets are worth in several engines and models: scores of walks, column by column.

A column is a physics engine with a model of the robot; a cell is a column on one trajectory, with
the walks of all sets on the same plants (a `Verdict`). Whether a change of the loss belongs to the
weights or to one simulator shows in the differences between columns:

- the spread: the largest difference between engines of the median change on the same plants of the
  same model, beside the gain, the smallest reduction in any of these engines;
- Kendall's tau of the order of the sets by their median L, between every two columns.
"""

from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.runs import metrics
from hector_jax.runs.metrics import BASELINES, COVERAGE, Comparison, Interval, Verdict

OWN, LIGHT, HEAVY = "own", "light", "heavy"  # models: the robot's file, and with other masses
FEWEST_SETS = 3  # that have an order worth comparing


class Column(NamedTuple):
    """Where all sets walk."""

    engine: str
    model: str  # OWN, LIGHT, HEAVY or the name of another model of the robot


Cells = Mapping[tuple[Column, str], Verdict]
"""Walks of all sets, by column and trajectory."""


class Tally(NamedTuple):
    """How often the median change of a set against a baseline is below zero."""

    cells: int
    below: int  # and comparable
    clear: int  # and the interval too
    above: int  # the interval is above zero, and comparable
    void: int  # falls make it no comparison


class Falls(NamedTuple):
    """How often a set falls."""

    falls: int
    walks: int
    share: Interval  # with its exact binomial (Clopper-Pearson) interval


class Worst(NamedTuple):
    """The walk with the largest L against that of the baseline on the same plant."""

    column: Column
    trajectory: str
    seed: int
    change: float  # [%]
    fallen: bool


class Spread(NamedTuple):
    """How far engines differ about the change of a set on one trajectory and model."""

    trajectory: str
    model: str
    gain: float  # [%] smallest reduction of L in any of the engines
    spread: float  # [percentage points] largest difference of the change

    @property
    def is_small(self) -> bool:
        """Whether the gain is at least twice the spread."""
        return self.gain >= 2.0 * self.spread


class Agreement(NamedTuple):
    """How alike two columns order the sets."""

    trajectory: str
    one: Column
    other: Column
    tau: float  # Kendall's: 1 for the same order, -1 for the reverse one


def columns_of(cells: Cells) -> list[Column]:
    """The columns, in order."""
    return list(dict.fromkeys(column for column, _ in cells))


def trajectories_of(cells: Cells) -> list[str]:
    """The trajectories, in order."""
    return list(dict.fromkeys(trajectory for _, trajectory in cells))


def sets_of(cells: Cells) -> list[str]:
    """The weight sets, in order."""
    return list(next(iter(cells.values())).scores)


def changes(cells: Cells, name: str, baseline: str) -> dict[tuple[Column, str], Comparison]:
    """The comparison of a set with a baseline in every cell."""
    return {cell: metrics.compare(verdict, name, baseline) for cell, verdict in cells.items()}


def tally(cells: Cells, name: str, baseline: str) -> Tally:
    """Count the cells in which a set is below a baseline."""
    each = changes(cells, name, baseline).values()
    L = [one.change["L"] for one in each if one.counts]
    return Tally(
        cells=len(cells),
        below=sum(one.value < 0.0 for one in L),
        clear=sum(one.high < 0.0 for one in L),
        above=sum(one.low > 0.0 for one in L),
        void=len(cells) - len(L),
    )


def falls(cells: Cells, name: str) -> Falls:
    """Count the falls of a set in some cells; the interval takes walks as independent."""
    fallen = np.concatenate([verdict.scores[name].fallen for verdict in cells.values()])
    count = int(fallen.sum())
    return Falls(count, len(fallen), fall_share(count, len(fallen)))


def fall_share(falls: int, walks: int) -> Interval:
    """The share of walks that fall, with its exact binomial (Clopper-Pearson) interval.

    >>> round(fall_share(0, 10).high, 4)  # 1 - 0.025^(1/10)
    0.3085
    """
    from scipy import stats  # takes most of a second to import

    ends = stats.binomtest(falls, walks).proportion_ci(COVERAGE, method="exact")
    return Interval(falls / walks, float(ends.low), float(ends.high))


def worst(cells: Cells, name: str, baseline: str) -> Worst:
    """The plant on which a set does worst against a baseline, falls as the loss charges them."""
    found = []
    for (column, trajectory), verdict in cells.items():
        ours, theirs = verdict.scores[name], verdict.scores[baseline]
        change = 100.0 * (ours.L / theirs.L - 1.0)
        at = int(np.argmax(change))
        seed, fallen = int(verdict.seeds[at]), bool(ours.fallen[at])
        found.append(Worst(column, trajectory, seed, float(change[at]), fallen))
    return max(found, key=lambda one: one.change)


def on_seeds(verdict: Verdict, seeds: np.ndarray) -> Verdict:
    """The verdict on some of its seeds."""
    rows = np.flatnonzero(np.isin(verdict.seeds, seeds))
    scores = jax.tree.map(lambda x: x[rows], verdict.scores)
    return verdict._replace(seeds=verdict.seeds[rows], scores=scores)


def spreads(cells: Cells, name: str, baseline: str) -> list[Spread]:
    """The spread between engines of each trajectory and model that several engines walk."""
    found = []
    for trajectory in trajectories_of(cells):
        for model in dict.fromkeys(column.model for column in columns_of(cells)):
            each = [v for (c, t), v in cells.items() if (c.model, t) == (model, trajectory)]
            if len(each) < 2:
                continue
            shared = _shared(*each)
            scores = [on_seeds(one, shared).scores for one in each]
            medians = [100.0 * float(np.median(s[name].L / s[baseline].L) - 1.0) for s in scores]
            gain, spread = -max(medians), max(medians) - min(medians)
            found.append(Spread(trajectory, model, gain, spread))
    return found


def agreements(cells: Cells) -> list[Agreement]:
    """Kendall's tau between every two columns of each trajectory; none of fewer than three sets."""
    if len(sets_of(cells)) < FEWEST_SETS:
        return []
    from scipy import stats  # takes most of a second to import

    found = []
    for trajectory in trajectories_of(cells):
        for one, other in combinations([c for c, t in cells if t == trajectory], 2):
            pair = cells[one, trajectory], cells[other, trajectory]
            seeds = _shared(*pair)
            medians = [
                [float(np.median(score.L)) for score in on_seeds(v, seeds).scores.values()]
                for v in pair
            ]
            tau = float(stats.kendalltau(*medians).statistic)
            found.append(Agreement(trajectory, one, other, tau))
    return found


def _shared(*verdicts: Verdict) -> np.ndarray:
    """Seeds that all have."""
    return np.array([s for s in verdicts[0].seeds if all(s in v.seeds for v in verdicts[1:])])


def as_result(cells: Cells, family: str) -> dict[str, Any]:
    """All columns as JSON values: the content of verdict.json.

    `columns` is a list of `engine`, `model`, `seeds` and `trajectories.<name>`, each as the `sets`
    of result.json, with `falls_share` beside `falls`; `sets.<name>.against.<baseline>` has the
    counts of cells, the worst plant and the spreads; `kendall` is a list of pairs of columns.
    """
    names = sets_of(cells)
    by_column: list[dict[str, Any]] = []
    for column in columns_of(cells):
        own = {t: verdict for (c, t), verdict in cells.items() if c == column}
        seeds = next(iter(own.values())).seeds.tolist()
        each = {trajectory: _cell(verdict) for trajectory, verdict in own.items()}
        by_column.append({**column._asdict(), "seeds": seeds, "trajectories": each})
    result: dict[str, Any] = {"family": family, "columns": by_column, "sets": {}}
    for name in names:
        against = {}
        for baseline in (one for one in BASELINES if one in names and one != name):
            against[baseline] = {
                **tally(cells, name, baseline)._asdict(),
                "worst": _plain(worst(cells, name, baseline)),
                "spread": [one._asdict() for one in spreads(cells, name, baseline)],
            }
        total = falls(cells, name)
        result["sets"][name] = {**total._asdict(), "share": total.share._asdict()}
        result["sets"][name]["against"] = against
    return result | {"kendall": [_plain(one) for one in agreements(cells)]}


def _cell(verdict: Verdict) -> dict[str, Any]:
    sets = {}
    for name, worlds in metrics.as_result(verdict)["sets"].items():
        one, score = worlds["standin"], verdict.scores[name]
        one["falls_share"] = fall_share(one["falls"], len(verdict.seeds))._asdict()
        one["L"] |= {"median": float(np.median(score.L)), "by_seed": score.L.tolist()}
        sets[name] = one
    return sets


def _plain(value: Any) -> dict[str, Any]:
    """A named tuple as JSON values, columns in it too."""
    items = value._asdict().items()
    return {key: x._asdict() if isinstance(x, Column) else x for key, x in items}
