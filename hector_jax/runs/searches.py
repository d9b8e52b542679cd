"""The step `search`: CMA-ES on walks of the high-fidelity simulator."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar, say
from hector_jax.core.files import locked
from hector_jax.core.inputs import plural
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree_file import tree_hash
from hector_jax.robot.model import Robot
from hector_jax.runs.cache import robot_hash
from hector_jax.search import cmaes as searching
from hector_jax.search.cmaes import Generation, SearchConfig, SearchResult, best
from hector_jax.sim.engine import Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import loss_of


def losses_on_hfs(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Sequence[Weights]],
    *,
    commands: Mapping[str, Command],
    engine: Engine,
    at_once: int,
) -> dict[str, Float[np.ndarray, " sets"]]:
    """L of weight sets on the high-fidelity simulator, one walk each, as long as the rollouts.

    Args:
        pool: worker processes.
        config: controller, length and loss.
        robot: the body.
        sets: by the trajectory that they walk.
        commands: by trajectory.
        engine: of the walks.
        at_once: walks that a program is compiled for; fewer are filled up to it.
    """
    walk, plant = config.rollout.walk, hfs(robot.description)
    seconds = config.rollout.ticks * walk.gait.tick
    cases = [(weights, commands[name]) for name, each in sets.items() for weights in each]
    jobs = [Job(*case, plant, seconds) for case in cases]
    walks = engine.walk(pool, walk, robot, jobs, batch=at_once)
    rows = [(float(loss_of(config.loss, one)), np.max(one.residual) <= SOLVED) for one in walks]
    ends = np.cumsum([len(each) for each in sets.values()])
    by_name = dict(zip(sets, np.split(np.array(rows), ends[:-1]), strict=True))
    for name, each in by_name.items():
        if unsolved := int(np.sum(each[:, 1] == 0)):
            say(f"{name}: a QP was not solved in {unsolved} of {plural(len(each), 'walk')}")
    return {name: each[:, 0] for name, each in by_name.items()}


def search(
    pool: Executor,
    config: SearchConfig,
    tune: TuneConfig,
    robot: Robot,
    start: Weights,
    *,
    commands: Mapping[str, Command],
    engine: Engine,
    folder: Path,
) -> dict[str, SearchResult]:
    """CMA-ES on the high-fidelity simulator, taking up the records under `folder`.

    Args:
        pool: worker processes.
        config: of the search.
        tune: controller, length of the walks and loss, the same as those of tunings.
        robot: the body.
        start: where to start.
        commands: by trajectory; the searches go in lock-step.
        engine: of the walks.
        folder: of the records.

    Raises:
        InputError: the folder cannot be written, and see `search.cmaes.search`; before anything is
            walked.
    """
    size = config.population * len(commands)
    every = {name: named_command(name) for name in COMMANDS} | dict(commands)
    about = {  # not the engine: both give a loss to seven digits
        "seconds": tune.rollout.ticks * tune.rollout.walk.gait.tick,
        "controller": repr(tune.rollout.walk),
        "loss": repr(tune.loss),
        "robot": robot_hash(robot),
        "plant": tree_hash(hfs(robot.description)),
        "commands": {name: tree_hash(command) for name, command in every.items()},
    }

    on_hfs = {"commands": commands, "engine": engine, "at_once": size}
    walk = partial(losses_on_hfs, pool, tune, robot, **on_hfs)
    with (
        locked(folder),
        bar(f"searching on the high-fidelity simulator, engine {engine.name}") as tell,
    ):

        def on_generation(histories: Mapping[str, list[Generation]]) -> None:
            done = sum(map(len, histories.values())) * config.population
            lowest = [f"{n} {best(one)[1] / 1e6:.3f}e6" for n, one in histories.items() if one]
            remark = "lowest L: " + ", ".join(lowest) if done else "compiling"
            tell(done, config.generations * size, remark)

        starts, notes = dict.fromkeys(commands, start), {"folder": folder, "about": about}
        return searching.search(config, starts, walk, **notes, on_generation=on_generation)
