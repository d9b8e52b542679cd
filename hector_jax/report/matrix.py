"""The report of an evaluation in several engines and models: a page, its numbers and a picture."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.core.files import write_file, write_json
from hector_jax.core.inputs import plural
from hector_jax.report import plots
from hector_jax.report.report import Picture, change_text, markdown_table, render, seeds_text
from hector_jax.sim.engine import ENGINES
from hector_jax.verdict import matrix
from hector_jax.verdict.matrix import OWN, Cells, Column, Columns, Judgement
from hector_jax.verdict.metrics import (
    BASELINES,
    FEWEST,
    Interval,
    baseline_of,
    compare,
    fixed_rank,
)
from hector_jax.verdict.stopping import claims_of

TITLES = {name: engine.title for name, engine in ENGINES.items()}
LEARNED_FROM = ("c", "mjx")  # engines whose walks train the nets and tune weights


def title_of(column: Column) -> str:
    """Return the title of a column: its engine, and its model unless it is the robot's own."""
    engine = TITLES.get(column.engine, column.engine)
    return engine if column.model == OWN else f"{engine}, {column.model}"


def cell_text(cell: tuple[Column, str]) -> str:
    """Return the title of a cell: its trajectory and column."""
    column, trajectory = cell
    return f"{trajectory} in {title_of(column)}"


def share_text(share: Interval) -> str:
    """Format a share of plants with its interval, in %.

    >>> share_text(Interval(0.125, 0.003, 0.527))
    '12.5 [0.3, 52.7] %'
    """
    value, low, high = (f"{100 * x:.1f}" for x in share)
    return f"{value} [{low}, {high}] %"


def claims(
    cells: Cells, judgement: Judgement, differs: Mapping[str, str], world: str
) -> dict[str, list[str]]:
    """List the `claims` that the walks support, and their `limits`.

    Args:
        cells: the walks.
        judgement: what they say.
        differs: differences of the plants in an engine from those in MuJoCo C, by its name.
        world: world of the plants.
    """
    verdicts = {column: verdict for (column, _), verdict in cells.items()}
    engines = list(dict.fromkeys(column.engine for column in verdicts))
    titles = {name: TITLES.get(name, name) for name in engines}
    facts = {
        "own_only": {column.model for column in verdicts} == {OWN},
        "few": [title_of(c) for c, verdict in verdicts.items() if len(verdict.seeds) < FEWEST],
        "seeds": list(dict.fromkeys(seeds_text(v.seeds) for v in verdicts.values())),
        "learned_from": [titles[name] for name in engines if name in LEARNED_FROM],
        "tuned": [name for name in judgement.falls if name not in BASELINES],
        "baseline": baseline_of(judgement.falls),
        "stopped": any(verdict.rank is not fixed_rank for verdict in cells.values()),
        "differs": {TITLES.get(name, name): text for name, text in differs.items()},
    }
    fill = partial(render, judgement=judgement, engines=list(titles.values()), world=world, **facts)
    words = {"cell_text": cell_text, "share_text": share_text, "title_of": title_of}
    texts = {name: fill(f"{name}.txt.j2", **words) for name in ("claims", "limits")}
    return {name: [x for x in text.splitlines() if x] for name, text in texts.items()}


def tables(cells: Cells) -> dict[str, str]:
    """Return a Markdown table by trajectory, with a row for each column and set."""
    names = matrix.sets_of(cells)
    baselines = [name for name in BASELINES if name in names]
    against = [f"against {baseline} [%]" for baseline in baselines]
    head = ["engine and model", "set", "median L", *against, "falls", "share of falls"]
    rows: dict[str, list[list[str]]] = {name: [] for name in matrix.trajectories_of(cells)}
    for (column, trajectory), verdict in cells.items():
        for name, score in verdict.scores.items():
            changes = [
                "" if baseline == name else change_text(compare(verdict, name, baseline))
                for baseline in baselines
            ]
            falls, count = int(score.fallen.sum()), len(verdict.seeds)
            share = share_text(matrix.fall_share(falls, count))
            cell = [title_of(column), name, f"{np.median(score.L) / 1e6:.3g}e6", *changes]
            rows[trajectory].append([*cell, f"{falls} / {count}", share])
    return {trajectory: markdown_table(head, lines, words=2) for trajectory, lines in rows.items()}


def print_matrix(cells: Cells, lines: Iterable[str]) -> None:
    """Print the change of every set in every cell, and the claims, a line each."""
    baseline = baseline_of(matrix.sets_of(cells))
    print(f"change of L against {baseline} in %, with falls where there are any")
    for cell, verdict in cells.items():
        texts = []
        for name in (name for name in verdict.scores if name != baseline):
            falls = int(verdict.scores[name].fallen.sum())
            text = change_text(compare(verdict, name, baseline), void=" *")
            texts.append(f"{name} {text}" + f" ({plural(falls, 'fall')})" * bool(falls))
        print(f"{cell_text(cell):32s} {'   '.join(texts)}")
    print("\n".join(lines))


def matrix_report(cells: Cells, differs: Mapping[str, str], world: str) -> dict[str, Any]:
    """Return an evaluation as JSON values: `matrix_result`, the claims and their limits.

    Args:
        cells: the walks.
        differs: differences of the plants in an engine from those in MuJoCo C, by its name.
        world: world of the plants.
    """
    judgement = matrix.judge_cells(cells)
    told = claims(cells, judgement, differs, world)
    return matrix.matrix_result(cells, judgement, world) | {"differs": dict(differs), **told}


def stopping_result(
    columns: Columns, planned: Mapping[Column, Sequence[int]]
) -> list[dict[str, Any]]:
    """Return where each column stopped and why, as JSON values: `stopping` of verdict.json.

    Args:
        columns: the walks.
        planned: seeds of the plants that would have walked in each column.
    """
    result = []
    for column, verdict in columns.items():
        plants, most = len(verdict.seeds), len(planned[column])
        per_plant = len(verdict.scores) * len(verdict.scenes)
        numbers = {"plants": plants, "most_plants": most}
        numbers |= {"walks": per_plant * plants, "walks_saved": per_plant * (most - plants)}
        against = {"baseline": baseline_of(verdict.scores), "claims": claims_of(verdict)}
        result.append({**column._asdict(), **numbers, **against})
    return result


def stopping_lines(stops: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say where each column stopped and why, a line each."""
    titles = [title_of(Column(stop["engine"], stop["model"])) for stop in stops]
    return render("stopping.txt.j2", stops=stops, titles=titles).splitlines()


def write_matrix_report(
    folder: Path, cells: Cells, result: Mapping[str, Any], command: str
) -> None:
    """Write report.md, verdict.json and verdict.png.

    Args:
        folder: output folder.
        cells: the walks.
        result: their `matrix_report`, with the flags as `config` and the machine as `environment`.
        command: command line that repeats the evaluation.
    """
    picture = Picture("verdict.png", plots.save_matrix(folder / "verdict.png", cells, title_of))
    text = render(
        "matrix.md.j2",
        **{name: result[name] for name in ("claims", "limits", "config", "environment")},
        pictures=[picture],
        tables=tables(cells),
        command=command,
        names=matrix.sets_of(cells),
        trajectories=matrix.trajectories_of(cells),
        count=len(matrix.columns_of(cells)),
        walks=sum(len(v.scores) * v.walks for v in cells.values()),
    )
    write_json(folder / "verdict.json", result)
    write_file(folder / "report.md", text.encode())
