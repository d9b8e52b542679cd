"""The physics engines as values: which there are, and what each does with jobs.

An engine is chosen once, by `choose_engine`, and passed down; no other module asks which one it is.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import redirect_stdout
from typing import NamedTuple

import jax

from hector_jax.control.controller import WalkConfig
from hector_jax.core.settings import choose
from hector_jax.core.trajectory import Trajectory
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk_many


class Engine(NamedTuple):
    """A physics engine.

    `walk(pool, config, robot, jobs, *, exact, batch)` gives the trajectories of the jobs in their
    order, as they come:

    - pool: worker processes, for an engine that walks on several.
    - config, robot: the controller.
    - exact: samples of 1 ms and physics in 64 bits. Otherwise one sample per tick will do, and 32
      bits where they are faster.
    - batch: as many jobs as a program is compiled for at least; fewer are filled up, so that the
      next ones need no new compilation.
    """

    name: str  # in flags, logs and cards
    walk: Callable[..., Iterator[Trajectory]]
    bits: Callable[[bool], int]  # of the physics, by `exact`


MUJOCO_C = Engine("c", walk_many, lambda exact: 64)
"""MuJoCo C, one walk per process."""


def _mjx_bits(exact: bool) -> int:
    # on a CPU 32 bits gain nothing
    return 64 if exact or jax.default_backend() == "cpu" else 32


def _walk_mjx(
    pool: Executor | None,
    config: WalkConfig,
    robot: Robot,
    jobs: Sequence[Job],
    *,
    exact: bool = True,
    batch: int = 0,
) -> Iterator[Trajectory]:
    with redirect_stdout(sys.stderr):  # MJX takes a second to import and prints what it misses
        from hector_jax.sim.parallel import walk_batch

    filled = [*jobs, *list(jobs[-1:]) * (batch - len(jobs))]
    walks = walk_batch(config, robot, filled, fine=exact, single=_mjx_bits(exact) == 32)
    return (walk for _, walk in zip(jobs, walks, strict=False))


MJX = Engine("mjx", _walk_mjx, _mjx_bits)
"""MuJoCo in JAX, all walks at once."""

ENGINES = {engine.name: engine for engine in (MUJOCO_C, MJX)}
"""Every engine by its name; whoever adds one adds it here."""


def choose_engine(name: str) -> Engine:
    """The engine of a name; `auto` is MJX where JAX sees an accelerator, MuJoCo C elsewhere.

    Raises:
        InputError: no such engine.
    """
    if choose("engine", name, ("auto", *ENGINES)) == "auto":
        return MUJOCO_C if jax.default_backend() == "cpu" else MJX
    return ENGINES[name]
