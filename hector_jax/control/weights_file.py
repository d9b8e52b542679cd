"""Weights as JSON files."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.control.parameters import TUNABLES
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.files import write_json
from hector_jax.core.inputs import InputError, unknown
from hector_jax.core.settings import Range, convert, read_json
from hector_jax.core.trajectory import State
from hector_jax.robot.description import HECTOR
from hector_jax.robot.model import Robot

WEIGHTS = Range(1e-12, 1e12)  # of weights in a file; far outside it the QP is not solved
_MAX_BYTES = 1_000_000


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


def best(robot: Robot | None = None) -> Weights:
    """Read the tuned weights shipped with a robot: `ROBOT-best.json` beside its ROBOT.toml.

    HECTOR's, which are the default, are the row `best` of `hector tune --traj all`, including the
    limit of the position error and the width of the steps (docs/results.md).

    Raises:
        InputError: one line, if the robot has no such file or the file is invalid.
    """
    toml = (HECTOR if robot is None else robot.description).path
    path = toml.with_name(f"{toml.stem}-best.json")
    if not path.exists():
        raise InputError(
            f"weights best: there is no {path}; tune this robot and name a file of its run"
        )
    return load_weights(path, robot)


def load_weights(path: Path, robot: Robot | None = None) -> Weights:
    """Read weights that `save_weights` or a person wrote.

    Q and R have to be in the range `WEIGHTS`, `others` in their bounds in `TUNABLES`.

    Args:
        path: JSON file.
        robot: the robot of the weights, HECTOR by default: R has a row for each of its feet, no
            moment of point feet (ignored if present), and gains have a number for each joint of a
            leg.

    Raises:
        InputError: one line naming the file and the entry that is missing, unknown, of the wrong
            shape, or not a number in its range.
    """
    path = Path(path)
    tree = read_json(path, "weights", _MAX_BYTES, object_pairs_hook=_unique_keys)
    others: Any = {}
    if isinstance(tree, dict):
        tree.pop("$schema", None)  # for editors; the content is checked here
        others = tree.pop("others", {})
    like = nominal(robot)
    _check_keys(path, tree, ("Q", "R"), "")
    if not like.R.moment.size and isinstance(tree["R"], dict):
        tree["R"].pop("moment", None)
    values = {}
    for part in ("Q", "R"):
        entries = {name: w for name, w in getattr(like, part)._asdict().items() if w.size}
        _check_keys(path, tree[part], entries, f"{part}.")
        values[part] = {
            name: _numbers(path, f"{part}.{name}", tree[part][name], w.shape, WEIGHTS)
            for name, w in entries.items()
        }
    Q, R = State(**values["Q"]), like.R._replace(**values["R"])
    return Weights(Q, R, _others(path, others, robot))


def _others(path: Path, others: Any, robot: Robot | None) -> dict[str, np.ndarray]:
    if not isinstance(others, Mapping):
        raise InputError(f"{path}: others must be an object, got {json.dumps(others)[:60]}")
    values = {}
    for name, value in others.items():
        if name not in TUNABLES:
            raise InputError(f"{path}: others: {unknown('tunable', name, TUNABLES)}")
        tunable = TUNABLES[name]
        bounds = Range(tunable.lower, tunable.upper)
        values[name] = _numbers(path, f"others.{name}", value, tunable.shape(robot), bounds)
    return values


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        keys = [key for key, _ in pairs]
        duplicate = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f'"{duplicate}" is given twice')
    return tree


def _check_keys(path: Path, tree: Any, names: Any, prefix: str) -> None:
    expected = f"expected {', '.join(names)}"
    if not isinstance(tree, dict):
        where = prefix.rstrip(".") or "the file"
        raise InputError(f"{path}: {where} must be an object; {expected}")
    for key in tree:
        if key not in names:
            message = unknown("weight", prefix + key, [prefix + name for name in names])
            raise InputError(f"{path}: {message}")
    for name in names:
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
