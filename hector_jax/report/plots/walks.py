"""Pictures of walks: where each went, and how far it was from its reference."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.artist import setp
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

from hector_jax.core.trajectory import Trajectory, from_start
from hector_jax.report.motion import COLOURS, Motion
from hector_jax.report.plots.style import CURVES, drawing, label_of, looks_of, widen
from hector_jax.report.report import caption


def tracking(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Draw the errors of position and attitude along each walk.

    Args:
        path: file to write.
        walks: by weight set, on the same plant and command.
    """
    with drawing(path, 10.0, 4.2) as figure:
        draw_tracking(figure.subplots(2, 3, sharex=True), walks)
    return caption("tracking")


def _errors(walk: Trajectory) -> dict[str, Float[np.ndarray, " T"]]:
    """Errors of the six coordinates, along the heading of the reference; NaN after a fall."""
    R = Rotation.from_euler("z", np.asarray(walk.reference.euler)[:, 2:])
    away = R.apply(np.asarray(walk.state.position) - walk.reference.position, inverse=True)
    angles = np.rad2deg(np.asarray(walk.state.euler) - walk.reference.euler)
    labels = [f"error {way} [cm]" for way in ("ahead", "left", "up")]
    labels += [f"error in {angle} [deg]" for angle in ("roll", "pitch", "yaw")]
    values = np.where(walk.fallen[:, None], np.nan, np.hstack([100 * away, angles]))
    return dict(zip(labels, values.T, strict=True))


def draw_tracking(panels: np.ndarray, walks: Mapping[str, Trajectory]) -> None:
    """Draw the errors of position and attitude along each walk into 2 x 3 panels."""
    for name, look in looks_of(walks).items():
        times = float(walks[name].period) * np.arange(1, len(walks[name].fallen) + 1)
        for panel, (label, values) in zip(panels.flat, _errors(walks[name]).items(), strict=True):
            panel.plot(times, values, **look.line, label=label_of(name))
            panel.set_ylabel(label)
    for panel in panels.flat:
        panel.axhline(0.0, color="black", linewidth=0.8)
        widen(panel, 1.0)
    setp(panels[-1], xlabel="time [s]")


def distances(
    path: Path, motions: Mapping[str, Motion], width: int, height: int
) -> tuple[int, int, int, int]:
    """Draw the distance from the reference in the plane by time, to stand below a film.

    Args:
        path: file to write.
        motions: two, by the words for them, before and after.
        width: of the picture [pixel].
        height: of the picture [pixel].

    Returns:
        Left, top, right and bottom of the axes in the picture [pixel].
    """
    dpi = height / 1.2  # a figure of 1.2 inches, however many pixels
    last = max(motion.times[-1] for motion in motions.values())
    with drawing(path, width / dpi, height / dpi, dpi=dpi, legend_columns=0) as figure:
        axes = figure.subplots()
        looks = zip(COLOURS, ((0, (5, 1.5)), "-"), strict=True)
        for (name, motion), (colour, style) in zip(motions.items(), looks, strict=True):
            upright = motion.times <= motion.fall_time
            away = np.where(upright, 100 * motion.distance, np.nan)
            mean = np.sqrt(np.mean(away[upright] ** 2)) if upright.any() else np.nan
            rms = f"{mean:.1f} cm RMS" if upright.any() else "fell at once"
            label = f"{label_of(name)}: {rms}"
            axes.plot(motion.times, away, color=np.divide(colour, 255), ls=style, label=label)
        axes.set_title("distance from the reference [cm]", loc="left")
        axes.set(xlabel="time [s]", xlim=(0.0, last), ylim=(0.0, None))
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.95), ncols=2, borderaxespad=0.1)
        figure.draw_without_rendering()
        box = axes.get_window_extent()
    return round(box.x0), round(height - box.y1), round(box.x1), round(height - box.y0)


def path_from_above(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Draw the path of the centre of mass from above, with the footprints of the last set.

    Args:
        path: file to write.
        walks: by weight set, on the same plant and command.
    """
    walks = {name: from_start(walk) for name, walk in walks.items()}
    span, width = span_of(walks), 7.0
    height = float(np.clip(width * span[1] / span[0], 0.8, 5.0)) + 0.9
    with drawing(path, width, height, legend_columns=4) as figure:
        draw_path(figure.subplots(), walks)
    return caption("path_from_above", last=list(walks)[-1])


def span_of(walks: Mapping[str, Trajectory]) -> Float[np.ndarray, "2"]:
    """Extent of all paths in x and y [m], with room for the feet."""
    reference = next(iter(walks.values())).reference.position
    points = np.concatenate([walk.state.position[~walk.fallen, :2] for walk in walks.values()])
    return np.ptp(np.concatenate([points, reference[:, :2]]), axis=0) + 0.25


def draw_path(axes: Axes, walks: Mapping[str, Trajectory]) -> None:
    """Draw the paths of walks in the frame of their start."""
    for name, look in looks_of(walks).items():
        fallen, position = walks[name].fallen, walks[name].state.position
        x, y = np.where(fallen[:, None], np.nan, position)[:, :2].T
        axes.plot(x, y, **look.line, label=label_of(name))
    last = list(walks.values())[-1]
    axes.plot(*last.reference.position[:, :2].T, **CURVES["reference"], label="reference")
    touchdowns = np.diff(last.contact.astype(int), axis=0, prepend=0) > 0
    mark = {"linestyle": "none", "color": "0.6", "markersize": 6, "zorder": 1}
    for foot, (side, marker) in enumerate((("left", 4), ("right", 5))):
        spots = last.feet[touchdowns[:, foot] & ~last.fallen, foot]
        axes.plot(*spots[:, :2].T, **mark, marker=marker, label=f"{side} foot set down")
    axes.set(xlabel="x, ahead [m]", ylabel="y, left [m]", aspect="equal")
    axes.margins(0.05, 0.1)
