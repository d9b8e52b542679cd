"""The same closed loop in MJX: many walks at once under one jit, for data and for accelerators.

The walks of a batch differ in weights, command, start, push and plant; what differs between the
plants' MuJoCo models becomes batched leaves of one MJX model. All have backlash or none has. A
robot that falls is frozen where it was, its samples are held and marked. The state is known exactly
here.

Physics may run in 32 bits below a controller in 64: the cast stands at the door of `mjx.step`.
Nothing but the feet may touch the floor without ending the walk, so MJX looks for contacts of the
feet and between the legs alone, and whether anything else is in the floor is read off the geoms'
poses.
"""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import Any, NamedTuple

from hector_jax.core.headless import mujoco  # before MJX loads it with OpenGL

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from mujoco import mjx

from hector_jax.control.reference import Anchor, Command, anchor_at, standing_anchor
from hector_jax.control.walking import Memory, Plan, WalkConfig, init_memory
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory, Wrench, has_fallen, zero_wrench
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.actuators import Motors, init_actuators
from hector_jax.sim.sensing import Contacts, Touches
from hector_jax.sim.walk import (
    Job,
    Observed,
    as_trajectory,
    decide,
    drive,
    feel,
    first_tick,
    observe,
    substeps,
    walk_ticks,
)
from hector_jax.sim.world import Imperfections, Push, World, build_worlds, push_force, standing_qpos

# Newton steps and steps of their line search: under vmap every walk takes each of them. MJX's own
# search needs fewer than the C engine's. In 32 bits the fewer move contact forces by 2 mN in the
# median of 4096 walks; with four and six it is 2 N.
STEPS, SINGLE_STEPS = (10, 10), (6, 6)

# On a CPU jaxlib shares a batched Cholesky out to the threads that run the program and waits for
# them; from a batch of 64 on two cores both threads wait for each other (seen in 0.10.2).
CPU_CHUNK, DEVICE_CHUNK = 32, 4096

# Fields of a model that a plant's numbers change.
_VARIED = (
    "body_inertia",
    "body_invweight0",
    "body_ipos",
    "body_mass",
    "body_subtreemass",
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "dof_invweight0",
    "dof_M0",
    "geom_friction",
    "geom_solref",
    "jnt_range",
)


@dataclass(frozen=True)
class _Places:
    """Where the robot's parts are, for the compiler."""

    coordinates: tuple[int, ...]
    actuator: tuple[int, ...]
    foot_of_geom: tuple[int, ...]
    boxes: tuple[int, ...]  # geoms that end the walk when they touch the floor
    capsules: tuple[int, ...]
    floor: int
    trunk: int


class _Asked(NamedTuple):
    """What differs between the walks of a batch."""

    weights: Weights
    command: Command
    plant: Imperfections
    push: Push
    start_tick: Int[Array, "*batch"]
    model: dict[str, Array]


class _Physics(NamedTuple):
    """What MJX carries from one millisecond to the next."""

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    warmstart: Float[Array, " nv"]


class _Carry(NamedTuple):
    """One walk between two milliseconds."""

    memory: Memory
    plan: Plan
    motors: Motors
    anchor: Anchor
    yaw: Float[Array, ""]
    physics: _Physics
    fallen: Bool[Array, ""]
    effect: Wrench  # summed over the sample so far
    legs: Bool[Array, ""]  # touched in the sample so far
    seen: Observed  # the last sample


def batched_model(
    worlds: Sequence[World], single: bool = False
) -> tuple[mjx.Model, dict[str, np.ndarray]]:
    """One MJX model, to be stepped in 32 bits or 64, and the leaves that may differ, stacked.

    Raises:
        ValueError: the models do not have the same joints.
    """
    if len({world.model.nq for world in worlds}) != 1:
        raise ValueError("plants of one batch must all have backlash or none")
    first = copy(worlds[0].model)
    first.opt.iterations, first.opt.ls_iterations = SINGLE_STEPS if single else STEPS
    for geom in _falling(worlds[0]):
        first.geom_contype[geom] &= ~first.geom_conaffinity[worlds[0].floor]
        first.geom_conaffinity[geom] &= ~first.geom_contype[worlds[0].floor]
    varied = {name: np.stack([getattr(w.model, name) for w in worlds]) for name in _VARIED}
    return mjx.put_model(first), varied


def _falling(world: World) -> list[int]:
    """Geoms that collide with the floor and are of no foot."""
    model, floor = world.model, world.floor
    meets = (model.geom_contype[floor] & model.geom_conaffinity) | (
        model.geom_conaffinity[floor] & model.geom_contype
    )
    return [g for g in np.flatnonzero(meets).tolist() if g != floor and world.foot_of_geom[g] < 0]


def _places(world: World) -> _Places:
    kinds = {mujoco.mjtGeom.mjGEOM_BOX: [], mujoco.mjtGeom.mjGEOM_CAPSULE: []}
    for geom in _falling(world):
        kind = mujoco.mjtGeom(world.model.geom_type[geom])
        if kind not in kinds:
            name = world.model.geom(geom).name or f"number {geom}"
            raise InputError(
                f"geom {name} may touch the floor and is a {kind.name.removeprefix('mjGEOM_')}; "
                "in MJX all but feet are expected to be BOX or CAPSULE"
            )
        kinds[kind].append(geom)
    boxes, capsules = (tuple(geoms) for geoms in kinds.values())
    return _Places(
        coordinates=tuple(sensing.coordinates(world).tolist()),
        actuator=tuple(world.actuator.tolist()),
        foot_of_geom=tuple(world.foot_of_geom.tolist()),
        boxes=boxes,
        capsules=capsules,
        floor=world.floor,
        trunk=world.trunk,
    )


def mjx_contacts(data: mjx.Data) -> Contacts:
    """Contacts of the last MJX step; slots whose bodies are apart have geoms -1."""
    found = data._impl.contact
    rows = np.maximum(found.efc_address, 0)[:, None] + np.arange(4)
    edges = data._impl.efc_force[np.minimum(rows, data._impl.efc_force.shape[0] - 1)]
    return Contacts(
        geoms=jnp.where((found.dist < found.includemargin)[:, None], found.geom, -1),
        position=found.pos,
        frame=found.frame,
        pyramid=edges,
        friction=found.friction[:, :2],
    )


def _in_floor(places: _Places, model: mjx.Model, data: mjx.Data) -> Bool[Array, ""]:
    """Whether a part that may not touch the floor does; poses are those of the step's start."""
    boxes, capsules = np.array(places.boxes, int), np.array(places.capsules, int)
    up = data.geom_xmat[:, 2]  # of each geom's axes, their z in the world
    of_box = jnp.abs(up[boxes] * model.geom_size[boxes]).sum(axis=1)
    radius, half = model.geom_size[capsules, 0], model.geom_size[capsules, 1]
    of_capsule = radius + half * jnp.abs(up[capsules, 2])
    both = np.concatenate([boxes, capsules])
    lowest = data.geom_xpos[both, 2] - jnp.concatenate([of_box, of_capsule])
    return (lowest < data.geom_xpos[places.floor, 2]).any()


def _single(tree: Any) -> Any:
    """The same in 32 bits."""
    narrow = {np.dtype(np.float64): np.float32, np.dtype(np.int64): np.int32}
    cast = lambda x: x.astype(narrow[x.dtype]) if x.dtype in narrow else x  # noqa: E731
    return jax.tree.map(cast, tree)


def _where(fallen: Array, held: Any, new: Any) -> Any:
    return jax.tree.map(lambda h, n: jnp.where(fallen, h, n), held, new)


def _walk_one(
    config: WalkConfig,
    places: _Places,
    last_start: int,
    ticks: int,
    fine: bool,
    single: bool,
    robot: Robot,
    model: mjx.Model,
    qpos: Float[Array, " nq"],
    asked: _Asked,
) -> Trajectory:
    count, begin = substeps(config), first_tick(config)
    each = 1 if fine else count  # milliseconds in a sample
    where, actuator = np.array(places.coordinates), np.array(places.actuator)
    floor, foot_of_geom = jnp.asarray(places.floor), jnp.asarray(places.foot_of_geom)
    no_error = jnp.zeros(sensing.ERRORS)
    weights, command, start_tick = asked.weights, asked.command, asked.start_tick
    model = model.replace(**asked.model)
    template = mjx.make_data(model)
    if single:
        model, template = _single((model, template))

    def read(physics: _Physics) -> sensing.Reading:
        flat = jnp.concatenate([physics.qpos, physics.qvel, jnp.zeros(1, physics.qpos.dtype)])
        return sensing.unpack_reading(flat[where].astype(qpos.dtype))

    def step(physics: _Physics, torque: Array, force: Array) -> tuple[_Physics, mjx.Data]:
        data = template.replace(
            qpos=physics.qpos,
            qvel=physics.qvel,
            qacc_warmstart=physics.warmstart,
            ctrl=template.ctrl.at[actuator].set(torque.astype(template.ctrl.dtype)),
            xfrc_applied=template.xfrc_applied.at[places.trunk, :3].set(
                force.astype(template.ctrl.dtype)
            ),
        )
        with jax.enable_x64(not single and jax.config.read("jax_enable_x64")):
            data = mjx.step(model, data)
        return _Physics(data.qpos, data.qvel, data.qacc_warmstart), data

    def millisecond(carry: _Carry, when: tuple[Array, Array]) -> tuple[_Carry, None]:
        tick, substep = when
        before = read(carry.physics)
        motors, yaw, torque = drive(
            config,
            robot,
            asked.plant,
            carry.memory,
            carry.plan,
            carry.motors,
            carry.yaw,
            substep,
            before,
            no_error,
        )
        force = push_force(asked.push, (tick - start_tick) * count + substep)
        physics, data = step(carry.physics, torque, force)
        wide = lambda x: x.astype(qpos.dtype) if x.dtype == data.qpos.dtype else x  # noqa: E731
        contacts = jax.tree.map(wide, mjx_contacts(data))
        effect, touches = feel(robot, before, contacts, floor, foot_of_geom)
        state = sensing.base_state(robot, read(physics), yaw)
        down = has_fallen(state, *robot.description.limits)
        fallen = carry.fallen | down | touches.floor | _in_floor(places, model, data)
        held = _where(fallen, (carry.physics, carry.motors, carry.yaw), (physics, motors, yaw))
        return carry._replace(
            physics=held[0],
            motors=held[1],
            yaw=held[2],
            fallen=fallen,
            effect=jax.tree.map(jnp.add, carry.effect, effect),
            legs=carry.legs | touches.legs,
        ), None

    def sample(carry: _Carry, when: tuple[Array, Array]) -> tuple[_Carry, Observed]:
        carry = carry._replace(effect=zero_wrench(), legs=never)
        carry, _ = jax.lax.scan(millisecond, carry, when)
        seen = observe(
            config,
            robot,
            command,
            carry.anchor,
            when[0][-1] + (when[1][-1] + 1) / count,
            carry.yaw,
            read(carry.physics),
            jax.tree.map(lambda w: w / each, carry.effect),
            Touches(carry.fallen, carry.legs),
        )
        carry = carry._replace(seen=_where(carry.fallen, carry.seen, seen))
        return carry, carry.seen._replace(fallen=carry.fallen)

    def one_tick(carry: _Carry, tick: Array) -> tuple[_Carry, tuple[Plan, Observed]]:
        anchor = anchor_at(robot, carry.seen.state, start_tick)
        carry = carry._replace(anchor=_where(tick == start_tick, anchor, carry.anchor))
        known = (carry.anchor, tick, carry.memory, carry.yaw, read(carry.physics))
        plan_with = lambda slots: partial(decide, config, robot, weights, command, slots=slots)  # noqa: E731
        if config.gait.double_support:
            memory, plan = plan_with(2)(*known, no_error)
        else:
            stands = tick < config.gait.first_tick
            memory, plan = jax.lax.cond(stands, plan_with(2), plan_with(1), *known, no_error)
        planned = carry._replace(memory=memory, plan=plan)
        carry = _where(carry.fallen, carry, planned)
        when = (jnp.full(count, tick), jnp.arange(count))
        carry, seen = jax.lax.scan(sample, carry, jax.tree.map(lambda x: x.reshape(-1, each), when))
        return carry, (carry.plan, seen)

    anchor = standing_anchor(robot)._replace(tick=start_tick)
    physics = _Physics(qpos, jnp.zeros(model.nv), jnp.zeros(model.nv))
    yaw, never = jnp.zeros(()), jnp.zeros((), bool)
    start = read(physics)
    memory = init_memory(robot, sensing.measure(robot, start, yaw, no_error)[0])
    now, known = jnp.asarray(begin), (memory, yaw, start, no_error)
    shapes = jax.eval_shape(
        lambda: decide(config, robot, weights, command, anchor, now, *known, slots=2)[1]
    )
    plan = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    seen = observe(
        config, robot, command, anchor, 1.0 * now, yaw, start, zero_wrench(), Touches(never, never)
    )
    if single:
        physics = _single(physics)
    carry = _Carry(
        memory, plan, init_actuators(), anchor, yaw, physics, never, zero_wrench(), never, seen
    )
    _, (plans, seen) = jax.lax.scan(one_tick, carry, jnp.arange(begin, last_start + ticks))

    # Each walk's own part, from its t = 0 on.
    lead = (start_tick - begin) * (count // each)
    plans = jax.tree.map(lambda x: jnp.repeat(x, count // each, axis=0), plans)
    seen = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
    initial = jax.tree.map(lambda x: x[lead - 1], seen.state)
    walked = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, lead, ticks * (count // each)), (plans, seen)
    )
    return as_trajectory(jnp.asarray(1e-3 * each), initial, *walked)


@partial(jax.jit, static_argnames=("config", "places", "last_start", "ticks", "fine", "single"))
def _walk_all(config, places, last_start, ticks, fine, single, robot, model, qpos, asked):
    one = partial(_walk_one, config, places, last_start, ticks, fine, single, robot, model, qpos)
    return jax.vmap(one)(asked)


def _stack(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *trees)


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
        robot: its nominal body; the plants are its MJCF.
        jobs: what to walk, all of one length; plants that do not change, without errors of the
            estimator.
        chunk: walks at once, at most; by default 32 on a CPU and 4096 elsewhere.
        fine: samples of 1 ms; by default one per tick, its effect the mean over the tick.
        single: physics in 32 bits; the controller keeps the precision of JAX.

    Returns:
        The walks (numpy) in the order of their jobs, as their chunks are done.

    Raises:
        ValueError: the jobs differ in length, in the pieces of their commands, in the number of
            their pushes or in their joints, have errors of the estimator or changes, or a number
            of one is out of its range; or a geom that may touch the floor has a shape unknown here.
    """
    if chunk is None:
        chunk = CPU_CHUNK if jax.default_backend() == "cpu" else DEVICE_CHUNK
    if chunk < 1:
        raise ValueError(f"a chunk has at least one walk, got {chunk}")
    if not jobs:
        return iter(())
    for name, found in (
        ("seconds", {float(job.seconds) for job in jobs}),
        ("pieces of the command", {len(job.command.duration) for job in jobs}),
        ("pushes", {len(job.push.start) for job in jobs}),
    ):
        if len(found) > 1:
            raise ValueError(f"walks of one batch must agree in {name}, got {sorted(found)}")
    if any(np.any(np.asarray(x)) for job in jobs for x in job.imperfections.estimator):
        raise ValueError("a batch in MJX knows its state exactly: estimator errors must be zero")
    changing = [i for i, job in enumerate(jobs) if job.changes]
    if changing:
        raise ValueError(f"MJX walks plants that do not change: jobs {changing} have changes")
    ticks = [walk_ticks(config, job.seconds, int(job.start_tick)) for job in jobs][0]
    worlds = build_worlds([job.imperfections for job in jobs], robot.description)
    places = _places(worlds[0])
    model, varied = batched_model(worlds, single)
    qpos = jnp.asarray(standing_qpos(worlds[0], robot.standing_joints, float(robot.trunk_height)))
    asked = _Asked(
        weights=_stack([job.weights for job in jobs]),
        command=_stack([job.command for job in jobs]),
        plant=_stack([job.imperfections for job in jobs]),
        push=_stack([job.push for job in jobs]),
        start_tick=np.array([job.start_tick for job in jobs], np.int32),
        model=varied,
    )
    last_start = int(asked.start_tick.max())
    walk = partial(_walk_all, config, places, last_start, ticks, fine, single, robot, model, qpos)
    size = ceil(len(jobs) / ceil(len(jobs) / chunk))  # chunks of one size, the last one filled up

    def walks() -> Iterator[Trajectory]:
        for first in range(0, len(jobs), size):
            rows = np.minimum(np.arange(first, first + size), len(jobs) - 1)
            done = jax.device_get(walk(jax.tree.map(lambda x, rows=rows: x[rows], asked)))
            for i in range(min(size, len(jobs) - first)):
                yield jax.tree.map(lambda x, i=i: x[i], done)

    return walks()
