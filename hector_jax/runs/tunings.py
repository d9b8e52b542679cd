"""The step `tune`: gradient tunings in worker processes, each an artefact (cache.py).

A tuning runs on one core, because a closed loop is one long chain of small operations; several run
side by side.
"""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import bar
from hector_jax.core.runtime import message_queue
from hector_jax.core.tree import stack
from hector_jax.grfm import network
from hector_jax.robot.model import Robot
from hector_jax.runs import replay
from hector_jax.runs.cache import content_key, load_or_make
from hector_jax.runs.folder import Journal
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning import difftune, evaluate
from hector_jax.tuning.curvature import Curvature, gauss_newton, main_directions
from hector_jax.tuning.difftune import Iteration, TuneConfig, Tuning
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.tuning.rollout import rollout_config

# modules that decide the numbers, for `content_key`
TUNING_CODE = ("tuning.difftune", "grfm.network")


class Problem(NamedTuple):
    """What weights are tuned for."""

    command: Command
    params: network.Params | None  # of the net to tune through; None: the plain rigid body
    others: tuple[Command, ...] = ()  # commands that the same weights are to walk as well

    @property
    def commands(self) -> tuple[Command, ...]:
        """All commands."""
        return self.command, *self.others


class Tuned(NamedTuple):
    """A tuning with its history."""

    tuning: Tuning
    commit: str  # at which it was made; empty where that is not known


def _restored(stored: Any) -> Tuned:
    """A tuning from a file, where the iterations are stacked and texts are arrays."""
    tuning, count = stored.tuning, len(stored.tuning.history.iteration)
    history = [jax.tree.map(lambda x, i=i: np.asarray(x[i]), tuning.history) for i in range(count)]
    return Tuned(tuning._replace(history=history, stop=str(tuning.stop)), str(stored.commit))


def load_or_tune(
    config: TuneConfig,
    robot: Robot,
    start: Weights,
    paths: Mapping[str, Path],
    make: Callable[[list[str], Mapping[str, Tuned]], Iterator[tuple[str, Tuned]]],
) -> dict[str, Tuned]:
    """Tunings by name; see `load_or_make`, of which `paths` and `make` are arguments."""
    none, text = np.zeros(0), np.array("")
    weights = difftune.init(config, start).best  # with the other numbers that are tuned
    rows = jax.tree.map(lambda w: np.zeros((0, *w.shape)), weights)
    seen = evaluate.Evaluation(none, {term.name: none for term in config.loss}, rows, none, none)
    history: Any = Iteration(none, rows, seen, none, none)  # iterations are stacked in the file
    like: Any = Tuned(Tuning(history, weights, weights, text), text)  # pyright: ignore

    def restored(stored: Mapping[str, Any]) -> dict[str, Tuned]:
        return {name: _restored(one) for name, one in stored.items()}

    def make_stored(missing: list[str], stored: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        for name, (tuning, commit) in make(missing, restored(stored)):
            yield name, Tuned(tuning._replace(history=stack(tuning.history)), commit)

    return restored(
        load_or_make(paths, make_stored, like=lambda _: like, kind="tuning", robot=robot)
    )


def _tune_job(
    config: TuneConfig, robot: Robot, start: Weights, problem: Problem, name: str, messages: Any
) -> Tuning:
    """One tuning in a worker; the queue `messages` gets each iteration."""
    step, models = partial(difftune.tune_step, config, robot), _models(config, robot, problem)
    evaluations = [lambda weights, m=model: step(weights, *m) for model in models]
    start = difftune.init(config, start).best  # with the other numbers that are tuned
    mean = evaluate.mean_over_commands(evaluations, start)
    return difftune.descend(config, start, mean, lambda one: messages.put((name, one)))


def _models(config: TuneConfig, robot: Robot, problem: Problem) -> list[tuple[Any, ...]]:
    """Command, anchor and effect of the rollout on each command of a problem."""
    effect = network.effect_of(problem.params, config.rollout.walk.gait)
    return [(command, standing_anchor(robot), effect) for command in problem.commands]


def _tunings(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    start: Weights,
    problems: Mapping[str, Problem],
    title: str,
    on_iteration: Callable[[str, Iteration], None],
) -> Iterator[tuple[str, Tuning]]:
    """Tune several problems side by side; yields each tuning with its name when it has ended."""
    done, total = 0, config.iterations * len(problems)
    with message_queue() as messages, bar(title) as tell:
        running: dict[Future[Tuning], str] = {
            pool.submit(_tune_job, config, robot, start, problem, name, messages): name
            for name, problem in problems.items()
        }
        tell(done, total, "compiling")
        while running:
            ended = wait(running, timeout=0.1, return_when=FIRST_COMPLETED).done
            while not messages.empty():  # also all that those told which have ended
                name, iteration = messages.get()
                done += int(iteration.iteration > 0)
                tell(done, total, f"{name}: L {float(iteration.evaluation.loss) / 1e6:.3f}e6")
                on_iteration(name, iteration)
            for future in ended:
                yield running.pop(future), future.result()


def tune(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    problems: Mapping[str, Problem],
    folder: Path,
    *,
    title: str,
    start: Weights | None = None,
    commit: str = "",
    journal: Journal | None = None,
    dumps: Path | None = None,
) -> dict[str, Tuned]:
    """Tune several problems side by side; `folder` keeps the tunings that ended.

    Of a problem with several commands the mean of the losses is lowered, each divided by its share
    of the losses at the start, so that all count alike.

    Args:
        pool: worker processes.
        config: how.
        robot: the body.
        problems: by name.
        folder: of the tunings, a file for each; a tuning that is there is not tuned again.
        start: where to start; the nominal weights by default.
        title: for the person who waits.
        commit: to note with what is tuned now.
        journal: of the iterations.
        dumps: folder for what was refused, see `replay.keep`; None: nothing is kept. Nothing is of
            a problem with several commands, as a dump is of one rollout.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model; the folder cannot be
            written.
    """
    start = nominal(robot) if start is None else start
    key = partial(content_key, config, robot, start, code=TUNING_CODE)
    paths = {n: folder / f"tuning-{n}-{key(*problem)}.npz" for n, problem in problems.items()}

    def on_iteration(name: str, iteration: Iteration) -> None:
        if journal is not None:
            journal.add(name, iteration)
        command, net, others = problems[name]
        if dumps is not None and not others:
            of = {"config": config, "robot": robot, "command": command, "net": net}
            replay.keep(dumps, name, iteration, **of)

    def make(missing: list[str], stored: Mapping[str, Tuned]) -> Iterator[tuple[str, Tuned]]:
        if journal is not None:  # in the order of the problems
            there = {n: stored[n].tuning.history if n in stored else () for n in problems}
            journal.write(there)
        wanted = {name: problems[name] for name in missing}
        for name, tuning in _tunings(pool, config, robot, start, wanted, title, on_iteration):
            yield name, Tuned(tuning, commit)

    tuned = load_or_tune(config, robot, start, paths, make)
    if journal is not None:
        journal.write({name: one.tuning.history for name, one in tuned.items()})
    return tuned


def _norms_job(config: TuneConfig, robot: Robot, problem: Problem) -> dict[str, float]:
    norms = partial(evaluate.gradient_norms, config.rollout, robot, nominal(robot))
    models = _models(config, robot, problem)
    each = [norms(command, anchor, phi, config.loss) for command, anchor, phi in models]
    return jax.tree.map(lambda *x: float(np.mean(x)), *each)


def gradient_norms(
    pool: Executor, config: TuneConfig, robot: Robot, problems: Mapping[str, Problem]
) -> dict[str, dict[str, float]]:
    """Norms of the gradients of the loss's parts at nominal weights, means over the commands."""
    with bar("norms of the gradients") as tell:
        running = {n: pool.submit(_norms_job, config, robot, one) for n, one in problems.items()}
        tell(0, len(problems), "compiling")
        return {name: future.result() for name, future in running.items()}


def gauss_newton_job(
    config: TuneConfig, robot: Robot, start: Weights, problem: Problem
) -> Float[np.ndarray, "n n"]:
    """The Gauss-Newton matrix divided by the loss, mean over the commands, in a worker."""
    matrix_of = partial(gauss_newton, config.rollout, robot, start)
    models = _models(config, robot, problem)
    each = [matrix_of(command, anchor, phi, config.loss) for command, anchor, phi in models]
    return np.mean([np.asarray(matrix) / float(loss) for loss, matrix in each], axis=0)


def curvature(
    pool: Executor, config: TuneConfig, robot: Robot, start: Weights, problem: Problem
) -> Curvature:
    """How the loss on the model is curved in the starting weights."""
    with bar("directions of the weights that matter") as tell:
        tell(0, 1, "compiling")
        matrix = pool.submit(gauss_newton_job, config, robot, start, problem).result()
    return main_directions(matrix, start)


def tune_config(robot: Robot, **settings: Any) -> TuneConfig:
    """Settings of a tuning, with the controller and the loss that the robot's TOML asks for.

    Raises:
        InputError: one line naming the file and what is wrong in it.
    """
    loss = loss_of_robot(robot.description)
    return TuneConfig(rollout=rollout_config(robot), loss=loss, **settings)


def tuning_paths(pool: Executor, robot: Robot, folder: Path) -> list[Weights]:
    """Weights that plain tunings of the trajectories pass through, stacked: data covers them.

    The tunings are kept in `folder`; their settings are the same whatever is tuned later.
    """
    config = tune_config(robot)
    problems = {name: Problem(named_command(name), None) for name in COMMANDS}
    title = "tuning paths on the rigid body, for the data"
    tuned = tune(pool, config, robot, problems, folder, title=title)
    return [
        stack([i.weights for i in tuned[name].tuning.history if i.accepted]) for name in COMMANDS
    ]


def _compile_tuning(config: TuneConfig, robot: Robot, command: Command) -> None:
    (model,) = _models(config, robot, Problem(command, None))
    difftune.tune_step(config, robot, nominal(robot), *model)


def compile_programs(pool: Executor, robot: Robot) -> None:
    """Compile what tunings and walks run, each program in one process; the others load it."""
    config = tune_config(robot)
    controller, straight = config.rollout.walk, named_command("straight")
    tick = Job(nominal(robot), straight, hfs(robot.description), controller.gait.tick)
    with bar("compiling, once on a machine") as tell:
        tuned = pool.submit(_compile_tuning, config, robot, straight)
        walked = pool.submit(walk, controller, robot, tick)
        for done, job in enumerate((tuned, walked)):
            tell(done, 2, "")
            job.result()
        tell(2, 2, "")
