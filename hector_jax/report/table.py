"""The paper's table, made again: all sets on three trajectories, with intervals and every fall.

One result is told four times, as report.md, table.csv, table.json and table.tex; the paper's own
losses stand beside it. The paper measured on a robot with other errors, so its losses are not to be
compared with ours, but its changes in % are.
"""

import csv
import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hector_jax.core.files import write_file, write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.settings import read_json
from hector_jax.report.report import (
    STAND_IN,
    VOID,
    Picture,
    change_text,
    errors_of_tracking,
    legend,
    markdown_table,
    parts_table,
    percent,
    seeds_text,
    tuning_section,
    verdict_table,
)
from hector_jax.runs import metrics
from hector_jax.runs.metrics import BASELINES, Comparison, Interval, Verdict
from hector_jax.tuning.difftune import Tuning
from hector_jax.tuning.loss import PAPER_LOSS

PAPER = {
    "straight": {
        "nominal": (9.66e2, 9.01e2, 7.15e5, 2.78e8),
        "expert": (2.49e2, 4.09e2, 8.11e5, 1.08e8),
        "without_ten": (1.78e2, 3.87e2, 7.77e5, 0.96e8),
        "with_ten": (1.86e2, 3.38e2, 8.90e5, 0.87e8),
    },
    "c": {
        "nominal": (2.32e3, 1.54e2, 3.56e5, 2.63e8),
        "expert": (2.97e3, 0.66e2, 4.49e5, 3.11e8),
        "without_ten": (3.01e3, 2.38e2, 4.76e5, 3.50e8),
        "with_ten": (1.75e3, 0.47e2, 4.56e5, 1.85e8),
    },
    "s": {
        "nominal": (1.91e3, 8.05e2, 0.89e6, 3.53e8),
        "expert": (1.65e3, 4.06e2, 1.00e6, 2.47e8),
        "without_ten": (2.74e3, 23.27e2, 0.73e6, 7.41e8),
        "with_ten": (1.47e3, 2.86e2, 1.02e6, 2.05e8),
    },
}
"""L_Eul, L_pos, L_ctrl and L by trajectory and set: the paper's table of losses in experiments."""

_UNITS = {term.name: term.unit for term in PAPER_LOSS} | {"L": ""}
_ORDER = tuple(_UNITS)  # the paper's
_RIVALS = ("without", "searched", "ceiling")  # that `with` is held against besides the baselines
_TRAJECTORIES = {"straight": "Straight line", "c": "C curve", "s": "S curve"}


_SETS = """What the sets are, and what each costs in walks on the simulator:

- `nominal`, `expert`: flat weights that walk; those that the robot's laboratory published.
- `without_ten`, `without`: DiffTune from nominal on the plain rigid body, ten iterations and to
  convergence; no walk.
- `with_ten`, `with`: the same through GRFM-Net, which learned from 64 walks for all trajectories.
- `with_walks`: `with`, stepped further along measured walks, a few on each step; to be compared
  with searches by its walks too.
- `searched`: the best of a short CMA-ES search; `ceiling`: that of a long one. Their walks are
  told under "Search and tuning"."""


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
    """What a search without derivatives did."""

    walks: int  # on the high-fidelity simulator
    best_at: int  # the walk that was the best
    loss: float  # of it
    stop: str


class Earlier(NamedTuple):
    """An earlier table, on other plants, to hold the order of the sets against."""

    seeds: str
    rankings: Mapping[str, Sequence[str]]  # by trajectory, see `ranking`


class Table(NamedTuple):
    """All that is told."""

    verdicts: Mapping[str, Verdict]  # by trajectory
    falls: Sequence[Fall]
    tunings: Mapping[str, Mapping[str, Tuning]]  # by trajectory and set
    searches: Mapping[str, Search]  # by trajectory
    ceilings: Mapping[str, Search]  # long ones, by trajectory, where there are any
    pictures: Sequence[Picture]
    config: Mapping[str, Any]  # resolved, as JSON values
    environment: Mapping[str, str]
    commits: Sequence[str]  # at which the results were made that are told
    command: str  # that makes this table again
    earlier: Earlier | None = None


class Line(NamedTuple):
    """One set on one trajectory."""

    means: dict[str, Interval]  # by part
    falls: int
    seeds: int
    against: dict[str, Comparison]  # by the other set


class Bar(NamedTuple):
    """Something the table has to show."""

    trajectory: str
    text: str
    measured: str
    holds: bool | None  # None where a set it needs was not walked, or too few plants


def paper_change(trajectory: str, name: str, baseline: str, part: str = "L") -> float:
    """Change [%] of a part of the loss in the paper's table, from its rounded losses."""
    at = _ORDER.index(part)
    return 100.0 * (PAPER[trajectory][name][at] / PAPER[trajectory][baseline][at] - 1.0)


def lines(verdicts: Mapping[str, Verdict]) -> dict[tuple[str, str], Line]:
    """Each set on each trajectory, against the baselines; `with` against its rivals too."""
    found = {}
    for trajectory, verdict in verdicts.items():
        for name in verdict.scores:
            others = [*BASELINES, *(_RIVALS if name == "with" else ())]
            others += ["without_ten"] if name == "with_ten" else []
            others += ["with", "ceiling"] if name == "with_walks" else []
            found[trajectory, name] = Line(
                {part: metrics.mean(verdict, name, part) for part in _ORDER},
                int(verdict.scores[name].fallen.sum()),
                len(verdict.seeds),
                {
                    other: metrics.compare(verdict, name, other)
                    for other in others
                    if other in verdict.scores and other != name
                },
            )
    return found


def _bar(
    line: Line | None, trajectory: str, text: str, other: str, most: float, part: str = "L"
) -> Bar:
    """Whether the median change [%] against another set is `most` or less."""
    if line is None or other not in line.against:
        return Bar(trajectory, text, "not walked", None)
    comparison = line.against[other]
    change = comparison.change[part]
    void = "" if comparison.counts else ", void: the falls differ"
    holds = comparison.counts and change.value <= most
    return Bar(trajectory, text, f"{change_text(change)} %{void}", holds)


def bars(found: Mapping[tuple[str, str], Line]) -> list[Bar]:
    """What the converged `with` has to show on each trajectory, and whether it does."""
    told = []
    for t in dict.fromkeys(trajectory for trajectory, _ in found):
        line, expert = found.get((t, "with")), found.get((t, "expert"))
        clear = _bar(line, t, "`with` below `without`, interval clear of zero", "without", 0.0)
        if line is not None and clear.holds:
            high = line.against["without"].change["L"].high
            clear = clear._replace(holds=None if math.isnan(high) else high < 0.0)
        told += [
            _bar(line, t, "`with` at least 60 % below nominal", "nominal", -60.0),
            _bar(line, t, "`with` at least 40 % below expert", "expert", -40.0),
            _bar(line, t, "L_ctrl of `with` at most 9 % above expert", "expert", 9.0, "L_ctrl"),
            clear,
            _bar(line, t, "`with` at most 15 % above `ceiling`", "ceiling", 15.0),
        ]
        text = "`with` falls no more often than expert"
        if line is None or expert is None:
            told.append(Bar(t, text, "not walked", None))
        else:
            measured = f"{line.falls} against {expert.falls} of {line.seeds}"
            told.append(Bar(t, text, measured, line.falls <= expert.falls))
    return told


def aims(found: Mapping[tuple[str, str], Line]) -> list[Bar]:
    """What is hoped for beyond the bars: the paper's figures after ten iterations, 70 and 45 %."""
    told = []
    for t in dict.fromkeys(trajectory for trajectory, _ in found):
        for baseline in BASELINES:
            paper = paper_change(t, "with_ten", baseline)
            text = f"`with_ten` further below {baseline} than the paper's {-paper:.1f} %"
            told.append(_bar(found.get((t, "with_ten")), t, text, baseline, paper))
        for baseline, aim in zip(BASELINES, (70.0, 45.0), strict=True):
            text = f"`with` at least {aim:.0f} % below {baseline}"
            told.append(_bar(found.get((t, "with")), t, text, baseline, -aim))
    return told


def ranking(verdict: Verdict) -> list[str]:
    """The sets from the best to the worst, by the median over seeds of L against nominal."""
    base = verdict.scores["nominal"].L
    return sorted(verdict.scores, key=lambda name: float(np.median(verdict.scores[name].L / base)))


def load_earlier(path: Path, seeds: Sequence[int]) -> Earlier:
    """The order of the sets in a table.json of other plants than those of `seeds`.

    Raises:
        InputError: one line naming the file, where it cannot be read, is no such file, or is of the
            same plants, on which the order would be the same by itself.
    """
    earlier = _load_earlier(path)
    if earlier.seeds == seeds_text(seeds):
        raise InputError(
            f"{path}: a table of the same plants, seeds {earlier.seeds}; expected others, to "
            "compare the order of the sets"
        )
    return earlier


def _load_earlier(path: Path) -> Earlier:
    told = read_json(path, "a table.json", 100_000_000)
    try:
        rankings = {name: list(one["ranking"]) for name, one in told["trajectories"].items()}
        return Earlier(str(told["seeds"]), rankings)
    except (TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path}: not a table.json of `hector table`: {error!r}") from error


def same_order(verdicts: Mapping[str, Verdict], earlier: Earlier) -> list[Bar]:
    """Whether the sets that both tables have stand in the same order."""
    told = []
    for trajectory, verdict in verdicts.items():
        text = f"sets in the same order as on seeds {earlier.seeds}"
        before = earlier.rankings.get(trajectory)
        if before is None:
            told.append(Bar(trajectory, text, "not walked", None))
            continue
        now = [name for name in ranking(verdict) if name in before]
        before = [name for name in before if name in now]
        pairs = itertools.combinations(before, 2)
        swapped = [f"`{a}` and `{b}`" for a, b in pairs if now.index(a) > now.index(b)]
        measured = f"changed places: {', '.join(swapped)}" if swapped else f"all {len(now)}"
        told.append(Bar(trajectory, text, measured, not swapped))
    return told


def _all_bars(table: Table, found: Mapping[tuple[str, str], Line]) -> list[Bar]:
    return bars(found) + (same_order(table.verdicts, table.earlier) if table.earlier else [])


def write_table(folder: Path, table: Table) -> Path:
    """Write report.md, table.csv, table.json and table.tex, each whole or not at all.

    Args:
        folder: where the pictures are.
        table: what to tell.

    Returns:
        report.md.

    Raises:
        WriteError: a file cannot be written.
    """
    found = lines(table.verdicts)
    write_file(folder / "table.csv", _csv(found).encode())
    write_json(folder / "table.json", _result(table, found))
    write_file(folder / "table.tex", _tex(table.verdicts, found).encode())
    write_file(folder / "report.md", _report(table, found).encode())
    return folder / "report.md"


def _report(table: Table, found: Mapping[tuple[str, str], Line]) -> str:
    first = next(iter(table.verdicts.values()))
    sections = [
        f"# The paper's table: {', '.join(table.verdicts)}, {plural(len(first.seeds), 'plant')}",
        _summary(found),
        STAND_IN,
        _SETS,
        "## What it had to show",
        _checklist(_all_bars(table, found)),
        "Beyond that it was hoped for:",
        _checklist(aims(found)),
    ]
    for trajectory, verdict in table.verdicts.items():
        sections += [
            f"## {_TRAJECTORIES.get(trajectory, trajectory)}",
            verdict_table(verdict),
            f"From the best to the worst, by the median against nominal: {_order(verdict)}.",
            *(line.replace(VOID, "\\" + VOID) for line in legend(verdict)),
            parts_table(verdict),
            errors_of_tracking(verdict),
        ]
    sections += [
        "## With the net against its rivals",
        "Change in %, median over plants of the paired ratio [95 % bootstrap interval].",
        _rivals(found),
        "## Beside the paper",
        "Change of L in %. The paper tunes for ten iterations; its figures were measured on the "
        "robot and bear no intervals, ours on simulated plants. The losses themselves are those of "
        "other errors and not to be compared.",
        _beside(found),
        f"L_ctrl of the paper's `with_ten` against its expert: {_paper_control()} %.",
        "The paper's own table:",
        _paper_table(),
        "## Falls",
        _falls(table),
        "## Pictures",
        *(f"![{p.caption}]({p.file})\n\n*{p.caption}*" for p in table.pictures),
        "## Search and tuning",
        _searches(table),
    ]
    for trajectory, tunings in table.tunings.items():
        for name, tuning in tunings.items():
            sections.append(tuning_section(f"{trajectory}, {name}", tuning))
    sections += [
        "## What was run",
        _made_at(table),
        markdown_table(("what", "version"), list(table.environment.items())),
        "```json\n" + json.dumps(table.config, indent=2) + "\n```",
        "## How to reproduce",
        f"```\n{table.command}\n```\n\n`table.json` holds every score by seed, `table.csv` the "
        "same numbers as this report in columns, `table.tex` a tabular for LaTeX.",
    ]
    return "\n\n".join(sections) + "\n"


def _order(verdict: Verdict) -> str:
    return ", ".join(f"`{name}`" for name in ranking(verdict))


def _summary(found: Mapping[tuple[str, str], Line]) -> str:
    told = []
    for (trajectory, name), line in found.items():
        if name != "with":
            continue
        against = ", ".join(
            f"{change_text(line.against[baseline].change['L'])} % against {baseline}"
            for baseline in BASELINES
            if baseline in line.against
        )
        fell = f"{plural(line.falls, 'fall')} on {plural(line.seeds, 'plant')}"
        told.append(f"- {trajectory}: {against}; {fell}")
    return "Loss of the weights tuned through the net (`with`):\n\n" + "\n".join(told)


def _checklist(told: Sequence[Bar]) -> str:
    word = {True: "holds", False: "falls short", None: "open"}
    return "\n".join(
        f"- [{'x' if bar.holds else ' '}] {bar.trajectory}: {bar.text}: {bar.measured}: "
        f"**{word[bar.holds]}**"
        for bar in told
    )


def _marked(comparison: Comparison, part: str = "L") -> str:
    return change_text(comparison.change[part]) + ("" if comparison.counts else " \\" + VOID)


def _rivals(found: Mapping[tuple[str, str], Line]) -> str:
    rows = []
    for (trajectory, name), line in found.items():
        for other, comparison in line.against.items():
            if other in BASELINES:
                continue
            cells = [_marked(comparison, part) for part in _ORDER]
            wins = f"{round(comparison.wins * line.seeds)} / {line.seeds}"
            rows.append([f"{trajectory}: `{name}` against `{other}`", *cells, wins])
    return markdown_table(("", *_ORDER, "wins (L)"), rows) if rows else "No rival was walked."


def _beside(found: Mapping[tuple[str, str], Line]) -> str:
    trajectories = list(dict.fromkeys(trajectory for trajectory, _ in found))
    rows = []
    for name in ("without_ten", "with_ten", "without", "with"):
        for baseline in BASELINES:
            cells = []
            for t in trajectories:
                line = found.get((t, name))
                ours = line.against.get(baseline) if line else None
                paper = PAPER.get(t, {}).get(name)
                cells.append("" if ours is None else _marked(ours))
                cells.append("" if paper is None else f"{paper_change(t, name, baseline):+.1f}")
            rows.append([f"`{name}` against {baseline}", *cells])
    head = [cell for t in trajectories for cell in (t, "paper")]
    return markdown_table(("", *head), rows)


def _paper_control() -> str:
    told = (f"{paper_change(t, 'with_ten', 'expert', 'L_ctrl'):+.1f} ({t})" for t in PAPER)
    return ", ".join(told)


def _paper_table() -> str:
    head = ("", *(f"{part} [{_UNITS[part]}]" if _UNITS[part] else part for part in _ORDER))
    rows = [
        [f"{trajectory}: {name}", *(f"{x:.3g}".replace("e+0", "e") for x in losses)]
        for trajectory, sets in PAPER.items()
        for name, losses in sets.items()
    ]
    return markdown_table(head, rows)


def _falls(table: Table) -> str:
    walks = sum(len(v.seeds) * len(v.scores) for v in table.verdicts.values())
    if not table.falls:
        return f"None of the {plural(walks, 'walk')} ended in a fall."
    rows = [
        [
            f"{fall.trajectory}: {fall.name}",
            str(fall.seed),
            f"{fall.upright:.2f}",
            f"{100 * fall.height:.1f}",
            f"{math.degrees(fall.roll):.1f}",
            f"{math.degrees(fall.pitch):.1f}",
        ]
        for fall in table.falls
    ]
    head = ("set", "plant", "upright [s]", "height [cm]", "roll [deg]", "pitch [deg]")
    return (
        f"{len(table.falls)} of {plural(walks, 'walk')} ended in a fall. Height of the centre of "
        "mass, roll and pitch are those of the last millisecond before it.\n\n"
        + markdown_table(head, rows)
    )


def _searches(table: Table) -> str:
    kinds = {"searched": table.searches, "ceiling": table.ceilings}
    rows = [
        [f"{name}: `{kind}`", str(s.walks), str(s.best_at), f"{s.loss / 1e6:.3f}", s.stop]
        for kind, searches in kinds.items()
        for name, s in searches.items()
    ]
    head = ("", "walks", "best at", "L x1e6 there", "ended")
    return (
        "`searched` and `ceiling` are CMA-ES in the log-weights from nominal, on the "
        "high-fidelity simulator that the net learned from.\n\n" + markdown_table(head, rows)
    )


def _made_at(table: Table) -> str:
    known = ", ".join(f"`{commit}`" if commit else "unknown" for commit in table.commits)
    scores = [score for verdict in table.verdicts.values() for score in verdict.scores.values()]
    worst = max(float(score.residual.max()) for score in scores)
    return (
        f"Tunings and walks were made at {known}. "
        f"Worst relative KKT residual of a plan in any walk: {worst:.0e}."
    )


def _csv(found: Mapping[tuple[str, str], Line]) -> str:
    """One row per trajectory, set and part of the loss; changes in %."""
    others = (*BASELINES, *_RIVALS, "without_ten", "with")
    head = ["trajectory", "set", "part", "unit", "mean", "mean_low", "mean_high", "falls", "seeds"]
    for other in others:
        head += [f"{key}_{other}" for key in ("median", "low", "high", "wins", "counts")]
    head += ["paper", *(f"paper_{baseline}" for baseline in BASELINES)]
    rows: list[list[Any]] = [head]
    for (trajectory, name), line in found.items():
        paper = PAPER.get(trajectory, {}).get(name)
        for part in _ORDER:
            row = [trajectory, name, part, _UNITS[part], *line.means[part], line.falls, line.seeds]
            for other in others:
                one = line.against.get(other)
                wins = "" if one is None or part != "L" else one.wins
                row += [""] * 5 if one is None else [*one.change[part], wins, one.counts]
            row.append("" if paper is None else paper[_ORDER.index(part)])
            for baseline in BASELINES:
                known = paper is not None and name != baseline
                row.append(paper_change(trajectory, name, baseline, part) if known else "")
            rows.append(row)
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(
        [_csv_number(cell) if isinstance(cell, float) else cell for cell in row] for row in rows
    )
    return out.getvalue()


def _csv_number(x: float) -> str:
    return f"{x:.6g}" if math.isfinite(x) else ""


def _result(table: Table, found: Mapping[tuple[str, str], Line]) -> dict[str, Any]:
    """The table as JSON values, every score by seed among them."""
    told = {}
    for trajectory, verdict in table.verdicts.items():
        one = metrics.as_result(verdict)
        for name, score in verdict.scores.items():
            by_seed = {part: score.losses[part].tolist() for part in verdict.parts}
            by_seed["fallen"] = score.fallen.astype(bool).tolist()
            one["sets"][name]["standin"]["by_seed"] = by_seed
        one["against"] = {
            f"{name} against {other}": metrics.change_result(comparison)
            for (t, name), line in found.items()
            for other, comparison in line.against.items()
            if t == trajectory and other not in BASELINES
        }
        one["ranking"] = ranking(verdict)
        one["tunings"] = {
            name: {"iterations": len(tuning.history) - 1, "stop": tuning.stop}
            for name, tuning in table.tunings.get(trajectory, {}).items()
        }
        for key, searches in (("search", table.searches), ("ceiling", table.ceilings)):
            if trajectory in searches:
                one[key] = searches[trajectory]._asdict()
        told[trajectory] = one
    return {
        "command": table.command,
        "environment": dict(table.environment),
        "commits": list(table.commits),
        "seeds": seeds_text(next(iter(table.verdicts.values())).seeds),
        "config": dict(table.config),
        "bars": [bar._asdict() for bar in _all_bars(table, found)],
        "aims": [bar._asdict() for bar in aims(found)],
        "falls": [fall._asdict() for fall in table.falls],
        "trajectories": told,
        "paper": {
            trajectory: {name: dict(zip(_ORDER, losses, strict=True)) for name, losses in s.items()}
            for trajectory, s in PAPER.items()
        },
    }


_TEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: "\\" + character for character in "&%$#_{}"},
}


def tex(text: str) -> str:
    """Plain words for LaTeX."""
    return "".join(_TEX.get(character, character) for character in text)


def _tex_number(x: float) -> str:
    """Three significant digits, without a power of ten."""
    digits = 2 - math.floor(math.log10(x)) if x > 0.0 else 0
    return f"{x:.{max(digits, 0)}f}"


def _tex_change(comparison: Comparison | None) -> str:
    if comparison is None:
        return "--"
    value, *ends = comparison.change["L"].text(percent).split(" ", 1)
    told = " ".join(f"${text}$" for text in (value, *ends))
    return told + ("" if comparison.counts else "$^{*}$")


def _tex(verdicts: Mapping[str, Verdict], found: Mapping[tuple[str, str], Line]) -> str:
    """A tabular that asks for no package; the smallest mean of a trajectory is bold."""
    scales = {"L_Eul": 1.0, "L_pos": 1.0, "L_ctrl": 1e-3, "L": 1e-6}
    first = next(iter(verdicts.values()))
    seeds = seeds_text(first.seeds)
    head = [
        "",
        r"$L_\mathrm{Eul}$ [rad$^2$]",
        r"$L_\mathrm{pos}$ [m$^2$]",
        r"$L_\mathrm{ctrl}$ [$10^3$]",
        r"$L$ [$10^6$]",
        "falls",
        *(cell for b in BASELINES for cell in (rf"against {b} [\%]", "wins", "paper")),
    ]
    rows = [
        f"% Means over {plural(len(first.seeds), 'plant')} of the hardware stand-in "
        f"(seeds {seeds}); change of L: median of the paired",
        "% ratio [95 % bootstrap interval]; * does not count, the falls differ. paper: its own "
        "table, ten iterations.",
        rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
        r"\hline",
        " & ".join(head) + r" \\",
    ]
    for trajectory, verdict in verdicts.items():
        title = tex(_TRAJECTORIES.get(trajectory, trajectory))
        rows += [r"\hline", rf"\multicolumn{{{len(head)}}}{{l}}{{{title}}} \\"]
        least = {
            part: min(found[trajectory, name].means[part].value for name in verdict.scores)
            for part in _ORDER
        }
        for name in verdict.scores:
            line = found[trajectory, name]
            cells = [tex(name)]
            for part in _ORDER:
                value = line.means[part].value
                text = _tex_number(scales[part] * value)
                cells.append(rf"\textbf{{{text}}}" if value == least[part] else text)
            cells.append(f"{line.falls}/{line.seeds}")
            for baseline in BASELINES:
                one = line.against.get(baseline)
                known = name in PAPER.get(trajectory, {}) and name != baseline
                cells += [
                    _tex_change(one),
                    "--" if one is None else f"{round(one.wins * line.seeds)}/{line.seeds}",
                    f"${paper_change(trajectory, name, baseline):+.1f}$" if known else "--",
                ]
            rows.append(" & ".join(cells) + r" \\")
    rows += [r"\hline", r"\end{tabular}"]
    return "\n".join(rows) + "\n"
