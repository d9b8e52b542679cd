"""The step `choose`: the iteration of a tuning that walks best on the high-fidelity simulator.

The rigid-body model is wrong in places: from some iteration on a tuning can gain on the model and
lose on the robot. A few points of the path, its start among them, walk on plants drawn around the
hfs, of which neither the tuner nor an evaluation sees anything. Their estimate of the state is
noisy: a rollout knows its state exactly, so nothing keeps a tuning from gains that amplify noise.
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
from hector_jax.sim.world import Imperfections, hfs_drawn, truth
from hector_jax.tuning.difftune import TuneConfig, Tuning

# of the accepted iterations: where a path is walked
SHARES = (0.0, 1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 3 / 4, 1.0)
_FIRST_SEED = 7000  # of the plants, drawn as `hfs-varied` but none of its seeds
# White noise: encoders of 14 bits; a gyroscope on a vibrating trunk; velocity and position by both
# over a leg of about 0.7 m.
_SIGMAS = {
    "position": 0.001,  # [m]
    "velocity": 0.02,  # [m/s]
    "angle": 0.001,  # [rad]
    "ang_velocity": 0.02,  # [rad/s]
    "joint": 0.0004,  # [rad]
}


class Choice(NamedTuple):
    """An iteration of a tuning."""

    weights: Weights
    iteration: int  # its number
    of: int  # number of the last


def drawn_plants(robot: Robot) -> list[Imperfections]:
    """The plants on which weights of this robot are chosen and tuned on."""
    noisy = truth()._replace(**{name: np.asarray(sigma) for name, sigma in _SIGMAS.items()})
    seeds = range(_FIRST_SEED, _FIRST_SEED + robot.description.tuning.choice_plants)
    drawn = [hfs_drawn(seed, 0.4, robot.description) for seed in seeds]
    return [plant._replace(estimator=noisy) for plant in drawn]


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
    """Walk the paths of tunings and take the best point of each; none if no plants are asked for.

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
    paths = {name: [i for i in one.history if i.accepted] for name, one in tunings.items()}
    points = {  # of each path, by their labels
        name: {
            f"{name}-{i}" if i else "start": path[i]
            for i in sorted({round(share * (len(path) - 1)) for share in SHARES})
        }
        for name, path in paths.items()
    }
    sets = {label: one.weights for each in points.values() for label, one in each.items()}
    title = f"choosing an iteration on {plural(count, 'plant')} drawn around the hfs"
    notes = {"title": title, "seconds": seconds, "folder": folder, "commit": commit}
    plants = drawn_plants(robot), range(count)
    each = [
        verdicts.judge(pool, config, robot, sets, command, *plants, **notes).scores
        for command in commands
    ]
    loss = {
        label: np.array([[one.L for one in scores[label]] for scores in each]) for label in sets
    }
    ratio = {label: float(np.mean(loss[label] / loss["start"])) for label in sets}
    choices = {}
    for name, labels in points.items():
        *_, last = labels
        best = min(labels, key=ratio.__getitem__)
        numbers = int(labels[best].iteration), int(labels[last].iteration)
        choices[name] = Choice(labels[best].weights, *numbers)
        change = [100 * (ratio[label] - 1) for label in (best, last)]
        say(
            f"{name}: iteration {numbers[0]} of {numbers[1]} walks best on plants drawn around "
            f"the hfs: L {change[0]:+.0f} % against the start, the last {change[1]:+.0f} %"
        )
    return choices
