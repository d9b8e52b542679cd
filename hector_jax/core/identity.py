"""What identifies a function in keys of stored results: its name and, of a user's, its content."""

import hashlib
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from inspect import unwrap
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import numpy as np

_INSTALLED = ("site-packages", "dist-packages")
_CONSTANTS = (int, float, complex, str, bytes, tuple, np.ndarray)
_NOT_CONTENT = ("__dict__", "__weakref__", "__doc__", "__firstlineno__", "__static_attributes__")


def function_id(function: Callable[..., Any]) -> str:
    """Return the name of a function and, if it is a user's, a hash of its content.

    The content is its code, defaults and closure, and the functions, classes, modules and constants
    of the user that these name, through the wrappers of JAX and other packages. Not seen are files
    that it reads and modules that it imports while it runs. An object of the user that changes
    while it is used makes another function. Our own code is in `code_hash`, other installed
    packages have a version.
    """
    inner = function.func if isinstance(function, partial) else function
    name = _name(inner if hasattr(inner, "__qualname__") else type(inner))
    content = list(_content(function, {}))
    if content == [repr(name)]:
        return name
    return f"{name}#{hashlib.sha256(repr(content).encode()).hexdigest()[:12]}"


def _content(value: Any, seen: dict[int, tuple[int, Any]]) -> Iterator[str]:
    """Yield texts that tell a value from another one; `seen` numbers the values so far, by id."""
    if isinstance(value, str | bytes | int | float | complex | None):
        yield repr(value)
    elif id(value) in seen:
        yield f"the value number {seen[id(value)][0]}"
    else:
        seen[id(value)] = len(seen), value
        for part in _parts(value):
            yield from _content(part, seen)


def _parts(value: Any) -> Iterator[Any]:
    """Yield what a value consists of."""
    origin = _origin(value)
    match value:
        case MethodType():
            yield value.__func__, value.__self__
        case _ if origin == "ours":
            yield _name(value)
        case FunctionType():
            yield _name(value)
            if origin == "user":
                names = set(_names(value.__code__))
                yield value.__code__
                yield value.__defaults__, value.__kwdefaults__
                yield {name: x for name, x in value.__globals__.items() if name in names}
            if value.__closure__:  # an installed wrapper may hold a function of the user
                yield [cell.cell_contents for cell in value.__closure__]
            yield from filter(None, [getattr(value, "__wrapped__", None)])
        case _ if origin == "installed" and _origin(unwrap(value)) != "user":
            yield _name(value)
        case ModuleType():
            kinds = (*_CONSTANTS, FunctionType, ModuleType, type)
            yield {name: x for name, x in vars(value).items() if isinstance(x, kinds)}
        case CodeType():
            yield value.co_code, value.co_names, value.co_consts
        case type():
            content = {name: x for name, x in vars(value).items() if name not in _NOT_CONTENT}
            yield _name(value), value.__bases__, content
        case _ if hasattr(value, "__wrapped__"):  # by jax.jit or with a derivative of its own
            rules = [vars(value).get(rule) for rule in ("jvp", "fwd", "bwd")]
            yield _name(value), value.__wrapped__, rules
        case partial():
            yield value.func, value.args, value.keywords
        case Mapping():
            yield from ((key, value[key]) for key in sorted(value, key=str))
        case list() | tuple():
            yield type(value)
            yield from value
        case set() | frozenset():
            yield from sorted(value, key=repr)
        case np.ndarray() | np.generic() | jax.Array():
            array = np.asarray(value)
            yield str(array.dtype), array.shape, array.tobytes()
        case property():
            yield value.fget, value.fset
        case _:
            yield type(value), _state(value)


def _state(value: Any) -> Any:
    """Return what an object of no known kind holds."""
    try:
        return vars(value) if hasattr(value, "__dict__") else value.__reduce_ex__(4)[1:3]
    except TypeError:  # such as a lock
        return ()


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
    if not (hasattr(value, "__module__") and hasattr(value, "__qualname__")):
        return ""
    # a worker process has the user's script under another name
    return f"{value.__module__}.{value.__qualname__}".replace("__mp_main__", "__main__")


def _origin(value: Any) -> str:
    """Return whose a module, function or class is: ours (or Python's), installed or user."""
    if not _name(value):
        return "user"
    name = str(value.__name__ if isinstance(value, ModuleType) else value.__module__)
    top, file = name.partition(".")[0], getattr(sys.modules.get(name), "__file__", None)
    if top == __name__.partition(".")[0] or (top in sys.stdlib_module_names and top != "__main__"):
        return "ours"
    return "installed" if any(folder in str(file) for folder in _INSTALLED) else "user"
