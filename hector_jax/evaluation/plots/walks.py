"""Where a walk went and how well it kept to its reference."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import imread

from hector_jax.evaluation.plots.style import CURVES, drawing, legend, looks_of, named, widen
from hector_jax.trajectory import Trajectory


def _times(walk: Trajectory) -> np.ndarray:
    """Times [s] of the samples, which stand at the ends of their intervals."""
    return float(walk.period) * np.arange(1, len(walk.fallen) + 1)


def _standing(walk: Trajectory, values: np.ndarray) -> np.ndarray:
    """The values with those after a fall left out of the line."""
    return np.where(np.asarray(walk.fallen)[:, None], np.nan, values)


def tracking(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """CoM and Euler angles against their reference, and the errors that a path hides.

    Args:
        path: file to write.
        walks: by set, on the same plant and command.
    """
    with drawing(path, 10.0, 6.2) as figure:
        panels = figure.subplots(3, 3, sharex=True)
        _draw_tracking(panels, walks)
        legend(figure, panels[0, 0])
    return "Centre of mass and Euler angles of one stand-in walk of each set against the reference."


def _draw_tracking(panels: np.ndarray, walks: Mapping[str, Trajectory]) -> None:
    """Fill 3 x 3 panels."""
    first, looks = next(iter(walks.values())), looks_of(walks)
    rows = {
        "x [m]": lambda s: s.position[:, 0],
        "y [m]": lambda s: s.position[:, 1],
        "z [m]": lambda s: s.position[:, 2],
        "roll [deg]": lambda s: np.rad2deg(s.euler[:, 0]),
        "pitch [deg]": lambda s: np.rad2deg(s.euler[:, 1]),
        "yaw [deg]": lambda s: np.rad2deg(s.euler[:, 2]),
    }
    errors = {
        "error in x [cm]": lambda s, r: 100 * (s.position[:, 0] - r.position[:, 0]),
        "error in y [cm]": lambda s, r: 100 * (s.position[:, 1] - r.position[:, 1]),
        "error in yaw [deg]": lambda s, r: np.rad2deg(s.euler[:, 2] - r.euler[:, 2]),
    }
    for panel, (label, value) in zip(panels.flat, rows.items(), strict=False):
        for name, walk in walks.items():
            kept = _standing(walk, value(walk.state)[:, None])
            panel.plot(_times(walk), kept, **looks[name].line, label=named(name))
        panel.plot(_times(first), value(first.reference), **CURVES["reference"], label="reference")
        panel.set_ylabel(label)
    for panel, (label, value) in zip(panels[2], errors.items(), strict=True):
        for name, walk in walks.items():
            kept = _standing(walk, value(walk.state, walk.reference)[:, None])
            panel.plot(_times(walk), kept, **looks[name].line)
        panel.axhline(0.0, **CURVES["reference"])
        panel.set(ylabel=label, xlabel="time [s]")
    for panel in panels.flat:
        widen(panel, 0.02 if "[m]" in panel.get_ylabel() else 1.0)


def path_from_above(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Top view of where the centre of mass went, with the footprints of the last set.

    Args:
        path: file to write.
        walks: by set, on the same plant and command.
    """
    span, width = _span(walks), 7.0
    with drawing(path, width, float(np.clip(width * span[1] / span[0], 1.4, 5.0)) + 0.9) as figure:
        axes = figure.subplots()
        _draw_path(axes, walks)
        figure.legend(loc="outside upper center", ncols=4)
    return f"Path from above; foot marks are those of the set '{list(walks)[-1]}'."


def _span(walks: Mapping[str, Trajectory]) -> np.ndarray:
    """Extent of all paths in x and y [m], with room for the feet."""
    reference = next(iter(walks.values())).reference.position
    points = np.concatenate([walk.state.position[~walk.fallen, :2] for walk in walks.values()])
    return np.ptp(np.concatenate([points, reference[:, :2]]), axis=0) + 0.35


def _draw_path(axes: Axes, walks: Mapping[str, Trajectory], extra: str = "") -> None:
    """The paths, that of the set `extra` labelled as drawn nowhere else."""
    last, looks = list(walks.values())[-1], looks_of(walks)
    reference = next(iter(walks.values())).reference.position
    stands = np.asarray(last.contact)
    landed = stands & ~np.roll(stands, 1, axis=0)
    landed[0] = stands[0]
    for name, walk in walks.items():
        kept = _standing(walk, np.asarray(walk.state.position))
        label = f"{named(name)} (path only)" if name == extra else named(name)
        axes.plot(kept[:, 0], kept[:, 1], **looks[name].line, label=label)
    axes.plot(*np.asarray(reference)[:, :2].T, **CURVES["reference"], label="reference")
    for foot, marker in enumerate((4, 5)):
        spots = np.asarray(last.feet)[landed[:, foot] & ~np.asarray(last.fallen), foot]
        side = ("left", "right")[foot]
        axes.plot(
            *spots[:, :2].T,
            linestyle="none",
            marker=marker,
            color="0.6",
            markersize=6,
            zorder=1,
            label=f"{side} foot set down",
        )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.margins(0.05)


_MAIN = ("nominal", "expert", "without", "with")  # more lines cannot be told apart
_BEST = "ceiling"


def collective(path: Path, walks: Mapping[str, Trajectory], snapshots: Path | None) -> str:
    """The paper's collective figure: snapshots, path from above, and tracking.

    Args:
        path: file to write.
        walks: by set, on the same plant and command. Drawn are nominal, expert, without and with,
            of which there is at least one, and, on the path only, the long search.
        snapshots: picture of the walk, two rows of tiles; None where there is none.
    """
    main = {name: walk for name, walk in walks.items() if name in _MAIN}
    walks = {name: walk for name, walk in walks.items() if name in (*_MAIN, _BEST)}
    width = 10.0
    image = None if snapshots is None else imread(snapshots)
    top = 0.0 if image is None else 0.97 * width * image.shape[0] / image.shape[1] + 0.1
    span = _span(walks)
    flat = span[0] > 3.0 * span[1]  # a straight line has a row of its own
    middle, bottom = (0.85 * width * span[1] / span[0] + 0.7 if flat else 0.0), 6.2
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
        _draw_path(axes, walks, extra=_BEST)
        _draw_tracking(beside.subplots(3, 3, sharex=True), main)
        legend(figure, axes, columns=4)
    seen = "" if image is None else "Snapshots; "
    return (
        f"{seen}path of the centre of mass from above, foot marks those of "
        f"'{named(list(walks)[-1])}'; centre of mass and Euler angles against the reference, of "
        f"{', '.join(named(name) for name in main)}. One stand-in plant."
    )
