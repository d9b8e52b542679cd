"""Propose the TOML of a model's file: the names that `survey` finds, and settings by rules.

Rules scale HECTOR (m0 = 12 kg; h0 = 0.423 m, the height of its centre of mass standing) to a robot
of mass m and height h:

    armature                 2e-4 kg m^2 per N m of torque limit for joints that have no armature
    stance, swing [ticks]    20 sqrt(h / h0): a pendulum's time
    step_ticks               0.15 swing, rounded up, at least 3: ten MPC steps reach past one swing
    max_force                2.5 m g
    effort_reference         "gravity": otherwise the plan jumps before single stance
    sole_width               0.6 of a flat foot's: otherwise it rolls over its edge
    pattern                  "trot" for four feet
    width                    0.85 (four feet: 0.7) of half the distance of the foot points, standing
    feedback                 0.12 s sqrt(h / h0)
    height                   0.06 m h / 0.69 m for the swing foot; landing -0.005 m
    kp                       I w^2 with I the inertia at the joint with its motor and w the largest
                             with which slow motors leave the joints a phase margin of 30 degrees
                             (`response`); at most 2 / rad times the torque limit
    kd                       sqrt(kp I)
    mpc.inertia              that share which leaves the plan's attitude the same phase margin
    Q                        HECTOR's
    R of forces, moments     times (m0 / m)^2, (m0 h0 / (m h))^2; for nominal times 0.3 as well
    L_ctrl                   times (m0 / m)^2
    lead                     one gait cycle in place before the command of a rollout
    touchdown_error          true: heavy legs miss the planned touchdown by some centimetres
    estimate_noise, delay    1, 0.005 s: without them a tuning takes gains that shake the robot
    choice_plants            4: tuning can improve the model's walk and worsen the robot's
    joint_friction, _damping times m h / (m0 h0); push, payload: m / m0; trunk_com: h / h0
    min_height               0.55 h
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import FEET
from hector_jax.robot.checks import standing_data
from hector_jax.robot.description import Description, description_of
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.model import Robot, compile_model, robot_of
from hector_jax.robot.response import (
    Response,
    planned_inertia,
    response,
    swing_frequency,
    trunk_gain,
)
from hector_jax.robot.soles import Sole, find_soles
from hector_jax.robot.stand import standing_pose
from hector_jax.robot.survey import Survey, survey_file

MASS, HEIGHT = 12.0, 0.423  # of HECTOR [kg], [m]
_TICK = 0.01  # [s] of the gait
_ANGLE, _RATE = 50, 1  # weights Q of attitude and angular velocity
_KP_PER_LIMIT = 2.0  # [1/rad]
_ARMATURE_PER_LIMIT = 2e-4  # [s^2]: HECTOR's has 2.4e-4, Unitree's robots 1e-4 to 4e-4
_COLUMNS = 100


class Proposal(NamedTuple):
    """The proposed TOML of a model's file."""

    survey: Survey
    soles: tuple[Sole, ...]
    table: dict[str, Any]
    wrong: tuple[str, ...]  # one line per problem to correct by hand


class Size(NamedTuple):
    """The inputs of the rules."""

    mass: float  # relative to HECTOR's
    height: float  # relative to HECTOR's
    robot: Robot
    inertia: Float[np.ndarray, " joints"]  # at each joint, standing [kg m^2]


def propose(path: Path) -> Proposal:
    """Return the proposed TOML of a model's file.

    Raises:
        InputError: one line with the missing part of the file and the remedy.
    """
    survey = survey_file(path)
    soles = find_soles(survey)
    angles, balanced = standing_pose(survey, soles)
    if len(soles[0].contacts) == 1:  # a round foot, whose contact moves when the leg bends
        soles = find_soles(survey, angles)
        angles, balanced = standing_pose(survey, soles, angles)
    table, wrong = _names(survey, soles, angles), []
    if soles[0].guessed:
        wrong.append(
            f"no box, sphere, capsule or cylinder of body {soles[0].section['body']!r} collides: "
            "its contacts are guessed from its inertia: measure the sole and correct "
            f"{' and '.join(f'feet.{leg}' for leg in FEET[len(soles)])}"
        )
    if not balanced:
        wrong.append(
            "no standing pose found with level soles and the centre of mass over the feet: correct "
            "the angles of [standing]"
        )
    description = description_of(Path(path).with_suffix(".toml"), table)
    try:
        robot = robot_of(description)
    except InputError as error:
        return Proposal(survey, soles, table, (*wrong, str(error)))
    if armature := _armature(survey, robot):
        table["joints"]["armature"] = armature
        description = description_of(description.path, table)
    table |= _settings(size_of(description, robot))
    return Proposal(survey, soles, table, tuple(wrong))


def _names(survey: Survey, soles: Sequence[Sole], angles: dict[str, float]) -> dict[str, Any]:
    """Return the part of the TOML with names and standing angles."""
    joints: dict[str, Any] = {}
    feet = {}
    for name, leg, sole in zip(FEET[len(soles)], survey.legs, soles, strict=True):
        joints[name] = [survey.model.joint(j).name for j in leg]
        feet[name] = sole.section
    if survey.weld:
        joints["weld"] = list(survey.weld)
    stem = "".join(x if x.isalnum() or x in "-_" else "-" for x in survey.path.stem)
    table = {"name": stem, "model": survey.path.name, "standing": angles}
    return {**table, "joints": joints, "feet": feet}


def size_of(description: Description, robot: Robot) -> Size:
    """Return the inputs of the rules for a robot."""
    model = compile_model(description)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, standing_data(description, model), M)
    mass, height = float(robot.mass), float(robot.standing_height)
    return Size(mass / MASS, height / HEIGHT, robot, M.diagonal()[6:])


def _settings(size: Size) -> dict[str, Any]:
    """Return the part of the TOML with the settings that follow from the rules."""
    robot, mass, root = size.robot, size.mass, math.sqrt(size.height)
    height, weight = float(robot.standing_height), float(robot.mass * robot.gravity[2])
    ticks, torque = round(20 * root), _short(mass * size.height)
    foot_y = foot_poses(robot, jnp.asarray(robot.standing_joints)).position[:, 1]
    four = len(foot_y) == 4
    flat = robot.structure.contact == "flat"
    step_ticks, answer = max(3, math.ceil(0.15 * ticks)), response(robot)
    return {
        "limits": {"min_height": round(0.55 * height, 2)},
        "gait": ({"pattern": "trot"} if four else {}) | {"stance": ticks, "swing": ticks},
        "mpc": {
            "step_ticks": step_ticks,
            "max_force": float(f"{2.5 * weight:.2g}"),
            "effort_reference": "gravity",
            **({"sole_width": 0.6} if flat else {}),
            "inertia": _inertia(robot, answer, _TICK * step_ticks),
        },
        "footstep": {
            "width": round((0.7 if four else 0.85) * float(np.abs(foot_y).mean()), 3),
            "feedback": round(0.12 * root, 3),
        },
        "legs": {
            "height": round(0.06 * height / 0.69, 3),
            "landing": -0.005,
            **_gains(size, answer),
            "gravity_compensation": True,
        },
        "weights": _weights(size),
        "loss": {"L_ctrl": _short(mass**-2)},
        "tuning": {
            "lead": 2 * ticks,
            "touchdown_error": True,
            "estimate_noise": 1,
            "delay": 0.005,
            "choice_plants": 4,
        },
        "plants": {
            "joint_friction": torque,
            "joint_damping": torque,
            "push": _short(mass),
            "trunk_com": _short(size.height),
            "payload": _short(mass),
        },
    }


def _armature(survey: Survey, robot: Robot) -> list[float] | None:
    """Return the armature of a leg's motors [kg m^2], by the rule if the file has none."""
    leg = list(survey.legs[0])
    armature = survey.model.dof_armature[survey.model.jnt_dofadr[leg]]
    default = _ARMATURE_PER_LIMIT * robot.torque_limit[: len(leg)]
    complete = np.all(armature)
    return None if complete else [_short(x) for x in np.where(armature, armature, default)]


def _inertia(robot: Robot, answer: Response, step: float) -> list[float]:
    """Return the shares of the inertia with which an MPC of a step [s] plans."""
    gain = trunk_gain(robot, answer)
    shares = planned_inertia(gain, angle=_ANGLE, rate=_RATE, step=step, tick=_TICK)
    return [round(float(share), 2) for share in shares]


def _gains(size: Size, answer: Response) -> dict[str, list[float]]:
    """Return the gains of a leg's joints from the mean inertia and least torque of all legs."""
    legs = len(size.robot.foot_point)
    inertia = size.inertia.reshape(legs, -1).mean(axis=0)
    limit = size.robot.torque_limit.reshape(legs, -1).min(axis=0)
    kp = np.minimum(inertia * swing_frequency(answer) ** 2, _KP_PER_LIMIT * limit)
    return {"kp": [_short(x) for x in kp], "kd": [_short(x) for x in np.sqrt(kp * inertia)]}


def _weights(size: Size) -> dict[str, Any]:
    """Return HECTOR's Q, and R scaled by the squares of mass and of mass times height."""
    force, moment = size.mass**-2, (size.mass * size.height) ** -2
    rates = {"ang_velocity": _RATE, "velocity": 1}
    return {
        "nominal": {
            "euler": _ANGLE,
            "position": [50, 50, 250],
            **rates,
            "force": _short(0.3e-4 * force),
            "moment": _short(0.3e-3 * moment),
        },
        "expert": {
            "euler": [100, 100, 250],
            "position": [200, 200, 300],
            **rates,
            "force": [_short(x * force) for x in (1e-4, 1e-4, 5e-4)],
            "moment": _short(1e-2 * moment),
        },
    }


def _short(x: float) -> float:
    """Return a number rounded to three digits."""
    return float(f"{x:.3g}")


def as_toml(table: dict[str, Any], comments: Sequence[str]) -> str:
    """Return a table as the text of a TOML file that begins with comments."""
    lines = [f"# {line}" for line in comments]
    lines += [_line(key, value) for key, value in table.items() if not isinstance(value, dict)]
    for name, section in table.items():
        if isinstance(section, dict):
            nested = section and all(isinstance(value, dict) for value in section.values())
            parts = {f"{name}.{key}": value for key, value in section.items()} if nested else {}
            for title, part in (parts or {name: section}).items():
                lines += ["", f"[{title}]", *(_line(key, value) for key, value in part.items())]
    return "\n".join(lines) + "\n"


def _line(key: str, value: Any) -> str:
    """Return a key and its value; a long list is wrapped into several lines."""
    bare = key.replace("_", "").replace("-", "")
    name = key if bare.isalnum() and bare.isascii() else json.dumps(key)
    text = f"{name} = {_value(value)}"
    if len(text) <= _COLUMNS or not isinstance(value, list):
        return text
    rows, row = [], ""
    for item in map(_value, value):
        if row and len(row) + len(item) + 5 > _COLUMNS:
            rows.append(row)
            row = ""
        row += f"{' ' if row else ''}{item},"
    return "\n".join([f"{name} = [", *(f"  {r}" for r in (*rows, row)), "]"])


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, float):
        return f"{value:.10g}" if abs(value) < 1e15 else repr(value)
    return json.dumps(value)
