"""Settings from JSON and TOML and back; an error is an InputError of one line.

Settings are frozen dataclasses that call `check` in `__post_init__`. msgspec converts values to the
types of the fields; this module adds ranges and messages: the field, the expected and the received
value, and the closest name. A range is declared with the field as `Annotated[float, POSITIVE]`, or
passed to `check`.
"""

import json
import math
import sys
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import msgspec
import numpy as np

from hector_jax.core.inputs import (
    InputError,
    did_you_mean,
    one_line,
    read_text,
    short_repr,
    unknown,
)

T = TypeVar("T")
_COLUMNS = 100  # of a line of TOML


@dataclass(frozen=True)
class Range:
    """Finite numbers from `low` to `high`, both included."""

    low: int | float = -math.inf
    high: int | float = math.inf
    above: bool = False  # `low` is excluded

    def __contains__(self, number: Any) -> bool:
        above_low = number > self.low if self.above else number >= self.low
        return bool(above_low and number <= self.high and abs(number) <= sys.float_info.max)

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
AT_LEAST_ONE = Range(1)
SEED = Range(0, 2**32 - 1)

Rule = Range | tuple[str, ...]
"""Allowed range of numbers, or allowed words."""


def convert(value: Any, kind: Any, rule: Rule | None = None, name: str = "") -> Any:
    """Convert a value to a type: a list to a tuple, 1 to 1.0, text to a `Path`.

    Args:
        value: from a file or a program.
        kind: the type annotation; a range in `Annotated` takes precedence over `rule`.
        rule: allowed numbers or words, of a list too; without a rule, numbers have to be finite.
        name: name of the value, for the message.

    Raises:
        InputError: `NAME must be ..., got ...`.
    """
    if get_origin(kind) is Annotated:
        kind, *notes = get_args(kind)
        rule = next((note for note in notes if isinstance(note, Range)), rule)
    if isinstance(rule, tuple):
        kind, rule = tuple[Literal[rule], ...] if get_origin(kind) is tuple else Literal[rule], None
    try:
        converted = msgspec.convert(_builtin(value), kind, dec_hook=_instance)
        allowed = rule or Range()
        numbers = converted if isinstance(converted, tuple) else (converted,)
        valid = all(x in allowed for x in numbers if type(x) in (int, float))
    except msgspec.ValidationError:
        valid, converted = False, None
    if not valid:
        words = get_args(kind) if get_origin(kind) is Literal else _known(kind)
        texts = value if isinstance(value, list | tuple) else (value,)
        other = next((x for x in texts if isinstance(x, str) and x not in words), None)
        hint = did_you_mean(other, words) if other else ""
        message = f"must be {_expected(kind, rule)}, got {short_repr(value)}{hint}"
        raise InputError(f"{name} {message}" if name else message)
    return converted


def _known(kind: Any) -> tuple[str, ...]:
    """Return the names of a kind of `core.part.Part`, or of that in a list of them."""
    kinds = [kind, *get_args(kind), *(x for inner in get_args(kind) for x in get_args(inner))]
    return tuple(str(part) for one in kinds for part in getattr(one, "known", ()))


def _builtin(value: Any) -> Any:
    """Convert a number of NumPy to Python's own type."""
    if isinstance(value, Real) and not isinstance(value, bool):
        return int(value) if isinstance(value, Integral) else float(value)
    return tuple(map(_builtin, value)) if isinstance(value, list | tuple) else value


def _instance(kind: type, value: Any) -> Any:
    if isinstance(value, str) and kind is Path:
        return Path(value)
    if isinstance(value, str) and hasattr(kind, "known"):
        return kind.named(value)
    if isinstance(kind, type) and not isinstance(value, kind):
        raise msgspec.ValidationError(f"expected {kind}")
    return value


def _expected(kind: Any, rule: Rule | None = None) -> str:
    """Describe the values that a type and a rule allow, in words."""
    inner = get_args(kind)
    if names := getattr(kind, "known", ()):
        return f"{' or '.join(repr(str(part)) for part in names)}, or a {kind.__name__}"
    if get_origin(kind) is Annotated:
        return _expected(inner[0], next((x for x in inner if isinstance(x, Range)), rule))
    if get_origin(kind) is Literal:
        *others, last = map(repr, inner)
        return f"{', '.join(others)} or {last}" if others else last
    if isinstance(kind, UnionType):
        return " or ".join(_expected(member, rule) for member in inner if member is not NoneType)
    if get_origin(kind) is tuple:
        number = "" if inner[-1] is Ellipsis else f" of {len(inner)}"
        return f"a list{number}, each {_expected(inner[0], rule)}"
    numbers = rule if isinstance(rule, Range) else Range()
    words = {bool: "true or false", int: f"a whole number {numbers}", float: f"a number {numbers}"}
    words |= {str: "text", Path: "a path", tuple: "a list"}
    return words.get(kind) or f"a {kind.__name__}"


def check(settings: Any, /, **rules: Rule) -> None:
    """Check the fields of a dataclass against their types and ranges; for `__post_init__`.

    The name of a part becomes the part.

    Raises:
        InputError: `CLASS.FIELD must be ..., got ...`.
    """
    for field in fields(settings):
        value, name = getattr(settings, field.name), f"{type(settings).__name__}.{field.name}"
        converted = convert(value, field.type, rules.get(field.name), name)
        if _known(field.type):  # parts in the place of their names
            object.__setattr__(settings, field.name, converted)
        if isinstance(value, list | dict):
            raise InputError(f"{name} must be hashable, got {short_repr(value)}")


def choose(name: str, word: str, choices: Iterable[str]) -> str:
    """Return the word if it is among the choices.

    Raises:
        InputError: `NAME must be ..., got ...`.
    """
    return convert(word, str, tuple(choices), name)


def read_json(path: Path, what: str, max_bytes: int = 10_000_000, **options: Any) -> Any:
    """Read a JSON file with `inputs.read_text`; `options` are those of `json.loads`.

    Raises:
        InputError: one line naming the file: from `inputs.read_text`, or it is not valid JSON.
    """
    return _decoded(path, "JSON", lambda: json.loads(read_text(path, what, max_bytes), **options))


def read_toml(path: Path, what: str, max_bytes: int = 10_000_000) -> dict[str, Any]:
    """Read a TOML file with `inputs.read_text`.

    Raises:
        InputError: one line naming the file: from `inputs.read_text`, or it is not valid TOML.
    """
    return _decoded(path, "TOML", lambda: tomllib.loads(read_text(path, what, max_bytes)))


def _decoded(path: Path, language: str, decode: Callable[[], Any]) -> Any:
    try:
        return decode()
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid {language}: {one_line(error)}") from None


def from_table(where: str, kind: type[T], table: Any) -> T:
    """Build a dataclass from a table of a file, and nested dataclasses from nested tables.

    A field that is a dict of dataclasses takes a table of tables.

    Args:
        where: the file and the place in it, for the message.
        kind: the dataclass, which checks itself; fields without a default are required.
        table: read from the file.

    Raises:
        InputError: one line naming `where` and the field that is unknown, missing or invalid.
    """
    by_name = {field.name: field for field in fields(kind)}  # pyright: ignore[reportArgumentType]
    if not isinstance(table, Mapping):
        raise InputError(
            f"{where} must be a table of {', '.join(by_name)}, got {short_repr(table)}"
        )
    values = {}
    for name, value in table.items():
        if name not in by_name:
            raise InputError(f"{where}: {unknown('field', name, by_name)}")
        type_ = by_name[name].type
        types = [x for x in (type_, *get_args(type_)) if isinstance(x, type)]
        inner: Any = next(filter(is_dataclass, types), None)
        if inner and get_origin(type_) is dict and isinstance(value, Mapping):
            named = value.items()
            values[name] = {n: from_table(f"{where}: {name}: {n}", inner, x) for n, x in named}
            continue
        if inner and value is not None:
            values[name] = from_table(f"{where}: {name}", inner, value)
            continue
        values[name] = convert(value, type_, name=f"{where}: {name}")
    for name, field in by_name.items():
        if name not in table and field.default is field.default_factory is MISSING:
            raise InputError(f"{where}: missing field {name!r}; known: {', '.join(by_name)}")
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(f'{kind.__name__}.')}") from None


def to_table(settings: Any) -> Any:
    """Convert settings to JSON values that `from_table` reads; a path or a part becomes text."""
    return msgspec.to_builtins(
        settings, enc_hook=lambda x: x.item() if isinstance(x, np.generic) else str(x)
    )


def as_toml(table: dict[str, Any], comments: Sequence[str]) -> str:
    """Return a table as the text of a TOML file that begins with comments."""
    lines = [f"# {line}" for line in comments]
    lines += [_line(key, value) for key, value in table.items() if not isinstance(value, dict)]
    for name, section in table.items():
        if isinstance(section, dict):
            nested = section and all(isinstance(value, dict) for value in section.values())
            parts = {f"{name}.{key}": value for key, value in section.items()} if nested else {}
            for title, part in (parts or {name: section}).items():
                lines += ["", f"[{title}]", *(_line(key, value) for key, value in part.items())]
    return "\n".join(lines) + "\n"


def _line(key: str, value: Any) -> str:
    """Return a key and its value; a long list is wrapped into several lines."""
    bare = key.replace("_", "").replace("-", "")
    name = key if bare.isalnum() and bare.isascii() else json.dumps(key)
    text = f"{name} = {_value(value)}"
    if len(text) <= _COLUMNS or not isinstance(value, list):
        return text
    rows, row = [], ""
    for item in map(_value, value):
        if row and len(row) + len(item) + 5 > _COLUMNS:
            rows.append(row)
            row = ""
        row += f"{' ' if row else ''}{item},"
    return "\n".join([f"{name} = [", *(f"  {r}" for r in (*rows, row)), "]"])


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float):
        return f"{value:.10g}" if abs(value) < 1e15 else repr(value)
    return json.dumps(value)
