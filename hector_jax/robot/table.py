"""Describe a robot in a short table of plain words."""

import textwrap
from collections.abc import Sequence

from hector_jax.core.trajectory import FEET
from hector_jax.robot.checks import trunk_body
from hector_jax.robot.kinematics import knee_joints
from hector_jax.robot.links import data_at
from hector_jax.robot.model import Robot, compile_model
from hector_jax.robot.source import build_spec
from hector_jax.robot.survey import Survey, axis_words

_HEADER = ("joint", "axis", "range [rad]", "motor [N m]", "link [kg]", "standing [rad]")
_HEAVY_LEGS = 0.35  # share of the robot's mass


def table_of(robot: Robot) -> list[str]:
    """Return the table of a robot, line by line."""
    description = robot.description
    count = description.leg_joints
    share = float(robot.link_mass.sum() / robot.mass)
    _, knee, _ = knee_joints(robot)
    bend = robot.standing_joints.reshape(-1, count)[::2, knee] * robot.joint_axis[::2, knee, 1]
    model = compile_model(description)
    trunk = model.body(trunk_body(model)).name
    rows = [
        (
            f"{description.joints[i]}, {description.joints[count + i]}",
            axis_words(robot.joint_axis[0, i]),
            f"{robot.joint_lower[i]:+.2f} to {robot.joint_upper[i]:+.2f}",
            f"{robot.torque_limit[i]:.3g}",
            f"{robot.link_mass[0, i]:.3g}",
            f"{robot.standing_joints[i]:+.2f}",
        )
        for i in range(count)
    ]
    return [
        f"robot    {description.name}: {robot.mass:.4g} kg, trunk {trunk!r}; standing, its centre "
        f"of mass is {robot.standing_height:.3g} m high",
        f"legs     {count} joints each, {100 * share:.0f} % of the mass; "
        f"{_knees((bend > 0.0).tolist())}",
        *_columns([_HEADER, *rows]),
        f"feet     {robot.structure.contact}: {_sole(robot)}",
        *_list("fixed", description.weld),
    ]


def table_of_survey(survey: Survey) -> list[str]:
    """Return the table of a robot that cannot be loaded, line by line."""
    model, data = survey.model, data_at(survey.model)
    rows = []
    for left, right in zip(*survey.legs[:2], strict=True):
        names = f"{model.joint(left).name}, {model.joint(right).name}"
        low, high = model.jnt_range[left]
        limits = f"{low:+.2f} to {high:+.2f}" if model.jnt_limited[left] else "none"
        rows.append((names, axis_words(data.xaxis[left]), limits))
    mass = float(model.body_subtreemass[survey.trunk])
    return [
        f"robot    {mass:.4g} kg, trunk {model.body(survey.trunk).name!r}",
        f"legs     {len(rows)} joints each; {_knees(survey.forwards)}",
        *_columns([_HEADER[:3], *rows]),
        *_list("fixed", survey.weld),
    ]


def changes(robot: Robot) -> list[str]:
    """Return one line per change that was made to the model of the robot's file."""
    notes = build_spec(robot.description).notes
    return [note for note in notes if not note.startswith("fixed: ")]  # the table lists these


def remarks(robot: Robot) -> list[str]:
    """Return one line per likely cause of trouble in walking, with its remedy."""
    share, lines = float(robot.link_mass.sum() / robot.mass), []
    control = {name: dict(section) for name, section in robot.description.control}
    if share > _HEAVY_LEGS and not control.get("legs", {}).get("gravity_compensation"):
        lines.append(
            f"the legs are {100 * share:.0f} % of the mass and lift the trunk when they stretch: "
            "set legs.gravity_compensation = true and bend the knees"
        )
    model = compile_model(robot.description)
    names = robot.description.joints
    if missing := [n for n in names if not model.dof_armature[model.joint(n).dofadr[0]]]:
        lines.append(
            f"joint {missing[0]!r} has no armature, without which backlash cannot be simulated: "
            "set joints.armature"
        )
    ahead = (robot.sole[0].T @ robot.foot_point[0])[0]  # of the last joint
    if robot.heel - ahead > 1.2 * (robot.toe + ahead):
        lines.append(
            "the heel is longer than the toe: if the robot looks along -x, turn the model so that "
            "x is ahead"
        )
    force = control.get("mpc", {}).get("max_force", 500.0)
    weight = float(robot.mass * robot.gravity[2])
    if force < 1.5 * weight:
        lines.append(
            f"mpc.max_force is {force:.3g} N, {force / weight:.2g} times the weight: set "
            f"{2.5 * weight:.2g}"
        )
    return lines


def _sole(robot: Robot) -> str:
    if robot.structure.contact == "point":
        return "one contact each"
    text = f"{100 * robot.toe:.1f} cm ahead of the foot point, {100 * robot.heel:.1f} cm behind it"
    if robot.structure.contact == "flat":
        text += f", {100 * robot.half_width:.1f} cm to either side"
    return text


def _knees(forwards: Sequence[bool]) -> str:
    """Return the direction in which the knees bend, and the leg of the numbers that follow."""
    words = ["forwards" if ahead else "backwards" for ahead in forwards]
    direction = words[0] if len(set(words)) == 1 else f"{words[0]} in front and {words[1]} behind"
    leg = FEET[2 * len(words)][0].replace("_", " ")
    return f"knees bend {direction}; axes and numbers of the {leg} leg:"


def _list(title: str, names: Sequence[str]) -> list[str]:
    """Return the names, wrapped into lines, after a title."""
    lines = textwrap.wrap(", ".join(names) or "no joint", 91, break_on_hyphens=False)
    return [f"{title if i == 0 else '':8s} {line}" for i, line in enumerate(lines)]


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows with their cells aligned in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(f"{x:{w}}" for x, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
