"""The four files of the table: report.md, table.csv, table.json and table.tex.

Each has all sets on all trajectories, with intervals and falls, beside the paper's losses. The
paper measured on a robot with other errors, so that only its changes in % can be compared with
ours, not its losses.
"""

import csv
import io
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import ChoiceLoader, FileSystemLoader

from hector_jax.core.files import write_file, write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.settings import read_json
from hector_jax.report.report import TEMPLATES, Picture, change_text, column, seeds_text, wins_text
from hector_jax.report.run import tuning_section
from hector_jax.tuning.difftune import Tuning
from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import BASELINES, Comparison, Summary, Verdict

PAPER = {
    "straight": {
        "nominal": (9.66e2, 9.01e2, 7.15e5, 2.78e8),
        "expert": (2.49e2, 4.09e2, 8.11e5, 1.08e8),
        "without": (1.78e2, 3.87e2, 7.77e5, 0.96e8),
        "with": (1.86e2, 3.38e2, 8.90e5, 0.87e8),
    },
    "c": {
        "nominal": (2.32e3, 1.54e2, 3.56e5, 2.63e8),
        "expert": (2.97e3, 0.66e2, 4.49e5, 3.11e8),
        "without": (3.01e3, 2.38e2, 4.76e5, 3.50e8),
        "with": (1.75e3, 0.47e2, 4.56e5, 1.85e8),
    },
    "s": {
        "nominal": (1.91e3, 8.05e2, 0.89e6, 3.53e8),
        "expert": (1.65e3, 4.06e2, 1.00e6, 2.47e8),
        "without": (2.74e3, 23.27e2, 0.73e6, 7.41e8),
        "with": (1.47e3, 2.86e2, 1.02e6, 2.05e8),
    },
}
"""L_Eul, L_pos, L_ctrl and L by trajectory and set, after ten iterations of the paper's rule: its
table of losses in experiments."""

PARTS = ("L_Eul", "L_pos", "L_ctrl", "L")  # in that order
TITLES = {"straight": "Straight line", "c": "C curve", "s": "S curve"}
OTHERS = {  # further sets to compare a set with, besides the baselines
    "with": ("paper", "without", "search_200", "search_2000"),
    "with_walks": ("with", "search_2000"),
}

Summaries = Mapping[tuple[str, str], Summary]  # by trajectory and set

_FOLDER = FileSystemLoader(Path(__file__).parent / "templates")
_MARKDOWN = TEMPLATES.overlay(loader=ChoiceLoader([_FOLDER, *filter(None, [TEMPLATES.loader])]))
# LaTeX has braces of its own
_TEX = _MARKDOWN.overlay(variable_start_string="<<", variable_end_string=">>")


class Fall(NamedTuple):
    """A walk that ended in a fall."""

    trajectory: str
    name: str  # of the set
    seed: int
    upright: float  # [s]
    height: float  # of the centre of mass in the last sample before the fall [m]
    roll: float  # [rad]
    pitch: float  # [rad]


class Search(NamedTuple):
    """A search without derivatives."""

    walks: int  # on the high-fidelity simulator
    best_at: int  # number of the best walk
    loss: float  # of the best walk
    stop: str


class Earlier(NamedTuple):
    """Order of the sets in an earlier table, on other plants."""

    plants: str  # family and seeds
    rankings: Mapping[str, Sequence[str]]  # by trajectory, best first


class Table(NamedTuple):
    """Contents of the four files."""

    verdicts: Mapping[str, Verdict]  # by trajectory, of one scene each
    falls: Sequence[Fall]
    tunings: Mapping[str, Mapping[str, Tuning]]  # by trajectory and set
    searches: Mapping[str, Search]  # by trajectory
    long_searches: Mapping[str, Search]  # by trajectory, if any
    pictures: Sequence[Picture]
    config: Mapping[str, Any]  # resolved, as JSON values
    environment: Mapping[str, str]
    commits: Sequence[str]  # of the results
    command: str  # that makes this table again
    earlier: Earlier | None = None
    family: str = "standin"  # of the plants

    @property
    def seeds(self) -> np.ndarray:
        """Seeds of the plants, the same on all trajectories."""
        return next(iter(self.verdicts.values())).seeds

    @property
    def units(self) -> dict[str, str]:
        """Units of the terms of the loss."""
        return {term.name: term.unit for term in next(iter(self.verdicts.values())).loss}


def paper_losses(trajectory: str, name: str) -> dict[str, float]:
    """Return the paper's losses beside those of a set, by part; empty if it has none.

    Those through its net stand beside the same rule (`paper`) and beside our own (`with`).
    """
    losses = PAPER.get(trajectory, {}).get("with" if name == "paper" else name, ())
    return dict(zip(PARTS, losses, strict=False))


def paper_change(trajectory: str, name: str, baseline: str, part: str = "L") -> float | None:
    """Return the change [%] of a part of the loss in the paper's table, from its rounded losses.

    None for a baseline against itself, and for a set that is not in that table.
    """
    losses, before = paper_losses(trajectory, name), paper_losses(trajectory, baseline)
    if name == baseline or not losses:
        return None
    return 100.0 * (losses[part] / before[part] - 1.0)


def summaries(verdicts: Mapping[str, Verdict]) -> dict[tuple[str, str], Summary]:
    """Summarize each set on each trajectory, against the baselines and its `OTHERS`."""
    return {
        (trajectory, name): metrics.summarize(verdict, name, (*BASELINES, *OTHERS.get(name, ())))
        for trajectory, verdict in verdicts.items()
        for name in verdict.scores
    }


def ranking(verdict: Verdict) -> list[str]:
    """Sort the sets from best to worst, by the median of L against nominal."""
    base = verdict.scores["nominal"].L
    return sorted(verdict.scores, key=lambda name: float(np.median(verdict.scores[name].L / base)))


def plants_text(seeds: str, family: str) -> str:
    """Name the plants of a table: their seeds, and their family if it is not `standin`."""
    return f"seeds {seeds}" + ("" if family == "standin" else f" of the family {family}")


def load_earlier(path: Path, seeds: Sequence[int], family: str = "standin") -> Earlier:
    """Read the order of the sets from a table.json of other plants than those of `seeds`.

    Raises:
        InputError: one line naming the file, if it cannot be read, is no table.json, or is of the
            same plants, on which the order is always the same.
    """
    table = read_json(path, "a table.json", 100_000_000)
    try:
        rankings = {name: list(row["ranking"]) for name, row in table["trajectories"].items()}
        plants = plants_text(str(table["seeds"]), table.get("family", "standin"))
        earlier = Earlier(plants, rankings)
    except (TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: not a table.json of experiments/table.py: {error!r}") from error
    if earlier.plants == plants_text(seeds_text(seeds), family):
        raise InputError(
            f"{path}: a table of the same plants, {earlier.plants}; expected others, to "
            "compare the order of the sets"
        )
    return earlier


def swapped_sets(
    verdicts: Mapping[str, Verdict], earlier: Earlier
) -> dict[str, list[tuple[str, str]] | None]:
    """Return pairs of sets whose order differs from an earlier table's, by trajectory.

    None for a trajectory that the earlier table does not have.
    """
    pairs: dict[str, list[tuple[str, str]] | None] = dict.fromkeys(verdicts)
    for trajectory in verdicts.keys() & earlier.rankings.keys():
        names = ranking(verdicts[trajectory])
        before = [name for name in earlier.rankings[trajectory] if name in names]
        couples = itertools.combinations(before, 2)
        pairs[trajectory] = [(a, b) for a, b in couples if names.index(a) > names.index(b)]
    return pairs


def write_table(folder: Path, table: Table) -> Path:
    """Write report.md, table.csv, table.json and table.tex, each whole or not at all.

    Args:
        folder: with the pictures.
        table: the contents.

    Returns:
        report.md.

    Raises:
        WriteError: a file cannot be written.
    """
    sets = summaries(table.verdicts)
    write_file(folder / "table.csv", _csv(table, sets).encode())
    write_json(folder / "table.json", _result(table, sets))
    write_file(folder / "table.tex", _tex(table, sets).encode())
    write_file(folder / "report.md", _report(table, sets).encode())
    return folder / "report.md"


def _report(table: Table, sets: Summaries) -> str:
    scores = [score for verdict in table.verdicts.values() for score in verdict.scores.values()]
    sections = [
        tuning_section(f"{trajectory}, {name}", tuning, where=_where(name))
        for trajectory, tunings in table.tunings.items()
        for name, tuning in tunings.items()
    ]
    return _MARKDOWN.get_template("table.md.j2").render(
        **table._asdict(),
        PAPER=PAPER,
        PARTS=PARTS,
        TITLES=TITLES,
        change_text=change_text,
        degrees=math.degrees,
        paper_change=paper_change,
        ranking=ranking,
        wins_text=wins_text,
        count=len(table.seeds),
        others=[
            (trajectory, name, other, comparison)
            for (trajectory, name), summary in sets.items()
            for other, comparison in summary.against.items()
            if other not in BASELINES
        ],
        residual=f"{max(float(score.residual.max()) for score in scores):.0e}",
        sections=sections,
        sets=sets,
        swapped=table.earlier and swapped_sets(table.verdicts, table.earlier),
        units=table.units,
    )


def _where(name: str) -> str:
    """Return where the loss of a tuning was computed, in words."""
    walks = "of its walks on the simulator, mean over their plants"
    return walks if name == "with_walks" else "on the model"


def _csv(table: Table, sets: Summaries) -> str:
    """Return a row per trajectory, set and part of the loss; changes in %."""
    others = list(dict.fromkeys((*BASELINES, *itertools.chain(*OTHERS.values()))))
    head = ["trajectory", "set", "part", "unit", "mean", "mean_low", "mean_high", "falls", "seeds"]
    for other in others:
        head += [f"{key}_{other}" for key in ("median", "low", "high", "wins", "counts")]
    rows: list[list[Any]] = [[*head, "paper", *(f"paper_{baseline}" for baseline in BASELINES)]]
    for (trajectory, name), summary in sets.items():
        paper = paper_losses(trajectory, name)
        for part in PARTS:
            row = [trajectory, name, part, table.units.get(part, ""), *summary.means[part]]
            row += [summary.falls, len(table.seeds)]
            for other in others:
                pair = summary.against.get(other)
                wins = pair.wins if pair and part == "L" else ""
                row += [*pair.change[part], wins, pair.counts] if pair else [""] * 5
            row.append(paper.get(part, ""))
            row += [paper_change(trajectory, name, baseline, part) for baseline in BASELINES]
            rows.append([_csv_number(cell) if isinstance(cell, float) else cell for cell in row])
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _csv_number(x: float) -> str:
    return f"{x:.6g}" if math.isfinite(x) else ""


def _result(table: Table, sets: Summaries) -> dict[str, Any]:
    """Return the table as JSON values, with every score by seed."""
    trajectories = {}
    for trajectory, verdict in table.verdicts.items():
        result: dict[str, Any] = {**metrics.verdict_result(verdict), "family": table.family}
        for name, score in verdict.scores.items():
            by_seed = {part: losses[:, 0].tolist() for part, losses in score.losses.items()}
            by_seed["fallen"] = score.fallen[:, 0].astype(bool).tolist()
            result["sets"][name]["standin"]["by_seed"] = by_seed
        result["against"] = {
            f"{name} against {other}": metrics.change_result(comparison)
            for name in verdict.scores
            for other, comparison in sets[trajectory, name].against.items()
            if other not in BASELINES
        }
        result["ranking"] = ranking(verdict)
        result["tunings"] = {
            name: {"iterations": len(tuning.iterations) - 1, "stop": tuning.reason}
            for name, tuning in table.tunings.get(trajectory, {}).items()
        }
        kinds = {"search_200": table.searches, "search_2000": table.long_searches}
        for key, searches in kinds.items():
            if trajectory in searches:
                result[key] = searches[trajectory]._asdict()
        trajectories[trajectory] = result
    return {
        "command": table.command,
        "environment": dict(table.environment),
        "commits": list(table.commits),
        "seeds": seeds_text(table.seeds),
        "family": table.family,
        "config": dict(table.config),
        "swapped": swapped_sets(table.verdicts, table.earlier) if table.earlier else None,
        "falls": [fall._asdict() for fall in table.falls],
        "trajectories": trajectories,
        "paper": {
            trajectory: {name: dict(zip(PARTS, losses, strict=True)) for name, losses in s.items()}
            for trajectory, s in PAPER.items()
        },
    }


_ESCAPES = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: "\\" + character for character in "&%$#_{}"},
}


def tex(text: str) -> str:
    """Escape text for LaTeX."""
    return "".join(_ESCAPES.get(character, character) for character in text)


def _tex_number(x: float) -> str:
    """Format three significant digits, without a power of ten."""
    digits = 2 - math.floor(math.log10(x)) if x > 0.0 else 0
    return f"{x:.{max(digits, 0)}f}"


def _tex_change(comparison: Comparison) -> str:
    value, *ends = comparison.change["L"].text().split(" ", 1)
    void = "" if comparison.counts else "$^{*}$"
    return " ".join(f"${text}$" for text in (value, *ends)) + void


def _tex(table: Table, sets: Summaries) -> str:
    """Return a tabular that needs no package; the smallest mean of a trajectory is bold."""
    count = len(table.seeds)
    powers = {p: column(p, *(s.means[p].value for s in sets.values())).power for p in PARTS}
    sections = {}
    for trajectory, verdict in table.verdicts.items():
        by_name = {name: sets[trajectory, name] for name in verdict.scores}
        least = {part: min(s.means[part].value for s in by_name.values()) for part in PARTS}
        rows = []
        for name, summary in by_name.items():
            cells = [tex(name)]
            for part in PARTS:
                value = summary.means[part].value
                text = _tex_number(value / 10.0 ** powers[part])
                cells.append(rf"\textbf{{{text}}}" if value == least[part] else text)
            cells.append(f"{summary.falls}/{count}")
            for baseline in BASELINES:
                pair = summary.against.get(baseline)
                wins = wins_text(pair, count).replace(" ", "") if pair else "--"
                paper = paper_change(trajectory, name, baseline)
                cells += [_tex_change(pair) if pair else "--", wins]
                cells.append("--" if paper is None else f"${paper:+.1f}$")
            rows.append(cells)
        sections[tex(TITLES.get(trajectory, trajectory))] = rows
    return _TEX.get_template("table.tex.j2").render(
        plants=plural(count, "plant"),
        seeds=seeds_text(table.seeds),
        units=table.units,
        powers=powers,
        baselines=BASELINES,
        sections=sections,
    )
