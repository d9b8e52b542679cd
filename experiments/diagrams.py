"""The diagrams of README and docs, in one style; `pictures.py` writes them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, Circle, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

from hector_jax import expert, load_robot, nominal, walk_config
from hector_jax.control.weights import direction_names, directions, weights_to_vector
from hector_jax.control.weights_file import shipped
from hector_jax.report.plots import save_weight_bars
from hector_jax.report.plots.style import SETS, drawing
from hector_jax.sim.loop import first_tick, substeps

INK, BLUE, ORANGE = "#33383f", SETS["best"]["color"], "#b8560f"
WIDTH = 12.2  # of a diagram, in units of its axes
SMALL: dict[str, Any] = {"fontsize": 9.5, "color": INK}
CENTRE: dict[str, Any] = {"ha": "center", "va": "center"}
CHOICES = (  # what somebody has, and the commands to type
    ("nothing yet", "HECTOR, the paper's walks", ("hector tune --traj straight",)),
    ("a trajectory", "pieces of velocity", ("hector tune --traj examples/slalom.toml",)),
    (
        "a robot",
        "its MJCF or URDF",
        ("hector robot h1.xml --out h1", "hector tune --robot h1/robot.toml"),
    ),
    (
        "a controller",
        "an MPC in any language",
        (
            "hector log check log.npz --robot mine/robot.toml",
            "hector tune --walker mine.py --planner plans.py --robot mine/robot.toml"
            " --start mine.json --walks 40",
        ),
    ),
    ("time for more walks", "in the simulator", ("hector tune --traj all --walks 300",)),
    (
        "a real robot",
        "that logs its walks",
        ("hector propose runs/robot --traj s", "hector log add runs/robot s.npz"),
    ),
)

WORLDS = (  # height of a row, simulated robots, and who reads them
    (
        6.7,
        "ideal, hfs\nMuJoCo without and with imperfections",
        "checks\ncontroller, start, exported code",
    ),
    (
        5.65,
        "no name: plants near hfs\nother masses, friction, motors",
        "network\nlearns what the ground returns",
    ),
    (4.45, "srbm\nrigid body with the network, in JAX", "tuner\nfollows its gradient"),
    (
        3.4,
        "no name: plants farther from hfs\nand a noisy state estimate",
        "best\nwalks there in its last steps",
    ),
    (
        2.35,
        "hfs-varied, hfs-even\ndrawn plants, from other seeds",
        "developers\nchoose settings of the method",
    ),
    (
        0.5,
        "standin, standin-even\nother numbers, ground and estimate",
        "evaluation\nthe tables of reports and pages",
    ),
)
HEAD = "-|>,head_width=3.5,head_length=6"  # of an arrow


@contextmanager
def _canvas(path: Path, low: float, high: float) -> Iterator[Axes]:
    """Make axes without frame, WIDTH wide and from `low` to `high`, for a diagram in a file."""
    with drawing(path, 9.6, 9.6 * (high - low) / WIDTH, legend_columns=0) as figure:
        axes = figure.subplots()
        axes.set(xlim=(0, WIDTH), ylim=(low, high), aspect="equal")
        axes.axis("off")
        yield axes


def _box(
    axes: Axes, place: tuple[float, float], size: tuple[float, float], text: str, **look: str
) -> None:
    """Draw a box around a place, with a title and lines below it."""
    (x, y), (width, height) = place, size
    face: dict[str, Any] = {"facecolor": "#eef1f5", "edgecolor": INK, **look}
    shape = "round,pad=0,rounding_size=0.08"
    corner = x - width / 2, y - height / 2
    axes.add_patch(FancyBboxPatch(corner, width, height, boxstyle=shape, linewidth=1.2, **face))
    title, *rest = text.split("\n")
    up = 0.13 * len(rest)
    axes.text(x, y + up, title, weight="bold", fontsize=11, **CENTRE)
    for i, line in enumerate(rest, 1):
        axes.text(x, y + up - 0.27 * i, line, fontsize=9.5, **CENTRE)


def _arrow(
    axes: Axes,
    *points: tuple[float, float],
    text: str = "",
    at: tuple[float, float] = (0.0, 0.0),
    **look: Any,
) -> None:
    """Draw an arrow along some points, with words at a place."""
    line: dict[str, Any] = {"color": INK, "linewidth": 1.6, **look}
    for start, end in zip(points[:-2], points[1:-1], strict=True):
        axes.plot(*zip(start, end, strict=True), solid_capstyle="round", **line)
    last: dict[str, Any] = {"arrowstyle": HEAD, "shrinkA": 0.0, "shrinkB": 0.0}
    axes.add_patch(FancyArrowPatch(points[-2], points[-1], **last, **line))
    if text:
        axes.text(at[0], at[1], text, fontsize=9.5, ha="center", va="center", color=line["color"])


def draw_method(path: Path) -> None:
    """Draw the closed loop that is differentiated, and the way of its gradient."""
    with _canvas(path, -0.05, 4.65) as axes:
        main, y = (2.0, 1.15), 3.0
        _box(axes, (0.85, y), (1.4, 1.15), "command\nvelocity,\nturning rate", facecolor="white")
        _box(axes, (3.35, y), main, "MPC\na quadratic program\nwith weights Q, R")
        _box(axes, (6.35, y), main, "ground model\nGRFM-Net: wished to\nreal ground force")
        _box(axes, (9.1, y), (1.7, 1.15), "rigid body\ntrunk with\nmass, inertia")
        _box(axes, (11.35, y), (1.4, 1.15), "loss\nerrors and\njerky forces", facecolor="white")
        _arrow(axes, (1.55, y), (2.35, y))
        _arrow(axes, (4.35, y), (5.35, y), text="wrench", at=(4.85, y + 0.22))
        _arrow(axes, (7.35, y), (8.25, y), text="effect", at=(7.8, y + 0.22))
        _arrow(axes, (9.95, y), (10.65, y))
        top = 4.2
        loop = (9.1, y + 0.58), (9.1, top), (3.35, top), (3.35, y + 0.58)
        words = "state, every 10 ms, for a walk of 4 s (all of this is one program in JAX)"
        _arrow(axes, *loop, text=words, at=(6.2, top + 0.2))
        low = 1.55
        back = (11.35, y - 0.58), (11.35, low), (3.35, low), (3.35, y - 0.58)
        words = (
            "gradient through every quadratic program: next Q, R (Gauss-Newton, at most ten steps)"
        )
        _arrow(axes, *back, text=words, at=(7.5, low - 0.22), color=BLUE, linewidth=2.6)
        _box(axes, (1.55, 0.5), (2.6, 0.85), "MuJoCo\n64 walks, measured forces", edgecolor=ORANGE)
        learns = (2.85, 0.5), (6.35, 0.5), (6.35, low - 0.42)
        axes.plot([6.35, 6.35], [low + 0.08, y - 0.72], color=ORANGE, linewidth=1.6)
        axes.plot(*zip(*learns, strict=True), color=ORANGE, linewidth=1.6)
        _arrow(axes, (6.35, y - 0.8), (6.35, y - 0.58), color=ORANGE)
        axes.text(4.6, 0.7, "trains, once", fontsize=9.5, ha="center", color=ORANGE)


def draw_own(path: Path) -> None:
    """Draw what the user of a controller provides, what is done with it, and the first minutes."""
    with _canvas(path, -0.1, 5.75) as axes:
        for x, text, color in ((2.3, "you provide", INK), (8.5, "hector_jax does", BLUE)):
            axes.text(x, 5.55, text, weight="bold", fontsize=12, ha="center", color=color)
        rows = (
            (4.85, "walker\nweights, command in; log out", "is it the weights?\nhector log check"),
            (
                3.8,
                "planner, or [twin]\nstate, feet, weights in; plan out",
                "conventions, parity\nhector log twin",
            ),
            (
                2.75,
                "robot.toml, mine.json\nmodel of the robot, your weights",
                "walks and slopes\nhector tune --walker",
            ),
        )
        for (y, given, done), words in zip(rows, ("log.npz, a bag", "plans", "files"), strict=True):
            _box(axes, (2.3, y), (3.7, 0.85), given, facecolor="white")
            _box(axes, (8.5, y), (3.6, 0.85), done, edgecolor=BLUE)
            _arrow(axes, (4.15, y), (6.7, y), text=words, at=(5.4, y + 0.22))
        back = (8.5, 2.32), (8.5, 1.98), (0.15, 1.98), (0.15, 4.85), (0.45, 4.85)
        _arrow(axes, *back, text="walk, and plan, with other weights", at=(5.4, 2.16), color=BLUE)
        _arrow(axes, (0.15, 3.8), (0.45, 3.8), color=BLUE)
        words = "best.json, your format"
        _arrow(axes, (10.3, 2.75), (11.6, 2.75), color=BLUE, linewidth=2.6)
        axes.text(10.95, 2.1, words, fontsize=9.5, ha="center", color=BLUE)
        axes.text(0.1, 1.55, "the first ten minutes", weight="bold", fontsize=11)
        words = "as they went for a controller in C++ on two busy cores"
        axes.text(3.3, 1.55, words, fontsize=9.5)
        axes.plot([0.4, 11.8], [1.0, 1.0], color=INK, linewidth=1.6)
        steps = (
            (0, "robot.toml, mine.json,\nthe walker"),
            (2, "hector walk"),
            (4, "log check"),
            (5, "log twin"),
            (9.5, "its lines to paste:\nparity to 0.5 N"),
        )
        for minute, text in steps:
            x = 1.0 + 1.03 * minute
            axes.plot(x, 1.0, "o", color=BLUE, markersize=7)
            axes.text(x, 1.2, f"{minute:g}", fontsize=9.5, ha="center")
            axes.text(x, 0.75, text, fontsize=9.5, ha="center", va="top")


def draw_worlds(path: Path) -> None:
    """Draw who may read which world: nothing that learns reads the stand-in."""
    left, right = 2.6, 9.6
    with _canvas(path, 0.0, 7.6) as axes:
        for x, text, color in ((left, "world", INK), (right, "who may read it", BLUE)):
            axes.text(x, 7.4, text, weight="bold", fontsize=12, ha="center", color=color)
        for y, world, reader in WORLDS:
            color = INK if y > 1.0 else ORANGE
            _box(axes, (left, y), (5.0, 0.85), world, edgecolor=color)
            _box(axes, (right, y), (5.0, 0.85), reader, facecolor="white", edgecolor=BLUE)
            _arrow(axes, (left + 2.5, y), (right - 2.5, y), color=color)
        turn = 5.05
        back = (right, 5.22), (right, turn), (left, turn), (left, 4.88)
        _arrow(axes, *back, text="is part of", at=(6.1, turn + 0.17), color=BLUE)
        _arrow(axes, (right, 4.02), (right, 3.83), color=BLUE)
        axes.plot([0.1, WIDTH - 0.1], [1.6, 1.6], color=ORANGE, linestyle=(0, (5, 3)))
        words = "Nothing that collects, trains, tunes or searches reads below this line."
        axes.text(WIDTH / 2, 1.3, words, fontsize=9.5, color=ORANGE, **CENTRE)


def draw_commands(path: Path) -> None:
    """Draw which command is for whom, as a tree."""
    with _canvas(path, 0.0, 6.7) as axes:
        places = np.linspace(6.2, 0.5, len(CHOICES))
        _box(axes, (0.65, 3.35), (1.2, 0.6), "You have", facecolor="white")
        axes.plot([1.25, 1.55], [3.35, 3.35], color=INK, linewidth=1.6)
        axes.plot([1.55, 1.55], places[[0, -1]], color=INK, linewidth=1.6)
        for y, (title, words, commands) in zip(places, CHOICES, strict=True):
            _arrow(axes, (1.55, y), (1.95, y))
            _box(axes, (3.4, y), (2.9, 0.85), f"{title}\n{words}")
            _arrow(axes, (4.85, y), (5.3, y), color=BLUE)
            break_at: dict[str, Any] = {"subsequent_indent": "  ", "break_on_hyphens": False}
            lines = [line for command in commands for line in wrap(command, 54, **break_at)]
            for i, line in enumerate(lines):
                at = y + 0.15 * (len(lines) - 1) - 0.3 * i
                look = {"family": "monospace", "va": "center", "color": BLUE}
                axes.text(5.45, at, line, fontsize=9.5, **look)


def draw_time(path: Path) -> None:
    """Draw calls and plans of the exported controller, and the first seconds of a walk."""
    config = walk_config(load_robot())
    period, tick = substeps(config), config.gait.tick
    start, stand = -first_tick(config) * tick, config.gait.stand * tick
    with _canvas(path, 0.4, 6.6) as axes:
        axes.text(0.1, 6.3, "calls", weight="bold", fontsize=11)
        words = f"One in each millisecond. The first of {period} makes a plan; each makes torques."
        axes.text(1.2, 6.3, words, fontsize=9.5)
        for ms in range(2 * period + 1):
            x, plans = 0.6 + 0.54 * ms, ms % period == 0
            height, color = (0.75, BLUE) if plans else (0.3, "0.75")
            axes.add_patch(Rectangle((x - 0.16, 5.0), 0.32, height, facecolor=color))
            axes.text(x, 4.8, f"{ms}" + " ms" * (ms == 2 * period), **CENTRE, **SMALL)
            if plans:
                axes.text(x, 5.92, "plan", fontsize=9.5, color=BLUE, weight="bold", **CENTRE)
        axes.text(0.1, 4.05, "a walk", weight="bold", fontsize=11)
        words = "Drive at zero for two seconds, then add at most 0.1 m/s in each second."
        axes.text(1.2, 4.05, words, fontsize=9.5)
        at = lambda seconds: 0.44 + 2.07 * seconds  # noqa: E731
        stages = ((0.0, stand, "0.85", "stands"), (stand, 2.0, "#d5dcea", "steps in place"))
        for first, last, color, words in (*stages, (2.0, 5.4, "#a9b8d6", "walks")):
            axes.add_patch(Rectangle((at(first), 2.2), at(last) - at(first), 0.4, facecolor=color))
            axes.text(at((first + last) / 2), 2.4, words, **CENTRE, **SMALL)
        speed = np.array([(0.0, 2.8), (2.0, 2.8), (5.0, 3.65), (5.4, 3.65)])
        axes.plot(at(speed[:, 0]), speed[:, 1], color=BLUE, linewidth=2.2)
        for seconds, y, words in ((2.0, 3.0, "2 s"), (5.0, 3.4, "5 s"), (5.2, 3.82, "0.3 m/s")):
            axes.text(at(seconds), y, words, fontsize=9.5, color=BLUE, **CENTRE)
        first = "The robot stands. Now\ncontroller_drive puts its\nanchor where it stands."
        later = (
            "From here on a path of your own may begin. Its anchor is the place, the yaw and\n"
            "the gait tick at which it begins. Before that tick the robot steps in place."
        )
        marks = (0.0, "0 s: first call", first), (start, f"{start:g} s: gait tick 0", later)
        for seconds, title, words in marks:
            axes.plot([at(seconds)] * 2, [0.55, 2.2], color=ORANGE, linewidth=2.0)
            axes.text(at(seconds) + 0.12, 1.6, title, weight="bold", fontsize=9.5, color=ORANGE)
            axes.text(at(seconds) + 0.12, 1.45, words, va="top", **SMALL)


def draw_foot(path: Path) -> None:
    """Draw a line foot from the side and from above: HECTOR's lengths, frames and signs."""
    robot = load_robot()
    toe, heel, ankle = (30.0 * float(x) for x in (robot.toe, robot.heel, -robot.foot_point[0, 2]))
    with _canvas(path, 0.0, 6.3) as axes:
        _draw_side(axes, (3.1, 3.2), toe, heel, ankle)
        _draw_above(axes, (9.5, 3.9), toe, heel)
        low, high = (rf"{x:g}\,\mathrm{{m}}\,F_z" for x in (-robot.toe, robot.heel))
        words = rf"A line foot has $M_x = 0$ and ${low} \leq M_y \leq {high}$."
        axes.text(WIDTH / 2, 0.3, words, fontsize=11, **CENTRE)


def _draw_side(
    axes: Axes, point: tuple[float, float], toe: float, heel: float, ankle: float
) -> None:
    """Draw a foot from the side, its foot point at a place, 30 units a metre."""
    x, y = point
    skin: dict[str, Any] = {"facecolor": "#dfe4ec", "edgecolor": INK}
    axes.text(0.1, 6.0, "HECTOR's foot, seen from the right", weight="bold", fontsize=11)
    axes.plot([0.2, 7.0], [y, y], color="0.6", linewidth=1.2)
    shin = [-0.2, ankle], [-0.5, 2.6], [0.1, 2.6], [0.2, ankle]
    sole = [-heel, 0.15], [toe, 0.15], [toe, 0.5], [0.4, ankle + 0.25], [-0.4, ankle + 0.25]
    for shape in (shin, (*sole, [-heel, 0.5])):
        axes.add_patch(Polygon(np.array(shape) + point, **skin))
    for place, name in ((-heel, "heel"), (toe, "toe")):
        axes.add_patch(Circle((x + place, y + 0.3), 0.3, **skin))
        axes.text(x + place, y + 0.8, name, ha="left" if place > 0 else "right", **SMALL)
        _arrow(axes, (x + place, y - 1.5), (x + place, y - 0.08), color=ORANGE, linewidth=2.6)
        text = f"all load on the {name}:\n$M_y = {-place / 30:+g}\\,\\mathrm{{m}}\\,F_z$"
        axes.text(x + place, y - 1.65, text, ha="center", va="top", fontsize=9.5, color=ORANGE)
        size = {"arrowstyle": "<->", "color": INK}
        axes.annotate("", (x + place, y - 0.5), (x, y - 0.5), arrowprops=size)
        axes.text(x + place / 2, y - 0.75, f"{abs(place) / 0.3:.0f} cm", **CENTRE, **SMALL)
    axes.add_patch(Circle((x, y + ankle), 0.12, facecolor="white", edgecolor=INK))
    axes.text(x - 0.6, y + ankle + 0.2, "ankle", ha="right", **SMALL)
    _arrow(axes, (x, y - 1.5), (x, y - 0.08), color=BLUE, linewidth=2.6)
    axes.plot(x, y, "o", color=BLUE, markersize=8)
    words = "$F_z$, at the\nfoot point"
    axes.text(x, y - 1.65, words, ha="center", va="top", fontsize=9.5, color=BLUE)
    bow: dict[str, Any] = {"arrowstyle": HEAD, "connectionstyle": "arc3,rad=-0.9"}
    ends = (x - 0.5, y + 0.4), (x + 0.5, y + 0.4)
    axes.add_patch(FancyArrowPatch(*ends, color=BLUE, linewidth=2.2, **bow))
    axes.text(x + 0.95, y + 0.6, "$+M_y$", fontsize=11, color=BLUE, **CENTRE)
    corner = 5.1, 4.9
    _arrow(axes, corner, (6.0, 4.9), text="x, ahead", at=(6.1, 4.65))
    _arrow(axes, corner, (5.1, 5.8), text="z, up", at=(5.5, 5.75))
    axes.plot(*corner, "o", color=INK, markersize=11, markerfacecolor="white")
    axes.plot(*corner, "x", color=INK, markersize=7)
    axes.text(4.95, 4.9, "y, left,\ninto the page", ha="right", va="center", **SMALL)


def _draw_above(axes: Axes, point: tuple[float, float], toe: float, heel: float) -> None:
    """Draw a foot from above, its foot point at a place, with the axes of forces and moments."""
    x, y = point
    yaw = np.deg2rad(30.0)
    along, across = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    axes.text(7.5, 6.0, "seen from above", weight="bold", fontsize=11)
    ends = np.array([-heel * along, toe * along]) + point
    for width, color in ((19, INK), (17, "#dfe4ec")):
        axes.plot(*ends.T, color=color, linewidth=width, zorder=0, solid_capstyle="round")
    _arrow(axes, point, (x + 1.9, y), text="x, world", at=(x + 1.9, y - 0.25))
    _arrow(axes, point, (x, y + 1.5), text="y, world", at=(x + 0.1, y + 1.7))
    for tip, name in ((point + 2.0 * along, "x"), (point + 1.3 * across, "y")):
        at = tip + 0.4 * across - 0.25 * along
        _arrow(axes, point, tuple(tip), text=f"{name}, foot", at=at, color=BLUE, linewidth=2.2)
    axes.plot(x, y, "o", color=BLUE, markersize=8)
    axes.add_patch(Arc(point, 2.2, 2.2, theta2=np.rad2deg(yaw), color=INK, linewidth=1.2))
    axes.text(x + 1.4, y + 0.37, "yaw", **CENTRE, **SMALL)
    rows = (
        ("In the MPC", "F has the axes of the world, and M those of the foot."),
        ("In logs, plans and exports", "Both have the axes of the world."),
    )
    for i, (place, words) in enumerate(rows):
        axes.text(7.5, 2.2 - 0.8 * i, place, weight="bold", fontsize=9.5)
        axes.text(7.5, 1.9 - 0.8 * i, words, **SMALL)


def draw_weights(path: Path) -> None:
    """Draw the weights of `shipped` and `expert` as ratios to the nominal ones."""
    D = directions() / directions().sum(axis=1, keepdims=True)  # of both feet, which share R
    sets = {"nominal": nominal(), "expert": expert(), "shipped": shipped()}
    vectors = {name: D @ np.asarray(weights_to_vector(weights)) for name, weights in sets.items()}
    save_weight_bars(path, direction_names(), vectors)


DIAGRAMS = {
    "method": draw_method,
    "own": draw_own,
    "worlds": draw_worlds,
    "commands": draw_commands,
    "time": draw_time,
    "foot": draw_foot,
    "weights": draw_weights,
}
