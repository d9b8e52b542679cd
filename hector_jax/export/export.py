"""Export for the robot: the weights with their schema, and the controller as C.

A recorded walk with the outputs of the live controller lies beside the files; where there is a C
compiler, nothing is written unless the compiled controller returns the same outputs (`TOLERANCE`).
"""

import hashlib
import io
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.control.contact import LINE_FRICTION
from hector_jax.control.controller import WalkConfig
from hector_jax.control.mpc import input_weights
from hector_jax.control.parameters import COST, TUNABLES, tunable
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, nominal
from hector_jax.control.weights_file import WEIGHTS, weights_tree
from hector_jax.core.console import Broken, say
from hector_jax.core.environment import versions
from hector_jax.core.files import as_json, locked, write_file, write_json
from hector_jax.core.inputs import plural
from hector_jax.core.settings import Range, to_table
from hector_jax.core.tree_file import tree_hash
from hector_jax.export.check import (
    Check,
    WalkRecord,
    as_arrays,
    compare_with_live,
    compile_controller,
    compiler,
    record,
)
from hector_jax.export.source import controller_source, with_prefix
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import ideal

SCHEMA = "weights.schema.json"
TOLERANCE = 1e-6
"""Largest difference [N, N m] from the live controller."""

_DESCRIPTIONS = {
    "Q": "of the squared error of each state, world frame",
    "euler": "roll, pitch, yaw [1/rad^2]",
    "position": "x, y, z of the centre of mass [1/m^2]",
    "ang_velocity": "x, y, z [s^2/rad^2]",
    "velocity": "x, y, z [s^2/m^2]",
    "R": "of the squared wrench of the ground on each foot, left ones first, world frame",
    "force": "x, y, z [1/N^2]",
    "moment": "x, y, z [1/(N m)^2]",
}
_STATES = ("roll, pitch, yaw", "x, y, z", "their rates: wx, wy, wz", "vx, vy, vz")
_INPUTS = ("force, foot 0 (left)", "force, foot 1 (right)", "moment, foot 0", "moment, foot 1")


def _require_same(result: Check) -> None:
    """Raise `Broken` if the compiled controller differs from the live one or fails to solve."""
    if not np.max(result[:3]) <= TOLERANCE:
        raise Broken(
            f"the compiled controller differs from the live one by {result.force:.1e} N, "
            f"{result.moment:.1e} N m and {result.torque:.1e} N m at the joints, at most "
            f"{TOLERANCE:g} was expected; nothing was written"
        )
    if result.unsolved:
        what = plural(result.unsolved, "QP") + (" was" if result.unsolved == 1 else " were")
        raise Broken(f"{what} not solved on the walk of the check; nothing was written")


def _checked(
    config: WalkConfig, robot: Robot, source: dict[str, str], recorded: WalkRecord
) -> dict[str, Any] | None:
    """Compile the source, compare it with the live controller; None where it cannot run."""
    if compiler() is None:
        say("there is no C compiler (cc): the check of controller.c did not run")
        return None
    with tempfile.TemporaryDirectory() as folder:
        if os.statvfs(folder).f_flag & os.ST_NOEXEC:
            say(f"no program runs in {folder} (TMPDIR): the check of controller.c did not run")
            return None
        library = compile_controller(source, Path(folder))
        result = compare_with_live(config, robot, library, recorded)
    _require_same(result)
    return {"milliseconds": len(recorded.torque), **result._asdict()}


def _times(check: dict[str, Any] | None) -> str:
    """Return the longest calls of a check for the header."""
    if check is None:
        return "not measured"
    plan, hold = (check[f"{kind}_ms"]["max"] for kind in ("plan", "hold"))
    return f"a plan {plan:.2g} ms, a hold {hold:.2g} ms, on the computer that exported"


def export(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    folder: Path,
    *,
    name: str,
    seconds: float = 1.0,
    prefix: str = "controller",
) -> dict[str, Any]:
    """Write everything that goes to the robot, replacing existing files.

    Args:
        config, robot, weights: the controller, its robot and the weights to export.
        command, seconds: command and length of the walk of the check, from t = 0 on.
        folder: folder to write.
        name: name of the weights, for the files.
        prefix: of files and names of the C program, so that two can be in one program.

    Returns:
        The card, also in `controller.json`: sha256 of the files, weights, settings and the check,
        which is None if there is no C compiler or the compiled program cannot run.

    Raises:
        InputError: see `record` and `controller_source`; or the folder cannot be written.
        Broken: the compiled controller differs from the live one by more than TOLERANCE, or a QP
            of the check was not solved; nothing is written.
    """
    weights_json = (as_json({"$schema": SCHEMA} | weights_tree(weights), indent=2) + "\n").encode()
    given = {"name": name, "content": weights_json, "pieces": len(command.duration)}
    source = controller_source(config, robot, weights, **given)
    with_prefix(source, prefix)  # refuses before the walk what it refuses
    with locked(folder):
        job = Job(weights, command, ideal(robot.description), seconds)
        recorded = record(config, robot, job)
        check = _checked(config, robot, source, recorded)
        # the card has the hashes of the other files: it is removed first and written last
        (folder / "controller.json").unlink(missing_ok=True)
        np.savez(archive := io.BytesIO(), **as_arrays(recorded))
        source = controller_source(config, robot, weights, **given, measured=_times(check))
        contents = {file: text.encode() for file, text in with_prefix(source, prefix).items()}
        contents["weights.json"] = weights_json
        contents[SCHEMA] = (as_json(weights_schema(robot), indent=2) + "\n").encode()
        if len(robot.foot_point) == 2:  # the C++ controller is for bipeds
            contents["weights.cpp"] = weights_cpp(weights, config, robot, name=name).encode()
        contents["check.npz"] = archive.getvalue()
        for file, content in contents.items():
            write_file(folder / file, content)
        card = {
            "name": name,
            "sha256": {file: hashlib.sha256(x).hexdigest() for file, x in contents.items()},
            "weights": weights_tree(weights),
            "controller": to_table(config),
            "robot": tree_hash(robot),
            "versions": versions(),
            "check": check,
        }
        write_json(folder / "controller.json", card)
        return card


def weights_schema(robot: Robot | None = None) -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of a weights file of a robot, HECTOR by default."""
    schema = _schema(weights_tree(nominal(robot)))
    others = {
        name: _schema(np.zeros(number.shape(robot)).tolist(), Range(number.lower, number.upper))
        for name, number in TUNABLES.items()
    }
    factor = tunable(COST)
    schema["properties"] |= {
        "$schema": {"type": "string"},
        "others": {
            "type": "object",
            "properties": others,
            "patternProperties": {f"^{COST}": _schema(1.0, Range(factor.lower, factor.upper))},
            "additionalProperties": False,
        },
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Weights of the walking MPC: diagonals of |x - x_ref|^2_Q + |u|^2_R",
        **schema,
    }


def _schema(example: Any, range: Range = WEIGHTS) -> dict[str, Any]:
    """Return the schema of values in a range with the nesting of an example."""
    if isinstance(example, dict):
        properties = {
            name: {"description": _DESCRIPTIONS[name], **_schema(value)}
            for name, value in example.items()
        }
        names = {"properties": properties, "required": list(example)}
        return {"type": "object", **names, "additionalProperties": False}
    if isinstance(example, list):
        size = {"minItems": len(example), "maxItems": len(example)}
        return {"type": "array", "items": _schema(example[0], range), **size}
    return {"type": "number", "minimum": range.low, "maximum": range.high}


_HEADER = """\
// Weights {name!r}, tuned with hector_jax, for DRCL-USC/Hector_Simulation, branch
// ROS_Simulation: these take the place of Q and Alpha in updateMPCIfNeeded() of
// hector_control/ConvexMPC/ConvexMPCLocomotion.cpp.
//
// Both controllers minimise sum |x - x_ref|^2_Q + |u|^2_Alpha, world frame, in SI; the numbers go
// over as they are. They were tuned with {mass:.4g} kg, steps of {dt:g} s, {horizon} of them,
// |F_x| + |F_y| <= {mu:g} F_z <= {limit:g} N, -{toe:.3g} F_z <= M_y <= {heel:.3g} F_z, M_x = 0,
// friction at toe and heel: {line}. What differs in the C++ controller is in docs/export-cpp.md
// of hector_jax: read it before walking.
"""
_ATTENTION = """\
// ATTENTION: R prices u less the feet's share of the weight here, u itself there: Alpha was not
// tuned for that.
"""
_COSTS = "// ATTENTION: tuned beside costs that the C++ controller has not: {}.\n"


def weights_cpp(weights: Weights, config: WalkConfig, robot: Robot, *, name: str) -> str:
    """Return the weights as the two arrays of the open HECTOR C++ controller.

    Args:
        weights: weights to write.
        config: controller that they were tuned for.
        robot: robot of the controller.
        name: name of the weights, for the first line.

    Source: DRCL-USC/Hector_Simulation, branch ROS_Simulation, ConvexMPCLocomotion.cpp and
        SolverMPC.cpp at commit 79d545a, read for order and factors.
    """
    mpc, numbers = config.mpc, config.parameters(weights).mpc
    header = _HEADER.format(
        name=name,
        mass=float(robot.mass),
        dt=config.mpc_step,
        horizon=mpc.horizon,
        mu=float(numbers.friction),
        limit=float(numbers.friction * numbers.max_force),
        toe=float(robot.toe),
        heel=float(robot.heel),
        line=LINE_FRICTION in mpc.on("inputs"),
    )
    others = weights_tree(weights).get("others", {}).items()
    notes = [f"// ATTENTION: walks with {name} {value}.\n" for name, value in others]
    if mpc.costs:
        notes.append(_COSTS.format(", ".join(map(str, mpc.costs))))
    Q = _cpp_array("Q", np.concatenate(weights.Q), _STATES)
    Alpha = _cpp_array("Alpha", input_weights(weights), _INPUTS)
    return "".join([header, _ATTENTION * bool(numbers.effort_reference), *notes, Q, Alpha])


def _cpp_array(variable: str, values: Any, names: tuple[str, ...]) -> str:
    rows = zip(np.asarray(values, float).reshape(4, 3).tolist(), names, strict=True)
    lines = [f"    {', '.join(map(repr, row))},  // {name}\n" for row, name in rows]
    return "".join([f"double {variable}[12] = {{\n", *lines, "};\n"])
