"""Artefacts on disk: results that take more than a moment to compute are computed once.

An artefact is a tree of arrays in one file: a tuning, a walk. The name of its file ends in a
`content_key` of all its inputs: settings, robot, command, net, weights, plant, seed, loss, and the
code and packages that compute it. Other inputs make another file, so that no artefact is mistaken
for another or overwritten. A process that is killed loses the artefacts that were not finished; a
damaged file is named in a message and made again.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from hector_jax.control.parameters import is_ours, name_of, tunable
from hector_jax.core.console import say
from hector_jax.core.environment import code_hash
from hector_jax.core.files import locked
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import ROBOT_DIGITS, load_tree, save_tree, tree_hash
from hector_jax.robot.model import Robot

Key = TypeVar("Key")
Tree = TypeVar("Tree")


def robot_hash(robot: Robot) -> str:
    """Return a hash (16 hexadecimal digits) of a robot: its numbers, its TOML and its MJCF."""
    model = robot.description.model
    settings = replace(robot.description, path=Path(), model=Path(model.name))
    text = f"{tree_hash(robot, ROBOT_DIGITS)} {settings!r} ".encode() + model.read_bytes()
    return hashlib.sha256(text).hexdigest()[:16]


def content_key(*parts: Any, code: Sequence[str]) -> str:
    """Return a hash (12 hexadecimal digits) of all inputs of a result.

    It is exact in every bit, but for the numbers of a robot, of which it has ROBOT_DIGITS digits.
    Of the tunables that settings, weights or a job name it has what they are and their boxes.

    Args:
        parts: settings (hashed by their repr), robots and trees of numbers.
        code: modules that compute the result, see `code_hash`.
    """

    def text(part: Any) -> str:
        if isinstance(part, Robot):
            return robot_hash(part)
        return tree_hash(part) if isinstance(part, tuple | None) else repr(part)

    others = [getattr(getattr(part, "weights", part), "others", ()) for part in parts]
    boxes = sorted({tunable(x) for names in others for x in names if is_ours(name_of(x))})
    key = "\n".join([*map(text, parts), repr(boxes), code_hash(tuple(code))])
    return hashlib.sha256(key.encode()).hexdigest()[:12]


def load_stored(
    paths: Mapping[Key, Path], like: Callable[[Key], Any], *, kind: str, robot: Robot
) -> dict[Key, Any]:
    """Return the artefacts that are on disk; a damaged one is named and left out.

    Args:
        paths, like, kind, robot: see `load_or_make`.
    """
    trees = {}
    for key, path in paths.items():
        try:
            if path.exists():
                trees[key], _ = load_tree(path, like(key), kind=kind, robot=robot)
        except InputError as error:
            say(f"made anew: {error}")
    return trees


def load_or_make(
    paths: Mapping[Key, Path],
    make: Callable[[list[Key], Mapping[Key, Tree]], Iterable[tuple[Key, Tree]]],
    *,
    like: Callable[[Key], Any],
    kind: str,
    robot: Robot,
    about: Mapping[str, Any] | None = None,
) -> dict[Key, Tree]:
    """Return artefacts by key: read those on disk, make the others and save them as they come.

    Args:
        paths: file of each artefact, all in one folder, which is locked during the call.
        make: function of the missing keys and the artefacts that were read, which yields each
            missing key with its artefact, in any order; not called if nothing is missing.
        like: returns a tree with the structure of the file of a key, see `load_tree`.
        kind: kind of the files.
        robot: robot of the artefacts.
        about: JSON values for the cards.

    Raises:
        InputError: the folder cannot be written.
    """
    if not paths:
        return {}
    with locked(next(iter(paths.values())).parent):
        trees = load_stored(paths, like, kind=kind, robot=robot)
        missing = [key for key in paths if key not in trees]
        for key, tree in make(missing, dict(trees)) if missing else ():
            save_tree(paths[key], tree, kind=kind, robot=robot, about=about)
            trees[key] = tree
    return {key: trees[key] for key in paths}
