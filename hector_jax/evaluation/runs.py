"""Run folders of `hector tune` read back, and several of them side by side."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hector_jax.evaluation.metrics import BASELINES, Interval
from hector_jax.evaluation.report import VOID, change_text


class Run(NamedTuple):
    """What a finished run says of itself."""

    name: str  # the folder as it was given
    result: Mapping[str, Any]  # result.json
    metrics: list[dict[str, Any]]  # metrics.jsonl
    settings: dict[str, Any]  # config.json, nested names joined by dots
    made_with: Mapping[str, str]  # versions.json


def load_run(folder: Path) -> Run:
    """Read a finished run.

    Raises:
        ValueError: one line naming the file that is missing or is not what a run leaves.
    """
    result, config, made_with = (
        _read_json(folder / name) for name in ("result.json", "config.json", "versions.json")
    )
    if not isinstance(result.get("sets"), dict):
        raise ValueError(f"{folder / 'result.json'}: no `sets` inside; expected that of a tuning")
    return Run(str(folder), result, read_metrics(folder), _flat(config), made_with)


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Lines of a run's metrics.jsonl, also while it is written: a last, cut line is left out.

    Raises:
        ValueError: one line naming the file, where it is missing or damaged.
    """
    path = folder / "metrics.jsonl"
    data = _read(path)
    lines = []
    for number, line in enumerate(data[: data.rfind(b"\n") + 1].splitlines(), 1):
        try:
            found = json.loads(line)
            sound = isinstance(found["set"], str) and isinstance(found["iteration"], int)
            sound &= {"accepted", "weights", "gradient_log"} <= found.keys()
        except (ValueError, TypeError, KeyError):
            sound = False
        if not sound:
            raise ValueError(f"{path}: line {number} is no iteration of a tuning")
        lines.append(found)
    return lines


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(
            f"cannot read {path}: {error.strerror}; expected a run folder of `hector tune`"
        ) from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(_read(path).decode())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: no valid JSON: {error}") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: expected an object, got {str(found)[:40]}")
    return found


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found = {}
    for key, value in tree.items():
        found |= (
            _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        )
    return found


def compare_runs(runs: Sequence[Run]) -> dict[str, Any]:
    """Several runs side by side, as JSON values.

    `runs` is a list of `run`, `seconds` (null where the run did not say), `sets.<name>` (as the
    verdict on the stand-in in result.json, with the number of seeds), `versions` and
    `tuning.<name>.{iterations, refused}`; `differ.settings` and `differ.versions` hold what is not
    the same in all, a value for each run, null where a run does not know it.

    Raises:
        ValueError: no run, or one without a verdict on the stand-in.
    """
    if not runs:
        raise ValueError("expected at least one run folder, got none")
    told = [
        {
            "run": run.name,
            "seconds": float(run.made_with["seconds"]) if "seconds" in run.made_with else None,
            "sets": {name: _verdict(run, name) for name in run.result["sets"]},
            "tuning": _tuning(run.metrics),
            "versions": dict(run.made_with),
        }
        for run in runs
    ]
    versions = [{k: v for k, v in run.made_with.items() if k != "seconds"} for run in runs]
    differ = {
        "settings": _differing([run.settings for run in runs]),
        "versions": _differing(versions),
    }
    return {"runs": told, "differ": differ}


def _verdict(run: Run, name: str) -> dict[str, Any]:
    try:
        found = run.result["sets"][name]["standin"]
        # both are used below: a file without them is refused here
        for part in ("L", "L_ctrl"):
            float(found[part]["mean"])
        changes = found["change"].values()
        assert all({"median", "low", "high", "counts"} <= change.keys() for change in changes)
        return {**found, "seeds": len(found["seeds"]), "falls": int(found["falls"])}
    except (KeyError, TypeError, AttributeError, ValueError, AssertionError):
        raise ValueError(
            f"{Path(run.name) / 'result.json'}: set {name} has no verdict on the stand-in"
        ) from None


def _tuning(metrics: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    found: dict[str, dict[str, int]] = {}
    for line in metrics:
        one = found.setdefault(line["set"], {"iterations": 0, "refused": 0})
        one["iterations"] = max(one["iterations"], int(line["iteration"]))
        one["refused"] += not line["accepted"]
    return found


def _differing(each: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    names = dict.fromkeys(name for one in each for name in one)
    columns = {name: [one.get(name) for one in each] for name in names}
    return {name: values for name, values in columns.items() if any(v != values[0] for v in values)}


def print_comparison(told: Mapping[str, Any], console: Console | None = None) -> None:
    """What `compare_runs` found as one table on the terminal, a column for each run.

    Args:
        told: by `compare_runs`.
        console: where to print; None takes stdout.
    """
    console = console or Console(highlight=False)
    runs = told["runs"]
    if not console.is_terminal:
        # a file has no width: no cell is to be cut or wrapped there
        width = 60 + 60 * len(runs)
        console = Console(file=console.file, highlight=False, width=width, color_system=None)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("on the hardware stand-in", no_wrap=True)
    for run in runs:
        table.add_column(Text("/".join(Path(run["run"]).parts[-2:])), justify="right")
    for name in dict.fromkeys(name for run in runs for name in run["sets"]):
        sets = [run["sets"].get(name) for run in runs]
        for row, cells in _rows(name, sets).items():
            if any(cells):
                table.add_row(Text(row), *(cell or "-" for cell in cells))
        table.add_section()
    for name in dict.fromkeys(name for run in runs for name in run["tuning"]):
        counts = [run["tuning"].get(name) for run in runs]
        table.add_row(
            Text(f"{name}: iterations (refused)"),
            *(f"{one['iterations']} ({one['refused']})" if one else "-" for one in counts),
        )
    seconds = [run["seconds"] for run in runs]
    table.add_row(Text("time [s]"), *("-" if one is None else f"{one:.0f}" for one in seconds))
    commits = [run["versions"].get("commit", "-").split() for run in runs]
    table.add_row("commit", *(" ".join([one[0][:10], *one[1:]]) for one in commits))
    for kind, rows in told["differ"].items():
        table.add_section()
        for name, values in rows.items():
            if name == "commit":
                continue
            shown = ("-" if value is None else str(value) for value in values)
            table.add_row(Text(f"{kind}: {name}"), *map(Text, shown))
    console.print(table)
    if len(runs) > 1 and not any(told["differ"].values()):
        console.print("All settings and versions are the same.")
    console.print(
        Text(
            f"L and L_ctrl are means over the plants, changes medians of L with 95 % intervals; "
            f"{VOID} falls make a comparison void.",
            style="dim",
        )
    )


def _rows(name: str, sets: Sequence[Mapping[str, Any] | None]) -> dict[str, list[str]]:
    """Rows of one weight set, a cell for each run, empty where there is nothing to tell."""

    def change(one: Mapping[str, Any], baseline: str) -> str:
        if baseline not in one["change"]:
            return ""
        found = one["change"][baseline]
        interval = Interval(*(found[key] for key in ("median", "low", "high")))
        return change_text(interval) + ("" if found["counts"] else VOID)

    rows = {
        f"{name}: L [1e6]": lambda one: f"{one['L']['mean'] / 1e6:.3f}",
        **{
            f"  against {baseline} [%]": lambda one, b=baseline: change(one, b)
            for baseline in BASELINES
        },
        "  L_ctrl [1e6]": lambda one: f"{one['L_ctrl']['mean'] / 1e6:.3f}",
        "  falls": lambda one: f"{one['falls']} of {one['seeds']}",
    }
    return {row: [tell(one) if one else "" for one in sets] for row, tell in rows.items()}
