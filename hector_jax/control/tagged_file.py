"""Weights in a file of another program: its tagged numbers are read, and replaced in a copy.

A tag is a comment of that file, in its own syntax, with the weights of the numbers before it:

    q_roll: 25.0   # hector: Q.euler[0]
    double Q[7] = {25, 25, 30, 9, 9, 8, 0};   // hector: Q.euler, Q.position, -
    (0,0)  1e-4    ; hector: R.force[left][2] * 0.5

`*` and `/` lead from the weight to the file: the last has half of it. `R.force[all]` is three
numbers, of all feet; `-` is one that is no weight. If its line has no number, a tag is of those
below. JSON has no comments: gains.hector.toml has the keys of gains.json, with a tag in place of
each number.
"""

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from decimal import Decimal, localcontext
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hector_jax.core.inputs import InputError, check_file, one_line, plural, short_repr, unknown
from hector_jax.core.settings import Range, convert, read_toml
from hector_jax.core.trajectory import FEET

Entries = Mapping[str, tuple[tuple[int, ...], Range]]
"""Shape and range of what a tag may name, such as `Q.euler`."""
Span = tuple[int, int]  # of a number in the text

_MARK = r"//+|/\*+|<!--|--+|#+|;+|%+"  # that begins a comment
_TAG = re.compile(rf"({_MARK})[!<*]*[ \t]*hector:[ \t]*(.*?)\s*(?:\*/.*|-->.*)?$", re.MULTILINE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?"
# digits that are no number: text, closed comments, types, indices; those of `(0,0)  1e-4`
_TOKEN = re.compile(
    r"""\"[^"]*\"|'[^']*'|/\*.*?\*/|(?<![\w.])[^\W\d]\w*<[^<>;]*>|(?<=\w)\[[^]]*\]"""
    rf"|^\s*\(\s*\d+\s*,\s*\d+\s*\)|(?<![\w.])({_NUMBER})(?=[fFlL]?(?![\w.]))|([^\W\d]\w*)|({_MARK})"
)
_COMMENTED = re.compile(rf"\s*(?:/\*.*?\*/\s*)*(?!#\s*define\b)(?:{_MARK})")
_FACTORS, _SIZES = Range(1e-12, 1e12), Range(-1e99, 1e99)
_WEIGHT = re.compile(rf"(\w+\.\w+)((?:\[\w+\])*)(?:\s*([*/])\s*({_NUMBER}))?")
_JSON_NUMBER = re.compile(r'"(?:[^"\\]|\\.)*"|(-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?)')


class Place(NamedTuple):
    """A number of a file that is a weight."""

    span: Span
    where: str  # file and line
    tag: str
    name: str  # of the entry
    cells: tuple[int, ...]  # of the flattened entry; several for `name[all]`
    factor: Fraction  # of the number by the weight


def read_own(path: Path) -> str:
    """Return the text of a file; bytes that are not UTF-8 become surrogates, so that none is lost.

    Raises:
        InputError: one line naming the file that cannot be read or is larger than 10 MB.
    """
    if (size := check_file(path, "weights")) > 10_000_000:
        raise InputError(f"{path}: {size / 1e6:.1f} MB, expected at most 10 MB")
    try:
        return path.read_bytes().decode(errors="surrogateescape")
    except OSError as error:
        raise InputError(f"{path}: cannot read weights: {error.strerror}") from None


def keys_file(path: Path) -> Path | None:
    """Return the file with the tags of a JSON file, or None if there is none."""
    keys = path.with_suffix(".hector.toml")
    return keys if path.suffix == ".json" and keys.exists() else None


def is_tagged(path: Path, text: str) -> bool:
    """Return whether the text of a file is tagged."""
    return keys_file(path) is not None or _TAG.search(text) is not None


def tagged_weights(path: Path, text: str, entries: Entries) -> dict[str, dict[str, Any]]:
    """Read the tagged numbers of a file, as the values of a weights file.

    Raises:
        InputError: one line naming the file and line of a tag that names no weight, of another
            number of numbers, of one out of range, or of a weight that another has too; or
            the weight that no tag has.
    """
    found: dict[str, np.ndarray] = {}
    for place in _places(path, text, entries):
        (shape, range), number = entries[place.name], text[slice(*place.span)]
        convert(float(number) / float(place.factor), float, range, f"{place.where}: {place.tag}")
        values = found.setdefault(place.name, np.full(shape, np.nan))
        values.flat[list(place.cells)] = _weight(number, place.factor)
    tree: dict[str, dict[str, Any]] = {}
    for name, values in found.items():
        if len(missing := np.argwhere(np.isnan(values))):
            raise InputError(f"{path}: no tag has {name}{_indices(missing[0])}")
        part, _, inner = name.partition(".")
        tree.setdefault(part, {})[inner] = values.tolist()
    return tree


def with_weights(
    path: Path, text: str, tree: Mapping[str, Mapping[str, Any]], optional: Collection[str] = ()
) -> tuple[str, list[str]]:
    """Return the text of a file with other weights, and those of the `optional` that it has not.

    Only digits of tagged numbers change, of those whose weight is another: `tagged_weights` of the
    text are exactly these.

    Args:
        path, text: the file.
        tree: of `weights_file.weights_tree`.
        optional: entries that may be without a tag, such as `others.KP`.

    Raises:
        InputError: one line, as of `tagged_weights`; or a number is of weights that differ.
    """
    arrays = {f"{p}.{name}": np.asarray(x) for p, part in tree.items() for name, x in part.items()}
    parts, end, left = [], 0, {name: np.ones(x.shape, bool) for name, x in arrays.items()}
    for place in _places(path, text, {name: (x.shape, Range()) for name, x in arrays.items()}):
        cells, number = list(place.cells), text[slice(*place.span)]
        weight, *others = np.unique(arrays[place.name].flat[cells]).tolist()
        if others:
            differ = f"is one number, the weights are {', '.join(map(repr, (weight, *others)))}"
            raise InputError(f"{place.where}: {place.tag} {differ}")
        left[place.name].flat[cells] = False
        if _weight(number, place.factor) != weight:
            number = _digits(weight, place.factor)
        parts += [text[end : place.span[0]], number]
        end = place.span[1]
    lacking = [name for name, absent in left.items() if name in optional and absent.all()]
    for name, absent in left.items():
        if absent.any() and name not in lacking:
            raise InputError(f"{path}: no tag has {name}{_indices(np.argwhere(absent)[0])}")
    return "".join([*parts, text[end:]]), lacking


def _indices(index: Any) -> str:
    return "".join(f"[{i}]" for i in index)


def _weight(number: str, factor: Fraction) -> float:
    return float(Fraction(number) / factor)


def _digits(weight: float, factor: Fraction) -> str:
    """Return the number of a weight, of as many digits as `_weight` needs to return the weight."""
    exact, digits = Fraction(weight) * factor, 16
    number = repr(float(exact))
    with localcontext(prec=60):
        decimal = Decimal(exact.numerator) / Decimal(exact.denominator)
        while _weight(number, factor) != weight:
            number, digits = f"{decimal:.{digits}e}", digits + 1
    # 1e-05 is text to YAML 1.1, 1.0e-05 a number
    return number if "." in number else number.replace("e", ".0e")


def _places(path: Path, text: str, entries: Entries) -> list[Place]:
    """Return the tagged numbers in their order in the text."""
    keys, places, tagged = keys_file(path), [], {}
    for where, tag, spans in _of_keys(path, keys, text) if keys else _of_comments(path, text):
        weights = list(_weights_of(where, tag, entries))
        if len(weights) != len(spans):
            found = f"takes {plural(len(weights), 'number')}, found {len(spans)}"
            raise InputError(f"{where}: {tag} {found}")
        for span, weight in zip(spans, weights, strict=True):
            if weight is None:
                continue
            line = f"{path}:{text.count(chr(10), 0, span[0]) + 1}"
            convert(float(text[slice(*span)]), float, _SIZES, f"{line}: {weight[0]}")
            places.append(place := Place(span, line, *weight))
            for key in ((place.name, i) for i in place.cells):
                if key in tagged:
                    raise InputError(f"{line}: {place.tag} is that of {tagged[key]} too")
                tagged[key] = line
    return sorted(places)


def _weights_of(
    where: str, tag: str, entries: Entries
) -> Iterator[tuple[str, str, tuple[int, ...], Fraction] | None]:
    """Yield tag, name, cells and factor of each number of a tag; None for one that is no weight."""
    for text in map(str.strip, tag.split(",")):
        match = _WEIGHT.fullmatch(text)
        if text == "-":
            yield None
            continue
        if match is None or match[1] not in entries:
            message = unknown("weight", match[1] if match else text, entries)
            raise InputError(f"{where}: {message}")
        convert(float(match[4] or 1), float, _FACTORS, f"{where}: the factor of {text}")
        factor = Fraction(match[4] or 1) ** (-1 if match[3] == "/" else 1)
        name, words = match[1], re.findall(r"\w+", match[2])
        for cells in _cells(f"{where}: {text}", name, words, entries[name][0]):
            yield text, name, tuple(cells), factor


def _cells(where: str, name: str, words: Sequence[str], shape: tuple[int, ...]) -> list[list[int]]:
    """Return which cells of a flattened entry each number of `name[word]..` is."""
    grid, shared = np.arange(np.prod(shape, dtype=int)).reshape(shape), 0
    if len(words) > len(shape):
        raise InputError(f"{where}: expected at most {len(shape)} of [..]")
    for axis, word in enumerate(words):  # the first axis leaves, or goes to the end for `all`
        feet = FEET.get(shape[0], ()) if axis == 0 and name.startswith("R.") else ()
        known = {"all": None, **{foot: i for i, foot in enumerate(feet)}}
        known |= {str(i): i for i in range(shape[axis])}
        if word not in known:
            raise InputError(f"{where}: {unknown('index', word, known)}")
        index = known[word]
        grid = np.moveaxis(grid, 0, -1) if index is None else grid[index]
        shared += index is None
    return grid.reshape(-1, np.prod(grid.shape[grid.ndim - shared :], dtype=int)).tolist()


def _of_comments(path: Path, text: str) -> Iterator[tuple[str, str, list[Span]]]:
    """Yield place, text and numbers of each tag in a comment."""
    lines = [(line.start(), line[0]) for line in re.finditer(r"(?m)^.*", text)]
    for row, (start, line) in enumerate(lines):
        tag, commented = _TAG.search(line), _COMMENTED.match(line)
        if tag is None or (commented and commented.end() <= tag.start()):
            continue  # a line that is commented out has no tag
        spans, words = _numbers(line[: tag.start()], tag[1], start)
        may_name = not line[: tag.start()].strip()
        for below, other in () if spans else lines[row + 1 :]:
            if _TAG.search(other):
                break
            if _COMMENTED.match(other):
                continue
            more, words = _numbers(other, tag[1], below)
            if words and not may_name:
                break  # a list ends where something else is named
            may_name &= not words
            spans += more
        yield f"{path}:{row + 1}", tag[2], spans


def _numbers(line: str, mark: str, start: int) -> tuple[list[Span], bool]:
    """Return the numbers before a comment, and whether there are words too."""
    spans, words = [], False
    for token in _TOKEN.finditer(line):
        if token[3] and token[3][0] == mark[0]:
            break
        if token[1]:
            spans.append((start + token.start(1), start + token.end(1)))
        words |= token[2] is not None
    return spans, words


def _of_keys(path: Path, keys: Path, text: str) -> Iterator[tuple[str, str, list[Span]]]:
    """Yield place, text and numbers of each tag in the keys of a JSON file."""
    spans = (number.span(1) for number in _JSON_NUMBER.finditer(text) if number[1])

    def next_span(_: str) -> Span:  # numbers are met in their order in the text
        return next(spans)

    try:
        values = json.loads(text.lstrip("\ufeff"), parse_int=next_span, parse_float=next_span)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON: {one_line(error)}") from None

    def numbers(values: Any) -> Iterator[Span]:
        if isinstance(values, tuple):
            yield values
        elif isinstance(values, list | dict):
            for inner in values.values() if isinstance(values, dict) else values:
                yield from numbers(inner)

    def tags(at: str, tree: Any, values: Any) -> Iterator[tuple[str, str, list[Span]]]:
        if isinstance(tree, str):
            yield f"{keys}: {at}", tree, list(numbers(values))
            return
        for key, inner in convert(tree, dict, name=f"{keys}: {at}").items():
            if not isinstance(values, dict) or key not in values:
                raise InputError(f"{keys}: {at} {path} has no {short_repr(key)} there")
            yield from tags(f"{at}.{key}".lstrip("."), inner, values[key])

    yield from tags("", read_toml(keys, "tags as TOML"), values)
