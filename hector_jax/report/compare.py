"""Several finished runs side by side: as JSON values, and as a table on the terminal."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hector_jax.core.inputs import InputError
from hector_jax.report.report import VOID, plain_console
from hector_jax.store.run import RESULT, Histories, Run
from hector_jax.verdict.metrics import BASELINES, Interval


def compare_runs(runs: Sequence[Run]) -> dict[str, Any]:
    """Compare several runs, as JSON values.

    `runs` is a list of `run`, `seconds` (null if unknown), `sets.<name>` (the verdict on the
    stand-in from result.json, with the numbers of seeds and `walks`), `versions` and
    `tuning.<name>.{iterations, refused}`; `differ.settings` and `differ.versions` hold the entries
    that differ between the runs, one value per run, null if a run has none.

    Raises:
        InputError: there is no run, or one has no verdict on the stand-in.
    """
    if not runs:
        raise InputError("expected at least one run folder, got none")
    rows = [
        {
            "run": str(run.folder),
            "seconds": float(run.made_with["seconds"]) if "seconds" in run.made_with else None,
            "sets": {name: _verdict(run, name) for name in run.result["sets"]},
            "tuning": _iterations(run.histories),
            "versions": dict(run.made_with),
        }
        for run in runs
    ]
    settings = _differing([run.settings for run in runs])
    versions = _differing([run.made_with for run in runs])
    versions.pop("seconds", None)
    return {"runs": rows, "differ": {"settings": settings, "versions": versions}}


def _verdict(run: Run, name: str) -> dict[str, Any]:
    try:
        verdict = run.result["sets"][name]["standin"]
        seeds = len(verdict["seeds"])
        counts = {"seeds": seeds, "walks": seeds * len(verdict["scenes"])}
        verdict = verdict | counts | {"falls": int(verdict["falls"])}
        _cells(name, verdict)  # raises if the file lacks a printed value
        return verdict
    except (KeyError, TypeError, AttributeError, ValueError):
        raise InputError(f"{run.folder / RESULT}: set {name} has no verdict") from None


def _iterations(histories: Histories) -> dict[str, dict[str, int]]:
    return {  # the start is not an iteration
        name: {"iterations": len(rows) - 1, "refused": sum(not i.accepted for i in rows)}
        for name, rows in histories.items()
    }


def _differing(tables: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    rows = {name: [table.get(name) for table in tables] for names in tables for name in names}
    return {name: values for name, values in rows.items() if any(v != values[0] for v in values)}


def print_comparison(comparison: Mapping[str, Any], console: Console | None = None) -> None:
    """Print the result of `compare_runs` as a table with a column for each run.

    Args:
        comparison: result of `compare_runs`.
        console: output; None means stdout.
    """
    runs, differ = comparison["runs"], comparison["differ"]
    console = plain_console(console, width=60 + 60 * len(runs))
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("on the hardware stand-in", no_wrap=True)
    for run in runs:
        table.add_column(Text("/".join(Path(run["run"]).parts[-2:])), justify="right")

    def add(title: str, cells: Iterable[Any]) -> None:
        table.add_row(Text(title), *(Text("-" if cell is None else str(cell)) for cell in cells))

    for name in dict.fromkeys(name for run in runs for name in run["sets"]):
        columns = [_cells(name, run["sets"][name]) if name in run["sets"] else {} for run in runs]
        for title in max(columns, key=len):
            add(title, (column.get(title) for column in columns))
        table.add_section()
    for name in dict.fromkeys(name for run in runs for name in run["tuning"]):
        counts = [run["tuning"].get(name) for run in runs]
        texts = (count and f"{count['iterations']} ({count['refused']})" for count in counts)
        add(f"{name}: iterations (refused)", texts)
    seconds = [run["seconds"] for run in runs]
    add("time of the last call [s]", (None if s is None else f"{s:.0f}" for s in seconds))
    add("commit", (re.sub(r"^(\w{10})\w*", r"\1", r["versions"].get("commit", "-")) for r in runs))
    for kind, rows in differ.items():
        table.add_section()
        for name, values in rows.items():
            if name != "commit":
                add(f"{kind}: {name}", values)
    console.print(table)
    if any(name.startswith("tune.loss") for name in differ["settings"]):
        console.print("The losses differ (see the settings), so that their L cannot be compared.")
    if len(runs) > 1 and not any(differ.values()):
        console.print("All settings and versions are the same.")
    note = (
        "L and L_ctrl are means over the walks, changes medians of L with 95 % intervals over "
        f"plants; {VOID} falls make a comparison void."
    )
    console.print(Text(note, style="dim"))


def _cells(name: str, verdict: Mapping[str, Any]) -> dict[str, str]:
    """Return the cells of one weight set of one run by the title of the row."""
    cells = {f"{name}: L [1e6]": f"{verdict['L']['mean'] / 1e6:.3f}"}
    for baseline in BASELINES:
        if change := verdict["change"].get(baseline):
            # null if there is no interval
            low, high = (math.nan if change[k] is None else change[k] for k in ("low", "high"))
            text = Interval(change["median"], low, high).text()
            cells[f"  against {baseline} [%]"] = text + VOID * (not change["counts"])
    if "L_ctrl" in verdict:  # a loss of one's own may be without
        cells["  L_ctrl [1e6]"] = f"{verdict['L_ctrl']['mean'] / 1e6:.3f}"
    return cells | {"  falls": f"{verdict['falls']} of {verdict['walks']}"}
