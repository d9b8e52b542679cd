"""What the commands do, one step each: collect walks, train the net, tune, search, judge.

Everything that is walked or tuned runs in worker processes, one core each, because a closed loop is
one long chain of small operations. A step that finds its result on disk takes it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import asdict, dataclass
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import COMMANDS, Command, named_command, standing_anchor
from hector_jax.control.walking import WalkConfig, walk_config
from hector_jax.control.weights import WEIGHT_NAMES, Weights, nominal, weights_to_vector
from hector_jax.core.console import bar, say_if_slow
from hector_jax.core.environment import code_hash
from hector_jax.core.files import append_file, as_json, locked, write_file
from hector_jax.core.inputs import InputError, plural, short_repr
from hector_jax.core.runtime import message_queue
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, SEED, check, from_table
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import check_settings, tree_hash
from hector_jax.grfm import collection, dataset, network, training
from hector_jax.grfm.collection import Walks
from hector_jax.grfm.dataset import Dataset
from hector_jax.grfm.effect import HISTORY, last_command
from hector_jax.grfm.jobs import draw_jobs, draw_jobs_near
from hector_jax.grfm.nets import History
from hector_jax.grfm.network import Params
from hector_jax.grfm.paper import LinearMap, fit_linear
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot.model import Robot
from hector_jax.runs import replay
from hector_jax.runs.cache import cached, content_key, robot_hash
from hector_jax.search import cmaes as searching
from hector_jax.search.cmaes import Found, Generation, SearchConfig, best
from hector_jax.sim.engine import ENGINES, MUJOCO_C, Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Imperfections, hfs, hfs_drawn
from hector_jax.tuning import difftune, measured
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Evaluation, Iteration, TuneConfig, Tuning
from hector_jax.tuning.loss import Losses, loss_of
from hector_jax.tuning.measured import evaluate_walk
from hector_jax.tuning.rollout import RolloutConfig, rollout

TUNING = "tuning"  # kind of a file
# modules that decide the numbers, for `runs.cache.content_key`
TUNING_CODE = ("tuning.difftune", "grfm.network")
TRAINING_CODE = ("grfm.training",)
COLLECTION_CODE = (*TUNING_CODE, "grfm.collection", "grfm.jobs", "sim.parallel")
SEARCH_CODE = ("search.cmaes", "tuning.loss", "sim.parallel")


@dataclass(frozen=True)
class CollectConfig:
    """Walks on the hfs to learn the ground from."""

    walks: int = 64
    seconds: float = 4.0  # of each
    seed: int = 0
    engine: str = "auto"  # c: MuJoCo on the processes; mjx: all at once; auto: mjx on a GPU

    def __post_init__(self) -> None:
        # devices stay unasked: their number may not be set up yet
        check(self, walks=AT_LEAST_ONE, seconds=POSITIVE, seed=SEED, engine=("auto", *ENGINES))
        if self.walks < 3:
            raise InputError(
                "CollectConfig.walks must be at least 3 (to learn from, to choose by, to judge "
                f"by), got {self.walks}"
            )
        least = HISTORY * GaitConfig.tick
        if self.seconds < least:
            raise InputError(
                f"CollectConfig.seconds must be at least {least:g} s, the {HISTORY} ticks of one "
                f"sample, got {short_repr(self.seconds)}"
            )


REFRESH = CollectConfig(walks=32)  # walks at the current weights, each time


class Learned(NamedTuple):
    """A trained GRFM-Net with what there is to say about it."""

    params: Params
    linear: LinearMap  # the baseline, fitted to the same samples
    errors: dict[str, Any]  # of raw command, linear map and net on walks that no training saw
    course: History
    config: TrainConfig
    folders: tuple[Path, ...]  # of the walks; none for a net that came alone
    held_out: list[int]  # numbers of the walks that no training saw


class Tuned(NamedTuple):
    """A tuning with its history."""

    tuning: Tuning
    commit: str  # at which it was made; empty where that is not known


class Journal:
    """metrics.jsonl: a line for each iteration as it comes, in order when the tunings are over."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._histories: dict[str, Sequence[Iteration]] = {}

    def write(self, histories: Mapping[str, Sequence[Iteration]]) -> None:
        """Write the file anew, with these tunings after or instead of those written before.

        Raises:
            WriteError: where the file cannot be written; the old one stays.
        """
        self._histories.update(histories)
        lines = (as_line(name, i) for name, history in self._histories.items() for i in history)
        write_file(self.path, "".join(lines).encode())

    def add(self, name: str, iteration: Iteration) -> None:
        """Write one line more.

        Raises:
            WriteError: where the file cannot be written.
        """
        append_file(self.path, as_line(name, iteration).encode())


def _stored(tuned: Tuned) -> Any:
    """A tuning as arrays, iterations stacked, as `_stored_like`."""
    history = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *tuned.tuning.history)
    return Tuned(tuned.tuning._replace(history=history), tuned.commit)


def _stored_like(_: Any) -> Any:
    none, text = np.zeros(0), np.array("")
    rows = jax.tree.map(lambda w: np.zeros((0, *w.shape)), nominal())
    seen = Evaluation(none, Losses(none, none, none), rows, none, none)
    history: Any = Iteration(none, rows, seen, none, np.zeros(0, "U1"), none)  # pyright: ignore
    return Tuned(Tuning(history, nominal(), nominal(), text), text)  # pyright: ignore


def _restored(stored: Any) -> Tuned:
    """What `_stored` was given."""
    tuning, rows = stored.tuning, stored.tuning.history
    history = [
        Iteration(
            int(rows.iteration[i]),
            *jax.tree.map(lambda x, i=i: np.asarray(x[i]), (rows.weights, rows.evaluation)),
            accepted=bool(rows.accepted[i]),
            reason=str(rows.reason[i]),
            step=float(rows.step[i]),
        )
        for i in range(len(rows.iteration))
    ]
    tuning = Tuning(history, tuning.ten, tuning.converged, str(tuning.stop))
    return Tuned(tuning, str(stored.commit))


def _tune_job(
    config: TuneConfig, robot: Robot, command: Command, params: Params | None, name: str, heard: Any
) -> Tuning:
    """One tuning in a worker; the queue `heard` is told of each iteration."""
    return difftune.tune(
        config,
        robot,
        nominal(robot),
        command,
        standing_anchor(robot),
        network.effect_of(params, config.rollout.walk.gait),
        lambda iteration: heard.put((name, iteration)),
    )


def _tunings(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    problems: Mapping[str, tuple[Command, Params | None]],
    title: str,
    on_iteration: Callable[[str, Iteration], None],
) -> Iterator[tuple[str, Tuning]]:
    """Tune several problems side by side; yields each tuning with its name when it has ended."""
    done, total = 0, config.iterations * len(problems)
    with message_queue() as heard, bar(title) as tell:
        running: dict[Future[Tuning], str] = {
            pool.submit(_tune_job, config, robot, command, params, name, heard): name
            for name, (command, params) in problems.items()
        }
        tell(done, total, "compiling")
        while running:
            ended = wait(running, timeout=0.1, return_when=FIRST_COMPLETED).done
            while not heard.empty():  # also all that those told which have ended
                name, iteration = heard.get()
                done += iteration.iteration > 0
                tell(done, total, f"{name}: L {float(iteration.evaluation.loss) / 1e6:.3f}e6")
                on_iteration(name, iteration)
            for future in ended:
                yield running.pop(future), future.result()


def tune(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    problems: Mapping[str, tuple[Command, Params | None]],
    folder: Path,
    *,
    title: str,
    commit: str = "",
    journal: Journal | None = None,
    dumps: Path | None = None,
) -> dict[str, Tuned]:
    """Tune several problems side by side from the nominal weights; `folder` keeps those that ended.

    Args:
        pool: worker processes.
        config: how.
        robot: the body.
        problems: by name, the command and the net to tune through (None: the plain rigid body).
        folder: of the tunings, a file for each; a tuning that is there is not tuned again.
        title: for the person who waits.
        commit: to note with what is tuned now.
        journal: of the iterations.
        dumps: folder for what was refused, see `replay.keep`; None: nothing is kept.

    Raises:
        InputError: the starting weights fall or cannot be solved on the model; the folder cannot be
            written.
    """
    paths = {
        name: folder
        / f"tuning-{name}-{content_key(config, robot, nominal(robot), *each, code=TUNING_CODE)}.npz"
        for name, each in problems.items()
    }

    def on_iteration(name: str, iteration: Iteration) -> None:
        if journal is not None:
            journal.add(name, iteration)
        if dumps is not None:
            command, params = problems[name]
            anchor = standing_anchor(robot)
            replay.keep(dumps, name, config, robot, command, anchor, params, iteration)

    def make(missing: list[str], found: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        if journal is not None:
            there = {name: _restored(one).tuning.history for name, one in found.items()}
            journal.write({name: there.get(name, ()) for name in problems})  # in their order
        asked = {name: problems[name] for name in missing}
        for name, tuning in _tunings(pool, config, robot, asked, title, on_iteration):
            yield name, _stored(Tuned(tuning, commit))

    stored = cached(paths, make, like=_stored_like, kind=TUNING, robot=robot)
    tuned = {name: _restored(one) for name, one in stored.items()}
    if journal is not None:
        journal.write({name: one.tuning.history for name, one in tuned.items()})
    return tuned


def measured_plants(count: int) -> list[Imperfections]:
    """The hfs and plants drawn around it, which tunings on walks go by; others judge variants."""
    return [hfs(), *(hfs_drawn(seed) for seed in range(500, 499 + count))]


def _measured_job(
    config: TuneConfig,
    robot: Robot,
    command: Command,
    params: Params | None,
    weights: Weights,
    plant: Imperfections,
) -> Evaluation:
    seconds = config.rollout.ticks * config.rollout.walk.gait.tick
    walked = walk(config.rollout.walk, robot, Job(weights, command, plant, seconds))
    effect = network.effect_of(params, config.rollout.walk.gait)
    return evaluate_walk(config, robot, weights, command, effect, walked)


def tune_measured(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    params: Params | None,
    plants: Sequence[Imperfections],
    folder: Path,
    *,
    title: str,
    commit: str = "",
) -> Tuned:
    """Tune on along walks on the high-fidelity simulator, one on each plant for every step.

    Args:
        pool: worker processes.
        config: how.
        robot: the body.
        weights: where to start: those of a tuning on the model.
        command: what to walk.
        params: the net whose Jacobian is used; None: the plain rigid body.
        plants: see `measured_plants`.
        folder: of the tuning; one that is there is not tuned again.
        title: for the person who waits.
        commit: to note with what is tuned now.

    Raises:
        InputError: a walk with the starting weights falls or cannot be believed; the folder cannot
            be written.
    """
    code = (*TUNING_CODE, "tuning.measured", "sim.walk")
    key = content_key(config, robot, weights, command, params, *plants, code=code)
    job = partial(_measured_job, config, robot, command, params)

    def make(missing: list[str], found: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        with bar(title) as tell:
            tell(0, config.iterations, "compiling")
            tuning = measured.tune_measured(
                config,
                weights,
                lambda trial: list(pool.map(job, repeat(trial), plants)),
                lambda iteration: tell(
                    iteration.iteration,
                    config.iterations,
                    f"L {float(iteration.evaluation.loss) / 1e6:.3f}e6",
                ),
            )
        yield "walks", _stored(Tuned(tuning, commit))

    paths = {"walks": folder / f"tuning-walks-{key}.npz"}
    return _restored(cached(paths, make, like=_stored_like, kind=TUNING, robot=robot)["walks"])


def _norms_job(config: TuneConfig, robot: Robot, command: Command, params: Params | None) -> Losses:
    effect = network.effect_of(params, config.rollout.walk.gait)
    model = command, standing_anchor(robot), effect
    return jax.device_get(difftune.gradient_norms(config, robot, nominal(robot), *model))


def gradient_norms(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    problems: Mapping[str, tuple[Command, Params | None]],
) -> dict[str, Losses]:
    """Norms of the gradients of the loss's parts at the nominal weights, by problem."""
    with bar("norms of the gradients") as tell:
        running = {
            name: pool.submit(_norms_job, config, robot, command, params)
            for name, (command, params) in problems.items()
        }
        tell(0, len(problems), "compiling")
        return {name: future.result() for name, future in running.items()}


def path_config(robot: Robot) -> TuneConfig:
    """Settings of the tunings whose weights the data cover: the same whatever is tuned later."""
    return TuneConfig(rollout=RolloutConfig(walk=walk_config(robot)))


def tuning_paths(pool: Executor, robot: Robot, folder: Path) -> list[Weights]:
    """Weights that plain tunings of the trajectories pass through, stacked: data covers them.

    The tunings are kept in `folder`.
    """
    config = path_config(robot)
    problems = {name: (named_command(name), None) for name in COMMANDS}
    title = "tuning paths on the rigid body, for the data"
    tuned = tune(pool, config, robot, problems, folder, title=title)
    stacked = []
    for name in COMMANDS:
        passed = [i.weights for i in tuned[name].tuning.history if i.accepted]
        stacked.append(jax.tree.map(lambda *w: np.stack(w), *passed))
    return stacked


def _compile_tuning(config: TuneConfig, robot: Robot) -> None:
    command, effect = named_command("straight"), network.effect_of(None, config.rollout.walk.gait)
    difftune.tune_step(config, robot, nominal(robot), command, standing_anchor(robot), effect)


def _compile_walking(config: WalkConfig, robot: Robot) -> None:
    walk(config, robot, Job(nominal(robot), named_command("straight"), hfs(), config.gait.tick))


def compile_programs(pool: Executor, robot: Robot) -> None:
    """Compile what tunings and walks run, each program in one process; the others load it."""
    config = path_config(robot)
    with bar("compiling, once on a machine") as tell:
        jobs = [
            pool.submit(_compile_tuning, config, robot),
            pool.submit(_compile_walking, config.rollout.walk, robot),
        ]
        for done, job in enumerate(jobs):
            tell(done, len(jobs), "")
            job.result()
        tell(len(jobs), len(jobs), "")


def collection_settings(config: CollectConfig, robot: Robot) -> dict[str, Any]:
    """All that the walks of a collection follow from, as JSON values for their card."""
    paths = path_config(robot)
    return {
        **asdict(config),
        "controller": repr(paths.rollout.walk),
        "paths": content_key(paths, robot, nominal(robot), code=()),
        "robot": robot_hash(robot),
        "code": code_hash(*COLLECTION_CODE),
    }


def collect(pool: Executor, config: CollectConfig, robot: Robot, folder: Path) -> None:
    """Walk on drawn hfs plants and keep the walks under `folder`; takes up what is there.

    Raises:
        InputError: the folder cannot be written, told before anything is walked; or it holds walks
            of other settings.
    """
    with locked(folder):
        compile_programs(pool, robot)
        paths = tuning_paths(pool, robot, folder / "paths")
        jobs = draw_jobs(config.seed, config.walks, paths, seconds=config.seconds, robot=robot)
        settings = collection_settings(config, robot)
        _keep_walks(pool, choose_engine(config.engine), robot, jobs, folder, settings)


def _keep_walks(
    pool: Executor,
    engine: Engine,
    robot: Robot,
    jobs: Sequence[Job],
    folder: Path,
    settings: Mapping[str, Any],
) -> None:
    what = f"{plural(len(jobs), 'walk')} on the high-fidelity simulator, engine {engine.name}"
    with bar(f"collecting {what}") as tell:
        collection.collect(
            folder,
            jobs,
            lambda missing: engine.walk(pool, walk_config(robot), robot, missing, exact=False),
            robot=robot,
            settings=settings,
            about={"engine": engine.name, "physics_bits": engine.bits(False)},
            progress=lambda done, of: tell(done, of, "" if done else "compiling"),
        )


def walk_rigid_body(robot: Robot, weights: Weights, command: Command, seconds: float) -> Trajectory:
    """A walk on the plain single rigid body, `seconds` long, from standing."""
    controller = walk_config(robot)
    config = RolloutConfig(controller, ticks=round(seconds / controller.gait.tick))
    walked = jax.jit(rollout, static_argnums=0)
    anchor = standing_anchor(robot)
    return jax.device_get(walked(config, robot, weights, command, anchor, last_command))


class Samples(NamedTuple):
    """The samples of a collection; no walk is in two of the parts."""

    training: Dataset
    validation: Dataset  # chooses the epoch of a net
    held_out: Dataset  # is only looked at
    dropped: int  # by a fall, an unsolved QP or a push


def samples(robot: Robot, *folders: Path) -> Samples:
    """Samples of the walks under `folders`: a fifth of the walks held out, of the rest another.

    Each folder is split by itself, so that what was held out stays held out beside other walks;
    walks are numbered by folder.
    """
    each = [_samples(robot, folder) for folder in folders]
    join = lambda *parts: jax.tree.map(lambda *x: np.concatenate(x), *parts)  # noqa: E731
    return Samples(
        join(*(one.training for one in each)),
        join(*(one.validation for one in each)),
        join(*(one.held_out for one in each)),
        sum(one.dropped for one in each),
    )


def _samples(robot: Robot, folder: Path) -> Samples:
    walks = collection.load_walks(folder, robot)
    found, dropped = dataset.make_dataset(
        robot, walks.trajectory, walks.job.start_tick, push=walks.job.push
    )
    rest, held_out = dataset.split_by_walk(found)
    return Samples(*dataset.split_by_walk(rest, seed=1), held_out, dropped)


def held_out(robot: Robot, net: Learned) -> Walks:
    """The walks that no training of a net saw, of the folder that it was trained on."""
    walks = collection.load_walks(net.folders[0], robot)
    return jax.tree.map(lambda x: x[net.held_out], walks)


def walks_of(
    pool: Executor, config: TuneConfig, robot: Robot, jobs: Sequence[Job], title: str
) -> Iterator[Trajectory]:
    """The walks of jobs, in order, as they come."""
    with bar(title) as tell:
        tell(0, len(jobs), "compiling")
        for done, found in enumerate(MUJOCO_C.walk(pool, config.rollout.walk, robot, jobs), 1):
            yield found
            tell(done, len(jobs), "")


def walk_all(
    pool: Executor, config: TuneConfig, robot: Robot, jobs: Sequence[Job], title: str
) -> Walks:
    """Walks of jobs whose commands are alike, at the plan interval."""
    walked = walks_of(pool, config, robot, jobs, title)
    walks = [dataset.at_interval(walk, config.rollout.walk.gait.tick) for walk in walked]
    return Walks(stack(jobs), stack(walks))


def train(
    config: TrainConfig, robot: Robot, folder: Path, path: Path, more: Sequence[Path] = ()
) -> Learned:
    """Train a GRFM-Net on the walks under `folder`, and under `more`, and keep it at `path`.

    Its card tells the walks and the controller that it belongs to.

    Raises:
        InputError: the folder cannot be written; there are no walks, or damaged ones.
    """
    with locked(path.parent):
        return _train(config, robot, (folder, *more), path)


def _train(config: TrainConfig, robot: Robot, folders: tuple[Path, ...], path: Path) -> Learned:
    with say_if_slow(f"reading the walks in {', '.join(map(str, folders))}"):
        parts = samples(robot, *folders)
    made_of = [collection.walked_with(each) for each in folders]
    with bar(
        f"training GRFM-Net ({config.variant}) on {plural(len(parts.training.walk), 'sample')}"
    ) as tell:
        tell(0, config.epochs, "compiling")
        params, course = training.train(
            config,
            parts.training,
            parts.validation,
            lambda epoch, _: tell(epoch, config.epochs, ""),
        )
    with say_if_slow("computing the errors on held-out walks"):
        linear = fit_linear(parts.training)
        effects = {
            "raw": last_command,
            "linear": network.as_effect(linear),
            "net": network.as_effect(params),
        }
        errors = training.report(effects, parts.held_out)
    held_out = np.unique(parts.held_out.walk).tolist()
    sizes = {name: len(part.walk) for name, part in parts._asdict().items() if name != "dropped"}
    about = {
        "made_of": made_of[0],
        **({"and_of": made_of[1:]} if made_of[1:] else {}),
        "settings": training_settings(config),
        "samples": {**sizes, "dropped": parts.dropped},
        "held_out": held_out,
        "errors": errors,
        "linear": [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(linear)],
        "course": {name: np.asarray(values).tolist() for name, values in course._asdict().items()},
    }
    network.save_net(path, params, robot=robot, about=about)
    return Learned(params, linear, about["errors"], course, config, folders, held_out)


def net_path(data: Path, variant: str) -> Path:
    """Where the net of a variant is kept: `grfm.npz`, and others than the default by their name."""
    default = variant == TrainConfig().variant
    return data / ("grfm.npz" if default else f"grfm-{variant}.npz")


def load_learned(path: Path, robot: Robot, variant: str) -> tuple[Learned, dict[str, Any]]:
    """A net from a file with what its card says of its training.

    Returns:
        The net, and `settings` and `made_of` of its card: how it was trained, and on which walks.

    Raises:
        InputError: one line naming the file that is damaged, of another robot or another variant.
    """
    params, _, card = network.load_net(path, robot, variant)
    about = card["about"]
    try:
        linear = jax.tree.unflatten(
            jax.tree.structure(network.layout("linear", ())), map(np.array, about["linear"])
        )
        held_out = list(about["held_out"])
        settings, made_of = dict(about["settings"]), dict(about["made_of"])
        trained = {k: v for k, v in settings.items() if k != "code"}
        config = from_table(f"{path}: about.settings", TrainConfig, trained)
        course = History(**{n: np.array(about["course"][n], float) for n in History._fields})
        errors = {name: about["errors"][name] for name in ("raw", "linear", "net")}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: its card does not tell its training: {error!r}") from None
    made = {"settings": settings, "made_of": made_of}
    return Learned(params, linear, errors, course, config, (), held_out), made


def training_settings(config: TrainConfig) -> dict[str, Any]:
    """All that a net follows from beside its walks, as JSON values for its card."""
    return {**asdict(config), "code": code_hash(*TRAINING_CODE)}


def ground(pool: Executor, robot: Robot, data: Path, variant: str | None = None) -> Learned:
    """A GRFM-Net with its walks under `data`: made now, or from disk where it would be made so.

    Args:
        pool: worker processes.
        robot: the body.
        data: folder of `walks/` and of the net, see `net_path`.
        variant: of the net; None takes the default one.

    Raises:
        InputError: walks or net in the folder were made with other settings or by other code, the
            net on other walks, or a file is damaged or of another robot or variant.
    """
    config = TrainConfig() if variant is None else TrainConfig(variant=variant)
    walks, path = data / "walks", net_path(data, config.variant)
    settings = collection_settings(CollectConfig(), robot)
    if not (walks / "card.json").exists():
        collect(pool, CollectConfig(), robot, walks)
    made_of = collection.walked_with(walks)
    check_settings(walks, {name: made_of.get(name) for name in settings}, settings)
    with locked(data):  # a second process that begins now waits, and finds the net
        if not path.exists():
            return _train(config, robot, (walks,), path)
    found, about = load_learned(path, robot, config.variant)
    check_settings(path, about["settings"], training_settings(config))
    check_settings(path, about["made_of"], made_of)
    return found._replace(folders=(walks,))


def _command(name: str, own: Mapping[str, Command] | None) -> Command:
    return own[name] if own and name in own else named_command(name)


def losses_on_hfs(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    engine: Engine,
    sets: Mapping[str, Sequence[Weights]],
    at_once: int,
    own: Mapping[str, Command] | None = None,
) -> dict[str, Float[np.ndarray, " sets"]]:
    """L of weight sets on the high-fidelity simulator, one walk each, as long as the rollouts.

    Args:
        pool: worker processes.
        config: controller, length and loss.
        robot: the body.
        engine: of the walks.
        sets: by the trajectory that they walk.
        at_once: walks that a program is compiled for; fewer are filled up to it.
        own: commands of trajectories that are not built in, by their name.
    """
    walk = config.rollout.walk
    seconds = config.rollout.ticks * walk.gait.tick
    jobs = [
        Job(weights, _command(name, own), hfs(), seconds)
        for name, each in sets.items()
        for weights in each
    ]
    walks = engine.walk(pool, walk, robot, jobs, batch=at_once)
    told = iter([float(loss_of(config.loss, walked)) for walked in walks])
    return {name: np.array([next(told) for _ in each]) for name, each in sets.items()}


def search(
    pool: Executor,
    config: SearchConfig,
    tune: TuneConfig,
    robot: Robot,
    starts: Mapping[str, Weights],
    engine: Engine,
    folder: Path,
    own: Mapping[str, Command] | None = None,
) -> dict[str, Found]:
    """CMA-ES on the high-fidelity simulator, taking up the records under `folder`.

    Args:
        pool: worker processes.
        config: of the search.
        tune: controller, length of the walks and loss, the same as those of tunings.
        robot: the body.
        starts: where to start, by the name of the trajectory; all go in lock-step.
        engine: of the walks.
        folder: of the records.
        own: commands of trajectories that are not built in, by their name.

    Raises:
        InputError: see `named_command` and `tuning.search.search`.
        InputError: the folder cannot be written; told before
            anything is walked.
    """
    size = config.population * len(starts)
    about = {  # not the engine: both give a loss to seven digits
        "seconds": tune.rollout.ticks * tune.rollout.walk.gait.tick,
        "controller": repr(tune.rollout.walk),
        "loss": repr(tune.loss),
        "robot": robot_hash(robot),
        "plant": tree_hash(hfs()),
        "commands": {name: tree_hash(_command(name, own)) for name in (*COMMANDS, *starts)},
    }

    def walk(sets: Mapping[str, Sequence[Weights]]) -> dict[str, np.ndarray]:
        return losses_on_hfs(pool, tune, robot, engine, sets, size, own)

    title = f"searching on the high-fidelity simulator, engine {engine.name}"
    with locked(folder), bar(title) as tell:

        def on_generation(histories: Mapping[str, list[Generation]]) -> None:
            done = sum(len(history) for history in histories.values()) * config.population
            lowest = (
                f"{name} {best(history)[1] / 1e6:.3f}e6"
                for name, history in histories.items()
                if history
            )
            tell(
                done,
                config.generations * size,
                "lowest L: " + ", ".join(lowest) if done else "compiling",
            )

        return searching.search(config, starts, walk, folder, about, on_generation)


def refresh(
    pool: Executor,
    config: CollectConfig,
    tune: TuneConfig,
    robot: Robot,
    command: Command,
    tuning: Tuning,
    before: Learned,
    folder: Path,
) -> tuple[Learned, dict[str, Any]]:
    """Collect again where a tuning went, and train its net anew on the old and the new walks.

    The walks are kept in `folder`/walks and the net in `folder`/refreshed.npz.

    Args:
        pool: worker processes.
        config: how much to walk.
        tune: of the tuning.
        robot: the body.
        command: that was tuned for.
        tuning: whose weights, from ten iterations to converged, are walked.
        before: the net that it went through; the new one is trained as this one was.
        folder: where.

    Returns:
        The new net, and the shift: errors of the raw command and of the nets `before` and `after`
        on held-out walks, `old` and `new`, as `training.report` gives them.
    """
    walks = folder / "walks"
    late = [i.weights for i in tuning.history if i.accepted and i.iteration > PAPER_ITERATIONS]
    path = jax.tree.map(lambda *w: np.stack(w), tuning.ten, *late)
    jobs = draw_jobs_near(config.seed, config.walks, command, path=path, seconds=config.seconds)
    with locked(walks):
        # the jobs say the rest
        settings = {**asdict(config), "code": code_hash(*COLLECTION_CODE)}
        _keep_walks(pool, choose_engine(config.engine), robot, jobs, walks, settings)
    oldest, *newer = (*before.folders, walks)
    after = train(before.config, robot, oldest, folder / "refreshed.npz", newer)
    effects = {
        "raw": last_command,
        "before": network.as_effect(before.params),
        "after": network.as_effect(after.params),
    }
    places = {"old": before.folders, "new": (walks,)}
    return after, {
        name: training.report(effects, samples(robot, *folders).held_out)
        for name, folders in places.items()
    }


def judge(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    command: Command,
    plants: Sequence[Imperfections],
    seeds: Sequence[int],
    title: str,
    seconds: float = 4.0,
) -> dict[str, list[Trajectory]]:
    """Walk every weight set on every plant, `seconds` each; by set, in order of the plants."""
    jobs = [
        Job(weights, command, plant, seconds, seed)
        for weights in sets.values()
        for plant, seed in zip(plants, seeds, strict=True)
    ]
    walks = list(walks_of(pool, config, robot, jobs, title))
    each = len(plants)
    return {name: walks[i * each : (i + 1) * each] for i, name in enumerate(sets)}


def as_line(name: str, iteration: Iteration) -> str:
    """A line of metrics.jsonl."""
    found = iteration.evaluation
    gradient = jax.tree.map(np.multiply, found.gradient, iteration.weights)
    vector = lambda tree: np.asarray(weights_to_vector(tree)).tolist()  # noqa: E731
    row = {
        "set": name,
        "iteration": iteration.iteration,
        "accepted": iteration.accepted,
        "reason": iteration.reason,
        "step": iteration.step,
        "L": float(found.loss),
        "L_Eul": float(found.parts.euler),
        "L_pos": float(found.parts.position),
        "L_ctrl": float(found.parts.control),
        "fallen": float(found.fallen),
        "residual": float(found.residual),
        "weights": dict(zip(WEIGHT_NAMES, vector(iteration.weights), strict=True)),
        "gradient_log": dict(zip(WEIGHT_NAMES, vector(gradient), strict=True)),
    }
    return as_json(row) + "\n"
