"""Config entries that are functions: a file stores the name, the program calls the functions.

A kind of part is a subclass that annotates its functions; a part is an instance of it. `known` are
those that can be given by name, in files and in Python:

    class Solver(Part):
        approach: Callable[[Normal], Approach]

    JAXOPT = Solver("jaxopt", approach=box_osqp)
    Solver.known = (JAXOPT,)

A part equals another part of its kind with the same name and functions: a jitted function with a
part in its static config is recompiled for another part of the same name. Its `repr`, which
identifies stored results, has the content of a user's functions; its `str` is the name.
"""

from typing import Any, ClassVar, TypeVar

from hector_jax.core.identity import function_id

P = TypeVar("P", bound="Part")


class Part:
    """A named value of a config that cannot be changed, mostly of pure functions."""

    known: ClassVar[tuple[Any, ...]] = ()

    def __init__(self, name: str, **functions: Any) -> None:
        """Create a part with this name and these functions."""
        self.__dict__.update(functions, name=name)

    @classmethod
    def named(cls: type[P], name: str) -> P:
        """Return the known part of a name.

        Raises:
            ValueError: there is none.
        """
        return cls.known[[*map(str, cls.known)].index(name)]

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{self!r} cannot be changed")

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash((type(self), str(self)))

    def __str__(self) -> str:
        return self.__dict__["name"]

    def __repr__(self) -> str:
        values = (
            f"{name}={function_id(value) if callable(value) else repr(value)}"
            for name, value in self.__dict__.items()
            if name != "name"
        )
        return f"{type(self).__name__}({str(self)!r}, {', '.join(values)})"
