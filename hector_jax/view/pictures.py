"""The pictures and the film of each command, drawn by plots and video.py."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hector_jax.control.weights import Weights, weight_names, weights_to_vector
from hector_jax.core.console import say
from hector_jax.core.trajectory import Trajectory, Wrench
from hector_jax.grfm.nets import History
from hector_jax.report import plots
from hector_jax.report.fidelity import Drift
from hector_jax.report.report import WORLDS, Picture
from hector_jax.robot.model import Robot
from hector_jax.store.run import Histories
from hector_jax.tuning.difftune import TuneConfig, Tuning
from hector_jax.tuning.loss import Loss
from hector_jax.view.motion import motions
from hector_jax.view.page import ViewedWalk
from hector_jax.view.video import VideoUnavailable, write_film


def of_run(
    folder: Path,
    config: TuneConfig,
    *,
    sets: Mapping[str, Weights],
    tunings: Mapping[str, Tuning],
    walks: Mapping[str, Trajectory],
    ground: Mapping[str, Wrench],
    training: History,
) -> list[Picture]:
    """Draw the pictures of a tuning into `pictures/` of its folder.

    Args:
        folder: folder of the run.
        config: config of the tunings.
        sets: weights by name.
        tunings: tunings by set.
        walks: one walk by set, at the plan interval.
        ground: result of `fidelity.curves`.
        training: errors of the net by epoch.

    Returns:
        The pictures, in the order of the report.
    """
    walks = {name: walks[name] for name in ("nominal", "expert", "with", "best")}
    compared = ("nominal", "expert", "without", "with", "best")
    vectors = {name: np.asarray(weights_to_vector(sets[name])) for name in compared}
    histories = {name: tunings[name].iterations for name in ("without", "with")}
    path, tick = folder / "pictures", config.rollout.walk.gait.tick
    path.mkdir(exist_ok=True)
    names = weight_names(sets["nominal"])
    captions = {
        "tracking": plots.save_tracking(path / "tracking.png", walks),
        "path": plots.save_path(path / "path.png", walks),
        "losses": plots.save_losses(path / "losses.png", config.loss, histories),
        "weights": plots.save_weight_bars(path / "weights.png", names, vectors),
        "wrenches": plots.save_wrenches(path / "wrenches.png", tick, ground),
        "training": plots.save_training(path / "training.png", training),
    }
    return [Picture(f"pictures/{name}.png", caption) for name, caption in captions.items()]


def of_nets(
    folder: Path,
    tick: float,
    ground: Mapping[str, Wrench],
    drifts: Mapping[str, Mapping[str, Drift]],
    trainings: Mapping[str, History],
) -> list[Picture]:
    """Draw the predictions and the training of nets.

    Args:
        folder: output folder.
        tick: interval between plans [s].
        ground: result of `fidelity.curves` for the first held-out walk.
        drifts: results of `fidelity.drift` by world and phi.
        trainings: errors by epoch, by the name of the picture.

    Returns:
        The pictures, in the order of the report.
    """
    wrenches = plots.save_wrenches(folder / "wrenches.png", tick, ground)
    worlds = {WORLDS.get(world, world): drift for world, drift in drifts.items()}
    captions = {
        "wrenches": f"{wrenches} The first held-out walk, in the robot's yaw frame.",
        "open_loop": plots.save_open_loop(folder / "open_loop.png", worlds),
        **{name: plots.save_training(folder / f"{name}.png", x) for name, x in trainings.items()},
    }
    return [Picture(f"{name}.png", caption) for name, caption in captions.items()]


def of_view(
    folder: Path, robot: Robot, histories: Histories, loss: Loss, views: Mapping[str, ViewedWalk]
) -> None:
    """Draw the content of the page of `view` as a film and pictures.

    Args:
        folder: output folder.
        robot: the body that walked.
        histories: tuning histories of the run.
        loss: loss of the tunings.
        views: walks by the name of their set, before and after.

    Raises:
        VideoUnavailable: this machine cannot make a film.
    """
    walks = {name: viewed.walk for name, viewed in views.items()}
    plots.save_tracking(folder / "tracking.png", walks)
    plots.save_path(folder / "path.png", walks)
    after, ground = list(views.values())[-1]
    period = float(after.period)
    first = min(0.4, period * len(after.fallen))  # [s], two steps
    plots.save_wrenches(folder / "wrenches.png", period, ground, seconds=first)
    if tunings := {name: histories[name] for name in ("without", "with") if histories.get(name)}:
        plots.save_losses(folder / "losses.png", loss, tunings)
    say("making the film")
    pair = motions(robot, plots.style.titled(walks))
    write_film(folder / "film.mp4", robot, pair, strip=folder / "film.png")


def film(
    path: Path, robot: Robot, walks: Mapping[str, Trajectory], strip: Path | None = None
) -> str:
    """Film two walks, and draw a strip of snapshots if `strip` is its path.

    Returns the reason if no film can be made, which does not stop the run, else "".
    """
    say("making the film")
    pair = motions(robot, walks)
    try:
        write_film(path, robot, pair, strip=strip)
    except VideoUnavailable as error:
        say(str(error))
        return str(error)
    say(f"the film is in {path}")
    return ""
