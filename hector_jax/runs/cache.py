"""Artefacts on disk: what takes longer than a moment to compute is computed once.

An artefact is a tree of arrays in one file: a tuning, the score of a walk, the scores of a group of
walks. Its file's name ends in a `storage.digest` of all that it follows from: settings, robot,
command, net, weights, plant, seed, loss, and the code and packages that compute it. Other inputs
make another file, so that nothing is taken for something else and nothing is overwritten. A process
that is killed loses the artefacts that were not finished; a damaged file is named and made anew.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from hector_jax.core.console import say
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import Robot
from hector_jax.storage import load_tree, locked, save_tree

Key = TypeVar("Key")
Tree = TypeVar("Tree")


def load_artefact(path: Path, like: Tree, *, kind: str, robot: Robot) -> Tree | None:
    """Read an artefact; None where there is none, or, with a line on stderr, a damaged one."""
    if not path.exists():
        return None
    try:
        return load_tree(path, like, kind=kind, robot=robot)[0]
    except InputError as error:
        say(f"made anew: {error}")
        return None


def cached(
    paths: Mapping[Key, Path],
    make: Callable[[list[Key], Mapping[Key, Tree]], Iterable[tuple[Key, Tree]]],
    *,
    like: Callable[[Key], Tree],
    kind: str,
    robot: Robot,
    about: Mapping[str, Any] | None = None,
) -> dict[Key, Tree]:
    """Artefacts by key: those on disk are read, the others are made, and saved as they come.

    Args:
        paths: file of each artefact, all in one folder, which is locked meanwhile.
        make: given the missing keys and the artefacts that were read, yields each missing key with
            its artefact, in any order; not called where nothing is missing.
        like: a tree of the structure of a key's artefact, see `load_tree`.
        kind: of the files.
        robot: the body that the artefacts are of.
        about: JSON values for the cards.

    Raises:
        InputError: the folder cannot be written.
    """
    if not paths:
        return {}
    with locked(next(iter(paths.values())).parent):
        loaded = {
            key: load_artefact(path, like(key), kind=kind, robot=robot)
            for key, path in paths.items()
        }
        found = {key: tree for key, tree in loaded.items() if tree is not None}
        missing = [key for key in paths if key not in found]
        for key, tree in make(missing, dict(found)) if missing else ():
            save_tree(paths[key], tree, kind=kind, robot=robot, about=about)
            found[key] = tree
    return {key: found[key] for key in paths}
