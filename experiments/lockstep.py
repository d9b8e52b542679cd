"""Optimizers in lock-step: in every round all walk at once what each asked for.

The journal is one file: a line of settings, the loss of the start, then a line per round with each
optimizer's steps, their losses and the seconds that it thought. A benchmark that finds its journal
goes on where that ends. The start is walked once for all and counts for none.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from optimizers import DIM, Optimizer, Steps

from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.search.cmaes import Generation, Walk, add_row, project, read_journal, to_generation

FORMAT = 1
START = "start"


class Round(NamedTuple):
    """What an optimizer did in a round."""

    walked: Generation
    seconds: float  # of thinking


class BenchmarkResult(NamedTuple):
    """A whole benchmark."""

    start: float  # loss
    rounds: dict[str, list[Round]]  # by optimizer


Think = Callable[
    [Mapping[str, tuple[Optimizer, Weights, Sequence[Generation]]]],
    Mapping[str, tuple[Steps, float]],
]
"""Steps that each optimizer asks for, and the seconds it took."""


def benchmark(
    optimizers: Mapping[str, Optimizer],
    start: Weights,
    rollouts: int,
    *,
    think: Think,
    walk: Walk,
    path: Path,
    about: Mapping[str, Any],
    on_round: Callable[[BenchmarkResult], None] = lambda result: None,
) -> BenchmarkResult:
    """Compare optimizers in lock-step, taking up the journal.

    Args:
        optimizers: by name.
        start: of all.
        rollouts: walks of each, at most.
        think: asks them.
        walk: the objective; a loss that is not finite counts as infinite.
        path: of the journal.
        about: JSON values on which all depends; kept in the journal and held to.
        on_round: called once the journal is read and after each round.

    Raises:
        InputError: a rollout too few, a start without a loss, a journal of another race or a
            damaged one, or what an optimizer raises.
        WriteError: the journal cannot be written.
    """
    if rollouts < 1:
        raise InputError(f"a race needs at least one rollout, got {rollouts}")
    head = {"format": FORMAT, "rollouts": rollouts, "rivals": sorted(optimizers), **about}
    rows: list[Any] = read_journal(path, head, what="race", parse=_round_of_each)
    if not rows:
        loss = float(walk({START: [start]})[START][0])
        if not np.isfinite(loss):
            raise InputError(f"the start cannot be raced from: its loss is {loss}")
        rows = [{START: loss}]
        add_row(path, rows[0])
    first = to_generation(np.zeros((1, DIM)), [rows[0][START]])
    result = BenchmarkResult(rows[0][START], {name: [] for name in optimizers})
    for row in rows[1:]:
        for name, one in row.items():
            result.rounds[name].append(one)
    on_round(result)
    while True:
        left = {name: rollouts - walks(rounds) for name, rounds in result.rounds.items()}
        thought = think(
            {
                name: (optimizer, start, [first, *(one.walked for one in result.rounds[name])])
                for name, optimizer in optimizers.items()
                if left[name] > 0
            }
        )
        thought = {n: (s[: left[n]], seconds) for n, (s, seconds) in thought.items() if len(s)}
        if not thought:
            return result
        losses = walk({n: [project(start, s) for s in steps] for n, (steps, _) in thought.items()})
        row = {
            name: {"steps": steps.tolist(), "losses": losses[name].tolist(), "seconds": seconds}
            for name, (steps, seconds) in thought.items()
        }
        add_row(path, row)
        for name, one in _round_of_each(row).items():
            result.rounds[name].append(one)
        on_round(result)


def _round_of_each(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the journal: the round of each optimizer, or the loss of the start."""
    if START in row:
        return {START: float(row[START])}
    return {
        name: Round(to_generation(one["steps"], one["losses"]), one["seconds"])
        for name, one in row.items()
    }


def walks(rounds: Sequence[Round]) -> int:
    """Number of walks in some rounds."""
    return sum(len(one.walked.losses) for one in rounds)


def lowest(start: float, rounds: Sequence[Round]) -> Float[np.ndarray, " walked"]:
    """The lowest loss after each walk, that of the start first."""
    losses = [one.walked.losses for one in rounds]
    return np.minimum.accumulate(np.concatenate([[start], *losses]))
