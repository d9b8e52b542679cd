"""The folder of a tuning as it stands, while the run goes on or after it: course and weights."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.control.weights import WEIGHT_NAMES, Weights, expert, nominal, vector_to_weights
from hector_jax.robot import Robot
from hector_jax.storage import load_weights
from hector_jax.tuning.difftune import Evaluation, Iteration
from hector_jax.tuning.loss import LossConfig, Losses

METRICS, RESULT = "metrics.jsonl", "result.json"

Histories = dict[str, list[Iteration]]  # by set


class Asked(NamedTuple):
    """What a run was asked for."""

    trajectory: str
    loss: LossConfig
    data: Path  # folder of its net
    variant: str  # of the net
    robot: Path | None  # TOML of the biped; None: HECTOR


def read_asked(folder: Path) -> Asked:
    """What the run in a folder was asked for.

    Raises:
        ValueError: the folder is none of a run.
    """
    try:
        config = json.loads((Path(folder) / "config.json").read_text())
        # a run that has only just begun knows its flags and nothing else
        flags, loss = config["flags"], config.get("tune", {}).get("loss", {})
        return Asked(
            trajectory=str(flags["traj"]),
            loss=LossConfig(**loss),
            data=Path(flags["data"]),
            variant=str(flags.get("variant", "residual")),
            robot=Path(flags["robot"]) if flags.get("robot") else None,
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        told = getattr(error, "strerror", None) or repr(error)
        raise ValueError(
            f"{folder} is no run of `hector tune`: its config.json was expected there ({told})"
        ) from None


def read_metrics(folder: Path) -> Histories:
    """The iterations of a run so far; a line that is being written is left for later.

    Raises:
        ValueError: one line naming the file and the line that is none of an iteration.
    """
    path = Path(folder) / METRICS
    whole = path.read_text().rpartition("\n")[0] if path.exists() else ""
    found: Histories = {}
    for number, line in enumerate(whole.splitlines(), 1):
        try:
            row = json.loads(line)
            found.setdefault(str(row["set"]), []).append(_iteration(row))
        except (ValueError, KeyError, TypeError) as error:
            told = f"{path}, line {number}: an iteration of a tuning was expected ({error!r})"
            raise ValueError(told) from None
    return found


def _iteration(row: Mapping[str, Any]) -> Iteration:
    """What `pipeline.as_line` wrote; null, which stands for what is not finite, becomes NaN."""
    number = lambda x: np.array(np.nan if x is None else x, float)  # noqa: E731
    vector = lambda table: np.array([number(table[name]) for name in WEIGHT_NAMES])  # noqa: E731
    tree = lambda values: jax.tree.map(np.asarray, vector_to_weights(jnp.asarray(values)))  # noqa: E731
    weights = vector(row["weights"])
    return Iteration(
        iteration=int(row["iteration"]),
        weights=tree(weights),
        evaluation=Evaluation(
            loss=number(row["L"]),
            parts=Losses(*(number(row[part]) for part in ("L_Eul", "L_pos", "L_ctrl"))),
            gradient=tree(vector(row["gradient_log"]) / weights),
            fallen=number(row["fallen"]),
            residual=number(row["residual"]),
        ),
        accepted=bool(row["accepted"]),
        reason=str(row["reason"]),
        step=float(row["step"]),
    )


def weights_of(folder: Path, name: str, robot: Robot | None = None) -> tuple[Weights, str]:
    """A weight set of a run, and what it is in words.

    Args:
        folder: of the run.
        name: of a file of its `weights/`; of a tuning that is still going on, whose newest accepted
            weights are taken; nominal and expert are always there.
        robot: whose nominal and expert weights they are; HECTOR by default.

    Raises:
        ValueError: there is no such set; names those that there are.
    """
    path = Path(folder) / "weights" / f"{name}.json"
    if path.exists():
        return load_weights(path), name
    published = {"nominal": nominal, "expert": expert}
    if name in published:
        return published[name](robot), name
    newest = _newest(read_metrics(folder))
    if name in newest:
        return newest[name].weights, f"{name} at iteration {newest[name].iteration}, so far"
    there = sorted({*published, *newest, *(file.stem for file in path.parent.glob("*.json"))})
    raise ValueError(f"{folder} has no weight set {name!r}; it has {', '.join(there)}")


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
