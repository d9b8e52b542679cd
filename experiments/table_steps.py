"""The steps of the table: search, tune, tune along walks, and walk for the verdict.

Each stores its results and reads existing results.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
from measured import evaluate_walk, tune_measured

from hector_jax.control.reference import named_command
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import bar, say
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError, plural
from hector_jax.grfm.network import Params, effect_of
from hector_jax.robot.model import Robot
from hector_jax.search.cmaes import SearchConfig, SearchResult
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Imperfections, hfs, hfs_drawn
from hector_jax.store import tunings
from hector_jax.store.cache import content_key, load_or_make
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem, Tuned
from hector_jax.tuning.difftune import Iteration, TuneConfig
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.verdict import judging
from hector_jax.verdict.judging import ScoredWalks
from hector_jax.walk_tuning import searches

# modules of the package that decide the numbers, for `content_key`
SEARCH_CODE = ("walk_tuning.searches", "sim.walk", "sim.parallel")
WALKS_CODE = (*tunings.TUNING_CODE, "tuning.grounded", "sim.walk")


class Bench(NamedTuple):
    """Inputs of all steps."""

    setup: Setup
    params: Params  # of the net
    folder: Path  # of the artefacts


def search(
    bench: Bench, config: SearchConfig, trajectories: Sequence[str]
) -> dict[str, SearchResult]:
    """Search without derivatives from nominal, for all trajectories in lock-step."""
    engine, (_, tune, robot, _) = choose_engine("auto"), bench.setup
    settings = replace(config, budget=config.population)  # a record continues to any budget
    model = engine.key, tune.rollout, repr(tune.loss)
    key = content_key(*model, settings, robot, hfs(), nominal(), code=SEARCH_CODE)
    return searches.search_all(
        bench.setup,
        config,
        nominal(),
        commands={name: named_command(name) for name in trajectories},
        engine=engine,
        folder=bench.folder / f"search-{key}",
    )


def tune(bench: Bench, name: str, steps: int, plants: int) -> dict[str, Tuned]:
    """Tune for one trajectory without and with the net, and by the paper's rule in its ten steps.

    The one with the net is tuned on along walks, if there are any steps.
    """
    command = named_command(name)
    problems = {"without": Problem((command,), None), "with": Problem((command,), bench.params)}
    title = f"tuning {name} without and with GRFM-Net"
    results = tunings.tune_all(bench.setup, problems, bench.folder / name, title=title)
    rule = bench.setup._replace(config=replace(bench.setup.config, rule="relative", iterations=10))
    title = f"tuning {name} by the paper's rule"
    problems = {"paper": problems["with"]}
    results = tunings.tune_all(rule, problems, bench.folder / name, title=title) | results
    if steps:
        start = results["with"].tuning.weights
        try:
            results["with_walks"] = tune_along_walks(bench, name, start, steps, plants)
        except InputError as error:  # a walk with the tuned weights falls
            say(f"{name}: no row with_walks: {error}")
    return results


def tune_along_walks(bench: Bench, name: str, start: Weights, steps: int, plants: int) -> Tuned:
    """Tune along walks on the high-fidelity simulator, a walk on each plant for every step.

    Args:
        bench: its net's Jacobian is used.
        name: of the trajectory.
        start: weights of a tuning on the model.
        steps: largest number of steps.
        plants: number: the hfs, and others drawn around it; verdicts are on other plants.

    Raises:
        InputError: a walk with the starting weights falls or is not solved; the folder cannot be
            written.
    """
    setup = bench.setup._replace(config=TuneConfig(iterations=steps))
    pool, config, robot, commit = setup
    problem = Problem((named_command(name),), bench.params)
    simulators = [hfs(), *(hfs_drawn(seed) for seed in range(500, 499 + plants))]
    inputs = config, robot, start, problem.commands[0], problem.params
    own = function_id(_walk_job), function_id(tune_measured)
    key = content_key(*inputs, *simulators, *own, code=WALKS_CODE)
    job = partial(_walk_job, config, robot, problem)

    def make(missing: list[str], _: Mapping[str, Tuned]) -> Iterator[tuple[str, Tuned]]:
        with bar(f"tuning {name} further, along walks on the simulator") as report_progress:
            report_progress(0, config.iterations, "compiling")

            def evaluate(trial: Weights) -> list[tuple[Evaluation, np.ndarray]]:
                return list(pool.map(job, repeat(trial), simulators))

            def on_iteration(iteration: Iteration) -> None:
                message = f"L {float(iteration.evaluation.loss) / 1e6:.3f}e6"
                report_progress(int(iteration.iteration), config.iterations, message)

            tuning = tune_measured(config, start, evaluate, on_iteration)
        yield "walks", Tuned(tuning, commit)

    paths = {"walks": bench.folder / name / f"tuning-walks-{key}.npz"}
    return load_or_make(paths, make, **tunings.artefact(setup, start))["walks"]


def _walk_job(
    config: TuneConfig, robot: Robot, problem: Problem, weights: Weights, plant: Imperfections
) -> tuple[Evaluation, np.ndarray]:
    controller, (command,) = config.rollout.walk, problem.commands
    seconds = config.rollout.ticks * controller.gait.tick
    trajectory = walk(controller, robot, Job(weights, command, plant, seconds))
    effect = effect_of(problem.params, controller)
    return evaluate_walk(config, robot, weights, command, effect, trajectory)


def judge(
    bench: Bench,
    name: str,
    sets: Mapping[str, Weights],
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
) -> ScoredWalks:
    """Walk all sets on the plants, along one trajectory."""
    return judging.judge(
        bench.setup,
        sets,
        named_command(name),
        plants,
        seeds,
        title=f"evaluating {name} on {plural(len(plants), 'stand-in plant')}",
        folder=bench.folder / name,
    )
