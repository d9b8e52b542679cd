"""Walks for learning phi, on disk: whole walks at the plan interval, in the world frame.

A folder holds a file for each walk, with its job, and `card.json` with the settings of all.
Windows, frames and labels are made from the walks anew each time, so another history or another
label needs no new data.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import walk_config
from hector_jax.core.console import bar
from hector_jax.core.files import locked, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.journal import check_settings
from hector_jax.core.settings import Range, convert, read_json
from hector_jax.core.trajectory import Trajectory, no_samples
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import load_tree, tree_hash
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.store.cache import load_or_make

_CARD = "card.json"
_UNITS = {
    **dict.fromkeys(("period", "duration", "start"), "s"),
    **dict.fromkeys(("euler", "joints"), "rad"),
    **dict.fromkeys(("position", "feet"), "m"),
    **{"ang_velocity": "rad/s", "velocity": "m/s", "force": "N", "moment": "N m"},
}
_FACTS = {
    "units": _UNITS,
    "frames": "world; wrench of the ground on each foot at its foot point, left feet first",
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
    title: str = "collecting walks",
) -> None:
    """Walk all jobs and save each walk to a file, continuing what an earlier call left.

    Args:
        folder: folder of the walks; made if missing.
        jobs: with commands of PIECES pieces, such as those of `grfm.jobs`.
        walk_jobs: walks the missing jobs in order, in any world. A lazy iterator loses least when
            it is interrupted.
        robot: robot of the walks.
        settings: JSON values of all that determines the walks; walks of others are refused.
        title: of the progress bar.

    Raises:
        InputError: the folder has walks of other jobs or settings, or cannot be written.
        ValueError: walks are missing, or too short.
    """
    interval = walk_config(robot).gait.tick
    all_settings = {"interval": interval, **(settings or {}), "jobs": tree_hash(tuple(jobs))}
    # a JSON round trip, to compare equal with settings that are read from a file
    card = {"walks": len(jobs), **_FACTS, "settings": json.loads(json.dumps(all_settings))}

    def make(missing: list[int], _: Mapping[int, Walks]) -> Iterator[tuple[int, Walks]]:
        walks = walk_jobs([jobs[i] for i in missing])
        with bar(title) as report_progress:
            report_progress(0, len(missing), "compiling")
            for done, (i, walk) in enumerate(zip(missing, walks, strict=True), 1):
                yield i, Walks(stack([jobs[i]]), stack([at_interval(walk, interval)]))
                report_progress(done, len(missing), "")

    with locked(folder):
        if not check_made(folder, card["settings"]):
            if any(Path(folder).glob("walk-*.npz")):
                raise InputError(f"{folder}: has walks but no {_CARD} that says of what; remove it")
            write_json(Path(folder) / _CARD, card)
        like = walks_like(robot)
        paths = dict(enumerate(_paths(folder, len(jobs))))
        load_or_make(paths, make, like=lambda _: like, kind="walks", robot=robot, about=_FACTS)


def _paths(folder: Path, walks: int) -> list[Path]:
    return [Path(folder) / f"walk-{i:05d}.npz" for i in range(walks)]


def check_made(folder: Path, settings: Mapping[str, Any]) -> bool:
    """Check that a folder's walks, if there are any, have these settings; return if it has a card.

    Raises:
        InputError: one line with the first that differs, or the card is damaged.
    """
    if not (Path(folder) / _CARD).exists():
        return False
    made = _read_card(folder)["settings"]
    check_settings(folder, {name: made.get(name) for name in settings}, settings)
    return True


def is_finished(folder: Path) -> bool:
    """Return whether a folder has all walks of a collection.

    Raises:
        InputError: the card of the collection is damaged.
    """
    if not (Path(folder) / _CARD).exists():
        return False
    return all(path.is_file() for path in _paths(folder, _read_card(folder)["walks"]))


def load_walks(folder: Path, robot: Robot) -> Walks:
    """Read all walks that `collect` wrote to a folder.

    Raises:
        InputError: one line naming folder or file: nothing collected, not finished, damaged, or of
            another robot.
    """
    like, paths = walks_like(robot), _finished_paths(folder)
    parts = [load_tree(path, like, kind="walks", robot=robot)[0] for path in paths]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def fingerprint(folder: Path) -> dict[str, Any]:
    """Return the identity of a collection: a hash of its walks, and its settings.

    Raises:
        InputError: nothing collected, not finished, or no valid card.
    """
    digest = hashlib.sha256()
    for path in _finished_paths(folder):
        digest.update(path.read_bytes())
    return {"content": digest.hexdigest()[:16], **_read_card(folder)["settings"]}


def _finished_paths(folder: Path) -> list[Path]:
    if not is_finished(folder):
        raise InputError(f"{folder}: no finished collection; collect first")
    return _paths(folder, _read_card(folder)["walks"])


def _read_card(folder: Path) -> dict[str, Any]:
    path = Path(folder) / _CARD
    try:
        card = read_json(path, "the card of a collection")
        walks = convert(card["walks"], int, Range(1, 1_000_000))
        return {"walks": walks, "settings": {**card["settings"]}}
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no card of a collection; collect again") from error


def walks_like(robot: Robot) -> Walks:
    """Return zeros in the shapes of a robot's files; axes of length 0 are walks and ticks."""
    (job,) = draw_jobs(0, 1, robot=robot)
    samples = no_samples(len(robot.joint_lower), len(robot.foot_point), 0)
    return Walks(jax.tree.map(lambda x: np.zeros((0, *np.shape(x))), job), samples)
