"""The controller as C: `controller.c` and `controller.h` from a configuration and a robot.

The templates are the C program; what is filled in are sizes, tables and the constraints in use.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import TUNABLES
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import WEIGHTS
from hector_jax.core.geometry import inverse
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import FEET
from hector_jax.robot.kinematics import NEWTON_STEPS
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import first_tick, substeps

# sides of a contact for each of the constraints that the template has
_SIDES = {
    "friction": 4,
    "unilateral_force": 2,
    "line_pressure": 2,
    "line_friction": 4,
    "side_pressure": 2,
    "torsion": 2,
    "corner_friction": 12,
}
_COMPONENTS = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")
PIECES = 16  # of a command, at least
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)


def controller_source(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    *,
    name: str,
    content: bytes,
    pieces: int = 0,
) -> dict[str, str]:
    """Return `controller.c` and `controller.h` by their names.

    Args:
        config, robot, weights: the controller.
        name: of the weights, for the first line.
        content: of the weights file, whose sha256 is in the header.
        pieces: of a command, if more than PIECES.

    Raises:
        InputError: constraints or costs of one's own, which are Python.
    """
    mpc = config.mpc
    constraints = [part.name for part in (*mpc.on("inputs"), *mpc.on("states"))]
    own = [part for part in constraints if part not in _SIDES] + [c.name for c in mpc.costs]
    if own:
        text = f"the C controller has the constraints {', '.join(_SIDES)} and no costs beside Q and"
        raise InputError(f"{text} R, got {', '.join(own)}")
    values = {
        "robot": robot.description.name,
        "name": name,
        "sha256": hashlib.sha256(content).hexdigest(),
        "pieces": max(pieces, PIECES),
        "tolerance": mpc.qp.tolerances(jnp.dtype(float)).residual,
        "constraints": constraints,
        **_of_robot(config, robot),
        **_of_times(config),
        **_sizes(config, sum(_SIDES[part] for part in constraints)),
    }
    values["tunables"] = dict(_tunables(config, robot, weights))
    return {f: _TEMPLATES.get_template(f"{f}.j2").render(c=_c, **values) for f in FILES}


FILES = ("controller.h", "controller.c")


def _c(value: Any) -> str:
    """Return an array as a C initialiser, to the last bit."""
    if np.ndim(value):
        return "{ " + ", ".join(map(_c, value)) + " }"
    return "INFINITY" if value == np.inf else repr(np.asarray(value).item())


def _of_times(config: WalkConfig) -> dict[str, Any]:
    """Return the times of gait and plan."""
    gait = config.gait
    return {
        "horizon": config.mpc.horizon,
        "tick": gait.tick,
        "dt": config.mpc_step,
        "step_ticks": config.mpc.step_ticks,
        "stance": gait.stance,
        "swing": gait.swing,
        "first_tick": gait.first_tick,
        "lead_ticks": np.rint(gait.cycle * np.array(gait.offsets)).astype(int),
        "begin": first_tick(config),
        "period": substeps(config),
        "lead": -first_tick(config) * substeps(config),
    }


def _of_robot(config: WalkConfig, robot: Robot) -> dict[str, Any]:
    """Return the tables of the robot, joints leg by leg."""
    structure, count = robot.structure, len(robot.foot_point)
    by_leg = {
        part: np.asarray(getattr(robot, part)).reshape(count, -1)
        for part in ("joint_lower", "joint_upper", "standing_joints", "link_mass")
    }
    inertia = jnp.asarray(config.mpc.planned_inertia(robot.inertia))
    axes = robot.joint_axis
    return {
        "feet": FEET[count],
        "joints": np.reshape(robot.description.joints, (count, -1)).tolist(),
        "mass": float(robot.mass),
        "gravity": robot.gravity,
        "max_force": config.mpc.max_force,
        "inverse_inertia": np.asarray(inverse(inertia)),
        "com_offset": robot.com_offset,
        "height": float(robot.standing_height),
        "toe": float(robot.toe),
        "heel": float(robot.heel),
        "half_width": float(config.mpc.sole_width * robot.half_width),
        "foot_ahead": robot.foot_ahead,
        "footholds": config.footstep.rule,
        "slip_distance": float(config.slip.distance * robot.standing_height),
        "slip_share": config.slip.share,
        "recovery": config.slip.recovery,
        "joint_origin": robot.joint_origin,
        # the closed form takes its axes as exact
        "joint_axis": np.round(axes) if structure.closed_form else axes,
        "foot_point": robot.foot_point,
        "soles": robot.sole,
        "link_com": robot.link_com,
        "torque_limit": robot.torque_limit,
        "closed_form": structure.closed_form,
        "placed": structure.placed,
        "newton_steps": NEWTON_STEPS,
        **by_leg,
    }


def _sizes(config: WalkConfig, sides: int) -> dict[str, Any]:
    """Return the sizes of the QP, what it costs and the memory that it takes."""
    feet, steps, model = len(config.gait.offsets), config.mpc.horizon, config.mpc.contact
    contacts, usual = steps * feet, steps * config.gait.most_contacts * model.inputs
    variables, limit = contacts * model.inputs, 100 + 6 * usual

    def work(n: int, active: int, changes: int) -> float:
        """Return multiplications: three factorisations' worth, and the changes of active rows."""
        change = 6 * n * n + 9 * n * active + 6 * active**2 + 2 * contacts * sides * model.inputs
        return n**3 / 2 + changes * change

    return {
        "contacts": contacts,
        "inputs": model.inputs,
        "component": model.components,
        "components": [_COMPONENTS[i] for i in model.components],
        "moments": max(model.components) > 2,
        "sides": sides,
        "variables": variables,
        "limit": limit,
        "usual": work(usual, usual // 5, usual // 5),
        "most": work(variables, variables, limit),
        "bytes": 8 * (4 * variables**2 + contacts * sides * (model.inputs + 1) + 12 * variables),
    }


def _tunables(
    config: WalkConfig, robot: Robot, weights: Weights
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the names of the tunables with the exported values and their bounds.

    The bounds are those of a weights file, and further out if the exported value is.
    """
    parameters = jax.tree.map(np.asarray, config.parameters(weights))
    named = {"Q": np.concatenate(weights.Q), "R_force": weights.R.force}
    named |= {"R_moment": weights.R.moment} if weights.R.moment.size else {}
    named |= {name: tunable.read(parameters) for name, tunable in TUNABLES.items()}
    for name, value in named.items():
        box = TUNABLES.get(name)
        low, high = (box.lower, box.upper) if box else (WEIGHTS.low, WEIGHTS.high)
        value = np.asarray(value, float)
        edges = np.minimum(value, low), np.maximum(value, high)
        yield name, dict(zip(("exported", "lower", "upper"), (value, *edges), strict=True))
