"""The step `front`: how tracking, smooth commands and falls are traded for each other.

Two numbers move a tuned set along this front. `smooth` multiplies the weight of L_ctrl in the loss
that is tuned: the commands change less and the robot tracks worse. `safe` is the share of the
controller's friction with which the set plans: less friction makes it fall less often under a push
and, on fast turns, track worse. The points walk undisturbed and under pushes, on plants by which
nothing else is chosen or evaluated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, between, expert, nominal
from hector_jax.runs import choice, tunings
from hector_jax.runs.metrics import Score
from hector_jax.runs.setup import Setup
from hector_jax.runs.tunings import Problem
from hector_jax.runs.verdicts import score_jobs
from hector_jax.sim.loop import Job
from hector_jax.sim.world import NO_PUSH, Push
from hector_jax.tuning.loss import with_alphas

SMOOTH = (1.0, 3.0, 10.0)
SAFE = (1.0, choice.SAFE, 0.75)
PLANTS, _FIRST_SEED = 4, 6800  # not those of `choice`
SIDES = np.deg2rad(22.5 + 45 * np.arange(8))  # [rad] of the pushes, from ahead to the left
_FORCE, _START, _TIME, _WALK = 90.0, 1.05, 0.1, 2.5  # [N] of HECTOR, [s]; includes the recovery


class Point(NamedTuple):
    """Results of one set; changes are medians of paired ratios over plants and trajectories."""

    name: str
    L: float  # against nominal [%]
    L_ctrl: float  # against expert [%]
    falls: int  # under a push
    pushed: int  # walks under a push
    falls_calm: int  # in walks without a push
    calm: int


def smoothed(setup: Setup, smooth: float) -> Setup:
    """Return the setup of tunings in which L_ctrl counts `smooth` times."""
    loss = setup.config.loss
    alphas = {term.name: smooth * term.weight for term in loss if term.name == "L_ctrl"}
    return setup._replace(config=replace(setup.config, loss=with_alphas(alphas, loss)))


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
        last = {name: tuning.converged for name, tuning in results.items()}
        tuned[smooth] = [choices[n].weights if choices else last[n] for n in problems]
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
    return {
        f"smooth_{smooth:g}_safe_{safe:.2f}": choice.planned_with(
            setup, between(without, through_net, share), safe
        )
        for smooth, (without, through_net) in pairs.items()
        for safe in SAFE
    }


def walk(
    setup: Setup,
    commands: Mapping[str, Command],
    sets: Mapping[str, Weights],
    *,
    seconds: float,
    folder: Path,
) -> list[Point]:
    """Walk nominal, expert and the sets of a front, undisturbed and under pushes from all sides.

    Args:
        setup: workers, controller and loss, nominal body.
        commands, seconds: commands by name, and the length of a walk without a push.
        sets: sets by name.
        folder: folder of the artefacts; walks whose scores are in it are not repeated.
    """
    robot = setup.robot
    sets = {"nominal": nominal(robot), "expert": expert(robot), **sets}
    force = _FORCE * robot.description.plants.push
    sides = np.stack([np.cos(SIDES), np.sin(SIDES), 0.0 * SIDES], axis=1)
    pushes = [Push(*(np.array([x]) for x in (force * side, _START, _TIME))) for side in sides]
    scenes = {"calm": (NO_PUSH, seconds)}
    scenes |= {f"push{i}": (push, _WALK) for i, push in enumerate(pushes)}
    plants = choice.drawn_plants(robot, PLANTS, _FIRST_SEED)
    keys = {
        (f"{name}-{command}-{scene}", seed): (name, command, scene, seed)
        for name, command, scene, seed in product(sets, commands, scenes, range(PLANTS))
    }
    jobs = {}
    for case, (name, command, scene, seed) in keys.items():
        push, length = scenes[scene]
        inputs = sets[name], commands[command], plants[seed], length, seed
        jobs[case] = Job(*inputs, push=push)
    title = "walking the front, with and without pushes"
    scored = score_jobs(setup, jobs, title=title, folder=folder / "front")
    scores: dict[tuple[str, bool], list[Score]] = {}  # by set, without a push or with one
    for case, (name, _, scene, _) in keys.items():
        scores.setdefault((name, scene == "calm"), []).append(scored[case][0].score)

    def change(name: str, baseline: str, term: str) -> float:
        pairs = zip(scores[name, True], scores[baseline, True], strict=True)
        ratios = [float(one.losses[term] / other.losses[term]) for one, other in pairs]
        return 100.0 * (median(ratios) - 1.0)

    def falls(name: str, calm: bool) -> tuple[int, int]:
        fallen = [bool(score.fallen) for score in scores[name, calm]]
        return sum(fallen), len(fallen)

    return [
        Point(
            name,
            change(name, "nominal", "L"),
            change(name, "expert", "L_ctrl"),
            *falls(name, False),
            *falls(name, True),
        )
        for name in sets
    ]
