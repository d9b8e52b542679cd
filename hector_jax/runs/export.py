"""Off to the robot: weights, their lines for the open C++ controller, and the controller itself.

The controller is one function, called every millisecond and handed around as one file of
`jax.export`: StableHLO with the robot, the configuration and the weights inside, so that a file
that was checked cannot be run with other weights.

    carry, out = control(carry, millisecond, measured, command, anchor)

It takes and gives plain tuples and dictionaries of arrays, so that whoever loads it needs JAX and
nothing of this package. In the first millisecond of a tick it plans, in the others it holds the
plan; the torques are new every millisecond. The carry is opaque: zeros at millisecond 0, when the
robot stands, and then what came out. The gait's clock starts there, as walks in MuJoCo do.

A walk is kept beside it, with what the live controller answered, and the file is believed once it
has answered the same (`TOLERANCE`). What is exported is traced on the CPU: the guess by a GPU
kernel (`control.qp`) has no stable custom call, and the plain guess leads to the same minimiser.
"""

import hashlib
import io
import textwrap
import time
from collections.abc import Callable
from dataclasses import asdict
from difflib import get_close_matches
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from hector_jax.control.controller import Memory, Plan, WalkConfig, actuate, step_plan
from hector_jax.control.footstep import Feet
from hector_jax.control.legs import Measurement
from hector_jax.control.reference import Anchor, Command, anchor_at, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import WEIGHTS, save_weights, weights_tree
from hector_jax.core.console import Broken
from hector_jax.core.environment import versions
from hector_jax.core.files import make_folder, write_file, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import from_table, read_json
from hector_jax.core.trajectory import State, Wrench, pack_wrench
from hector_jax.core.tree_file import tree_hash
from hector_jax.qp import Status
from hector_jax.robot.model import Robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job, first_tick, substeps
from hector_jax.sim.walk import walk
from hector_jax.sim.world import build_world, ideal, standing_qpos

SCHEMA = "weights.schema.json"
PLATFORMS = ("cpu", "cuda")
TOLERANCE = 1e-6
"""Largest difference [N, N m] from the live controller."""


def find_weights(run: Path, name: str) -> tuple[Path, WalkConfig | None]:
    """A weight set's file, and the controller that it was tuned for.

    Args:
        run: folder of a run, or a weights file.
        name: of the set in the folder.

    Returns:
        The file, and the controller; None where a file does not tell it.

    Raises:
        InputError: one line with what is missing or odd, and what there is.
    """
    if not run.is_dir():
        return run, None
    sets = sorted(path.stem for path in (run / "weights").glob("*.json"))
    if name not in sets:
        near = get_close_matches(name, sets, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(sets) or 'none'}"
        raise InputError(f"{run}: no weight set {name!r}; {hint}")
    path = run / "config.json"
    kept = read_json(path, "the settings of a run")
    try:
        settings = kept["tune"]["rollout"]["walk"]
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not the settings of a walking controller: {error!r}") from error
    # a setting that this version does not know is refused: the file goes to a robot
    config = from_table(f"{path}: tune.rollout.walk", WalkConfig, settings)
    return run / "weights" / f"{name}.json", config


# The weights


def weights_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a weights file."""

    def of(what: str, value: dict[str, Any]) -> dict[str, Any]:
        return {"description": what, **value}

    def entries(named: dict[str, Any]) -> dict[str, Any]:
        return {
            "type": "object",
            "properties": named,
            "required": list(named),
            "additionalProperties": False,
        }

    row = {
        "type": "array",
        "items": {"type": "number", "minimum": WEIGHTS.low, "maximum": WEIGHTS.high},
        "minItems": 3,
        "maxItems": 3,
    }
    feet = {"type": "array", "items": row, "minItems": 2, "maxItems": 2}
    weights = entries(
        {
            "Q": of(
                "of the squared error of each state, world frame",
                entries(
                    {
                        "euler": of("roll, pitch, yaw [1/rad^2]", row),
                        "position": of("x, y, z of the centre of mass [1/m^2]", row),
                        "ang_velocity": of("x, y, z [s^2/rad^2]", row),
                        "velocity": of("x, y, z [s^2/m^2]", row),
                    }
                ),
            ),
            "R": of(
                "of the squared wrench of the ground on each foot, left then right, world frame",
                entries(
                    {
                        "force": of("x, y, z [1/N^2]", feet),
                        "moment": of("x, y, z [1/(N m)^2]", feet),
                    }
                ),
            ),
        }
    )
    weights["properties"]["$schema"] = {"type": "string"}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Weights of the walking MPC: diagonals of |x - x_ref|^2_Q + |u|^2_R",
        **weights,
    }


_STATES = ("roll, pitch, yaw", "x, y, z", "their rates: wx, wy, wz", "vx, vy, vz")
_INPUTS = ("force, foot 0 (left)", "force, foot 1 (right)", "moment, foot 0", "moment, foot 1")


def weights_cpp(weights: Weights, config: WalkConfig, robot: Robot, name: str) -> str:
    """The weights as the two lines of the open HECTOR C++ controller, and what else differs.

    Args:
        weights: to write.
        config: the controller that they were tuned for.
        robot: its body.
        name: of the weights, for the first line.

    Source: DRCL-USC/Hector_Simulation, branch ROS_Simulation, ConvexMPCLocomotion.cpp and
        SolverMPC.cpp at commit 79d545a, read for order and factors.
    """
    mpc, toe, heel = config.mpc, float(robot.toe), float(robot.heel)
    notes = [
        f"dt {config.mpc_step:g} s and {mpc.horizon} steps here; 0.04 s and 10 steps there",
        f"{float(robot.mass):.4g} kg about the centre of mass here; 9.0 kg about the trunk's origin"
        " there",
        "A, B and the levers follow the reference and the coming footholds here; the present state"
        " and feet, frozen, there",
        "the reference is integrated from the start here; it starts anew at the robot, is one step"
        " late and 0.55 m high there",
        f"|F_x| + |F_y| <= {mpc.friction:g} F_z <= {mpc.friction * mpc.max_force:g} N here; each of"
        " |F_x|, |F_y| <= 0.5 F_z <= 125 N there (mu = 2.0 is 1 / 0.5; 2 F_z <= 500)",
        f"-{toe:.3g} F_z (toe) <= M_y <= {heel:.3g} F_z (heel) here; toe and heel swapped there,"
        " and no lower bound on foot 1",
        "M_x = 0 here; 0 to 0.01 N m there",
        f"M_z is bounded by friction at toe and heel: {mpc.line_friction} here; False there",
    ]
    if mpc.effort_about == "weight":
        notes.append(
            "ATTENTION: R prices u less the feet's share of the weight here, u itself there: Alpha"
            " was not tuned for that"
        )
    wrapped = [
        textwrap.fill(note, 98, initial_indent="//   - ", subsequent_indent="//     ")
        for note in notes
    ]

    def block(kind: str, values: Any, names: tuple[str, ...]) -> str:
        triples = np.asarray(values, float).reshape(4, 3).tolist()
        lines = [
            f"    {', '.join(map(repr, row))},  // {name}"
            for row, name in zip(triples, names, strict=True)
        ]
        return "\n".join([f"double {kind}[12] = {{", *lines, "};"])

    return "\n".join(
        [
            f"// Weights {name!r}, tuned with hector_jax, for DRCL-USC/Hector_Simulation, branch",
            "// ROS_Simulation: these take the place of Q and Alpha in updateMPCIfNeeded() of",
            "// hector_control/ConvexMPC/ConvexMPCLocomotion.cpp.",
            "//",
            "// Both controllers minimise sum |x - x_ref|^2_Q + |u|^2_Alpha, world frame, in SI.",
            "// Their solver has the 2 of H = 2 (B'SB + Alpha) and g = 2 B'S (A x_0 - x_ref): the",
            "// numbers go over as they are. The gravity state has no weight in either.",
            "//",
            "// What else differs:",
            *wrapped,
            block("Q", np.concatenate(weights.Q), _STATES),
            block("Alpha", pack_wrench(Wrench(*map(jnp.asarray, weights.R))), _INPUTS),
            "",
        ]
    )


# The controller


def _idle(config: WalkConfig, robot: Robot, weights: Weights) -> tuple[Memory, Plan]:
    """Memory and plan of zeros, with the shapes and dtypes of the real ones."""
    still = Measurement(State(*np.zeros((4, 3))), np.zeros(10), np.zeros(10))
    memory = Memory(Feet(np.zeros((2, 3)), np.zeros(2)))
    command = Command(np.ones(2), np.zeros((2, 2)), np.zeros(2))
    known = (weights, command, standing_anchor(robot), np.int32(0), memory, still)
    shapes = jax.eval_shape(partial(step_plan, config), robot, *known)
    return jax.tree.map(lambda shape: np.zeros(shape.shape, shape.dtype), shapes)


def controller(
    config: WalkConfig, robot: Robot, weights: Weights
) -> tuple[Callable[..., tuple], tuple]:
    """The controller as one function of plain arrays, and an example of its arguments.

    Args:
        config, robot, weights: what it is made for.

    Returns:
        `control(carry, millisecond, measured, command, anchor) -> (carry, out)`, as the module's
        docstring says, and arguments of a robot that stands at millisecond 0.
    """
    idle, structure = jax.tree.flatten(_idle(config, robot, weights))
    count, begin, moves = substeps(config), first_tick(config), config.gait.first_tick

    def control(
        carry: tuple[Array, ...],
        millisecond: Int[Array, ""],
        measured: dict[str, Array],
        command: dict[str, Array],
        anchor: dict[str, Array],
    ) -> tuple[tuple[Array, ...], dict[str, Array]]:
        tick, substep = begin + millisecond // count, millisecond % count
        told = dict(measured)
        joints, rates = told.pop("joints"), told.pop("joint_rates")
        measurement = Measurement(State(**told), joints, rates)
        memory, plan = jax.tree.unflatten(structure, carry)

        def planned(max_contacts: int) -> Callable[[], tuple[Memory, Plan]]:
            return lambda: step_plan(
                config,
                robot,
                config.parameters(weights),
                command=Command(**command),
                anchor=Anchor(**anchor),
                tick=tick,
                memory=memory,
                measurement=measurement,
                max_contacts=max_contacts,
            )

        both = (tick < moves) | config.gait.double_support
        branch = jnp.where(substep > 0, 0, jnp.where(both, 2, 1))
        memory, plan = lax.switch(branch, [lambda: (memory, plan), planned(1), planned(2)])
        legs, now = config.legs.parameters, {"substep": substep, "measurement": measurement}
        out = {
            "force": plan.wrench.force,
            "moment": plan.wrench.moment,
            "torque": actuate(config, robot, legs, plan=plan, memory=memory, **now),
            "contact": plan.contact,
            "status": plan.status,
            "residual": plan.residual,
        }
        return tuple(jax.tree.leaves((memory, plan))), out

    position = np.append(robot.com_offset[:2], robot.standing_height)
    still = State(np.zeros(3), position, np.zeros(3), np.zeros(3))
    measured = still._asdict() | {"joints": robot.standing_joints, "joint_rates": np.zeros(10)}
    command = Command(np.ones(2), np.zeros((2, 2)), np.zeros(2))
    anchor = jax.tree.map(np.asarray, standing_anchor(robot))
    return control, (tuple(idle), np.int32(0), measured, command._asdict(), anchor._asdict())


_SIGNATURE = {
    "carry": "opaque: zeros at millisecond 0, then the carry that came out",
    "millisecond": "since the start; the robot stands on both feet then",
    "measured": {
        "euler": "roll, pitch, yaw of the trunk [rad], R = Rz Ry Rx; yaw continuous, not wrapped",
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
        "yaw": "[rad]",
        "tick": "when: gait tick from which on the command is walked; before, it steps in place",
    },
    "out": {
        "force": "of the ground on each foot as commanded, left then right, world frame [N]",
        "moment": "the same, at the foot point [N m]",
        "torque": "of the joints [N m], within the limits: this goes to the motors",
        "contact": "planned stance",
        "status": "of the QP: "
        + ", ".join(f"{code.value} {code.name.lower().replace('_', ' ')}" for code in Status),
        "residual": "worst relative residual of the QP",
    },
}


def export_controller(
    config: WalkConfig, robot: Robot, weights: Weights, platform: str = "cpu"
) -> bytes:
    """The controller as a file's content for `jax.export.deserialize`, of 64-bit numbers.

    Args:
        config, robot, weights: baked in.
        platform: cpu or cuda, which need not be here.

    Raises:
        InputError: flatbuffers is not installed, or JAX runs with 32 bits or not on the CPU.
    """
    if find_spec("flatbuffers") is None:
        raise InputError("exporting needs flatbuffers: pip install 'hector-jax[export]'")
    if jax.default_backend() != "cpu" or not jax.config.read("jax_enable_x64"):
        raise InputError("exporting needs JAX on the CPU (JAX_PLATFORMS=cpu) and with 64 bits")
    control, example = controller(config, robot, weights)
    return bytes(jax.export.export(jax.jit(control), platforms=[platform])(*example).serialize())


def load_controller(content: bytes) -> Callable[..., tuple]:
    """The function in a file's content, compiled here and now; a call never compiles again."""
    exported = jax.export.deserialize(bytearray(content))
    arguments, _ = jax.tree.unflatten(exported.in_tree, exported.in_avals)
    return jax.jit(exported.call).lower(*arguments).compile()


# The check


class Record(NamedTuple):
    """A walk as the controller met it, a row a millisecond, and what the live controller answered.

    The first `lead` rows are those before t = 0, where the anchor is `standing`; from then on it is
    `anchor`.
    """

    measurement: Measurement  # (T,) rows
    command: Command
    standing: Anchor
    anchor: Anchor
    lead: int
    wrench: Wrench  # commanded, rows from t = 0 on
    torque: Float[np.ndarray, "T 10"]  # [N m]


def record(
    config: WalkConfig, robot: Robot, weights: Weights, command: Command, seconds: float
) -> Record:
    """Walk in the ideal world and keep what went into the controller and came out.

    Raises:
        InputError: the robot falls.
    """
    plant = ideal()
    world = build_world(plant, robot.description)
    standing = standing_qpos(world, robot.standing_joints, float(robot.trunk_height))
    rows = [np.concatenate([standing, np.zeros(world.model.nv + 1)])[sensing.coordinates(world)]]
    torques = []

    def keep(world: Any, data: Any) -> None:
        torques.append(data.ctrl[world.actuator].copy())
        known = np.concatenate([data.qpos, data.qvel, np.zeros(1)])
        rows.append(known[sensing.coordinates(world)])

    walked = walk(config, robot, Job(weights, command, plant, seconds), on_sample=keep)
    if np.asarray(walked.fallen).any():
        raise InputError(
            f"with these weights the robot falls within {seconds:g} s in the ideal world: there is "
            "no walk to check the export on"
        )

    @jax.jit
    def told(rows: Array) -> Measurement:
        def one(yaw: Array, row: Array) -> tuple[Array, Measurement]:
            reading = sensing.unpack_reading(row)
            return sensing.measure(robot, reading, yaw, jnp.zeros(sensing.ERRORS))[::-1]

        return lax.scan(one, jnp.zeros(()), rows)[1]

    lead = -first_tick(config) * substeps(config)
    host = partial(jax.tree.map, np.asarray)
    return Record(
        measurement=host(told(np.stack(rows[:-1]))),
        command=command,
        standing=host(standing_anchor(robot)),
        anchor=host(anchor_at(robot, jax.tree.map(jnp.asarray, walked.initial), 0)),
        lead=lead,
        wrench=host(walked.command),
        torque=np.stack(torques),
    )


class Check(NamedTuple):
    """How an exported controller did along a walk."""

    force: float  # [N] largest difference from the live controller
    moment: float  # [N m]
    torque: float  # [N m]
    unsolved: int  # plans whose QP was not solved
    plan_ms: dict[str, float]  # [ms] of a call that plans: p50, p99, max; cpu_p50, cpu_p99
    hold_ms: dict[str, float]  # [ms] of one that holds the plan


def check(
    config: WalkConfig, control: Callable[..., tuple], example: tuple, walked: Record
) -> Check:
    """Ask an exported controller what the live one was asked, and time it, numpy in, numpy out.

    Args:
        config: for its times.
        control: from `load_controller`.
        example: its arguments, from `controller`.
        walked: from `record`.
    """
    state, joints, rates = walked.measurement
    measured = state._asdict() | {"joints": joints, "joint_rates": rates}
    told = jax.device_put(
        [part._asdict() for part in (walked.command, walked.standing, walked.anchor)]
    )
    jax.block_until_ready(control(*example))  # the first call is slower
    carry, answers, spent = example[0], [], []
    for i in range(len(joints)):
        now = {name: rows[i] for name, rows in measured.items()}
        wall, cpu = time.perf_counter(), time.process_time()
        carry, out = control(carry, np.int32(i), now, told[0], told[1 + (i >= walked.lead)])
        np.asarray(out["torque"])
        spent.append((time.perf_counter() - wall, time.process_time() - cpu))
        answers.append(out)
    out = {name: np.stack([answer[name] for answer in answers]) for name in answers[0]}
    plans = np.arange(len(joints)) % substeps(config) == 0

    def spread(times: np.ndarray) -> dict[str, float]:
        names = ("p50", "p99", "max")
        wall, cpu = 1e3 * np.quantile(times, [0.5, 0.99, 1.0], axis=0).T
        told = {**dict(zip(names, wall, strict=True)), "cpu_p50": cpu[0], "cpu_p99": cpu[1]}
        return {name: float(value) for name, value in told.items()}

    return Check(
        force=float(np.abs(out["force"][walked.lead :] - walked.wrench.force).max()),
        moment=float(np.abs(out["moment"][walked.lead :] - walked.wrench.moment).max()),
        torque=float(np.abs(out["torque"] - walked.torque).max()),
        unsolved=int((~np.isin(out["status"][plans], (Status.SOLVED, Status.NOT_UNIQUE))).sum()),
        plan_ms=spread(np.array(spent)[plans]),
        hold_ms=spread(np.array(spent)[~plans]),
    )


def _as_arrays(walked: Record) -> dict[str, Any]:
    """A record as named arrays, for whoever checks the controller on the robot's computer."""
    state, joints, rates = walked.measurement
    groups = {
        "measured": state._asdict() | {"joints": joints, "joint_rates": rates},
        "command": walked.command._asdict(),
        "standing": walked.standing._asdict(),
        "anchor": walked.anchor._asdict(),
        "out": {**walked.wrench._asdict(), "torque": walked.torque},
    }
    return {f"{group}.{name}": row for group, rows in groups.items() for name, row in rows.items()}


# All together


def _described(texts: Any, values: Any) -> Any:
    if isinstance(texts, dict):
        return {name: _described(text, values[name]) for name, text in texts.items()}
    arrays = [{"shape": list(x.shape), "dtype": str(x.dtype)} for x in jax.tree.leaves(values)]
    return {"is": texts, **(arrays[0] if len(arrays) == 1 else {"arrays": arrays})}


def export(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    folder: Path,
    *,
    name: str,
    seconds: float = 1.0,
) -> dict[str, Any]:
    """Write everything that goes to the robot; files that are there already are replaced.

    Args:
        config: the controller that the weights were tuned for.
        robot: its body.
        weights: to export.
        command: to walk for the check.
        folder: where to.
        name: of the weights, as told in the files.
        seconds: of the check from t = 0 on.

    Returns:
        The card, also in `controller.json`: files with their sha256, the signature with shapes and
        units, what the robot's own code needs to know, weights, settings, and the check.

    Raises:
        InputError: as `record` and `export_controller`; or the folder cannot be written.
        Broken: the exported controller differs from the live one by more than TOLERANCE; nothing
            is written.
    """
    make_folder(folder)
    blobs = {place: export_controller(config, robot, weights, place) for place in PLATFORMS}
    walked = record(config, robot, weights, command, seconds)
    _, example = controller(config, robot, weights)
    found = check(config, load_controller(blobs["cpu"]), example, walked)
    if not max(found.force, found.moment, found.torque) <= TOLERANCE:
        raise Broken(
            f"the exported controller differs from the live one by {found.force:.1e} N, "
            f"{found.moment:.1e} N m and {found.torque:.1e} N m at the joints, at most "
            f"{TOLERANCE:g} was expected; nothing was written"
        )
    # the card vouches for the others: it goes first and comes last
    (folder / "controller.json").unlink(missing_ok=True)
    save_weights(folder / "weights.json", weights, SCHEMA)
    write_json(folder / SCHEMA, weights_schema())
    write_file(folder / "weights.cpp", weights_cpp(weights, config, robot, name).encode())
    rows = io.BytesIO()
    np.savez(rows, **_as_arrays(walked))
    contents = {f"controller-{place}.jaxexport": blob for place, blob in blobs.items()}
    contents["check.npz"] = rows.getvalue()
    for file, content in contents.items():
        write_file(folder / file, content)
    for file in ("weights.json", SCHEMA, "weights.cpp"):
        contents[file] = (folder / file).read_bytes()
    card = {
        "name": name,
        "sha256": {file: hashlib.sha256(blob).hexdigest() for file, blob in contents.items()},
        "signature": {
            **_described(
                {part: text for part, text in _SIGNATURE.items() if part != "out"},
                dict(zip(_SIGNATURE, example, strict=False)),
            ),
            "out": _SIGNATURE["out"],
        },
        "constants": {
            "milliseconds_per_plan": substeps(config),
            "millisecond_of_tick_0": walked.lead,
            "joint_names": list(robot.description.joints),
            "standing_joints": robot.standing_joints.tolist(),
            "standing_height": float(robot.standing_height),
            "com_offset": robot.com_offset.tolist(),
            "torque_limit": robot.torque_limit.tolist(),
        },
        "weights": weights_tree(weights),
        "controller": asdict(config),
        "robot": tree_hash(robot),
        "versions": versions(),
        "check": {"milliseconds": len(walked.torque), **found._asdict()},
    }
    write_json(folder / "controller.json", card)
    return card
