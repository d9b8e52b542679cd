"""The closed loop in MuJoCo C: one walk, or many on several processes.

Start-up: double stance under the MPC, gait cycles in place, then t = 0, where the reference is
anchored at the true centre of mass and yaw.
Controller and sensing are compiled once per process and serve every walk, whatever its weights,
command and plant: per tick one program plans and one observes, per millisecond one turns the plan
into torques, and MuJoCo steps between. A fall ends the walk: what is missing is held and marked,
never started afresh. The steps of the loop, and how they become a Trajectory, serve MJX too.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cache, partial
from itertools import repeat
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hector_jax.control.reference import Anchor, Command, anchor_at, reference_at, standing_anchor
from hector_jax.control.walking import (
    Measurement,
    Memory,
    Plan,
    Retune,
    WalkConfig,
    actuate,
    init_memory,
    slots_needed,
    step_plan,
)
from hector_jax.control.weights import Weights
from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State, Trajectory, Wrench, has_fallen
from hector_jax.robot.model import Robot, quiet_mujoco
from hector_jax.sim import sensing
from hector_jax.sim.actuators import Motors, init_actuators, step_actuators
from hector_jax.sim.changes import Change, worlds_by_step
from hector_jax.sim.sensing import Contacts, Reading, Touches
from hector_jax.sim.world import (
    NO_PUSH,
    TIME_STEP,
    Imperfections,
    Push,
    World,
    build_world,
    push_force,
    standing_qpos,
)


class Job(NamedTuple):
    """One walk to be walked."""

    weights: Weights
    command: Command
    imperfections: Imperfections
    seconds: float = 4.0  # from t = 0
    seed: int = 0  # of the estimator's errors
    start_tick: int = 0  # gait tick of t = 0: the phase at which the command starts
    push: Push = NO_PUSH
    changes: tuple[Change, ...] = ()  # of the plant


class Observed(NamedTuple):
    """What a sample turned out to be; see Trajectory."""

    state: State
    reference: State
    effect: Wrench
    feet: Float[Array, "*batch 2 3"]
    joints: Float[Array, "*batch 10"]
    fallen: Bool[Array, "*batch"]
    legs_touch: Bool[Array, "*batch"]


def decide(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    tick: Int[Array, ""],
    memory: Memory,
    yaw: Float[Array, ""],
    reading: Reading,
    error: Float[Array, "22"],
    *,
    slots: int,
) -> tuple[Memory, Plan]:
    """The controller's plan from what it is told; once a tick."""
    measurement, _ = sensing.measure(robot, reading, yaw, error)
    return step_plan(
        config, robot, weights, command, anchor, tick, memory, measurement, slots=slots
    )


def drive(
    config: WalkConfig,
    robot: Robot,
    imperfections: Imperfections,
    memory: Memory,
    plan: Plan,
    motors: Motors,
    yaw: Float[Array, ""],
    substep: Int[Array, ""],
    reading: Reading,
    error: Float[Array, "22"],
) -> tuple[Motors, Float[Array, ""], Float[Array, "10"]]:
    """Motors, true yaw [rad] and the torque at the joints [N m] over the next millisecond."""
    measurement, yaw = sensing.measure(robot, reading, yaw, error)
    torque = actuate(config, robot, plan, memory, substep, measurement)
    motors, applied = step_actuators(robot, imperfections, motors, torque)
    return motors, yaw, applied


def feel(
    robot: Robot,
    before: Reading,
    contacts: Contacts,
    floor: Int[Array, ""],
    foot_of_geom: Int[Array, " ngeom"],
) -> tuple[Wrench, Touches]:
    """The ground's wrench over a millisecond, and what touches beside the feet and the floor.

    Args:
        robot: nominal body.
        before: coordinates at its start.
        contacts: found at its start; their forces act over it.
        floor: from the World.
        foot_of_geom: from the World.
    """
    foot, touches = sensing.foot_contacts(contacts, floor, foot_of_geom)
    return sensing.ground_wrench(contacts, foot, floor, sensing.foot_points(robot, before)), touches


def observe(
    config: WalkConfig,
    robot: Robot,
    command: Command,
    anchor: Anchor,
    time: Float[Array, ""],
    yaw: Float[Array, ""],
    after: Reading,
    effect: Wrench,
    touches: Touches,
) -> Observed:
    """The truth about one sample.

    Args:
        config: times.
        robot: nominal body.
        command: what is walked.
        anchor: from where.
        time: gait time at its end, in ticks.
        yaw: a yaw [rad] shortly before.
        after: coordinates at its end.
        effect: mean wrench of the ground over it.
        touches: what touched in it, feet on the floor apart.
    """
    state = sensing.base_state(robot, after, yaw)
    return Observed(
        state=state,
        reference=reference_at(config.gait.tick, command, anchor, time),
        effect=effect,
        feet=sensing.foot_points(robot, after),
        joints=after.joints + after.slack,
        fallen=has_fallen(state, *robot.description.limits) | touches.floor,
        legs_touch=touches.legs,
    )


def as_trajectory(
    period: Float[Array | np.ndarray, ""], initial: State, plan: Plan, seen: Observed
) -> Trajectory:
    """The walk of these samples, each with the plan in force."""
    return Trajectory(
        period=period,
        initial=initial,
        state=seen.state,
        reference=seen.reference,
        command=plan.wrench,
        effect=seen.effect,
        contact=plan.contact,
        feet=seen.feet,
        joints=seen.joints,
        fallen=seen.fallen,
        legs_touch=seen.legs_touch,
        residual=plan.residual,
    )


def substeps(config: WalkConfig) -> int:
    """Milliseconds in a tick.

    Raises:
        InputError: a tick is no whole number of milliseconds.
    """
    count = round(config.gait.tick / TIME_STEP)
    if count < 1 or abs(count * TIME_STEP - config.gait.tick) > 1e-9:
        raise InputError(
            f"GaitConfig.tick must be a multiple of {TIME_STEP} s, got {config.gait.tick}"
        )
    return count


def first_tick(config: WalkConfig) -> int:
    """Tick at which a walk in MuJoCo begins, standing."""
    return config.gait.first_tick - config.gait.stand


def walk_ticks(config: WalkConfig, seconds: float, start_tick: int) -> int:
    """Ticks of a walk from t = 0 on.

    Raises:
        InputError: there are none, or t = 0 is not after the walk's first tick.
    """
    ticks = round(seconds / config.gait.tick)
    if ticks < 1:
        raise InputError(f"a walk needs at least one tick of {config.gait.tick} s, got {seconds} s")
    if start_tick <= first_tick(config):
        raise InputError(
            f"a walk stands from tick {first_tick(config)} on; start_tick {start_tick} is not later"
        )
    return ticks


@dataclass(frozen=True)
class _Programs:
    """The compiled parts of the loop; readings and their errors enter as flat rows."""

    begin: Callable
    tell: Callable
    decide: dict[int, Callable]  # by slots
    drive: Callable
    observe: Callable


@cache
def _programs(config: WalkConfig) -> _Programs:
    def begin(robot: Robot, row: Array) -> Memory:
        reading = sensing.unpack_reading(row)
        no_error = jnp.zeros(sensing.ERRORS)
        return init_memory(robot, sensing.measure(robot, reading, jnp.zeros(()), no_error)[0])

    def tell(robot: Robot, yaw: Array, row: Array, error: Array) -> Measurement:
        return sensing.measure(robot, sensing.unpack_reading(row), yaw, error)[0]

    def decide_(slots, robot, weights, command, anchor, tick, memory, yaw, row, error):
        reading = sensing.unpack_reading(row)
        known = (config, robot, weights, command, anchor, tick, memory, yaw)
        return decide(*known, reading, error, slots=slots)

    def drive_(robot, plant, memory, plan, motors, yaw, substep, row, error):
        reading = sensing.unpack_reading(row)
        return drive(config, robot, plant, memory, plan, motors, yaw, substep, reading, error)

    def observe_(robot, command, anchor, tick, yaw, rows, contacts, floor, foot_of_geom):
        count = substeps(config)

        def one(time: Array, before: Array, after: Array, contacts: Contacts) -> Observed:
            felt = feel(robot, sensing.unpack_reading(before), contacts, floor, foot_of_geom)
            reading = sensing.unpack_reading(after)
            return observe(config, robot, command, anchor, time, yaw, reading, *felt)

        times = tick + (1 + jnp.arange(count)) / count
        return jax.vmap(one)(times, rows[:-1], rows[1:], contacts)

    return _Programs(
        begin=jax.jit(begin),
        tell=jax.jit(tell),
        decide={slots: jax.jit(partial(decide_, slots)) for slots in (1, 2)},
        drive=jax.jit(drive_),
        observe=jax.jit(observe_),
    )


@quiet_mujoco()
def walk(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    imperfections: Imperfections,
    seconds: float = 4.0,
    seed: int = 0,
    start_tick: int = 0,
    push: Push = NO_PUSH,
    changes: Sequence[Change] = (),
    on_sample: Callable[[World, mujoco.MjData], None] | None = None,
    retune: Retune | None = None,
) -> Trajectory:
    """Walk once in MuJoCo C.

    Args:
        config: the controller.
        robot: its nominal body; the plant is its MJCF.
        weights: of the MPC.
        command: what to walk.
        imperfections: the plant.
        seconds: length from t = 0, start-up apart.
        seed: of the estimator's errors.
        start_tick: gait tick of t = 0, for other start phases.
        push: on the trunk.
        changes: of the plant, while it is walked on.
        on_sample: called after each millisecond, start-up included, with the world of that moment.
        retune: gives the weights to plan with at each tick from t = 0 on, instead of `weights`.

    Returns:
        Samples of 1 ms from t = 0 (numpy). After a fall they are held and `fallen`.

    Raises:
        InputError: the plant's file or numbers are wrong, or the length is no positive
            number of ticks.
    """
    count, begin = substeps(config), first_tick(config)
    ticks = walk_ticks(config, seconds, start_tick)
    world = build_world(imperfections, robot.description)
    data = mujoco.MjData(world.model)
    data.qpos[:] = standing_qpos(world, robot.standing_joints, float(robot.trunk_height))

    programs = _programs(config)
    fixed = jax.device_put((robot, weights, command, imperfections))
    device_robot, device_weights, device_command, device_imperfections = fixed
    place = jax.device_put((np.array(world.floor), world.foot_of_geom))
    lead = (start_tick - begin) * count
    worlds = worlds_by_step(world, changes, -lead, ticks * count)
    errors = sensing.draw_errors(imperfections.estimator, seed, lead, ticks * count)
    forces = np.asarray(_push_forces(push, np.arange(-lead, ticks * count)))
    anchor = jax.device_put(standing_anchor(robot, start_tick))
    substep_numbers = [jax.device_put(np.array(i, np.int32)) for i in range(count)]

    rows, where = np.zeros((count + 1, sensing.READING)), sensing.coordinates(world)
    nothing = np.zeros(1)
    np.concatenate([data.qpos, data.qvel, nothing]).take(where, out=rows[0])
    contacts = sensing.empty_contacts(count)
    memory, motors, yaw = programs.begin(device_robot, rows[0]), init_actuators(), jnp.zeros(())
    told: list[tuple[Plan, Observed]] = []
    carry = None if retune is None else retune.init
    for tick in range(begin, start_tick + ticks):
        if tick == start_tick:
            last = jax.tree.map(lambda x: x[-1], told[-1][1].state)
            anchor = jax.device_put(anchor_at(robot, last, start_tick))
        error = errors[(tick - begin) * count :]
        now, yaw_before = np.array(tick, np.int32), yaw
        if retune is not None and tick >= start_tick:
            measurement = programs.tell(device_robot, yaw, rows[0], error[0])
            last = told[-1][0].wrench
            carry, chosen = retune.step(carry, tick, anchor, measurement, last)
            device_weights = jax.device_put(chosen)
        plan_now = programs.decide[slots_needed(config, tick)]
        memory, plan = plan_now(
            device_robot,
            device_weights,
            device_command,
            anchor,
            now,
            memory,
            yaw,
            rows[0],
            error[0],
        )
        for i in range(count):
            motors, yaw, torque = programs.drive(
                device_robot,
                device_imperfections,
                memory,
                plan,
                motors,
                yaw,
                substep_numbers[i],
                rows[i],
                error[i],
            )
            step = (tick - begin) * count + i
            world = worlds.get(step - lead, world)
            data.ctrl[world.actuator] = torque
            data.xfrc_applied[world.trunk, :3] = forces[step]
            mujoco.mj_step(world.model, data)
            np.concatenate([data.qpos, data.qvel, nothing]).take(where, out=rows[i + 1])
            sensing.read_contacts(world, data, contacts, i)
            if on_sample is not None:
                on_sample(world, data)
        seen = programs.observe(
            device_robot, device_command, anchor, now, yaw_before, rows, contacts, *place
        )
        told.append((plan, seen))
        if np.asarray(seen.fallen).any() or data.warning.number.any():
            break
        rows[0] = rows[-1]
    return _trajectory(told, count, lead, ticks * count, bool(data.warning.number.any()))


_push_forces = jax.jit(jax.vmap(push_force, in_axes=(None, 0)))


def _trajectory(
    told: Sequence[tuple[Plan, Observed]], count: int, lead: int, length: int, broken: bool
) -> Trajectory:
    """The samples from t = 0 on; the last good one is held from a fall on."""
    plans, seen = (
        jax.tree.map(lambda *x: np.stack(x), *trees) for trees in zip(*told, strict=True)
    )
    seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
    fell = np.flatnonzero(seen.fallen)
    good = len(seen.fallen) - 1
    if len(fell):
        good = max(fell[0] - 1, 0)
    elif broken:  # MuJoCo warned within the last tick and the state does not show it
        good = max(len(seen.fallen) - count - 1, 0)
    wanted = lead + np.arange(length)
    held = np.minimum(wanted, good)
    sample = jax.tree.map(lambda x: x[held], seen)
    planned = jax.tree.map(lambda x: x[held // count], plans)
    initial = jax.tree.map(lambda x: x[min(lead - 1, good)], seen.state)
    sample = sample._replace(fallen=wanted > good)
    return as_trajectory(np.array(TIME_STEP), initial, planned, sample)


def walk_job(config: WalkConfig, robot: Robot, job: Job) -> Trajectory:
    """`walk` for a job."""
    return walk(config, robot, *job)


def walk_many(
    pool: Executor,
    config: WalkConfig,
    robot: Robot,
    jobs: Sequence[Job],
) -> Iterator[Trajectory]:
    """Walk all jobs in a pool (`runtime.workers`); gives the walks in order, as they come."""
    host = partial(jax.tree.map, np.asarray)  # what a process is sent must not sit on a device
    sent = [Job(host(w), host(c), host(plant), *rest) for w, c, plant, *rest in jobs]
    yield from pool.map(walk_job, repeat(config), repeat(host(robot)), sent)
