"""The controller as one function, called every millisecond, and as one file of `jax.export`.

The file is StableHLO that contains the robot, the configuration and the weights, so that a checked
file cannot be run with other weights.

    carry, out = control(carry, millisecond, measured, command, anchor)

It takes and returns plain tuples and dictionaries of arrays, so that loading it needs JAX but not
this package. In the first millisecond of a tick it plans, in the others it holds the plan; the
torques are computed every millisecond. The carry is opaque: zeros at millisecond 0, when the robot
stands, and then the carry of the last call. The gait clock starts at millisecond 0, as in walks in
MuJoCo.

The exported function is traced on the CPU: the initial guess by a GPU kernel (`qp`) has no stable
custom call, and the plain guess leads to the same minimiser. A file is checked by replaying and
timing a recorded walk.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float, Int

from hector_jax.control.controller import (
    Memory,
    Plan,
    WalkConfig,
    actuate,
    contacts_needed,
    init_memory,
    step_plan,
)
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command, anchor_at, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError, require_package
from hector_jax.core.trajectory import State, Wrench
from hector_jax.qp import Status
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, ideal, standing_qpos

_STILL = Command(np.ones(2), np.zeros((2, 2)), np.zeros(2))


class _Heading(NamedTuple):
    """Yaws that do not jump by whole turns, in the carry."""

    yaw: Any  # the last measured one that is finite [rad]
    anchor: Anchor  # the last one, as it was given
    anchor_yaw: Any  # its yaw, next to the measured one [rad]


def _idle(config: WalkConfig, robot: Robot, weights: Weights) -> tuple[_Heading, Memory, Plan]:
    """Return a carry of zeros with the shapes and dtypes of real ones."""
    joints = np.zeros_like(robot.standing_joints)
    anchor = standing_anchor(robot)
    measurement = Measurement(State(*np.zeros((4, 3))), joints, joints)
    shapes = jax.eval_shape(
        partial(step_plan, config),
        robot,
        config.parameters(weights),
        command=_STILL,
        anchor=anchor,
        tick=np.int32(0),
        memory=jax.eval_shape(init_memory, robot, measurement),
        measurement=measurement,
    )
    carry = _Heading(anchor.yaw, anchor, anchor.yaw), *shapes
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), carry)


def _next_to(angle: Float[Array, ""], other: Float[Array, ""]) -> Float[Array, ""]:
    """Return an angle [rad] plus the whole turns that bring it closest to another."""
    return angle + 2 * jnp.pi * jnp.round((other - angle) / (2 * jnp.pi))


def _unwrap(
    last: _Heading, yaw: Float[Array, ""], anchor: Anchor
) -> tuple[_Heading, Float[Array, ""]]:
    """Return the next heading and the measured yaw [rad] next to the last one.

    A new anchor's yaw is taken next to the measured one, as both may be of any turn.
    """
    yaw = _next_to(yaw, last.yaw)
    seen = jnp.where(jnp.isfinite(yaw), yaw, last.yaw)
    is_new = jnp.any(jnp.stack([jnp.any(x != y) for x, y in zip(anchor, last.anchor, strict=True)]))
    anchor_yaw = jnp.where(is_new, _next_to(anchor.yaw, seen), last.anchor_yaw)
    return _Heading(seen, anchor, anchor_yaw), yaw


def controller(
    config: WalkConfig, robot: Robot, weights: Weights
) -> tuple[Callable[..., tuple], tuple]:
    """Return the controller as one function of plain arrays, and an example of its arguments.

    Args:
        config, robot, weights: constants of the function.

    Returns:
        `control(carry, millisecond, measured, command, anchor) -> (carry, out)`, see the module,
        and its arguments for a robot that stands at millisecond 0.
    """
    idle, structure = jax.tree.flatten(_idle(config, robot, weights))
    count, begin, first_step = substeps(config), first_tick(config), config.gait.first_tick
    parameters = config.parameters(weights)

    def control(
        carry: tuple[Array, ...],
        millisecond: Int[Array, ""],
        measured: dict[str, Array],
        command: dict[str, Array],
        anchor: dict[str, Array],
    ) -> tuple[tuple[Array, ...], dict[str, Array]]:
        tick, substep = begin + millisecond // count, millisecond % count
        heading, memory, plan = jax.tree.unflatten(structure, carry)
        heading, yaw = _unwrap(heading, measured["euler"][2], Anchor(**anchor))
        state = State(**{name: measured[name] for name in State._fields})
        state = state._replace(euler=jnp.append(state.euler[:2], yaw))
        measurement = Measurement(state, measured["joints"], measured["joint_rates"])

        plan_tick = partial(
            step_plan,
            config,
            robot,
            parameters,
            command=Command(**command),
            anchor=heading.anchor._replace(yaw=heading.anchor_yaw),
            tick=tick,
            memory=memory,
            measurement=measurement,
        )
        branch = jnp.where(substep > 0, 0, jnp.where(tick < first_step, 2, 1))
        planners = [
            partial(plan_tick, max_contacts=contacts_needed(config, example_tick))
            for example_tick in (first_step, first_step - 1)
        ]
        memory, plan = lax.switch(branch, [lambda: (memory, plan), *planners])
        inputs = {"substep": substep, "measurement": measurement, "plan": plan, "memory": memory}
        out = {
            **plan.wrench._asdict(),
            "torque": actuate(config, robot, parameters.legs, **inputs),
            "contact": plan.contact,
            "status": plan.status,
            "residual": plan.residual,
        }
        return tuple(jax.tree.leaves((heading, memory, plan))), out

    return control, (tuple(idle), np.int32(0), *_standing(robot))


def _measured(measurement: Measurement) -> dict[str, Any]:
    """Return a measurement with the names of the exported function."""
    state, joints, rates = measurement
    return state._asdict() | {"joints": joints, "joint_rates": rates}


def _standing(robot: Robot) -> tuple[dict[str, Any], ...]:
    """Return measurement, command and anchor of a robot that stands."""
    position, joints = np.append(robot.com_offset[:2], robot.standing_height), robot.standing_joints
    state = State(np.zeros(3), position, np.zeros(3), np.zeros(3))
    measured = _measured(Measurement(state, joints, np.zeros_like(joints)))
    anchor = jax.tree.map(np.asarray, standing_anchor(robot))
    return measured, _STILL._asdict(), anchor._asdict()


_SIGNATURE = {
    "carry": "opaque: zeros at millisecond 0, then the carry that came out",
    "millisecond": "since the start; the robot stands on all feet then",
    "measured": {
        "euler": "roll, pitch, yaw of the trunk [rad], R = Rz Ry Rx; the yaw of any turn",
        "position": "centre of mass [m], world: trunk origin + R com_offset; the floor is z = 0",
        "ang_velocity": "of the trunk, world frame [rad/s]",
        "velocity": "of the centre of mass, world frame [m/s]",
        "joints": "[rad], order of joint_names",
        "joint_rates": "[rad/s]",
    },
    "command": {
        "duration": "of each piece [s]; repeated after the last",
        "velocity": "ahead and to the left [m/s]",
        "yaw_rate": "[rad/s]",
    },
    "anchor": {
        "position": "where the reference starts [m]; z is standing_height",
        "yaw": "[rad], of any turn",
        "tick": "when: gait tick from which on the command is walked; before, it steps in place",
    },
    "out": {
        "force": "of the ground on each foot as commanded, left ones first, world frame [N]",
        "moment": "the same, at the foot point [N m]",
        "torque": "of the joints [N m], within the limits: this goes to the motors",
        "contact": "planned stance",
        "status": "of the QP: "
        + ", ".join(f"{code.value} {code.name.lower().replace('_', ' ')}" for code in Status),
        "residual": "worst relative residual of the QP",
    },
}


def export_controller(
    config: WalkConfig, robot: Robot, weights: Weights, *, platform: str = "cpu"
) -> bytes:
    """Return the controller with 64-bit numbers as file content for `jax.export.deserialize`.

    Args:
        config, robot, weights: constants of the exported function.
        platform: cpu or cuda, which this machine need not have.

    Raises:
        InputError: flatbuffers is not installed, or JAX runs with 32 bits or not on the CPU.
    """
    require_package("flatbuffers", "export", "exporting")
    if jax.default_backend() != "cpu" or not jax.config.read("jax_enable_x64"):
        raise InputError("exporting needs JAX on the CPU (JAX_PLATFORMS=cpu) and with 64 bits")
    control, example = controller(config, robot, weights)
    return bytes(jax.export.export(jax.jit(control), platforms=[platform])(*example).serialize())


def load_controller(content: bytes) -> Callable[..., tuple]:
    """Return the function in the content of a file, already compiled for this machine."""
    exported = jax.export.deserialize(bytearray(content))
    arguments, _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    return jax.jit(exported.call).lower(*arguments).compile()


def _with_shapes(texts: Any, values: Any) -> Any:
    """Add the shapes of values to their texts; without values, as for `out`, return the texts."""
    if values is None:
        return texts
    if isinstance(texts, dict):
        return {name: _with_shapes(text, values.get(name)) for name, text in texts.items()}
    arrays = [{"shape": list(x.shape), "dtype": str(x.dtype)} for x in jax.tree.leaves(values)]
    return {"is": texts, **(arrays[0] if len(arrays) == 1 else {"arrays": arrays})}


def signature(example: tuple) -> dict[str, Any]:
    """Describe arguments and results of the controller in words, with shapes and dtypes."""
    return _with_shapes(_SIGNATURE, dict(zip(_SIGNATURE, example, strict=False)))


class WalkRecord(NamedTuple):
    """Inputs and outputs of the live controller along a walk, a row for each millisecond.

    The first `lead` rows are before t = 0, where the anchor is `standing`; from then on it is
    `anchor`.
    """

    measurement: Measurement  # (T,) rows
    command: Command
    standing: Anchor
    anchor: Anchor
    lead: int
    wrench: Wrench  # commanded; rows from t = 0 on
    torque: Float[np.ndarray, "T joints"]  # [N m]


def record(
    config: WalkConfig, robot: Robot, weights: Weights, *, command: Command, seconds: float
) -> WalkRecord:
    """Walk in the ideal world and record the inputs and outputs of the controller.

    Raises:
        InputError: the robot falls.
    """
    plant = ideal(robot.description)
    world = build_world(plant, robot.description)
    standing = standing_qpos(world, robot.standing_joints, float(robot.trunk_height))
    rows = [np.concatenate([standing, np.zeros(world.model.nv + 1)])[sensing.coordinates(world)]]
    torques = []

    def append(world: Any, data: Any) -> None:
        torques.append(data.ctrl.copy())
        entries = np.concatenate([data.qpos, data.qvel, np.zeros(1)])
        rows.append(entries[sensing.coordinates(world)])

    trajectory = walk(
        config,
        robot,
        Job(weights, command, plant, seconds),
        build=partial(MujocoPlant, on_step=append),
    )
    if np.asarray(trajectory.fallen).any():
        raise InputError(
            f"with these weights the robot falls within {seconds:g} s in the ideal world: there is "
            "no walk to check the export on"
        )

    @jax.jit
    def measurements(rows: Array) -> Measurement:
        def measure(yaw: Array, row: Array) -> tuple[Array, Measurement]:
            measurement, yaw = sensing.measure(robot, row, yaw, sensing.no_error(robot))
            return yaw, measurement

        return lax.scan(measure, jnp.zeros(()), rows)[1]

    host = partial(jax.tree.map, np.asarray)
    return WalkRecord(
        measurement=host(measurements(np.stack(rows[:-1]))),
        command=command,
        standing=host(standing_anchor(robot)),
        anchor=host(anchor_at(robot, jax.tree.map(jnp.asarray, trajectory.initial), 0)),
        lead=-first_tick(config) * substeps(config),
        wrench=host(trajectory.command),
        torque=np.stack(torques),
    )


class Check(NamedTuple):
    """Differences and times of an exported controller along a walk."""

    force: float  # [N] largest difference from the live controller
    moment: float  # [N m]
    torque: float  # [N m]
    unsolved: int  # plans whose QP was not solved
    plan_ms: dict[str, float]  # [ms] of a call that plans: p50, p99, max; cpu_p50, cpu_p99
    hold_ms: dict[str, float]  # [ms] of a call that holds the plan


def compare_with_live(
    config: WalkConfig, control: Callable[..., tuple], example: tuple, recorded: WalkRecord
) -> Check:
    """Run an exported controller along a recorded walk and time it, with NumPy inputs and outputs.

    Args:
        config: settings of the controller, with its times.
        control: exported controller, from `load_controller`.
        example: its arguments, from `controller`.
        recorded: recorded walk, from `record`.
    """
    measured = _measured(recorded.measurement)
    command, standing, anchor = jax.device_put(
        [part._asdict() for part in (recorded.command, recorded.standing, recorded.anchor)]
    )
    jax.block_until_ready(control(*example))  # the first call is slower
    carry, outputs, times = example[0], [], []
    for i in range(len(recorded.torque)):
        row = {name: rows[i] for name, rows in measured.items()}
        start = standing if i < recorded.lead else anchor
        wall, cpu = time.perf_counter(), time.process_time()
        carry, out = control(carry, np.int32(i), row, command, start)
        np.asarray(out["torque"])
        times.append((time.perf_counter() - wall, time.process_time() - cpu))
        outputs.append(out)
    out = {name: np.stack([output[name] for output in outputs]) for name in outputs[0]}
    plans = np.arange(len(recorded.torque)) % substeps(config) == 0

    def quantiles(rows: np.ndarray) -> dict[str, float]:
        wall, cpu = 1e3 * np.quantile(np.array(times)[rows], [0.5, 0.99, 1.0], axis=0).T
        names = ("p50", "p99", "max", "cpu_p50", "cpu_p99")
        return dict(zip(names, [*wall.tolist(), *cpu[:2].tolist()], strict=True))

    return Check(
        force=float(np.abs(out["force"][recorded.lead :] - recorded.wrench.force).max()),
        moment=float(np.abs(out["moment"][recorded.lead :] - recorded.wrench.moment).max()),
        torque=float(np.abs(out["torque"] - recorded.torque).max()),
        unsolved=int((~np.isin(out["status"][plans], (Status.SOLVED, Status.NOT_UNIQUE))).sum()),
        plan_ms=quantiles(plans),
        hold_ms=quantiles(~plans),
    )


def as_arrays(recorded: WalkRecord) -> dict[str, Any]:
    """Return a record as named arrays, to check the controller on the computer of the robot."""
    groups = {
        "measured": _measured(recorded.measurement),
        "command": recorded.command._asdict(),
        "standing": recorded.standing._asdict(),
        "anchor": recorded.anchor._asdict(),
        "out": {**recorded.wrench._asdict(), "torque": recorded.torque},
    }
    return {f"{group}.{name}": row for group, rows in groups.items() for name, row in rows.items()}
