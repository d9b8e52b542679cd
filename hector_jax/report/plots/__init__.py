"""The pictures of a run; only this package imports matplotlib.

Each function draws one picture to a file (the ending of its name sets the format) and returns its
caption. A weight set has the same colour, line and marker in all pictures, so that it can be
recognised in grey too. Figures are made without pyplot: no display, no global state. Scripts draw
their own pictures with `style`.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.artist import setp
from matplotlib.axes import Axes
from scipy.spatial.transform import Rotation

from hector_jax.core.trajectory import FEET, Trajectory, Wrench, from_start
from hector_jax.grfm.nets import History
from hector_jax.report.fidelity import Drift
from hector_jax.report.plots import style
from hector_jax.report.plots.style import CURVES, ORANGE, SETS, drawing, label_of, looks_of
from hector_jax.report.report import caption
from hector_jax.tuning.difftune import Iteration
from hector_jax.tuning.loss import Loss
from hector_jax.verdict.matrix import Cells, Column, columns_of, sets_of, trajectories_of
from hector_jax.verdict.metrics import Verdict, baseline_of, compare


def save_tracking(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Draw the errors of position and attitude along each walk.

    Args:
        path: file to write.
        walks: by weight set, on the same plant and command.
    """
    with drawing(path, 10.0, 4.2) as figure:
        draw_tracking(figure.subplots(2, 3, sharex=True), walks)
    return caption("tracking")


def _errors(walk: Trajectory) -> dict[str, Float[np.ndarray, " T"]]:
    """Return the errors of six coordinates in the reference's heading frame; NaN after a fall."""
    R = Rotation.from_euler("z", np.asarray(walk.reference.euler)[:, 2:])
    error = R.apply(np.asarray(walk.state.position) - walk.reference.position, inverse=True)
    angles = np.rad2deg(np.asarray(walk.state.euler) - walk.reference.euler)
    labels = [f"error {direction} [cm]" for direction in ("ahead", "left", "up")]
    labels += [f"error in {angle} [deg]" for angle in ("roll", "pitch", "yaw")]
    values = np.where(walk.fallen[:, None], np.nan, np.hstack([100 * error, angles]))
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
        style.widen(panel, 1.0)
    setp(panels[-1], xlabel="time [s]")


def save_path(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Draw the path of the centre of mass from above, with the footprints of the last set.

    Args:
        path: file to write.
        walks: by weight set, on the same plant and command.
    """
    walks = {name: from_start(walk) for name, walk in walks.items()}
    span, width = span_of(walks), 7.0
    feet = next(iter(walks.values())).contact.shape[-1]
    columns = 4 if feet == 2 else 3  # names of four feet are long
    legend_rows = -(-(len(walks) + 1 + feet) // columns)
    height = float(np.clip(width * span[1] / span[0], 0.8, 5.0)) + 0.5 + 0.2 * legend_rows
    with drawing(path, width, height, legend_columns=columns) as figure:
        draw_path(figure.subplots(), walks)
    return caption("path_from_above", last=list(walks)[-1])


def span_of(walks: Mapping[str, Trajectory]) -> Float[np.ndarray, "2"]:
    """Return the extent of all paths in x and y [m], with a margin for the feet."""
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
    names = FEET[touchdowns.shape[1]]
    for foot, (name, marker) in enumerate(zip(names, (4, 5, 6, 7), strict=False)):
        points = last.feet[touchdowns[:, foot] & ~last.fallen, foot]
        label = f"{name.replace('_', ' ')} foot set down"
        axes.plot(*points[:, :2].T, **mark, marker=marker, label=label)
    axes.set(xlabel="x, ahead [m]", ylabel="y, left [m]", aspect="equal")
    axes.margins(0.05, 0.1)


def save_losses(path: Path, loss: Loss, histories: Mapping[str, Sequence[Iteration]]) -> str:
    """Draw the total loss on the model and its parts by iteration.

    Args:
        path: file to write.
        loss: terms, which are multiplied by their weights.
        histories: histories of the tunings by weight set, `without` and `with`.
    """
    parts = {"$L$": lambda evaluation: evaluation.loss}
    for i, term in enumerate(loss, 1):
        alpha = "" if term.weight == 1.0 else rf"\alpha_{i} "
        title = rf"${alpha}L_\mathrm{{{term.name.removeprefix('L_')}}}$"
        parts[title] = lambda evaluation, term=term: term.weight * evaluation.terms[term.name]
    cross = {"linestyle": "none", "marker": "x", "color": "black", "markersize": 4.5}
    with drawing(path, 2.5 * len(parts), 2.7) as figure:
        panels = figure.subplots(1, len(parts))
        for panel, (title, part) in zip(panels, parts.items(), strict=True):
            for name, look in looks_of(histories).items():
                values = np.array([float(part(step.evaluation)) for step in histories[name]]) / 1e6
                accepted = np.array([step.accepted for step in histories[name]])
                good, bad = np.flatnonzero(accepted), np.flatnonzero(~accepted)
                marks = {"marker": look.marker, "markersize": 3.2}
                panel.plot(good, values[good], **look.line, **marks, label=label_of(name))
                if title == "$L$":
                    top = 1.1 * values[good].max()  # the loss of a rejected step may be infinite
                    panel.plot(bad, np.where(values < top, values, top)[bad], **cross)
            panel.set(title=title, xlabel="iteration", ylim=(0, 1.12 * panel.get_ylim()[1]))
            panel.xaxis.get_major_locator().set_params(integer=True)
        panels[0].set_ylabel("loss on the model [10$^6$]")
        if not all(step.accepted for history in histories.values() for step in history):
            panels[0].plot([], [], **cross, label="refused step")
    return caption("losses")


def save_weight_bars(
    path: Path, names: Sequence[str], sets: Mapping[str, Float[np.ndarray, " weights"]]
) -> str:
    """Draw tuned weights as ratios to the nominal ones.

    Args:
        path: file to write.
        names: names of the weights, from `weight_names`.
        sets: `nominal`, `expert` and tuned sets, flat in the order of `names`.
    """
    ratio = {name: np.divide(values, sets["nominal"]) for name, values in sets.items()}
    bars = [name for name in ("without", "with", "best", "shipped") if name in sets]
    with drawing(path, 10.0, 3.4) as figure:
        axes = figure.subplots()
        for i, name in enumerate(bars):
            x = np.arange(len(names)) + 0.8 / len(bars) * (i - (len(bars) - 1) / 2)
            look = {"color": SETS[name]["color"], "hatch": "////" if name == "without" else None}
            look |= {"edgecolor": "white", "linewidth": 0.0}
            axes.bar(
                x, ratio[name] - 1.0, 0.76 / len(bars), bottom=1.0, **look, label=label_of(name)
            )
        if "expert" in sets:
            look = looks_of(["expert"])["expert"].dot
            axes.plot(ratio["expert"], **look, markerfacecolor="white", label="expert")
        axes.axhline(1.0, color="black", linewidth=0.8)
        style.log_axis(axes, "y")
        labels = {"rotation": 60, "ha": "right", "va": "center", "rotation_mode": "anchor"}
        style.category_axis(axes, [name.replace("_", " ") for name in names], 3, **labels)
        axes.set_ylabel("weight / nominal, log scale")
    return caption("weights")


def save_wrenches(
    path: Path, period: float, curves: Mapping[str, Wrench], *, seconds: float = 0.4
) -> str:
    """Draw the commanded, predicted and measured wrench of the first foot over the first steps.

    Args:
        path: file to write.
        period: time between samples [s].
        curves: some of `commanded`, `predicted`, `paper`, `linear`, `measured`, one sample per
            period, (T, feet, 3) each; constant over the period.
        seconds: length from the start of the walk [s]; two steps by default.
    """
    first = next(iter(curves.values())).force
    count = min(round(seconds / period), len(first))
    labels = ["$F_x$ [N]", "$F_y$ [N]", "$F_z$ [N]", "$M_x$ [N m]", "$M_y$ [N m]", "$M_z$ [N m]"]
    order = ("measured", "commanded", "linear", "paper", "predicted")
    # point feet have no moments
    rows = 1 + any(np.nan_to_num(curve.moment).any() for curve in curves.values())
    with drawing(path, 10.0, 0.4 + 2.0 * rows) as figure:
        panels = figure.subplots(rows, 3, sharex=True, squeeze=False)
        for name in (name for name in order if name in curves):
            wrench = np.concatenate([np.asarray(part)[:count, 0] for part in curves[name]], axis=1)
            look = {"baseline": None, "label": label_of(name), **CURVES[name]}
            for panel, values in zip(panels.flat, wrench.T, strict=False):
                panel.stairs(values, period * np.arange(count + 1), **look)
        for panel, label in zip(panels.flat, labels, strict=False):
            panel.axvline(seconds / 2, color="0.75", linewidth=0.8, zorder=0)
            panel.set_ylabel(label)
            style.widen(panel, 5.0 if "[N]" in label else 0.5)
        setp(panels[-1], xlabel="time [s]")
    return caption("wrenches", side=FEET[first.shape[1]][0].replace("_", " "))


def save_open_loop(path: Path, worlds: Mapping[str, Mapping[str, Drift]]) -> str:
    """Draw the open-loop prediction errors of the rigid body by time ahead.

    Args:
        path: file to write.
        worlds: errors by world and phi.
    """
    with drawing(path, 7.0, 2.6 * len(worlds) + 0.3, legend_columns=3) as figure:
        panels = figure.subplots(len(worlds), 2, squeeze=False, sharex=True)
        for row, (world, drifts) in zip(panels, worlds.items(), strict=True):
            for name, look in looks_of(drifts, CURVES).items():
                time, position, euler = drifts[name]
                row[0].plot(time, 100 * position, label=label_of(name), **look.line)
                row[1].plot(time, np.rad2deg(euler), **look.line)
            row[0].set(title=world, ylabel="error of the CoM [cm]", ylim=(0, None))
            row[1].set(title=world, ylabel="error of the angles [deg]", ylim=(0, None))
        setp(panels[-1], xlabel="time ahead [s]")
    return caption("open_loop")


def save_training(path: Path, history: History) -> str:
    """Draw the errors of the net by epoch, on the training and on the validation walks.

    Args:
        path: file to write.
        history: mean square errors in physical units.
    """
    kinds = {"force": "mean square error [N$^2$]", "moment": "mean square error [(N m)$^2$]"}
    if not np.any(history.valid_moment):  # feet without moments
        del kinds["moment"]
    with drawing(path, max(3.5 * len(kinds), 5.0), 2.7) as figure:  # the legend needs 5 inches
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for panel, (kind, label) in zip(panels, kinds.items(), strict=True):
            train, valid = (np.asarray(getattr(history, f"{p}_{kind}")) for p in ("train", "valid"))
            epochs, best = np.arange(1, len(train) + 1), int(np.argmin(valid))
            panel.plot(epochs, train, **SETS["expert"], label="training walks")
            panel.plot(epochs, valid, color=ORANGE, label="validation walks")
            panel.plot(epochs[best], valid[best], "o", color=ORANGE, label="least")
            # the first epochs of a new net may have large errors, which may be cut off
            top = 1.6 * np.percentile(np.concatenate([train, valid]), 90)
            panel.set(title=kind, xlabel="epoch", ylabel=label, ylim=(0.0, top))
    return caption("training")


def save_matrix(path: Path, cells: Cells, title_of: Callable[[Column], str]) -> str:
    """Draw the change of L of every set against the baseline, a row for each engine and model.

    Args:
        path: file to write.
        cells: walks of all sets, by column and trajectory.
        title_of: words for a column.
    """
    columns, names, trajectories = columns_of(cells), sets_of(cells), trajectories_of(cells)
    height = (0.15 * len(names) + 0.12) * len(columns) + 1.1
    width, labels = 2.9 * len(trajectories) + 1.5, 2 * len(trajectories)
    with drawing(path, width, height, legend_columns=labels) as figure:
        panels = figure.subplots(1, len(trajectories), sharex=True, sharey=True, squeeze=False)[0]
        for panel, trajectory in zip(panels, trajectories, strict=True):
            panel.axvline(0.0, color="black", linewidth=1.0, zorder=1)
            _draw_sets(panel, [cells[column, trajectory] for column in columns], names)
            panel.set(title=trajectory, xlabel=f"change of L against {baseline_of(names)} [%]")
            panel.grid(visible=False, axis="y")
            for edge, (above, below) in enumerate(pairwise(columns)):
                color = "0.9" if above.engine == below.engine else "0.4"
                panel.axhline(edge + 0.5, color=color, linewidth=0.8, zorder=0)
        panels[0].set_yticks(range(len(columns)), [title_of(column) for column in columns])
        panels[0].set(ylim=(len(columns) - 0.5, -0.5), xlim=(-100.0, _WORST + 45.0))
        setp(panels, xticks=[-100, -50, 0, 50])
    return caption("matrix", baseline=baseline_of(names))


_WORST = 60.0  # [%] a larger change is drawn as an arrow


def _draw_sets(panel: Axes, verdicts: Sequence[Verdict], names: Sequence[str]) -> None:
    for i, (name, look) in enumerate(looks_of(names).items()):
        edge = {"color": look.color, "ha": "right", "va": "center", "fontsize": 7}
        for row, verdict in enumerate(verdicts):
            comparison = compare(verdict, name, baseline_of(names))
            y = row + 0.8 * ((i + 0.5) / len(names) - 0.5)
            value, low, high = comparison.change["L"]
            dot = dict(look.dot, markerfacecolor=look.color if comparison.counts else "white")
            dot |= {"marker": r"$\rightarrow$", "markersize": 9} if value > _WORST else {}
            panel.plot(np.minimum([low, high], _WORST), [y, y], color=look.color, linewidth=1.6)
            label = label_of(name) if not row else None
            panel.plot(min(value, _WORST), y, **dot, zorder=3, label=label)
            if falls := int(verdict.scores[name].fallen.sum()):
                panel.text(_WORST + 43.0, y, f"{falls} fell", **edge)
