"""Search without derivatives: CMA-ES in the logarithms of 18 weights, the two feet sharing one R.

What a gradient has to be measured against. The objective is whatever `walk` says a weight set
costs; several searches go in lock-step, so that a whole generation of all is walked at once.

Each search keeps a record, FOLDER/NAME.jsonl: its settings, then a line per generation with what
was asked and what came. A search that finds a record goes through it again, asking and being told,
and goes on where it ends: the result is that of a search that was never cut. A last line that was
cut short is dropped and walked again. The budget is no part of the settings, so a record can be
carried on to a larger one, and a search of the same population and seed is its beginning. On a
machine whose linear algebra rounds differently the search carries on from all that was told, with
other draws.
"""

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.weights import (
    DIRECTION_NAMES,
    Weights,
    bounds,
    directions,
    moved,
    weights_to_vector,
)
from hector_jax.core.files import append_file, write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, Range, check

FORMAT = 1


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
    """What was asked at once, and what came."""

    steps: Float[np.ndarray, "population 18"]  # log-weights, less those of the start
    losses: Float[np.ndarray, " population"]  # infinite where there is no number


class Found(NamedTuple):
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
    folder: Path,
    about: Mapping[str, Any],
    on_generation: Callable[[Mapping[str, list[Generation]]], None] = lambda histories: None,
) -> dict[str, Found]:
    """Search from several starts in lock-step, taking up the records under `folder`.

    Args:
        config: how.
        starts: where each search starts, by its name.
        walk: the objective; it is given those searches that have not ended.
        folder: of the records.
        about: JSON values on which the losses depend; kept in the records and held to.
        on_generation: called with the histories once the records are read and after each
            generation.

    Raises:
        InputError: a start outside the box or with feet that differ, a record of another search
            or a damaged one, or cmaes, of the extra `search`, is not installed.
        WriteError: a record cannot be written.
    """
    searches = {
        name: _Search(config, start, Path(folder) / f"{name}.jsonl", about)
        for name, start in starts.items()
    }
    histories = {name: one.history for name, one in searches.items()}
    on_generation(histories)
    while waiting := {name: one for name, one in searches.items() if not one.stop}:
        # a cut may have left one record a generation behind another
        turn = min(len(one.history) for one in waiting.values())
        asked = {n: one.ask() for n, one in waiting.items() if len(one.history) == turn}
        losses = walk({n: [placed(starts[n], s) for s in steps] for n, steps in asked.items()})
        for name, steps in asked.items():
            searches[name].record(Generation(steps, np.asarray(losses[name], float)))
        on_generation(histories)
    return {name: one.found() for name, one in searches.items()}


def best(history: list[Generation]) -> tuple[Float[np.ndarray, "18"], float, int]:
    """Steps, loss and number of the best walk; the number counts from 1."""
    losses = np.concatenate([generation.losses for generation in history])
    steps = np.concatenate([generation.steps for generation in history])
    which = int(np.argmin(losses))
    return steps[which], float(losses[which]), which + 1


class _Course:
    """CMA-ES with all that it was told."""

    def __init__(
        self, config: SearchConfig, start: Weights, history: Sequence[Generation] = ()
    ) -> None:
        if find_spec("cmaes") is None:
            raise InputError('a search needs the package cmaes: pip install "hector-jax[search]"')
        from cmaes import CMA

        self.config, self.start = config, start
        self.history: list[Generation] = []
        self.optimiser = CMA(
            mean=np.zeros(len(DIRECTION_NAMES)),
            sigma=config.spread,
            bounds=room(start),
            seed=config.seed,
            population_size=config.population,
        )
        for generation in history[: config.generations]:
            self.ask()  # draws what was drawn then
            self.tell(generation)

    @property
    def stop(self) -> str:
        if len(self.history) >= self.config.generations:
            return "the budget is spent"
        return "CMA-ES has converged" if self.optimiser.should_stop() else ""

    def ask(self) -> Float[np.ndarray, "population 18"]:
        return np.stack([self.optimiser.ask() for _ in range(self.config.population)])

    def tell(self, generation: Generation) -> None:
        losses = np.where(np.isfinite(generation.losses), generation.losses, np.inf)
        self.history.append(generation._replace(losses=losses))
        self.optimiser.tell(list(zip(generation.steps, losses.tolist(), strict=True)))


class _Search:
    """One search with its record."""

    def __init__(
        self, config: SearchConfig, start: Weights, path: Path, about: Mapping[str, Any]
    ) -> None:
        self.start, self.path = start, path
        _Course(config, start)  # refuses a wrong start before there is a record
        head = {
            "format": FORMAT,
            "name": path.stem,
            "population": config.population,
            "seed": config.seed,
            "spread": config.spread,
            "start": np.asarray(weights_to_vector(start), float).tolist(),
            "directions": list(DIRECTION_NAMES),
            **about,
        }
        kept = _read(path, head)
        if kept is None:
            write_file(path, (json.dumps(head, allow_nan=False) + "\n").encode())
        self.course = _Course(config, start, kept or ())

    @property
    def history(self) -> list[Generation]:
        return self.course.history

    @property
    def stop(self) -> str:
        return self.course.stop

    def ask(self) -> Float[np.ndarray, "population 18"]:
        return self.course.ask()

    def record(self, generation: Generation) -> None:
        line = {
            "steps": generation.steps.tolist(),
            "losses": [x if math.isfinite(x) else None for x in generation.losses.tolist()],
        }
        append_file(self.path, (json.dumps(line, allow_nan=False) + "\n").encode())
        self.course.tell(generation)

    def found(self) -> Found:
        steps, loss, walk = best(self.history)
        return Found(placed(self.start, steps), loss, walk, self.history, self.stop)


def next_generation(
    config: SearchConfig, start: Weights, history: Sequence[Generation]
) -> Float[np.ndarray, "walks 18"]:
    """What a search walks after `history`; nothing once it has ended.

    Raises:
        InputError: as `search`.
    """
    course = _Course(config, start, history)
    return np.zeros((0, len(DIRECTION_NAMES))) if course.stop else course.ask()


def placed(start: Weights, steps: Float[np.ndarray, "18"]) -> Weights:
    """Weights after steps, inside the box to the last digit, whatever the logarithm rounds to."""
    return jax.tree.map(np.clip, moved(start, steps), *bounds())


def room(start: Weights) -> Float[np.ndarray, "18 2"]:
    """Steps from a start to the box, down and up.

    Raises:
        InputError: it lies outside the box, or its feet differ.
    """
    tied = directions().argmax(axis=1)  # of the left foot, where there are two
    at, low, high = (np.asarray(weights_to_vector(w), float) for w in (start, *bounds()))
    if any(np.any(part[0] != part[1]) for part in start.R):
        raise InputError("a search needs a start whose feet share one R; these differ")
    if not ((low <= at) & (at <= high)).all():
        raise InputError("the start lies outside the box of weights: Q 0.01..1e4, R 1e-7..1")
    return np.log(np.stack([low, high], axis=1) / at[:, None])[tied]


def read_record(path: Path, head: Mapping[str, Any], what: str) -> list[bytes] | None:
    """Lines of a record after its head; None without a record.

    A last line that was cut short is dropped from the file.

    Args:
        path: of the record.
        head: settings that its first line has to hold.
        what: it is a record of, for who reads the error.

    Raises:
        InputError: it is no record, or one of other settings.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    end = data.rfind(b"\n") + 1
    first, *lines = data[:end].splitlines() or [b""]
    try:
        kept = json.loads(first)
        differs = [name for name in head | kept if kept.get(name) != head.get(name)]
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not the record of a {what}: {error}") from error
    if differs:
        name = differs[0]
        raise InputError(
            f"{path}: record of another {what}: its {name} is {str(kept.get(name))[:80]}, expected "
            f"{str(head.get(name))[:80]}; choose another folder"
        )
    os.truncate(path, end)
    return lines


def _read(path: Path, head: Mapping[str, Any]) -> list[Generation] | None:
    """Generations of a record; None without one."""
    lines = read_record(path, head, "search")
    if lines is None:
        return None
    found = []
    for number, line in enumerate(lines, 2):
        try:
            told = json.loads(line)
            steps = np.array(told["steps"], float)
            losses = np.array([np.inf if x is None else x for x in told["losses"]], float)
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: line {number} is damaged: {error}") from error
        shape = (head["population"], len(DIRECTION_NAMES))
        if steps.shape != shape or losses.shape != shape[:1]:
            raise InputError(
                f"{path}: line {number} is damaged: steps {steps.shape} and losses "
                f"{losses.shape}, expected {shape} and {shape[:1]}"
            )
        found.append(Generation(steps, losses))
    return found
