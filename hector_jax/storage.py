"""Trees of arrays to files and back, and weights to JSON.

Nothing is pickled, nothing is half-written, nothing is believed unseen. A file is a plain `.npz`
(`numpy.load` opens it) whose entry `card` is JSON: format, kind, robot, what each array is,
versions, and `about`, which belongs to whoever wrote it. The archive's comment is the sha256 of all
bytes before it, so a file that was cut or changed anywhere is refused as a whole. The robot is
known by the hash of its numbers: what was learned on one body is not loaded for another. Files
appear by rename, so a reader finds the old one or the new one and never a part.
"""

import ast
import difflib
import hashlib
import io
import json
import os
import platform
import secrets
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from filelock import FileLock, Timeout

from hector_jax.control.weights import Weights
from hector_jax.core.console import Broken, say
from hector_jax.core.inputs import (
    InputError,
    Range,
    one_line,
    read_json,
    short_repr,
    validation_error,
)
from hector_jax.core.trajectory import State, Wrench
from hector_jax.robot.model import Robot

FORMAT = 1
WEIGHTS = Range(1e-12, 1e12)  # of weights in a file; far beyond, no QP is solved
_MOST_WEIGHTS = 1_000_000  # bytes
_PART = ".hector_jax-part"  # ends the name of a file that is being written, and of no other
_DIGEST = 64  # hexadecimal digits of a sha256
_NUMERIC = ("jax", "jaxlib", "mujoco", "numpy")  # packages that decide the numbers of a result
_NO_NUMBERS = ("core.console", "core.inputs", "core.runtime", "storage")  # modules that decide none
_PACKAGES = (
    "hector-jax",
    "jax",
    "jaxlib",
    "flax",
    "numpy",
    "mujoco",
    "mujoco-mjx",
    "cmaes",
    "scikit-learn",
)

Tree = TypeVar("Tree")


class WriteError(Broken):
    """A file cannot be written, such as on a full disk; the one line names it."""


def _cannot_write(path: Path, error: OSError) -> WriteError:
    # files appear whole, and a run goes on from them
    return WriteError(f"cannot write {path}: {error.strerror}; what was written before it is kept")


def versions() -> dict[str, str]:
    """Versions of Python and of those packages that shape our numbers and are installed."""
    return dict(_versions())


@cache  # a checkpoint asks for them at every save
def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def fingerprint(tree: Any) -> str:
    """Sixteen digits that stand for the numbers of a tree, such as a `Robot`."""
    digest = hashlib.sha256()
    for name, leaf in _named_leaves(tree).items():
        # rounded to 9 digits, so that two machines' last bits make the same robot
        digest.update(f"{name}{np.shape(leaf)}".encode())
        digest.update(" ".join(f"{x:.9g}" for x in np.ravel(leaf).astype(float) + 0.0).encode())
    return digest.hexdigest()[:16]


def identity(robot: Robot) -> str:
    """Sixteen digits for a robot: its numbers, what its TOML says and its MJCF."""
    body = robot.description
    said = replace(body, path=Path(), model=Path(body.model.name))
    told = f"{fingerprint(robot)} {said!r} ".encode() + body.model.read_bytes()
    return hashlib.sha256(told).hexdigest()[:16]


def digest(*parts: Any, code: Sequence[str]) -> str:
    """Content hash (12 hexadecimal digits) of all that a result follows from, exact in every bit.

    Args:
        parts: settings (by their repr), robots and trees of numbers.
        code: modules that compute the result, see `code_hash`.
    """

    def text(part: Any) -> str:
        if isinstance(part, Robot):
            return identity(part)
        return _bits(part) if isinstance(part, tuple) or part is None else repr(part)

    key = "\n".join([*map(text, parts), code_hash(*code)])
    return hashlib.sha256(key.encode()).hexdigest()[:12]


def environment() -> dict[str, str]:
    """What the numbers were made with: versions, platform, device and, if known, the commit."""
    found = versions() | {
        "platform": f"{platform.system()} {platform.machine()}",
        "cores": str(os.cpu_count()),
        "device": jax.default_backend(),
        "precision": str(jnp.asarray(0.0).dtype),
    }
    commit = _commit(Path(__file__).parents[1])
    return found | ({"commit": commit} if commit else {})


def _commit(folder: Path) -> str:
    """Commit of the checkout in `folder`, marked where files differ from it; empty elsewhere."""
    if not (folder / ".git").exists():  # an installed package may lie inside some other checkout
        return ""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=folder, capture_output=True, text=True, timeout=10, check=True
        )
        return done.stdout.strip()

    try:
        changed = " with changes" if git("status", "--porcelain", "--untracked-files=no") else ""
        return git("describe", "--tags", "--always", "--abbrev=40", "--long") + changed
    except (OSError, subprocess.SubprocessError):
        return ""


@cache
def code_hash(*modules: str) -> str:
    """Hash (12 hexadecimal digits) of the code and the packages that decide a result's numbers.

    Hashed are the syntax trees of the modules and of all of this package that they import, without
    docstrings, and the versions of JAX, MuJoCo and NumPy. Comments, layout and what only reads,
    writes and prints void nothing.

    Args:
        modules: names such as `sim.walk`, relative to this package.
    """
    trees: dict[str, str] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name in trees or name in _NO_NUMBERS:
            continue
        tree = ast.parse(_source(name).read_bytes())
        waiting += _imported(tree)
        for node in ast.walk(tree):
            body = getattr(node, "body", None)
            if isinstance(body, list) and body and _is_text(body[0]):
                body.pop(0)
        trees[name] = ast.dump(tree)
    numeric = {name: version(name) for name in _NUMERIC}
    return hashlib.sha256(repr((sorted(trees.items()), numeric)).encode()).hexdigest()[:12]


def _source(module: str) -> Path:
    path = Path(__file__).parent.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _imported(tree: ast.Module) -> list[str]:
    """Modules of this package that a module imports, relative to it."""
    package, found = f"{__package__}.", []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith(package):
            module = f"{node.module}."[len(package) :]
            names = [f"{module}{alias.name}" for alias in node.names]
            found += [name for name in names if _source(name).exists()] + [module[:-1]] * bool(
                module
            )
    return found


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def _bits(tree: Any) -> str:
    found = hashlib.sha256()
    for name, leaf in _named_leaves(tree).items():
        array = np.asarray(leaf)
        found.update(f"{name}{array.dtype}{array.shape}".encode() + array.tobytes())
    return found.hexdigest()


def write_file(path: Path, data: bytes) -> None:
    """Put `data` under `path`, whole or not at all; missing folders are made.

    Args:
        path: the file, replaced if it is there.
        data: all of it.

    Raises:
        WriteError: one line with the path, where the folder or the disk refuses.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{_PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        _sync(path.parent)
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _cannot_write(path, error) from error
        raise


def append_file(path: Path, data: bytes) -> None:
    """Add `data` to a file; a stop in the midst may leave part of it.

    Raises:
        WriteError: one line with the path, where the folder or the disk refuses.
    """
    try:
        with Path(path).open("ab") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise _cannot_write(path, error) from error


def _sync(folder: Path) -> None:
    """Bring the names of a folder's files to the disk; without it a rename may outlive its data."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(folder: Path) -> None:
    """Make a folder, and find out that it can be written before anything is computed for it.

    Raises:
        InputError: one line with the folder, where it cannot be made or written.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"cannot write to {folder}: {error.strerror}") from error


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Be the only process that writes to `folder`, which is made, as long as the block lasts.

    Waits, with a line on stderr, for another process that has the lock. A process that is killed
    lets go of it; what `write_file` left half-written there is removed here.

    Raises:
        InputError: one line with the folder, where it cannot be made or written.
    """
    make_folder(folder)
    lock = FileLock(Path(folder) / ".lock")
    try:
        lock.acquire(blocking=False)
    except Timeout:
        say(f"{folder}: another process is writing there; waiting for it to end")
        lock.acquire()
    try:
        for part in Path(folder).glob(f".*{_PART}"):
            part.unlink(missing_ok=True)
        yield
    finally:
        lock.release()


def save_tree(
    path: Path, tree: Any, *, kind: str, robot: Any = None, about: Mapping[str, Any] | None = None
) -> None:
    """Write a tree of arrays.

    Args:
        path: file, replaced if it is there.
        tree: NamedTuples and dictionaries of arrays.
        kind: what it is, in a word; `load_tree` asks for the same.
        robot: the `Robot` that the numbers belong to, or None.
        about: JSON values for the card: units, frames, seeds, settings.

    Raises:
        WriteError: where the file cannot be written.
    """
    arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(tree).items()}
    card = {
        "format": FORMAT,
        "kind": kind,
        "robot": None if robot is None else fingerprint(robot),
        "arrays": {n: {"shape": list(a.shape), "dtype": str(a.dtype)} for n, a in arrays.items()},
        "versions": versions(),
        "about": dict(about or {}),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in {"card": np.array(json.dumps(card)), **arrays}.items():
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
        archive.comment = b"0" * _DIGEST  # makes room; a zip file ends with its comment
    content = buffer.getvalue()[:-_DIGEST]
    write_file(path, content + hashlib.sha256(content).hexdigest().encode())


def load_tree(
    path: Path, like: Tree, *, kind: str, robot: Any = None
) -> tuple[Tree, dict[str, Any]]:
    """Read what `save_tree` wrote.

    Args:
        path: the file.
        like: a tree of the expected structure. Shapes must agree with its leaves, where an axis of
            length 0 stands for any length; dtypes are those of the file.
        kind: as given to `save_tree`.
        robot: the `Robot` in use, or None to take any.

    Returns:
        The tree, with numpy arrays, and its card.

    Raises:
        InputError: one line naming the file, for one that is missing, cut, changed, of another
            kind, format, layout or robot.
    """
    arrays, card = _read(path)
    if card["kind"] != kind:
        raise InputError(f"{path}: holds {short_repr(card['kind'])[1:-1]}, expected {kind}")
    if robot is not None and card["robot"] != (expected := fingerprint(robot)):
        raise InputError(
            f"{path}: made for robot {card['robot']}, the robot in use is {expected}; make it anew"
        )
    wanted = _named_leaves(like)
    if arrays.keys() != wanted.keys():
        odd = sorted(arrays.keys() ^ wanted.keys())
        told = one_line(", ".join(odd))
        raise InputError(f"{path}: another layout of {kind}; fields that differ: {told}")
    for name, leaf in wanted.items():
        is_text = np.asarray(leaf).dtype.kind == "U"
        if (dtype := arrays[name].dtype).kind not in ("U" if is_text else "biuf"):
            what = "text" if is_text else "numbers"
            raise InputError(f"{path}: {name} has type {dtype}, expected {what}")
        shape, got = np.shape(leaf), arrays[name].shape
        if len(shape) != len(got) or any(s not in (0, g) for s, g in zip(shape, got, strict=True)):
            text = ", ".join("any" if s == 0 else str(s) for s in shape)
            raise InputError(f"{path}: {name} has shape {got}, expected ({text})")
    leaves = [arrays[name] for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(like), leaves), card


def read_card(path: Path) -> dict[str, Any]:
    """The card of a file that `save_tree` wrote, once the file as a whole is found sound.

    Raises:
        InputError: one line naming the file, as `load_tree`.
    """
    return _read(path)[1]


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    data = _read_bytes(Path(path))
    content, digest = data[:-_DIGEST], data[-_DIGEST:]
    if hashlib.sha256(content).hexdigest().encode() != digest:
        raise InputError(f"{path}: cut or changed since it was written, or not a hector_jax file")
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("an entry is compressed")
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        card = json.loads(str(arrays.pop("card")))
    except Exception as error:  # whoever made the archive chose what goes wrong
        raise InputError(f"{path}: no card or no plain arrays inside: {one_line(error)}") from error
    _check_card(path, card)
    return arrays, card


def _check_card(path: Path, card: Any) -> None:
    if not isinstance(card, dict):
        raise InputError(f"{path}: card must be an object, got {short_repr(card)}")
    if card.get("format") != FORMAT:
        raise InputError(
            f"{path}: file format {short_repr(card.get('format'))}, this version reads {FORMAT}"
        )
    kinds = {"kind": str, "robot": str | None, "about": dict, "versions": dict}
    for name, kind in kinds.items():
        if name not in card:
            raise InputError(f"{path}: card.{name} is missing")
        if told := validation_error(card[name], kind):
            raise InputError(f"{path}: card.{name} {told}")


def _read_bytes(path: Path) -> bytes:
    try:
        if path.exists() and not path.is_file():  # a pipe or a device might never end
            raise InputError(f"cannot read {path}: not a plain file")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error


def _named_leaves(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def check_settings(path: Path, made: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Hold the settings that a file was made with against those that it would be made with now.

    Raises:
        InputError: one line naming the file and the first setting that differs.
    """
    for name in {**expected, **made}:
        before, now = made.get(name), expected.get(name)
        if before == now:
            continue
        what = f"with {name} {short_repr(before)}, this command expects {short_repr(now)}"
        if name == "code":
            what = f"by other code or other versions of {', '.join(_NUMERIC)}"
        raise InputError(f"{path}: made {what}; remove it, or name another folder")


def as_json(value: Any, indent: int | None = None) -> str:
    """JSON of nested values; numbers that are not finite, which JSON does not have, are null.

    >>> as_json({"L": [1.0, float("nan")]})
    '{"L": [1.0, null]}'
    """
    return json.dumps(_known(value), indent=indent, allow_nan=False)


def write_json(path: Path, value: Any) -> None:
    """Write nested values as JSON, `as_json` with line breaks.

    Raises:
        WriteError: where the file cannot be written.
    """
    write_file(path, (as_json(value, indent=2) + "\n").encode())


def _known(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _known(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_known(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def weights_tree(weights: Weights) -> dict[str, Any]:
    """Weights as JSON values, `{"Q": {"euler": [..], ...}, "R": {"force": [[..], [..]], ...}}`."""
    return {
        part: {name: np.asarray(value).tolist() for name, value in tree._asdict().items()}
        for part, tree in weights._asdict().items()
    }


def save_weights(path: Path, weights: Weights, schema: str | None = None) -> None:
    """Write weights as JSON, as `weights_tree`; with the place of a schema it names that first.

    Raises:
        WriteError: where the file cannot be written.
    """
    tree = {} if schema is None else {"$schema": schema}
    write_file(path, (json.dumps(tree | weights_tree(weights), indent=2) + "\n").encode())


def load_weights(path: Path) -> Weights:
    """Read weights that `save_weights` or a person wrote; in `WEIGHTS`, not held to the box.

    Raises:
        InputError: one line naming the file and the entry that is missing, unknown, of the wrong
            shape, or not a number of that range.
    """
    path = Path(path)
    tree = read_json(path, "weights", _MOST_WEIGHTS, object_pairs_hook=_no_twins)
    if isinstance(tree, dict):
        tree.pop("$schema", None)  # for editors; what is in a file is checked here
    shapes: dict[str, dict[str, tuple[int, ...]]] = {
        "Q": dict.fromkeys(State._fields, (3,)),
        "R": dict.fromkeys(Wrench._fields, (2, 3)),
    }
    _check_keys(path, tree, shapes.keys(), "")
    values = {}
    for part, entries in shapes.items():
        _check_keys(path, tree[part], entries.keys(), f"{part}.")
        values[part] = {
            name: _positive(path, f"{part}.{name}", tree[part][name], shape)
            for name, shape in entries.items()
        }
    return Weights(Q=State(**values["Q"]), R=Wrench(**values["R"]))


def _no_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        names = [name for name, _ in pairs]
        twin = next(name for name in names if names.count(name) > 1)
        raise ValueError(f'"{twin}" is given twice')
    return tree


def _check_keys(path: Path, tree: Any, names: Any, prefix: str) -> None:
    expected = f"expected {', '.join(names)}"
    if not isinstance(tree, dict):
        where = prefix.rstrip(".") or "the file"
        raise InputError(f"{path}: {where} must be an object; {expected}")
    for key in tree:
        if key not in names:
            near = difflib.get_close_matches(key, names, n=1)
            hint = f'did you mean "{prefix}{near[0]}"?' if near else expected
            raise InputError(f"{path}: unknown weight {json.dumps(prefix + key[:40])}; {hint}")
    for name in names:
        if name not in tree:
            raise InputError(f'{path}: missing weight "{prefix}{name}"; {expected}')


def _positive(path: Path, name: str, entry: Any, shape: tuple[int, ...]) -> np.ndarray:
    wanted = " x ".join(str(s) for s in shape)
    try:
        array = np.array(entry, object)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    if array.shape != shape:
        raise InputError(f"{path}: {name} must be {wanted} numbers, got {json.dumps(entry)[:60]}")
    for index, value in np.ndenumerate(array):
        if told := validation_error(value, float, WEIGHTS):
            place = "".join(f"[{i}]" for i in index)
            raise InputError(f"{path}: {name}{place} {told}")
    return array.astype(float)
