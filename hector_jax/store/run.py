"""The folder of a `hector tune` run, which can be read while the run writes it.

`config.json` holds the flags and the settings that follow from them, `versions.json` the versions
of code and packages, `metrics.jsonl` a line for each iteration, `weights/` the weight sets,
`result.json` the verdict.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig
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
from hector_jax.core.inputs import InputError, short_repr, unknown
from hector_jax.core.journal import read_rows
from hector_jax.core.settings import convert, from_table, read_json
from hector_jax.robot.model import Robot, load_robot
from hector_jax.store.cache import robot_hash
from hector_jax.tuning.difftune import Iteration
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.loss import Loss, named_loss
from hector_jax.tuning.status import status_of

CONFIG, METRICS, RESULT, VERSIONS = "config.json", "metrics.jsonl", "result.json", "versions.json"
_MAX_BYTES = 100_000_000

Histories = Mapping[str, Sequence[Iteration]]  # by set


class RunRequest(NamedTuple):
    """Settings with which a run was started."""

    trajectory: str  # the first if there are several
    loss: Loss  # of the table
    data: Path  # folder of its net
    net: Path | None  # file of the net, if it is not in `data`
    variant: str  # of the net
    robot: Path | None  # TOML of the robot; None: HECTOR
    body: str  # `robot_hash` of the robot at the start
    params: str | None  # `tree_hash` of the parameters of the net; None: not loaded yet


@dataclass(frozen=True, eq=False)
class Run:
    """A run, finished or not: its files, each read when it is asked for.

    All of it raises an InputError, one line that names the file that is missing or is not a file
    of a run.
    """

    folder: Path  # as the user named it

    @property
    def is_finished(self) -> bool:
        """True if its verdict is written."""
        return (self.folder / RESULT).exists()

    @cached_property
    def config(self) -> dict[str, Any]:
        """The flags, and the settings that follow from them."""
        return read_object(self.folder / CONFIG)

    @property
    def settings(self) -> dict[str, Any]:
        """The same with nested names joined by dots, without its time."""
        return flattened({name: x for name, x in self.config.items() if name != "began"})

    @cached_property
    def made_with(self) -> Mapping[str, str]:
        """Versions, machine and commit."""
        return read_object(self.folder / VERSIONS)

    @cached_property
    def result(self) -> Mapping[str, Any]:
        """The verdict of a finished run."""
        result = read_object(self.folder / RESULT)
        if not isinstance(result.get("sets"), dict):
            text = "no `sets` in it; expected the result of a tuning"
            raise InputError(f"{self.folder / RESULT}: {text}")
        return result

    @property
    def histories(self) -> dict[str, list[Iteration]]:
        """The iterations so far, by set; an incomplete last line is skipped."""
        path, histories = self.folder / METRICS, {}
        if path.exists():
            for name, iteration in read_rows(path, "a tuning", _named_iteration):
                histories.setdefault(name, []).append(iteration)
        return histories

    @cached_property
    def request(self) -> RunRequest:
        """The settings that it was started with, but for those of walks made elsewhere."""
        flags = self.config.get("flags")
        if isinstance(flags, dict) and flags.get("walker"):
            text = f"its walks are those of {flags['walker']}, its weights are in"
            raise InputError(f"{self.folder}: {text} {self.folder}/weights")
        try:
            # a run that has just begun has written only its flags
            flags, loss = self.config["flags"], self.config.get("tune", {}).get("loss", {})
            return RunRequest(
                trajectory=convert(flags["traj"], tuple[str, ...], name="traj")[0],
                loss=named_loss(loss),
                data=Path(flags["data"]),
                net=flags["net"] and Path(flags["net"]),
                variant=str(flags["variant"]),
                robot=flags["robot"] and Path(flags["robot"]),
                body=self.config["robot"],
                params=self.config.get("net"),
            )
        except (LookupError, TypeError, AttributeError, ValueError) as error:
            text = f"expected the settings of a run of `hector tune` ({error!r})"
            raise InputError(f"{self.folder / CONFIG}: {text}") from None

    @property
    def robot_file(self) -> Path | None:
        """The file of its robot, also of a run whose walks are made elsewhere; None: HECTOR."""
        flags = self.config.get("flags")
        robot = flags.get("robot") if isinstance(flags, dict) else None
        return robot and Path(robot)

    @cached_property
    def robot(self) -> Robot:
        """Its robot, whose files must not have changed since."""
        robot = load_robot(self.request.robot)
        if self.request.body != robot_hash(robot):
            text = f"{robot.description.path} or its MJCF has changed"
            raise InputError(f"{self.folder} was tuned for another robot: {text}")
        return robot

    @cached_property
    def controller(self) -> WalkConfig:
        """The controller that it tunes."""
        path = self.folder / CONFIG
        try:
            table = self.config["tune"]["rollout"]["walk"]
        except (KeyError, TypeError) as error:
            text = f"not the settings of a walking controller: {error!r}"
            raise InputError(f"{path}: {text}") from error
        # a setting that this version does not know is refused: the file goes to a robot
        return from_table(f"{path}: tune.rollout.walk", WalkConfig, table)

    def weights_file(self, name: str) -> Path:
        """Return the file of a weight set; the error names the sets that there are."""
        sets = sorted(path.stem for path in (self.folder / "weights").glob("*.json"))
        if name not in sets:
            raise InputError(f"{self.folder}: {unknown('weight set', name, sets)}")
        return self.folder / "weights" / f"{name}.json"

    def weights(self, name: str, robot: Robot | None = None) -> tuple[Weights, str]:
        """Load a weight set, with its description in words.

        Args:
            name: name of a file in `weights/`; nominal or expert, which are always available; or
                name of a tuning in progress, whose newest accepted weights are taken.
            robot: robot of the nominal and expert weights; HECTOR by default.
        """
        path = self.folder / "weights" / f"{name}.json"
        published = {"nominal": nominal, "expert": expert}
        if path.exists():
            return load_weights(path, robot), name
        if name in published:
            return published[name](robot), name
        newest = _newest(self.histories)
        if name in newest:
            return newest[name].weights, f"{name} at iteration {newest[name].iteration}, so far"
        names = sorted({*published, *newest, *(file.stem for file in path.parent.glob("*.json"))})
        raise InputError(f"{self.folder} has no weight set {name!r}; it has {', '.join(names)}")


def as_row(name: str, iteration: Iteration) -> dict[str, Any]:
    """Return an iteration as a row of metrics.jsonl, for `Run.histories`."""
    evaluation = iteration.evaluation
    gradient = jax.tree.map(np.multiply, evaluation.gradient, iteration.weights)

    def named(tree: Weights) -> dict[str, Any]:
        return dict(zip(weight_names(tree), weights_to_vector(tree), strict=True))

    row = {
        "set": name,
        "iteration": iteration.iteration,
        "accepted": iteration.accepted,
        "reason": iteration.reason,
        "step": iteration.step_size,
        "L": evaluation.loss,
        **evaluation.terms,
        "fallen": evaluation.fallen,
        "residual": evaluation.residual,
        "weights": {**named(iteration.weights), **iteration.weights.others},
        "gradient_log": named(gradient),
    }
    if iteration.weights.others:  # others may be zero and have no logarithm
        row["gradient"] = dict(evaluation.gradient.others)
    return msgspec.to_builtins(row, enc_hook=lambda x: np.asarray(x).tolist())


def _named_iteration(row: Mapping[str, Any]) -> tuple[str, Iteration]:
    """Return set and iteration of a row of `as_row`; null, for a non-finite number, is NaN."""
    number = partial(np.array, dtype=float)  # NaN of None

    like = named_like(row["weights"])
    names = weight_names(like)
    other_names = row["weights"].keys() - set(names)

    def vector(table: Mapping[str, Any]) -> np.ndarray:
        return number([table[name] for name in names])

    def tree(values: np.ndarray, table: Mapping[str, Any]) -> Weights:
        weights = vector_to_weights(jnp.asarray(values), like)
        others = {name: number(table[name]) for name in other_names}
        return jax.tree.map(np.asarray, weights._replace(others=others))

    weights = vector(row["weights"])
    return row["set"], Iteration(
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
        step_size=number(row["step"]),
    )


def read_object(path: Path) -> dict[str, Any]:
    """Read a JSON object from the folder of a run.

    Raises:
        InputError: one line naming the file that is missing or is not a JSON object.
    """
    value = read_json(path, "a file of a run of `hector tune`", _MAX_BYTES)
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a JSON object, got {short_repr(value)}")
    return value


def flattened(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested dictionary as a flat dictionary whose names are joined by dots."""
    flat = {}
    for key, value in tree.items():
        name = prefix + key
        flat |= flattened(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat


def _newest(histories: Histories) -> dict[str, Iteration]:
    """Return the last accepted iteration of each set that has accepted iterations."""
    accepted = {name: [i for i in history if i.accepted] for name, history in histories.items()}
    return {name: history[-1] for name, history in accepted.items() if history}


def loss_curves(histories: Histories) -> dict[str, Float[np.ndarray, " n"]]:
    """Return the loss by iteration in % of its start, NaN if rejected and beyond the last.

    The tunings minimise different losses, so that their values cannot be compared.
    """
    count, curves = max(map(len, histories.values()), default=0), {}
    for name, history in histories.items():
        whole = history[0].evaluation.loss / 100.0
        losses = [i.evaluation.loss / whole if i.accepted else np.nan for i in history]
        curves[name] = np.array(losses + [np.nan] * (count - len(losses)))
    return curves


def progress_sentence(histories: Histories, done: bool) -> str:
    """Describe the progress of the tunings."""
    newest = [
        f"{name}: iteration {at.iteration}, loss {at.evaluation.loss / whole:.0f} % of the start"
        for name, at in _newest(histories).items()
        for whole in [histories[name][0].evaluation.loss / 100.0]
    ]
    return "; ".join([*newest, "the run is done" if done else "the run goes on"])
