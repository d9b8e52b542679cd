"""What identifies a function in keys of stored results: its name and, of a user's, its content."""

import hashlib
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import numpy as np

_INSTALLED = ("site-packages", "dist-packages")


def function_id(function: Callable[..., Any]) -> str:
    """Return the name of a function and, if it is a user's, a hash of its content.

    The content is all that it computes with: its code, its defaults and closure, and the functions,
    classes, modules and numbers of the user that it names. Our own code is in `code_hash`, other
    installed packages have a version.
    """
    inner = function.func if isinstance(function, partial) else function
    name = _name(inner if hasattr(inner, "__qualname__") else type(inner))
    content = list(_content(function, {}))
    if content == [repr(name)]:
        return name
    return f"{name}#{hashlib.sha256(repr(content).encode()).hexdigest()[:12]}"


def _content(value: Any, seen: dict[int, Any]) -> Iterator[str]:
    """Yield texts that tell a value from another one; `seen` holds the values so far, by id."""
    if isinstance(value, str | bytes | int | float | complex | None):
        yield repr(value)
    elif id(value) not in seen:
        seen[id(value)] = value
        for part in _parts(value):
            yield from _content(part, seen)


def _parts(value: Any) -> Iterator[Any]:
    """Yield what a value consists of."""
    match value:
        case MethodType():
            yield value.__func__, value.__self__
        case _ if _name(value) and not _is_of_user(value):
            yield _name(value)
        case ModuleType():
            yield _name(value)
            yield Path(value.__file__).read_bytes() if value.__file__ else b""
        case FunctionType():
            names = set(_names(value.__code__))
            yield _name(value)
            yield value.__code__
            yield value.__defaults__, value.__kwdefaults__
            yield [cell.cell_contents for cell in value.__closure__ or ()]
            yield {name: x for name, x in value.__globals__.items() if name in names}
        case CodeType():
            yield value.co_code, value.co_names, value.co_consts
        case type():
            yield _name(value), dict(vars(value))
        case _ if hasattr(value, "__wrapped__"):  # by jax.jit or with a derivative of its own
            yield value.__wrapped__, [vars(value).get(rule) for rule in ("jvp", "fwd", "bwd")]
        case partial():
            yield value.func, value.args, value.keywords
        case Mapping():
            yield from ((key, value[key]) for key in sorted(value, key=str))
        case list() | tuple():
            yield from value
        case set() | frozenset():
            yield from sorted(value, key=repr)
        case np.ndarray() | np.generic() | jax.Array():
            array = np.asarray(value)
            yield str(array.dtype), array.shape, array.tobytes()
        case _:
            yield type(value), getattr(value, "__dict__", {})


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that a function and the functions inside it look up."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _name(value: Any) -> str:
    """Return the name of a module, function or class; "" if the value is none."""
    if isinstance(value, ModuleType):
        return value.__name__
    named = hasattr(value, "__module__") and hasattr(value, "__qualname__")
    return f"{value.__module__}.{value.__qualname__}" if named else ""


def _is_of_user(value: Any) -> bool:
    """Tell whether a module, function or class is the user's: neither ours nor installed."""
    name = str(value.__name__ if isinstance(value, ModuleType) else value.__module__)
    top, file = name.partition(".")[0], getattr(sys.modules.get(name), "__file__", None)
    ours = top == __name__.partition(".")[0]
    standard = top in sys.stdlib_module_names and top != "__main__"
    return not (ours or standard or any(folder in str(file) for folder in _INSTALLED))
