"""What the closed loop needs of a physics engine: a plant that stands, steps and is read.

Whatever speaks an engine's own language (geoms, solvers, contact models) stays behind it.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from hector_jax.core.inputs import InputError
from hector_jax.robot.model import Robot
from hector_jax.sim.changes import worlds_by_step
from hector_jax.sim.loop import Job
from hector_jax.sim.sensing import Ground
from hector_jax.sim.world import World, build_world


@runtime_checkable
class Plant(Protocol):
    """A robot in the world of one walk; it stands at the origin when it is built."""

    @property
    def broken(self) -> bool:
        """Whether the engine warned or failed: what follows means nothing."""
        ...

    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """Step a millisecond under joint torques [N m] and a force [N] on the trunk's centre."""
        ...

    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """Write the coordinates now, in the order of `sensing.Reading`, into `row`."""
        ...

    def ground(self) -> Ground:
        """What touched in each of the milliseconds since the last call (n, ...)."""
        ...


BuildPlant = Callable[[Job, Robot, int, int], Plant]
"""Makes the plant of a job.

It takes the job, the robot of the plant (`Job.body`), which stands at the origin, and the
milliseconds after t = 0 at which the walk begins and ends. It raises an InputError where the engine
cannot have such a plant.
"""


def lasting_world(engine: str, job: Job, body: Robot, first: int, end: int) -> World:
    """The world of a walk for an engine whose plants do not change on the way.

    Raises:
        InputError: a change begins or ends within the walk, or a number of it is out of its range.
    """
    world = build_world(job.imperfections, body.description)
    worlds = worlds_by_step(world, job.changes, first, end)
    if len(worlds) > 1:
        raise InputError(
            f"engine {engine}: a plant cannot change during a walk; expected changes that last "
            "from its start to its end"
        )
    return worlds[first]
