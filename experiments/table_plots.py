"""Pictures of the table: the loss on every plant, and the paper's collective figure."""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import imread
from table_report import paper_change

from hector_jax.core.console import say
from hector_jax.core.trajectory import Trajectory, from_start
from hector_jax.report.motion import motions
from hector_jax.report.plots import draw_path, draw_tracking, span_of
from hector_jax.report.plots.style import drawing, label_of, log_axis, looks_of
from hector_jax.report.report import Picture, caption
from hector_jax.report.video import VideoConfig, VideoUnavailable, write_strip
from hector_jax.robot.model import Robot
from hector_jax.verdict.metrics import BASELINES, Verdict, compare

_MAIN = ("nominal", "expert", "without", "with")  # more lines cannot be distinguished
_BEST = "search_2000"
_SNAPSHOTS = VideoConfig(height=360)


def draw(
    out: Path,
    robot: Robot,
    verdicts: Mapping[str, Verdict],
    walks: Mapping[str, Mapping[str, Trajectory]],
) -> list[Picture]:
    """Draw all pictures into `pictures/` of a folder, in the order of the report.

    Args:
        out: the folder.
        robot: the body.
        verdicts: by trajectory.
        walks: on the first plant, by trajectory and set.
    """
    say("drawing the pictures")
    paper = {
        (trajectory, name, baseline): change
        for trajectory in verdicts
        for name in verdicts[trajectory].scores
        for baseline in BASELINES
        if (change := paper_change(trajectory, name, baseline)) is not None
    }
    file = "pictures/changes.png"
    pictures = [Picture(file, changes(out / file, verdicts, paper))]
    for trajectory, by_set in walks.items():
        file = f"pictures/{trajectory}.png"
        with tempfile.TemporaryDirectory() as folder:
            strip = _snapshots(Path(folder) / "strip.png", robot, by_set)
            text = collective(out / file, by_set, strip)
        pictures.append(Picture(file, f"{trajectory}: {text}"))
    return pictures


def _snapshots(path: Path, robot: Robot, walks: Mapping[str, Trajectory]) -> Path | None:
    """Draw a strip of two walks; None, with a message, if there is no renderer."""
    pair = {name: walks[name] for name in ("nominal", "with")}
    try:
        write_strip(path, robot, motions(robot, pair), _SNAPSHOTS)
    except VideoUnavailable as error:
        say(f"no snapshots: {error}")
        return None
    return path


def changes(
    path: Path, verdicts: Mapping[str, Verdict], paper: Mapping[tuple[str, str, str], float]
) -> str:
    """Draw the loss of every weight set against nominal and expert on every plant.

    Args:
        path: file to write.
        verdicts: by trajectory.
        paper: the paper's change [%] by trajectory, set and baseline.
    """
    names = dict.fromkeys(name for verdict in verdicts.values() for name in verdict.scores)
    names = [name for name in names if name not in BASELINES]
    size = (3.3 * len(verdicts) + 1.2, 2 * (0.27 * len(names) + 0.75) + 0.3)
    diamond = {"linestyle": "none", "marker": "D", "color": "black", "markerfacecolor": "white"}
    diamond |= {"markersize": 5, "zorder": 4, "label": "the paper, on the robot"}
    with drawing(path, *size) as figure:
        panels = figure.subplots(2, len(verdicts), sharex="row", sharey=True, squeeze=False)
        for row, baseline in zip(panels, BASELINES, strict=True):
            for panel, (trajectory, verdict) in zip(row, verdicts.items(), strict=True):
                _draw_changes(panel, verdict, names, baseline)
                change = {i: paper.get((trajectory, n, baseline)) for i, n in enumerate(names)}
                points = [(1 + x / 100, i) for i, x in change.items() if x is not None]
                panel.plot(*np.reshape(points, (-1, 2)).T, **diamond)
                panel.set(xlabel=f"change of L against {baseline} [%]", title=trajectory)
            log_axis(row[0], "x")
            percent = lambda r, _: f"{100 * (r - 1):+.0f}" if r != 1 else "0"  # noqa: E731
            row[0].xaxis.set_major_formatter(percent)
        first = panels[0, 0]
        first.set_yticks(range(len(names)), [label_of(name) for name in names])
        first.set_ylim(len(names) - 0.5, -0.5)
        first.plot([], [], "o", color="0.4", alpha=0.5, label="one plant")
        cross = {"color": "0.2", "markersize": 11, "mew": 2.2}
        first.plot([], [], "+", **cross, label="median and its interval")
    return caption("changes")


def _draw_changes(panel: Axes, verdict: Verdict, names: Sequence[str], baseline: str) -> None:
    panel.axvline(1.0, color="black", linewidth=0.9)
    looks = looks_of(names)
    for row, name in enumerate(names):
        if name not in verdict.scores:
            continue
        score, color = verdict.scores[name], looks[name].color
        ratio = (score.L / verdict.scores[baseline].L)[~score.fallen]
        panel.plot(ratio, [row] * len(ratio), "o", color=color, alpha=0.3, markersize=3, mew=0)
        if falls := int(score.fallen.sum()):
            edge = {"transform": panel.get_yaxis_transform(), "ha": "right", "va": "center"}
            panel.text(0.99, row, f"{falls} fell", color=color, **edge)
        value, low, high = (1 + x / 100 for x in compare(verdict, name, baseline).change["L"])
        if len(ratio):  # limit the axis if falls widen the interval
            high = min(high, 1.1 * max(*ratio, value))
        panel.hlines(row, low, high, color=color, linewidth=2.2, zorder=3)
        panel.plot(value, row, "|", color=color, markersize=11, mew=2.2, zorder=3)
    panel.grid(visible=False, axis="y")


def collective(path: Path, walks: Mapping[str, Trajectory], snapshots: Path | None) -> str:
    """Draw the paper's collective figure: snapshots, path from above, and tracking.

    Args:
        path: file to write.
        walks: by weight set, on the same plant and command. Drawn are nominal, expert, without and
            with, at least one of them, and, on the path only, search_2000. The footprints are
            those of `with`, or of the last.
        snapshots: picture of the walk, two rows of tiles, or None.
    """
    walks = {name: walks[name] for name in sorted(walks, key="with".__eq__)}
    main = {name: walk for name, walk in walks.items() if name in _MAIN}
    walks = {n: from_start(walk) for n, walk in walks.items() if n in (*_MAIN, _BEST)}
    width = 10.0
    image = None if snapshots is None else imread(snapshots)
    top = 0.0 if image is None else 0.97 * width * image.shape[0] / image.shape[1] + 0.1
    span = span_of(walks)
    flat = span[0] > 3.0 * span[1]  # a straight line has a row of its own
    middle, bottom = (0.85 * width * span[1] / span[0] + 0.7 if flat else 0.0), 4.4
    legend = 0.55
    with drawing(path, width, top + middle + bottom + legend, legend_columns=4) as figure:
        heights = [height for height in (top, middle, bottom) if height]
        rows = iter(figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights).flat)
        if image is not None:
            axes = next(rows).subplots()
            axes.imshow(image)
            axes.set_axis_off()
        if flat:
            above, beside = next(rows), next(rows)
        else:
            # as wide as the path needs at the height of the panels
            share = float(np.clip(bottom * span[0] / span[1] / width, 0.25, 0.42))
            above, beside = next(rows).subfigures(1, 2, width_ratios=[share, 1.0 - share])
        draw_path(above.subplots(), walks)
        draw_tracking(beside.subplots(2, 3, sharex=True), main)
    return caption("collective", snapshots=image is not None, last=list(walks)[-1], main=main)
