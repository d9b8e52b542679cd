"""Config entries that are functions: a file stores the name, the program calls the functions.

A kind of part is a subclass that annotates its functions; a part is an instance of it:

    class Solver(Part):
        approach: Callable[[Normal], Approach]

    JAXOPT = Solver("jaxopt", approach=box_osqp)

A part is a `str`, so that TOML, JSON and messages show its name. Two parts are equal if their names
and functions are: a jitted function with a part in its static config is recompiled for another part
of the same name. Its `repr`, which identifies stored results, has only the names of the functions:
use functions of a module, not closures or lambdas, which can share a name.
"""

from collections.abc import Iterable
from typing import Any, TypeVar

from hector_jax.core.inputs import InputError
from hector_jax.core.settings import choose


class Part(str):
    """A named value of one or two pure functions."""

    def __new__(cls, name: str, **functions: Any):
        """Create a part with this name and these functions."""
        part = super().__new__(cls, name)
        part.__dict__.update(functions)
        return part

    def __eq__(self, other: object) -> bool:
        same_name = str.__eq__(self, other)
        return same_name and (not isinstance(other, Part) or self.__dict__ == other.__dict__)

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = str.__hash__

    def __repr__(self) -> str:
        values = (
            f"{name}={value.__module__}.{value.__qualname__}"
            if hasattr(value, "__qualname__")
            else f"{name}={value!r}"
            for name, value in self.__dict__.items()
        )
        return f"{type(self).__name__}({str(self)!r}, {', '.join(values)})"


P = TypeVar("P", bound=Part)


def choose_part(what: str, chosen: str, kind: type[P], parts: Iterable[P]) -> P:
    """Return `chosen` if it is a part of this kind, else the part in `parts` with that name.

    Raises:
        InputError: `WHAT must be ..., got ...`.
    """
    if isinstance(chosen, kind):
        return chosen
    by_name = {str(part): part for part in parts}
    if isinstance(chosen, Part):
        raise InputError(f"{what} must be a {kind.__name__}, got {chosen!r}")
    return by_name[choose(what, chosen, by_name)]
