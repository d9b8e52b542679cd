"""Selection of the weights of a run.

`choose` takes an iteration of each tuning, `answer` the set `best`, and `earliest` the set `best`
after a tuning on walks.

The rigid-body model is inexact: from some iteration on a tuning can gain on the model and lose on
the robot. A few points of the path, including its start, therefore walk on plants drawn around the
hfs that no evaluation and no tuning on the model uses. A tuning on walks does, later: its sets are
compared on other plants. The state estimate of all these plants is noisy: a rollout knows its state
exactly, so nothing keeps a tuning from gains that amplify noise.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.control.parameters import TUNABLES
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, between
from hector_jax.core.console import say
from hector_jax.core.inputs import plural
from hector_jax.robot.model import Robot
from hector_jax.runs import verdicts
from hector_jax.runs.setup import Setup
from hector_jax.sim.world import Imperfections, hfs_with_motors, noisy
from hector_jax.tuning.difftune import Tuning

# fractions of the accepted iterations at which a path is walked
SHARES = (0.0, 1 / 16, 1 / 8, 1 / 4, 3 / 8, 1 / 2, 3 / 4, 1.0)
LIMIT, WIDTH, FEEDBACK = 0.19, 7 / 8, 2 / 3
"""Numbers of the set between two tunings: limit of the position error as a share of the height of
the centre of mass (8 cm for HECTOR); width and velocity feedback of the steps as shares of the
controller's."""
HELD_OUT = 8
"""Number of the plants of `earliest`."""
# first seed of the plants of `choose`, `answer` and a tuning on walks, drawn like those of hfs-even
# but for the mass and with other seeds; those of `earliest` have the seeds before it, so that none
# is among the former
_FIRST_SEED = 7000


class Choice(NamedTuple):
    """The chosen iteration of a tuning."""

    weights: Weights
    iteration: int  # its number
    of: int  # number of the last iteration


def drawn_plants(robot: Robot, count: int, first_seed: int = _FIRST_SEED) -> list[Imperfections]:
    """Return plants drawn around the hfs; by default the first of `choose` and tuning on walks."""
    return [
        hfs_with_motors(seed, 0.4, robot.description)._replace(estimator=noisy())
        for seed in range(first_seed, first_seed + count)
    ]


def _ratios(
    setup: Setup,
    sets: Mapping[str, Weights],
    commands: Sequence[Command],
    plants: Sequence[Imperfections],
    title: str,
    **notes: Any,
) -> dict[str, Float[np.ndarray, "commands plants"]]:
    """Return L of each set relative to the first set."""
    title = f"{title} on {plural(len(plants), 'plant')} drawn around the hfs"
    judge = partial(verdicts.judge, setup, sets, title=title, **notes)
    results = [judge(command, plants, range(len(plants))).scores for command in commands]
    losses = {name: np.array([[s.L for s in scores[name]] for scores in results]) for name in sets}
    first = losses[next(iter(sets))]
    return {name: loss / first for name, loss in losses.items()}


def choose(
    setup: Setup,
    tunings: Mapping[str, Tuning],
    commands: Sequence[Command],
    *,
    seconds: float,
    folder: Path,
) -> dict[str, Choice]:
    """Walk the paths of tunings and return the best point of each; empty if no plants are required.

    Args:
        setup: workers, controller and loss, nominal body with the number of plants.
        tunings: tunings by name, all from the same start.
        commands, seconds: commands to walk, which count alike, and their length.
        folder: folder of the scores; walks whose scores are in it are not repeated.
    """
    plants = drawn_plants(setup.robot, setup.robot.description.tuning.choice_plants)
    if not plants:
        return {}
    points = {}  # of each path, by their labels
    for name, tuning in tunings.items():
        path = [iteration for iteration in tuning.iterations if iteration.accepted]
        indices = sorted({round(share * (len(path) - 1)) for share in SHARES})
        points[name] = {f"{name}-{i}" if i else "start": path[i] for i in indices}
    sets = {label: i.weights for labels in points.values() for label, i in labels.items()}
    sets = {"start": sets["start"], **sets}
    inputs, title = (setup, sets, commands, plants), "choosing an iteration"
    ratios = _ratios(*inputs, title, seconds=seconds, folder=folder)
    ratio = {name: float(r.mean()) for name, r in ratios.items()}
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


def completed(weights: Weights, **others: float) -> Weights:
    """Return weights with numbers beside Q and R, within their boxes, where they have none."""
    boxes = {name: (TUNABLES[name].lower, TUNABLES[name].upper) for name in others}
    within = {name: float(np.clip(value, *boxes[name])) for name, value in others.items()}
    return weights._replace(others={**within, **weights.others})


def between_tunings(setup: Setup, pair: Sequence[Weights], share: float, limit: float) -> Weights:
    """Return the set between two tunings, with a limit of the position error and other steps.

    What the tunings have beside Q and R stays; else the steps have the shares `WIDTH` and
    `FEEDBACK` of the controller's numbers.

    Weights that track tightly fall under a push that looser ones survive: the error becomes so
    large that they ask for all the friction there is to pull the robot back. On a slippery floor
    they fall because a foot further out needs more horizontal force. With less feedback of the
    velocity they fall less under pushes on curves (docs/notes.md, Robustness).

    Args:
        setup: controller.
        pair: two tuned sets.
        share: share of the second one.
        limit: limit of the position error that the MPC sees [m]; infinite for none.
    """
    footstep, (one, other) = setup.config.rollout.walk.footstep, pair
    return completed(
        between(one, other, share),
        position_limit=limit,
        footstep_width=round(WIDTH * footstep.width, 4),
        footstep_feedback=round(FEEDBACK * footstep.feedback, 4),
    )


def answer(
    setup: Setup,
    sets: Mapping[str, Weights],
    pair: tuple[str, str],
    share: float,
    commands: Sequence[Command],
    *,
    safe: float | None = None,
    **notes: Any,
) -> Weights:
    """Return the set `best` of a run.

    Between two tunings, gains from the faults of one model are half lost, and gains that both
    tunings share remain. If the description of the robot requires drawn plants, one of the tuned
    sets is taken where it walks better on them, because the models are less exact for such robots.

    Args:
        setup, commands, notes: see `choose`.
        sets: sets by name: nominal and all tuned sets.
        pair: names of the two tunings.
        share: share of the second tuning.
        safe: limit of the position error [m], whichever set it is; None: for the set between the
            tunings that of the controller, else `LIMIT`.
    """
    own = setup.config.rollout.walk.mpc.position_limit
    default = round(LIMIT * float(setup.robot.standing_height), 3) if own is None else own
    limit = default if safe is None else safe
    mixture = between_tunings(setup, [sets[name] for name in pair], share, limit)
    if safe is not None:
        tuned = {name: w for name, w in sets.items() if name != "nominal"}
        sets = {**sets, **{n: completed(w, position_limit=safe) for n, w in tuned.items()}}
    plants = drawn_plants(setup.robot, setup.robot.description.tuning.choice_plants)
    if not plants:
        return mixture
    candidates = {**sets, "between": mixture}
    ratio = _ratios(setup, candidates, commands, plants, "choosing the answer", **notes)
    best = min((n for n in candidates if n != "nominal"), key=lambda name: ratio[name].mean())
    say(f"best: {best} walks best on plants drawn around the hfs")
    return candidates[best]


def earliest(
    setup: Setup, sets: Mapping[str, Weights], commands: Sequence[Command], **notes: Any
) -> str:
    """Return the name of the first set that is as good as the best one on plants of its own.

    A tuning on the walks of a few plants fits them better and better, from some walk on at the
    expense of other plants. So its sets walk on plants on which none of them was tuned, and of
    those that differ from the best by at most one standard error the earliest is taken. The error
    is that of the paired differences of log L over plants, each the mean over its commands.

    Args:
        setup, commands, notes: see `choose`.
        sets: sets by name in the order in which they were made, the start first.

    Source: the one-standard-error rule of Breiman, Friedman, Olshen and Stone, "Classification and
    Regression Trees", 1984.
    """
    plants = drawn_plants(setup.robot, HELD_OUT, _FIRST_SEED - HELD_OUT)
    ratios = _ratios(setup, sets, commands, plants, "comparing the tuned sets", **notes)
    losses = {name: np.log(ratio).mean(axis=0) for name, ratio in ratios.items()}
    best = min(losses, key=lambda name: losses[name].mean())

    def as_good(name: str) -> bool:
        excess = losses[name] - losses[best]
        return bool(excess.mean() <= excess.std(ddof=1) / np.sqrt(len(excess)))

    chosen = next(filter(as_good, losses))
    change = [100.0 * np.expm1(losses[name].mean()) for name in (chosen, best)]
    say(
        f"best: {chosen}, the earliest as good as {best} on {plural(HELD_OUT, 'other plant')}; "
        f"L there against the start: {change[0]:+.0f} and {change[1]:+.0f} %"
    )
    return chosen
