"""The step `search`: CMA-ES on walks of the high-fidelity simulator."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command
from hector_jax.control.weights import Weights
from hector_jax.core.console import bar
from hector_jax.core.files import locked
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


def _command(name: str, own: Mapping[str, Command] | None) -> Command:
    return own[name] if own and name in own else named_command(name)


def losses_on_hfs(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Sequence[Weights]],
    *,
    engine: Engine,
    at_once: int,
    own: Mapping[str, Command] | None = None,
) -> dict[str, Float[np.ndarray, " sets"]]:
    """L of weight sets on the high-fidelity simulator, one walk each, as long as the rollouts.

    Args:
        pool: worker processes.
        config: controller, length and loss.
        robot: the body.
        sets: by the trajectory that they walk.
        engine: of the walks.
        at_once: walks that a program is compiled for; fewer are filled up to it.
        own: commands of trajectories that are not built in, by their name.
    """
    walk = config.rollout.walk
    seconds = config.rollout.ticks * walk.gait.tick
    jobs = [
        Job(weights, _command(name, own), hfs(), seconds)
        for name, each in sets.items()
        for weights in each
    ]
    walks = engine.walk(pool, walk, robot, jobs, batch=at_once)
    losses = [float(loss_of(config.loss, walked)) for walked in walks]
    ends = np.cumsum([len(each) for each in sets.values()])
    return dict(zip(sets, np.split(np.array(losses), ends[:-1]), strict=True))


def search(
    pool: Executor,
    config: SearchConfig,
    tune: TuneConfig,
    robot: Robot,
    starts: Mapping[str, Weights],
    *,
    engine: Engine,
    folder: Path,
    own: Mapping[str, Command] | None = None,
) -> dict[str, SearchResult]:
    """CMA-ES on the high-fidelity simulator, taking up the records under `folder`.

    Args:
        pool: worker processes.
        config: of the search.
        tune: controller, length of the walks and loss, the same as those of tunings.
        robot: the body.
        starts: where to start, by the name of the trajectory; all go in lock-step.
        engine: of the walks.
        folder: of the records.
        own: commands of trajectories that are not built in, by their name.

    Raises:
        InputError: see `named_command` and `search.cmaes.search`.
        InputError: the folder cannot be written; told before
            anything is walked.
    """
    size = config.population * len(starts)
    about = {  # not the engine: both give a loss to seven digits
        "seconds": tune.rollout.ticks * tune.rollout.walk.gait.tick,
        "controller": repr(tune.rollout.walk),
        "loss": repr(tune.loss),
        "robot": robot_hash(robot),
        "plant": tree_hash(hfs()),
        "commands": {name: tree_hash(_command(name, own)) for name in (*COMMANDS, *starts)},
    }

    def walk(sets: Mapping[str, Sequence[Weights]]) -> dict[str, np.ndarray]:
        return losses_on_hfs(pool, tune, robot, sets, engine=engine, at_once=size, own=own)

    title = f"searching on the high-fidelity simulator, engine {engine.name}"
    with locked(folder), bar(title) as tell:

        def on_generation(histories: Mapping[str, list[Generation]]) -> None:
            done = sum(len(history) for history in histories.values()) * config.population
            lowest = (
                f"{name} {best(history)[1] / 1e6:.3f}e6"
                for name, history in histories.items()
                if history
            )
            tell(
                done,
                config.generations * size,
                "lowest L: " + ", ".join(lowest) if done else "compiling",
            )

        return searching.search(
            config, starts, walk, folder=folder, about=about, on_generation=on_generation
        )
