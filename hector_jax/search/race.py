"""Rivals in lock-step: in every round all walk at once what each asked for.

The record is one file: a line of settings, the loss of the start, then a line per round with what
each was asked, what came and how long it thought. A race that finds its record goes on where that
ends; a last line that was cut short is dropped and walked again. The start is walked once for all
and counts for none.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.control.weights import DIRECTION_NAMES, Weights
from hector_jax.core.files import append_file, as_json, write_file
from hector_jax.core.inputs import InputError
from hector_jax.search.cmaes import Generation, Walk, placed, read_record
from hector_jax.search.rivals import Rival, Steps

FORMAT = 1
START = "start"


class Turn(NamedTuple):
    """What a rival did in a round."""

    walked: Generation
    seconds: float  # of thinking


class Raced(NamedTuple):
    """A whole race."""

    start: float  # loss
    turns: dict[str, list[Turn]]  # by rival


Think = Callable[
    [Mapping[str, tuple[Rival, Weights, Sequence[Generation]]]], Mapping[str, tuple[Steps, float]]
]
"""Steps that each rival asks for, and the seconds it took."""


def race(
    rivals: Mapping[str, Rival],
    start: Weights,
    rollouts: int,
    think: Think,
    walk: Walk,
    path: Path,
    about: Mapping[str, Any],
    on_round: Callable[[Raced], None] = lambda raced: None,
) -> Raced:
    """Race, taking up the record.

    Args:
        rivals: by name.
        start: of all.
        rollouts: walks of each, at most.
        think: asks them.
        walk: the objective; a loss that is not finite counts as infinite.
        path: of the record.
        about: JSON values on which all depends; kept in the record and held to.
        on_round: called once the record is read and after each round.

    Raises:
        InputError: a rollout too few, a start without a loss, a record of another race or a damaged
            one, or what a rival raises.
        WriteError: the record cannot be written.
    """
    if rollouts < 1:
        raise InputError(f"a race needs at least one rollout, got {rollouts}")
    head = {"format": FORMAT, "rollouts": rollouts, "rivals": sorted(rivals), **about}
    lines = _read(path, head)
    if lines is None:
        write_file(path, (json.dumps(head, allow_nan=False) + "\n").encode())
        lines = []
    if not lines:
        loss = float(walk({START: [start]})[START][0])
        if not np.isfinite(loss):
            raise InputError(f"the start cannot be raced from: its loss is {loss}")
        lines = [{START: loss}]
        _append(path, lines[0])
    here = Generation(np.zeros((1, len(DIRECTION_NAMES))), np.array([lines[0][START]]))
    raced = Raced(lines[0][START], {name: [] for name in rivals})
    for line in lines[1:]:
        _note(raced, line)
    on_round(raced)
    while True:
        left = {name: rollouts - walks(turns) for name, turns in raced.turns.items()}
        asked = think(
            {
                name: (rival, start, [here, *(turn.walked for turn in raced.turns[name])])
                for name, rival in rivals.items()
                if left[name] > 0
            }
        )
        asked = {n: (s[: left[n]], seconds) for n, (s, seconds) in asked.items() if len(s)}
        if not asked:
            return raced
        losses = walk({n: [placed(start, s) for s in steps] for n, (steps, _) in asked.items()})
        line = {
            name: {"steps": steps.tolist(), "losses": losses[name].tolist(), "seconds": seconds}
            for name, (steps, seconds) in asked.items()
        }
        _append(path, line)
        _note(raced, line)
        on_round(raced)


def walks(turns: Sequence[Turn]) -> int:
    """How many walks there were."""
    return sum(len(turn.walked.losses) for turn in turns)


def lowest(start: float, turns: Sequence[Turn]) -> Float[np.ndarray, " walked"]:
    """The lowest loss after each walk, that of the start first."""
    losses = [turn.walked.losses for turn in turns]
    return np.minimum.accumulate(np.concatenate([[start], *losses]))


def _note(raced: Raced, line: Mapping[str, Any]) -> None:
    for name, told in line.items():
        losses = np.array([np.inf if x is None else x for x in told["losses"]], float)
        losses = np.where(np.isfinite(losses), losses, np.inf)
        walked = Generation(np.array(told["steps"], float), losses)
        raced.turns[name].append(Turn(walked, told["seconds"]))


def _append(path: Path, line: Mapping[str, Any]) -> None:
    append_file(path, (as_json(line) + "\n").encode())


def _read(path: Path, head: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """Lines of a record after its head; None without one."""
    lines = read_record(path, head, "race")
    try:
        return None if lines is None else [json.loads(line) for line in lines]
    except ValueError as error:
        raise InputError(f"{path}: not the record of a race: {error}") from error
