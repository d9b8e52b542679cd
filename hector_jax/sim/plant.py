"""What the closed loop needs of a physics engine: a plant that stands, steps and is read.

Whatever speaks an engine's own language (geoms, solvers, contact models) stays behind it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from hector_jax.core.inputs import InputError
from hector_jax.robot.model import Robot
from hector_jax.sim.changes import worlds_by_step
from hector_jax.sim.loop import Job
from hector_jax.sim.sensing import Ground, Touches
from hector_jax.sim.world import World, build_world


class Plant(ABC):
    """A robot in the world of one walk; it stands at the origin when it is built."""

    @property
    @abstractmethod
    def broken(self) -> bool:
        """Whether the engine warned or failed: what follows means nothing."""

    @abstractmethod
    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """Step a millisecond under joint torques [N m] and a force [N] on the trunk's centre."""

    @abstractmethod
    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """Write the coordinates now, in the order of `sensing.Reading`, into `row`."""

    @abstractmethod
    def ground(self) -> Any:
        """Contacts of each of the n milliseconds since the last call, as `ground_of` takes them."""

    @staticmethod
    def ground_of(robot: Robot, contacts: Any) -> Ground:
        """Sum up the contacts that `ground` returned, in JAX, as a Ground with a leading axis n.

        The closed loop calls it within its compiled program of a tick: with a compiled call of its
        own, walks in MuJoCo C take 7 to 9 % longer. By default `ground` has summed them up already.
        """
        return contacts


BuildPlant = Callable[[Job, Robot, int, int], Plant]
"""Makes the plant of a job.

It takes the job, the robot of the plant (`Job.body`), which stands at the origin, and the
milliseconds after t = 0 at which the walk begins and ends. It raises an InputError where the engine
cannot have such a plant.
"""


OTHER, LEGS = -1, -2  # in the place of a foot: another part on the floor; a leg on another


class PointContacts:
    """Forces at points, noted step by step and summed up into a `Ground`."""

    def __init__(self, feet: int) -> None:
        """Of a robot with so many feet."""
        self._feet, self._steps = feet, 0
        self._rows: list[tuple[float, ...]] = []

    def note(self, foot: int, force: Float[np.ndarray, "3"], point: Float[np.ndarray, "3"]) -> None:
        """Note a force [N] of the ground on a foot at a point [m]; or `OTHER` or `LEGS`."""
        self._rows.append((self._steps, foot, *force, *point))

    def end_step(self) -> None:
        """What follows is of the next step."""
        self._steps += 1

    def ground(self) -> Ground:
        """Return the sums of each step, and begin anew."""
        rows, steps = np.array(self._rows).reshape(-1, 8), self._steps
        self._rows, self._steps = [], 0
        step, foot = rows[:, :2].astype(int).T
        other, legs = (np.isin(np.arange(steps), step[foot == kind]) for kind in (OTHER, LEGS))
        force, moment = np.zeros((2, steps, self._feet, 3))
        rows, where = rows[foot >= 0], (step[foot >= 0], foot[foot >= 0])
        np.add.at(force, where, rows[:, 2:5])
        np.add.at(moment, where, np.cross(rows[:, 5:], rows[:, 2:5]))
        return Ground(force, moment, Touches(other, legs))


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
