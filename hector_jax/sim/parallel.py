"""The same closed loop in MJX: many walks at once under one jit, for data and for accelerators.

The walks of a batch differ in weights, command and plant; what differs between the plants' MuJoCo
models becomes batched leaves of one MJX model. All have backlash or none has. A robot that falls is
frozen where it was, its samples are held and marked. The state is known exactly here.
"""

import contextlib
import io
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hector_jax.control.reference import Anchor, Command, anchor_at, standing_anchor
from hector_jax.control.walking import Memory, Plan, WalkConfig, init_memory
from hector_jax.control.weights import Weights
from hector_jax.robot import Robot
from hector_jax.sim import sensing
from hector_jax.sim.actuators import Motors, init_actuators
from hector_jax.sim.sensing import Contacts
from hector_jax.sim.walk import (
    Observed,
    decide,
    drive,
    first_tick,
    observe,
    substeps,
)
from hector_jax.sim.world import Imperfections, World, build_worlds, standing_qpos
from hector_jax.trajectory import Trajectory

with contextlib.redirect_stdout(io.StringIO()):  # it announces what it does not find
    from mujoco import mjx


# Under vmap each of these steps is walked by all; MJX's own search needs fewer than the C engine's.
LINE_SEARCH = 10


@dataclass(frozen=True)
class _Places:
    """Where the robot's parts are, for the compiler."""

    coordinates: tuple[int, ...]
    actuator: tuple[int, ...]
    foot_of_geom: tuple[int, ...]
    floor: int


class _Carry(NamedTuple):
    """One walk between two milliseconds."""

    memory: Memory
    plan: Plan
    motors: Motors
    anchor: Anchor
    yaw: Float[Array, ""]
    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    warmstart: Float[Array, " nv"]
    fallen: Bool[Array, ""]
    seen: Observed


def batched_model(worlds: Sequence[World]) -> tuple[mjx.Model, dict[str, Array]]:
    """One MJX model, and the leaves in which the worlds' models differ, stacked.

    Raises:
        ValueError: the models do not have the same joints.
    """
    models = [world.model for world in worlds]
    if len({model.nq for model in models}) != 1:
        raise ValueError("plants of one batch must all have backlash or none")
    first = copy(models[0])
    first.opt.ls_iterations = LINE_SEARCH
    shared = mjx.put_model(first)
    varied = {}
    for name in shared.__dataclass_fields__:
        value = getattr(first, name, None)
        if isinstance(value, np.ndarray) and isinstance(getattr(shared, name), jax.Array):
            values = [getattr(model, name) for model in models]
            if any(not np.array_equal(value, other) for other in values[1:]):
                varied[name] = jnp.stack([jnp.asarray(value) for value in values])
    return shared, varied


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


def _where(fallen: Array, held: Any, new: Any) -> Any:
    return jax.tree.map(lambda h, n: jnp.where(fallen, h, n), held, new)


def _walk_one(
    config: WalkConfig,
    places: _Places,
    ticks: int,
    start_tick: int,
    fine: bool,
    robot: Robot,
    model: mjx.Model,
    qpos: Float[Array, " nq"],
    weights: Weights,
    command: Command,
    imperfections: Imperfections,
) -> Trajectory:
    count, begin = substeps(config), first_tick(config)
    where, actuator = np.array(places.coordinates), np.array(places.actuator)
    floor, foot_of_geom = jnp.asarray(places.floor), jnp.asarray(places.foot_of_geom)
    template, no_error = mjx.make_data(model), jnp.zeros(sensing.ERRORS)

    def read(qpos: Array, qvel: Array) -> sensing.Reading:
        return sensing.unpack_reading(jnp.concatenate([qpos, qvel, jnp.zeros(1)])[where])

    def millisecond(carry: _Carry, when: tuple[Array, Array]) -> tuple[_Carry, Observed]:
        tick, substep = when
        before = read(carry.qpos, carry.qvel)
        motors, yaw, torque = drive(
            config,
            robot,
            imperfections,
            carry.memory,
            carry.plan,
            carry.motors,
            carry.yaw,
            substep,
            before,
            no_error,
        )
        data = template.replace(
            qpos=carry.qpos,
            qvel=carry.qvel,
            qacc_warmstart=carry.warmstart,
            ctrl=jnp.zeros_like(template.ctrl).at[actuator].set(torque),
        )
        data = mjx.step(model, data)
        time = tick + (substep + 1) / count
        seen = observe(
            config,
            robot,
            command,
            carry.anchor,
            time,
            yaw,
            before,
            mjx_contacts(data),
            read(data.qpos, data.qvel),
            floor,
            foot_of_geom,
        )
        fallen = carry.fallen | seen.fallen
        new = carry._replace(
            motors=motors,
            yaw=yaw,
            qpos=data.qpos,
            qvel=data.qvel,
            warmstart=data.qacc_warmstart,
            seen=seen,
        )
        carry = _where(fallen, carry, new)._replace(fallen=fallen)
        return carry, carry.seen._replace(fallen=fallen)

    def one_tick(carry: _Carry, tick: Array) -> tuple[_Carry, tuple[Plan, Observed]]:
        anchor = anchor_at(robot, carry.seen.state, start_tick)
        carry = carry._replace(anchor=_where(tick == start_tick, anchor, carry.anchor))
        known = (carry.anchor, tick, carry.memory, carry.yaw, read(carry.qpos, carry.qvel))
        plan_with = lambda slots: partial(decide, config, robot, weights, command, slots=slots)  # noqa: E731
        if config.gait.double_support:
            memory, plan = plan_with(2)(*known, no_error)
        else:
            stands = tick < config.gait.first_tick
            memory, plan = jax.lax.cond(stands, plan_with(2), plan_with(1), *known, no_error)
        planned = carry._replace(memory=memory, plan=plan)
        carry = _where(carry.fallen, carry, planned)
        when = (jnp.full(count, tick), jnp.arange(count))
        carry, seen = jax.lax.scan(millisecond, carry, when)
        if not fine:
            last = jax.tree.map(lambda x: x[-1], seen)
            seen = last._replace(effect=jax.tree.map(lambda x: x.mean(axis=0), seen.effect))
        return carry, (carry.plan, seen)

    anchor = standing_anchor(robot, start_tick)
    qvel = jnp.zeros(model.nv)
    start = read(qpos, qvel)
    yaw = jnp.zeros(())
    memory = init_memory(robot, sensing.measure(robot, start, yaw, no_error)[0])
    shapes = jax.eval_shape(
        lambda: (
            decide(
                config,
                robot,
                weights,
                command,
                anchor,
                jnp.asarray(begin),
                memory,
                yaw,
                start,
                no_error,
                slots=2,
            )[1],
            observe(
                config,
                robot,
                command,
                anchor,
                jnp.asarray(1.0 * begin),
                yaw,
                start,
                mjx_contacts(template),
                start,
                floor,
                foot_of_geom,
            ),
        )
    )
    plan, seen = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    carry = _Carry(
        memory,
        plan,
        init_actuators(),
        anchor,
        yaw,
        qpos,
        qvel,
        jnp.zeros_like(qvel),
        jnp.zeros((), bool),
        seen,
    )
    _, (plans, seen) = jax.lax.scan(one_tick, carry, jnp.arange(begin, start_tick + ticks))

    lead = start_tick - begin
    each = count if fine else 1
    initial = jax.tree.map(lambda x: x[lead - 1], seen.state)
    walked, planned = jax.tree.map(lambda x: x[lead:], (seen, plans))
    if fine:
        initial = jax.tree.map(lambda x: x[-1], initial)
        walked = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), walked)
    planned = jax.tree.map(lambda x: jnp.repeat(x, each, axis=0), planned)
    return Trajectory(
        period=jnp.asarray(config.gait.tick / each),
        initial=initial,
        state=walked.state,
        reference=walked.reference,
        command=planned.wrench,
        effect=walked.effect,
        contact=planned.contact,
        feet=walked.feet,
        joints=walked.joints,
        fallen=walked.fallen,
        residual=planned.residual,
    )


@partial(jax.jit, static_argnames=("config", "places", "ticks", "start_tick", "fine"))
def _walk_all(
    config, places, ticks, start_tick, fine, robot, model, varied, qpos, weights, command, plants
):
    def one(varied: dict, weights: Weights, command: Command, plant: Imperfections) -> Trajectory:
        return _walk_one(
            config,
            places,
            ticks,
            start_tick,
            fine,
            robot,
            model.replace(**varied),
            qpos,
            weights,
            command,
            plant,
        )

    return jax.vmap(one)(varied, weights, command, plants)


def walk_batch(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    imperfections: Sequence[Imperfections],
    seconds: float = 4.0,
    start_tick: int = 0,
    fine: bool = False,
    path: Path | None = None,
) -> Trajectory:
    """Walk a batch in MJX.

    Args:
        config: the controller.
        robot: its nominal body.
        weights: with a batch axis B.
        command: with a batch axis B.
        imperfections: B plants without errors of the estimator.
        seconds: length from t = 0.
        start_tick: gait tick of t = 0.
        fine: samples of 1 ms; by default one per tick, its effect the mean over the tick.
        path: the plants' XML, hector.xml by default.

    Returns:
        Trajectory with a leading axis B.

    Raises:
        ValueError: the plants are not B, have errors of the estimator, or differ in their joints.
    """
    count = len(imperfections)
    for name, tree in (("weights", weights), ("command", command)):
        sizes = {np.shape(leaf)[0] for leaf in jax.tree.leaves(tree)}
        if sizes != {count}:
            raise ValueError(f"{name} has batch sizes {sorted(sizes)} for {count} plants")
    if any(np.any(np.asarray(x)) for plant in imperfections for x in plant.estimator):
        raise ValueError("a batch in MJX knows its state exactly: estimator errors must be zero")
    worlds = build_worlds(imperfections, path)
    world = worlds[0]
    model, varied = batched_model(worlds)
    places = _Places(
        coordinates=tuple(sensing.coordinates(world).tolist()),
        actuator=tuple(world.actuator.tolist()),
        foot_of_geom=tuple(world.foot_of_geom.tolist()),
        floor=world.floor,
    )
    qpos = jnp.asarray(standing_qpos(world, robot.standing_joints, float(robot.trunk_height)))
    plants = jax.tree.map(lambda *x: np.stack(x), *imperfections)
    ticks = round(seconds / config.gait.tick)
    return _walk_all(
        config,
        places,
        ticks,
        start_tick,
        fine,
        robot,
        model,
        varied,
        qpos,
        weights,
        command,
        plants,
    )
