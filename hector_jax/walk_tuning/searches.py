"""The step `search`: CMA-ES on walks of the high-fidelity simulator."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar, say
from hector_jax.core.environment import code_hash
from hector_jax.core.files import locked
from hector_jax.core.inputs import plural
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree_file import tree_hash
from hector_jax.search import cmaes
from hector_jax.search.cmaes import Generation, SearchConfig, SearchResult, best_point
from hector_jax.sim.engine import Engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.store.cache import robot_hash
from hector_jax.store.setup import Setup
from hector_jax.tuning.loss import loss_of


def losses_on_hfs(
    setup: Setup,
    sets: Mapping[str, Sequence[Weights]],
    *,
    commands: Mapping[str, Command],
    engine: Engine,
    at_once: int,
) -> dict[str, Float[np.ndarray, " sets"]]:
    """Return L of weight sets, one walk each on the hfs of the same length as rollouts.

    Args:
        setup: workers; controller, length and loss; robot that walks.
        sets: weight sets by the trajectory that they walk.
        commands: commands by trajectory.
        engine: engine of the walks.
        at_once: number of walks for which a program is compiled; fewer walks are padded to it.
    """
    pool, config, robot = setup
    walk, plant = config.rollout.walk, hfs(robot.description)
    seconds = config.rollout.ticks * walk.gait.tick
    jobs = [Job(w, commands[name], plant, seconds) for name, group in sets.items() for w in group]
    walks = engine.walk(pool, walk, robot, jobs, batch=at_once)
    rows = [(float(loss_of(config.loss, w)), np.max(w.residual) <= SOLVED) for w in walks]
    ends = np.cumsum([len(group) for group in sets.values()])
    by_name = dict(zip(sets, np.split(np.array(rows), ends[:-1]), strict=True))
    for name, group in by_name.items():
        if unsolved := int(np.sum(group[:, 1] == 0)):
            say(f"{name}: a QP was not solved in {unsolved} of {plural(len(group), 'walk')}")
    return {name: group[:, 0] for name, group in by_name.items()}


def search_all(
    setup: Setup,
    config: SearchConfig,
    start: Weights,
    *,
    commands: Mapping[str, Command],
    engine: Engine,
    folder: Path,
) -> dict[str, SearchResult]:
    """Search with CMA-ES on the high-fidelity simulator, continuing the records under `folder`.

    Args:
        setup: workers; controller, length of the walks and loss as those of tunings; robot.
        config: settings of the search.
        start: weights at the start.
        commands: commands by trajectory; the searches run in lock-step.
        engine: engine of the walks.
        folder: folder of the records.

    Raises:
        InputError: before any walk: the folder cannot be written, or see `search.cmaes.search`.
    """
    size, tune, robot = config.population * len(commands), setup.config, setup.robot
    all_commands = {name: named_command(name) for name in COMMANDS} | dict(commands)
    about = {
        "code": code_hash("walk_tuning.searches", *engine.modules),
        "engine": engine.key,
        "seconds": tune.rollout.ticks * tune.rollout.walk.gait.tick,
        "controller": repr(tune.rollout.walk),
        "loss": repr(tune.loss),
        "robot": robot_hash(robot),
        "plant": tree_hash(hfs(robot.description)),
        "commands": {name: tree_hash(command) for name, command in all_commands.items()},
    }

    options = {"commands": commands, "engine": engine, "at_once": size}
    walk = partial(losses_on_hfs, setup, **options)
    title = f"searching on the high-fidelity simulator, engine {engine.name}"
    with locked(folder), bar(title) as report_progress:

        def on_generation(histories: Mapping[str, list[Generation]]) -> None:
            done = sum(map(len, histories.values())) * config.population
            lowest = [
                f"{n} {best_point(rows)[1] / 1e6:.3f}e6" for n, rows in histories.items() if rows
            ]
            remark = "lowest L: " + ", ".join(lowest) if done else "compiling"
            report_progress(done, config.generations * size, remark)

        starts, notes = dict.fromkeys(commands, start), {"folder": folder, "about": about}
        return cmaes.search(config, starts, walk, **notes, on_generation=on_generation)
