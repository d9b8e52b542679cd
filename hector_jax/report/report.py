"""Verdicts as text: the table on the terminal, and the Markdown parts of all reports.

Prose is in the templates; the functions here make the tables of numbers that they include. The
stand-in for the robot is always called "hardware stand-in", and a comparison that falls make void
is shown with a mark, never left out.
"""

import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hector_jax.core.inputs import plural
from hector_jax.verdict import metrics
from hector_jax.verdict.foretell import Carried
from hector_jax.verdict.metrics import BASELINES, Comparison, Summary, Verdict

# titles of worlds that differ from their names
WORLDS = {"standin": "hardware stand-in", "standin-even": "hardware stand-in, family even"}
VOID = "*"
ERRORS = (
    "Errors are RMS, up to a fall where there is one; in the plane: ahead and sideways together."
)


class Picture(NamedTuple):
    """A file of the run folder with its caption."""

    file: str
    caption: str


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> str:
    """Format a table in Markdown; the first `words` columns are words, aligned left.

    >>> print(markdown_table(("set", "L"), [("nominal", "3.9"), ("expert", "2.8")]))
    | set | L |
    | :--- | ---: |
    | nominal | 3.9 |
    | expert | 2.8 |
    """
    rule = [":---" if i < words else "---:" for i in range(len(head))]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *rows))


def seeds_text(seeds: Sequence[int] | np.ndarray) -> str:
    """Format seeds, as a range if they are consecutive."""
    if len(seeds) > 1 and np.array_equal(seeds, np.arange(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]}-{seeds[-1]}"
    return ", ".join(map(str, seeds))


def power_text(x: float) -> str:
    """Format a loss weight, such as `1e5`."""
    return f"{x:.0e}".replace("e+0", "e") if x >= 1e3 else f"{x:g}"


def number(x: float, form: str = ".3g") -> str:
    """Format a number of a table; a dash if it is not finite."""
    return format(x, form) if math.isfinite(x) else "-"


class TableColumn(NamedTuple):
    """Number format of a part of the loss."""

    part: str
    power: int  # numbers are divided by ten to this power
    digits: int

    @property
    def unit(self) -> str:
        """Power of ten in the column's head."""
        return f"x1e{self.power}" if self.power else ""

    @property
    def head(self) -> str:
        """Head of the column."""
        return f"{self.part} {self.unit}".strip()

    def text(self, x: float) -> str:
        """Format a number of the column."""
        return f"{x / 10.0**self.power:.{self.digits}f}"


def column(part: str, *numbers: float) -> TableColumn:
    """Choose a power of a thousand for the middle one, and three digits of the smallest number.

    A row of falls, which may be a thousand times as large, decides neither.
    """
    positive = sorted(x for x in numbers if x > 0.0)
    if not positive:
        return TableColumn(part, 0, 2)
    middle = positive[(len(positive) - 1) // 2]
    power = 0 if 0.1 <= middle < 1e3 else 3 * math.floor(math.log10(middle) / 3)
    digits = 2 - math.floor(math.log10(positive[0] / 10.0**power))
    return TableColumn(part, power, min(max(digits, 0), 4))


def columns(verdict: Verdict) -> dict[str, TableColumn]:
    """Choose the number format of each part for the tables of a verdict."""
    means = [summary.means for summary in summaries(verdict).values()]
    return {part: column(part, *(mean[part].value for mean in means)) for part in verdict.parts}


def summaries(verdict: Verdict) -> dict[str, Summary]:
    """Summarize all sets of a verdict, each against the baselines."""
    return {name: metrics.summarize(verdict, name) for name in verdict.scores}


def plain_errors(verdict: Verdict, name: str) -> dict[str, float]:
    """Return the RMS errors of a set in the plane and in height [cm], in pitch and yaw [deg]."""
    (_, pitch, yaw), (x, y, z) = metrics.rms(verdict, name)
    lengths = {"plane": 100 * math.hypot(x, y), "height": 100 * z}
    return {**lengths, "pitch": math.degrees(pitch), "yaw": math.degrees(yaw)}


def first_lines(verdict: Verdict, run: str) -> list[str]:
    """Say in lines what a run has come to: errors, falls, what to do next.

    Args:
        verdict: on the stand-in, with `best` or, without it, a tuned set as its last one.
        run: `latest` or the folder of the run; empty if it can be neither viewed nor exported.
    """
    tuned = "best" if "best" in verdict.scores else list(verdict.scores)[-1]
    errors = {name: plain_errors(verdict, name) for name in (tuned, *baselines(verdict))}
    falls = {name: int(summaries(verdict)[name].falls) for name in errors}
    worse = {scene: _worse(verdict.of_scene(scene), tuned) for scene in verdict.scenes}
    values = {"verdict": verdict, "errors": errors, "falls": falls, "worse": worse, "run": run}
    return render("first.txt.j2", **values).splitlines()


def _worse(verdict: Verdict, tuned: str) -> list[str]:
    """Say in what a tuned set is worse than the first baseline; of errors, by more than 5 %."""
    if not (names := baselines(verdict)):
        return []
    of, than = (plain_errors(verdict, name) for name in (tuned, names[0]))
    falls = [int(summaries(verdict)[name].falls) for name in (tuned, names[0])]
    units = {"plane": "cm off in the plane", "pitch": "degrees in pitch"}
    found = [
        f"{of[error]:.1f} {unit}, {names[0]} {than[error]:.1f}"
        for error, unit in units.items()
        if of[error] > 1.05 * than[error]
    ]
    fell = f"{plural(falls[0], 'fall')}, {names[0]} {falls[1]}"
    return found + [fell] * (falls[0] > falls[1])


def elsewhere_line(carried: Carried) -> str:
    """Say what a set may bring on a robot that is not the simulator; empty if nothing can be."""
    if not carried.change:
        return ""
    each = [f"{_less(low, high)} on {scene}" for scene, (_, low, high) in carried.change.items()]
    held = f"held in {carried.held} of {carried.walks} walks of other sets, engines and masses"
    return f"On a robot that is not this simulator expect {', '.join(each)} (90 %; {held})."


def _less(low: float, high: float) -> str:
    """Write the interval of a change of the loss [%] in words."""
    if low < 0.0 < high:
        return f"up to {-low:.0f} % less or {high:.0f} % more loss than with nominal"
    least, most = sorted((abs(low), abs(high)))
    word = "less" if high <= 0.0 else "more"
    return f"{least:.0f} to {most:.0f} % {word} loss than with nominal"


def baselines(verdict: Verdict) -> list[str]:
    """Return the baselines that another set can be compared with."""
    return [name for name in BASELINES if name in verdict.scores and len(verdict.scores) > 1]


def change_text(comparison: Comparison, part: str = "L", void: str = f" \\{VOID}") -> str:
    """Format a change in % with its interval and, if falls make it void, a mark."""
    return comparison.change[part].text() + ("" if comparison.counts else void)


def legend(verdict: Verdict) -> list[str]:
    """Explain the columns of a verdict, line by line."""
    comparisons = [c for summary in summaries(verdict).values() for c in summary.against.values()]
    text = render(
        "legend.txt.j2",
        verdict=verdict,
        seeds=seeds_text(verdict.seeds),
        fewest=metrics.FEWEST,
        mark=None if all(comparison.counts for comparison in comparisons) else VOID,
    )
    return text.splitlines()


def plain_console(console: Console | None, width: int) -> Console:
    """Return the console, or a plain one of this width for a file; None means stdout."""
    console = console or Console(highlight=False)
    if console.is_terminal:
        return console
    return Console(file=console.file, highlight=False, width=width, color_system=None)


def print_tables(
    verdict: Verdict,
    world: str = "standin",
    console: Console | None = None,
    *,
    more: Sequence[str] = (),
) -> None:
    """Print the verdict as a table, and of several scenes each, without colours outside a terminal.

    Args:
        verdict: verdict to print.
        world: world of the walks.
        console: output; None means stdout.
        more: lines below the tables.
    """
    console = plain_console(console, width=160)
    where = f"{plural(len(verdict.seeds), 'plant')} on the {WORLDS.get(world, world)}"
    for name, one in verdict.each.items():
        console.print(Text(f"{name}, {where}", style="bold"))
        console.print(_terminal_table(one, padding=1 if console.width >= 90 else 0))
        for line in legend(one):
            console.print(Text(line, style="dim"))
    console.print(Text(ERRORS, style="dim"))
    for line in more:
        console.print(Text(line))


def _terminal_table(verdict: Verdict, padding: int) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, padding, 0, 0), pad_edge=False, show_edge=False)
    table.add_column("set\n", no_wrap=True)
    loss, others = columns(verdict)["L"], baselines(verdict)
    errors = ("plane\n[cm]", "height\n[cm]", "pitch\n[deg]")
    changes = (f"against {baseline}\n[%]" for baseline in others)
    for head in (*errors, f"L\n{loss.unit}", "falls\n", *changes):
        table.add_column(Text(head), justify="right", no_wrap=True)  # [cm] is no markup
    for name, summary in summaries(verdict).items():
        at = plain_errors(verdict, name)
        cells: list[Any] = [number(at[error], ".1f") for error in ("plane", "height", "pitch")]
        cells.append(loss.text(summary.means["L"].value))
        cells.append(Text(str(summary.falls), style="red" if summary.falls else ""))
        cells += [_change(summary.against.get(baseline)) for baseline in others]
        table.add_row(name, *cells)
    return table


def _change(comparison: Comparison | None) -> Text:
    if comparison is None:
        return Text("-", style="dim")
    change = comparison.change["L"]
    style = "green" if change.high < 0.0 else "red" if change.low > 0.0 else ""
    return Text(change_text(comparison, void=VOID), style=style if comparison.counts else "yellow")


def wins_text(comparison: Comparison, walks: int) -> str:
    """Format the number of walks in which the set is better."""
    return f"{round(comparison.wins * walks)} / {walks}"


TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_FUNCTIONS = (baselines, change_text, columns, first_lines, legend, markdown_table, plain_errors)
_FUNCTIONS += (plural, summaries, wins_text)
TEMPLATES.globals |= {function.__name__: function for function in (*_FUNCTIONS, metrics.rms)}
TEMPLATES.globals["BASELINES"] = BASELINES
TEMPLATES.filters |= {
    "degrees": math.degrees,
    "json": partial(json.dumps, indent=2),
    "number": number,
    "power": power_text,
}


def render(template: str, **values: Any) -> str:
    """Fill a template of the folder `templates`."""
    return TEMPLATES.get_template(template).render(values)


def caption(picture: str, **values: Any) -> str:
    """Return the caption of a picture of `plots`, from its macro in captions.j2."""
    return getattr(TEMPLATES.get_template("captions.j2").module, picture)(**values)
