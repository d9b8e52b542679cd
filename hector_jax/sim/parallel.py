"""The closed loop in MJX: many walks at once under one jit, for data and for accelerators.

The walks of a batch differ in weights, command, start, push and plant; all plants have backlash or
none has. A robot that falls is frozen in its last state, which its samples repeat, marked as
fallen. The state estimate has no errors. Physics may run in 32 bits with a controller in 64: the
cast is at `mjx.step`.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax.control import controller
from hector_jax.control.controller import Memory, Plan, WalkConfig, contacts_needed, init_memory
from hector_jax.control.reference import Anchor, anchor_at, standing_anchor
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory, Wrench, has_fallen, zero_wrench
from hector_jax.core.tree import stack, where
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim import loop, mjx_model, sensing
from hector_jax.sim.actuators import Motors, init_actuators, step_actuators
from hector_jax.sim.loop import Job, Sample, first_tick, substeps
from hector_jax.sim.mjx_model import mjx
from hector_jax.sim.programs import make_room
from hector_jax.sim.sensing import Touches
from hector_jax.sim.world import build_worlds, push_force, standing_qpos

# On a CPU jaxlib distributes a batched Cholesky to the threads that run the program and waits for
# them; from a batch of 64 on two cores both threads wait for each other (observed in 0.10.2).
CPU_CHUNK, DEVICE_CHUNK = 32, 4096


@dataclass(frozen=True)
class _Program:
    """Static settings that the walks of a batch are compiled for."""

    config: WalkConfig
    places: mjx_model.Places
    last_start: int  # latest start tick of the batch
    ticks: int  # from t = 0
    substeps: int  # milliseconds in a tick
    period: int  # milliseconds in a sample
    single: bool  # physics in 32 bits


class _Walk(NamedTuple):
    """Constants of one walk and its plant."""

    robot: Robot
    job: Job  # of arrays
    model: mjx.Model
    data: mjx.Data  # its state is set at each step
    error: Float[Array, " errors"]  # of the state estimate: zero


class _Physics(NamedTuple):
    """State of MJX from one millisecond to the next."""

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    warmstart: Float[Array, " nv"]


class _Carry(NamedTuple):
    """State of one walk between two milliseconds."""

    memory: Memory
    plan: Plan
    motors: Motors
    anchor: Anchor
    yaw: Float[Array, ""]
    physics: _Physics
    fallen: Bool[Array, ""]
    effect: Wrench  # summed over the current sample
    legs: Bool[Array, ""]  # legs touched in the current sample
    last: Sample


def _read(program: _Program, walk: _Walk, physics: _Physics) -> Float[Array, " reading"]:
    """Return the flat reading in the precision of the controller."""
    flat = jnp.concatenate([physics.qpos, physics.qvel, jnp.zeros(1, physics.qpos.dtype)])
    return flat[np.array(program.places.coordinates)].astype(walk.error.dtype)


def _step_physics(
    program: _Program,
    walk: _Walk,
    physics: _Physics,
    *,
    torque: Float[Array, " joints"],
    force: Float[Array, "3"],
) -> tuple[_Physics, mjx.Data]:
    """Step MJX by a millisecond under joint torques [N m] and a force [N] on the trunk."""
    data, places = walk.data, program.places
    torque, force = torque.astype(data.ctrl.dtype), force.astype(data.ctrl.dtype)
    data = data.replace(
        qpos=physics.qpos,
        qvel=physics.qvel,
        qacc_warmstart=physics.warmstart,
        ctrl=torque,
        xfrc_applied=data.xfrc_applied.at[places.trunk, :3].set(force),
    )
    with jax.enable_x64(not program.single and jax.config.read("jax_enable_x64")):
        data = mjx.step(walk.model, data)
    return _Physics(data.qpos, data.qvel, data.qacc_warmstart), data


def _millisecond(
    program: _Program, walk: _Walk, carry: _Carry, clock: tuple[Array, Array]
) -> tuple[_Carry, None]:
    tick, substep = clock
    robot, job, places = walk.robot, walk.job, program.places
    before = _read(program, walk, carry.physics)
    legs = program.config.parameters(job.weights).legs
    measurement, yaw = sensing.measure(robot, before, carry.yaw, walk.error)
    inputs = {"memory": carry.memory, "substep": substep, "measurement": measurement}
    torque = controller.actuate(program.config, robot, legs, plan=carry.plan, **inputs)
    motors, torque = step_actuators(robot, job.imperfections, carry.motors, torque)
    force = push_force(job.push, (tick - job.start_tick) * program.substeps + substep)
    physics, data = _step_physics(program, walk, carry.physics, torque=torque, force=force)
    widen = lambda x: x.astype(before.dtype) if x.dtype == data.qpos.dtype else x  # noqa: E731
    contacts = jax.tree.map(widen, mjx_model.mjx_contacts(data))
    floor, foot_of_geom = jnp.asarray(places.floor), jnp.asarray(places.foot_of_geom)
    ground = sensing.ground_of(contacts, floor, foot_of_geom, len(robot.foot_point))
    points = sensing.foot_points(robot, sensing.unpack_reading(before))
    effect, touches = loop.contact_effect(points, ground), ground.touches
    reading = sensing.unpack_reading(_read(program, walk, physics))
    fell = has_fallen(sensing.base_state(robot, reading, yaw), *robot.description.limits)
    fallen = carry.fallen | fell | touches.floor | mjx_model.in_floor(places, walk.model, data)
    stepped = carry._replace(physics=physics, motors=motors, yaw=yaw)
    return where(fallen, carry, stepped)._replace(
        fallen=fallen,
        effect=jax.tree.map(jnp.add, carry.effect, effect),
        legs=carry.legs | touches.legs,
    ), None


def _sample(
    program: _Program, walk: _Walk, carry: _Carry, clock: tuple[Array, Array]
) -> tuple[_Carry, Sample]:
    no_effect = zero_wrench(len(walk.robot.foot_point))
    carry = carry._replace(effect=no_effect, legs=jnp.zeros((), bool))
    carry, _ = jax.lax.scan(partial(_millisecond, program, walk), carry, clock)
    tick, substep = clock
    time = tick[-1] + (substep[-1] + 1) / program.substeps
    after = _read(program, walk, carry.physics)
    sample = loop.sample(
        program.config,
        walk.robot,
        command=walk.job.command,
        anchor=carry.anchor,
        time=time,
        yaw=carry.yaw,
        after=after,
        feet=sensing.foot_points(walk.robot, sensing.unpack_reading(after)),
        effect=jax.tree.map(lambda w: w / program.period, carry.effect),
        touches=Touches(carry.fallen, carry.legs),
    )
    carry = carry._replace(last=where(carry.fallen, carry.last, sample))
    return carry, carry.last._replace(fallen=carry.fallen)


def _step_plan(program: _Program, walk: _Walk, max_contacts: int) -> Callable[..., Any]:
    parameters = program.config.parameters(walk.job.weights)
    step = partial(
        controller.step_plan, program.config, walk.robot, parameters, max_contacts=max_contacts
    )
    return partial(step, command=walk.job.command)


def _plan(
    program: _Program, walk: _Walk, tick: Int[Array, ""], carry: _Carry, *, max_contacts: int
) -> tuple[Memory, Plan]:
    reading = _read(program, walk, carry.physics)
    measurement, _ = sensing.measure(walk.robot, reading, carry.yaw, walk.error)
    now = {"anchor": carry.anchor, "tick": tick, "memory": carry.memory}
    return _step_plan(program, walk, max_contacts)(measurement=measurement, **now)


def _tick(
    program: _Program, walk: _Walk, carry: _Carry, tick: Int[Array, ""]
) -> tuple[_Carry, tuple[Plan, Sample]]:
    config, start_tick, count = program.config, walk.job.start_tick, program.substeps
    first_step = config.gait.first_tick
    anchor = anchor_at(walk.robot, carry.last.state, start_tick)
    carry = carry._replace(anchor=where(tick == start_tick, anchor, carry.anchor))
    contacts = [contacts_needed(config, t) for t in (first_step - 1, first_step)]
    stand, step = (partial(_plan, program, walk, tick, max_contacts=n) for n in contacts)
    if contacts[0] == contacts[1]:
        memory, plan = stand(carry)
    else:
        memory, plan = jax.lax.cond(tick < first_step, stand, step, carry)
    carry = where(carry.fallen, carry, carry._replace(memory=memory, plan=plan))
    clock = jnp.full(count, tick), jnp.arange(count)
    clock = jax.tree.map(lambda x: x.reshape(-1, program.period), clock)
    carry, samples = jax.lax.scan(partial(_sample, program, walk), carry, clock)
    return carry, (carry.plan, samples)


def _init_carry(program: _Program, walk: _Walk, physics: _Physics) -> _Carry:
    """Return the state of a robot that stands at the walk's first tick, before its first plan."""
    robot, job, config = walk.robot, walk.job, program.config
    yaw, false, tick = jnp.zeros(()), jnp.zeros((), bool), jnp.asarray(first_tick(config))
    reading, effect = _read(program, walk, physics), zero_wrench(len(robot.foot_point))
    anchor = standing_anchor(robot)._replace(tick=job.start_tick)
    measurement, _ = sensing.measure(robot, reading, yaw, walk.error)
    memory = init_memory(robot, measurement)
    now = {"anchor": anchor, "tick": tick, "memory": memory, "measurement": measurement}
    _, shapes = jax.eval_shape(_step_plan(program, walk, len(robot.foot_point)), **now)
    sample = loop.sample(
        config,
        robot,
        command=job.command,
        anchor=anchor,
        time=1.0 * tick,
        yaw=yaw,
        after=reading,
        feet=sensing.foot_points(robot, sensing.unpack_reading(reading)),
        effect=effect,
        touches=Touches(false, false),
    )
    return _Carry(
        memory=memory,
        plan=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes),
        motors=init_actuators(len(robot.joint_lower)),
        anchor=anchor,
        yaw=yaw,
        physics=mjx_model.to_single(physics) if program.single else physics,
        fallen=false,
        effect=effect,
        legs=false,
        last=sample,
    )


def _walk_one(
    program: _Program,
    robot: Robot,
    standing: tuple[mjx.Model, Float[Array, " nq"]],
    batch: tuple[Job, dict[str, Array]],
) -> Trajectory:
    (model, qpos), (job, varied) = standing, batch
    model = model.replace(**varied)
    data = mjx.make_data(model)
    if program.single:
        model, data = mjx_model.to_single((model, data))
    walk = _Walk(robot, job, model, data, error=sensing.no_error(robot))
    carry = _init_carry(program, walk, _Physics(qpos, jnp.zeros(model.nv), jnp.zeros(model.nv)))
    begin, rate = first_tick(program.config), program.substeps // program.period
    ticks = jnp.arange(begin, program.last_start + program.ticks)
    _, (plans, samples) = jax.lax.scan(partial(_tick, program, walk), carry, ticks)

    # The part of this walk from its t = 0 on; `rate` is the number of samples in a tick.
    lead = job.start_tick - begin
    samples = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)
    cut, count = jax.lax.dynamic_slice_in_dim, program.ticks
    plans = jax.tree.map(lambda x: cut(x, lead, count), plans)
    samples = jax.tree.map(lambda x: cut(x, lead * rate - 1, count * rate + 1), samples)
    return loop.as_trajectory(jnp.asarray(TIME_STEP * program.period), plans, samples, rate)


@partial(jax.jit, static_argnames="program")
def _walk_all(program, robot, standing, batch):
    return jax.vmap(partial(_walk_one, program, robot, standing))(batch)


def _check_batch(jobs: Sequence[Job]) -> None:
    if len(lengths := {float(job.seconds) for job in jobs}) > 1:
        raise ValueError(f"walks of one batch must agree in seconds, got {sorted(lengths)}")
    if len({job.plant and job.plant.description for job in jobs}) > 1:
        raise ValueError("walks of one batch must be on plants of one model")
    if any(np.any(np.asarray(x)) for job in jobs for x in job.imperfections.estimator):
        raise InputError(
            "engine mjx knows its state exactly: expected a plant whose estimator errs 0"
        )


def _in_chunks(batch: Any, count: int, chunk: int, walk: Any) -> Iterator[Trajectory]:
    """Yield `count` walks, computed in chunks of one size, the last chunk filled up."""
    size = ceil(count / ceil(count / chunk))
    for first in range(0, count, size):
        rows = np.minimum(np.arange(first, first + size), count - 1)
        walks = jax.device_get(walk(jax.tree.map(lambda x, rows=rows: x[rows], batch)))
        for i in range(min(size, count - first)):
            yield jax.tree.map(lambda x, i=i: x[i], walks)


def walk_batch(
    config: WalkConfig,
    robot: Robot,
    jobs: Sequence[Job],
    *,
    chunk: int | None = None,
    fine: bool = False,
    single: bool = False,
) -> Iterator[Trajectory]:
    """Walk jobs in MJX, a chunk of them at once.

    Args:
        config: the controller.
        robot: its nominal robot; the plants are its MJCF, or that of the jobs.
        jobs: walks of one length, on plants without errors of the estimator.
        chunk: walks at once, at most; by default 32 on a CPU and 4096 elsewhere.
        fine: samples of 1 ms; by default one per tick, its effect the mean over the tick.
        single: physics in 32 bits; the controller keeps the precision of JAX.

    Returns:
        The walks (numpy) in the order of their jobs, as their chunks are done.

    Raises:
        InputError: the joints of the jobs' plant are not those of the robot, or a plant has
            errors of the estimator.
        ValueError: the jobs differ in their plant's model, in length, in the pieces of their
            commands, in the number of their pushes or in their joints, or a number of a plant is
            out of its range; or a geom that may touch the floor has an unsupported shape.
    """
    if chunk is None:
        chunk = CPU_CHUNK if jax.default_backend() == "cpu" else DEVICE_CHUNK
    if chunk < 1:
        raise ValueError(f"a chunk has at least one walk, got {chunk}")
    if not jobs:
        return iter(())
    _check_batch(jobs)
    make_room(robot.description)
    ticks = [loop.walk_ticks(config, job.seconds, int(job.start_tick)) for job in jobs][0]
    body = jobs[0].body(robot)
    worlds = build_worlds([job.imperfections for job in jobs], body.description)
    model, varied = mjx_model.batched_model(worlds, single)
    qpos = jnp.asarray(standing_qpos(worlds[0], body.standing_joints, float(body.trunk_height)))
    others = {name for job in jobs for name in job.weights.others}

    def as_arrays(job: Job) -> Job:
        weights, start = config.with_others(job.weights, others), np.int32(job.start_tick)
        return job._replace(weights=weights, start_tick=start, plant=None)

    places, last_start = mjx_model.find_places(worlds[0]), max(int(job.start_tick) for job in jobs)
    count = substeps(config)
    program = _Program(config, places, last_start, ticks, count, 1 if fine else count, single)
    batch = stack([as_arrays(job) for job in jobs]), varied
    return _in_chunks(batch, len(jobs), chunk, partial(_walk_all, program, robot, (model, qpos)))
