"""How low can one weight set go on many plants? A search with thousands of walks.

CMA-ES over the mean loss on several plants of `hfs-varied` and all three commands at once, from
the tuned set, in the metric of the model. Its answer is the mean of the last distribution, walked
on the plants of the search and on as many others: what it gains on the former alone is luck.

    python experiments/ceiling.py --tune weights --out runs/ceiling
    python experiments/ceiling.py --tune all --generations 40

The generations are stored in OUT/NAME/generations.jsonl, and a later call continues after them.
"""

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import jax
import numpy as np
import tyro
from jaxtyping import Float
from lib import write_report

from hector_jax.control.parameters import tunables
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import best, load_weights, save_weights, weights_tree
from hector_jax.core.console import bar, exit_code
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import require_package
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, Range, check
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree_file import tree_hash
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import load_robot
from hector_jax.runs import tunings
from hector_jax.runs.cache import content_key, robot_hash
from hector_jax.runs.metrics import bootstrap
from hector_jax.runs.walks import Campaign, space_of, weights_at
from hector_jax.search.cmaes import Generation, add_row, read_journal, to_generation
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.tuning.loss import loss_of


@dataclass(frozen=True)
class Flags:
    """What to search."""

    tune: tuple[str, ...] = ("weights",)  # as `hector tune --tune`
    start: Path | None = None  # a weights file; by default the set `best`
    plants: int = 16  # to search on, and as many others to judge by
    first_plant: int = 100  # seed of the first one
    generations: int = 30
    population: int = 16  # weight sets in a generation
    spread: float = 0.3  # first standard deviation, in the metric of the model
    seed: int = 0
    engine: str = "auto"  # c (MuJoCo, on the processes), mjx (all at once), auto: mjx on a GPU
    out: Path = Path("runs/ceiling")  # folder of the report
    robot: Path | None = None  # TOML file of another robot; HECTOR by default
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        counts = dict.fromkeys(("plants", "generations", "processes"), AT_LEAST_ONE)
        check(self, **counts, population=Range(4), spread=POSITIVE, seed=SEED, first_plant=SEED)


def plant_losses(
    pool: Executor, campaign: Campaign, engine: Engine, sets: Sequence[Weights]
) -> Iterator[Float[np.ndarray, " cases"]]:
    """Yield the losses of each weight set in all cases of a campaign; infinite if not solved."""
    config, robot, cases = campaign.config, campaign.robot, campaign.cases
    jobs = [
        Job(weights, command, plant, campaign.seconds, case)
        for weights in sets
        for case, (plant, command) in enumerate(cases)
        if plant is not None
    ]
    walks = engine.walk(pool, config.rollout.walk, robot, jobs, exact=False)
    for _ in sets:
        rows = [
            (float(loss_of(config.loss, walk)), walk.residual.max())
            for walk in islice(walks, len(cases))
        ]
        yield np.array([loss if worst <= SOLVED else np.inf for loss, worst in rows])


def search(pool: Executor, campaign: Campaign, engine: Engine, flags: Flags) -> Weights:
    """Search from the start of a campaign; return the mean of the last distribution."""
    require_package("cmaes", "search", "a search")
    from cmaes import CMA

    space = space_of(pool, campaign)
    dimensions, size = len(space.box), flags.population
    evolution = CMA(np.zeros(dimensions), flags.spread, seed=flags.seed, population_size=size)
    path, code = campaign.folder / "generations.jsonl", ("sim.walk", "sim.parallel")
    head = {
        "robot": robot_hash(campaign.robot),
        "settings": content_key(campaign.config, code=code),
        "start": weights_tree(campaign.start),
        "plants": [tree_hash(plant) for plant in campaign.plants],
        **{name: getattr(flags, name) for name in ("population", "spread", "seed")},
    }

    def parse(row: dict[str, list]) -> Generation:
        generation = to_generation(row["steps"], row["losses"])
        if generation.steps.shape != (size, dimensions) or generation.losses.shape != (size,):
            raise ValueError(f"steps {generation.steps.shape}, losses {generation.losses.shape}")
        return generation

    rows = read_journal(path, head, what="search", parse=parse)[: flags.generations]
    at_start = next(plant_losses(pool, campaign, engine, [campaign.start]))
    with bar(f"searching with {size * len(campaign.cases)} walks a generation") as report_progress:
        for number in range(flags.generations):
            points = np.stack([evolution.ask() for _ in range(size)])
            if number == len(rows):
                sets = [weights_at(campaign, space, space.clip(point)) for point in points]
                losses = plant_losses(pool, campaign, engine, sets)
                rows.append(to_generation(points, [np.mean(row / at_start) for row in losses]))
                add_row(path, {k: v.tolist() for k, v in rows[-1]._asdict().items()})
            losses = rows[number].losses
            # of the points that were asked for: what leaves the box is walked at its edge
            evolution.tell(list(zip(rows[number].steps, losses.tolist(), strict=True)))
            remark = f"mean L against the start {np.median(losses):.3f}"
            report_progress(number + 1, flags.generations, remark)
    return weights_at(campaign, space, space.clip(evolution.mean))


def changes(
    baseline: Float[np.ndarray, "plants commands"], losses: Float[np.ndarray, "plants commands"]
) -> list[str]:
    """Return the median change of L on each command as text, with its interval."""
    ratios = 100.0 * (losses / baseline - 1.0)
    return [
        bootstrap(partial(np.median, axis=-1), column).text("{:+.0f}".format) for column in ratios.T
    ]


def main() -> None:
    """Search, and write report.md, ceiling.json and the weights."""
    flags = tyro.cli(Flags)
    setup_jax()
    robot = jax.tree.map(np.asarray, load_robot(flags.robot))
    start = best(robot) if flags.start is None else load_weights(flags.start, robot)
    config, engine = (
        tunings.tune_config(robot, others=tunables(flags.tune)),
        choose_engine(flags.engine),
    )
    commands = {name: named_command(name) for name in COMMANDS}

    def campaign(first: int, folder: Path) -> Campaign:
        seeds = range(first, first + flags.plants)
        plants: list[Imperfections | None] = [
            named_world("hfs-varied", seed, robot.description) for seed in seeds
        ]
        make_folder(folder)
        return Campaign(folder, config, robot, start, commands, plants, flags.seed)

    folder = flags.out / "-".join(flags.tune)
    searched = campaign(flags.first_plant, folder)
    others = campaign(flags.first_plant + flags.plants, folder)
    with workers(flags.processes) as pool:
        answer = search(pool, searched, engine, flags)
        save_weights(folder / "weights.json", answer)
        sets = {"nominal": nominal(robot), "expert": expert(robot), "start": start, "found": answer}
        losses = {
            (title, name): next(plant_losses(pool, each, engine, [weights])).reshape(
                flags.plants, -1
            )
            for title, each in (("searched", searched), ("others", others))
            for name, weights in sets.items()
        }
    rows = [
        [title, name, *changes(losses[title, "nominal"], of_set)]
        for (title, name), of_set in losses.items()
        if name != "nominal"
    ]
    walks = flags.generations * flags.population * len(searched.cases)
    count, first = flags.plants, flags.first_plant
    text = (
        f"{walks} walks, engine {engine.title}, on plants {first} to {first + count - 1} of "
        f"hfs-varied; `others` are {first + count} to {first + 2 * count - 1}. Change of L against "
        "nominal in %, median over the plants with its 95 % interval."
    )
    numbers = {
        "flags": {name: str(value) for name, value in asdict(flags).items()},
        "losses": {f"{title} {name}": x.tolist() for (title, name), x in losses.items()},
    }
    table = markdown_table(["plants", "set", *commands], rows)
    report = write_report(
        folder / "report.md",
        "The ceiling",
        [text, table],
        numbers=numbers,
        json_name="ceiling.json",
    )
    print(report)


if __name__ == "__main__":
    sys.exit(exit_code("ceiling", main))
