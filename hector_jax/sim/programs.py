"""Compiled programs of walks, of few robots at a time.

A program is compiled for a robot's description and controller. A process that walks robot after
robot would keep the programs of all of them until its memory ends.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import jax

from hector_jax.robot.description import Description

ROBOTS = 6  # whose programs are kept
_T = TypeVar("_T")
_caches: list[Any] = []
_present: dict[Description, None] = {}


def by_robot(build: Callable[..., _T]) -> Callable[..., _T]:
    """Return a function that builds a program once, until `make_room` frees it."""
    cached = cache(build)
    _caches.append(cached)
    return cached


def make_room(description: Description) -> None:
    """Free all compiled programs before a process walks with one robot too many."""
    if description not in _present and len(_present) >= ROBOTS:
        _present.clear()
        for cached in _caches:
            cached.cache_clear()
        jax.clear_caches()
    _present[description] = None
