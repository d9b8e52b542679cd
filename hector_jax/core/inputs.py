"""Input errors, the wording of their messages, packages of others, and files read as text."""

import difflib
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from types import ModuleType
from typing import Any


class InputError(ValueError):
    """Invalid input; the one-line message says what was received and what was expected.

    The programs end with exit code 2 and that line. Every other exception is a bug and keeps its
    traceback.
    """


def require_package(package: str, extra: str, what: str, hint: str = "") -> None:
    """Raise an InputError unless the package of an extra, which `what` needs, is installed."""
    if find_spec(package) is None:
        raise InputError(
            f"{what} needs {package}: pip install -e '.[{extra}]' in the checkout{hint}"
        )


@contextmanager
def outside_packages() -> Iterator[None]:
    """Raise an InputError where a package of others cannot be loaded, as one of another Python.

    A fault of our own modules keeps its exception.
    """
    try:
        yield
    except Exception as error:
        if line := _broken_package(error):
            raise InputError(line) from None
        raise


def _broken_package(error: Exception) -> str:
    """Return the line about the package that cannot be loaded; "" if the error is another one."""
    while isinstance(error, ImportError) and isinstance(error.__cause__, ImportError):
        error = error.__cause__  # the first one says most
    frames = [frame for frame, _ in walk_tb(error.__traceback__)]
    modules = [_package(frame.f_globals.get("__name__", "")) for frame in frames]
    named, last = "", modules[-1] if modules else ""
    is_ours = last == _package(__name__) or not _file_of(last, sys.path[1:])
    if isinstance(error, ImportError):
        named = _package(error.name or "")
    elif isinstance(error, AttributeError) and isinstance(error.obj, ModuleType):
        named = _package(error.obj.__name__)
    elif isinstance(error, SyntaxError):  # of another Python
        parts = reversed(Path(str(error.filename)).with_suffix("").parts)
        named = next((x for x in parts if x.isidentifier() and _file_of(x)), "")
        error, is_ours = ImportError(str(error), name=named), named == _package(__name__)
    suspects = [named]
    if not is_ours and any(frame.f_code.co_name == "<module>" for frame in frames):
        suspects += [last, *sorted(map(_package, sys.modules))]  # one may break another
    # of this Python's packages: neither of PYTHONPATH nor of the script
    folders = [x for x in sys.path[1:] if os.path.abspath(x) not in _python_path()]
    for package in suspects:
        own, file = _file_of(package, folders), _file_of(package)
        if own and file != own and package != _package(__name__):
            folder = str(Path(file).parents[Path(file).name == "__init__.py"])
            on_path = folder in _python_path()
            remedy = f"take {folder} out of PYTHONPATH" if on_path else "rename it"
            reason = f"{one_line(error)[:150]}; it hides {own}: {remedy}"
            return f"{package} cannot be loaded from {file}: {reason}"
    if not isinstance(error, ImportError) or (is_ours and _file_of(named)):
        return ""
    if is_ours:
        return f"{named} is not installed: {one_line(error)}"
    package = named if _file_of(named) else last
    return f"{package} cannot be loaded from {_file_of(package)}: {one_line(error)}"


def _package(module: str) -> str:
    return module.partition(".")[0]


def _python_path() -> list[str]:
    return list(map(os.path.abspath, os.environ.get("PYTHONPATH", "").split(os.pathsep)))


def _file_of(package: str, folders: list[str] | None = None) -> str:
    """Return the file of a package in the first folder that has it, of sys.path by default."""
    spec = PathFinder.find_spec(package, folders) if package else None
    return (spec and spec.origin) or ""


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """Return `; did you mean 'NAME'?` with the closest of the names; "" if none is close."""
    near = difflib.get_close_matches(str(name)[:100], [n for n in names if n], n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def unknown(what: str, name: Any, names: Iterable[str]) -> str:
    """Return the message for a name that is not among the names.

    >>> unknown("set", "wiht", ["with", "without"])
    "unknown set 'wiht'; did you mean 'with'?; known: with, without"
    """
    names = list(names)
    choices = ", ".join(names) or "none"
    return f"unknown {what} {short_repr(name)}{did_you_mean(name, names)}; known: {choices}"


def expect(path: Path, condition: Any, message: str) -> None:
    """Raise InputError `path: message` unless the condition holds."""
    if not condition:
        raise InputError(f"{path}: {message}")


def require(path: Path, kind: str, name: str, names: Sequence[str], remedy: str = "") -> None:
    """Raise InputError with the nearest name unless the name is one of the names."""
    if name not in names:  # the nearest name takes longer to find than all other checks
        text = f"no {kind} {name!r}{did_you_mean(name, names)}; {kind}s: {listed(names)}"
        raise InputError(f"{path}: {text}{remedy}")


def listed(names: Sequence[str]) -> str:
    """Return the names that are not empty, joined by commas, or "none"."""
    return ", ".join(filter(None, names)) or "none"


def short_repr(value: Any) -> str:
    """Return the `repr` of a value on one line of at most 60 characters."""
    return _shortened(_repr_line(value))


def short_reprs(one: Any, other: Any) -> tuple[str, str]:
    """Return the `short_repr` of two values, from shortly before their first difference on.

    >>> short_reprs([0.25] * 20 + [1], [0.25] * 20 + [2])
    ('...0.25, 1]', '...0.25, 2]')
    """
    texts = _repr_line(one), _repr_line(other)
    same = len(os.path.commonprefix(texts))
    if same <= 40:
        return _shortened(texts[0]), _shortened(texts[1])
    begin = max(texts[0].rfind(" ", 0, same - 4), same - 30) + 1
    return _shortened("..." + texts[0][begin:]), _shortened("..." + texts[1][begin:])


def _repr_line(value: Any) -> str:
    try:
        return " ".join(repr(value).split())
    except ValueError:  # Python prints no integer of many thousand digits
        return "a number of too many digits"


def _shortened(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


def one_line(error: BaseException | str) -> str:
    """Return the text of an error on one line of at most 300 characters."""
    return printable(" ".join(str(error).split()))[:300]


def printable(text: str) -> str:
    """Return a text on one line; control characters, as in a file's name, become `?`."""
    return "".join(x if x.isprintable() else " " if x.isspace() else "?" for x in text)


def check_utf8(what: str, name: str) -> None:
    """Raise an InputError unless the name of a file or folder, as Python reads it, is UTF-8."""
    if name != name.encode(errors="replace").decode():
        raise InputError(f"{what} must be in UTF-8, got {name!r}")


def plural(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or plural.

    >>> plural(1, "plant"), plural(32, "stand-in plant"), plural(3, "trajectory")
    ('1 plant', '32 stand-in plants', '3 trajectories')
    """
    many = f"{noun[:-1]}ies" if noun.endswith("ry") else f"{noun}s"
    return f"{number} {noun if number == 1 else many}"


def check_file(path: Path, what: str) -> int:
    """Return the size of a regular file in bytes.

    Args:
        path: the file.
        what: its expected content, for the message.

    Raises:
        InputError: one line naming the file that is missing or not a regular file.
    """
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:  # ValueError: for example a null byte in the name
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot read {what}: {reason}") from None
    if not path.is_file():  # a pipe or a device might never end
        raise InputError(f"{path}: cannot read {what}: not a plain file")
    return size


def read_text(path: Path, what: str, max_bytes: int) -> str:
    """Read a text file in UTF-8, with or without a byte order mark.

    Args:
        path: the file.
        what: its expected content, for the message.
        max_bytes: largest size allowed.

    Raises:
        InputError: one line naming the file that is missing, too large or not text.
    """
    if (size := check_file(path, what)) > max_bytes:
        raise InputError(f"{path}: {size / 1e6:.1f} MB, expected at most {max_bytes / 1e6:g} MB")
    try:
        return path.read_text(encoding="utf-8-sig")  # Windows writes a byte order mark
    except OSError as error:
        raise InputError(f"{path}: cannot read {what}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file, expected {what} in UTF-8") from None
