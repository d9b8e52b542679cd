"""How low can one weight set go on many plants? A search with thousands of walks.

CMA-ES over the mean loss on several plants of `hfs-varied` and all three commands at once, from
`shipped` or another start, in the steps of the tuner (`parameters.stepped`). Its answer is the mean
of the last distribution. It walks on the plants of the search and on as many others: what it gains
on the former alone is fitted to them.

    python experiments/many_plants.py --tune weights
    python experiments/many_plants.py --tune all --generations 40

Report, weights and the generations so far are in OUT/TUNE; a later call continues there.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, cast

import jax
import lib
import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import step_bounds, tunables, weights_after
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights, save_weights, shipped, weights_tree
from hector_jax.core.console import bar
from hector_jax.core.environment import code_hash
from hector_jax.core.files import make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError, plural, require_package
from hector_jax.core.journal import add_row, continue_journal
from hector_jax.core.pool import workers
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, Range
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import tree_hash
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.store import tunings
from hector_jax.store.cache import content_key, robot_hash
from hector_jax.store.setup import Setup
from hector_jax.tuning.loss import loss_of
from hector_jax.verdict import judging, metrics
from hector_jax.walk_tuning.campaign import Campaign


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to search."""

    tune: tuple[str, ...] = ("weights",)  # as `hector tune --tune`
    start: Path | None = None  # a weights file; by default the set `shipped`
    plants: Annotated[int, AT_LEAST_ONE] = 16  # to search on, and as many others to judge by
    first_plant: Annotated[int, SEED] = 100  # seed of the first one
    generations: Annotated[int, AT_LEAST_ONE] = 30
    population: Annotated[int, Range(4)] = 16  # weight sets in a generation
    spread: Annotated[float, POSITIVE] = 0.3  # first standard deviation: e-folds, shares of a box
    seed: Annotated[int, SEED] = 0
    engine: str = "auto"  # c (MuJoCo, on the processes), mjx (all at once), auto: mjx on a GPU
    out: Path = Path("runs/many-plants")  # folder of the reports
    robot: Path | None = None  # TOML file of another robot; HECTOR by default


_losses = jax.jit(jax.vmap(loss_of, in_axes=(None, 0)))


def losses_of(
    pool: Executor, campaign: Campaign, engine: Engine, sets: Sequence[Weights], batch: int
) -> Iterator[Float[np.ndarray, " cases"]]:
    """Yield the losses of each set in all cases of a campaign; infinite where a QP is not solved.

    Args:
        pool, campaign, engine: workers; plants and commands; engine of the walks.
        sets: weight sets.
        batch: number of walks for which a program is compiled, see `Engine`.
    """
    config, cases = campaign.config, campaign.cases
    jobs = [
        Job(weights, command, cast(Imperfections, plant), campaign.seconds, case)
        for weights in sets
        for case, (plant, command) in enumerate(cases)
    ]
    walks = engine.walk(pool, config.rollout.walk, campaign.robot, jobs, exact=False, batch=batch)
    for _ in sets:
        of_set = stack(list(islice(walks, len(cases))))
        solved = of_set.residual.max(axis=1) <= SOLVED
        yield np.where(solved, _losses(config.loss, of_set), np.inf)


def search(pool: Executor, campaign: Campaign, engine: Engine, flags: Flags) -> Weights:
    """Search from the start of a campaign; return the mean of the last distribution.

    Raises:
        InputError: cmaes is not installed, the folder has the record of another search, or a QP
            of the start is not solved.
    """
    require_package("cmaes", "race", "a search")
    from cmaes import CMA

    head = {
        "robot": robot_hash(campaign.robot),
        "settings": content_key(campaign.config, campaign.start, code=()),
        "engine": engine.key,
        "physics_bits": engine.bits(False),
        "numbers": list(campaign.config.others),
        "start": weights_tree(campaign.start),
        "plants": [tree_hash(plant) for plant in campaign.plants],
        "code": [code_hash(("walk_tuning.walks", *engine.modules)), function_id(search)],
        **{name: getattr(flags, name) for name in ("population", "spread", "seed")},
    }
    others = campaign.config.others
    lower, upper = map(np.asarray, step_bounds(campaign.start, others))
    size, dimensions = flags.population, len(lower)

    def weights_at(steps: Float[np.ndarray, " d"]) -> Weights:
        clipped = np.clip(steps, lower, upper)
        return jax.device_get(weights_after(campaign.start, clipped, others))

    def parse(row: dict[str, list]) -> tuple[Float[np.ndarray, "n d"], Float[np.ndarray, " n"]]:
        steps, losses = np.array(row["steps"], float), np.array(row["losses"], float)
        if steps.shape != (size, dimensions) or losses.shape != (size,):
            raise ValueError(f"steps {steps.shape}, losses {losses.shape}")
        return steps, np.where(np.isfinite(losses), losses, np.inf)  # null in the journal

    path = campaign.folder / "generations.jsonl"
    rows = continue_journal(path, head, "a search", parse)
    losses = partial(losses_of, pool, campaign, engine, batch=size * len(campaign.cases))
    at_start = next(losses([campaign.start]))
    if not np.isfinite(at_start).all():
        raise InputError("--start: a QP of these weights is not solved on at least one plant")
    evolution = CMA(np.zeros(dimensions), flags.spread, seed=flags.seed, population_size=size)
    with bar(f"searching with {size * len(campaign.cases)} walks a generation") as report_progress:
        for number in range(flags.generations):
            points = np.stack([evolution.ask() for _ in range(size)])
            if number == len(rows):
                means = [float(np.mean(x / at_start)) for x in losses([*map(weights_at, points)])]
                row = {"steps": points.tolist(), "losses": means}
                rows.append(parse(row))
                add_row(path, row)
            # the points as they were drawn, though one outside the box walked at its edge
            steps, ratios = rows[number]
            evolution.tell(list(zip(steps, ratios.tolist(), strict=True)))
            remark = f"mean L against the start {np.median(ratios):.3f}"
            report_progress(number + 1, flags.generations, remark)
    return weights_at(evolution.mean)


def main(flags: Flags) -> Path:
    """Search, and write report.md, many-plants.json and the weights."""
    robot, engine = jax.tree.map(np.asarray, load_robot(flags.robot)), choose_engine(flags.engine)
    start = shipped(robot) if flags.start is None else load_weights(flags.start, robot)
    config = tunings.tune_config(robot, others=tunables(flags.tune))
    commands = {name: named_command(name) for name in COMMANDS}
    folder, count, first = flags.out / "-".join(flags.tune), flags.plants, flags.first_plant
    make_folder(folder)
    seeds = range(first, first + 2 * count)
    plants = [named_world("hfs-varied", seed, robot.description) for seed in seeds]
    campaign = Campaign(folder, config, robot, start, commands, plants[:count])
    with workers(flags.processes) as pool:
        answer = search(pool, campaign, engine, flags)
        save_weights(folder / "weights.json", answer)
        sets = {"nominal": nominal(robot), "expert": expert(robot)}
        sets |= {"start": start, "search": answer}
        inputs, judged = (Setup(pool, config, robot), sets, commands), {}
        for title, part in (("own", slice(count)), ("others", slice(count, None))):
            options = {"title": f"walking on the {title} plants", "folder": folder}
            judged[title] = judging.judge(*inputs, plants[part], seeds[part], **options).verdict
    rows, numbers = [], {}
    for title, verdict in judged.items():
        for name in sets:
            each = [verdict.of_scene(traj) for traj in commands]
            changes = [metrics.compare(v, name, "nominal").change["L"].text() for v in each]
            falls = sum(int(v.scores[name].fallen.sum()) for v in each)
            rows.append([title, name, *changes, str(falls)])
            numbers[f"{title} {name}"] = [v.scores[name].L[:, 0].tolist() for v in each]
    walks = flags.generations * flags.population * len(campaign.cases)
    text = (
        f"{walks} walks, engine {engine.title}, on plants {first} to {first + count - 1} of "
        f"hfs-varied (`own`); `others` are {first + count} to {first + 2 * count - 1}. Change of L "
        "against nominal in %, median over the plants with its 95 % interval, walked in MuJoCo C; "
        f"falls of {plural(count * len(commands), 'walk')}."
    )
    table = markdown_table(["plants", "set", *commands, "falls"], rows)
    path, title = folder / "many-plants.json", "A search over many plants"
    return lib.write_report(path, title, [text, table], {"losses": numbers})


if __name__ == "__main__":
    lib.run(main, Flags)
