"""What a person hands in: one line says what came, what was expected and the nearest known name.

Settings are frozen dataclasses that call `check` when they are made; tables of a TOML file become
such dataclasses by `from_table`. A rule narrows what the type of a field allows: an `Interval` of
numbers, or the words to choose from.
"""

import dataclasses
import difflib
import json
import math
import tomllib
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")


class InputError(ValueError):
    """What a person handed in is wrong; the one line says what came and what was expected.

    The programs end with exit code 2 and that line. Every other exception is a fault of the program
    and keeps its traceback.
    """


@dataclass(frozen=True)
class Range:
    """Finite numbers from `low` to `high`, both allowed."""

    low: int | float = -math.inf
    high: int | float = math.inf
    above: bool = False  # low itself is not allowed

    def __contains__(self, number: Any) -> bool:
        over = number > self.low if self.above else number >= self.low
        return bool(over and number <= self.high and math.isfinite(number))

    def __str__(self) -> str:
        write = lambda x: str(x) if isinstance(x, int) else f"{x:g}"  # noqa: E731
        if math.isfinite(self.low) and math.isfinite(self.high) and not self.above:
            return f"from {write(self.low)} to {write(self.high)}"
        parts = [f"{'above' if self.above else 'of at least'} {write(self.low)}"]
        parts = parts * math.isfinite(self.low)
        parts += [f"{'' if parts else 'of '}at most {write(self.high)}"] * math.isfinite(self.high)
        return " and ".join(parts) or "that is finite"


POSITIVE = Range(0.0, above=True)
NOT_NEGATIVE = Range(0.0)
SHARE = Range(0.0, 1.0)
AT_LEAST_ONE = Range(1)  # a number of things, at least one
SEED = Range(0, 2**32 - 1)


Rule = Range | tuple[str, ...] | Enum
"""What is allowed beyond a type: numbers, or words; a member of an `Enum` is for the caller."""


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """`; did you mean 'NAME'?` with the nearest of some names; nothing where none is near."""
    near = difflib.get_close_matches(str(name)[:100], [n for n in names if n], n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def short_repr(value: Any) -> str:
    """A value as it came, on one line and not longer than a line."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python prints no integer of many thousand digits
        text = "a number of too many digits"
    return text if len(text) <= 60 else f"{text[:57]}..."


def one_line(error: BaseException | str) -> str:
    """What an error or a text says, on one line of at most 300 characters."""
    return printable(" ".join(str(error).split()))[:300]


def printable(text: str) -> str:
    """A text on one line; what would control a terminal, as in a file's name, becomes `?`."""
    return "".join(x if x.isprintable() else " " if x.isspace() else "?" for x in text)


def plural(number: int, noun: str) -> str:
    """A number of things.

    >>> plural(1, "plant"), plural(32, "stand-in plant")
    ('1 plant', '32 stand-in plants')
    """
    return f"{number} {noun}" + ("" if number == 1 else "s")


def _words(choices: Iterable[str]) -> str:
    *others, last = map(repr, choices)
    return f"{', '.join(others)} or {last}" if others else last


def validation_error(value: Any, kind: Any, rule: Rule | None = None) -> str | None:
    """What is wrong with a value, `must be ..., got ...`; None where nothing is.

    Args:
        value: what came.
        kind: the annotation: bool, int, float, str, a class, a tuple or a union of these, with the
            rule where it is `Annotated`, or words as a `Literal`; any other allows everything.
        rule: what is allowed of numbers or words; without one, numbers have to be finite.
    """
    if typing.get_origin(kind) is typing.Annotated:
        return validation_error(value, *typing.get_args(kind)[:2])
    if typing.get_origin(kind) is typing.Literal:
        return validation_error(value, str, typing.get_args(kind))
    if isinstance(kind, types.UnionType):
        kinds = typing.get_args(kind)
        found = [validation_error(value, one, rule) for one in kinds if one is not types.NoneType]
        missing = value is None and types.NoneType in kinds
        return None if missing or None in found else found[0]
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, tuple):
            return f"must be a tuple, got {short_repr(value)}"
        of = typing.get_args(kind)[0]
        found = [told for one in value if (told := validation_error(one, of, rule))]
        return f"{found[0]} in {short_repr(value)}" if found else None
    return _simple_problem(value, kind, rule)


def _simple_problem(value: Any, kind: Any, rule: Rule | None) -> str | None:
    if kind is bool:
        return (
            None if isinstance(value, bool) else f"must be true or false, got {short_repr(value)}"
        )
    if kind in (int, float):
        number, name = (Integral, "a whole number") if kind is int else (Real, "a number")
        allowed = rule if isinstance(rule, Range) else Range()
        try:
            fine = isinstance(value, number) and not isinstance(value, bool) and value in allowed
        except OverflowError:  # an integer that no float holds
            fine = False
        return None if fine else f"must be {name} {allowed}, got {short_repr(value)}"
    if kind is str and isinstance(rule, tuple):
        hint = did_you_mean(value, rule) if isinstance(value, str) else ""
        return None if value in rule else f"must be {_words(rule)}, got {short_repr(value)}{hint}"
    if isinstance(kind, type) and not isinstance(value, kind):
        return (
            f"must be {'words' if kind is str else f'a {kind.__name__}'}, got {short_repr(value)}"
        )
    return None


def check(settings: Any, /, **rules: Rule) -> None:
    """Check the fields of a dataclass against their types and rules; for `__post_init__`.

    Raises:
        InputError: `CLASS.FIELD must be ..., got ...`.
    """
    for field in dataclasses.fields(settings):
        told = validation_error(getattr(settings, field.name), field.type, rules.get(field.name))
        if told:
            raise InputError(f"{type(settings).__name__}.{field.name} {told}")


def choose(name: str, word: str, choices: Iterable[str]) -> str:
    """The word, one of those there are.

    Raises:
        InputError: `NAME must be ..., got ...`.
    """
    if told := validation_error(word, str, tuple(choices)):
        raise InputError(f"{name} {told}")
    return word


def check_file(path: Path, what: str) -> int:
    """Size of a plain file in bytes.

    Args:
        path: the file.
        what: it should be, in words.

    Raises:
        InputError: one line naming the file that is missing or is not a plain one.
    """
    try:
        size = path.stat().st_size
    except (OSError, ValueError) as error:  # such as a null byte in the name
        told = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot read {what}: {told}") from None
    if not path.is_file():  # a pipe or a device might never end
        raise InputError(f"{path}: cannot read {what}: not a plain file")
    return size


def read_text(path: Path, what: str, most: int) -> str:
    """Text of a file in UTF-8, with or without a byte order mark.

    Args:
        path: the file.
        what: it should be, in words.
        most: bytes it may have.

    Raises:
        InputError: one line naming the file: missing, too large, no text.
    """
    if (size := check_file(path, what)) > most:
        raise InputError(f"{path}: {size / 1e6:.1f} MB, expected at most {most / 1e6:g} MB")
    try:
        return path.read_text(encoding="utf-8-sig")  # Windows writes a mark before the text
    except OSError as error:
        raise InputError(f"{path}: cannot read {what}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file, expected {what} in UTF-8") from None


def read_json(path: Path, what: str, most: int = 10_000_000, **options: Any) -> Any:
    """What a JSON file holds; see `read_text`, with `options` of `json.loads`.

    Raises:
        InputError: one line naming the file: as `read_text`, or not valid JSON.
    """
    return _decoded(path, "JSON", lambda: json.loads(read_text(path, what, most), **options))


def read_toml(path: Path, what: str, most: int) -> dict[str, Any]:
    """What a TOML file holds; see `read_text`.

    Raises:
        InputError: one line naming the file: as `read_text`, or not valid TOML.
    """
    return _decoded(path, "TOML", lambda: tomllib.loads(read_text(path, what, most)))


def _decoded(path: Path, language: str, decode: Callable[[], Any]) -> Any:
    try:
        return decode()
    except InputError:
        raise
    except RecursionError:
        told = "nested too deeply"
    except ValueError as error:
        told = one_line(error)
        if "set_int_max_str_digits" in told:  # Python's advice to a programmer
            told = "a number has too many digits"
    raise InputError(f"{path}: not valid {language}: {told}")


def from_table(where: str, kind: type[T], table: Any) -> T:
    """A dataclass from a table of a file; dataclasses inside it from tables inside that.

    Args:
        where: the file and the place in it, for the message.
        kind: the dataclass, which checks itself; fields without a default have to be there. Its
            `RULES`, where it has any, are told with values of a wrong type.
        table: what was read.

    Raises:
        InputError: one line naming `where` and the field that is unknown, missing or wrong.
    """
    fields = {field.name: field for field in dataclasses.fields(kind)}
    if not isinstance(table, Mapping):
        raise InputError(f"{where} must be a table of {', '.join(fields)}, got {short_repr(table)}")
    for name in table:
        if name not in fields:
            raise InputError(
                f"{where}: unknown field {short_repr(name)}{did_you_mean(name, fields)}; "
                f"known: {', '.join(fields)}"
            )
    for name, field in fields.items():
        if name not in table and field.default is field.default_factory is dataclasses.MISSING:
            raise InputError(f"{where}: missing field {name!r}; known: {', '.join(fields)}")
    values = {name: _value(f"{where}: {name}", fields[name].type, x) for name, x in table.items()}
    rules = getattr(kind, "RULES", {})
    for name, value in values.items():
        if told := validation_error(value, fields[name].type, rules.get(name)):
            raise InputError(f"{where}: {name} {told}")
    try:
        return kind(**values)
    except InputError as error:
        told = str(error).removeprefix(f"{kind.__name__}.")
        raise InputError(f"{where}: {told}") from None


def _value(where: str, kind: Any, value: Any) -> Any:
    """A value of a file as its type: 1 where 1.0 is meant, a tuple of a list, a dataclass."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return from_table(where, kind, value)
    if typing.get_origin(kind) is tuple and isinstance(value, list | tuple):
        return tuple(_value(where, typing.get_args(kind)[0], one) for one in value)
    return float(value) if kind is float and type(value) is int and abs(value) < 2**53 else value
