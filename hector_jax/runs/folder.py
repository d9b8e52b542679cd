"""The folder of a `hector tune` run: written while it goes on, read at any time.

`config.json` holds the flags and what follows from them, `versions.json` what it was made with,
`metrics.jsonl` a line for each iteration, `weights/` the weight sets, `result.json` the verdict.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Float

from hector_jax.control.weights import (
    Weights,
    expert,
    named_like,
    nominal,
    vector_to_weights,
    weight_names,
    weights_to_vector,
)
from hector_jax.control.weights_file import load_weights
from hector_jax.core.files import append_file, as_json, write_file
from hector_jax.core.inputs import InputError, read_text, short_repr
from hector_jax.core.settings import read_json
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import Iteration
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import Loss, with_alphas
from hector_jax.tuning.status import status_of

CONFIG, METRICS, RESULT, VERSIONS = "config.json", "metrics.jsonl", "result.json", "versions.json"
_MOST_BYTES = 100_000_000
# of what a line of metrics.jsonl holds
_KINDS = {"set": str, "iteration": int, "accepted": bool, "weights": dict, "gradient_log": dict}

Histories = dict[str, list[Iteration]]  # by set


class Run(NamedTuple):
    """A finished run."""

    name: str  # the folder as it was given
    result: Mapping[str, Any]  # result.json
    metrics: list[dict[str, Any]]  # metrics.jsonl
    settings: dict[str, Any]  # config.json, nested names joined by dots
    made_with: Mapping[str, str]  # versions.json


class RunRequest(NamedTuple):
    """What a run was started with."""

    trajectory: str  # the first, where there are several
    loss: Loss
    data: Path  # folder of its net
    net: Path | None  # or the net itself
    variant: str  # of the net
    robot: Path | None  # TOML of the robot; None: HECTOR
    body: str | None  # its `robot_hash` then; None: not in the file


def load_run(folder: Path) -> Run:
    """Read a finished run.

    Raises:
        InputError: one line naming the file that is missing or is not what a run leaves.
    """
    result, config, made_with = (read_object(folder / name) for name in (RESULT, CONFIG, VERSIONS))
    if not isinstance(result.get("sets"), dict):
        raise InputError(f"{folder / RESULT}: no `sets` in it; expected the result of a tuning")
    return Run(str(folder), result, read_metrics(folder), _flat(config), made_with)


def read_request(folder: Path) -> RunRequest:
    """Read what the run in a folder was started with.

    Raises:
        InputError: the folder is none of a run.
    """
    config = read_object(folder / CONFIG)
    try:
        # a run that has only just begun has its flags there and nothing else
        flags, loss = config["flags"], config.get("tune", {}).get("loss", {})
        return RunRequest(
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
            f"{folder / CONFIG}: expected the settings of a run of `hector tune` ({error!r})"
        ) from None


def as_line(name: str, iteration: Iteration) -> str:
    """A line of metrics.jsonl; `read_histories` reads it."""
    evaluation = iteration.evaluation
    gradient = jax.tree.map(np.multiply, evaluation.gradient, iteration.weights)

    def named(tree: Weights) -> dict[str, Any]:
        return dict(zip(weight_names(tree), weights_to_vector(tree), strict=True))

    row = {
        "set": name,
        "iteration": iteration.iteration,
        "accepted": iteration.accepted,
        "reason": iteration.reason,
        "step": iteration.step_scale,
        "L": evaluation.loss,
        **evaluation.terms,
        "fallen": evaluation.fallen,
        "residual": evaluation.residual,
        "weights": {**named(iteration.weights), **iteration.weights.others},
        "gradient_log": named(gradient),
    }
    if iteration.weights.others:  # they may be zero and have no logarithm
        row["gradient"] = dict(evaluation.gradient.others)
    plain = msgspec.to_builtins(row, enc_hook=lambda x: np.asarray(x).tolist())
    return as_json(plain) + "\n"


class Journal:
    """metrics.jsonl, a line for each iteration: as they come; in order when tunings are over."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._histories: dict[str, Sequence[Iteration]] = {}

    def write(self, histories: Mapping[str, Sequence[Iteration]]) -> None:
        """Write the file anew, with these tunings after or instead of those written before.

        Raises:
            WriteError: where the file cannot be written; the old one stays.
        """
        self._histories.update(histories)
        lines = (as_line(name, i) for name, history in self._histories.items() for i in history)
        write_file(self.path, "".join(lines).encode())

    def add(self, name: str, iteration: Iteration) -> None:
        """Write one line more.

        Raises:
            WriteError: where the file cannot be written.
        """
        append_file(self.path, as_line(name, iteration).encode())


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Lines of a run's metrics.jsonl, also while it is written: a last, cut line is left out.

    Raises:
        InputError: one line naming the file and, where it is damaged, its line.
    """
    path = folder / METRICS
    text = read_text(path, "the iterations of a run of `hector tune`", _MOST_BYTES)
    rows = []
    for number, line in enumerate(text.rpartition("\n")[0].splitlines(), 1):
        with _line(path, number):
            row = json.loads(line)
            for name, kind in _KINDS.items():
                if not isinstance(row[name], kind):
                    raise TypeError(f"{name}: {row[name]!r}")
            rows.append(row)
    return rows


def read_histories(folder: Path) -> Histories:
    """The iterations of a run so far, by set; none where nothing was written yet.

    Raises:
        InputError: one line naming the file and the line that is none of an iteration.
    """
    path = folder / METRICS
    histories: Histories = {}
    for number, row in enumerate(read_metrics(folder) if path.exists() else [], 1):
        with _line(path, number):
            histories.setdefault(row["set"], []).append(_iteration(row))
    return histories


@contextmanager
def _line(path: Path, number: int) -> Iterator[None]:
    """Blame the line for errors in the block."""
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}, line {number}: an iteration of a tuning was expected ({error!r})"
        ) from None


def _iteration(row: Mapping[str, Any]) -> Iteration:
    """Read what `as_line` wrote; null, which stands for what is not finite, becomes NaN."""
    number = partial(np.array, dtype=float)  # NaN of None

    def vector(table: Mapping[str, Any]) -> np.ndarray:
        return number([table[name] for name in weight_names(like)])

    def tree(values: np.ndarray, table: Mapping[str, Any]) -> Weights:
        weights = vector_to_weights(jnp.asarray(values), like)
        others = {name: number(table[name]) for name in names}
        return jax.tree.map(np.asarray, weights._replace(others=others))

    like = named_like(row["weights"])
    weights = vector(row["weights"])
    names = row["weights"].keys() - set(weight_names(like))
    return Iteration(
        iteration=np.array(row["iteration"]),
        weights=tree(weights, row["weights"]),
        evaluation=Evaluation(
            loss=number(row["L"]),
            terms={name: number(row[name]) for name in row if name.startswith("L_")},
            gradient=tree(vector(row["gradient_log"]) / weights, row.get("gradient", {})),
            fallen=number(row["fallen"]),
            residual=number(row["residual"]),
        ),
        status=np.array(status_of(row["reason"])),
        step_scale=number(row["step"]),
    )


def read_object(path: Path) -> dict[str, Any]:
    """Read a JSON object of a run's folder.

    Raises:
        InputError: one line naming the file that is missing or holds something else.
    """
    value = read_json(path, "a file of a run of `hector tune`", _MOST_BYTES)
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, got {short_repr(value)}")
    return value


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for key, value in tree.items():
        name = prefix + key
        flat |= _flat(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def weights_of(folder: Path, name: str, robot: Robot | None = None) -> tuple[Weights, str]:
    """Load a weight set of a run, with its description in words.

    Args:
        folder: of the run.
        name: of a file of its `weights/`; of a tuning that is still going on, whose newest accepted
            weights are taken; nominal and expert are always there.
        robot: whose nominal and expert weights they are; HECTOR by default.

    Raises:
        InputError: there is no such set; names those that there are.
    """
    path, published = folder / "weights" / f"{name}.json", {"nominal": nominal, "expert": expert}
    if path.exists():
        return load_weights(path, robot), name
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
    return {name: history[-1] for name, history in accepted.items() if history}


def loss_curves(histories: Mapping[str, Sequence[Iteration]]) -> dict[str, Float[np.ndarray, " n"]]:
    """L in 1e6 by iteration, padded to the longest history; NaN where refused or not there."""
    count, curves = max(map(len, histories.values()), default=0), {}
    for name, history in histories.items():
        losses = [one.evaluation.loss / 1e6 if one.accepted else np.nan for one in history]
        curves[name] = np.array(losses + [np.nan] * (count - len(losses)))
    return curves


def progress_sentence(histories: Mapping[str, Sequence[Iteration]], done: bool) -> str:
    """How far the tunings are."""
    newest = [
        f"{name}: iteration {one.iteration}, L {one.evaluation.loss / 1e6:.3f}e6"
        for name, one in _newest(histories).items()
    ]
    return "; ".join([*newest, "the run is done" if done else "the run goes on"])
