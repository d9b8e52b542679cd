"""The weights of an export: their JSON schema, and the lines for the open HECTOR C++ controller."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from hector_jax.control.contact import LINE_FRICTION
from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import TUNABLES
from hector_jax.control.weights import Weights, nominal
from hector_jax.control.weights_file import WEIGHTS, weights_tree
from hector_jax.core.settings import Range
from hector_jax.core.trajectory import Wrench, pack_wrench
from hector_jax.robot.model import Robot

_DESCRIPTIONS = {
    "Q": "of the squared error of each state, world frame",
    "euler": "roll, pitch, yaw [1/rad^2]",
    "position": "x, y, z of the centre of mass [1/m^2]",
    "ang_velocity": "x, y, z [s^2/rad^2]",
    "velocity": "x, y, z [s^2/m^2]",
    "R": "of the squared wrench of the ground on each foot, left then right, world frame",
    "force": "x, y, z [1/N^2]",
    "moment": "x, y, z [1/(N m)^2]",
}
_STATES = ("roll, pitch, yaw", "x, y, z", "their rates: wx, wy, wz", "vx, vy, vz")
_INPUTS = ("force, foot 0 (left)", "force, foot 1 (right)", "moment, foot 0", "moment, foot 1")


def weights_schema(robot: Robot | None = None) -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a weights file of a robot, HECTOR by default."""
    schema = _schema(weights_tree(nominal()))
    others = {
        name: _schema(np.zeros(one.shape(robot)).tolist(), Range(one.lower, one.upper))
        for name, one in TUNABLES.items()
    }
    schema["properties"] |= {
        "$schema": {"type": "string"},
        "others": {"type": "object", "properties": others, "additionalProperties": False},
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Weights of the walking MPC: diagonals of |x - x_ref|^2_Q + |u|^2_R",
        **schema,
    }


def _schema(example: Any, range: Range = WEIGHTS) -> dict[str, Any]:
    """Schema of values in a range that are nested as the example is."""
    if isinstance(example, dict):
        properties = {
            name: {"description": _DESCRIPTIONS[name], **_schema(value)}
            for name, value in example.items()
        }
        names = {"properties": properties, "required": list(example)}
        return {"type": "object", **names, "additionalProperties": False}
    if isinstance(example, list):
        count = len(example)
        return {
            "type": "array",
            "items": _schema(example[0], range),
            "minItems": count,
            "maxItems": count,
        }
    return {"type": "number", "minimum": range.low, "maximum": range.high}


_HEADER = """\
// Weights {name!r}, tuned with hector_jax, for DRCL-USC/Hector_Simulation, branch
// ROS_Simulation: these take the place of Q and Alpha in updateMPCIfNeeded() of
// hector_control/ConvexMPC/ConvexMPCLocomotion.cpp.
//
// Both controllers minimise sum |x - x_ref|^2_Q + |u|^2_Alpha, world frame, in SI; the numbers go
// over as they are. They were tuned with {mass:.4g} kg, steps of {dt:g} s, {horizon} of them,
// |F_x| + |F_y| <= {mu:g} F_z <= {limit:g} N, -{toe:.3g} F_z <= M_y <= {heel:.3g} F_z, M_x = 0,
// friction at toe and heel: {line}. What differs in the C++ controller is in docs/export.md of
// hector_jax: read it before walking.
"""
_ATTENTION = """\
// ATTENTION: R prices u less the feet's share of the weight here, u itself there: Alpha was not
// tuned for that.
"""


def weights_cpp(weights: Weights, config: WalkConfig, robot: Robot, *, name: str) -> str:
    """The weights as the two lines of the open HECTOR C++ controller.

    Args:
        weights: to write.
        config: the controller that they were tuned for.
        robot: its body.
        name: of the weights, for the first line.

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
    Alpha = pack_wrench(Wrench(*map(jnp.asarray, weights.R)))
    others = weights_tree(weights).get("others", {}).items()
    return "".join(
        [
            header,
            _ATTENTION if numbers.effort_reference else "",
            *(f"// ATTENTION: tuned with {name} {value}.\n" for name, value in others),
            _block("Q", np.concatenate(weights.Q), _STATES),
            _block("Alpha", Alpha, _INPUTS),
        ]
    )


def _block(kind: str, values: Any, names: tuple[str, ...]) -> str:
    rows = np.asarray(values, float).reshape(4, 3).tolist()
    lines = [
        f"    {', '.join(map(repr, row))},  // {name}\n"
        for row, name in zip(rows, names, strict=True)
    ]
    return "".join([f"double {kind}[12] = {{\n", *lines, "};\n"])
