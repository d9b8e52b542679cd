"""Comparison of weight sets in several engines and models: scores of walks, column by column.

A column is a physics engine with a model of the robot; a cell is a column on one trajectory, with
the walks of all sets on the same plants (a `Verdict` of one scene). Cells are not independent of
each other: plants of one seed are drawn alike in all columns. The differences between columns show
whether a change of the loss is due to the weights or to one simulator:

- the spread: the largest difference between engines of the median change on the same plants of the
  same model, beside the gain, the smallest reduction in any of these engines;
- Kendall's tau of the order of the sets by their median L, between every two columns.
"""

from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import BASELINES, COVERAGE, Interval, Verdict

OWN = "own"  # the model of the robot's file
LOWER, MAYBE_LOWER, NOT_LOWER = "lower", "maybe lower", "not lower"
"""Claims about a set in all cells: every interval is below zero; every median is; neither."""
FEWEST_SETS = 3  # for which Kendall's tau is computed


class Column(NamedTuple):
    """World in which all sets walk."""

    engine: str
    model: str  # OWN, or the name of another model of the robot


Columns = Mapping[Column, Verdict]
"""Walks of all sets on all trajectories, by column."""
Cells = Mapping[tuple[Column, str], Verdict]
"""Walks of all sets, by column and trajectory."""


class Tally(NamedTuple):
    """Counts of cells by the sign of the median change of a set against a baseline."""

    cells: int
    below: int  # comparable, median below zero
    clear: int  # comparable, interval below zero
    above: int  # comparable, interval above zero
    void: int  # not comparable because of falls


class Falls(NamedTuple):
    """Falls of a set in some cells."""

    falls: int  # walks that end in one
    walks: int
    fallen_plants: int  # seeds with a fall in at least one cell
    plants: int  # seeds
    share_of_plants: Interval


class Worst(NamedTuple):
    """The walk with the largest L against that of the baseline on the same plant."""

    column: Column
    trajectory: str
    seed: int
    change: float  # [%]
    fallen: bool


class Spread(NamedTuple):
    """Difference between engines in the change of a set on one trajectory and model."""

    trajectory: str
    model: str
    gain: float  # [%] smallest reduction of L in any of the engines
    spread: float  # [percentage points] largest difference of the change

    @property
    def is_small(self) -> bool:
        """True if the gain is at least twice the spread."""
        return self.gain >= 2.0 * self.spread


class Agreement(NamedTuple):
    """Similarity of the order of the sets in two columns."""

    trajectory: str
    one: Column
    other: Column
    tau: float  # Kendall's: 1 for the same order, -1 for the reverse one


class Against(NamedTuple):
    """What the walks say of a set against a baseline."""

    tally: Tally
    above: list[tuple[Column, str]]  # cells with the whole interval above zero
    void: list[tuple[Column, str]]  # cells that falls make no comparison
    worst: Worst
    spreads: list[Spread]

    @property
    def claim(self) -> str:
        """What may be said of all cells: LOWER, MAYBE_LOWER or NOT_LOWER."""
        if self.tally.clear == self.tally.cells:
            return LOWER
        return MAYBE_LOWER if self.tally.below == self.tally.cells else NOT_LOWER

    @property
    def widest(self) -> Spread:
        """The largest spread between engines; there is one where several engines walk."""
        return sorted(self.spreads, key=lambda spread: spread.spread)[-1]

    @property
    def small(self) -> int:
        """Number of trajectories and models in which the spread is small beside the gain."""
        return sum(spread.is_small for spread in self.spreads)


class Judgement(NamedTuple):
    """What walks in several engines and models say, and of which sets it is told in words."""

    against: dict[tuple[str, str], Against]  # by set and baseline
    told: list[tuple[str, str]]  # the pairs of `against` that are told
    falls: dict[str, Falls]  # by set
    agreements: list[Agreement]

    @property
    def least(self) -> Agreement | None:
        """The two columns that order the sets least alike; None for fewer than 3 sets."""
        return min(self.agreements, key=lambda agreement: agreement.tau, default=None)


def cells_of(columns: Columns) -> Cells:
    """Return the walks of each column on each trajectory."""
    return {(c, t): verdict.of_scene(t) for c, verdict in columns.items() for t in verdict.scenes}


def columns_of(cells: Cells) -> list[Column]:
    """Return the columns, in order."""
    return list(dict.fromkeys(column for column, _ in cells))


def trajectories_of(cells: Cells) -> list[str]:
    """Return the trajectories, in order."""
    return list(dict.fromkeys(trajectory for _, trajectory in cells))


def sets_of(cells: Cells) -> list[str]:
    """Return the weight sets, in order."""
    return list(next(iter(cells.values())).scores)


def judge_cells(cells: Cells) -> Judgement:
    """Judge every set against every baseline that has walked."""
    names = sets_of(cells)
    pairs = [(n, b) for n in names for b in BASELINES if b in names and b != n]
    return Judgement(
        {(n, b): against(cells, n, b) for n, b in pairs},
        [(n, b) for n, b in pairs if n not in BASELINES] or pairs[-1:],
        {name: falls(cells, name) for name in names},
        agreements(cells),
    )


def against(cells: Cells, name: str, baseline: str) -> Against:
    """Judge a set against a baseline."""
    changes = {cell: metrics.compare(verdict, name, baseline) for cell, verdict in cells.items()}
    intervals = {cell: c.change["L"] for cell, c in changes.items() if c.counts}
    above = [cell for cell, interval in intervals.items() if interval.low > 0.0]
    void = [cell for cell in cells if cell not in intervals]
    tally = Tally(
        cells=len(cells),
        below=sum(interval.value < 0.0 for interval in intervals.values()),
        clear=sum(interval.high < 0.0 for interval in intervals.values()),
        above=len(above),
        void=len(void),
    )
    differ = spreads(cells, name, baseline)
    return Against(tally, above, void, worst(cells, name, baseline), differ)


def falls(cells: Cells, name: str) -> Falls:
    """Count the falls of a set in some cells, and the plants on which it falls."""
    seeds = np.concatenate([np.repeat(v.seeds, len(v.scenes)) for v in cells.values()])
    fallen = np.concatenate([v.scores[name].fallen.ravel() for v in cells.values()])
    fell, plants = len(set(seeds[fallen])), len(set(seeds))
    return Falls(int(fallen.sum()), len(seeds), fell, plants, fall_share(fell, plants))


def fall_share(fallen: int, plants: int) -> Interval:
    """Return the share of plants with a fall, with its exact (Clopper-Pearson) interval.

    >>> round(fall_share(0, 10).high, 4)  # 1 - 0.025^(1/10)
    0.3085
    """
    from scipy import stats  # takes most of a second to import

    ends = stats.binomtest(fallen, plants).proportion_ci(COVERAGE, method="exact")
    return Interval(fallen / plants, float(ends.low), float(ends.high))


def worst(cells: Cells, name: str, baseline: str) -> Worst:
    """Return the worst plant of a set against a baseline, with falls as charged by the loss."""
    candidates = []
    for (column, trajectory), verdict in cells.items():
        score = verdict.scores[name]
        change = 100.0 * (score.L / verdict.scores[baseline].L - 1.0)
        i = int(np.argmax(change))
        seed, fallen = int(verdict.seeds[i]), bool(score.fallen[i, 0])
        candidates.append(Worst(column, trajectory, seed, float(change[i, 0]), fallen))
    return max(candidates, key=lambda candidate: candidate.change)


def spreads(cells: Cells, name: str, baseline: str) -> list[Spread]:
    """Return the spread between engines for each trajectory and model with several engines."""
    result = []
    for trajectory in trajectories_of(cells):
        for model in dict.fromkeys(column.model for column in columns_of(cells)):
            verdicts = [v for (c, t), v in cells.items() if (c.model, t) == (model, trajectory)]
            if len(verdicts) < 2:
                continue
            losses = _losses_on_shared_seeds(verdicts)
            medians = [100.0 * float(np.median(L[name] / L[baseline]) - 1.0) for L in losses]
            gain, spread = -max(medians), max(medians) - min(medians)
            result.append(Spread(trajectory, model, gain, spread))
    return result


def agreements(cells: Cells) -> list[Agreement]:
    """Return Kendall's tau of all pairs of columns per trajectory; empty for fewer than 3 sets."""
    if len(sets_of(cells)) < FEWEST_SETS:
        return []
    from scipy import stats  # takes most of a second to import

    result = []
    for trajectory in trajectories_of(cells):
        for first, second in combinations([c for c, t in cells if t == trajectory], 2):
            verdicts = [cells[first, trajectory], cells[second, trajectory]]
            losses = _losses_on_shared_seeds(verdicts)
            one, other = ([float(np.median(L)) for L in by_set.values()] for by_set in losses)
            tau = float(stats.kendalltau(one, other).statistic)
            result.append(Agreement(trajectory, first, second, tau))
    return result


def _losses_on_shared_seeds(verdicts: Sequence[Verdict]) -> list[dict[str, np.ndarray]]:
    """Return L of verdicts by set, on the seeds that all of the verdicts have."""
    seeds = reduce(np.intersect1d, [verdict.seeds for verdict in verdicts])
    rows = [np.isin(verdict.seeds, seeds) for verdict in verdicts]
    inputs = zip(verdicts, rows, strict=True)
    return [{name: score.L[at] for name, score in v.scores.items()} for v, at in inputs]


def matrix_result(cells: Cells, judgement: Judgement, world: str) -> dict[str, Any]:
    """Return all columns as JSON values: `world` and what follows, of verdict.json.

    `columns` is a list of `engine`, `model`, `seeds` and `trajectories.<name>`, each as the `sets`
    of result.json, with `falls_share` and `fallen_by_seed` beside `falls`; `sets.<name>` has the
    `Falls` in all cells, `.against.<baseline>` the counts of cells, the worst plant and the
    spreads; `kendall` is a list of pairs of columns.
    """
    columns: list[dict[str, Any]] = []
    for column in columns_of(cells):
        verdicts = {t: verdict for (c, t), verdict in cells.items() if c == column}
        seeds = next(iter(verdicts.values())).seeds.tolist()
        trajectories = {trajectory: _cell(verdict) for trajectory, verdict in verdicts.items()}
        columns.append({**column._asdict(), "seeds": seeds, "trajectories": trajectories})
    sets = {name: {**_plain(count), "against": {}} for name, count in judgement.falls.items()}
    for (name, baseline), row in judgement.against.items():
        sets[name]["against"][baseline] = {
            **row.tally._asdict(),
            "worst": _plain(row.worst),
            "spread": [spread._asdict() for spread in row.spreads],
        }
    kendall = [_plain(agreement) for agreement in judgement.agreements]
    return {"world": world, "columns": columns, "sets": sets, "kendall": kendall}


def _cell(verdict: Verdict) -> dict[str, Any]:
    """Return the sets of a verdict as JSON values."""
    sets = {}
    for name in verdict.scores:
        row, score = metrics.set_result(verdict, name), verdict.scores[name]
        row["falls_share"] = fall_share(row["falls"], len(verdict.seeds))._asdict()
        row["fallen_by_seed"] = score.fallen[:, 0].tolist()
        row["L"] |= {"median": float(np.median(score.L)), "by_seed": score.L[:, 0].tolist()}
        sets[name] = row
    return sets


def _plain(value: Any) -> dict[str, Any]:
    """Return a named tuple, and the columns or intervals in it, as JSON values."""
    items = value._asdict().items()
    return {key: x._asdict() if isinstance(x, Column | Interval) else x for key, x in items}
