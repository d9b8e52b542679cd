"""The step `tune_on_walks`: a tuning on the model grounded on walks (grounded.py).

The best weights have walked on some plants. A round takes some steps down the mean over the models
grounded on these walks, and walks where they end. Where the walks gain, the next round begins there
and takes up to twice as many steps; where they lose, it walks half as far along the same path.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from itertools import product, repeat
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.weights import Weights
from hector_jax.core.console import Tell, bar
from hector_jax.core.inputs import plural
from hector_jax.grfm import network
from hector_jax.grfm.dataset import at_interval
from hector_jax.robot.model import Robot
from hector_jax.runs import tunings
from hector_jax.runs.cache import content_key
from hector_jax.runs.tunings import Problem, Tuned
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import (
    PAPER_ITERATIONS,
    Iteration,
    TuneConfig,
    Tuning,
    descend,
    init,
    step_status,
)
from hector_jax.tuning.evaluate import Evaluation, mean_of
from hector_jax.tuning.grounded import Grounding, evaluate_grounded, fit_grounding
from hector_jax.tuning.loss import losses, total
from hector_jax.tuning.status import StepStatus

FIRST, MOST = 8, 16  # steps of a round
_CODE = ("grfm.network", "runs.walks")  # they import all that decides the numbers

Walked = tuple[Evaluation, Grounding]
"""Loss of a walk with its gradient along it, and what grounds the model on it."""

Descent = Callable[[Weights, Sequence[Walked], Float[np.ndarray, " n"], int], list[Weights]]
"""The path of some steps down the mean of losses by their scales, its start first."""


def _walk_job(config: TuneConfig, robot: Robot, problem: Problem, job: Job) -> Walked:
    controller = config.rollout.walk
    walked = walk(controller, robot, job)
    samples = at_interval(walked, controller.gait.tick)
    effect = network.effect_of(problem.params, controller.gait)
    found = fit_grounding(config.rollout, robot, job.weights, job.command, effect, samples)
    grounding = jax.device_get(found)  # of the types of later evaluations: no second program
    along = _evaluate_job(config, robot, problem, job.weights, job, grounding)
    terms = losses(config.loss, walked)
    evaluation = along._replace(
        loss=total(config.loss, terms),
        terms=terms,
        fallen=np.maximum(along.fallen, np.mean(1.0 * walked.fallen)),
        residual=np.maximum(along.residual, np.max(walked.residual)),
    )
    return jax.device_get((evaluation, grounding))


def _evaluate_job(
    config: TuneConfig,
    robot: Robot,
    problem: Problem,
    weights: Weights,
    job: Job,
    grounding: Grounding,
) -> Evaluation:
    effect = network.effect_of(problem.params, config.rollout.walk.gait)
    inputs = config.rollout, robot, weights, job.command, effect, grounding, config.loss
    return jax.device_get(evaluate_grounded(*inputs))


def _status(config: TuneConfig, evaluation: Evaluation, low: float) -> StepStatus:
    status = StepStatus(int(step_status(config, evaluation)))
    rose = status == StepStatus.ACCEPTED and not evaluation.loss < low
    return StepStatus.ROSE if rose else status


def _alternate(
    config: TuneConfig,
    start: Weights,
    rounds: int,
    walk_all: Callable[[Weights], list[Walked]],
    descent: Descent,
    tell: Tell,
) -> Tuning:
    """Walk and descend in turn; see the module's docstring."""
    history: list[Iteration] = []
    best = trial = start
    tried = walk_all(start)
    scales = np.array([one.loss for one, _ in tried])
    scales, steps, low = scales / scales.mean(), FIRST // 2, np.inf
    path, stop = [start], ""
    while not stop:
        seen = mean_of([one for one, _ in tried], scales)
        number, status = PAPER_ITERATIONS + len(history), _status(config, seen, low)
        share = steps / FIRST if history else 0.0
        row = map(np.asarray, (status, share))
        history.append(Iteration(np.asarray(number), trial, seen, *row))
        tell(len(history) - 1, rounds, f"L {float(seen.loss) / 1e6:.3f}e6")
        if accepted := status == StepStatus.ACCEPTED:
            best, low, steps = trial, float(seen.loss), min(2 * steps, MOST)
        else:
            steps //= 2
        if np.isinf(low):
            stop = f"the start was refused: {history[-1].reason}"
        elif len(history) > rounds:
            stop = plural(rounds, "round")
        elif not steps:
            stop = f"the walks of a single step were refused: {history[-1].reason}"
        else:
            path = descent(best, tried, scales, steps) if accepted else path
            steps = min(steps, len(path) - 1)
            if steps:
                trial = path[steps]
                tried = walk_all(trial)
            else:
                stop = "no step gains on the grounded model"
    return Tuning(history, start, best, stop)


def tune_on_walks(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    start: Weights,
    problem: Problem,
    plants: Sequence[Imperfections],
    folder: Path,
    *,
    rounds: int,
    seconds: float,
    commit: str = "",
) -> Tuned:
    """Tune with walks on plants; the history holds the start and the trial of each round.

    All plants and commands count alike: the loss of each is divided by its share at the start.

    Args:
        pool: worker processes.
        config, robot, start: how; nominal body; where to start.
        problem: commands, and the net of the model that is grounded, if any.
        plants: to walk on.
        folder: of the tuning; one that is there is not made again.
        rounds: most of them. It ends before where a single step loses.
        seconds: length of a walk.
        commit: to note with what is tuned now.

    Raises:
        InputError: the folder cannot be written.
    """
    ticks = round(seconds / config.rollout.walk.gait.tick)
    config = replace(config, rollout=replace(config.rollout, ticks=ticks))
    start = jax.tree.map(np.asarray, init(config, start).best)  # with the other numbers, feet tied
    cases = list(enumerate(product(plants, problem.commands)))
    step = partial(_evaluate_job, config, robot, problem)

    def jobs(weights: Weights) -> list[Job]:
        return [Job(weights, command, plant, seconds, seed) for seed, (plant, command) in cases]

    def walk_all(weights: Weights) -> list[Walked]:
        return list(pool.map(partial(_walk_job, config, robot, problem), jobs(weights)))

    def descent(best: Weights, walks: Sequence[Walked], scales: Any, steps: int) -> list[Weights]:
        def mean(weights: Weights) -> Evaluation:
            each = pool.map(step, repeat(weights), jobs(weights), [one for _, one in walks])
            return mean_of(list(each), scales)

        far = replace(config, iterations=PAPER_ITERATIONS + steps)
        history = descend(far, best, mean, first=PAPER_ITERATIONS).history
        return [one.weights for one in history if one.accepted]

    def make(*_: Any) -> Iterator[tuple[str, Tuned]]:
        with bar(f"tuning with walks on {plural(len(plants), 'plant')}") as tell:
            tell(0, rounds, "compiling")
            tuning = _alternate(config, start, rounds, walk_all, descent, tell)
            yield "walks", Tuned(tuning, commit)

    inputs = config, robot, start, *problem, *plants, rounds, seconds
    path = folder / f"tuning-walks-{content_key(*inputs, code=_CODE)}.npz"
    return tunings.load_or_tune(config, robot, start, {"walks": path}, make)["walks"]
