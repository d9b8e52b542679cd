"""The steps `collect` and `fit`: collection of walks, and training of nets on them."""

from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import walk_config
from hector_jax.control.gait import GaitConfig
from hector_jax.control.trajectories import command_of
from hector_jax.control.weights import nominal
from hector_jax.core.console import bar, say, say_if_slow
from hector_jax.core.environment import code_hash
from hector_jax.core.files import locked, make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError, plural, short_repr
from hector_jax.core.journal import check_settings
from hector_jax.core.settings import POSITIVE, SEED, Range, check
from hector_jax.grfm import dataset, network, training
from hector_jax.grfm.effect import HISTORY, last_command
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.grfm.nets import History
from hector_jax.grfm.network import Params, as_effect
from hector_jax.grfm.paper import LinearMap, fit_linear
from hector_jax.grfm.training import TrainConfig
from hector_jax.robot.model import Robot
from hector_jax.sim.engine import ENGINES, choose_engine
from hector_jax.store import collection
from hector_jax.store.cache import content_key, robot_hash
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import TUNING_CODE, compile_programs, tune_config, tuning_paths

_WALKS = "walks"  # folder of the walks of a tuning, beside its net
# modules that determine the numbers, for `code_hash`
TRAINING_CODE = ("store.nets", "grfm.training")
COLLECTION_CODE = (*TUNING_CODE, "store.collection", "grfm.jobs", "sim.walk", "sim.parallel")


@dataclass(frozen=True)
class CollectConfig:
    """Settings of walks on the hfs, from which a net learns the ground."""

    walks: int = 64
    seconds: float = 4.0  # of each
    seed: int = 0
    engine: str = "auto"  # c: MuJoCo in worker processes; mjx: all at once; auto: mjx on a GPU

    def __post_init__(self) -> None:
        # no device is looked up: their number may not be set up yet
        # three walks: for training, validation and testing
        check(self, walks=Range(3), seconds=POSITIVE, seed=SEED, engine=("auto", *ENGINES))
        least = HISTORY * GaitConfig.tick
        if self.seconds < least:
            raise InputError(
                f"CollectConfig.seconds must be at least {least:g} s, the {HISTORY} ticks of one "
                f"sample, got {short_repr(self.seconds)}"
            )


class TrainedNet(NamedTuple):
    """A trained GRFM-Net with its training and its errors."""

    params: Params
    linear: LinearMap  # the baseline, fitted to the same samples
    errors: dict[str, Any]  # of raw command, linear map and net on held-out walks
    history: History
    folder: Path | None  # of the walks; None for a net without walks
    held_out_walks: list[int]  # numbers of the walks that were not trained on


def collection_settings(config: CollectConfig, robot: Robot) -> dict[str, Any]:
    """Return all inputs of the walks of a collection, as JSON values for their card."""
    paths, engine = tune_config(robot), choose_engine(config.engine)
    return {
        "robot": robot_hash(robot),  # first: another robot has other paths and gains too
        **asdict(config),
        "engine": engine.key,
        "physics_bits": engine.bits(False),
        "controller": repr(paths.rollout.walk),
        "paths": content_key(paths, robot, nominal(robot), code=()),
        "code": code_hash((*COLLECTION_CODE, *engine.modules)),
    }


def collect_walks(pool: Executor, config: CollectConfig, robot: Robot, folder: Path) -> None:
    """Walk on drawn hfs plants and save the walks under `folder`, continuing from those in it.

    Raises:
        InputError: the folder cannot be written, which is checked before the walks; or it holds
            walks of other settings.
    """
    engine = choose_engine(config.engine)
    what = f"{plural(config.walks, 'walk')} on the high-fidelity simulator, engine {engine.name}"
    with locked(folder):
        settings = collection_settings(config, robot)
        collection.check_made(folder, settings)
        setup = Setup(pool, tune_config(robot), robot)
        compile_programs(setup, nominal(robot), command_of("straight"))
        paths = tuning_paths(pool, robot, folder / "paths")
        jobs = draw_jobs(config.seed, config.walks, paths, seconds=config.seconds, robot=robot)
        collection.collect(
            folder,
            jobs,
            lambda missing: engine.walk(pool, walk_config(robot), robot, missing, exact=False),
            robot=robot,
            settings=settings,
            title=f"collecting {what}",
        )


class SampleSets(NamedTuple):
    """Samples of a collection; no walk is in two of the parts."""

    training: dataset.Dataset
    validation: dataset.Dataset  # to choose the epoch of a net
    held_out: dataset.Dataset  # for errors only
    dropped: int  # number of samples dropped for a fall, an unsolved QP or a push


def samples(robot: Robot, folder: Path) -> SampleSets:
    """Return samples of the walks under a folder: 1/5 held out, 1/5 of the rest for validation."""
    job, walk = collection.load_walks(folder, robot)
    data, dropped = dataset.make_dataset(robot, walk, job.start_tick, push=job.push)
    rest, held_out = dataset.split_by_walk(data)
    return SampleSets(*dataset.split_by_walk(rest, seed=1), held_out, dropped)


def held_out_walks(robot: Robot, net: TrainedNet) -> collection.Walks:
    """Load the held-out walks from the folder on which a net was trained."""
    assert net.folder is not None  # a net without walks has none to load
    walks = collection.load_walks(net.folder, robot)
    return jax.tree.map(lambda x: x[net.held_out_walks], walks)


def train_net(config: TrainConfig, robot: Robot, folder: Path, path: Path) -> TrainedNet:
    """Train a GRFM-Net on the walks under `folder` and save it at `path`.

    Its card describes its walks and their controller.

    Raises:
        InputError: the folder cannot be written; there are no walks, or damaged ones.
    """
    make_folder(path.parent)
    with say_if_slow(f"reading the walks in {folder}"):
        parts = samples(robot, folder)
    count = plural(len(parts.training.walk), "sample")
    with bar(f"training GRFM-Net ({config.variant}) on {count}") as report_progress:
        report_progress(0, config.epochs, "compiling")
        on_epoch = lambda epoch, _: report_progress(epoch, config.epochs, "")  # noqa: E731
        params, history = training.train(config, parts.training, parts.validation, on_epoch)
    with say_if_slow("computing the errors on held-out walks"):
        linear = fit_linear(parts.training)
        effects = {"raw": last_command, "linear": as_effect(linear), "net": as_effect(params)}
        errors = training.errors_by_phi(effects, parts.held_out)
    if parts.held_out.lands.any() and errors["net"]["touchdown"] == errors["raw"]["touchdown"]:
        say(
            f"{robot.description.path}: tuning.touchdown_error: the net {config.variant} does not "
            "learn where the feet land"
        )
    held_out = np.unique(parts.held_out.walk).tolist()
    sizes = {name: len(part.walk) for name, part in parts._asdict().items() if name != "dropped"}
    about = {
        "made_of": collection.fingerprint(folder),
        "settings": training_settings(config, robot),
        "samples": {**sizes, "dropped": parts.dropped},
        "held_out": held_out,
        "errors": errors,
        "linear": [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(linear)],
        "course": {name: np.asarray(rows).tolist() for name, rows in history._asdict().items()},
    }
    network.save_net(path, params, robot=robot, about=about)
    return TrainedNet(params, linear, errors, history, folder, held_out)


def net_path(data: Path, variant: str) -> Path:
    """Return the file of the net of a variant: `grfm.npz` for the default, else with its name."""
    return data / ("grfm.npz" if variant == TrainConfig.variant else f"grfm-{variant}.npz")


def own_path(walks: Path, config: TrainConfig) -> Path:
    """Return the file of a net: `net_path`, with what a tuning would not train it with or on."""
    path = net_path(walks.parent, config.variant)
    if walks.name != _WALKS:
        path = path.with_stem(f"{path.stem}-{walks.name}")
    return _apart(path, config, TrainConfig(variant=config.variant))


def own_folder(walks: Path, config: CollectConfig) -> Path:
    """Return the folder of walks, with the settings in its name that a tuning would not have."""
    if choose_engine(config.engine) == choose_engine(CollectConfig.engine):
        config = replace(config, engine=CollectConfig.engine)
    return _apart(walks, config, CollectConfig())


def _apart(path: Path, config: Any, default: Any) -> Path:
    usual = asdict(default)
    other = [f"-{name}-{value}" for name, value in asdict(config).items() if value != usual[name]]
    return path.with_name("".join([path.stem, *other, path.suffix]))


def load_trained(path: Path, robot: Robot, variant: str) -> tuple[TrainedNet, dict[str, Any]]:
    """Load a net from a file, with the description of its training from its card.

    Returns:
        The net, and `settings` and `made_of` of its card: settings and walks of its training.

    Raises:
        InputError: one line naming the file that is damaged, of another robot or another variant.
    """
    params, _, card = network.load_net(path, robot, variant)
    about = card["about"]
    try:
        structure = jax.tree.structure(network.empty_params("linear", (), walk_config(robot)))
        linear = jax.tree.unflatten(structure, map(np.array, about["linear"]))
        held_out = list(about["held_out"])
        settings, made_of = dict(about["settings"]), dict(about["made_of"])
        history = History(**{n: np.array(about["course"][n], float) for n in History._fields})
        errors = {name: about["errors"][name] for name in ("raw", "linear", "net")}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: its card does not tell its training: {error!r}") from None
    inputs = {"settings": settings, "made_of": made_of}
    return TrainedNet(params, linear, errors, history, None, held_out), inputs


def training_settings(config: TrainConfig, robot: Robot) -> dict[str, Any]:
    """Return all inputs of a net other than its walks, as JSON values for its card."""
    phi = network.VARIANTS[config.variant]
    return {
        **asdict(config),
        "functions": [function_id(f) for f in (phi.init, phi.fit, phi.apply)],
        "touchdown_error": robot.description.tuning.touchdown_error,
        "code": code_hash(TRAINING_CODE),
    }


def load_or_train(
    pool: Executor, robot: Robot, data: Path, variant: str = TrainConfig.variant
) -> TrainedNet:
    """Return a GRFM-Net with its walks under `data`, which are made if they do not exist.

    Args:
        pool: worker processes.
        robot: robot of the walks.
        data: folder of `walks/` and of the net, see `net_path`.
        variant: variant of the net.

    Raises:
        InputError: walks or net in the folder were made with other settings or by other code, the
            net on other walks, or a file is damaged or of another robot or variant.
    """
    config = TrainConfig(variant=variant)
    walks, path = data / _WALKS, net_path(data, config.variant)
    collection.check_made(walks, collection_settings(CollectConfig(), robot))
    if not collection.is_finished(walks):
        collect_walks(pool, CollectConfig(), robot, walks)
    made_of = collection.fingerprint(walks)
    with locked(data):  # a second process waits here, and then loads the net
        if not path.exists():
            return train_net(config, robot, walks, path)
    net, inputs = load_trained(path, robot, config.variant)
    check_settings(path, inputs["settings"], training_settings(config, robot))
    check_settings(path, inputs["made_of"], made_of)
    return net._replace(folder=walks)
