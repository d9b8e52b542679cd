"""Describe a robot in a short table of plain words, line by line."""

import textwrap
from collections.abc import Sequence

import numpy as np

from hector_jax.core.headless import mujoco
from hector_jax.importing.remarks import numbers, pairs_of, range_words, words_of
from hector_jax.importing.survey import axis_words
from hector_jax.robot.kinematics import knee_joints
from hector_jax.robot.model import Robot, build_model, quiet_mujoco
from hector_jax.robot.poses import standing_data, trunk_body

_COLUMNS = {
    "axis": axis_words,
    "range [rad]": range_words,
    "motor [N m]": numbers,
    "link [kg]": numbers,
    "standing [rad]": lambda angle: f"{angle[0]:+.2f}",
}
_WIDTH = 91  # of the names of a line


@quiet_mujoco()
def table_of(robot: Robot, fixed: Sequence[str] = ()) -> list[str]:
    """Return the table of a robot, of which some joints are fixed, line by line."""
    description, model = robot.description, build_model(robot.description, checked=False)[1]
    count = description.leg_joints
    share = float(robot.link_mass.sum() / robot.mass)
    trunk = model.body(trunk_body(model)).name
    rows = [
        (f"{left[i]}, {right[i]}", *(words_of(has[x], i, write) for x, write in _COLUMNS.items()))
        for left, right, has in pairs_of(robot, model)
        for i in range(count)
    ]
    return [
        f"robot    {description.name}: {robot.mass:.4g} kg, trunk {trunk!r}; standing, its centre "
        f"of mass is {robot.standing_height:.3g} m high",
        f"legs     {count} joints each, {100 * share:.0f} % of the mass; "
        f"{_knees(_knees_ahead(robot, model))}",
        *_columns([("joint", *_COLUMNS), *rows]),
        f"feet     {robot.structure.contact}: {_sole(robot)}",
        *section(
            "fixed", textwrap.wrap(", ".join(fixed) or "no joint", _WIDTH, break_on_hyphens=False)
        ),
    ]


def _knees_ahead(robot: Robot, model: mujoco.MjModel) -> list[bool]:
    """Return whether the knees are ahead of the legs, standing, for each pair of legs."""
    data, (hip, knee, ankle) = standing_data(robot.description, model), knee_joints(robot)
    anchors = data.xanchor[1:].reshape(len(robot.foot_point), -1, 3)
    ends = [data.site(foot.point).xpos for foot in robot.description.feet]
    ends = anchors[:, ankle] if ankle > knee else np.array(ends)
    (x, _, z), (u, _, w) = (anchors[:, knee] - anchors[:, hip]).T, (ends - anchors[:, knee]).T
    return (z * u > x * w)[::2].tolist()


def _sole(robot: Robot) -> str:
    if robot.structure.contact == "point":
        return "one contact each"
    text = f"{100 * robot.toe:.1f} cm ahead of the foot point, {100 * robot.heel:.1f} cm behind it"
    if robot.structure.contact == "flat":
        text += f", {100 * robot.half_width:.1f} cm to either side"
    return text


def _knees(forwards: Sequence[bool]) -> str:
    """Return the direction in which the knees bend, and whose the numbers that follow are."""
    words = ["forwards" if ahead else "backwards" for ahead in forwards]
    direction = words[0] if len(set(words)) == 1 else f"{words[0]} in front and {words[1]} behind"
    return f"knees bend {direction}; numbers of left legs, and of right ones where they differ:"


def section(title: str, lines: Sequence[str]) -> list[str]:
    """Return lines, or "nothing", beside a title."""
    return [f"{'' if i else title:8s} {line}" for i, line in enumerate(lines or ["nothing"])]


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows with their cells aligned in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(f"{x:{w}}" for x, w in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
