"""A plant in MuJoCo C."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.core.arrays import Array
from hector_jax.core.headless import mujoco
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.changes import worlds_by_step
from hector_jax.sim.loop import Job
from hector_jax.sim.plant import Plant
from hector_jax.sim.sensing import Ground, RawContacts
from hector_jax.sim.world import World, build_world, standing_qpos


class MujocoPlant(Plant):
    """A `Plant` in MuJoCo C, which may change during a walk."""

    def __init__(
        self,
        job: Job,
        body: Robot,
        first: int,
        end: int,
        *,
        on_step: Callable[[World, mujoco.MjData], None] | None = None,
    ) -> None:
        """Build as a `BuildPlant` does.

        `on_step` is called after each step with the world then in force.
        """
        world = self.world = build_world(job.imperfections, body.description)
        self.data = mujoco.MjData(world.model)
        self.data.qpos[:] = standing_qpos(world, body.standing_joints, float(body.trunk_height))
        self._contacts, self._steps = sensing.empty_contacts(end - first), 0
        self._time, self._reading_index = first, sensing.coordinates(world)
        self._place = jax.device_put((np.array(world.floor), world.foot_of_geom))
        self._worlds, self._on_step = worlds_by_step(world, job.changes, first, end), on_step
        # views that remain valid: each look-up in MjData costs half a microsecond
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._push = self.data.xfrc_applied[world.trunk, :3]
        self._flat = np.zeros(len(self._qpos) + len(self._qvel) + 1)

    @property
    def broken(self) -> bool:
        """Return whether MuJoCo warned."""
        return bool(self.data.warning.number.any())

    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """See `Plant`."""
        world = self.world = self._worlds.get(self._time, self.world)
        self._ctrl[:] = torque
        self._push[:] = push
        mujoco.mj_step(world.model, self.data)
        sensing.read_contacts(self.data, self._contacts, self._steps)
        self._time, self._steps = self._time + 1, self._steps + 1
        if self._on_step is not None:
            self._on_step(world, self.data)

    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """See `Plant`."""
        split = len(self._qpos)
        self._flat[:split], self._flat[split:-1] = self._qpos, self._qvel
        self._flat.take(self._reading_index, out=row, mode="clip")

    def ground(self) -> tuple[RawContacts, Array, Array]:
        """See `Plant`."""
        contacts = RawContacts(*(x[: self._steps] for x in self._contacts))
        self._steps = 0
        return contacts, *self._place

    @staticmethod
    def ground_of(robot: Robot, contacts: tuple[RawContacts, Array, Array]) -> Ground:
        """See `Plant`."""

        def ground_of(raw: RawContacts, floor: Array, foot_of_geom: Array) -> Ground:
            feet = len(robot.foot_point)
            return sensing.ground_of(sensing.contacts_of(raw, floor), floor, foot_of_geom, feet)

        return jax.vmap(ground_of, in_axes=(0, None, None))(*contacts)
