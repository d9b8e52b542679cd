"""The step `tune`: tunings in worker processes or on a GPU, each an artefact (cache.py).

On a CPU a tuning runs on one core, because a closed loop is one long chain of small operations;
several tunings run in parallel.
"""

import pickle
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import bar
from hector_jax.core.identity import function_id
from hector_jax.core.runtime import message_queue
from hector_jax.core.tree import stack
from hector_jax.grfm import network
from hector_jax.robot.model import Robot
from hector_jax.runs.cache import content_key, load_or_make
from hector_jax.runs.folder import add_iteration, write_histories
from hector_jax.runs.setup import Setup
from hector_jax.sim.diagnosis import not_the_weights
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import hfs
from hector_jax.tuning import batch, difftune, evaluate
from hector_jax.tuning.difftune import Iteration, TuneConfig, Tuning, step_status
from hector_jax.tuning.evaluate import Objective, mean_objective
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.tuning.rollout import rollout_config
from hector_jax.tuning.status import StepStatus

# modules that determine the numbers, for `content_key`
TUNING_CODE = ("runs.tunings", "tuning.difftune", "grfm.network")


class Problem(NamedTuple):
    """Commands and model for which weights are tuned."""

    commands: tuple[Command, ...]  # for the same weights
    params: network.Params | None  # of the net to tune through; None: the plain rigid body


class Tuned(NamedTuple):
    """A tuning with its history."""

    tuning: Tuning
    commit: str  # of the code that made it; empty if unknown


def artefact(setup: Setup, start: Weights) -> dict[str, Any]:
    """Return the options of `load_or_make` for tunings."""
    config, empty = setup.config, np.zeros(0)
    weights = difftune.init(config, start).start  # with the other numbers that are tuned
    rows = jax.tree.map(lambda w: np.zeros((0, *w.shape)), weights)
    terms = {term.name: empty for term in config.loss}
    evaluation = evaluate.Evaluation(empty, terms, rows, empty, empty)
    history = Iteration(empty, rows, evaluation, empty, empty)
    like = Tuned(Tuning(weights, np.zeros(()), np.zeros((0, 0)), np.zeros(()), history), "")
    return {"like": lambda _: like, "kind": "tuning", "robot": setup.robot}


def _tune_job(
    config: TuneConfig, robot: Robot, start: Weights, problem: Problem, name: str, messages: Any
) -> Tuning:
    """Run one tuning in a worker and put each iteration into the queue `messages`."""
    objective = _objective(config, robot, start, problem)
    put = lambda iteration: messages.put(pickle.dumps((name, iteration)))  # noqa: E731
    return difftune.descend(config, start, objective, put)


def _tune_on_gpu(setup: Setup, start: Weights, problem: Problem) -> Tuning:
    """Run one tuning on the accelerator, as a batch of one."""
    pool, config, robot, _ = setup
    models, scales = _models(config, robot, problem), np.ones(1)
    if len(models) > 1:
        losses = pool.submit(_losses_job, config, robot, start, problem).result()
        scales = losses / losses.mean()
    scenarios = [
        batch.Scenario(m["command"], m["anchor"], np.asarray(0), config.loss, np.asarray(scale))
        for m, scale in zip(models, scales, strict=True)
    ]
    problems = stack([batch.Problem(start, stack(scenarios), np.asarray(1.0))])
    found = batch.tune_batch(config, robot, problems, stack([models[0]["effect"]]))
    return difftune.single(jax.tree.map(lambda x: x[0], found))


def _losses_job(
    config: TuneConfig, robot: Robot, start: Weights, problem: Problem
) -> Float[np.ndarray, " commands"]:
    """Return the loss of each command at the start."""
    at, models = difftune.init(config, start).start, _models(config, robot, problem)
    evaluations = [difftune.tune_step(config, robot, at, **model) for model in models]
    return np.array([float(evaluation.loss) for evaluation in evaluations])


def _objective(config: TuneConfig, robot: Robot, start: Weights, problem: Problem) -> Objective:
    """Return the mean over the commands of a problem, each with equal influence at the start."""
    models = _models(config, robot, problem)
    objectives = [difftune.model_objective(config, robot, **model) for model in models]
    if len(objectives) == 1:
        return objectives[0]
    return mean_objective(objectives, _losses_job(config, robot, start, problem))


def _models(config: TuneConfig, robot: Robot, problem: Problem) -> list[dict[str, Any]]:
    """Return command, anchor and effect of the rollout for each command of a problem."""
    effect = network.effect_of(problem.params, config.rollout.walk)
    model = {"anchor": standing_anchor(robot), "effect": effect}
    return [{"command": command, **model} for command in problem.commands]


def _tunings(
    setup: Setup,
    start: Weights,
    problems: Mapping[str, Problem],
    title: str,
    on_iteration: Callable[[str, Iteration], None],
) -> Iterator[tuple[str, Tuned]]:
    """Tune several problems in parallel and yield each tuning with its name when it ends.

    Where there is a GPU they are tuned there, in turn.
    """
    if jax.default_backend() == "gpu":
        with bar(title) as report_progress:
            for done, (name, problem) in enumerate(problems.items()):
                report_progress(done, len(problems), name)
                tuning = _tune_on_gpu(setup, start, problem)
                for iteration in tuning.iterations:
                    on_iteration(name, iteration)
                yield name, Tuned(tuning, setup.commit)
        return
    done, total = 0, setup.config.iterations * len(problems)
    inputs = setup.config, setup.robot, start
    with message_queue() as messages, bar(title) as report_progress:
        running: dict[Future[Tuning], str] = {
            setup.pool.submit(_tune_job, *inputs, problem, name, messages): name
            for name, problem in problems.items()
        }
        report_progress(done, total, "compiling")
        while running:
            ended = wait(running, timeout=0.1, return_when=FIRST_COMPLETED).done
            while not messages.empty():  # after `wait`: includes all messages of the ended tunings
                name, iteration = pickle.loads(messages.get())
                done += int(iteration.iteration > 0)
                remark = f"{name}: L {float(iteration.evaluation.loss) / 1e6:.3f}e6"
                report_progress(done, total, remark)
                on_iteration(name, iteration)
            for future in ended:
                yield running.pop(future), Tuned(future.result(), setup.commit)


def tune(
    setup: Setup,
    problems: Mapping[str, Problem],
    folder: Path,
    *,
    title: str,
    start: Weights | None = None,
    metrics: Path | None = None,
) -> dict[str, Tuned]:
    """Tune several problems in parallel; finished tunings are saved in `folder`.

    For a problem with several commands the mean of the losses is minimised, each divided by its
    share of the losses at the start, so that all count alike.

    Args:
        setup: workers, settings and robot of the tunings.
        problems: problems by name.
        folder: folder of the tunings, a file for each; tunings in it are not repeated.
        start: weights at the start; the nominal weights by default.
        title: title of the progress bar.
        metrics: file of the iterations, see `folder.as_line`.

    Raises:
        InputError: with the weights at the start the model falls or a QP is not solved; or the
            folder cannot be written.
    """
    start = nominal(setup.robot) if start is None else start
    key = partial(content_key, setup.config, setup.robot, start, code=TUNING_CODE)
    paths = {}
    for name, (commands, net) in problems.items():
        phi = "" if net is None else function_id(network.variant_of(net).apply)
        paths[name] = folder / f"tuning-{name}-{key(commands, net, phi)}.npz"

    def on_iteration(name: str, iteration: Iteration) -> None:
        if metrics is not None:
            add_iteration(metrics, name, iteration)

    def make(missing: list[str], stored: Mapping[str, Tuned]) -> Iterator[tuple[str, Tuned]]:
        if metrics is not None:
            write_histories(metrics, {n: tuned.tuning.iterations for n, tuned in stored.items()})
        remaining = {name: problems[name] for name in missing}
        return _tunings(setup, start, remaining, title, on_iteration)

    tuned = load_or_make(paths, make, **artefact(setup, start))
    if metrics is not None:
        write_histories(metrics, {n: result.tuning.iterations for n, result in tuned.items()})
    return tuned


def _norms_job(config: TuneConfig, robot: Robot, problem: Problem) -> dict[str, float]:
    norms = partial(evaluate.gradient_norms, config.rollout, robot, nominal(robot))
    results = [norms(**model, loss=config.loss) for model in _models(config, robot, problem)]
    return jax.tree.map(lambda *x: float(np.mean(x)), *results)


def gradient_norms(setup: Setup, problems: Mapping[str, Problem]) -> dict[str, dict[str, float]]:
    """Return norms of the gradients of the loss terms at nominal weights, means over commands."""
    with bar("norms of the gradients") as report_progress:
        pool, config, robot, _ = setup
        running = {n: pool.submit(_norms_job, config, robot, p) for n, p in problems.items()}
        report_progress(0, len(problems), "compiling")
        return {name: future.result() for name, future in running.items()}


def gauss_newton_job(
    config: TuneConfig, robot: Robot, start: Weights, problem: Problem
) -> Float[np.ndarray, "n n"]:
    """Return the Gauss-Newton matrix divided by the loss, mean over the commands, in a worker."""
    losses = _losses_job(config, robot, start, problem)
    matrix = _objective(config, robot, start, problem).matrix(start)
    return np.asarray(matrix) / losses.mean()


def tune_config(robot: Robot, **settings: Any) -> TuneConfig:
    """Return settings of a tuning, with the controller and the loss of the TOML of the robot.

    Raises:
        InputError: one line naming the file and the error in it.
    """
    loss = loss_of_robot(robot.description)
    return TuneConfig(rollout=rollout_config(robot), loss=loss, **settings)


def tuning_paths(pool: Executor, robot: Robot, folder: Path) -> list[Weights]:
    """Return the stacked weights along tunings of each trajectory, which the data are to cover.

    The tunings are saved in `folder`; their settings do not depend on later tunings.
    """
    problems = {name: Problem((named_command(name),), None) for name in COMMANDS}
    title = "tuning paths on the rigid body, for the data"
    tuned = tune(Setup(pool, tune_config(robot), robot), problems, folder, title=title)
    histories = [tuned[name].tuning.iterations for name in COMMANDS]
    return [stack([i.weights for i in history if i.accepted]) for history in histories]


def _prepare_tuning(
    config: TuneConfig, robot: Robot, start: Weights, command: Command, trace_only: bool
) -> None:
    """Compile the program of a tuning, or only trace it, so that its first call need not."""
    (model,) = _models(config, robot, Problem((command,), None))
    weights = difftune.init(config, start).start
    objective = difftune.model_objective(config, robot, **model)
    if trace_only:
        for function in objective:
            jax.eval_shape(function, weights)
        return
    evaluation = objective.evaluate(weights)
    difftune.check_start(StepStatus(int(step_status(config, evaluation))), evaluation)
    objective.matrix(weights)


def compile_programs(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    start: Weights,
    trajectory: NamedCommand,
    *,
    meanwhile: Callable[[], None] = lambda: None,
) -> list[str]:
    """Compile the programs of a tuning in one process; walk once and trace them in another one.

    The other processes load the programs of both from the cache. The walk is with the weights at
    the start on the hfs; its faults that no weights can cure are returned, a line each.

    Args:
        pool: worker processes.
        config, robot, start, trajectory: of the tuning.
        meanwhile: what is done at the same time; its jobs come after the walk.

    Raises:
        InputError: with the weights at the start the model falls or a QP is not solved.
    """
    job = Job(start, trajectory.command, hfs(robot.description))
    job = on_host(job._replace(seconds=trajectory.seconds or job.seconds))
    on_hfs = config.rollout.walk, jax.tree.map(np.asarray, robot), job
    inputs = config, robot, start, trajectory.command
    walking = pool.submit(not_the_weights, *on_hfs)
    tuning = pool.submit(_prepare_tuning, *inputs, False)
    meanwhile()
    with bar("compiling, once on a machine") as report_progress:
        pool.submit(_prepare_tuning, *inputs, True)  # by a free process; `tuning` raises its errors
        for done, future in enumerate((walking, tuning)):
            report_progress(done, 2, "")
            future.result()
        report_progress(2, 2, "")
    return walking.result()
