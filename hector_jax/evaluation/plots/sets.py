"""Weight sets beside each other: by plant, scene, push and trajectory."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from hector_jax.evaluation.metrics import BASELINES, Verdict, compare
from hector_jax.evaluation.plots.style import (
    SETS,
    drawing,
    legend,
    log_axis,
    looks_of,
    named,
    plain_log,
)
from hector_jax.evaluation.robustness import DIRECTIONS, Cell


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
        for column, (trajectory, verdict) in zip(panels.T, verdicts.items(), strict=True):
            for panel, baseline in zip(column, BASELINES, strict=True):
                _draw_changes(panel, verdict, names, baseline)
                known = {n: paper.get((trajectory, n, baseline)) for n in names}
                at = {names.index(n): 1 + x / 100 for n, x in known.items() if x is not None}
                panel.plot(
                    list(at.values()),
                    list(at),
                    "D",
                    color="black",
                    markerfacecolor="white",
                    markersize=5,
                    zorder=4,
                    label="the paper, on the robot",
                )
                panel.set_xscale("log")
                panel.set(xlabel=f"L against {baseline} [%]", title=trajectory)
        for row in panels:
            low, high = row[0].get_xlim()
            few = _TENTHS if high < 3.0 * low else _RATIOS if high < 30.0 * low else _WIDE
            ticks = [r for r in few if low <= r <= high]
            row[0].xaxis.set_minor_locator(NullLocator())
            row[0].set_xticks(ticks, [f"{100 * (r - 1):+.0f}" if r != 1 else "0" for r in ticks])
        panels[0, 0].set_yticks(range(len(names)), [named(name) for name in names])
        panels[0, 0].set_ylim(len(names) - 0.5, -0.5)
        for mark, label in {"o": "one plant", "x": "one plant, the set fell"}.items():
            panels[0, 0].plot([], [], mark, color="0.4", label=label)
        cross = {"color": "0.2", "markersize": 11, "mew": 2.2}
        panels[0, 0].plot([], [], "+", **cross, label="median and its interval")
        legend(figure, panels[0, 0])
    return (
        "L of each set against that of nominal and expert on the same plant, one dot per plant, "
        "with the median and its 95 % bootstrap interval; left of the line is better. A cross is a "
        "plant on which the set fell. Diamonds are the paper's table, after ten iterations."
    )


_RATIOS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0)


_TENTHS = tuple(i / 10 for i in range(1, 30))


_WIDE = (0.05, 0.2, 0.5, 1.0, 3.0, 10.0, 50.0, 200.0)


def _draw_changes(panel: Axes, verdict: Verdict, names: Sequence[str], baseline: str) -> None:
    panel.axvline(1.0, color="black", linewidth=0.9)
    looks = looks_of(names)
    for row, name in enumerate(names):
        if name not in verdict.scores:
            continue
        score, color = verdict.scores[name], looks[name].color
        ratio = score.L / verdict.scores[baseline].L
        fell, up = ratio[score.fallen], ratio[~score.fallen]
        panel.plot(up, np.full(len(up), row), "o", color=color, alpha=0.3, markersize=3, mew=0)
        panel.plot(fell, np.full(len(fell), row), "x", color=color, markersize=5)
        value, low, high = (1 + x / 100 for x in compare(verdict, name, baseline).change["L"])
        panel.hlines(row, low, high, color=color, linewidth=2.2, zorder=3)
        panel.plot(value, row, "|", color=color, markersize=11, mew=2.2, zorder=3)
    panel.grid(visible=False, axis="y")


def survival(path: Path, curves: Mapping[str, Mapping[float, Mapping[str, Cell]]]) -> str:
    """Share of walks without a fall and loss against the baseline, by the size of a disturbance.

    Args:
        path: file to write.
        curves: `push` by force and `friction` by the floor's friction, cells by set, the baseline
            first.
    """
    labels = {"push": "push [N]", "friction": "friction that the floor steps to"}
    with drawing(path, 7.0, 2.5 * len(curves) + 0.3) as figure:
        panels = figure.subplots(len(curves), 2, squeeze=False, sharex="row")
        for row, (kind, found) in zip(panels, curves.items(), strict=True):
            sizes = sorted(found)
            names = list(found[sizes[0]])
            for name, look in looks_of(names).items():
                cells = [found[size][name] for size in sizes]
                stood = np.array([cell.survived for cell in cells])
                ratio = np.array([cell.ratio for cell in cells])
                for panel, values in zip(row, (100 * stood, ratio), strict=True):
                    marker = {"marker": look.marker, "markersize": 3.5}
                    panel.plot(sizes, values[:, 0], **look.line, **marker, label=named(name))
                    panel.fill_between(
                        sizes, values[:, 1], values[:, 2], color=look.color, alpha=0.12, lw=0
                    )
            row[0].set(ylabel="walks without a fall [%]", ylim=(-4, 104), xlabel=labels[kind])
            row[1].set(ylabel=f"median L / {names[0]}", yscale="log", xlabel=labels[kind])
            plain_log(row[1].yaxis)
            row[0].set_xticks(sizes, [f"{size:g}" for size in sizes])
            if kind == "friction":  # the harder the further to the right
                row[0].invert_xaxis()
        legend(figure, panels[0, 0])
    return (
        "Walks without a fall, and the median ratio of L to the baseline's in the same scene on "
        "the same plant, by the force of a push from eight sides and by how slippery the floor "
        "turns. Bands redraw the plants."
    )


def scene_ratios(path: Path, rows: Mapping[str, Mapping[str, Cell]]) -> str:
    """Loss against the baseline and share of walks without a fall, one row per scene.

    Args:
        path: file to write.
        rows: by the scene's name, cells by set, the baseline first.
    """
    baseline, *others = next(iter(rows.values()))
    at = -np.arange(len(rows))
    with drawing(path, 7.0, 0.3 * len(rows) + 0.9) as figure:
        panels = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
        looks = looks_of([baseline, *others])
        for i, (name, look) in enumerate(looks.items()):
            y = at + 0.2 * ((len(looks) - 1) / 2 - i)
            dot = look.dot | {"label": named(name)}
            stood = np.array([row[name].survived for row in rows.values()])
            ratio = np.array([row[name].ratio for row in rows.values()])
            if name != baseline:
                panels[0].hlines(y, ratio[:, 1], ratio[:, 2], color=look.color, linewidth=1.0)
                panels[0].plot(ratio[:, 0], y, **dot)
            panels[1].plot(100 * stood[:, 0], y, **dot)
        panels[0].axvline(1.0, **SETS["nominal"])
        panels[0].set(xscale="log", xlabel=f"median L / {baseline}")
        plain_log(panels[0].xaxis)
        panels[0].set_yticks(at, list(rows))
        panels[1].set(xlabel="walks without a fall [%]", xlim=(-5, 105))
        legend(figure, panels[1])
    return (
        "Scenes in which something is in the way: the median ratio of L to the baseline's (left of "
        "1 is better) with its interval from redrawing the plants, and what did not fall."
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
            axes.plot(x, values, markersize=6, label=name, **looks[name].dot)
        axes.axhline(1.0, color="black", linewidth=0.8)
        for edge in at[1:]:
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8)
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, columns)
        axes.tick_params(axis="x", length=0)
        log_axis(axes.yaxis, axes.set_yscale)
        axes.set(ylabel="L / nominal", xlim=(-0.5, len(columns) - 0.5))
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
            axes.plot(share, np.sort(values) / 1e6, label=name, marker=look.marker, **look.line)
        log_axis(axes.yaxis, axes.set_yscale)
        axes.set(xlabel="plants [%], by their loss", ylabel="L [10$^6$]", xlim=(0, 100))
        legend(figure, axes)
    return "Loss on each plant, in rising order for each set: the right end is the tail."
