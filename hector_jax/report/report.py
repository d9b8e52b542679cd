"""What a person reads in the end: one table on the terminal, and report.md in the run folder.

Both are told from the same rows. The stand-in for the robot is called "hardware stand-in" wherever
it is named, and a comparison that falls make void is shown with a mark, never left out.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hector_jax.control.weights import WEIGHT_NAMES, Weights, bounds, weights_to_vector
from hector_jax.core.files import write_file, write_json
from hector_jax.core.inputs import plural
from hector_jax.runs.metrics import (
    BASELINES,
    FEWEST,
    Comparison,
    Interval,
    Verdict,
    compare,
    mean,
    rms,
)
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration, Tuning
from hector_jax.tuning.evaluate import aligned
from hector_jax.tuning.loss import Loss

WORLDS = {"standin": "hardware stand-in"}  # what worlds are called where it is not their name

STAND_IN = (
    "The verdict is given on the **hardware stand-in**: a family of simulated plants, one per "
    "seed, that differ from the simulator the net learned from in masses, friction, ground, "
    "motors, backlash and delay, and that show the controller only what a drifting, noisy state "
    "estimator sees. It is not hardware. No training, tuning or choice has read it."
)

_FIDELITY = (
    "`raw` is the command itself, `linear` an affine map of the paper's 18 inputs, `paper` the "
    "paper's net, `residual` the default, `gated` its linear part alone. The walks of the hfs "
    "were held out of training and of the choice of an epoch. The hardware stand-in is shown for "
    "information; nothing was chosen by it. `measured` moves the rigid body by the measured "
    "wrench: what is left there belongs to the legs, not to the ground."
)

_AXES = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")
VOID = "*"


class Picture(NamedTuple):
    """A file of the run folder with its caption."""

    file: str
    caption: str


class Report(NamedTuple):
    """All that report.md tells."""

    trajectory: str
    verdict: Verdict
    tunings: Mapping[str, Tuning]  # `without`, `with` and, refreshed, `with_refreshed`
    norms: Mapping[str, Mapping[str, float]]  # of the terms' gradients in log-weights, by model
    errors: Mapping[str, Mapping[str, Any]]  # held-out, of `raw`, `linear`, `net`: training.report
    pictures: Sequence[Picture]
    film: Picture | str  # or why there is none
    config: Mapping[str, Any]  # resolved, as JSON values
    environment: Mapping[str, str]
    command: str  # that makes this run again
    shifts: Sequence[Mapping[str, Any]] = ()  # of each refresh: nets.refresh


def _scale(largest: float) -> int:
    """Power of ten, in threes, that leaves one to four digits before the point."""
    if not largest > 0.0 or 0.1 <= largest < 1e3:
        return 0
    return 3 * math.floor(math.log10(largest) / 3)


def part_columns(verdict: Verdict) -> dict[str, tuple[int, Callable[[float], str]]]:
    """By part: the power of ten of its column and how its numbers are written."""
    columns = {}
    for part in verdict.parts:
        largest = max(mean(verdict, name, part).value for name in verdict.scores)
        power = _scale(largest)
        lead = math.floor(math.log10(largest / 10.0**power)) if largest > 0.0 else 0
        digits = max(0, 2 - lead)
        columns[part] = (
            power,
            lambda x, power=power, digits=digits: f"{x / 10.0**power:.{digits}f}",
        )
    return columns


def percent(x: float) -> str:
    """A change in %, two digits."""
    return f"{x:+.1f}" if abs(x) < 9.95 else f"{x:+.0f}"


def change_text(change: Interval) -> str:
    """A change in % with its interval."""
    return change.text(percent)


def _compared(verdict: Verdict, name: str, baseline: str) -> Comparison | None:
    known = baseline in verdict.scores and baseline != name
    return compare(verdict, name, baseline) if known else None


def seeds_text(seeds: Sequence[int] | np.ndarray) -> str:
    """Seeds as a range where they are one."""
    if len(seeds) > 1 and np.array_equal(seeds, np.arange(seeds[0], seeds[0] + len(seeds))):
        return f"{seeds[0]}-{seeds[-1]}"
    return ", ".join(map(str, seeds))


def _baselines(verdict: Verdict) -> list[str]:
    """Those baselines that another set can be compared with."""
    return [name for name in BASELINES if name in verdict.scores and len(verdict.scores) > 1]


def _formula(loss: Loss) -> str:
    terms = [t.name if t.weight == 1.0 else f"{_power(t.weight)} {t.name}" for t in loss]
    return "L = " + " + ".join(terms)


def _power(x: float) -> str:
    return f"{x:.0e}".replace("e+0", "e") if x >= 1e3 else f"{x:g}"


def legend(verdict: Verdict) -> list[str]:
    """What the columns of a verdict mean."""
    count = len(verdict.seeds)
    plants = (
        f"{plural(count, 'plant')} ({'seeds' if count > 1 else 'seed'} {seeds_text(verdict.seeds)})"
    )
    interval = " [95 % bootstrap interval]" if len(verdict.seeds) >= FEWEST else ""
    lines = [f"{_formula(verdict.loss)}; means over {plants}."]
    if _baselines(verdict):
        lines.append(
            f"Change of L in %, median over plants of the paired ratio{interval}; below zero is "
            "better."
        )
    if _void(verdict):
        lines.append(f"{VOID} does not count: one of the two falls more often than the other.")
    touched = {name: float(score.legs_touch.sum()) for name, score in verdict.scores.items()}
    told = [f"{name} {seconds:.3f} s" for name, seconds in touched.items() if seconds > 0.0]
    if told:
        lines.append(f"The legs touched each other, which is no fall: {', '.join(told)} in all.")
    return lines


def _void(verdict: Verdict) -> bool:
    pairs = [(name, baseline) for name in verdict.scores for baseline in BASELINES]
    return any((c := _compared(verdict, *pair)) is not None and not c.counts for pair in pairs)


def print_table(
    verdict: Verdict, title: str = "", world: str = "standin", console: Console | None = None
) -> None:
    """The verdict as one table on the terminal, plain where there is none.

    Args:
        verdict: what to tell.
        title: what was walked.
        world: where.
        console: where to print; None takes stdout.
    """
    console = console or Console(highlight=False)
    if not console.is_terminal:
        # a file has no width: no cell is to be cut or wrapped there
        console = Console(file=console.file, highlight=False, width=160, color_system=None)
    where = WORLDS.get(world, world)
    console.print(Text(f"{title} on the {where}" if title else f"On the {where}", style="bold"))
    console.print(_terminal_table(verdict, padding=1 if console.width >= 90 else 0))
    for line in legend(verdict):
        console.print(Text(line, style="dim"))


def _terminal_table(verdict: Verdict, padding: int) -> Table:
    columns = part_columns(verdict)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, padding, 0, 0), pad_edge=False, show_edge=False)
    table.add_column("set\n", no_wrap=True)
    for part in verdict.parts:
        power = columns[part][0]
        table.add_column(part + (f"\nx1e{power}" if power else "\n"), justify="right", no_wrap=True)
    table.add_column("falls\n", justify="right", no_wrap=True)
    for baseline in _baselines(verdict):
        table.add_column(f"against {baseline}\n[%]", justify="right", no_wrap=True)
    for name in verdict.scores:
        means = [columns[part][1](mean(verdict, name, part).value) for part in verdict.parts]
        fell = Text(
            str(int(verdict.scores[name].fallen.sum())),
            style="red" if int(verdict.scores[name].fallen.sum()) else "",
        )
        changes = [_terminal_change(_compared(verdict, name, b)) for b in _baselines(verdict)]
        table.add_row(name, *means, fell, *changes)
    return table


def _terminal_change(comparison: Comparison | None) -> Text:
    if comparison is None:
        return Text("-", style="dim")
    change = comparison.change["L"]
    if not comparison.counts:
        return Text(change_text(change) + VOID, style="yellow")
    style = "green" if change.high < 0.0 else "red" if change.low > 0.0 else ""
    return Text(change_text(change), style=style)


def write_report(folder: Path, report: Report) -> Path:
    """Write report.md into the run folder, whole or not at all.

    Args:
        folder: where the pictures are.
        report: what to tell.

    Returns:
        The file.
    """
    sections = [
        f"# Tuned weights for walking: {report.trajectory}",
        _summary(report.verdict),
        "## Verdict",
        STAND_IN,
        verdict_table(report.verdict),
        *(line.replace(VOID, "\\" + VOID) for line in legend(report.verdict)),
        parts_table(report.verdict),
        errors_of_tracking(report.verdict),
        *([_switching(report.verdict)] if "L_ctrl" in report.verdict.parts else []),
        "## Tuning",
        *(tuning_section(name, tuning) for name, tuning in report.tunings.items()),
        "### Gradients of the terms",
        _norms(report.verdict.loss, report.norms),
        "## GRFM-Net on held-out walks",
        _net_errors(report.errors),
        *(_shift(count, shift) for count, shift in enumerate(report.shifts, 1)),
        "## Pictures",
        *(f"![{p.caption}]({p.file})\n\n*{p.caption}*" for p in report.pictures),
        _film(report.film),
        "## What was run",
        markdown_table(("what", "version"), list(report.environment.items())),
        "```json\n" + json.dumps(report.config, indent=2) + "\n```",
        "## How to reproduce",
        _reproduce(report),
    ]
    path = folder / "report.md"
    write_file(path, ("\n\n".join(sections) + "\n").encode())
    return path


def write_fidelity(
    folder: Path, worlds: Mapping[str, Mapping[str, Any]], pictures: Sequence[Picture]
) -> Path:
    """Write report.md on the nets' fidelity, and the same numbers as result.json.

    Args:
        folder: where the pictures are.
        worlds: by their names, what `fidelity.as_result` gives.
        pictures: to show.

    Returns:
        report.md.
    """
    sections = ["# What the ground returns: GRFM-Net on walks it never saw", _FIDELITY]
    for world, found in worlds.items():
        sections += [
            f"## {WORLDS.get(world, world)}",
            _wrench_errors(found["errors"]),
            "Mean square errors by the phase of the step, since the switch of stance:",
            _phase_errors(found["phases"]),
            "Open loop, RMS error after the time ahead:",
            _drift_table(found["open_loop"]),
        ]
    sections += ["## Pictures"]
    sections += [f"![{p.caption}]({p.file})\n\n*{p.caption}*" for p in pictures]
    path = folder / "report.md"
    write_file(path, ("\n\n".join(sections) + "\n").encode())
    write_json(folder / "result.json", worlds)
    return path


def _number(x: float, form: str = ".3g") -> str:
    """A number of a table; none where nothing was there to measure."""
    return format(x, form) if math.isfinite(x) else "-"


def _wrench_errors(errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Mean square errors per axis; a column for each phi."""
    rows = []
    for kind, unit in (("force", "N^2"), ("moment", "(N m)^2")):
        rows.append([f"{kind}, all [{unit}]", *(_number(e[kind]) for e in errors.values())])
    for contact in ("stance", "swing"):
        for i, axis in enumerate(_AXES):
            unit = "N^2" if axis[0] == "F" else "(N m)^2"
            cells = (_number(e[contact][i]) for e in errors.values())
            rows.append([f"{axis}, {contact} [{unit}]", *cells])
    return markdown_table(("mean square error", *errors), rows)


def _phase_errors(phases: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]]) -> str:
    rows = []
    first = next(iter(phases.values()))
    for phase in first:
        for contact in ("stance", "swing"):
            for part, unit, axes in (("F", "N^2", slice(3)), ("M", "(N m)^2", slice(3, 6))):
                cells = (_number(np.mean(found[phase][contact][axes])) for found in phases.values())
                rows.append([f"{phase}, {contact}, {part} [{unit}]", *cells])
    return markdown_table(("mean over the axes", *phases), rows)


def _drift_table(found: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    horizons = list(next(iter(found.values())))
    rows = []
    for horizon in horizons:
        for part, unit, scale in (("position", "cm", 100.0), ("euler", "deg", 180.0 / np.pi)):
            cells = (_number(scale * one[horizon][part], ".2f") for one in found.values())
            rows.append([f"{part} after {horizon} [{unit}]", *cells])
    return markdown_table(("", *found), rows)


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], words: int = 1) -> str:
    """A table in Markdown; as many first columns as are words to the left, numbers to the right.

    >>> print(markdown_table(("set", "L"), [("nominal", "3.9"), ("expert", "2.8")]))
    | set | L |
    | :--- | ---: |
    | nominal | 3.9 |
    | expert | 2.8 |
    """
    line = lambda cells: f"| {' | '.join(cells)} |"  # noqa: E731
    rule = [":---" if i < words else "---:" for i in range(len(head))]
    return "\n".join(map(line, [head, rule, *rows]))


def _summary(verdict: Verdict) -> str:
    """What came out, a sentence for each tuning, whatever it is."""
    told = []
    how = {
        "with": "through the net",
        "without": "without the net",
        "with_refreshed": "through the net refreshed",
    }
    for name in how:
        if name not in verdict.scores:
            continue
        clauses = [
            _clause(comparison, baseline)
            for baseline in BASELINES
            if (comparison := _compared(verdict, name, baseline)) is not None
        ]
        count = int(verdict.scores[name].fallen.sum())
        fell = f"the robot fell on {count} of {plural(len(verdict.seeds), 'plant')}"
        told.append(f"Tuned {how[name]} (`{name}`), the loss is {' and '.join(clauses)}; {fell}.")
    return " ".join(told)


def _clause(comparison: Comparison, baseline: str) -> str:
    change = comparison.change["L"]
    side = "below" if change.value < 0.0 else "above"
    size = f"{abs(change.value):.1f} % {side} {baseline}"
    if not comparison.counts:
        return f"{size} (void: the falls differ)"
    clear = not change.low <= 0.0 <= change.high  # also without an interval
    return size if clear else f"{size} (the interval holds zero)"


def verdict_table(verdict: Verdict) -> str:
    """Means, falls, changes and wins of all sets, in Markdown."""
    columns = part_columns(verdict)
    head = ["set", *verdict.parts, "falls"]
    head = [h + (f" x1e{columns[h][0]}" if h in columns and columns[h][0] else "") for h in head]
    for baseline in _baselines(verdict):
        head += [f"against {baseline} [%]", "wins"]
    rows = []
    for name in verdict.scores:
        row = [f"**{name}**"]
        for part in verdict.parts[:-1]:
            row.append(columns[part][1](mean(verdict, name, part).value))
        row += [
            mean(verdict, name).text(columns["L"][1]),
            f"{int(verdict.scores[name].fallen.sum())} / {len(verdict.seeds)}",
        ]
        for baseline in _baselines(verdict):
            row += _verdict_cells(_compared(verdict, name, baseline), len(verdict.seeds))
        rows.append(row)
    return markdown_table(head, rows)


def _verdict_cells(comparison: Comparison | None, seeds: int) -> list[str]:
    if comparison is None:
        return ["", ""]
    mark = "" if comparison.counts else " \\" + VOID
    return [
        change_text(comparison.change["L"]) + mark,
        f"{round(comparison.wins * seeds)} / {seeds}",
    ]


def parts_table(verdict: Verdict) -> str:
    """Changes of the parts against each baseline."""
    rows = []
    for name in verdict.scores:
        for baseline in BASELINES:
            comparison = _compared(verdict, name, baseline)
            if comparison is not None:
                cells = [change_text(comparison.change[p]) for p in verdict.parts[:-1]]
                rows.append([f"{name} against {baseline}", *cells])
    head = ("change in % of", *(f"{term.name} [{term.unit}]" for term in verdict.loss))
    return markdown_table(head, rows)


def errors_of_tracking(verdict: Verdict) -> str:
    """RMS errors of all sets, in Markdown."""
    head = ("RMS error", "roll [deg]", "pitch [deg]", "yaw [deg]", "x [cm]", "y [cm]", "z [cm]")
    rows = []
    for name in verdict.scores:
        euler, position = rms(verdict, name)
        values = [*np.rad2deg(euler), *(100 * position)]
        rows.append([name, *(f"{v:.2f}" for v in values)])
    return markdown_table(head, rows) + "\n\nOver all plants, up to a fall where there is one."


def _switching(verdict: Verdict) -> str:
    power, write = part_columns(verdict)["L_ctrl"]
    head = [f"L_ctrl{f' x1e{power}' if power else ''}", "whole", "at switches", "between them"]
    rows = []
    for name, score in verdict.scores.items():
        whole, owed = float(score.losses["L_ctrl"].mean()), float(score.switching.mean())
        rows.append([name, write(whole), write(owed), write(whole - owed)])
    return (
        markdown_table(head, rows)
        + "\n\nWhere the stance switches, one foot lets go of the weight and the other takes it: "
        "about 2 (m g)^2 per switch is owed whatever the weights."
    )


def tuning_section(name: str, tuning: Tuning) -> str:
    """What a tuning did, under a heading of its name; one along walks begins after the paper's."""
    history = tuning.history
    whole = history[0].iteration < PAPER_ITERATIONS
    where = "on the model" if whole else "of its walks on the simulator, mean over their plants"
    refused = [i for i in history if not i.accepted]
    accepted = [i for i in history if i.accepted]
    early = [i for i in accepted if i.iteration <= PAPER_ITERATIONS]
    loss = lambda i: f"{float(i.evaluation.loss) / 1e6:.3f}e6"  # noqa: E731
    lines = [
        f"### {name}",
        f"- {len(history) - 1} iterations, {len(refused)} refused{_reasons(refused)}",
        f"- ended because: {tuning.stop}",
        f"- L {where}: {loss(history[0])} at the start, "
        + (f"{loss(early[-1])} after {PAPER_ITERATIONS} iterations, " if whole else "")
        + f"{loss(accepted[-1])} at the end",
        "- at a bound of the box "
        + (f"after {PAPER_ITERATIONS}: {_at_bounds(tuning.ten)}; " if whole else "")
        + f"at the end: {_at_bounds(tuning.converged)}",
        f"- worst QP residual of an accepted step: "
        f"{max(float(i.evaluation.residual) for i in accepted):.1e}",
    ]
    return "\n".join([lines[0], "", *lines[1:]])


def _reasons(refused: Sequence[Iteration]) -> str:
    """Why steps were refused, and which."""
    steps: dict[str, list[str]] = {}
    for i in refused:
        steps.setdefault(re.sub(r" (\d|inf|nan).*", "", i.reason), []).append(str(i.iteration))
    told = [f"{reason} (iteration {', '.join(which)})" for reason, which in steps.items()]
    return ": " + "; ".join(told) if told else ""


def _at_bounds(weights: Weights) -> str:
    lower, upper = (np.asarray(weights_to_vector(bound)) for bound in bounds())
    vector = np.asarray(weights_to_vector(weights))
    close = np.isclose(vector, lower, rtol=1e-9) | np.isclose(vector, upper, rtol=1e-9)
    names = [f"`{name}`" for name, hit in zip(WEIGHT_NAMES, close, strict=True) if hit]
    return ", ".join(names) or "none"


def _norms(loss: Loss, norms: Mapping[str, Mapping[str, float]]) -> str:
    """Norms of the gradients, and the alphas that would align them with that of the last term."""
    *others, last = (term.name for term in loss)
    powers = lambda loss: ", ".join(_power(term.weight) for term in loss[:-1])  # noqa: E731
    rows = [
        [
            name,
            *(f"{norm[term.name]:.3g}" for term in loss),
            *(f"{term.weight * norm[term.name]:.3g}" for term in loss[:-1]),
            powers(aligned(loss, norm, last)),
        ]
        for name, norm in norms.items()
    ]
    weighted = [f"alpha_{i} {name}" for i, name in enumerate(others, 1)]
    return (
        "Norms of the gradients in log-weights at the nominal weights. The paper's footnote "
        f"chooses alpha so that the {len(loss)} have one order of magnitude; `auto` is what "
        f"`--alpha auto` takes for alpha_1 to alpha_{len(others)}. This run: {powers(loss)}.\n\n"
        + markdown_table(("model", *others, last, *weighted, "auto"), rows)
    )


def _net_errors(errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Mean square errors per axis, of feet that stand and that swing."""
    names = ("raw", "linear", "net")
    rows = []
    for kind, unit in (("force", "N^2"), ("moment", "(N m)^2")):
        rows.append([f"{kind}, all [{unit}]", *_error_cells([errors[n][kind] for n in names])])
    for phase in ("stance", "swing"):
        for i, axis in enumerate(_AXES):
            unit = "N^2" if axis[0] == "F" else "(N m)^2"
            cells = _error_cells([errors[n][phase][i] for n in names])
            rows.append([f"{axis}, {phase} [{unit}]", *cells])
    return (
        "Mean square errors on walks that the net has not seen, beside the raw command (what the "
        "plain rigid body believes) and a linear map of the same inputs.\n\n"
        + markdown_table(
            ("", "raw command", "linear map", "GRFM-Net", "net / raw", "net / linear"), rows
        )
    )


def _error_cells(values: Sequence[float]) -> list[str]:
    raw, linear, net = values
    ratio = lambda a, b: f"{a / b:.2f}" if b > 0.0 else "-"  # noqa: E731
    return [*(f"{v:.3g}" for v in values), ratio(net, raw), ratio(net, linear)]


def _shift(count: int, shift: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """What a net tells of the ground where the tuning went, before and after it saw that."""
    names = ("raw", "before", "after")
    rows = [
        [f"{where} walks, {kind} [{unit}]", *(f"{errors[name][kind]:.3g}" for name in names)]
        for where, errors in shift.items()
        for kind, unit in (("force", "N^2"), ("moment", "(N m)^2"))
    ]
    return (
        f"### Refresh {count}\n\n"
        "Walks collected again at the weights that the tuning through the net passed through, "
        "from ten iterations to converged, and the net trained anew on old and new walks. Mean "
        "square errors on walks that neither net has seen: the shift is what the net before loses "
        "from old walks to new.\n\n"
        + markdown_table(("held out", "raw command", "net before", "net after"), rows)
    )


def _film(film: Picture | str) -> str:
    if isinstance(film, str):
        return f"No film: {film.removeprefix('no film: ')}"
    return f"[{film.caption}]({film.file})"


def _reproduce(report: Report) -> str:
    commit = report.environment.get("commit", "")
    at = f" at commit `{commit}`" if commit else ""
    return (
        f"In a checkout{at}:\n\n```\n{report.command}\n```\n\n"
        "On a CPU the same command, seeds and versions give the same weights and losses. "
        "`metrics.jsonl` holds every iteration, `result.json` the verdict."
    )
