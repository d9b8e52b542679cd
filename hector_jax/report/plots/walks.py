"""Where a walk went and how well it kept to its reference."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.image import imread

from hector_jax.core.trajectory import Trajectory, from_start
from hector_jax.report.plots.style import CURVES, drawing, legend, looks_of, named, widen

_FRAME = "Each walk is seen from where it stood and faced at t = 0, so that all have one reference."
_MAIN = ("nominal", "expert", "without", "with")  # more lines cannot be told apart
_BEST = "ceiling"


def _times(walk: Trajectory) -> Float[np.ndarray, " T"]:
    """Times [s] of the samples, which stand at the ends of their intervals."""
    return float(walk.period) * np.arange(1, len(walk.fallen) + 1)


def _errors(walk: Trajectory) -> dict[str, Float[np.ndarray, " T"]]:
    """What the six coordinates are off by, along the heading of the reference; NaN after a fall."""
    state, reference = walk.state, walk.reference
    yaw = np.asarray(reference.euler)[:, 2]
    x, y, up = 100 * (np.asarray(state.position) - np.asarray(reference.position)).T
    angles = np.rad2deg(np.asarray(state.euler) - np.asarray(reference.euler)).T
    values = {
        "error ahead [cm]": np.cos(yaw) * x + np.sin(yaw) * y,
        "error left [cm]": np.cos(yaw) * y - np.sin(yaw) * x,
        "error up [cm]": up,
        **dict(
            zip(
                (f"error in {angle} [deg]" for angle in ("roll", "pitch", "yaw")),
                angles,
                strict=True,
            )
        ),
    }
    return {label: np.where(walk.fallen, np.nan, value) for label, value in values.items()}


def tracking(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """What position and attitude are off by, along each walk.

    Args:
        path: file to write.
        walks: by set, on the same plant and command.
    """
    with drawing(path, 10.0, 4.2) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        _draw_tracking(panels, walks)
        legend(figure, panels[0, 0])
    return (
        "Errors of the centre of mass and of the Euler angles, one stand-in walk of each set; "
        "each against its own reference, ahead and left as the reference faces."
    )


def _draw_tracking(panels: np.ndarray, walks: Mapping[str, Trajectory]) -> None:
    """Fill 2 x 3 panels."""
    looks = looks_of(walks)
    for name, walk in walks.items():
        for panel, (label, values) in zip(panels.flat, _errors(walk).items(), strict=True):
            panel.plot(_times(walk), values, **looks[name].line, label=named(name))
            panel.set_ylabel(label)
    for panel in panels.flat:
        panel.axhline(0.0, color="black", linewidth=0.8)
        widen(panel, 1.0)
    for panel in panels[-1]:
        panel.set_xlabel("time [s]")


def distances(
    path: Path,
    walks: Mapping[str, Trajectory],
    colours: Sequence[tuple[int, int, int]],
    width: int,
    height: int,
) -> tuple[int, int, int, int]:
    """Distance from the reference in the plane by time, to stand below a film.

    Args:
        path: file to write.
        walks: two, by the words for them, before and after.
        colours: of both, 0 to 255.
        width: of the picture [pixel].
        height: of the picture [pixel].

    Returns:
        Left, top, right and bottom of the axes in the picture [pixel].
    """
    dpi = height / 1.2  # a figure of 1.2 inches, however many pixels
    with drawing(path, width / dpi, height / dpi, dpi) as figure:
        axes = figure.subplots()
        looks = zip(colours, ((0, (5, 1.5)), "-"), strict=True)
        for (name, walk), (colour, style) in zip(walks.items(), looks, strict=True):
            errors = _errors(walk)
            away = np.hypot(errors["error ahead [cm]"], errors["error left [cm]"])
            mean = np.sqrt(np.nanmean(away**2)) if np.isfinite(away).any() else np.nan
            label = f"{named(name)}: {mean:.1f} cm RMS"
            axes.plot(_times(walk), away, color=np.divide(colour, 255), ls=style, label=label)
        axes.set_title("distance from the reference [cm]", loc="left")
        axes.set(
            xlabel="time [s]",
            xlim=(0.0, max(_times(walk)[-1] for walk in walks.values())),
            ylim=(0.0, None),
        )
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.95), ncols=2, borderaxespad=0.1)
        figure.draw_without_rendering()
        box = axes.get_window_extent()
    return round(box.x0), round(height - box.y1), round(box.x1), round(height - box.y0)


def path_from_above(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Top view of where the centre of mass went, with the footprints of the last set.

    Args:
        path: file to write.
        walks: by set, on the same plant and command.
    """
    walks = {name: from_start(walk) for name, walk in walks.items()}
    span, width = _span(walks), 7.0
    with drawing(path, width, float(np.clip(width * span[1] / span[0], 0.8, 5.0)) + 0.9) as figure:
        axes = figure.subplots()
        _draw_path(axes, walks)
        legend(figure, axes, columns=4)
    return f"Path from above; foot marks are those of `{list(walks)[-1]}`. {_FRAME}"


def _span(walks: Mapping[str, Trajectory]) -> Float[np.ndarray, "2"]:
    """Extent of all paths in x and y [m], with room for the feet."""
    reference = next(iter(walks.values())).reference.position
    points = np.concatenate([walk.state.position[~walk.fallen, :2] for walk in walks.values()])
    return np.ptp(np.concatenate([points, reference[:, :2]]), axis=0) + 0.25


def _draw_path(axes: Axes, walks: Mapping[str, Trajectory]) -> None:
    """The paths of walks in the frame of their start."""
    last, looks = list(walks.values())[-1], looks_of(walks)
    for name, walk in walks.items():
        x, y = np.where(walk.fallen[:, None], np.nan, walk.state.position)[:, :2].T
        axes.plot(x, y, **looks[name].line, label=named(name))
    axes.plot(*last.reference.position[:, :2].T, **CURVES["reference"], label="reference")
    landed = np.diff(last.contact.astype(int), axis=0, prepend=0) > 0
    for foot, (side, marker) in enumerate((("left", 4), ("right", 5))):
        spots = last.feet[landed[:, foot] & ~last.fallen, foot]
        look = {"linestyle": "none", "marker": marker, "color": "0.6", "markersize": 6, "zorder": 1}
        axes.plot(*spots[:, :2].T, **look, label=f"{side} foot set down")
    axes.set(xlabel="x, ahead [m]", ylabel="y, left [m]", aspect="equal")
    axes.margins(0.05, 0.1)


def collective(path: Path, walks: Mapping[str, Trajectory], snapshots: Path | None) -> str:
    """The paper's collective figure: snapshots, path from above, and tracking.

    Args:
        path: file to write.
        walks: by set, on the same plant and command. Drawn are nominal, expert, without and with,
            of which there is at least one, and, on the path only, the ceiling.
        snapshots: picture of the walk, two rows of tiles; None where there is none.
    """
    main = {name: walk for name, walk in walks.items() if name in _MAIN}
    walks = {n: from_start(walk) for n, walk in walks.items() if n in (*_MAIN, _BEST)}
    width = 10.0
    image = None if snapshots is None else imread(snapshots)
    top = 0.0 if image is None else 0.97 * width * image.shape[0] / image.shape[1] + 0.1
    span = _span(walks)
    flat = span[0] > 3.0 * span[1]  # a straight line has a row of its own
    middle, bottom = (0.85 * width * span[1] / span[0] + 0.7 if flat else 0.0), 4.4
    head = 0.55  # the legend's
    with drawing(path, width, top + middle + bottom + head) as figure:
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
        axes = above.subplots()
        _draw_path(axes, walks)
        _draw_tracking(beside.subplots(2, 3, sharex=True), main)
        legend(figure, axes, columns=4)
    seen = "" if image is None else "Snapshots; "
    return (
        f"{seen}path of the centre of mass from above, foot marks those of `{list(walks)[-1]}`; "
        f"errors against the reference of {', '.join(main)}, ahead and left as it faces. "
        f"One stand-in plant. {_FRAME}"
    )
