"""Run folders of `hector tune` read back, also while they grow, and several side by side."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from hector_jax.control.weights import WEIGHT_NAMES, Weights, expert, nominal, vector_to_weights
from hector_jax.control.weights_file import load_weights
from hector_jax.core import settings
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.report.report import VOID, change_text
from hector_jax.robot.model import Robot
from hector_jax.runs.metrics import BASELINES, Interval
from hector_jax.tuning.difftune import Iteration, status_of
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import Loss, with_alphas

METRICS, RESULT = "metrics.jsonl", "result.json"
_MOST_BYTES = 100_000_000

Histories = dict[str, list[Iteration]]  # by set


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
        InputError: one line naming the file that is missing or is not what a run leaves.
    """
    result, config, made_with = (
        read_json(folder / name) for name in (RESULT, "config.json", "versions.json")
    )
    if not isinstance(result.get("sets"), dict):
        raise InputError(f"{folder / RESULT}: no `sets` in it; expected the result of a tuning")
    return Run(str(folder), result, read_metrics(folder), _flat(config), made_with)


class Asked(NamedTuple):
    """What a run was asked for."""

    trajectory: str  # the first, where there are several
    loss: Loss
    data: Path  # folder of its net
    net: Path | None  # or the net itself
    variant: str  # of the net
    robot: Path | None  # TOML of the biped; None: HECTOR
    body: str | None  # its `robot_hash` then; None: not told


def read_asked(folder: Path) -> Asked:
    """What the run in a folder was asked for.

    Raises:
        InputError: the folder is none of a run.
    """
    config = read_json(folder / "config.json")
    try:
        # a run that has only just begun knows its flags and nothing else
        flags, loss = config["flags"], config.get("tune", {}).get("loss", {})
        return Asked(
            trajectory=str(flags["traj"] if isinstance(flags["traj"], str) else flags["traj"][0]),
            loss=with_alphas(loss),
            data=Path(flags["data"]),
            net=Path(flags["net"]) if flags.get("net") else None,
            variant=str(flags.get("variant", "residual")),
            robot=Path(flags["robot"]) if flags.get("robot") else None,
            body=config.get("robot"),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{folder / 'config.json'}: expected the settings of a run of `hector tune` ({error!r})"
        ) from None


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Lines of a run's metrics.jsonl, also while it is written: a last, cut line is left out.

    Raises:
        InputError: one line naming the file and, where it is damaged, its line.
    """
    path = folder / METRICS
    rows = []
    for number, line in enumerate(_read(path).rpartition(b"\n")[0].splitlines(), 1):
        with _line(path, number):
            row = json.loads(line)
            kinds = {"set": str, "iteration": int, "accepted": bool}
            kinds |= {"weights": dict, "gradient_log": dict}
            for name, kind in kinds.items():
                if not isinstance(row[name], kind):
                    raise TypeError(f"{name}: {row[name]!r}")
            rows.append(row)
    return rows


def read_histories(folder: Path) -> Histories:
    """The iterations of a run so far, by set; none where nothing was written yet.

    Raises:
        InputError: one line naming the file and the line that is none of an iteration.
    """
    path, found = folder / METRICS, {}
    for number, row in enumerate(read_metrics(folder) if path.exists() else [], 1):
        with _line(path, number):
            found.setdefault(row["set"], []).append(_iteration(row))
    return found


@contextmanager
def _line(path: Path, number: int) -> Iterator[None]:
    """What goes wrong within is a fault of that line."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        told = f"{path}, line {number}: an iteration of a tuning was expected ({error!r})"
        raise InputError(told) from None


def _iteration(row: Mapping[str, Any]) -> Iteration:
    """What `tunings.as_line` wrote; null, which stands for what is not finite, becomes NaN."""
    number = lambda x: np.array(np.nan if x is None else x, float)  # noqa: E731
    vector = lambda table: np.array([number(table[name]) for name in WEIGHT_NAMES])  # noqa: E731
    tree = lambda values: jax.tree.map(np.asarray, vector_to_weights(jnp.asarray(values)))  # noqa: E731
    weights = vector(row["weights"])
    return Iteration(
        iteration=np.array(row["iteration"]),
        weights=tree(weights),
        evaluation=Evaluation(
            loss=number(row["L"]),
            terms={name: number(row[name]) for name in row if name.startswith("L_")},
            gradient=tree(vector(row["gradient_log"]) / weights),
            fallen=number(row["fallen"]),
            residual=number(row["residual"]),
        ),
        status=np.array(status_of(row["reason"])),
        step_scale=number(row["step"]),
    )


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror}; expected a run folder of `hector tune`"
        ) from None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object of a run's folder.

    Raises:
        InputError: one line naming the file that is missing or holds something else.
    """
    found = settings.read_json(path, "a file of a run of `hector tune`", _MOST_BYTES)
    if not isinstance(found, dict):
        raise InputError(f"{path}: expected a JSON object, got {short_repr(found)}")
    return found


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found = {}
    for key, value in tree.items():
        found |= (
            _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
        )
    return found


def weights_of(folder: Path, name: str, robot: Robot | None = None) -> tuple[Weights, str]:
    """A weight set of a run, and what it is in words.

    Args:
        folder: of the run.
        name: of a file of its `weights/`; of a tuning that is still going on, whose newest accepted
            weights are taken; nominal and expert are always there.
        robot: whose nominal and expert weights they are; HECTOR by default.

    Raises:
        InputError: there is no such set; names those that there are.
    """
    path = folder / "weights" / f"{name}.json"
    if path.exists():
        return load_weights(path), name
    published = {"nominal": nominal, "expert": expert}
    if name in published:
        return published[name](robot), name
    newest = _newest(read_histories(folder))
    if name in newest:
        return newest[name].weights, f"{name} at iteration {newest[name].iteration}, so far"
    there = sorted({*published, *newest, *(file.stem for file in path.parent.glob("*.json"))})
    raise InputError(f"{folder} has no weight set {name!r}; it has {', '.join(there)}")


def _newest(histories: Mapping[str, Sequence[Iteration]]) -> dict[str, Iteration]:
    """The last accepted iteration of each set that has one."""
    accepted = {name: [i for i in history if i.accepted] for name, history in histories.items()}
    return {name: kept[-1] for name, kept in accepted.items() if kept}


def curves(histories: Mapping[str, Sequence[Iteration]]) -> dict[str, Float[np.ndarray, " n"]]:
    """L in 1e6 by iteration, all sets as long as the longest; NaN: refused, or not there."""
    count = max((len(history) for history in histories.values()), default=0)
    found = {name: np.full(count, np.nan) for name in histories}
    for name, history in histories.items():
        for k, one in enumerate(history):
            if one.accepted:
                found[name][k] = one.evaluation.loss / 1e6
    return found


def as_sentence(histories: Mapping[str, Sequence[Iteration]], done: bool) -> str:
    """How far the tunings are."""
    far = [
        f"{name}: iteration {one.iteration}, L {one.evaluation.loss / 1e6:.3f}e6"
        for name, one in _newest(histories).items()
    ]
    return "; ".join([*far, "the run is done" if done else "the run goes on"])


def compare_runs(runs: Sequence[Run]) -> dict[str, Any]:
    """Several runs side by side, as JSON values.

    `runs` is a list of `run`, `seconds` (null where the run did not say), `sets.<name>` (as the
    verdict on the stand-in in result.json, with the number of seeds), `versions` and
    `tuning.<name>.{iterations, refused}`; `differ.settings` and `differ.versions` hold what is not
    the same in all, a value for each run, null where a run does not know it.

    Raises:
        InputError: no run, or one without a verdict on the stand-in.
    """
    if not runs:
        raise InputError("expected at least one run folder, got none")
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
        raise InputError(
            f"{Path(run.name) / RESULT}: set {name} has no verdict on the stand-in"
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
        # null where there is no interval
        ends = (np.nan if found[key] is None else found[key] for key in ("low", "high"))
        interval = Interval(found["median"], *ends)
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
