"""Search without derivatives: CMA-ES in the logarithms of the weights, all feet sharing one R.

What a gradient has to be measured against. The objective is whatever `walk` says a weight set
costs; several searches go in lock-step, so that a whole generation of all is walked at once.

Each search keeps a journal, FOLDER/NAME.jsonl: its settings, then a line per generation with the
steps and their losses. A search that finds a journal asks for the same steps again, is told the
same losses and goes on where it ends: the result is that of a search that was never cut. The budget
is no part of the settings, so a journal can be carried on to a larger one, and a search of the same
population and seed is its beginning. On a machine whose linear algebra rounds differently the
search carries on from all losses that it was told, with other draws.
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import Q, R, bounds
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    scale_weights,
    weights_to_vector,
)
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.files import append_file, as_json, write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, Range, check

FORMAT = 1
T = TypeVar("T")


@dataclass(frozen=True)
class SearchConfig:
    """How far and how wide."""

    budget: int = 200  # walks, at most; whole generations are walked
    population: int = 10  # walks in a generation
    seed: int = 0
    spread: float = 1.0  # first standard deviation of each log-weight

    def __post_init__(self) -> None:
        check(self, budget=AT_LEAST_ONE, population=Range(4), seed=SEED, spread=POSITIVE)
        if self.budget < self.population:
            raise InputError(
                f"SearchConfig.budget must be at least the population, {self.population} walks, "
                f"got {self.budget}"
            )

    @property
    def generations(self) -> int:
        """Whole generations in the budget."""
        return self.budget // self.population


class Generation(NamedTuple):
    """Steps that were walked at once, and their losses."""

    steps: Float[np.ndarray, "population directions"]  # log-weights, less those of the start
    losses: Float[np.ndarray, " population"]  # infinite where there is no number


class SearchResult(NamedTuple):
    """The best of a search."""

    weights: Weights
    loss: float
    walk: int  # which one it was, counted from 1
    history: list[Generation]
    stop: str  # why the search ended


Walk = Callable[[Mapping[str, list[Weights]]], Mapping[str, Float[np.ndarray, " population"]]]
"""Losses of a generation of each search; a loss that is not finite counts as the worst."""


def search(
    config: SearchConfig,
    starts: Mapping[str, Weights],
    walk: Walk,
    *,
    folder: Path,
    about: Mapping[str, Any],
    on_generation: Callable[[Mapping[str, list[Generation]]], None] = lambda histories: None,
) -> dict[str, SearchResult]:
    """Search from several starts in lock-step, taking up the journals under `folder`.

    Args:
        config: how.
        starts: where each search starts, by its name.
        walk: the objective; it is given those searches that have not ended.
        folder: of the journals.
        about: JSON values on which the losses depend; kept in the journals and held to.
        on_generation: called with the histories once the journals are read and after each
            generation.

    Raises:
        InputError: a start outside the box or with feet that differ, a journal of another search
            or a damaged one, or cmaes, of the extra `search`, is not installed.
        WriteError: a journal cannot be written.
    """
    searches = {name: CmaSearch(config, start) for name, start in starts.items()}
    paths = {name: Path(folder) / f"{name}.jsonl" for name in starts}
    for name, one in searches.items():
        head = {
            "format": FORMAT,
            "name": name,
            "population": config.population,
            "seed": config.seed,
            "spread": config.spread,
            "start": np.asarray(weights_to_vector(one.start), float).tolist(),
            "directions": list(direction_names(one.start)),
            **({"others": weights_tree(one.start)["others"]} if one.start.others else {}),
            **about,
        }
        one.replay(read_journal(paths[name], head, what="search", parse=one.parse))
    histories = {name: one.history for name, one in searches.items()}
    on_generation(histories)
    while waiting := {name: one for name, one in searches.items() if not one.stop}:
        # a cut may have left one journal a generation behind another
        number = min(len(one.history) for one in waiting.values())
        steps = {name: one.ask() for name, one in waiting.items() if len(one.history) == number}
        losses = walk({n: [project(starts[n], step) for step in s] for n, s in steps.items()})
        for name in steps:
            generation = to_generation(steps[name], losses[name])
            add_row(paths[name], {k: v.tolist() for k, v in generation._asdict().items()})
            searches[name].tell(generation)
        on_generation(histories)
    results = {}
    for name, one in searches.items():
        step, loss, number = best(one.history)
        results[name] = SearchResult(project(one.start, step), loss, number, one.history, one.stop)
    return results


def best(history: Sequence[Generation]) -> tuple[Float[np.ndarray, " directions"], float, int]:
    """Steps, loss and number of the best walk; the number counts from 1."""
    steps, losses = map(np.concatenate, zip(*history, strict=True))
    which = int(np.argmin(losses))
    return steps[which], float(losses[which]), which + 1


class CmaSearch:
    """CMA-ES about a start, asked for steps and told their losses.

    Raises:
        InputError: the start lies outside the box or its feet differ, or cmaes is not installed.
    """

    def __init__(self, config: SearchConfig, start: Weights) -> None:
        if find_spec("cmaes") is None:
            raise InputError('a search needs the package cmaes: pip install "hector-jax[search]"')
        from cmaes import CMA

        self.config, self.start = config, start
        self.history: list[Generation] = []
        self.optimizer = CMA(
            mean=np.zeros(len(direction_names(start))),
            sigma=config.spread,
            bounds=log_bounds(start),
            seed=config.seed,
            population_size=config.population,
        )

    @property
    def stop(self) -> str:
        """Why the search has ended; empty while it goes on."""
        if len(self.history) >= self.config.generations:
            return "the budget is spent"
        return "CMA-ES has converged" if self.optimizer.should_stop() else ""

    def ask(self) -> Float[np.ndarray, "population directions"]:
        """Draw the next generation."""
        return np.stack([self.optimizer.ask() for _ in range(self.config.population)])

    def tell(self, generation: Generation) -> None:
        """Take in the losses of the steps that were asked for."""
        self.history.append(generation)
        self.optimizer.tell(list(zip(generation.steps, generation.losses.tolist(), strict=True)))

    def replay(self, history: Sequence[Generation]) -> None:
        """Go through an earlier history, as far as the budget reaches."""
        for generation in history[: self.config.generations]:
            self.ask()  # draws what was drawn then
            self.tell(generation)

    def parse(self, row: Mapping[str, Any]) -> Generation:
        """Generation of a row of the journal; ValueError where its size is another."""
        generation, size = to_generation(row["steps"], row["losses"]), self.config.population
        steps, losses = (x.shape for x in generation)
        wanted = (size, len(direction_names(self.start))), (size,)
        if (steps, losses) != wanted:
            raise ValueError(
                f"steps {steps} and losses {losses}, expected {wanted[0]} and {wanted[1]}"
            )
        return generation


def to_generation(steps: Any, losses: Any) -> Generation:
    """Generation of nested numbers; a loss that is null or not finite becomes infinite."""
    numbers = np.array(losses, float)
    return Generation(np.array(steps, float), np.where(np.isfinite(numbers), numbers, np.inf))


def project(start: Weights, steps: Float[np.ndarray, " directions"]) -> Weights:
    """Weights after steps, inside the box to the last digit, whatever the logarithm rounds to."""
    scaled = jax.device_get(scale_weights(start, steps))
    return jax.tree.map(np.clip, scaled, *bounds(start.others, start))


def log_bounds(start: Weights) -> Float[np.ndarray, "directions 2"]:
    """Largest steps from a start that stay in the box, down and up.

    Raises:
        InputError: it lies outside the box, or its feet differ.
    """
    tied = directions(start).argmax(axis=1)  # of the first foot, where there are several
    box = (start, *bounds(like=start))
    at, low, high = (np.asarray(weights_to_vector(w), float) for w in box)
    if any(np.any(part != part[:1]) for part in start.R):
        raise InputError("a search needs a start whose feet share one R; these differ")
    if not ((low <= at) & (at <= high)).all():
        box = ", ".join(
            f"{part.path.rpartition('.')[2]} {part.lower:g} to {part.upper:g}" for part in (Q, R)
        )
        raise InputError(f"the start lies outside the box of weights: {box}")
    return np.log(np.stack([low, high], axis=1) / at[:, None])[tied]


def read_journal(
    path: Path, head: Mapping[str, Any], *, what: str, parse: Callable[[Any], T]
) -> list[T]:
    """Rows of a journal of JSON lines after its settings; one is begun where there is none.

    A last line that was cut short is dropped from the file.

    Args:
        path: of the journal.
        head: settings that its first line has to hold.
        what: it is a journal of, for who reads the error.
        parse: makes a row of a line's value; ValueError, TypeError or KeyError where it is damaged.

    Raises:
        InputError: it is no journal, one of other settings, or damaged.
        WriteError: it cannot be written.
    """
    if not path.exists():
        write_file(path, (json.dumps(head, allow_nan=False) + "\n").encode())
        return []
    data = path.read_bytes()
    end = data.rfind(b"\n") + 1
    first, *lines = data[:end].splitlines() or [b""]
    try:
        written = json.loads(first)
        differs = [name for name in head | written if written.get(name) != head.get(name)]
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not the record of a {what}: {error}") from error
    if differs:
        name = differs[0]
        before, now = (str(of.get(name))[:80] for of in (written, head))
        raise InputError(
            f"{path}: record of another {what}: its {name} is {before}, expected {now}; "
            "choose another folder"
        )
    rows = []
    for number, line in enumerate(lines, 2):
        try:
            rows.append(parse(json.loads(line)))
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: line {number} is damaged: {error}") from error
    os.truncate(path, end)
    return rows


def add_row(path: Path, row: Mapping[str, Any]) -> None:
    """Add a row to a journal; numbers that are not finite become null.

    Raises:
        WriteError: the file cannot be written.
    """
    append_file(path, (as_json(row) + "\n").encode())
