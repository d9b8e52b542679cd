"""Weight sets beside each other: by plant, scene, push and trajectory."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from hector_jax.report.plots.style import drawing, legend, log_axis, looks_of, named
from hector_jax.runs.metrics import BASELINES, Verdict, compare

DIRECTIONS = 45 * np.arange(8)  # [deg] of the pushes, from ahead to the left


def changes(
    path: Path,
    verdicts: Mapping[str, Verdict],
    paper: Mapping[tuple[str, str, str], float],
) -> str:
    """Loss of every set against nominal and expert on every plant.

    Args:
        path: file to write.
        verdicts: by trajectory.
        paper: the paper's change [%] by trajectory, set and baseline.
    """
    every = dict.fromkeys(name for verdict in verdicts.values() for name in verdict.scores)
    names = [name for name in every if name not in BASELINES]
    size = (3.3 * len(verdicts) + 1.2, 2 * (0.27 * len(names) + 0.75) + 0.3)
    with drawing(path, *size) as figure:
        panels = figure.subplots(2, len(verdicts), sharex="row", sharey=True, squeeze=False)
        for row, baseline in zip(panels, BASELINES, strict=True):
            for panel, (trajectory, verdict) in zip(row, verdicts.items(), strict=True):
                _draw_changes(panel, verdict, names, baseline)
                found = {i: paper.get((trajectory, n, baseline)) for i, n in enumerate(names)}
                at = {i: 1 + x / 100 for i, x in found.items() if x is not None}
                look = {"color": "black", "markerfacecolor": "white", "markersize": 5, "zorder": 4}
                panel.plot(
                    list(at.values()), list(at), "D", **look, label="the paper, on the robot"
                )
                panel.set(xlabel=f"change of L against {baseline} [%]", title=trajectory)
            log_axis(row[0], "x")
            row[0].xaxis.set_major_formatter(
                lambda r, _: f"{100 * (r - 1):+.0f}" if r != 1 else "0"
            )
        panels[0, 0].set_yticks(range(len(names)), [named(name) for name in names])
        panels[0, 0].set_ylim(len(names) - 0.5, -0.5)
        panels[0, 0].plot([], [], "o", color="0.4", alpha=0.5, label="one plant")
        cross = {"color": "0.2", "markersize": 11, "mew": 2.2}
        panels[0, 0].plot([], [], "+", **cross, label="median and its interval")
        legend(figure, panels[0, 0])
    return (
        "L of each set against that of nominal and expert on the same plant, one dot per plant, "
        "with the median and its 95 % bootstrap interval; left of the line is better. Plants on "
        "which the set fell have no dot, their number stands at the right; the median counts them. "
        "Diamonds are the paper's table, after ten iterations."
    )


def _draw_changes(panel: Axes, verdict: Verdict, names: Sequence[str], baseline: str) -> None:
    panel.axvline(1.0, color="black", linewidth=0.9)
    looks = looks_of(names)
    for row, name in enumerate(names):
        if name not in verdict.scores:
            continue
        score, color = verdict.scores[name], looks[name].color
        up = (score.L / verdict.scores[baseline].L)[~score.fallen]
        panel.plot(up, np.full(len(up), row), "o", color=color, alpha=0.3, markersize=3, mew=0)
        if falls := int(score.fallen.sum()):
            edge = {"transform": panel.get_yaxis_transform(), "ha": "right", "va": "center"}
            panel.text(0.99, row, f"{falls} fell", color=color, **edge)
        value, low, high = (1 + x / 100 for x in compare(verdict, name, baseline).change["L"])
        if len(up):  # an interval that falls widen shall not squeeze the axis
            high = min(high, 1.1 * max(*up, value))
        panel.hlines(row, low, high, color=color, linewidth=2.2, zorder=3)
        panel.plot(value, row, "|", color=color, markersize=11, mew=2.2, zorder=3)
    panel.grid(visible=False, axis="y")


def survival(path: Path, rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Loss against the baseline and share of walks without a fall, one row per disturbance.

    Args:
        path: file to write.
        rows: by what is in the way, cells by set, the baseline first.
    """
    looks = looks_of(next(iter(rows.values())))
    baseline, at = next(iter(looks)), -np.arange(len(rows))
    with drawing(path, 7.5, 0.3 * len(rows) + 0.9) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for i, (name, look) in enumerate(looks.items()):
            y = at + 0.25 * ((len(looks) - 1) / 2 - i)
            ratio = np.array([row[name].ratio for row in rows.values()])
            stood = 100 * np.array([row[name].survived for row in rows.values()])
            for panel, (value, low, high) in zip(panels, (ratio.T, stood.T), strict=True):
                panel.plot(value, y, **look.dot, label=named(name))
                panel.hlines(y, low, high, color=look.color, linewidth=1.2)
        panels[0].axvline(1.0, color="black", linewidth=0.8, zorder=1)
        panels[0].set_xlabel(f"median of L / L of {baseline}")
        panels[0].set_yticks(at, list(rows))
        log_axis(panels[0], "x")
        panels[1].set(xlabel="walks without a fall [%]", xlim=(-4, 104))
        legend(figure, panels[1])
    return (
        "What is in the way, a row each: the median ratio of L to the baseline's in the same scene "
        "on the same plant (left of 1 is better), and the walks without a fall (right is better). "
        "Lines are 95 % intervals from redrawing the plants."
    )


def push_directions(path: Path, endured: Mapping[str, Float[np.ndarray, "8"]]) -> str:
    """Largest push survived, by the direction in which it pushes.

    Args:
        path: file to write.
        endured: [N] by set, in the order of `DIRECTIONS`.
    """
    angles = np.deg2rad(np.append(DIRECTIONS, DIRECTIONS[0]))
    with drawing(path, 4.6, 4.4) as figure:
        axes = figure.subplots(subplot_kw={"projection": "polar", "theta_offset": np.pi / 2})
        for name, look in looks_of(endured).items():
            closed = np.append(endured[name], endured[name][0])
            marker = {"marker": look.marker, "markersize": 3.5}
            axes.plot(angles, closed, **look.line, **marker, label=named(name))
        axes.set_rmin(0.0)
        axes.set_rlabel_position(22.5)
        axes.yaxis.set_major_formatter(lambda force, _: f"{force:g} N")
        axes.set_title("Largest push of 0.1 s survived, by where it pushes to", pad=14)
        names = {0: "ahead", 90: "left", 180: "back", 270: "right"}
        axes.set_xticks(angles[:-1], [names.get(int(d), "") for d in DIRECTIONS])
        legend(figure, axes, columns=3)
    return (
        "Largest push [N] of 0.1 s that is survived together with all smaller ones, by where it "
        "pushes to; mean over plants and gait phases."
    )


def ratios(
    path: Path, columns: Sequence[str], sets: Mapping[str, Float[np.ndarray, " columns"]]
) -> str:
    """Losses of weight sets as ratios to nominal, by trajectory.

    Args:
        path: file to write.
        columns: the trajectories.
        sets: by name, a ratio per trajectory.
    """
    at, width = np.arange(len(columns)), 0.7 / max(len(sets), 1)
    with drawing(path, 7.5, 3.2) as figure:
        axes, looks = figure.subplots(), looks_of(sets)
        for i, (name, values) in enumerate(sets.items()):
            x = at + width * (i - (len(sets) - 1) / 2)
            axes.plot(x, values, markersize=6, label=named(name), **looks[name].dot)
        axes.axhline(1.0, color="black", linewidth=0.8)
        for edge in at[1:]:
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8)
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, columns)
        axes.tick_params(axis="x", length=0)
        log_axis(axes, "y")
        axes.set(ylabel="L / L of nominal", xlim=(-0.5, len(columns) - 0.5))
        legend(figure, axes)
    return "Loss on the hfs as a ratio to that of the nominal weights (1)."


def by_plant(path: Path, sets: Mapping[str, Float[np.ndarray, " plants"]]) -> str:
    """Losses of weight sets on many plants, each set's in rising order.

    Args:
        path: file to write.
        sets: by name, a loss per plant.
    """
    with drawing(path, 6.0, 3.4) as figure:
        axes, looks = figure.subplots(), looks_of(sets)
        for name, values in sets.items():
            share = 100 * (np.arange(len(values)) + 0.5) / len(values)
            look = looks[name]
            axes.plot(
                share, np.sort(values) / 1e6, label=named(name), marker=look.marker, **look.line
            )
        log_axis(axes, "y")
        axes.set(xlabel="plants [%], by their loss", ylabel="L [10$^6$]", xlim=(0, 100))
        legend(figure, axes)
    return "Loss on each plant, in rising order for each set: the right end is the tail."
