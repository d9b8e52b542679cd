"""The step `front`: how tracking, smooth commands and falls are traded for each other.

Two numbers move a tuned set along this front. `smooth` multiplies the weight of L_ctrl in the loss
that is tuned: the commands change less and the robot tracks worse. `safe` is the limit [m]
of the position error that the MPC sees: with less the robot may fall less often under pushes, and
it tracks worse. The points walk undisturbed and under pushes, on plants by which nothing else is
chosen or evaluated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.runs import choice, tunings, verdicts
from hector_jax.runs.metrics import Verdict, make_verdict
from hector_jax.runs.setup import Setup
from hector_jax.runs.tunings import Problem
from hector_jax.runs.verdicts import ScoredWalk
from hector_jax.sim.loop import Job
from hector_jax.sim.world import push_along
from hector_jax.tuning.loss import smoother

SMOOTH = (1.0, 3.0, 10.0)
SAFE = (np.inf, 1.0, 0.5)  # shares of the limit of the position error of `best`; inf: no limit
PLANTS, _FIRST_SEED = 4, 6800  # not those of `choice`
SIDES = np.deg2rad(22.5 + 45 * np.arange(8))  # [rad] of the pushes, from ahead to the left
_FORCE, _START, _TIME, _WALK = 90.0, 1.05, 0.1, 2.5  # [N] of HECTOR, [s]; includes the recovery


class Front(NamedTuple):
    """Walks of nominal, expert and the sets of a front."""

    calm: Verdict  # of walks without a push; each plant walks every command
    falls: dict[str, int]  # under a push, by set
    pushed: int  # walks of each set under a push


def smoothed(setup: Setup, smooth: float) -> Setup:
    """Return the setup of tunings in which L_ctrl counts `smooth` times."""
    config = setup.config
    return setup._replace(config=replace(config, loss=smoother(config.loss, smooth)))


def tune(
    setup: Setup,
    commands: Mapping[str, Command],
    problems: Mapping[str, Problem],
    *,
    start: Weights,
    seconds: float,
    folder: Path,
) -> dict[float, list[Weights]]:
    """Tune all problems for each of `SMOOTH`; return their weights in order, by `smooth`.

    Args:
        setup: workers, controller and loss, nominal body.
        commands, seconds: commands by name, and the length of their walks.
        problems: problems by name.
        start: weights at the start.
        folder: folder of the artefacts; tunings and walks in it are not repeated.
    """
    tuned = {}
    for smooth in SMOOTH:
        title = f"tuning with L_ctrl times {smooth:g}"
        done = tunings.tune(smoothed(setup, smooth), problems, folder, title=title, start=start)
        results = {name: entry.tuning for name, entry in done.items()}
        options = {"seconds": seconds, "folder": folder / "choice"}
        choices = choice.choose(setup, results, list(commands.values()), **options)
        tuned[smooth] = [choices[n].weights if choices else results[n].converged for n in problems]
    return tuned


def points(
    setup: Setup, pairs: Mapping[float, Sequence[Weights]], share: float
) -> dict[str, Weights]:
    """Return the sets of the front by name.

    Args:
        setup: controller and nominal body.
        pairs: tuned sets without and with the net, by `smooth`.
        share: share of the second one.
    """
    sets, limits = {}, choice.default_limit(setup) * np.array(SAFE)
    for (smooth, pair), limit in product(pairs.items(), limits):
        weights = choice.between_tunings(setup, pair, share, limit)
        safe = weights.others["position_limit"]
        sets[f"smooth_{smooth:g}_safe_{safe:.2g}"] = weights
    return sets


def walk(
    setup: Setup,
    commands: Mapping[str, Command],
    sets: Mapping[str, Weights],
    *,
    seconds: float,
    folder: Path,
) -> Front:
    """Walk nominal, expert and the sets of a front, undisturbed and under pushes from all sides.

    Args:
        setup: workers, controller and loss, nominal body.
        commands, seconds: commands by name, and the length of a walk without a push.
        sets: sets by name, without a hyphen in it.
        folder: folder of the artefacts; walks whose scores are in it are not repeated.
    """
    robot = setup.robot
    sets = {"nominal": nominal(robot), "expert": expert(robot), **sets}
    plants, seeds = choice.drawn_plants(robot, PLANTS, _FIRST_SEED), range(PLANTS)
    folder, force = folder / "front", _FORCE * robot.description.plants.push
    options = {"seconds": seconds, "folder": folder}
    alone = [
        verdicts.judge(
            setup, sets, command, plants, seeds, title=f"walking the front, {name}", **options
        ).scores
        for name, command in commands.items()
    ]
    calm = {name: [score for scores in alone for score in scores[name]] for name in sets}
    verdict = make_verdict(setup.config.loss, [*seeds] * len(commands), calm)
    jobs = {}
    for name, command, (i, side), seed in product(sets, commands, enumerate(SIDES), seeds):
        push = push_along(side, force, _START, _TIME)
        inputs = sets[name], commands[command], plants[seed], _WALK, seed
        jobs[f"{name}-{command}-push{i}", seed] = Job(*inputs, push=push)
    scored = verdicts.score_jobs(setup, jobs, title="pushing the front", folder=folder)
    pushed: dict[str, list[ScoredWalk]] = {name: [] for name in sets}
    for (case, _), (walk, _) in scored.items():
        pushed[case.partition("-")[0]].append(walk)  # there is no hyphen in the names of sets
    verdicts.say_faults(pushed)
    falls = {name: sum(bool(w.score.fallen) for w in walks) for name, walks in pushed.items()}
    return Front(verdict, falls, len(commands) * PLANTS * len(SIDES))
