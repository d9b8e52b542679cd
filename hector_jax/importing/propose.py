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
                             with which slow motors leave the joints a phase margin of 20 degrees
                             (`response`); at most 2 / rad times the torque limit
    kd                       sqrt(kp I)
    armature                 that of the model
    inertia_share            that share which leaves the plan's attitude the same phase margin
    Q                        HECTOR's; for nominal 250 on the height
    R of forces, moments     times (m0 / m)^2, (m0 h0 / (m h))^2; for nominal times 0.3 as well
    L_ctrl                   times (m0 / m)^2
    lead                     one gait cycle in place before the command of a rollout
    touchdown_error          true: heavy legs miss the planned touchdown by some centimetres
    estimate_noise, delay    1, 0.005 s: without them a tuning takes gains that shake the robot
    joint_friction, _damping times m h / (m0 h0); push, payload: m / m0; trunk_com: h / h0
    min_height               0.55 h
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hector_jax.core.files import write_file
from hector_jax.core.inputs import InputError, expect
from hector_jax.core.settings import as_toml, from_table, read_toml
from hector_jax.core.trajectory import FEET
from hector_jax.importing.convert import Standard, guessed_numbers, short, to_standard
from hector_jax.importing.draft import PublishedJoints, draft_of
from hector_jax.importing.elements import read_file
from hector_jax.importing.meshes import resolved
from hector_jax.importing.soles import Sole, find_soles
from hector_jax.importing.stand import standing_pose
from hector_jax.importing.survey import Survey, survey_file
from hector_jax.robot.description import (
    HECTOR_NAMES,
    MAX_BYTES,
    Description,
    Joints,
    convert_by,
    description_of,
    model_name,
)
from hector_jax.robot.model import Robot, build_model, conversion, robot_of
from hector_jax.robot.response import (
    Response,
    planned_inertia,
    response,
    swing_frequency,
    trunk_gain,
)

MASS, HEIGHT = 12.0, 0.423  # of HECTOR [kg], [m]
_TICK = 0.01  # [s] of the gait
_ANGLE, _RATE = 50.0, 1.0  # weights Q of attitude and angular velocity
_KP_PER_LIMIT = 2.0  # [1/rad]
_NAMES = ("name", "model", "standing", "joints", "feet")  # what is found, not ruled
TOML, MODEL = "robot.toml", "robot.xml"  # names of the files of a robot in the standard form


class RobotProposal(NamedTuple):
    """The proposed TOML of a file, as far as its rules go."""

    table: dict[str, Any]  # beside the file as it is published
    draft: dict[str, Any]  # of the table only what stays when the model is mended
    wrong: tuple[str, ...] = ()  # one line per problem to correct by hand
    guesses: tuple[str, ...] = ()  # one line per number that the file does not have
    filled: Sequence[str] = ()  # keys that the file does not have, which are proposed
    survey: Survey | None = None  # None: the file names all, or it has no legs
    soles: tuple[Sole, ...] = ()
    standard: Standard | None = None  # None: it cannot be converted, or need not be
    robot: Robot | None = None  # in the standard form; None: it cannot be built
    error: str | None = None  # why the robot cannot be used
    refused: str | None = None  # why other commands do not take a TOML file


def propose_robot(path: Path, folder: Path, weld: Sequence[str] = ()) -> RobotProposal:
    """Convert a robot to the standard form, and propose what a TOML of it leaves out.

    Args:
        path: MJCF or URDF as published, or a robot's TOML file.
        folder: new one for the converted robot, whose description names its files there.
        weld: joints that are fixed, so that they are of no leg.

    Raises:
        InputError: one line with the wrong part of the TOML file.
    """
    own: dict[str, Any] = {"model": path.name}
    if path.suffix == ".toml":
        own = read_toml(path, "the robot description", MAX_BYTES)
        if weld:
            raise InputError(f"--weld is for a model; in {path} write joints.weld")
    model_name(path, own)
    stem = "".join(x if x.isalnum() or x in "-_" else "-" for x in path.stem)
    first, wrong = RobotProposal({"name": stem, **own}, draft={"name": stem, **own}), []
    found = first
    try:
        for stage in _stages(path, folder / MODEL, first, weld, wrong):
            found = stage
    except InputError as raised:
        wrong.append(str(raised))
        found = found._replace(error=str(raised))
    return found._replace(wrong=tuple(wrong), filled=_left_out(found.table, own))


def _stages(
    path: Path, model: Path, found: RobotProposal, weld: Sequence[str], wrong: list[str]
) -> Iterator[RobotProposal]:
    """Yield what is found of a robot, more each time, and write its model in the standard form."""
    source, toml, own = path.parent / found.table["model"], path.with_suffix(".toml"), found.table
    with _told_of(source, model):
        robot, refused = _in_standard_form(path, own)
        found = found._replace(refused=refused)
        if robot:
            names = {key: x for key, x in HECTOR_NAMES.items() if key not in own}
            found = found._replace(table=own | names)
        else:
            file, named = read_file(source), _named_legs(path, own)
            if not (named and "feet" in own and "standing" in own):
                yield (found := _with_legs(survey_file(file, named, (*weld, *_welded(own))), found))
                yield (found := _with_feet(found, wrong))
            draft = draft_of(toml, found.table)
            joints, lines = guessed_numbers(file, draft)
            table = _merged({"joints": joints}, found.table)
            yield (found := found._replace(table=table, guesses=(*found.guesses, *lines)))
            standard = to_standard(file, draft_of(toml, table), str(table["name"]))
            write_file(model, standard.text.encode())
            found = found._replace(standard=standard)
            names = {key: x for key, x in table.items() if key in _NAMES}
            bare = _description(toml, found._replace(table=names), model)
            robot = robot_of(bare, checked=False)
        found = found._replace(table=_merged(_settings(robot), found.table))
        description = _description(toml, found, model)
        yield found._replace(robot=robot._replace(description=description))
        build_model(description)


@contextmanager
def _told_of(source: Path, model: Path) -> Iterator[None]:
    """Raise all errors of a conversion as InputErrors of the source, not of the new model."""
    try:
        with conversion(source):
            yield
    except InputError as error:
        raise InputError(str(error).replace(str(model), str(source))) from error


def _in_standard_form(path: Path, own: dict[str, Any]) -> tuple[Robot | None, str | None]:
    """Return the robot of a TOML file in the standard form that stands, or why it is none."""
    if path.suffix != ".toml":
        return None, None
    try:
        return robot_of(description_of(path, own)), None
    except InputError as error:
        return None, str(error).removesuffix(f"; {convert_by(path)}")


def _description(toml: Path, found: RobotProposal, model: Path) -> Description:
    """Return the description of a proposed robot, of which the model may be in another folder."""
    description = description_of(toml, _standard_table(found))
    return replace(description, model=model) if found.standard else description


def _standard_table(found: RobotProposal) -> dict[str, Any]:
    """Return the TOML table of a proposed robot in the standard form."""
    if found.standard is None:
        return found.table
    own = {field.name for field in fields(Joints)}
    joints = {key: x for key, x in found.table["joints"].items() if key in own}
    names = {"name": found.table["name"], "model": MODEL, "standing": "standing", "joints": joints}
    names["feet"] = found.standard.feet
    return names | {key: x for key, x in found.table.items() if key not in names}


def files_of(proposal: RobotProposal, path: Path, comments: Sequence[str]) -> dict[str, bytes]:
    """Return the files of a folder of its own for a robot, by name.

    They are the robot in the standard form; or, if something is wrong, a draft of it with all that
    its model includes, and its meshes. A draft has no numbers of the model, which is to be mended.

    Args:
        proposal: of the robot.
        path: file that it was made of.
        comments: first lines of the TOML.

    Raises:
        InputError: one line: there is no draft of a model that cannot be read.
    """
    table, source = _standard_table(proposal), path.parent / proposal.table["model"]
    if not proposal.wrong:
        text = proposal.standard.text.encode() if proposal.standard else source.read_bytes()
        table, files = table | {"model": MODEL}, {MODEL: text}
    else:
        table, files = proposal.draft, resolved(source)
    return {TOML: as_toml(table, comments).encode(), **files}


def _named_legs(path: Path, own: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the joints of each leg that a TOML file names; none if they are to be found."""
    joints = own.get("joints", {})
    if isinstance(joints, dict) and not {*joints} & {*sum(FEET.values(), ())}:
        return []
    return list(from_table(f"{path}: joints", PublishedJoints, joints).legs.values())


def _welded(own: dict[str, Any]) -> list[str]:
    """Return the joints that a TOML file fixes."""
    joints = own.get("joints", {})
    welded = joints.get("weld", []) if isinstance(joints, dict) else []
    return [x for x in welded if isinstance(x, str)] if isinstance(welded, list) else []


def _with_legs(survey: Survey, found: RobotProposal) -> RobotProposal:
    """Return a proposal with the legs of a survey; what its table has stays."""
    legs = zip(FEET[len(survey.legs)], survey.legs, strict=True)
    joints: dict[str, Any] = {x: [survey.file.joints[j] for j in leg] for x, leg in legs}
    joints |= {"weld": list(survey.weld)} if survey.weld else {}
    table = _merged({"joints": joints}, found.table)
    return found._replace(survey=survey, table=table, draft=table)


def _with_feet(found: RobotProposal, wrong: list[str]) -> RobotProposal:
    """Return a proposal with feet and standing angles; what its table has stays."""
    survey = found.survey
    assert survey is not None
    soles = find_soles(survey)
    angles, balanced = standing_pose(survey, soles)
    if len(soles[0].contacts) == 1:  # a round foot, whose contact moves when the leg bends
        soles = find_soles(survey, angles)
        angles, balanced = standing_pose(survey, soles, angles)
    feet, draft = zip(FEET[len(soles)], (sole.section for sole in soles), strict=True), found.draft
    table = {"standing": angles, "joints": {}, "feet": dict(feet)} | found.table
    if "feet" not in found.table:
        found = found._replace(guesses=(*found.guesses, *_sole_lines(soles)))
        if soles[0].guessed:  # and to be corrected by hand
            draft = draft | {"feet": table["feet"]}
    if not balanced and "standing" not in found.table:
        wrong.append(
            "no standing pose found with level soles and the centre of mass over the feet: correct "
            "the model, or write angles into [standing]"
        )
    return found._replace(soles=soles, table=table, draft=draft)


def _sole_lines(soles: Sequence[Sole]) -> Iterator[str]:
    """Yield the line that says what a guessed sole is and how it is measured."""
    if soles[0].guessed:
        body, contacts = soles[0].section["body"], soles[0].contacts
        count, (low, high) = len(contacts), (contacts.min(axis=0), contacts.max(axis=0))
        length, width = (100.0 * (high - low)[:2]).tolist()
        size = {1: "a point", 2: f"{length:.1f} cm long"}
        feet = " and ".join(f"feet.{leg}" for leg in FEET[len(soles)])
        yield (
            f"the sole of body {body!r} is guessed from its inertia, {soles[0].guessed}: "
            f"{size.get(count, f'{length:.1f} x {width:.1f} cm')}, {-100.0 * low[2]:.1f} cm below "
            "its joint; measure heel, toe and height of the sole on the robot or in its drawing "
            f"and correct the contacts of {feet}, in the body's frame [m]; "
            "hector walk says whether they hold"
        )


def _merged(rules: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return what a table has, and what the rules say where it has nothing."""
    both = {
        key: _merged(value, own[key])
        for key, value in rules.items()
        if isinstance(value, dict) and isinstance(own.get(key), dict)
    }
    return own | {key: x for key, x in rules.items() if key not in own} | both


def _left_out(table: dict[str, Any], own: dict[str, Any], prefix: str = "") -> list[str]:
    """Return the keys of a table that another one does not have."""
    keys = []
    for key, value in table.items():
        if key not in own:
            keys.append(f"{prefix}{key}")
        elif isinstance(value, dict):
            keys += _left_out(value, own[key], f"{prefix}{key}.")
    return keys


def _settings(robot: Robot) -> dict[str, Any]:
    """Return the part of the TOML with the settings that follow from the rules."""
    height, weight = float(robot.standing_height), float(robot.mass * robot.gravity[2])
    mass, size = float(robot.mass) / MASS, height / HEIGHT  # relative to HECTOR's
    root, torque = math.sqrt(size), short(mass * size)
    ticks = round(20 * root)
    four, flat = len(robot.foot_point) == 4, robot.structure.contact == "flat"
    step_ticks, answer = max(3, math.ceil(0.15 * ticks)), response(robot)
    step, gain = _TICK * step_ticks, trunk_gain(robot, answer)
    inertia = planned_inertia(gain, angle=_ANGLE, rate=_RATE, step=step, tick=_TICK)
    aside = float(np.abs(answer.lever[:, 1]).mean())
    return {
        "limits": {"min_height": round(0.55 * height, 2)},
        "gait": ({"pattern": "trot"} if four else {}) | {"stance": ticks, "swing": ticks},
        "mpc": {
            "step_ticks": step_ticks,
            "max_force": float(f"{2.5 * weight:.2g}"),
            "effort_reference": "gravity",
            **({"sole_width": 0.6} if flat else {}),
            "inertia_share": inertia.round(2).tolist(),
        },
        "footstep": {
            "width": round((0.7 if four else 0.85) * aside, 3),
            "feedback": round(0.12 * root, 3),
        },
        "legs": {
            "height": round(0.06 * height / 0.69, 3),
            "landing": -0.005,
            **_gains(robot, answer),
            "gravity_compensation": True,
        },
        "weights": _weights(mass, size),
        "loss": {"L_ctrl": short(mass**-2)},
        "tuning": {"lead": 2 * ticks, "touchdown_error": True, "estimate_noise": 1, "delay": 0.005},
        "plants": {
            "joint_friction": torque,
            "joint_damping": torque,
            "push": short(mass),
            "trunk_com": short(size),
            "payload": short(mass),
        },
    }


def _gains(robot: Robot, answer: Response) -> dict[str, list[float]]:
    """Return gains and motors of a leg's joints from mean inertias and least torque of all legs."""
    legs = len(robot.foot_point)
    inertia = answer.inertia.reshape(legs, -1).mean(axis=0)
    limit = robot.torque_limit.reshape(legs, -1).min(axis=0)
    frequency, text = swing_frequency(answer), "expected masses and inertias of a walking robot"
    path = robot.description.model
    expect(path, np.isfinite(frequency), f"no gains hold the swing legs; {text}")
    kp = np.minimum(inertia * frequency**2, _KP_PER_LIMIT * limit)
    motors = answer.armature.reshape(legs, -1).mean(axis=0)
    of_joints = {"kp": kp, "kd": np.sqrt(kp * inertia), "armature": motors}
    return {name: [short(x) for x in values] for name, values in of_joints.items()}


def _weights(mass: float, size: float) -> dict[str, Any]:
    """Return HECTOR's Q, and R scaled by the squares of mass and of mass times size."""
    force, moment = mass**-2, (mass * size) ** -2
    rates = {"ang_velocity": _RATE, "velocity": 1}
    return {
        "nominal": {
            "euler": _ANGLE,
            "position": [50, 50, 250],
            **rates,
            "force": short(0.3e-4 * force),
            "moment": short(0.3e-3 * moment),
        },
        "expert": {
            "euler": [100, 100, 250],
            "position": [200, 200, 300],
            **rates,
            "force": [short(x * force) for x in (1e-4, 1e-4, 5e-4)],
            "moment": short(1e-2 * moment),
        },
    }
