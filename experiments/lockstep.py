"""Optimizers in lock-step: in every round the proposals of all are walked in parallel.

The journal is one file: a line of settings, the loss of the start, then a line per round with each
optimizer's steps, their losses and its computing time [s]. A benchmark with a journal continues
after its last line. The start is walked once for all and counts for none.
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
    """A round of an optimizer."""

    generation: Generation
    seconds: float  # of computing


class BenchmarkResult(NamedTuple):
    """Result of a benchmark."""

    start: float  # loss
    rounds: dict[str, list[Round]]  # by optimizer


Propose = Callable[
    [Mapping[str, tuple[Optimizer, Weights, Sequence[Generation]]]],
    Mapping[str, tuple[Steps, float]],
]
"""Function that returns the next steps of each optimizer, and its computing time [s]."""


def benchmark(
    optimizers: Mapping[str, Optimizer],
    start: Weights,
    rollouts: int,
    *,
    propose: Propose,
    walk: Walk,
    path: Path,
    about: Mapping[str, Any],
    on_round: Callable[[BenchmarkResult], None] = lambda result: None,
) -> BenchmarkResult:
    """Compare optimizers in lock-step, continuing the journal.

    Args:
        optimizers: by name.
        start: of all.
        rollouts: largest number of walks of each.
        propose: computes the next steps of each.
        walk: the objective; a loss that is not finite counts as infinite.
        path: of the journal.
        about: JSON values on which the result depends; a journal with other values is refused.
        on_round: called after the journal is read and after each round.

    Raises:
        InputError: no rollout, a start without a loss, a journal that is damaged or of another
            race, or an error of an optimizer.
        WriteError: the journal cannot be written.
    """
    if rollouts < 1:
        raise InputError(f"a race needs at least one rollout, got {rollouts}")
    head = {"format": FORMAT, "rollouts": rollouts, "rivals": sorted(optimizers), **about}
    rows: list[Any] = read_journal(path, head, what="race", parse=_parse_row)
    if not rows:
        loss = float(walk({START: [start]})[START][0])
        if not np.isfinite(loss):
            raise InputError(f"the start cannot be raced from: its loss is {loss}")
        rows = [{START: loss}]
        add_row(path, rows[0])
    first = to_generation(np.zeros((1, DIM)), [rows[0][START]])
    result = BenchmarkResult(rows[0][START], {name: [] for name in optimizers})
    for row in rows[1:]:
        for name, one_round in row.items():
            result.rounds[name].append(one_round)
    on_round(result)
    while True:
        budget = {name: rollouts - walks(rounds) for name, rounds in result.rounds.items()}
        proposals = propose(
            {
                name: (optimizer, start, [first, *(r.generation for r in result.rounds[name])])
                for name, optimizer in optimizers.items()
                if budget[name] > 0
            }
        )
        proposals = {n: (s[: budget[n]], t) for n, (s, t) in proposals.items() if len(s)}
        if not proposals:
            return result
        losses = walk({n: [project(start, x) for x in s] for n, (s, _) in proposals.items()})
        row = {
            name: {"steps": steps.tolist(), "losses": losses[name].tolist(), "seconds": seconds}
            for name, (steps, seconds) in proposals.items()
        }
        add_row(path, row)
        for name, one_round in _parse_row(row).items():
            result.rounds[name].append(one_round)
        on_round(result)


def _parse_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the round of each optimizer, or the loss of the start, of a row of the journal."""
    if START in row:
        return {START: float(row[START])}
    return {
        name: Round(to_generation(cell["steps"], cell["losses"]), cell["seconds"])
        for name, cell in row.items()
    }


def walks(rounds: Sequence[Round]) -> int:
    """Return the number of walks in some rounds."""
    return sum(len(r.generation.losses) for r in rounds)


def lowest(start: float, rounds: Sequence[Round]) -> Float[np.ndarray, " walks"]:
    """Return the lowest loss after each walk, first that of the start."""
    losses = [r.generation.losses for r in rounds]
    return np.minimum.accumulate(np.concatenate([[start], *losses]))
