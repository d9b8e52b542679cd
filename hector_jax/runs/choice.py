"""The step `choose`: the iteration of a tuning that walks best on the high-fidelity simulator.

A model is wrong somewhere, and a long descent finds out where: from some iteration on the weights
get better on the model and worse on the robot. A few points of the path, its start among them, walk
on plants drawn around the hfs, of which neither the tuner nor an evaluation sees anything. Their
estimate of the state is noisy, because a tuning knows its state exactly and would take any gain.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.console import say
from hector_jax.core.inputs import plural
from hector_jax.robot.model import Robot
from hector_jax.runs import verdicts
from hector_jax.runs.metrics import Score
from hector_jax.sim.world import Estimator, hfs_drawn
from hector_jax.tuning.difftune import TuneConfig, Tuning

# of the accepted iterations: where a path is walked
SHARES = (0.0, 1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 3 / 4, 1.0)
_FIRST_SEED = 7000  # of the plants, drawn as `hfs-varied` but none of its seeds
# as a contact-aided filter of gyroscopes and encoders has them
_ESTIMATOR = Estimator(
    position=np.array(0.002),
    velocity=np.array(0.03),
    angle=np.array(0.003),
    ang_velocity=np.array(0.03),
    joint=np.array(0.0005),
    drift=np.array(0.0),
    drift_yaw=np.array(0.0),
)


class Choice(NamedTuple):
    """An iteration of a tuning."""

    weights: Weights
    iteration: int  # accepted ones before it
    of: int  # accepted ones


def choose(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    tunings: Mapping[str, Tuning],
    commands: Sequence[Command],
    *,
    seconds: float,
    folder: Path,
    commit: str = "",
) -> dict[str, Choice]:
    """Walk the paths of tunings and take the best point of each; nothing where no plants are asked.

    Args:
        pool: worker processes.
        config, robot: controller and loss, nominal body with the number of plants.
        tunings: by name; from one start.
        commands, seconds: what to walk, and how long. All commands count alike.
        folder: of the scores, where walks that are there are not walked again.
        commit: to note with what is walked now.
    """
    if not (count := robot.description.tuning.choice_plants):
        return {}
    paths = {name: [i.weights for i in one.history if i.accepted] for name, one in tunings.items()}
    points = {
        name: sorted({round(share * (len(path) - 1)) for share in SHARES})
        for name, path in paths.items()
    }
    sets = {_label(name, i): paths[name][i] for name in paths for i in points[name]}
    title = f"choosing an iteration on {plural(count, 'plant')} around the simulator's"
    notes = {"title": title, "seconds": seconds, "folder": folder, "commit": commit}
    drawn = [
        hfs_drawn(_FIRST_SEED + k, 0.4, robot.description)._replace(estimator=_ESTIMATOR)
        for k in range(count)
    ]
    each = [
        verdicts.judge(pool, config, robot, sets, command, drawn, range(count), **notes).scores
        for command in commands
    ]
    ratio = {name: np.mean([_against_start(one)[name] for one in each]) for name in sets}

    def best(name: str) -> Choice:
        path, last = paths[name], len(paths[name]) - 1
        i = min(points[name], key=lambda i: ratio[_label(name, i)])
        say(
            f"{name}: iteration {i} of {last} walks best there: L "
            f"{100 * (ratio[_label(name, i)] - 1):+.0f} % against the start, the last one "
            f"{100 * (ratio[_label(name, last)] - 1):+.0f} %"
        )
        return Choice(path[i], i, last)

    return {name: best(name) for name in paths}


def _label(name: str, iteration: int) -> str:
    return f"{name}-{iteration}" if iteration else "start"


def _against_start(scores: Mapping[str, Sequence[Score]]) -> dict[str, float]:
    """Mean loss of each set on the plants, by that of the start."""
    L = {name: np.mean([float(one.L) for one in each]) for name, each in scores.items()}
    return {name: float(loss / L["start"]) for name, loss in L.items()}
