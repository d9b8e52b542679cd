"""A plant in MuJoCo C."""

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job
from hector_jax.sim.plant import Plant
from hector_jax.sim.sensing import Ground
from hector_jax.sim.world import World, build_world, standing_qpos


class MujocoPlant(Plant):
    """A `Plant` in MuJoCo C."""

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

        `on_step` is called after each step with the world.
        """
        world = self.world = build_world(job.imperfections, body.description, sensors=True)
        self.data = mujoco.MjData(world.model)
        self.data.qpos[:] = standing_qpos(world, body.standing_joints, float(body.trunk_height))
        self._sensed, self._steps = np.zeros((end - first, world.model.nsensordata)), 0
        self._feet = len(body.foot_point)
        self._reading_index, self._on_step = sensing.coordinates(world), on_step
        # views that remain valid: each look-up in MjData costs half a microsecond
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._sensors = self.data.sensordata
        self._push = self.data.xfrc_applied[world.trunk, :3]
        self._flat = np.zeros(len(self._qpos) + len(self._qvel) + 1)
        self._coordinates = np.split(self._flat, [len(self._qpos), -1])

    @property
    def broken(self) -> bool:
        """Return whether MuJoCo warned."""
        return bool(self.data.warning.number.any())

    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """See `Plant`."""
        self._ctrl[:] = torque
        self._push[:] = push
        mujoco.mj_step(self.world.model, self.data)
        self._sensed[self._steps] = self._sensors
        self._steps += 1
        if self._on_step is not None:
            self._on_step(self.world, self.data)

    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """See `Plant`."""
        qpos, qvel, _ = self._coordinates
        qpos[:], qvel[:] = self._qpos, self._qvel
        self._flat.take(self._reading_index, out=row, mode="clip")

    def ground(self) -> Ground:
        """See `Plant`."""
        steps, self._steps = self._steps, 0
        return sensing.sensed_ground(self._sensed[:steps], self._feet)

    def mean_force(self, steps: int) -> Float[np.ndarray, "feet 3"]:
        """Return the mean force on each foot [N] over the last steps, at most those it notes."""
        rows = self._sensed[np.arange(self._steps - steps, self._steps)]
        return np.asarray(sensing.sensed_ground(rows, self._feet).force).mean(axis=0)

    def state(self) -> Float[np.ndarray, " n"]:
        """Return all that the next steps follow from, for `replay`."""
        kind, model = mujoco.mjtState.mjSTATE_INTEGRATION, self.world.model
        state = np.zeros(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, self.data, state, kind)
        return state

    def replay(
        self,
        state: Float[np.ndarray, " n"],
        forces: Iterable[tuple[np.ndarray, np.ndarray]],
        on_step: Callable[[World, mujoco.MjData], None],
    ) -> None:
        """Step again from a state under torques and forces on the trunk, beside this walk."""
        model, data = self.world.model, mujoco.MjData(self.world.model)
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        for torque, force in forces:
            data.ctrl[:], data.xfrc_applied[self.world.trunk, :3] = torque, force
            mujoco.mj_step(model, data)
            on_step(self.world, data)
