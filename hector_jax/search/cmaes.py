"""Search without derivatives: CMA-ES in the logarithms of the weights, with one R for all feet.

The benchmark of the gradient. The objective is the loss that `walk` returns for a weight set;
several searches run in lock-step, so that the generations of all are walked in parallel.

Each search keeps a journal, FOLDER/NAME.jsonl: its settings, then a line per generation with the
steps and their losses. A search with a journal replays its steps and losses and continues after
them: the result is that of a search without interruption. The budget is no part of the settings, so
a journal can be continued to a larger budget, and begins like that of a smaller one with the same
population and seed. On a machine whose linear algebra rounds differently the search continues from
all losses of the journal, with other draws.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import Q, R, bounds, step_bounds, weights_after
from hector_jax.control.weights import Weights, direction_names, weights_to_vector
from hector_jax.control.weights_file import weights_tree
from hector_jax.core.inputs import InputError, require_package
from hector_jax.core.journal import add_row, continue_journal
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, Range, check

FORMAT = 1


@dataclass(frozen=True)
class SearchConfig:
    """Settings of a search."""

    budget: int = 200  # walks, at most; only whole generations are walked
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
        """Number of whole generations in the budget."""
        return self.budget // self.population


class Generation(NamedTuple):
    """Steps of a generation, and their losses."""

    steps: Float[np.ndarray, "population directions"]  # log-weights less those of the start
    losses: Float[np.ndarray, " population"]  # infinite if not a finite number


class SearchResult(NamedTuple):
    """Best weights of a search."""

    weights: Weights
    loss: float
    walk: int  # number of the walk, counted from 1
    history: list[Generation]
    stop: str  # reason of the end


Walk = Callable[[Mapping[str, list[Weights]]], Mapping[str, Float[np.ndarray, " population"]]]
"""Function that returns the losses of a generation of each search; not finite is the worst."""


def search(
    config: SearchConfig,
    starts: Mapping[str, Weights],
    walk: Walk,
    *,
    folder: Path,
    about: Mapping[str, Any],
    on_generation: Callable[[Mapping[str, list[Generation]]], None] = lambda histories: None,
) -> dict[str, SearchResult]:
    """Search from several starts in lock-step, continuing the journals in `folder`.

    Args:
        config: the settings.
        starts: start of each search, by its name.
        walk: the objective; called with the searches that have not ended.
        folder: of the journals.
        about: JSON values on which the losses depend; a journal with other values is refused.
        on_generation: called with the histories after the journals are read and after each
            generation.

    Raises:
        InputError: a start is outside the box or has unequal feet, a journal is damaged or of
            another search, or cmaes, of the extra `search`, is not installed.
        WriteError: a journal cannot be written.
    """
    searches = {name: CmaSearch(config, start) for name, start in starts.items()}
    paths = {name: Path(folder) / f"{name}.jsonl" for name in starts}
    settings = {key: value for key, value in asdict(config).items() if key != "budget"}
    for name, search in searches.items():
        head = {
            "format": FORMAT,
            "name": name,
            **settings,
            "start": np.asarray(weights_to_vector(search.start), float).tolist(),
            "directions": list(direction_names(search.start)),
            **about,
        }
        if search.start.others:
            head["others"] = weights_tree(search.start)["others"]
        history = continue_journal(paths[name], head, "a search", search.parse)
        for generation in history[: config.generations]:
            search.ask()  # repeats the draws of that generation
            search.tell(generation)
    histories = {name: search.history for name, search in searches.items()}
    on_generation(histories)
    while active := {name: search for name, search in searches.items() if not search.stop}:
        # an interruption may have left one journal a generation behind another
        number = min(len(search.history) for search in active.values())
        steps = {name: s.ask() for name, s in active.items() if len(s.history) == number}
        sets = {n: [weights_after(starts[n], step) for step in s] for n, s in steps.items()}
        losses = walk(jax.device_get(sets))
        for name in steps:
            generation = to_generation(steps[name], losses[name])
            add_row(paths[name], {k: v.tolist() for k, v in generation._asdict().items()})
            searches[name].tell(generation)
        on_generation(histories)
    return {name: search.result() for name, search in searches.items()}


def best_point(
    history: Sequence[Generation],
) -> tuple[Float[np.ndarray, " directions"], float, int]:
    """Return steps, loss and number of the best walk; the number counts from 1."""
    steps, losses = map(np.concatenate, zip(*history, strict=True))
    index = int(np.argmin(losses))
    return steps[index], float(losses[index]), index + 1


class CmaSearch:
    """CMA-ES about a start, by an ask-and-tell interface.

    Raises:
        InputError: the start lies outside the box or its feet differ, or cmaes is not installed.
    """

    def __init__(self, config: SearchConfig, start: Weights) -> None:
        require_package("cmaes", "search", "a search")
        from cmaes import CMA

        self.config, self.start = config, start
        self.history: list[Generation] = []
        self.optimizer = CMA(
            mean=np.zeros(len(direction_names(start))),
            sigma=config.spread,
            bounds=checked_bounds(start),
            seed=config.seed,
            population_size=config.population,
        )

    @property
    def stop(self) -> str:
        """Reason of the end of the search; empty before it."""
        if len(self.history) >= self.config.generations:
            return "the budget is spent"
        return "CMA-ES has converged" if self.optimizer.should_stop() else ""

    def ask(self) -> Float[np.ndarray, "population directions"]:
        """Draw the next generation."""
        return np.stack([self.optimizer.ask() for _ in range(self.config.population)])

    def tell(self, generation: Generation) -> None:
        """Update with the losses of the generation drawn last."""
        self.history.append(generation)
        self.optimizer.tell(list(zip(generation.steps, generation.losses.tolist(), strict=True)))

    def result(self) -> SearchResult:
        """Return the best weights so far."""
        steps, loss, number = best_point(self.history)
        weights = jax.device_get(weights_after(self.start, steps))
        return SearchResult(weights, loss, number, self.history, self.stop)

    def parse(self, row: Mapping[str, Any]) -> Generation:
        """Return the generation of a row of the journal; ValueError if its size is wrong."""
        steps, losses = generation = to_generation(row["steps"], row["losses"])
        size, count = self.config.population, len(direction_names(self.start))
        if (steps.shape, losses.shape) != ((size, count), (size,)):
            got = f"{steps.shape} and losses {losses.shape}"
            raise ValueError(f"steps {got}, expected {(size, count)} and {(size,)}")
        return generation


def to_generation(steps: Any, losses: Any) -> Generation:
    """Return a generation from nested lists; a loss that is null or not finite becomes infinite."""
    numbers = np.array(losses, float)
    return Generation(np.array(steps, float), np.where(np.isfinite(numbers), numbers, np.inf))


def checked_bounds(start: Weights, others: Sequence[str] = ()) -> Float[np.ndarray, "n 2"]:
    """Return the `step_bounds` from a start in the box, as two columns.

    Raises:
        InputError: the start lies outside the box, or its feet differ.
    """
    trees = (start, *bounds(like=start))
    at, low, high = (np.asarray(weights_to_vector(w), float) for w in trees)
    if any(np.any(part != part[:1]) for part in start.R):
        raise InputError("a search needs a start whose feet share one R; these differ")
    if not ((low <= at) & (at <= high)).all():
        box = ", ".join(f"{n} {x.lower:g} to {x.upper:g}" for n, x in {"Q": Q, "R": R}.items())
        raise InputError(f"the start lies outside the box of weights: {box}")
    return np.stack(step_bounds(start, others), axis=1)
