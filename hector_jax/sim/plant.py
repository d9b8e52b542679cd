"""Interface of the closed loop to a physics engine: a plant that stands, steps and is read.

Details of an engine (geoms, solvers, contact models) stay behind it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.sim.sensing import Ground, Touches


class Plant(ABC):
    """A robot in the world of one walk; it stands at the origin when it is built."""

    @property
    @abstractmethod
    def broken(self) -> bool:
        """Return whether the engine warned or failed: later samples are invalid."""

    @abstractmethod
    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """Step a millisecond under joint torques [N m] and a force [N] on the trunk's centre."""

    @abstractmethod
    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """Write the current coordinates, in the order of `sensing.Reading`, into `row`."""

    @abstractmethod
    def ground(self) -> Ground:
        """Return what the ground did in each of the n milliseconds since the last call."""


BuildPlant = Callable[[Job, Robot, int, int], Plant]
"""Function that builds the plant of a job.

It takes the job, the robot of the plant (`Job.body`), which stands at the origin, and the
milliseconds after t = 0 at which the walk begins and ends. It raises an InputError if the engine
does not support such a plant.
"""


OTHER, LEGS = -1, -2  # instead of a foot: another part on the floor; one leg on another


class PointContacts:
    """Forces at points, noted step by step and summed to a `Ground`."""

    def __init__(self, feet: int) -> None:
        """Start without contacts, for a robot with `feet` feet."""
        self._feet, self._steps = feet, 0
        self._rows: list[tuple[float, ...]] = []

    def note(self, foot: int, force: Float[np.ndarray, "3"], point: Float[np.ndarray, "3"]) -> None:
        """Note a force [N] of the ground on a foot at a point [m]; or `OTHER` or `LEGS`."""
        self._rows.append((self._steps, foot, *force, *point))

    def end_step(self) -> None:
        """Begin the next step."""
        self._steps += 1

    def ground(self) -> Ground:
        """Return the sums of each step, and clear them."""
        rows, steps = np.array(self._rows).reshape(-1, 8), self._steps
        self._rows, self._steps = [], 0
        step, foot = rows[:, :2].astype(int).T
        other, legs = (np.isin(np.arange(steps), step[foot == kind]) for kind in (OTHER, LEGS))
        force, moment = np.zeros((2, steps, self._feet, 3))
        rows, index = rows[foot >= 0], (step[foot >= 0], foot[foot >= 0])
        np.add.at(force, index, rows[:, 2:5])
        np.add.at(moment, index, np.cross(rows[:, 5:], rows[:, 2:5]))
        return Ground(force, moment, np.zeros_like(moment), Touches(other, legs))
