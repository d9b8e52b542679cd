"""The closed loop in an engine that steps one plant: one walk, or many on several processes.

Controller and sensing are compiled once per process and serve every walk, whatever its weights,
command (of up to PIECES pieces), plant and engine: per tick one program plans, per millisecond one
turns the plan into torques and the engine steps, and one program samples ten ticks. Inputs and
outputs are packed into a few flat arrays, because the cost of a call grows with their number. A
fall ends the walk: later samples repeat the last valid one and are marked as fallen.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from functools import cache, partial
from itertools import repeat
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Float

from hector_jax.control import controller
from hector_jax.control.controller import Memory, Plan, WalkConfig
from hector_jax.control.disturbance import NO_DISTURBANCE
from hector_jax.control.parameters import Parameters
from hector_jax.control.reference import Anchor, anchor_at, standing_anchor, with_pieces
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree import Layout, layout, pack, unpack
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot, quiet_mujoco
from hector_jax.sim import loop, sensing
from hector_jax.sim.actuators import init_actuators, step_actuators
from hector_jax.sim.loop import Job, Sample, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.plant import BuildPlant, Plant
from hector_jax.sim.programs import by_robot, make_room
from hector_jax.sim.sensing import Ground
from hector_jax.sim.world import push_force


@jax.jit
def _begin(robot: Robot, reading: Array) -> Memory:
    measurement, _ = sensing.measure(robot, reading, jnp.zeros(()), sensing.no_error(robot))
    return controller.init_memory(robot, measurement)


@jax.jit
def _anchor(robot: Robot, reading: Array, yaw: Array, start_tick: Array) -> Anchor:
    state = sensing.base_state(robot, sensing.unpack_reading(reading), yaw)
    return anchor_at(robot, state, start_tick)


@by_robot
def _sampler(config: WalkConfig, constants: Layout, inputs: Layout) -> Callable[..., Sample]:
    """Compile the samples of a block of ticks.

    The program takes the packed constants and inputs of the plans, the readings of all milliseconds
    from the start of the block on, and what the ground does in each.
    """
    count = substeps(config)

    def samples(packed: Array, plans: Array, readings: Array, ground: Ground) -> Sample:
        robot, _, command, _ = unpack(constants, packed)
        anchors, ticks, _, yaws, *_ = unpack(inputs, plans)
        times = (ticks[:, None] + (1 + jnp.arange(count)) / count).ravel()
        anchors, yaws = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), (anchors, yaws))

        def sample(start: tuple[Anchor, Array, Array], after, points, ground: Ground) -> Sample:
            anchor, time, yaw = start
            return loop.sample(
                config,
                robot,
                command=command,
                anchor=anchor,
                time=time,
                yaw=yaw,
                after=after,
                feet=points[1],
                effect=loop.contact_effect(points[0], ground),
                touches=ground.touches,
            )

        feet = jax.vmap(lambda row: sensing.foot_points(robot, sensing.unpack_reading(row)))
        points = feet(readings)
        points = jnp.stack([points[:-1], points[1:]], axis=1)  # at start and end of a millisecond
        return jax.vmap(sample)((anchors, times, yaws), readings[1:], points, ground)

    return jax.jit(samples)


# On a CPU every call of a program sets up memory for each of its reductions, which takes longer
# than a short one itself. For one of more than 32 numbers XLA would make two.
_ONE_REDUCTION = {"xla_disable_hlo_passes": "tree_reduction_rewriter"}


class _Planner:
    """The compiled plan of a tick, from packed trees to the packed memory and plan."""

    layout: Layout  # of memory and plan, known after the first call

    def __init__(
        self, config: WalkConfig, constants: Layout, inputs: Layout, max_contacts: int
    ) -> None:
        def plan(*packed: Array) -> Array:
            robot, parameters, command, _ = unpack(constants, packed[0])
            anchor, tick, memory, yaw, reading, error = unpack(inputs, packed[1])
            measurement, _ = sensing.measure(robot, reading, yaw, error)
            now = {"anchor": anchor, "tick": tick, "memory": memory, "measurement": measurement}
            step = partial(
                controller.step_plan, config, robot, parameters, max_contacts=max_contacts
            )
            result = step(command=command, **now)
            self.layout = layout(result)
            return pack(result)

        options = _ONE_REDUCTION if jax.default_backend() == "cpu" else {}
        self.plan = jax.jit(plan, compiler_options=options)


_planner = by_robot(_Planner)


@by_robot
def _torques(config: WalkConfig, *layouts: Layout) -> Callable[..., Array]:
    """Compile the torques of a millisecond, from packed trees to the next state, packed.

    XLA runs a kernel for each of a hundred operations and distributes them to its threads, which
    takes several times as long as the operations: a call marked as small is compiled into one
    kernel. If that fails, because an operation exists only as a kernel of its own (products have
    one unless `setup_jax` has turned off YNNPACK), the call is compiled as usual.
    """

    def torques(*packed: Array) -> Array:
        constants, (memory, plan), (_, yaw, motors), now = map(unpack, layouts, packed)
        (robot, parameters, _, imperfections), (substep, reading, error) = constants, now
        measurement, yaw = sensing.measure(robot, reading, yaw, error)
        inputs: Any = {"memory": memory, "substep": substep, "measurement": measurement}
        torque = controller.actuate(config, robot, parameters.legs, plan=plan, **inputs)
        motors, torque = step_actuators(robot, imperfections, motors, torque)
        return pack((torque, yaw, motors))

    def small_call(*packed: Array) -> Array:
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return jax.jit(torques)(*packed)

    if jax.default_backend() == "cpu":
        compiled = jax.jit(small_call)
        with suppress(jax.errors.JaxRuntimeError):
            compiled(*(np.zeros(sum(leaf.size for leaf in leaves)) for _, leaves in layouts))
            return compiled
    return jax.jit(torques)


BLOCK = 10  # ticks that are sampled by one call, whose cost hardly grows with their number
_pack = jax.jit(pack)
_push_forces = jax.jit(jax.vmap(push_force, in_axes=(None, 0)))


def _parameters(config: WalkConfig, weights: Weights) -> Parameters:
    """Return the controller's numbers as arrays: one compiled plan then serves all weights."""
    return jax.tree.map(partial(np.asarray, dtype=float), config.parameters(weights))


@quiet_mujoco()
def walk(
    config: WalkConfig, robot: Robot, job: Job, *, build: BuildPlant = MujocoPlant
) -> Trajectory:
    """Walk once, by default in MuJoCo C.

    Args:
        config: the controller.
        robot: its nominal robot; the plant is its MJCF, or that of the job.
        job: the walk.
        build: builds the plant in an engine.

    Returns:
        Samples of 1 ms from t = 0 (numpy). After a fall they repeat the last valid sample and are
        marked `fallen`.

    Raises:
        InputError: the plant's file or numbers are wrong or not supported by the engine, or the
            length is no positive number of ticks.
    """
    make_room(robot.description)
    count, ticks = substeps(config), loop.walk_ticks(config, job.seconds, job.start_tick)
    lead, length = (job.start_tick - first_tick(config)) * count, ticks * count
    plant = build(job, job.body(robot), -lead, length)
    plans, flat = _simulate(config, robot, job, plant, ticks=ticks)
    # from a fall on, samples repeat the last valid one
    fell, good = np.flatnonzero(flat.fallen), len(flat.fallen) - 1
    if len(fell):
        good = max(fell[0] - 1, 0)
    elif plant.broken:  # the engine warned within the last tick and the state does not show it
        good = max(len(flat.fallen) - count - 1, 0)
    steps = lead - 1 + np.arange(length + 1)
    rows = np.minimum(steps, good)
    plans = jax.tree.map(lambda x: x[rows[1::count] // count], plans)
    samples = jax.tree.map(lambda x: x[rows], flat)._replace(fallen=steps > good)
    return loop.as_trajectory(np.array(TIME_STEP), plans, samples, count)


def _simulate(
    config: WalkConfig, robot: Robot, job: Job, plant: Plant, *, ticks: int
) -> tuple[Plan, Sample]:
    """Return the plans of all ticks and the samples (numpy), until t = `ticks` or a fall."""
    count, lead = substeps(config), job.start_tick - first_tick(config)
    joints, steps = len(robot.joint_lower), (lead + ticks) * count
    forces = np.asarray(_push_forces(job.push, np.arange(-lead * count, ticks * count)))
    noise = job.imperfections.estimator
    errors = sensing.draw_errors(noise, joints, job.seed, lead * count, ticks * count)
    stepper, step = Stepper(config, robot, job, plant), 0
    plans, samples = [], []
    while step < steps and not (plant.broken or samples and samples[-1].fallen.any()):
        for _ in range(BLOCK if steps - step >= BLOCK * count else 1):
            now, step = slice(step, step + count), step + count
            stepper.tick(errors[now], forces[now])
            if plant.broken:
                break  # rare: the samples of less than a block are another program
        planned, sampled = stepper.samples()
        plans.append(planned)
        samples.append(sampled)
    return joined(plans), joined(samples)


def joined(blocks: Iterable[Any]) -> Any:
    """Concatenate the trees of blocks of a walk."""
    return jax.tree.map(lambda *x: np.concatenate(x), *blocks)


class Stepper:
    """The closed loop of one walk, tick by tick; what it has in `job` may change between ticks.

    Weights change between any two ticks, a command only after `samples`, which are of one command.
    """

    def __init__(self, config: WalkConfig, robot: Robot, job: Job, plant: Plant) -> None:
        """Begin a walk; its plant notes at least BLOCK ticks between calls of `samples`."""
        self.config, self.robot, self.plant = config, robot, plant
        self.count, self.clock = substeps(config), first_tick(config)  # the next gait tick
        joints, self._start, yaw = len(robot.joint_lower), job.start_tick, np.zeros(())
        size = len(sensing.no_error(robot))
        # inputs of each millisecond of a block: milliseconds since the plan, reading, error
        self._rows = np.zeros((BLOCK * self.count + 1, 1 + 13 + 3 * joints + size))
        self._rows[:, 0] = np.arange(len(self._rows)) % self.count
        self._errors, self._readings = self._rows[:, -size:], self._rows[:, 1:-size]
        plant.read(self._readings[0])
        self._body, self.anchor = jax.device_put(robot), standing_anchor(robot, job.start_tick)
        memory = _begin(self._body, self._readings[0])
        state = np.zeros(joints), yaw, init_actuators(joints)
        measured = self._readings[0], self._errors[0]
        clock = np.int32(0)
        self.set_job(job)
        of_inputs = layout((self.anchor, clock, memory, yaw, *measured))
        self._packed_anchor, self._state, packed = map(_pack, (self.anchor, state, memory))
        self._packed, self._of_memory, self._yaw, self._joints = packed, layout(memory), yaw, joints
        self._memory_size = packed.size
        self._planner_for = cache(partial(_planner, config, self._of_constants, of_inputs))
        self._sampled = _sampler(config, self._of_constants, of_inputs)
        self._torques_of = partial(_torques, config, self._of_constants)
        self._torques, self._layouts = None, (layout(state), layout((clock, *measured)))
        self._inputs: list[np.ndarray] = []
        self._plans: list[np.ndarray] = []

    def set_job(self, job: Job) -> None:
        """Take the weights, command and imperfections of a job, as they are for the motors."""
        command = jax.device_put(with_pieces(job.command))
        numbers = _parameters(self.config, job.weights)
        constants = self._body, numbers, command, job.imperfections
        self._of_constants, self._constants = layout(constants), _pack(constants)

    def forget_disturbance(self) -> None:
        """Empty the memory of the integral action."""
        packed = np.array(self._packed)
        memory = unpack(self._of_memory, packed[: self._memory_size])
        memory = memory._replace(disturbance=NO_DISTURBANCE)
        leaves = [np.ravel(x) for x in jax.tree.leaves(memory)]
        self._packed = np.concatenate([*leaves, packed[self._memory_size :]])

    def set_anchor(self, anchor: Anchor) -> None:
        """Let the reference start elsewhere."""
        self.anchor, self._packed_anchor = anchor, _pack(anchor)

    @property
    def reading(self) -> Float[np.ndarray, " reading"]:
        """The coordinates now, see `sensing.Reading`."""
        return self._readings[len(self._plans) * self.count]

    @property
    def last_plan(self) -> Plan:
        """The plan of the last tick (numpy)."""
        return unpack(self._plan_layout, np.asarray(self._packed))[1]

    def tick(self, errors: Float[np.ndarray, "n errors"], forces: Float[np.ndarray, "n 3"]) -> None:
        """Plan, and step the plant to the next plan.

        Args:
            errors: of the estimate in each of the n milliseconds.
            forces: on the trunk in each of them [N].
        """
        step, plant, rows = len(self._plans) * self.count, self.plant, self._rows
        now = slice(step, step + self.count)
        self._errors[now] = errors
        if self.clock == self._start:
            self.set_anchor(_anchor(self._body, self._readings[step], self._yaw, self._start))
        planner = self._planner_for(controller.contacts_needed(self.config, self.clock))
        memory = np.asarray(self._packed)[: self._memory_size]
        parts = self._packed_anchor, [self.clock], memory, [self._yaw], rows[step, 1:]
        self._inputs.append(np.concatenate(parts))
        self._packed = packed = planner.plan(self._constants, self._inputs[-1])
        self._plans.append(np.asarray(packed))
        if self._torques is None:
            self._plan_layout = planner.layout
            self._torques = self._torques_of(planner.layout, *self._layouts)
        constants, torques, state, joints = (
            self._constants,
            self._torques,
            self._state,
            self._joints,
        )
        after = self._readings[step + 1 : step + self.count + 1]
        for row, force, reading in zip(rows[now], forces, after, strict=True):
            state = torques(constants, packed, state, row)
            plant.step(np.asarray(state)[:joints], force)
            plant.read(reading)
        self._state, self._yaw, self.clock = state, np.asarray(state)[joints], self.clock + 1

    def samples(self) -> tuple[Plan, Sample]:
        """Return the plans and samples (numpy) since the last call, of at least one tick."""
        end = len(self._plans) * self.count
        block, readings = np.stack(self._inputs), self._readings[: end + 1]
        found = self._sampled(self._constants, block, readings, self.plant.ground())
        found = jax.device_get(found)  # before the readings are written over
        plans = unpack(self._plan_layout, np.stack(self._plans))[1]
        self._readings[0], self._inputs, self._plans = self._readings[end], [], []
        return plans, found


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
    """Walk all jobs in a pool (`core.pool.workers`) or this process; yields the walks in order.

    `exact` and `batch` are those of an `Engine`: this one is always exact and compiles no batch.
    """
    map_jobs, walk_in = map if pool is None else pool.map, partial(walk, build=build)
    host_robot = jax.tree.map(np.asarray, robot)
    yield from map_jobs(walk_in, repeat(config), repeat(host_robot), map(on_host, jobs))
