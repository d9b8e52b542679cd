"""The closed loop in an engine that steps one plant: one walk, or many on several processes.

Controller and sensing are compiled once per process and serve every walk, whatever its weights,
command, plant and engine: per tick one program plans and one samples, per millisecond one turns the
plan into torques, and the engine steps in between. Inputs and outputs of the torques are packed
into a few flat arrays, because the cost of a call grows with their number. A fall ends the walk:
later samples repeat the last valid one and are marked as fallen.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from functools import cache, partial
from itertools import repeat
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata

from hector_jax.control.controller import (
    Memory,
    Plan,
    Retune,
    WalkConfig,
    contacts_needed,
    init_memory,
)
from hector_jax.control.parameters import Parameters
from hector_jax.control.reference import anchor_at, standing_anchor, with_pieces
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import Layout, layout, pack, stack, unpack
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot, quiet_mujoco
from hector_jax.sim import loop, sensing
from hector_jax.sim.actuators import init_actuators
from hector_jax.sim.loop import Job, Sample, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.plant import BuildPlant, Plant
from hector_jax.sim.sensing import Ground
from hector_jax.sim.world import push_force


@cache
def _programs(config: WalkConfig) -> SimpleNamespace:
    """The compiled parts of the loop."""
    count = substeps(config)

    def begin(robot: Robot, reading: Array) -> Memory:
        measurement = loop.measure(robot, reading, jnp.zeros(()), sensing.no_error(robot))
        return init_memory(robot, measurement)

    def plan(*inputs: Any, max_contacts: int) -> tuple[Memory, Plan, Array]:
        memory, plan = loop.plan_tick(config, *inputs, max_contacts=max_contacts)
        return memory, plan, pack((memory, plan))

    def samples(robot, command, anchor, tick, yaw, readings, contacts, *, ground_of) -> Sample:
        def sample(time: Array, before: Array, after: Array, ground: Ground) -> Sample:
            effect = loop.effect_of(robot, before, ground)
            inputs = robot, command, anchor, time, yaw, after
            return loop.sample(config, *inputs, effect=effect, touches=ground.touches)

        times = tick + (1 + jnp.arange(count)) / count
        return jax.vmap(sample)(times, readings[:-1], readings[1:], ground_of(robot, contacts))

    return SimpleNamespace(
        begin=jax.jit(begin),
        measure=jax.jit(loop.measure),
        plan=jax.jit(plan, static_argnames="max_contacts"),
        samples=jax.jit(samples, static_argnames="ground_of"),
    )


@cache
def _torques(config: WalkConfig, *layouts: Layout) -> Callable[..., Array]:
    """Compile the torques of a millisecond, from packed trees to the next state, packed.

    XLA runs a kernel for each of a hundred operations and distributes them to its threads, which
    takes several times as long as the operations: a call marked as small is compiled into one
    kernel. If that fails, because an operation exists only as a kernel of its own, the call is
    compiled as usual.
    """

    def torques(*packed: Array) -> Array:
        constants, tick, (_, yaw, motors), millisecond = map(unpack, layouts, packed)
        inputs: Any = *constants, *tick, motors, yaw, *millisecond
        motors, yaw, torque = loop.motor_torques(config, *inputs)
        return pack((torque, yaw, motors))

    def small_call(*packed: Array) -> Array:
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return jax.jit(torques)(*packed)

    shapes = [jax.eval_shape(pack, leaves) for _, leaves in layouts]
    if jax.default_backend() == "cpu":
        with suppress(jax.errors.JaxRuntimeError):
            return jax.jit(small_call, compiler_options=_LOOPS).lower(*shapes).compile()
    return jax.jit(torques).lower(*shapes).compile()


_LOOPS = {"xla_cpu_experimental_ynn_fusion_type": ""}  # products are loops, not library calls
_push_forces = jax.jit(jax.vmap(push_force, in_axes=(None, 0)))


def _parameters(config: WalkConfig, weights: Weights) -> Parameters:
    """Return the controller's numbers as arrays: one compiled plan then serves all weights."""
    numbers = jax.tree.map(partial(np.asarray, dtype=float), config.parameters(weights))
    return jax.device_put(numbers)


@quiet_mujoco()
def walk(
    config: WalkConfig,
    robot: Robot,
    job: Job,
    *,
    build: BuildPlant = MujocoPlant,
    retune: Retune | None = None,
) -> Trajectory:
    """Walk once, by default in MuJoCo C.

    Args:
        config: the controller.
        robot: its nominal robot; the plant is its MJCF, or that of the job.
        job: the walk.
        build: builds the plant in an engine.
        retune: returns the weights to plan with at each tick from t = 0 on, instead of the job's.

    Returns:
        Samples of 1 ms from t = 0 (numpy). After a fall they repeat the last valid sample and are
        marked `fallen`.

    Raises:
        InputError: the plant's file or numbers are wrong or not supported by the engine, or the
            length is no positive number of ticks.
    """
    count, ticks = substeps(config), loop.walk_ticks(config, job.seconds, job.start_tick)
    lead, length = (job.start_tick - first_tick(config)) * count, ticks * count
    plant = build(job, job.body(robot), -lead, length)
    plans, samples = zip(*_walk_ticks(config, robot, job, plant, ticks, retune), strict=True)
    return _trajectory(plans, samples, count, lead, length, plant.broken)


def _walk_ticks(
    config: WalkConfig, robot: Robot, job: Job, plant: Plant, ticks: int, retune: Retune | None
) -> Iterator[tuple[Plan, Sample]]:
    """Yield plan and samples of each tick, until t = `ticks` or a fall."""
    programs, count, begin = _programs(config), substeps(config), first_tick(config)
    start, steps = job.start_tick, (job.start_tick - begin + ticks) * count
    command, parameters = with_pieces(job.command), _parameters(config, job.weights)
    body, command, imperfections = jax.device_put((robot, command, job.imperfections))
    joints, lead = len(robot.joint_lower), steps - ticks * count
    forces = np.asarray(_push_forces(job.push, np.arange(-lead, ticks * count)))
    errors = sensing.draw_errors(job.imperfections.estimator, joints, job.seed, lead, ticks * count)
    anchor = jax.device_put(standing_anchor(robot, start))
    constants = body, parameters.legs, imperfections
    readings = np.zeros((count + 1, 13 + 3 * joints))
    plant.read(readings[0])
    memory, yaw = programs.begin(body, readings[0]), np.zeros(())
    state = np.zeros(joints), yaw, init_actuators(joints)
    packed_constants, packed_state = pack(constants), pack(state)
    millisecond = np.array(0, np.int32), readings[0], errors[0]
    rows = np.zeros((count, pack(millisecond).size))
    rows[:, 0] = np.arange(count)
    carry = None if retune is None else retune.init
    torques = plan = samples = None
    for tick in range(begin, start + ticks):
        if tick == start:
            assert samples is not None  # `walk_ticks` refuses a walk that begins at t = 0
            last = jax.tree.map(lambda x: x[-1], samples.state)
            anchor = jax.device_put(anchor_at(robot, last, start))
        step = (tick - begin) * count
        error, yaw_before, tick_array = errors[step : step + count], yaw, np.array(tick, np.int32)
        inputs = tick_array, memory, yaw, readings[0], error[0]
        if retune is not None and plan is not None and tick >= start:
            measurement = programs.measure(body, readings[0], yaw, error[0])
            carry, weights = retune.step(carry, tick, anchor, measurement, plan.wrench)
            parameters = _parameters(config, weights)
        memory, plan, packed_tick = programs.plan(
            body, parameters, command, anchor, *inputs, max_contacts=contacts_needed(config, tick)
        )
        if torques is None:
            trees = constants, (memory, plan), state, millisecond
            torques = _torques(config, *map(layout, trees))
        rows[:, -error.shape[1] :] = error
        for i in range(count):
            rows[i, 1 : -error.shape[1]] = readings[i]
            packed_state = torques(packed_constants, packed_tick, packed_state, rows[i])
            plant.step(np.asarray(packed_state)[:joints], forces[step + i])
            plant.read(readings[i + 1])
        yaw = np.asarray(packed_state)[joints]
        measured = tick_array, yaw_before, readings, plant.ground()
        samples = programs.samples(body, command, anchor, *measured, ground_of=plant.ground_of)
        yield plan, samples
        if np.asarray(samples.fallen).any() or plant.broken:
            return
        readings[0] = readings[-1]


def _trajectory(
    plans: Sequence[Plan],
    samples: Sequence[Sample],
    count: int,
    lead: int,
    length: int,
    broken: bool,
) -> Trajectory:
    """Return the samples from t = 0 on; from a fall on they repeat the last valid one."""
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), stack(samples))
    fell, good = np.flatnonzero(flat.fallen), len(flat.fallen) - 1
    if len(fell):
        good = max(fell[0] - 1, 0)
    elif broken:  # the engine warned within the last tick and the state does not show it
        good = max(len(flat.fallen) - count - 1, 0)
    steps = lead + np.arange(length)
    rows = np.minimum(steps, good)
    plan = jax.tree.map(lambda x: x[rows // count], stack(plans))
    initial = jax.tree.map(lambda x: x[min(lead - 1, good)], flat.state)
    chosen = jax.tree.map(lambda x: x[rows], flat)._replace(fallen=steps > good)
    return loop.as_trajectory(np.array(TIME_STEP), initial, plan, chosen)


def on_host(job: Job) -> Job:
    """Return the job with arrays on the host: arrays on a device cannot be sent to a process."""
    arrays = {name: getattr(job, name) for name in ("weights", "command", "imperfections", "plant")}
    return job._replace(**jax.tree.map(np.asarray, arrays))


def walk_many(
    pool: Executor | None,
    config: WalkConfig,
    robot: Robot,
    jobs: Sequence[Job],
    *,
    exact: bool = True,
    batch: int = 0,
    build: BuildPlant = MujocoPlant,
) -> Iterator[Trajectory]:
    """Walk all jobs in a pool (`runtime.workers`) or this process; yields the walks in order.

    `exact` and `batch` are those of an `Engine`: this one is always exact and compiles no batch.
    """
    map_jobs, walk_in = map if pool is None else pool.map, partial(walk, build=build)
    host_robot = jax.tree.map(np.asarray, robot)
    yield from map_jobs(walk_in, repeat(config), repeat(host_robot), map(on_host, jobs))
