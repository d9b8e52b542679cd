"""Config entries that are functions: a file stores the name, the program calls the functions.

A kind of part is a subclass that annotates its functions; a part is an instance of it:

    class Solver(Part):
        approach: Callable[[Normal], Approach]

    JAXOPT = Solver("jaxopt", approach=box_osqp)

A part is a `str`, so that TOML, JSON and messages show its name. It equals another part of its kind
with the same name and functions, and no plain text: a jitted function with a part in its static
config is recompiled for another part of the same name. Its `repr`, which identifies stored results,
has the content of a user's functions.
"""

from collections.abc import Iterable
from typing import Any, TypeVar

from hector_jax.core.identity import function_id
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
        same = type(self) is type(other) and str.__eq__(self, other)
        return same and self.__dict__ == other.__dict__

    def __ne__(self, other: object) -> bool:
        return not self == other

    def __hash__(self) -> int:
        return hash((type(self), str(self)))

    def __repr__(self) -> str:
        values = (
            f"{name}={function_id(value) if callable(value) else repr(value)}"
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
