"""The report of weight sets in several engines and models: one page, its numbers, one picture."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.core.files import write_file, write_json
from hector_jax.core.inputs import plural
from hector_jax.report import plots
from hector_jax.report.report import (
    Picture,
    change_text,
    markdown_table,
    render,
    seeds_text,
)
from hector_jax.runs import matrix
from hector_jax.runs.matrix import OWN, Cells, Column
from hector_jax.runs.metrics import BASELINES, FEWEST, Interval, compare
from hector_jax.sim.engine import ENGINES

TITLES = {name: engine.title for name, engine in ENGINES.items()}
_COARSE = 8  # fewer plants have a coarse interval
LEARNED_FROM = ("c", "mjx")  # engines whose walks nets and searches of this project use


def title_of(column: Column) -> str:
    """A column in words: its engine, and its model where it is not the robot's own."""
    engine = TITLES.get(column.engine, column.engine)
    return engine if column.model == OWN else f"{engine}, {column.model}"


def cell_text(cell: tuple[Column, str]) -> str:
    """A cell in words."""
    column, trajectory = cell
    return f"{trajectory} in {title_of(column)}"


def share_text(share: Interval) -> str:
    """A share of walks with its interval, in %.

    >>> share_text(Interval(0.125, 0.003, 0.527))
    '12.5 [0.3, 52.7] %'
    """
    value, low, high = (f"{100 * x:.1f}" for x in share)
    return f"{value} [{low}, {high}] %"


def claims(cells: Cells, differs: Mapping[str, str], family: str) -> list[str]:
    """What may be claimed, line by line."""
    return _lines("claims.txt.j2", cells, differs, family)


def limits(cells: Cells, differs: Mapping[str, str], family: str) -> list[str]:
    """What may not be claimed, line by line.

    Args:
        cells: the walks.
        differs: what plants have otherwise in an engine than in MuJoCo C, by its name.
        family: of the plants.
    """
    return _lines("limits.txt.j2", cells, differs, family)


def _lines(template: str, cells: Cells, differs: Mapping[str, str], family: str) -> Any:
    names = matrix.sets_of(cells)
    pairs = [(n, b) for n in names for b in BASELINES if b in names and b != n]
    pairs = [(n, b) for n, b in pairs if n not in BASELINES] or pairs[-1:]
    every = matrix.columns_of(cells)
    verdicts = {column: next(v for (c, _), v in cells.items() if c == column) for column in every}
    changes = {pair: matrix.changes(cells, *pair) for pair in pairs}
    text = render(
        template,
        above={
            pair: [c for c, one in of.items() if one.counts and one.change["L"].low > 0.0]
            for pair, of in changes.items()
        },
        agreements=matrix.agreements(cells),
        cell_text=cell_text,
        engines=list(dict.fromkeys(column.engine for column in every)),
        ENGINES=TITLES,
        falls={name: matrix.falls(cells, name) for name in names},
        family=family,
        coarse=[c for c, verdict in verdicts.items() if FEWEST <= len(verdict.seeds) < _COARSE],
        few=[c for c, verdict in verdicts.items() if len(verdict.seeds) < FEWEST],
        differs=differs,
        LEARNED_FROM=LEARNED_FROM,
        models=list(dict.fromkeys(column.model for column in every)),
        pairs=pairs,
        seeds={column: seeds_text(verdict.seeds) for column, verdict in verdicts.items()},
        share_text=share_text,
        spreads={pair: matrix.spreads(cells, *pair) for pair in pairs},
        tallies={pair: matrix.tally(cells, *pair) for pair in pairs},
        title_of=title_of,
        void={pair: [c for c, one in of.items() if not one.counts] for pair, of in changes.items()},
        tuned=[name for name in names if name not in BASELINES],
        worst={pair: matrix.worst(cells, *pair) for pair in pairs},
    )
    return [line for line in text.splitlines() if line]


def tables(cells: Cells) -> dict[str, str]:
    """A table in Markdown for each trajectory: a row for each column and set."""
    names = matrix.sets_of(cells)
    others = [name for name in BASELINES if name in names]
    head = ["engine and model", "set", "median L", *(f"against {one} [%]" for one in others)]
    found = {}
    for trajectory in matrix.trajectories_of(cells):
        rows = []
        for (column, walked), verdict in cells.items():
            if walked != trajectory:
                continue
            for name, score in verdict.scores.items():
                against = [
                    "" if one == name else change_text(compare(verdict, name, one))
                    for one in others
                ]
                fell, count = int(score.fallen.sum()), len(verdict.seeds)
                share = share_text(matrix.fall_share(fell, count))
                median = f"{np.median(score.L) / 1e6:.3g}e6"
                rows.append([title_of(column), name, median, *against, f"{fell} / {count}", share])
        found[trajectory] = markdown_table([*head, "falls", "share of falls"], rows, words=2)
    return found


def print_verdict(cells: Cells, differs: Mapping[str, str], family: str) -> None:
    """Print the change of every set in every cell, and what may be claimed."""
    baseline = BASELINES[0]
    print(f"change of L against {baseline} in %, with falls where there are any")
    for cell, verdict in cells.items():
        texts = []
        for name in (name for name in verdict.scores if name != baseline):
            fell = int(verdict.scores[name].fallen.sum())
            text = change_text(compare(verdict, name, baseline), void=" *")
            texts.append(f"{name} {text}" + f" ({plural(fell, 'fall')})" * bool(fell))
        print(f"{cell_text(cell):32s} {'   '.join(texts)}")
    for line in claims(cells, differs, family):
        print(line)


def write_report(
    folder: Path,
    cells: Cells,
    *,
    family: str,
    differs: Mapping[str, str],
    config: Mapping[str, Any],
    environment: Mapping[str, str],
    command: str,
) -> dict[str, Any]:
    """Write report.md, verdict.json and verdict.png; returns the content of verdict.json.

    Args:
        folder: where to.
        cells: the walks.
        family: of the plants.
        differs: what plants have otherwise in an engine than in MuJoCo C, by its name.
        config: the flags, as JSON values.
        environment: versions and machine.
        command: that makes the report again.
    """
    known = cells, differs, family
    result = matrix.as_result(cells, family) | {
        "differs": dict(differs),
        "claims": claims(*known),
        "limits": limits(*known),
        "config": dict(config),
        "environment": dict(environment),
    }
    picture = Picture("verdict.png", plots.matrix(folder / "verdict.png", cells, title_of))
    every = matrix.columns_of(cells)
    text = render(
        "matrix.md.j2",
        claims=result["claims"],
        limits=result["limits"],
        pictures=[picture],
        tables=tables(cells),
        config=config,
        environment=environment,
        command=command,
        names=matrix.sets_of(cells),
        trajectories=matrix.trajectories_of(cells),
        count=len(every),
        walks=sum(len(v.scores) * len(v.seeds) for v in cells.values()),
    )
    write_json(folder / "verdict.json", result)
    write_file(folder / "report.md", text.encode())
    return result
