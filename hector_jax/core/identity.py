"""What identifies a function in keys of stored results: its name and, of a user's, its content."""

import dis
import hashlib
import sys
from collections import deque
from collections.abc import Callable, Container, Iterator, Mapping
from functools import cache, partial
from importlib.metadata import packages_distributions, version
from inspect import unwrap
from pathlib import Path
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import numpy as np

_NOT_CONTENT = (
    "__dict__ __weakref__ __doc__ __firstlineno__ __static_attributes__ __module__ __name__"
    " __file__"  # a moved checkout is the same code
).split()


def function_id(function: Callable[..., Any]) -> str:
    """Return the name of a function and, if it is a user's, a hash of its content.

    The content is its code without docstrings, defaults and closure, and the functions, classes and
    values of the user that these name, in modules too, through the wrappers of JAX and other
    packages. Not seen are files that it reads, modules that it imports while it runs and names that
    it puts together. An object of the user that changes while it is used makes another function.
    Our own code is in `code_hash`; of an installed package the version counts.
    """
    inner = function.func if isinstance(function, partial) else function
    name = _name(inner if hasattr(inner, "__qualname__") else type(inner))
    names, count, content = set[str](), -1, list[str]()
    while count < len(names):  # what a module has of the names depends on the functions in it
        count, content = len(names), list(_content(function, names))
    if content[1:] == [repr(name)]:
        return name
    return f"{name}#{hashlib.sha256(repr(content).encode()).hexdigest()[:12]}"


def _content(function: Any, names: set[str]) -> Iterator[str]:
    """Yield texts that tell a function from another one; see `_parts`."""
    seen: dict[int, tuple[int, Any]] = {}  # number of a value by its id, and the value: ids return
    pending = [function]
    while pending:  # functions that call each other may be a long chain
        value = pending.pop()
        if isinstance(value, str | bytes | int | float | complex | None):
            yield repr(value)
        elif id(value) in seen:
            yield f"the value number {seen[id(value)][0]}"
        else:
            seen[id(value)] = len(seen), value
            parts = list(_parts(value, names))
            yield f"{len(parts)} parts"  # else [[1], 2] would be [[1, 2]]
            pending += reversed(parts)


def _parts(value: Any, names: set[str]) -> Iterator[Any]:
    """Yield what a value consists of; of a module that which has one of the names.

    The names that functions look up are added to `names`.
    """
    if (origin := _origin(value)) == "installed":
        yield from _versions(_name(value).partition(".")[0])
    match value:
        case MethodType():
            yield value.__func__, value.__self__
        case _ if origin == "ours":
            yield _name(value)
        case FunctionType():
            yield _name(value)
            if origin == "user":
                own = set(_names(value.__code__))
                names.update(own)
                yield value.__code__
                yield value.__defaults__, value.__kwdefaults__
                yield _chosen(value.__globals__, own)
            if value.__closure__:  # an installed wrapper may hold a function of the user
                yield [cell.cell_contents for cell in value.__closure__ if cell != CellType()]
            yield from filter(None, [getattr(value, "__wrapped__", None)])
        case _ if origin == "installed" and _origin(unwrap(value)) != "user":
            yield _name(value)
        case ModuleType():
            yield _chosen(vars(value), names)
        case CodeType():
            # a docstring is a constant that nothing loads
            loads = (x for x in dis.get_instructions(value) if x.opcode in dis.hasconst)
            yield value.co_code, value.co_names, [load.argval for load in loads]
        case type():
            yield _name(value), value.__bases__, _chosen(vars(value), vars(value))
        case _ if hasattr(value, "__wrapped__"):  # by jax.jit or with a derivative of its own
            rules = [vars(value).get(rule) for rule in ("jvp", "fwd", "bwd")]
            yield _name(value), value.__wrapped__, rules
        case partial():
            yield value.func, value.args, value.keywords
        case Mapping():
            yield from ((key, value[key]) for key in sorted(value, key=str))
        case list() | tuple() | deque():
            yield from (type(value), *value)
        case set() | frozenset():
            yield from sorted(value, key=repr)
        case np.ndarray() | np.generic() | jax.Array():
            array = np.asarray(value)
            yield str(array.dtype), array.shape, array.tobytes()
        case property():
            yield value.fget, value.fset
        case _:
            yield type(value), _state(value)


def _chosen(entries: Mapping[str, Any], names: Container[str]) -> dict[str, Any]:
    """Return the entries of these names, but those that are no content."""
    return {n: x for n, x in entries.items() if n in names and n not in _NOT_CONTENT}


def _state(value: Any) -> Any:
    """Return what an object of no known kind holds."""
    try:
        return vars(value) if hasattr(value, "__dict__") else value.__reduce_ex__(4)
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


_distributions = cache(packages_distributions)  # which reads the files of all packages


@cache
def _versions(package: str) -> list[str]:
    """Return name and version of what was installed as a package, such as numpy."""
    return [f"{name} {version(name)}" for name in sorted({*_distributions().get(package, ())})]


def _origin(value: Any) -> str:
    """Return whose a module, function or class is: ours (or Python's), installed or user."""
    if not _name(value):
        return "user"
    name = str(value.__name__ if isinstance(value, ModuleType) else value.__module__)
    top, file = name.partition(".")[0], getattr(sys.modules.get(name), "__file__", None)
    if top == __name__.partition(".")[0] or (top in sys.stdlib_module_names and top != "__main__"):
        return "ours"
    return "installed" if top in _distributions() and _is_installed(name, file or "") else "user"


@cache
def _is_installed(module: str, file: str) -> bool:
    """Tell whether the folder that a module is imported from is one of installed packages."""
    above = list(Path(file).parents)[module.count(".") + (Path(file).stem == "__init__") :]
    return any(above) and next(above[0].glob("*.dist-info"), None) is not None
