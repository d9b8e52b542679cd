"""The check of an exported controller: a recorded walk, gone through again and timed."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command, anchor_at, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Wrench
from hector_jax.qp import Status
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, ideal, standing_qpos


class Record(NamedTuple):
    """Inputs of the controller along a walk, a row each millisecond, and the live one's outputs.

    The first `lead` rows are those before t = 0, where the anchor is `standing`; from then on it is
    `anchor`.
    """

    measurement: Measurement  # (T,) rows
    command: Command
    standing: Anchor
    anchor: Anchor
    lead: int
    wrench: Wrench  # commanded, rows from t = 0 on
    torque: Float[np.ndarray, "T joints"]  # [N m]


def record(
    config: WalkConfig, robot: Robot, weights: Weights, *, command: Command, seconds: float
) -> Record:
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
        torques.append(data.ctrl[world.actuator].copy())
        entries = np.concatenate([data.qpos, data.qvel, np.zeros(1)])
        rows.append(entries[sensing.coordinates(world)])

    trajectory = walk(config, robot, Job(weights, command, plant, seconds), on_sample=append)
    if np.asarray(trajectory.fallen).any():
        raise InputError(
            f"with these weights the robot falls within {seconds:g} s in the ideal world: there is "
            "no walk to check the export on"
        )

    @jax.jit
    def measurements(rows: Array) -> Measurement:
        def one(yaw: Array, row: Array) -> tuple[Array, Measurement]:
            reading = sensing.unpack_reading(row)
            measurement, yaw = sensing.measure(robot, reading, yaw, sensing.no_error(robot))
            return yaw, measurement

        return lax.scan(one, jnp.zeros(()), rows)[1]

    lead = -first_tick(config) * substeps(config)
    host = partial(jax.tree.map, np.asarray)
    return Record(
        measurement=host(measurements(np.stack(rows[:-1]))),
        command=command,
        standing=host(standing_anchor(robot)),
        anchor=host(anchor_at(robot, jax.tree.map(jnp.asarray, trajectory.initial), 0)),
        lead=lead,
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
    hold_ms: dict[str, float]  # [ms] of one that holds the plan


def check(
    config: WalkConfig, control: Callable[..., tuple], example: tuple, recorded: Record
) -> Check:
    """Run an exported controller along a recorded walk, and time it, numpy in, numpy out.

    Args:
        config: for its times.
        control: from `load_controller`.
        example: its arguments, from `controller`.
        recorded: from `record`.
    """
    state, joints, rates = recorded.measurement
    measured = state._asdict() | {"joints": joints, "joint_rates": rates}
    command, standing, anchor = jax.device_put(
        [part._asdict() for part in (recorded.command, recorded.standing, recorded.anchor)]
    )
    jax.block_until_ready(control(*example))  # the first call is slower
    carry, answers, spent = example[0], [], []
    for i in range(len(joints)):
        now = {name: rows[i] for name, rows in measured.items()}
        wall, cpu = time.perf_counter(), time.process_time()
        carry, out = control(
            carry, np.int32(i), now, command, standing if i < recorded.lead else anchor
        )
        np.asarray(out["torque"])
        spent.append((time.perf_counter() - wall, time.process_time() - cpu))
        answers.append(out)
    out = {name: np.stack([answer[name] for answer in answers]) for name in answers[0]}
    plans = np.arange(len(joints)) % substeps(config) == 0

    def spread(times: np.ndarray) -> dict[str, float]:
        names = ("p50", "p99", "max")
        wall, cpu = 1e3 * np.quantile(times, [0.5, 0.99, 1.0], axis=0).T
        values = {**dict(zip(names, wall, strict=True)), "cpu_p50": cpu[0], "cpu_p99": cpu[1]}
        return {name: float(value) for name, value in values.items()}

    return Check(
        force=float(np.abs(out["force"][recorded.lead :] - recorded.wrench.force).max()),
        moment=float(np.abs(out["moment"][recorded.lead :] - recorded.wrench.moment).max()),
        torque=float(np.abs(out["torque"] - recorded.torque).max()),
        unsolved=int((~np.isin(out["status"][plans], (Status.SOLVED, Status.NOT_UNIQUE))).sum()),
        plan_ms=spread(np.array(spent)[plans]),
        hold_ms=spread(np.array(spent)[~plans]),
    )


def as_arrays(recorded: Record) -> dict[str, Any]:
    """A record as named arrays, for whoever checks the controller on the robot's computer."""
    state, joints, rates = recorded.measurement
    groups = {
        "measured": state._asdict() | {"joints": joints, "joint_rates": rates},
        "command": recorded.command._asdict(),
        "standing": recorded.standing._asdict(),
        "anchor": recorded.anchor._asdict(),
        "out": {**recorded.wrench._asdict(), "torque": recorded.torque},
    }
    return {f"{group}.{name}": row for group, rows in groups.items() for name, row in rows.items()}
