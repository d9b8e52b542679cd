"""Trees of arrays in files, and their hash.

Nothing is pickled. A file is a plain `.npz` (`numpy.load` opens it) whose entry `card` is JSON:
format, kind, robot, shape and dtype of each array, versions, and `about` with entries of the
writer. The archive's comment is the sha256 of all bytes before it, so a truncated or modified file
is rejected, and one of another format, kind or layout. The robot is identified by the hash of
its numbers: a file made for one robot is not loaded for another.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from hector_jax.core.environment import versions
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError, one_line, short_repr

FORMAT = 1
ROBOT_DIGITS = 9  # of a robot's numbers; rounding on another machine gives the same hash
_SHA256 = 64  # hexadecimal digits

Tree = TypeVar("Tree")


def tree_hash(tree: Any, digits: int | None = None) -> str:
    """Return a hash (16 hexadecimal digits) of a tree's arrays, exact or of `digits` digits."""
    content = hashlib.sha256()
    for name, leaf in named_leaves(tree).items():
        array = np.asarray(leaf)
        content.update(f"{name}{array.shape}".encode())
        if digits is None:
            content.update(f"{array.dtype}".encode() + array.tobytes())
        else:
            numbers = array.ravel().astype(float) + 0.0  # no negative zero
            content.update(" ".join(f"{x:.{digits}g}" for x in numbers).encode())
    return content.hexdigest()[:16]


def save_tree(
    path: Path, tree: Any, *, kind: str, robot: Any = None, about: Mapping[str, Any] | None = None
) -> None:
    """Write a tree of arrays.

    Args:
        path: file, replaced if it exists.
        tree: NamedTuples and dictionaries of arrays.
        kind: its kind in one word; `load_tree` expects the same.
        robot: the `Robot` that the numbers belong to, or None.
        about: JSON values for the card: units, frames, seeds, settings.

    Raises:
        WriteError: if the file cannot be written.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in named_leaves(tree).items()}
    card = {
        "format": FORMAT,
        "kind": kind,
        "robot": None if robot is None else tree_hash(robot, ROBOT_DIGITS),
        "arrays": {n: {"shape": list(a.shape), "dtype": str(a.dtype)} for n, a in arrays.items()},
        "versions": versions(),
        "about": dict(about or {}),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in {"card": np.array(json.dumps(card)), **arrays}.items():
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
        archive.comment = b"0" * _SHA256  # placeholder; a zip file ends with its comment
    content = buffer.getvalue()[:-_SHA256]
    write_file(path, content + hashlib.sha256(content).hexdigest().encode())


def load_tree(
    path: Path, like: Tree, *, kind: str, robot: Any = None
) -> tuple[Tree, dict[str, Any]]:
    """Read a file that `save_tree` wrote.

    Args:
        path: the file.
        like: a tree of the expected structure. Shapes must match its leaves, in which an axis of
            length 0 matches any length; dtypes are those of the file. A leaf "" is for a text.
        kind: the kind passed to `save_tree`.
        robot: the `Robot` in use, or None to accept any.

    Returns:
        The tree, with numpy arrays and texts, and its card.

    Raises:
        InputError: one line naming the file that is missing, truncated, modified, or of another
            kind, format, layout or robot.
    """
    arrays, card = _read(path, kind)
    if robot is not None and card["robot"] != tree_hash(robot, ROBOT_DIGITS):
        raise InputError(f"{path}: made for another robot than the one in use; make it anew")
    leaves = named_leaves(like)
    if arrays.keys() != leaves.keys():
        differences = one_line(", ".join(sorted(arrays.keys() ^ leaves.keys())))
        raise InputError(f"{path}: another layout of {kind}; fields that differ: {differences}")
    for name, leaf in leaves.items():
        shape, got = np.shape(leaf), arrays[name].shape
        if len(shape) != len(got) or any(s not in (0, g) for s, g in zip(shape, got, strict=True)):
            text = ", ".join("any" if s == 0 else str(s) for s in shape)
            raise InputError(f"{path}: {name} has shape {got}, expected ({text})")
    values = [str(arrays[n]) if isinstance(x, str) else arrays[n] for n, x in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(like), values), card


def read_card(path: Path, kind: str | None = None) -> dict[str, Any]:
    """Read the card of a file that `save_tree` wrote, after checking the whole file and its kind.

    Raises:
        InputError: one line naming the file, see `load_tree`.
    """
    return _read(path, kind)[1]


def _read(path: Path, kind: str | None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    content, digest = data[:-_SHA256], data[-_SHA256:]
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise InputError(f"{path}: cut or changed since it was written, or not a hector_jax file")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        card = json.loads(str(arrays.pop("card")))
    except Exception as error:  # an archive of others can raise anything
        raise InputError(f"{path}: no card or no plain arrays inside: {one_line(error)}") from error
    if card.get("format") != FORMAT:
        raise InputError(
            f"{path}: file format {short_repr(card.get('format'))}, this version reads {FORMAT}"
        )
    if kind is not None and card["kind"] != kind:
        raise InputError(f"{path}: holds {short_repr(card['kind'])[1:-1]}, expected {kind}")
    return arrays, card


def named_leaves(tree: Any) -> dict[str, Any]:
    """Return the leaves of a tree by their names in a file, such as `state.euler`."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
