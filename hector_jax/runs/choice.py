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
from hector_jax.robot.model import Robot
from hector_jax.runs import verdicts
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
    against_start: float  # mean loss on the plants, by that of the start
    last_against_start: float  # likewise, of the last iteration


def choose(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    tunings: Mapping[str, Tuning],
    commands: Sequence[Command],
    plants: int,
    *,
    seconds: float,
    folder: Path,
    title: str,
    commit: str = "",
) -> dict[str, Choice]:
    """Walk the paths of tunings and take the best point of each.

    Args:
        pool: worker processes.
        config, robot: controller and loss, nominal body.
        tunings: by name; from one start.
        commands, seconds: what to walk, and how long. All commands count alike.
        plants: how many to walk on.
        folder: of the scores, where walks that are there are not walked again.
        title: for the person who waits.
        commit: to note with what is walked now.
    """
    paths = {name: [i.weights for i in one.history if i.accepted] for name, one in tunings.items()}
    points = {
        name: sorted({round(share * (len(path) - 1)) for share in SHARES})
        for name, path in paths.items()
    }
    label = lambda name, i: f"{name}-{i}" if i else "start"  # noqa: E731
    sets = {label(name, i): paths[name][i] for name in paths for i in points[name]}
    drawn = [
        hfs_drawn(_FIRST_SEED + k, 0.4, robot.description)._replace(estimator=_ESTIMATOR)
        for k in range(plants)
    ]
    each = []
    for command in commands:
        judged = verdicts.judge(
            pool,
            config,
            robot,
            sets,
            command,
            drawn,
            range(plants),
            title=title,
            seconds=seconds,
            folder=folder,
            commit=commit,
        )
        L = {
            n: np.mean([float(score.L) for score in scores]) for n, scores in judged.scores.items()
        }
        each.append({name: loss / L["start"] for name, loss in L.items()})
    ratio = {name: float(np.mean([one[name] for one in each])) for name in sets}

    def best(name: str) -> Choice:
        path, last = paths[name], len(paths[name]) - 1
        i = min(points[name], key=lambda i: ratio[label(name, i)])
        return Choice(path[i], i, last, ratio[label(name, i)], ratio[label(name, last)])

    return {name: best(name) for name in paths}
