"""What a run takes of its tunings: an iteration of each (`choose`), and its answer, `best`.

The rigid-body model is wrong in places: from some iteration on a tuning can gain on the model and
lose on the robot. A few points of the path, its start among them, walk on plants drawn around the
hfs, of which neither the tuner nor an evaluation sees anything. Their estimate of the state is
noisy: a rollout knows its state exactly, so nothing keeps a tuning from gains that amplify noise.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hector_jax.control.parameters import TUNABLES
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, between
from hector_jax.core.console import say
from hector_jax.core.inputs import plural
from hector_jax.robot.model import Robot
from hector_jax.runs import verdicts
from hector_jax.sim.world import Imperfections, hfs_drawn, truth
from hector_jax.tuning.difftune import TuneConfig, Tuning

# of the accepted iterations: where a path is walked
SHARES = (0.0, 1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 3 / 4, 1.0)
_FRICTION = 11 / 12  # share of the controller's friction with which the answer plans
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


def drawn_plants(robot: Robot, count: int) -> list[Imperfections]:
    """The first plants on which weights of a robot are chosen and tuned."""
    noisy = truth()._replace(**{name: np.asarray(sigma) for name, sigma in _SIGMAS.items()})
    seeds = range(_FIRST_SEED, _FIRST_SEED + count)
    drawn = [hfs_drawn(seed, 0.4, robot.description) for seed in seeds]
    return [plant._replace(estimator=noisy) for plant in drawn]


def _ratios(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    commands: Sequence[Command],
    title: str,
    **notes: Any,
) -> dict[str, float]:
    """L of each set against the first one, mean over the drawn plants and the commands."""
    plants = drawn_plants(robot, robot.description.tuning.choice_plants)
    title = f"{title} on {plural(len(plants), 'plant')} drawn around the hfs"
    seeds = range(len(plants))
    each = [
        verdicts.judge(pool, config, robot, sets, one, plants, seeds, title=title, **notes).scores
        for one in commands
    ]
    loss = {name: np.array([[one.L for one in scores[name]] for scores in each]) for name in sets}
    first = loss[next(iter(sets))]
    return {name: float(np.mean(one / first)) for name, one in loss.items()}


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
    if not robot.description.tuning.choice_plants:
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
    sets = {"start": sets["start"], **sets}
    notes = {"seconds": seconds, "folder": folder, "commit": commit}
    ratio = _ratios(pool, config, robot, sets, commands, "choosing an iteration", **notes)
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


def answer(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    pair: tuple[str, str],
    share: float,
    commands: Sequence[Command],
    **notes: Any,
) -> Weights:
    """The set that a run takes for its answer.

    What each of two tunings gains by the faults of its own model is half lost between them, what
    both gain stays. The set between them plans with less friction than the controller assumes.
    For a robot that asks for drawn plants one of the tuned sets is taken where it walks better
    there, because models are further from such robots.

    Args:
        pool, config, robot, commands, notes: see `choose`.
        sets: by name: nominal, and all that were tuned.
        pair: names of the two tunings.
        share: of the second one.
    """
    lower, upper = TUNABLES["friction"].lower, TUNABLES["friction"].upper
    friction = float(np.clip(_FRICTION * config.rollout.walk.mpc.friction, lower, upper))
    half_way = between(sets[pair[0]], sets[pair[1]], share)
    half_way = half_way._replace(others={"friction": friction, **half_way.others})
    if not robot.description.tuning.choice_plants:
        return half_way
    walked = {**sets, "between": half_way}
    ratio = _ratios(pool, config, robot, walked, commands, "choosing the answer", **notes)
    best = min((name for name in walked if name != "nominal"), key=ratio.__getitem__)
    say(f"best: {best} walks best on plants drawn around the hfs")
    return walked[best]
