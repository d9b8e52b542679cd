"""The step `tune`: tunings in worker processes or on a GPU, each an artefact (cache.py).

On a CPU a rollout runs on one core, because a closed loop is one long chain of small operations;
the rollouts of a tuning, and several tunings, run in parallel.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import repeat
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import bar, say
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import plural
from hector_jax.core.journal import add_row, write_rows
from hector_jax.core.tree import stack
from hector_jax.grfm import network
from hector_jax.robot.model import Robot
from hector_jax.sim.diagnosis import not_the_weights
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import on_host
from hector_jax.sim.world import hfs
from hector_jax.store.cache import content_key, load_or_make
from hector_jax.store.run import as_row
from hector_jax.store.setup import Setup
from hector_jax.tuning import batch, difftune
from hector_jax.tuning.difftune import Iteration, TuneConfig, Tuning, step_status
from hector_jax.tuning.evaluate import Evaluation, Objective, gradient_norms, mean_objective
from hector_jax.tuning.loss import Loss, loss_of_robot
from hector_jax.tuning.rollout import Scenario, rollout_config
from hector_jax.tuning.status import StepStatus
from hector_jax.tuning.variation import drawn_variation

# modules that determine the numbers, for `content_key`
TUNING_CODE = ("store.tunings", "tuning.difftune", "grfm.network")


class Problem(NamedTuple):
    """Commands and model for which weights are tuned."""

    commands: tuple[Command, ...]  # for the same weights
    params: network.Params | None  # of the net to tune through; None: the plain rigid body
    draws: int = 0  # drawn variations of the model for each command; 0: the model as it is


def artefact(setup: Setup, start: Weights) -> dict[str, Any]:
    """Return the options of `load_or_make` for tunings."""
    config, empty = setup.config, np.zeros(0)
    weights = difftune.init(config, start).start  # with the other numbers that are tuned
    rows = jax.tree.map(lambda w: np.zeros((0, *w.shape)), weights)
    terms = {term.name: empty for term in config.loss}
    evaluation = Evaluation(empty, terms, rows, empty, empty)
    history = Iteration(empty, rows, evaluation, empty, empty)
    like = Tuning(weights, np.zeros(()), np.zeros((0, 0)), np.zeros(()), history)
    return {"like": lambda _: like, "kind": "tuning", "robot": setup.robot}


def rollouts_of(config: TuneConfig, robot: Robot, problem: Problem) -> list[Scenario]:
    """Return the rollouts of a problem.

    A drawn one starts at the touchdown of a foot or half a cycle later, and its net is one member.
    """
    commands, params, draws = problem
    walk = config.rollout.walk
    if not draws:
        anchor, effect = standing_anchor(robot), network.effect_of(params, walk)
        return [Scenario(robot, command, anchor, effect) for command in commands]
    scenarios = []
    for seed, command in enumerate(command for command in commands for _ in range(draws)):
        net = params if params is None else network.variant_of(params).member(params, seed)
        tick = seed % 2 * (walk.gait.cycle // 2)
        anchor, effect = standing_anchor(robot, tick), network.effect_of(net, walk)
        variation = drawn_variation(walk, robot, seed)
        scenarios.append(Scenario(robot, command, anchor, effect, variation))
    return scenarios


def _usable(
    config: TuneConfig, problem: Problem, scenarios: list[Scenario], found: Sequence[Evaluation]
) -> tuple[list[Scenario], Float[np.ndarray, " n"]]:
    """Return the rollouts of a problem that count, and their losses at the start.

    Drawn variations with which the start falls are left out, if not all are.

    Args:
        config, problem: of the tuning.
        scenarios: all rollouts.
        found: their evaluations at the start.
    """
    usable = [i for i, e in enumerate(found) if step_status(config, e) == StepStatus.ACCEPTED]
    kept = usable if usable and problem.draws else range(len(scenarios))
    if left_out := len(scenarios) - len(kept):
        say(
            f"{left_out} of {plural(len(scenarios), 'drawn model')} left out of the tuning: the "
            "weights at the start fall or are not solved there"
        )
    return [scenarios[i] for i in kept], np.array([found[i].loss for i in kept])


def _objective(setup: Setup, start: Weights, problem: Problem) -> Objective:
    """Return the mean over the rollouts of a problem, each divided by its share at the start.

    All rollouts of an evaluation are computed at the same time.
    """
    pool, config, robot = setup

    def of_all(scenarios: Sequence[Scenario], weights: Weights) -> list[tuple[Evaluation, Any]]:
        host = jax.tree.map(np.asarray, weights)
        return list(pool.map(difftune.model_slope, repeat(config), scenarios, repeat(host)))

    scenarios, losses = rollouts_of(config, robot, problem), np.ones(1)
    if len(scenarios) > 1:
        found = [evaluation for evaluation, _ in of_all(scenarios, start)]
        scenarios, losses = _usable(config, problem, scenarios, found)
    return mean_objective(partial(of_all, scenarios), losses)


def _tune_on_cpu(
    setup: Setup, start: Weights, problem: Problem, put: Callable[[Iteration], None]
) -> Tuning:
    """Run one tuning, whose rollouts worker processes compute."""
    at = difftune.init(setup.config, start).start
    return difftune.descend(setup.config, start, _objective(setup, at, problem), put)


def _tune_on_gpu(setup: Setup, start: Weights, problem: Problem) -> Tuning:
    """Run one tuning on the accelerator, as a batch of one."""
    _, config, robot = setup
    models, losses = rollouts_of(config, robot, problem), np.ones(1)
    if len(models) > 1:
        at = difftune.init(config, start).start
        found = [difftune.tune_step(config, model, at) for model in models]
        models, losses = _usable(config, problem, models, found)
    effects = [model.effect for model in (models if problem.draws else models[:1])]
    scenarios = [
        batch.BatchScenario(
            command=model.command,
            anchor=model.anchor,
            effect=np.asarray(i % len(effects)),
            loss=config.loss,
            scale=np.asarray(scale),
            variation=model.variation,
        )
        for i, (model, scale) in enumerate(zip(models, losses / losses.mean(), strict=True))
    ]
    problems = stack([batch.BatchProblem(start, stack(scenarios), np.asarray(1.0))])
    found = batch.tune_batch(config, robot, problems, stack(effects))
    return difftune.single(jax.tree.map(lambda x: x[0], found))


def _tunings(
    setup: Setup,
    start: Weights,
    problems: Mapping[str, Problem],
    title: str,
    on_iteration: Callable[[str, Iteration], None],
) -> Iterator[tuple[str, Tuning]]:
    """Tune several problems in parallel and yield each tuning with its name when it ends.

    Where there is a GPU they are tuned there, in turn; else threads of this process step the
    weights and wait for the rollouts.
    """
    if jax.default_backend() == "gpu":
        with bar(title) as report_progress:
            for done, (name, problem) in enumerate(problems.items()):
                report_progress(done, len(problems), name)
                tuning = _tune_on_gpu(setup, start, problem)
                for iteration in tuning.iterations:
                    on_iteration(name, iteration)
                yield name, tuning
        return
    done, total = 0, setup.config.iterations * len(problems)
    messages: SimpleQueue[tuple[str, Iteration]] = SimpleQueue()
    threads = ThreadPoolExecutor(len(problems))
    with ExitStack() as at_end, bar(title) as report_progress:
        at_end.callback(threads.shutdown, wait=False)  # a failure does not wait for the others
        running: dict[Future[Tuning], str] = {}
        for name, problem in problems.items():
            put = lambda iteration, name=name: messages.put((name, iteration))  # noqa: E731
            running[threads.submit(_tune_on_cpu, setup, start, problem, put)] = name
        report_progress(done, total, "compiling")
        while running:
            ended = wait(running, timeout=0.1, return_when=FIRST_COMPLETED).done
            while not messages.empty():  # after `wait`: includes all messages of the ended tunings
                name, iteration = messages.get()
                done += int(iteration.iteration > 0)
                remark = f"{name}: L {float(iteration.evaluation.loss) / 1e6:.3f}e6"
                report_progress(done, total, remark)
                on_iteration(name, iteration)
            for future in ended:
                yield running.pop(future), future.result()


def tune_all(
    setup: Setup,
    problems: Mapping[str, Problem],
    folder: Path,
    *,
    title: str,
    start: Weights | None = None,
    metrics: Path | None = None,
    before: Mapping[str, Tuning] | None = None,
) -> dict[str, Tuning]:
    """Tune several problems in parallel; finished tunings are saved in `folder`.

    For a problem with several commands the mean of the losses is minimised, each divided by its
    share of the losses at the start, so that all count alike.

    Args:
        setup: workers, settings and robot of the tunings.
        problems: problems by name.
        folder: folder of the tunings, a file for each; tunings in it are not repeated.
        start: weights at the start; the nominal weights by default.
        title: title of the progress bar.
        metrics: file of the iterations, see `folder.as_row`.
        before: earlier tunings whose iterations are in that file too.

    Raises:
        InputError: with the weights at the start the model falls or a QP is not solved; or the
            folder cannot be written.
    """
    start = nominal(setup.robot) if start is None else start
    key = partial(content_key, setup.config, setup.robot, start, code=TUNING_CODE)
    paths = {}
    for name, problem in problems.items():
        net = problem.params
        phi = "" if net is None else function_id(network.variant_of(net).apply)
        paths[name] = folder / f"tuning-{name}-{key(*problem, phi)}.npz"

    def write(tuned: Mapping[str, Tuning]) -> None:
        if metrics is not None:
            histories = {**(before or {}), **tuned}.items()
            write_rows(metrics, (as_row(name, i) for name, t in histories for i in t.iterations))

    def on_iteration(name: str, iteration: Iteration) -> None:
        if metrics is not None:
            add_row(metrics, as_row(name, iteration))

    def make(missing: list[str], stored: Mapping[str, Tuning]) -> Iterator[tuple[str, Tuning]]:
        write(stored)
        remaining = {name: problems[name] for name in missing}
        return _tunings(setup, start, remaining, title, on_iteration)

    tuned = load_or_make(paths, make, **artefact(setup, start))
    write(tuned)
    return tuned


def _norms_job(config: TuneConfig, robot: Robot, problem: Problem) -> dict[str, float]:
    weights = difftune.init(config, nominal(robot)).start

    def evaluate(scenario: Scenario, loss: Loss) -> Evaluation:
        return difftune.model_slope(replace(config, loss=loss), scenario, weights)[0]

    results = [
        gradient_norms(partial(evaluate, scenario), weights, config.loss)
        for scenario in rollouts_of(config, robot, problem)
    ]
    return jax.tree.map(lambda *x: float(np.mean(x)), *results)


def mean_norms(setup: Setup, problems: Mapping[str, Problem]) -> dict[str, dict[str, float]]:
    """Return norms of the gradients of the loss terms at nominal weights, means over commands."""
    with bar("norms of the gradients") as report_progress:
        pool, config, robot = setup
        running = {n: pool.submit(_norms_job, config, robot, p) for n, p in problems.items()}
        report_progress(0, len(problems), "compiling")
        return {name: future.result() for name, future in running.items()}


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
    tuned = tune_all(Setup(pool, tune_config(robot), robot), problems, folder, title=title)
    histories = [tuned[name].iterations for name in COMMANDS]
    return [stack([i.weights for i in history if i.accepted]) for history in histories]


def compile_programs(
    setup: Setup,
    start: Weights,
    trajectory: NamedCommand,
    *,
    others: Sequence[tuple[TuneConfig, Weights, Problem]] = (),
    meanwhile: Callable[[], None] = lambda: None,
) -> list[str]:
    """Compile the programs of tunings, each in one process, and walk once in one of them.

    The other processes load these programs from the cache. The walk is with the weights at
    the start on the hfs; its faults that no weights can cure are returned, a line each.

    Args:
        setup, start, trajectory: of the tuning on the rigid body.
        others: settings, start and problem of tunings that need other programs.
        meanwhile: what is done at the same time; its jobs come after the walk.

    Raises:
        InputError: with the weights at the start the model falls or a QP is not solved.
    """
    pool, config, robot = setup
    job = Job(start, trajectory.command, hfs(robot.description))
    job = on_host(job._replace(seconds=trajectory.seconds or job.seconds))
    walking = pool.submit(
        not_the_weights, config.rollout.walk, jax.tree.map(np.asarray, robot), job
    )
    preparing, plain = [], (config, start, Problem((trajectory.command,), None))
    for settings, weights, problem in (plain, *others):
        scenario, *_ = rollouts_of(settings, robot, problem)
        at = jax.tree.map(np.asarray, difftune.init(settings, weights).start)
        preparing.append(pool.submit(difftune.model_slope, settings, scenario, at))
    meanwhile()
    with bar("compiling, once on a machine") as report_progress:
        report_progress(0, len(preparing), "")
        for done, job in enumerate(preparing, 1):
            job.result()
            report_progress(done, len(preparing), "")
    evaluation, _ = preparing[0].result()
    difftune.check_start(StepStatus(int(step_status(config, evaluation))), evaluation)
    return walking.result()
