"""The physics engines as values: their names, packages, and functions that walk jobs.

An engine is chosen once, by `choose_engine`, and passed down.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import redirect_stdout
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from io import StringIO
from itertools import chain, groupby
from typing import NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError, outside_packages
from hector_jax.core.settings import choose
from hector_jax.core.trajectory import Trajectory
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.sim.plant import Plant
from hector_jax.sim.walk import walk_many


class Engine(NamedTuple):
    """A physics engine.

    `walk(pool, config, robot, jobs, *, exact, batch)` yields the trajectories of the jobs in their
    order, as they are done:

    - pool: worker processes, for an engine that walks on several; None walks in this process.
    - config, robot: the controller.
    - exact: samples of 1 ms and physics in 64 bits. Otherwise an engine may give one sample per
      tick, and use 32 bits if that is faster.
    - batch: least number of jobs that a program is compiled for; fewer jobs are filled up, so that
      later calls need no new compilation.
    """

    name: str  # in flags, logs and cards
    title: str  # in reports
    walk: Callable[..., Iterator[Trajectory]]
    bits: Callable[[bool], int]  # of the physics, by `exact`
    modules: tuple[str, ...] = ("sim.walk",)  # modules of this package that decide its numbers
    package: str = "mujoco"  # its Python package; the extra with the engine's name installs it
    # differences of its plants from MuJoCo C, for reports; empty means the same physics, and a walk
    # that falls is then diagnosed in MuJoCo C
    differs: str = ""
    content: str = ""  # of a program that walks; empty means the function `walk`

    @property
    def key(self) -> str:
        """What identifies it in keys of stored walks, beside the code of `modules`."""
        return f"{self.name} {self.version} {self.content or function_id(self.walk)}"

    @property
    def version(self) -> str | None:
        """Version of its package; None if that is not installed."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return None


def _double(exact: bool) -> int:
    return 64


MUJOCO_C = Engine("c", "MuJoCo C", walk_many, _double)
"""MuJoCo C, one walk per process."""


def _import_and_build(
    job: Job, body: Robot, first: int, end: int, *, name: str, plant: str
) -> Plant:
    """Import an optional engine's module, which nothing else imports, and build a plant of it."""
    return getattr(import_module(f"hector_jax.sim.{name}"), plant)(job, body, first, end)


def _optional_engine(name: str, title: str, plant: str, package: str, differs: str) -> Engine:
    """Return an engine of an extra, one walk per process; `plant` is its class in sim/NAME.py."""
    walk = partial(walk_many, build=partial(_import_and_build, name=name, plant=plant))
    return Engine(name, title, walk, _double, ("sim.walk", f"sim.{name}"), package, differs)


DRAKE = _optional_engine(
    "drake", "Drake", "DrakePlant", package="drake", differs="dry friction is smooth"
)
"""Drake: compliant contact, solved as a convex problem."""

PINOCCHIO = _optional_engine(
    "pinocchio",
    "Pinocchio",
    "PinocchioPlant",
    package="pin",
    differs="the floor is rigid, dry friction is smooth, legs pass through each other",
)
"""Pinocchio: rigid contact with Coulomb's law."""


def _mjx_bits(exact: bool) -> int:
    # on a CPU 32 bits are not faster
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
    with redirect_stdout(StringIO()):  # MJX takes a second to import and prints missing packages
        from hector_jax.sim.parallel import walk_batch

    def walked(alike: list[Job]) -> Iterator[Trajectory]:
        padded = [*alike, *alike[-1:] * (batch - len(alike))]
        walks = walk_batch(config, robot, padded, fine=exact, single=_mjx_bits(exact) == 32)
        return (walk for _, walk in zip(alike, walks, strict=False))

    shapes = groupby(jobs, lambda job: (float(job.seconds), np.shape(job.command.duration)))
    return chain.from_iterable(walked(list(alike)) for _, alike in shapes)


MJX = Engine("mjx", "MJX", _walk_mjx, _mjx_bits, modules=("sim.parallel",), package="mujoco-mjx")
"""MuJoCo in JAX, all walks at once."""

ENGINES = {engine.name: engine for engine in (MUJOCO_C, MJX, DRAKE, PINOCCHIO)}
"""Every engine by its name. A new one is added here and to the choices in cli/flags.py."""


def choose_engine(name: str) -> Engine:
    """Return the engine of a name; `auto` is MJX if JAX has an accelerator, else MuJoCo C.

    Raises:
        InputError: no such engine, or its package is not installed or cannot be loaded.
    """
    if choose("engine", name, ("auto", *ENGINES)) == "auto":
        return MUJOCO_C if jax.default_backend() == "cpu" else MJX
    engine = ENGINES[name]
    if engine.version is None:
        raise InputError(
            f"engine {name} needs {engine.package}, which is not installed: "
            f"pip install -e '.[{name}]' in the checkout"
        )
    with outside_packages(), redirect_stdout(StringIO()):  # MJX lists packages that none needs
        import_module(f"hector_jax.{engine.modules[-1]}")
    return engine
