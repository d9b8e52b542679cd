"""Walks for learning phi, on disk: whole walks at the plan interval, in the world frame.

A folder holds a file for each walk, with its job, and `card.json`, which is written when all walks
are complete. Windows, frames and labels are made from the walks anew each time, so another history
or another label needs no new data.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import walk_config
from hector_jax.core.console import say
from hector_jax.core.files import write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import Range, convert, read_json
from hector_jax.core.trajectory import Trajectory, no_samples
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import check_settings, load_tree, read_card, save_tree
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job

_NUMBER = Range(1, 1_000_000)  # of walks
_UNITS = {
    **dict.fromkeys(("period", "duration", "start"), "s"),
    **dict.fromkeys(("euler", "joints"), "rad"),
    **dict.fromkeys(("position", "feet"), "m"),
    **{"ang_velocity": "rad/s", "velocity": "m/s", "force": "N", "moment": "N m"},
}


class Walks(NamedTuple):
    """Walks and their jobs, stacked; trajectories are sampled at the plan interval."""

    job: Job  # arrays with a leading axis; commands of PIECES pieces
    trajectory: Trajectory


def collect(
    folder: Path,
    jobs: Sequence[Job],
    walk_jobs: Callable[[list[Job]], Iterable[Trajectory]],
    *,
    robot: Robot,
    settings: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Walk all jobs and save each walk to a file, resuming what an earlier call left.

    A sound file of the same job is kept, a missing or damaged one is written anew.

    Args:
        folder: folder of the walks; made if missing.
        jobs: walks to simulate.
        walk_jobs: called once, with the jobs whose walks are missing; returns the walks in their
            order, from any world. A lazy iterator loses least when it is interrupted.
        robot: the robot; walks of another one are refused.
        settings: JSON values of all that determines the walks; walks of others are refused.
        progress: called with the number of walks done and of all walks.

    Raises:
        InputError: a walk in the folder is of another job, robot or of other settings; or the
            folder cannot be written.
        ValueError: walks are missing, or too short.
    """
    interval = walk_config(robot).gait.tick
    # a JSON round trip, to compare equal with settings that are read from a file
    all_settings = json.loads(json.dumps({"interval": interval, **(settings or {})}))
    facts = {
        "units": _UNITS,
        "frames": "world; wrench of the ground on each foot at its foot point, left feet first",
        "settings": all_settings,
    }
    paths = _paths(folder, len(jobs))
    files = zip(paths, jobs, strict=True)
    walks = [_load_if_sound(path, stack([job]), robot, all_settings) for path, job in files]
    missing = [i for i, walk in enumerate(walks) if walk is None]
    done = len(jobs) - len(missing)
    progress(done, len(jobs))
    new_walks = walk_jobs([jobs[i] for i in missing]) if missing else ()
    for i, walk in zip(missing, new_walks, strict=True):
        walks[i] = Walks(stack([jobs[i]]), stack([at_interval(walk, interval)]))
        save_tree(paths[i], walks[i], kind="walks", robot=robot, about=facts)
        done += 1
        progress(done, len(jobs))
    falls = sum(bool(np.any(walk.trajectory.fallen)) for walk in walks if walk is not None)
    write_json(Path(folder) / "card.json", {"walks": len(jobs), "falls": falls, **facts})


def _paths(folder: Path, walks: int) -> list[Path]:
    return [Path(folder) / f"walk-{i:05d}.npz" for i in range(walks)]


def load_walks(folder: Path, robot: Robot) -> Walks:
    """Read all walks that `collect` wrote to a folder.

    Raises:
        InputError: one line naming folder or file: nothing collected, not finished, damaged, or of
            another robot.
    """
    like, paths = walks_like(robot), _read_collection(folder)[0]
    parts = [load_tree(path, like, kind="walks", robot=robot)[0] for path in paths]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def fingerprint(folder: Path) -> dict[str, Any]:
    """Return the identity of a collection: a hash of its walks, and its settings.

    Raises:
        InputError: nothing collected, not finished, or no valid card.
    """
    paths, settings = _read_collection(folder)
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return {"content": digest.hexdigest()[:16], **settings}


def _read_collection(folder: Path) -> tuple[list[Path], dict[str, Any]]:
    """Return the files of a finished collection, and its settings."""
    path = Path(folder) / "card.json"
    if not path.exists():
        raise InputError(f"{folder}: no finished collection (no card.json); collect first")
    try:
        card = read_json(path, "the card of a collection")
        walks, settings = convert(card["walks"], int, _NUMBER), {**card["settings"]}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no card of a collection; collect again") from error
    paths = _paths(folder, walks)
    if missing := next((file.name for file in paths if not file.is_file()), ""):
        raise InputError(f"{path}: no file {missing} beside it; collect again")
    return paths, settings


def _load_if_sound(path: Path, job: Job, robot: Robot, settings: dict[str, Any]) -> Walks | None:
    if not path.exists():
        return None
    try:
        card = read_card(path)
    except InputError as error:
        say(f"made anew: {error}")
        return None
    check_settings(path, card["about"].get("settings", {}), settings)
    walks, _ = load_tree(path, walks_like(robot), kind="walks", robot=robot)
    if not all(jax.tree.leaves(jax.tree.map(np.array_equal, walks.job, job))):
        raise InputError(f"{path}: collected for other walks; choose another folder or seed")
    return walks


def walks_like(robot: Robot) -> Walks:
    """Return zeros in the shapes of a robot's files; axes of length 0 are walks and ticks."""
    (job,) = draw_jobs(0, 1, robot=robot)
    samples = no_samples(len(robot.joint_lower), len(robot.foot_point), 0)
    return Walks(jax.tree.map(lambda x: np.zeros((0, *np.shape(x))), job), samples)
