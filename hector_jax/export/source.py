"""The controller as C: `controller.c` and `controller.h` from a configuration and a robot.

The templates are the C program: vectors, gait, reference, torques and interface in `controller`,
then `legs`, `qp` and `mpc`; in `ros2_control` a package of ROS 2 around it. What is filled in are
sizes, tables and the constraints in use.
"""

import hashlib
import json
import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hector_jax.control.contact import Constraint
from hector_jax.control.controller import WalkConfig
from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.parameters import TUNABLES, Q, R
from hector_jax.control.twin import TwinConfig
from hector_jax.control.weights import Weights
from hector_jax.core.environment import versions
from hector_jax.core.files import as_json
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import to_table
from hector_jax.core.trajectory import FEET
from hector_jax.core.tree_file import tree_hash
from hector_jax.robot.kinematics import NEWTON_STEPS
from hector_jax.robot.model import Robot
from hector_jax.sim.loop import first_tick, substeps

# Sides of a contact by constraint, as C: coefficients of (F_x, F_y, F_z, M_x, M_y, M_z), each F in
# the world and M in the foot's frame, of which the sum is at most a seventh number, zero by
# default. The formulas are those of `control.contact`; cs and sn are of the foot's yaw.
_SIDES = {
    "friction": ["1, 1, -mu", "-1, -1, -mu", "1, -1, -mu", "-1, 1, -mu"],
    "box_friction": ["cs, sn, -mu", "-cs, -sn, -mu", "-sn, cs, -mu", "sn, -cs, -mu"],
    "unilateral_force": ["0, 0, -1", "0, 0, 1, 0, 0, 0, MAX_FORCE"],
    "line_pressure": ["0, 0, -TOE, 0, -1", "0, 0, -HEEL, 0, 1"],
    "line_friction": [
        "-HEEL * sn, HEEL * cs, -grip * HEEL, 0, grip, 1",
        "HEEL * sn, -HEEL * cs, -grip * HEEL, 0, grip, -1",
        "-TOE * sn, TOE * cs, -grip * TOE, 0, -grip, -1",
        "TOE * sn, -TOE * cs, -grip * TOE, 0, -grip, 1",
    ],
    "side_pressure": [f"0, 0, -HALF_WIDTH, {s}" for s in (1, -1)],
    "twist": [f"0, 0, -TWIST, 0, 0, {s}" for s in (1, -1)],
    "torsion": [f"0, 0, -0.5 * grip * DIAGONAL, 0, 0, {s}" for s in (1, -1)],
    "corner_friction": [
        *("cs, sn, -inner", "-cs, -sn, -inner", "-sn, cs, -inner", "sn, -cs, -inner"),
        *(
            f"{a} * HALF_WIDTH * cs - ({b} * HALF_LENGTH - {s} * MIDDLE) * sn, "
            f"{a} * HALF_WIDTH * sn + ({b} * HALF_LENGTH - {s} * MIDDLE) * cs, "
            f"inner * ({s * b} * MIDDLE - HALF_LENGTH - HALF_WIDTH), "
            f"{s * a} * inner, {s * b} * inner, {s}"
            for a, b, s in product((1, -1), repeat=3)
        ),
    ],
}
_COMPONENTS = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")
PIECES = 16  # of a command, at least
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
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
    measured: str = "not measured",
) -> dict[str, str]:
    """Return the texts of FILES by their names.

    Args:
        config, robot, weights: the controller.
        name: of the weights, for the first line.
        content: of the weights file, whose sha256 is in the header.
        pieces: of a command, if more than PIECES.
        measured: times of calls, for the header.

    Raises:
        InputError: constraints or costs of one's own, which are Python; or a twin.
    """
    sides = [side for part in _constraints(config) for side in _SIDES[part]]
    table = as_json(to_table(config)).encode()
    hashes = {"weights": hashlib.sha256(content).hexdigest(), "robot": tree_hash(robot)}
    values = {
        "config": config,
        "robot": robot,
        "name": name,
        "version": versions().get("hector-jax", "of an unknown version"),
        "sha256": hashes | {"settings": hashlib.sha256(table).hexdigest()},
        "feet": FEET[len(robot.foot_point)],
        "pieces": max(pieces, PIECES),
        "period": substeps(config),
        "sides": sides,
        "moments": max(config.mpc.contact.components) > 2,
        "sizes": _sizes(config, len(sides)),
        "numbers": _numbers(config, robot),
        "tables": _tables(config, robot),
        "tunables": dict(_tunables(config, robot, weights)),
    }

    def render(**others: str) -> dict[str, str]:
        known = {**values, "c": _c, "yaml": _yaml, "names": _NAMES, **others}
        return {f: _TEMPLATES.get_template(f"{f}.j2").render(known) for f in FILES}

    # named by what they are: another export has other names in a program that links both
    text = "".join(render(id="", measured="").values())
    return render(id=hashlib.sha256(text.encode()).hexdigest()[:12], measured=measured)


def _constraints(config: WalkConfig) -> list[str]:
    """Return the names of the constraints; InputError if the C controller cannot have all parts."""
    mpc, footsteps = config.mpc, FootstepConfig()
    ours = footsteps.travel, footsteps.ahead
    if config.twin != TwinConfig() or (config.footstep.travel, config.footstep.ahead) != ours:
        raise InputError("a twin is not exported, but the numbers of a file are: --into")
    parts = (*mpc.on("inputs"), *mpc.on("states"))
    own = [part for part in parts if part not in Constraint.known] + list(mpc.costs)
    if own:
        text = "constraints and costs of your own are functions in Python, and the C controller has"
        listed = ", ".join(map(str, own))
        raise InputError(f"{text} none: {listed}; it has {', '.join(_SIDES)}")
    return [str(part) for part in parts]


ROS2 = "controller_ros2.cpp CMakeLists.txt package.xml plugins.xml parameters.yaml".split()
FILES = ("controller.h", "controller.c", "CMakeLists.txt", *(f"ros2_control/{f}" for f in ROS2))
_NAMES = "size exported lower upper init reset set_tunables set_max_changes drive from_imu".split()
_NAMES += ["plan", "hold", "step", "step_at"]


def with_prefix(source: dict[str, str], prefix: str) -> dict[str, str]:
    """Return source in whose names, files and macros the word controller is another.

    Raises:
        InputError: it is no name in C.
    """
    if not re.fullmatch("[a-z][a-z0-9_]*", prefix):
        raise InputError(f"--prefix must be a name in C in small letters, got {prefix!r}")
    names = r"\bcontroller(?=_(?!interface|manager)|\.[ch]\b)|(?<=struct )controller\b"

    def rename(text: str, names: str = names) -> str:
        return re.sub(r"\bCONTROLLER(?=_)", prefix.upper(), re.sub(names, prefix, text))

    cmake = {"CMakeLists.txt": "controller"}  # all there is a name
    return {rename(f): rename(text, cmake.get(f, names)) for f, text in source.items()}


def _c(value: Any) -> str:
    """Return a value as C writes it, numbers to the last bit and arrays as an initialiser."""
    if isinstance(value, str):
        return json.dumps(value)
    if np.ndim(value):
        return "{ " + ", ".join(map(_c, value)) + " }"
    return "HUGE_VAL" if value == np.inf else repr(np.asarray(value).item())


def _yaml(values: np.ndarray) -> str:
    """Return an array as a list of YAML, where 1e-5 would be text."""
    numbers = (np.format_float_positional(x, trim="0") for x in values.ravel())
    return f"[{', '.join(numbers)}]".replace("inf", ".inf")


def _numbers(config: WalkConfig, robot: Robot) -> dict[str, Any]:
    """Return the numbers of controller and robot, in SI units and in ticks."""
    gait, mpc, slip = config.gait, config.mpc, config.slip
    half, width = 0.5 * (robot.toe + robot.heel), mpc.sole_width * robot.half_width
    numbers = {"TICK": gait.tick, "STANCE": gait.stance, "SWING": gait.swing, "CYCLE": gait.cycle}
    numbers |= {"BEGIN": first_tick(config), "FIRST_TICK": gait.first_tick}
    numbers |= {"STEP_TICKS": mpc.step_ticks, "DT": config.mpc_step, "MASS": robot.mass}
    numbers |= {"MAX_FORCE": mpc.max_force, "TWIST": mpc.twist, "TOE": robot.toe}
    numbers |= {"HEEL": robot.heel, "MIDDLE": 0.5 * (robot.toe - robot.heel)}
    numbers |= {"HALF_LENGTH": half, "HALF_WIDTH": width, "DIAGONAL": np.hypot(half, width)}
    numbers |= {"SLIP_DISTANCE": slip.distance * robot.standing_height}
    numbers |= {"SLIP_LOSS": 1.0 - slip.share, "RECOVERY": slip.recovery}
    numbers |= {"PLACED": len(robot.structure.placed), "NEWTON_STEPS": NEWTON_STEPS}
    return numbers | {"TOLERANCE": mpc.qp.tolerances(jnp.dtype(float)).residual}


def _tables(config: WalkConfig, robot: Robot) -> dict[str, Any]:
    """Return the arrays of controller and robot, joints leg by leg."""
    structure, gait, shape = robot.structure, config.gait, (len(robot.foot_point), -1)
    inertia = np.asarray(config.mpc.planned_inertia(robot.inertia), float)
    tables = {"LEAD": np.rint(gait.cycle * np.array(gait.offsets)).astype(int)}
    tables |= {"COMPONENT": np.array(config.mpc.contact.components), "GRAVITY": robot.gravity}
    tables |= {"INVERSE_INERTIA": np.linalg.inv(inertia), "COM": robot.com_offset}
    tables |= {"ORIGIN": robot.joint_origin, "AXIS": robot.joint_axis}
    tables |= {"FOOT_POINT": robot.foot_point, "SOLE": robot.sole}
    tables |= {"LINK_MASS": robot.link_mass, "LINK_COM": robot.link_com}
    tables |= {"LOWER": robot.joint_lower.reshape(shape), "UPPER": robot.joint_upper.reshape(shape)}
    tables |= {"TORQUE_LIMIT": robot.torque_limit}
    if config.legs.armature:
        tables |= {"ARMATURE": np.array(config.legs.armature)}
    if config.footstep.rule != "paper":
        tables |= {"FOOT_AHEAD": robot.foot_ahead}
    if structure.closed_form:  # which takes its axes as exact
        return tables | {"AXIS": np.round(robot.joint_axis)}
    standing = robot.standing_joints.reshape(shape)
    return tables | {"STANDING": standing, "PLACED_ROW": np.array(structure.placed)}


def _sizes(config: WalkConfig, sides: int) -> dict[str, Any]:
    """Return the sizes of the QP, and what it costs."""
    feet, steps, model = len(config.gait.offsets), config.mpc.horizon, config.mpc.contact
    contacts, usual = steps * feet, steps * config.gait.most_contacts * model.inputs
    variables, limit = contacts * model.inputs, 100 + 6 * usual
    numbers = variables * (4 * variables + 23) + contacts * sides * (model.inputs + 1) + 30 * steps

    def millions(n: int, active: int, changes: int) -> float:
        """Return multiplications: factorisations, and the changes of the active set."""
        change = 6 * n * n + 9 * n * active + 6 * active**2 + 2 * contacts * sides * model.inputs
        return 1e-6 * (2 * n**3 + changes * change)

    sizes = {"steps": steps, "inputs": model.inputs, "sides": sides, "variables": variables}
    sizes |= {"components": ", ".join(_COMPONENTS[i] for i in model.components), "limit": limit}
    sizes |= {"kilobytes": round(8e-3 * numbers) + 2, "stack": 14 + contacts * sides // 100}
    sizes |= {"usual": round(millions(usual, usual // 5, usual // 5), 1)}
    return sizes | {"most": round(millions(variables, variables, limit))}


def _tunables(
    config: WalkConfig, robot: Robot, weights: Weights
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the names of the tunables with the exported values and their bounds.

    The bounds are the box of the tuner, and further out if the exported value is.
    """
    parameters = jax.tree.map(np.asarray, config.parameters(weights))
    named = {"Q": np.concatenate(weights.Q), "R_force": weights.R.force}
    named |= {"R_moment": weights.R.moment} if weights.R.moment.size else {}
    named |= {name: tunable.read(parameters) for name, tunable in TUNABLES.items()}
    for name, value in named.items():
        box, value = TUNABLES.get(name, Q if name == "Q" else R), np.asarray(value, float)
        edges = np.minimum(value, box.lower), np.maximum(value, box.upper)
        yield name, dict(zip(("exported", "lower", "upper"), (value, *edges), strict=True))
