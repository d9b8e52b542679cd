"""The steps `collect` and `fit`: walks to learn from, and nets trained on them."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import walk_config
from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import Command
from hector_jax.control.weights import nominal
from hector_jax.core.console import bar, say, say_if_slow
from hector_jax.core.environment import code_hash
from hector_jax.core.files import locked
from hector_jax.core.inputs import InputError, plural, short_repr
from hector_jax.core.settings import POSITIVE, SEED, Range, check, from_table
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import check_settings
from hector_jax.grfm import collection, dataset, network, training
from hector_jax.grfm.effect import HISTORY, last_command
from hector_jax.grfm.jobs import draw_jobs, draw_jobs_near
from hector_jax.grfm.nets import History
from hector_jax.grfm.network import Params, as_effect
from hector_jax.grfm.paper import LinearMap, fit_linear
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot.model import Robot
from hector_jax.runs.cache import content_key, robot_hash
from hector_jax.runs.tunings import TUNING_CODE, compile_programs, tune_config, tuning_paths
from hector_jax.sim.engine import ENGINES, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Tuning

# modules that decide the numbers, for `code_hash`
TRAINING_CODE = ("grfm.training",)
COLLECTION_CODE = (*TUNING_CODE, "grfm.collection", "grfm.jobs", "sim.walk", "sim.parallel")


@dataclass(frozen=True)
class CollectConfig:
    """Walks on the hfs to learn the ground from."""

    walks: int = 64
    seconds: float = 4.0  # of each
    seed: int = 0
    engine: str = "auto"  # c: MuJoCo on the processes; mjx: all at once; auto: mjx on a GPU

    def __post_init__(self) -> None:
        # devices stay unasked: their number may not be set up yet
        # three walks: to learn from, to choose by, to judge by
        check(self, walks=Range(3), seconds=POSITIVE, seed=SEED, engine=("auto", *ENGINES))
        least = HISTORY * GaitConfig.tick
        if self.seconds < least:
            raise InputError(
                f"CollectConfig.seconds must be at least {least:g} s, the {HISTORY} ticks of one "
                f"sample, got {short_repr(self.seconds)}"
            )


REFRESH = CollectConfig(walks=32)  # walks at the current weights, each time


class TrainedNet(NamedTuple):
    """A trained GRFM-Net with what there is to say about it."""

    params: Params
    linear: LinearMap  # the baseline, fitted to the same samples
    errors: dict[str, Any]  # of raw command, linear map and net on walks that no training saw
    course: History
    config: TrainConfig
    folders: tuple[Path, ...]  # of the walks; none for a net that came alone
    held_out_walks: list[int]  # numbers of the walks that no training saw


def collection_settings(config: CollectConfig, robot: Robot) -> dict[str, Any]:
    """All that the walks of a collection follow from, as JSON values for their card."""
    paths = tune_config(robot)
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
        _collect(pool, config, robot, jobs, folder, collection_settings(config, robot))


def _collect(
    pool: Executor,
    config: CollectConfig,
    robot: Robot,
    jobs: Sequence[Job],
    folder: Path,
    settings: Mapping[str, Any],
) -> None:
    engine = choose_engine(config.engine)
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


class Samples(NamedTuple):
    """The samples of a collection; no walk is in two of the parts."""

    training: dataset.Dataset
    validation: dataset.Dataset  # chooses the epoch of a net
    held_out: dataset.Dataset  # is only looked at
    dropped: int  # by a fall, an unsolved QP or a push


def samples(robot: Robot, *folders: Path) -> Samples:
    """Samples of the walks under `folders`: a fifth of the walks held out, of the rest another.

    Each folder is split by itself, so that what was held out stays held out beside other walks;
    walks are numbered by folder.
    """
    parts, total = [], 0
    for folder in folders:
        job, walk = collection.load_walks(folder, robot)
        data, dropped = dataset.make_dataset(robot, walk, job.start_tick, push=job.push)
        rest, held_out = dataset.split_by_walk(data)
        parts.append((*dataset.split_by_walk(rest, seed=1), held_out))
        total += dropped
    training, validation, held_out = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return Samples(training, validation, held_out, total)


def held_out_walks(robot: Robot, net: TrainedNet) -> collection.Walks:
    """The walks that no training of a net saw, of the folder that it was trained on."""
    walks = collection.load_walks(net.folders[0], robot)
    return jax.tree.map(lambda x: x[net.held_out_walks], walks)


def train(
    config: TrainConfig, robot: Robot, folder: Path, path: Path, more: Sequence[Path] = ()
) -> TrainedNet:
    """Train a GRFM-Net on the walks under `folder`, and under `more`, and keep it at `path`.

    Its card tells the walks and the controller that it belongs to.

    Raises:
        InputError: the folder cannot be written; there are no walks, or damaged ones.
    """
    with locked(path.parent):
        return _train(config, robot, (folder, *more), path)


def _train(config: TrainConfig, robot: Robot, folders: tuple[Path, ...], path: Path) -> TrainedNet:
    with say_if_slow(f"reading the walks in {', '.join(map(str, folders))}"):
        parts = samples(robot, *folders)
    made_of = [collection.fingerprint(each) for each in folders]
    count = plural(len(parts.training.walk), "sample")
    with bar(f"training GRFM-Net ({config.variant}) on {count}") as tell:
        tell(0, config.epochs, "compiling")
        on_epoch = lambda epoch, _: tell(epoch, config.epochs, "")  # noqa: E731
        params, course = training.train(config, parts.training, parts.validation, on_epoch)
    with say_if_slow("computing the errors on held-out walks"):
        linear = fit_linear(parts.training)
        effects = {"raw": last_command, "linear": as_effect(linear), "net": as_effect(params)}
        errors = training.report(effects, parts.held_out)
    if parts.held_out.lands.any() and errors["net"]["touchdown"] == errors["raw"]["touchdown"]:
        say(
            f"{robot.description.path}: tuning.touchdown_error: the net {config.variant} does not "
            "learn where the feet land"
        )
    held_out = np.unique(parts.held_out.walk).tolist()
    sizes = {name: len(part.walk) for name, part in parts._asdict().items() if name != "dropped"}
    about = {
        "made_of": made_of[0],
        **({"and_of": made_of[1:]} if made_of[1:] else {}),
        "settings": training_settings(config, robot),
        "samples": {**sizes, "dropped": parts.dropped},
        "held_out": held_out,
        "errors": errors,
        "linear": [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(linear)],
        "course": {name: np.asarray(values).tolist() for name, values in course._asdict().items()},
    }
    network.save_net(path, params, robot=robot, about=about)
    return TrainedNet(params, linear, about["errors"], course, config, folders, held_out)


def net_path(data: Path, variant: str) -> Path:
    """Where the net of a variant is kept: `grfm.npz`, and others than the default by their name."""
    return data / ("grfm.npz" if variant == TrainConfig.variant else f"grfm-{variant}.npz")


def load_net(path: Path, robot: Robot, variant: str) -> tuple[TrainedNet, dict[str, Any]]:
    """A net from a file with what its card says of its training.

    Returns:
        The net, and `settings` and `made_of` of its card: how it was trained, and on which walks.

    Raises:
        InputError: one line naming the file that is damaged, of another robot or another variant.
    """
    params, _, card = network.load_net(path, robot, variant)
    about = card["about"]
    try:
        structure = jax.tree.structure(network.layout("linear", ()))
        linear = jax.tree.unflatten(structure, map(np.array, about["linear"]))
        held_out = list(about["held_out"])
        settings, made_of = dict(about["settings"]), dict(about["made_of"])
        trained = {k: v for k, v in settings.items() if k not in ("code", "touchdown_error")}
        config = from_table(f"{path}: about.settings", TrainConfig, trained)
        course = History(**{n: np.array(about["course"][n], float) for n in History._fields})
        errors = {name: about["errors"][name] for name in ("raw", "linear", "net")}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: its card does not tell its training: {error!r}") from None
    followed_from = {"settings": settings, "made_of": made_of}
    return TrainedNet(params, linear, errors, course, config, (), held_out), followed_from


def training_settings(config: TrainConfig, robot: Robot) -> dict[str, Any]:
    """All that a net follows from beside its walks, as JSON values for its card."""
    learned = {"touchdown_error": robot.description.tuning.touchdown_error}
    return {**asdict(config), **learned, "code": code_hash(*TRAINING_CODE)}


def load_or_train(
    pool: Executor, robot: Robot, data: Path, variant: str = TrainConfig.variant
) -> TrainedNet:
    """A GRFM-Net with its walks under `data`: made now, or from disk where it would be made so.

    Args:
        pool: worker processes.
        robot: the body.
        data: folder of `walks/` and of the net, see `net_path`.
        variant: of the net.

    Raises:
        InputError: walks or net in the folder were made with other settings or by other code, the
            net on other walks, or a file is damaged or of another robot or variant.
    """
    config = TrainConfig(variant=variant)
    walks, path = data / "walks", net_path(data, config.variant)
    settings = collection_settings(CollectConfig(), robot)
    if not (walks / "card.json").exists():
        collect(pool, CollectConfig(), robot, walks)
    made_of = collection.fingerprint(walks)
    check_settings(walks, {name: made_of.get(name) for name in settings}, settings)
    with locked(data):  # a second process that begins now waits, and finds the net
        if not path.exists():
            return _train(config, robot, (walks,), path)
    trained, about = load_net(path, robot, config.variant)
    check_settings(path, about["settings"], training_settings(config, robot))
    check_settings(path, about["made_of"], made_of)
    return trained._replace(folders=(walks,))


def refresh(
    pool: Executor,
    config: CollectConfig,
    robot: Robot,
    command: Command,
    tuning: Tuning,
    *,
    net: TrainedNet,
    folder: Path,
) -> tuple[TrainedNet, dict[str, Any]]:
    """Collect again where a tuning went, and train its net anew on the old and the new walks.

    The walks are kept in `folder`/walks and the net in `folder`/refreshed.npz.

    Args:
        pool: worker processes.
        config: how much to walk.
        robot: the body.
        command: that was tuned for.
        tuning: whose weights, from ten iterations to converged, are walked.
        net: that it went through; the new one is trained as this one was.
        folder: where.

    Returns:
        The new net, and the shift: errors of the raw command and of the nets `before` and `after`
        on held-out walks, `old` and `new`, as `training.report` gives them.
    """
    walks = folder / "walks"
    late = [i.weights for i in tuning.history if i.accepted and i.iteration > PAPER_ITERATIONS]
    how = {"path": stack([tuning.ten, *late]), "seconds": config.seconds, "robot": robot}
    jobs = draw_jobs_near(config.seed, config.walks, command, **how)
    settings = {**asdict(config), "code": code_hash(*COLLECTION_CODE)}  # the jobs say the rest
    with locked(walks):
        _collect(pool, config, robot, jobs, walks, settings)
    oldest, *newer = (*net.folders, walks)
    after = train(net.config, robot, oldest, folder / "refreshed.npz", newer)
    nets = {"before": as_effect(net.params), "after": as_effect(after.params)}
    effects = {"raw": last_command, **nets}
    places = {"old": net.folders, "new": (walks,)}
    return after, {
        name: training.report(effects, samples(robot, *folders).held_out)
        for name, folders in places.items()
    }
