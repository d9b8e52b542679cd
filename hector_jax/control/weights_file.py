"""Weights in files: JSON, and tagged numbers of another program."""

import json
import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.control.parameters import COST, TUNABLES, numbers_of, tunable
from hector_jax.control.tagged_file import is_tagged, keys_file, read_own, tagged_weights
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.files import write_json
from hector_jax.core.inputs import InputError, unknown
from hector_jax.core.settings import Range, convert, read_json
from hector_jax.core.trajectory import State
from hector_jax.robot.description import HECTOR
from hector_jax.robot.model import Robot

WEIGHTS = Range(1e-12, 1e12)  # of weights in a file; far outside it the QP is not solved


def weights_tree(weights: Weights) -> dict[str, Any]:
    """Return JSON values, `{"Q": {"euler": [..], ...}, "R": {"force": [[..], [..]], ...}}`.

    `"others": {"footstep_feedback": 0.12, ...}` follows if it is not empty.
    """
    parts = {"Q": weights.Q._asdict(), "R": weights.R._asdict(), "others": weights.others}
    return {
        part: {name: np.asarray(value).tolist() for name, value in tree.items() if np.size(value)}
        for part, tree in parts.items()
        if tree
    }


def save_weights(path: Path, weights: Weights, schema: str | None = None) -> None:
    """Write the `weights_tree` as JSON, after the path or URL of a schema if there is one.

    Raises:
        WriteError: if the file cannot be written.
    """
    tree = {} if schema is None else {"$schema": schema}
    write_json(path, tree | weights_tree(weights))


def shipped(robot: Robot | None = None) -> Weights:
    """Read the tuned weights shipped with a robot: `ROBOT-shipped.json` beside its ROBOT.toml.

    HECTOR's, which are the default, are tuned for all trajectories on drawn models alone, with the
    limit of the position error and the width of the steps (docs/results.md).

    Raises:
        InputError: one line, if the robot has no such file or the file is invalid.
    """
    toml = (HECTOR if robot is None else robot.description).path
    path = toml.with_name(f"{toml.stem}-shipped.json")
    if not path.exists():
        raise InputError(f"weights shipped: no {path}; name nominal, expert or a weights file")
    return load_weights(path, robot)


def load_weights(path: Path, robot: Robot | None = None) -> Weights:
    """Read weights that `save_weights` or a person wrote, or the tagged numbers of any file.

    Q and R have to be in the range `WEIGHTS`, `others` in their bounds in `TUNABLES`, or in those
    of the robot's numbers, which start as its description says.

    Args:
        path: JSON file, or one with tags (`tagged_file`).
        robot: the robot of the weights, HECTOR by default: R has a row for each of its feet, no
            moment of point feet (ignored if present), and gains have a number for each joint of a
            leg.

    Raises:
        InputError: one line naming the file and the entry that is missing, unknown, of the wrong
            shape, or not a number in its range.
    """
    path, like = Path(path), nominal(robot)
    # shape and range of each entry
    parts = {
        part: {n: (w.shape, WEIGHTS) for n, w in getattr(like, part)._asdict().items() if w.size}
        for part in ("Q", "R")
    }
    if is_tagged(path, text := read_own(path)):
        keys = keys_file(path)
        tags = read_own(keys) if keys else text
        costs = set(re.findall(rf"\bothers\.({COST}\w+)", tags))
        known = {**parts, "others": _others((*TUNABLES, *costs), robot)}
        entries = {f"{part}.{n}": x for part, named in known.items() for n, x in named.items()}
        tree = tagged_weights(path, text, entries)
    elif path.suffix == ".json" or text.lstrip().startswith("{"):
        tree = read_json(path, "weights", object_pairs_hook=_unique_keys)
    else:
        raise InputError(f"{path}: no JSON, and no number has a tag, as in `# hector: Q.euler[0]`")
    given = tree.get("others") if isinstance(tree, dict) else None
    costs = [n for n in given if n.startswith(COST)] if isinstance(given, dict) else []
    others = _others((*TUNABLES, *costs), robot)
    _check_keys(path, tree, (*parts, "others", "$schema"), parts)  # a schema is for editors
    values = {}
    for part, entries in {**parts, "others": others}.items():
        given = tree.get(part, {})
        if part == "R" and not like.R.moment.size and isinstance(given, dict):
            given.pop("moment", None)
        _check_keys(path, given, entries, parts.get(part, ()), f"{part}.")
        values[part] = {
            name: _numbers(path, f"{part}.{name}", value, *entries[name])
            for name, value in given.items()
        }
    weights = Weights(State(**values["Q"]), like.R._replace(**values["R"]), values["others"])
    return with_numbers(weights, robot) if robot else weights


def with_numbers(weights: Weights, robot: Robot) -> Weights:
    """Return weights with the robot's numbers that they lack, at their start."""
    starts = {name: np.asarray(number.start) for name, number in robot.description.numbers}
    return weights._replace(others={**starts, **weights.others})


def _others(names: Iterable[str], robot: Robot | None) -> dict[str, tuple[tuple[int, ...], Range]]:
    numbers = {name: tunable(name) for name in names}
    numbers |= {of.name: of for of in numbers_of(robot.description)} if robot else {}
    return {n: (x.shape(robot), Range(x.lower, x.upper)) for n, x in numbers.items()}


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if duplicates := [key for key in keys if keys.count(key) > 1]:
        raise ValueError(f'"{duplicates[0]}" is given twice')
    return dict(pairs)


def _check_keys(
    path: Path, tree: Any, known: Collection[str], required: Collection[str], prefix: str = ""
) -> None:
    expected = f"expected {', '.join(required or known)}"
    if not isinstance(tree, dict):
        where = prefix.rstrip(".") or "the file"
        raise InputError(f"{path}: {where} must be an object; {expected}")
    for key in tree:
        if key not in known:
            message = unknown("weight", prefix + key, [prefix + name for name in known])
            raise InputError(f"{path}: {message}")
    for name in required:
        if name not in tree:
            raise InputError(f'{path}: missing weight "{prefix}{name}"; {expected}')


def _numbers(path: Path, name: str, entry: Any, shape: tuple[int, ...], range: Range) -> np.ndarray:
    expected = f"{' x '.join(map(str, shape))} numbers" if shape else "a number"
    try:
        array = np.array(entry, object)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    if array.shape != shape:
        raise InputError(f"{path}: {name} must be {expected}, got {json.dumps(entry)[:60]}")
    for index, value in np.ndenumerate(array):
        place = "".join(f"[{i}]" for i in index)
        convert(value, float, range, f"{path}: {name}{place}")
    return array.astype(float)
