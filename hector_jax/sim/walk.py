"""The closed loop in MuJoCo C: one walk, or many on several processes.

Controller and sensing are compiled once per process and serve every walk, whatever its weights,
command and plant: per tick one program plans and one samples, per millisecond one turns the plan
into torques, and MuJoCo steps between. What that one takes and gives is packed into a few flat
arrays, because a call costs by the array. A fall ends the walk: what is missing is held and
marked, never started afresh.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from functools import cache
from itertools import repeat
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Float

from hector_jax.control.controller import (
    Memory,
    Plan,
    Retune,
    WalkConfig,
    contacts_needed,
    init_memory,
)
from hector_jax.control.reference import anchor_at, standing_anchor
from hector_jax.core.arrays import Array
from hector_jax.core.headless import mujoco
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import Layout, layout, pack, stack, unpack
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot, quiet_mujoco
from hector_jax.sim import loop, sensing
from hector_jax.sim.actuators import init_actuators
from hector_jax.sim.changes import worlds_by_step
from hector_jax.sim.loop import Job, Sample, first_tick, substeps
from hector_jax.sim.sensing import Contacts
from hector_jax.sim.world import World, build_world, push_force, standing_qpos


@cache
def _programs(config: WalkConfig) -> SimpleNamespace:
    """The compiled parts of the loop."""
    count = substeps(config)

    def begin(robot: Robot, reading: Array) -> Memory:
        still = jnp.zeros(()), sensing.no_error(robot)
        return init_memory(robot, loop.measure(robot, reading, *still))

    def plan(*inputs: Any, max_contacts: int) -> tuple[Memory, Plan, Array]:
        memory, plan = loop.plan_tick(config, *inputs, max_contacts=max_contacts)
        return memory, plan, pack((memory, plan))

    def samples(robot, command, anchor, tick, yaw, readings, contacts, place) -> Sample:
        def one(time: Array, before: Array, after: Array, contacts: Contacts) -> Sample:
            effect, touches = loop.contact_wrench(robot, before, contacts, *place)
            truth = robot, command, anchor, time, yaw, after
            return loop.sample(config, *truth, effect=effect, touches=touches)

        times = tick + (1 + jnp.arange(count)) / count
        return jax.vmap(one)(times, readings[:-1], readings[1:], contacts)

    return SimpleNamespace(
        begin=jax.jit(begin),
        measure=jax.jit(loop.measure),
        plan=jax.jit(plan, static_argnames="max_contacts"),
        samples=jax.jit(samples),
    )


@cache
def _torques(config: WalkConfig, *layouts: Layout) -> Callable[..., Array]:
    """The compiled torques of a millisecond, from packed trees to the next state, packed.

    XLA runs a kernel for each of a hundred operations and shares them out to its threads, which
    takes several times as long as they do: a call with this mark is compiled into one. Where that
    fails, as an operation has code in a kernel of its own only, they are compiled as ever.
    """

    def torques(*packed: Array) -> Array:
        fixed, held, (_, yaw, motors), millisecond = map(unpack, layouts, packed)
        inputs: Any = *fixed, *held, motors, yaw, *millisecond
        motors, yaw, torque = loop.motor_torques(config, *inputs)
        return pack((torque, yaw, motors))

    def marked(*packed: Array) -> Array:
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return jax.jit(torques)(*packed)

    shapes = [jax.eval_shape(pack, leaves) for _, leaves in layouts]
    if jax.default_backend() == "cpu":
        with suppress(jax.errors.JaxRuntimeError):
            return jax.jit(marked, compiler_options=_LOOPS).lower(*shapes).compile()
    return jax.jit(torques).lower(*shapes).compile()


_LOOPS = {"xla_cpu_experimental_ynn_fusion_type": ""}  # products are loops, not calls of a library
_push_forces = jax.jit(jax.vmap(push_force, in_axes=(None, 0)))


class _Plant:
    """MuJoCo C over the milliseconds of a tick: torques in, readings and contacts out."""

    def __init__(self, config: WalkConfig, robot: Robot, job: Job, first: int, end: int) -> None:
        """Stand at the origin; `first` and `end` are milliseconds after t = 0."""
        count = substeps(config)
        body = job.body(robot)
        world = self.world = build_world(job.imperfections, body.description)
        self.data = mujoco.MjData(world.model)
        self.data.qpos[:] = standing_qpos(world, body.standing_joints, float(body.trunk_height))
        self.contacts = sensing.empty_contacts(count)
        self._first, self._where = first, sensing.coordinates(world)
        self._worlds = worlds_by_step(world, job.changes, first, end)
        self._forces = np.asarray(_push_forces(job.push, np.arange(first, end)))
        # views, which stay: each look-up in MjData costs half a microsecond
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._push = self.data.xfrc_applied[world.trunk, :3]
        self._flat = np.zeros(len(self._qpos) + len(self._qvel) + 1)
        self.readings = np.zeros((count + 1, len(self._where)))
        self._read(0)

    def _read(self, row: int) -> None:
        split = len(self._qpos)
        self._flat[:split], self._flat[split:-1] = self._qpos, self._qvel
        self._flat.take(self._where, out=self.readings[row], mode="clip")

    def step(self, number: int, substep: int, torque: Float[np.ndarray, " joints"]) -> None:
        """Millisecond `number` of the walk, which is `substep` of its tick."""
        self.world = world = self._worlds.get(self._first + number, self.world)
        self._ctrl[world.actuator] = torque
        self._push[:] = self._forces[number]
        mujoco.mj_step(world.model, self.data)
        self._read(substep + 1)
        sensing.read_contacts(world, self.data, self.contacts, substep)

    @property
    def broken(self) -> bool:
        """MuJoCo warned: what follows means nothing."""
        return bool(self.data.warning.number.any())


@quiet_mujoco()
def walk(
    config: WalkConfig,
    robot: Robot,
    job: Job,
    *,
    on_sample: Callable[[World, mujoco.MjData], None] | None = None,
    retune: Retune | None = None,
) -> Trajectory:
    """Walk once in MuJoCo C.

    Args:
        config: the controller.
        robot: its nominal body; the plant is its MJCF, or that of the job.
        job: what to walk.
        on_sample: called after each millisecond, start-up included, with the world of that moment.
        retune: gives the weights to plan with at each tick from t = 0 on, instead of the job's.

    Returns:
        Samples of 1 ms from t = 0 (numpy). After a fall they are held and `fallen`.

    Raises:
        InputError: the plant's file or numbers are wrong, or the length is no positive
            number of ticks.
    """
    count = substeps(config)
    length = loop.walk_ticks(config, job.seconds, job.start_tick) * count
    lead = (job.start_tick - first_tick(config)) * count
    plant = _Plant(config, robot, job, -lead, length)
    ticks = list(_walk_ticks(config, robot, job, plant, length // count, on_sample, retune))
    plans, samples = zip(*ticks, strict=True)
    return _trajectory(plans, samples, count, lead, length, plant.broken)


def _walk_ticks(
    config: WalkConfig,
    robot: Robot,
    job: Job,
    plant: _Plant,
    ticks: int,
    on_sample: Callable[[World, mujoco.MjData], None] | None,
    retune: Retune | None,
) -> Iterator[tuple[Plan, Sample]]:
    """Plan and samples of each tick, until t = `ticks` or a fall."""
    programs, count, begin = _programs(config), substeps(config), first_tick(config)
    start, steps = job.start_tick, (job.start_tick - begin + ticks) * count
    body, weights, command, imperfections = jax.device_put((robot, *job[:3]))
    place = jax.device_put((np.array(plant.world.floor), plant.world.foot_of_geom))
    joints, lead = len(robot.joint_lower), steps - ticks * count
    errors = sensing.draw_errors(job.imperfections.estimator, joints, job.seed, lead, ticks * count)
    anchor = jax.device_put(standing_anchor(robot, start))
    fixed = body, config.parameters(weights).legs, imperfections
    memory, yaw = programs.begin(body, plant.readings[0]), np.zeros(())
    state = np.zeros(joints), yaw, init_actuators(joints)
    constants, packed = pack(fixed), pack(state)
    millisecond = np.array(0, np.int32), plant.readings[0], errors[0]
    rows = np.zeros((count, pack(millisecond).size))
    rows[:, 0] = np.arange(count)
    carry = None if retune is None else retune.init
    torques = plan = samples = None
    for tick in range(begin, start + ticks):
        if tick == start:
            assert samples is not None  # `walk_ticks` refuses a walk that begins at t = 0
            last = jax.tree.map(lambda x: x[-1], samples.state)
            anchor = jax.device_put(anchor_at(robot, last, start))
        done = (tick - begin) * count
        error, yaw_before, now = errors[done : done + count], yaw, np.array(tick, np.int32)
        inputs = yaw, plant.readings[0], error[0]
        if retune is not None and plan is not None and tick >= start:
            measurement = programs.measure(body, inputs[1], yaw, error[0])
            carry, weights = retune.step(carry, tick, anchor, measurement, plan.wrench)
            weights = jax.device_put(weights)
        max_contacts = contacts_needed(config, tick)
        memory, plan, held = programs.plan(
            body, weights, command, anchor, now, memory, *inputs, max_contacts=max_contacts
        )
        if torques is None:
            torques = _torques(config, *map(layout, (fixed, (memory, plan), state, millisecond)))
        rows[:, -error.shape[1] :] = error
        for i in range(count):
            rows[i, 1 : -error.shape[1]] = plant.readings[i]
            packed = torques(constants, held, packed, rows[i])
            plant.step(done + i, i, np.asarray(packed)[:joints])
            if on_sample is not None:
                on_sample(plant.world, plant.data)
        yaw = np.asarray(packed)[joints]
        truth = now, yaw_before, plant.readings, plant.contacts
        samples = programs.samples(body, command, anchor, *truth, place)
        yield plan, samples
        if np.asarray(samples.fallen).any() or plant.broken:
            return
        plant.readings[0] = plant.readings[-1]


def _trajectory(
    plans: Sequence[Plan],
    samples: Sequence[Sample],
    count: int,
    lead: int,
    length: int,
    broken: bool,
) -> Trajectory:
    """The samples from t = 0 on; the last good one is held from a fall on."""
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), stack(samples))
    fell, good = np.flatnonzero(flat.fallen), len(flat.fallen) - 1
    if len(fell):
        good = max(fell[0] - 1, 0)
    elif broken:  # MuJoCo warned within the last tick and the state does not show it
        good = max(len(flat.fallen) - count - 1, 0)
    wanted = lead + np.arange(length)
    rows = np.minimum(wanted, good)
    plan = jax.tree.map(lambda x: x[rows // count], stack(plans))
    initial = jax.tree.map(lambda x: x[min(lead - 1, good)], flat.state)
    held = jax.tree.map(lambda x: x[rows], flat)._replace(fallen=wanted > good)
    return loop.as_trajectory(np.array(TIME_STEP), initial, plan, held)


def on_host(job: Job) -> Job:
    """The job with arrays of the host: what a process is sent must not sit on a device."""
    arrays = {name: getattr(job, name) for name in ("weights", "command", "imperfections", "plant")}
    return job._replace(**jax.tree.map(np.asarray, arrays))


def walk_many(
    pool: Executor,
    config: WalkConfig,
    robot: Robot,
    jobs: Sequence[Job],
    *,
    exact: bool = True,
    batch: int = 0,
) -> Iterator[Trajectory]:
    """Walk all jobs in a pool (`runtime.workers`); gives the walks in order, as they come.

    `exact` and `batch` are those of an `Engine`: this one is always exact and compiles no batch.
    """
    sent = map(on_host, jobs)
    yield from pool.map(walk, repeat(config), repeat(jax.tree.map(np.asarray, robot)), sent)
