"""The check of an exported controller: compiled, called along a recorded walk, and compared.

The walk is recorded in the ideal world with the inputs and outputs of the live controller in each
millisecond.
"""

import ctypes
import shutil
import subprocess
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command, anchor_at, standing_anchor
from hector_jax.core.arrays import Array
from hector_jax.core.console import Broken
from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Wrench
from hector_jax.export.source import PIECES
from hector_jax.qp import Status
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, standing_qpos


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


def record(config: WalkConfig, robot: Robot, job: Job) -> WalkRecord:
    """Walk in the ideal world and record the inputs and outputs of the controller.

    Raises:
        InputError: the robot falls.
    """
    plant = job.imperfections
    world = build_world(plant, robot.description)
    standing = standing_qpos(world, robot.standing_joints, float(robot.trunk_height))
    rows = [np.concatenate([standing, np.zeros(world.model.nv + 1)])[sensing.coordinates(world)]]
    torques = []

    def append(world: Any, data: Any) -> None:
        torques.append(data.ctrl.copy())
        entries = np.concatenate([data.qpos, data.qvel, np.zeros(1)])
        rows.append(entries[sensing.coordinates(world)])

    trajectory = walk(config, robot, job, build=partial(MujocoPlant, on_step=append))
    if np.asarray(trajectory.fallen).any():
        raise InputError(
            f"with these weights the robot falls within {job.seconds:g} s in the ideal world: "
            "there is no walk to check the export on"
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
        command=host(job.command),
        standing=host(standing_anchor(robot)),
        anchor=host(anchor_at(robot, jax.tree.map(jnp.asarray, trajectory.initial), 0)),
        lead=-first_tick(config) * substeps(config),
        wrench=host(trajectory.command),
        torque=np.stack(torques),
    )


def as_arrays(recorded: WalkRecord) -> dict[str, Any]:
    """Return a record as named arrays, to check the controller on the computer of the robot."""
    state, joints, rates = recorded.measurement
    groups = {
        "measured": state._asdict() | {"joints": joints, "joint_rates": rates},
        "command": recorded.command._asdict(),
        "standing": recorded.standing._asdict(),
        "anchor": recorded.anchor._asdict(),
        "out": {**recorded.wrench._asdict(), "torque": recorded.torque},
    }
    return {f"{group}.{name}": row for group, rows in groups.items() for name, row in rows.items()}


def compiler() -> str | None:
    """Return the path of the C compiler, None without one."""
    return shutil.which("cc")


def compile_controller(source: dict[str, str], folder: Path, *flags: str) -> Path:
    """Write the files of `controller_source` into a folder and compile them with these flags too.

    Returns:
        The shared library, beside them.

    Raises:
        Broken: the compiler refuses them.
    """
    for file, text in source.items():
        write_file(folder / file, text.encode())
    words = [
        compiler() or "cc",
        "-std=c99",
        "-O2",
        *flags,
        "-fPIC",
        "-shared",
        "controller.c",
        "-lm",
    ]
    library = folder / "controller.so"
    done = subprocess.run([*words, "-o", library.name], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        lines = [*done.stderr.strip().splitlines(), f"exit code {done.returncode}"]
        raise Broken(f"the compiler refuses controller.c: {lines[0]}")
    return library


class Layout(NamedTuple):
    """The structures of controller.h as NumPy knows them."""

    estimate: np.dtype
    command: np.dtype
    anchor: np.dtype
    output: np.dtype


def layout_of(robot: Robot, pieces: int = PIECES) -> Layout:
    """Return the layout for a robot, and for commands of up to `pieces` pieces."""
    feet, joints = len(robot.foot_point), len(robot.joint_lower)
    vectors = [(name, "f8", 3) for name in ("euler", "position", "ang_velocity", "velocity")]
    numbers = {"duration": (), "velocity": (2,), "yaw_rate": ()}
    command = [(name, "f8", (pieces, *shape)) for name, shape in numbers.items()]
    output = [("torque", "f8", joints), ("force", "f8", (feet, 3)), ("moment", "f8", (feet, 3))]
    output += [(name, "f8") for name in ("residual", "tilt", "height", "margin")] + [("age", "i8")]
    output += [("contact", "i4", feet), ("iterations", "i4"), ("status", "i4")]
    parts = (
        [*vectors, ("joints", "f8", joints), ("joint_rates", "f8", joints)],
        [("pieces", "i4"), *command],
        [("position", "f8", 3), ("yaw", "f8"), ("tick", "i8")],
        output,
    )
    return Layout(*(np.dtype(fields, align=True) for fields in parts))


class Inputs(NamedTuple):
    """Inputs of the C functions: structured arrays, a row for each millisecond or one row."""

    estimate: np.ndarray
    command: np.ndarray
    anchor: np.ndarray


def inputs_of(recorded: WalkRecord, robot: Robot) -> Inputs:
    """Return a recorded walk as the inputs of the C functions."""
    count, pieces = len(recorded.torque), len(recorded.command.duration)
    layout = layout_of(robot, max(pieces, PIECES))
    found = Inputs(*(np.zeros(n, part) for n, part in zip((count, 1, count), layout, strict=False)))
    state, joints, rates = recorded.measurement
    for name, value in {**state._asdict(), "joints": joints, "joint_rates": rates}.items():
        found.estimate[name] = value
    found.command["pieces"] = pieces
    for name, value in recorded.command._asdict().items():
        found.command[name][0, :pieces] = value
    for anchor, rows in (
        (recorded.standing, slice(recorded.lead)),
        (recorded.anchor, slice(recorded.lead, None)),
    ):
        for name, value in anchor._asdict().items():
            found.anchor[name][rows] = value
    return found


class Library:
    """A compiled controller, with its memory."""

    def __init__(self, path: Path) -> None:
        """Load the library and begin a walk."""
        self.functions = ctypes.CDLL(str(path.resolve()))
        size = ctypes.c_size_t.in_dll(self.functions, "controller_size").value
        self.memory = ctypes.create_string_buffer(size)
        self.functions.controller_init(self.memory)

    def step(self, inputs: Inputs, output: np.ndarray, row: int) -> float:
        """Take the step of a row of the inputs, its millisecond, and write the row of the output.

        Returns:
            The thread's CPU time [ms].
        """
        at = [x.ctypes.data + min(row, len(x) - 1) * x.itemsize for x in (*inputs, output)]
        pointers = [ctypes.c_void_p(address) for address in at]
        begin = time.thread_time_ns()
        self.functions.controller_step_at(self.memory, ctypes.c_int64(row), *pointers)
        return 1e-6 * (time.thread_time_ns() - begin)


class Check(NamedTuple):
    """Differences and times of a compiled controller along a walk."""

    force: float  # [N] largest difference from the live controller
    moment: float  # [N m]
    torque: float  # [N m]
    unsolved: int  # plans whose QP was not solved
    plan_ms: dict[str, float]  # [ms] thread CPU time of a call that plans: p50, p99, p999, max
    hold_ms: dict[str, float]  # [ms] of a call that holds the plan


def compare_with_live(
    config: WalkConfig, robot: Robot, library: Path, recorded: WalkRecord
) -> Check:
    """Run a compiled controller along a recorded walk, compare and time it.

    Args:
        config, robot: of the controller.
        library: from `compile_controller`.
        recorded: recorded walk, from `record`.
    """
    compiled, inputs = Library(library), inputs_of(recorded, robot)
    count = len(recorded.torque)
    out = np.zeros(count, layout_of(robot).output)
    spent = np.array([compiled.step(inputs, out, i) for i in range(count)])
    plans = np.arange(count) % substeps(config) == 0

    def quantiles(times: np.ndarray) -> dict[str, float]:
        shares = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}
        return {name: float(np.quantile(times, share)) for name, share in shares.items()}

    def worst(name: str, rows: np.ndarray) -> float:
        return float(np.abs(out[name][count - len(rows) :] - rows).max())

    return Check(
        force=worst("force", recorded.wrench.force),
        moment=worst("moment", recorded.wrench.moment),
        torque=worst("torque", recorded.torque),
        unsolved=int((~np.isin(out["status"][plans], (Status.SOLVED, Status.NOT_UNIQUE))).sum()),
        plan_ms=quantiles(spent[plans]),
        hold_ms=quantiles(spent[~plans]),
    )
