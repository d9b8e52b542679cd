"""What a tuning did, iteration by iteration, and tunings beside each other."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hector_jax.report.plots.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SETS,
    drawing,
    legend,
    log_axis,
    looks_of,
    named,
    weight_label,
)
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration
from hector_jax.tuning.loss import LossConfig


def losses(
    path: Path,
    alpha: LossConfig,
    histories: Mapping[str, Sequence[Iteration]],
    ten: int = PAPER_ITERATIONS,
) -> str:
    """Loss on the model by iteration, whole and by part.

    Args:
        path: file to write.
        alpha: loss weights, by which the parts are multiplied.
        histories: of the tunings, by set: `without` and `with`.
        ten: the iteration to mark.
    """
    parts = {
        "$L$": lambda found: found.loss,
        r"$\alpha_1 L_\mathrm{Eul}$": lambda found: alpha.euler * found.parts.euler,
        r"$\alpha_2 L_\mathrm{pos}$": lambda found: alpha.position * found.parts.position,
        r"$L_\mathrm{ctrl}$": lambda found: found.parts.control,
    }
    accepted = {n: np.array([i.accepted for i in history]) for n, history in histories.items()}
    looks = looks_of(histories)
    with drawing(path, 10.0, 2.7) as figure:
        panels = figure.subplots(1, 4)
        for panel, (title, part) in zip(panels, parts.items(), strict=True):
            panel.axvline(ten, color="0.5", linestyle=(0, (2, 2)), linewidth=0.9, zorder=0)
            for name, history in histories.items():
                values = np.array([float(part(i.evaluation)) for i in history]) / 1e6
                tried, kept = np.arange(len(values)), accepted[name]
                panel.plot(
                    tried[kept],
                    values[kept],
                    **looks[name].line,
                    marker=looks[name].marker,
                    markersize=3.2,
                    markevery=10,  # at each they hide how the line is dashed
                    label=named(name),
                )
                if title == "$L$":
                    top = 1.1 * values[kept].max()  # a step that failed need not be a number
                    seen = np.where(values < top, values, top)[~kept]
                    panel.plot(tried[~kept], seen, "kx", markersize=4.5)
            panel.set(title=title, xlabel="iteration", ylim=(0, 1.12 * panel.get_ylim()[1]))
            panel.xaxis.get_major_locator().set_params(integer=True)
        panels[0].set_ylabel("loss on the model [10$^6$]")
        if not all(kept.all() for kept in accepted.values()):
            panels[0].plot([], [], "kx", markersize=4.5, label="refused step")
        legend(figure, panels[0])
    return (
        f"Loss on the model by iteration, whole and by part; the line is iteration {ten}, "
        "a cross is a refused step; every tenth accepted one has a marker."
    )


def weights(
    path: Path,
    names: Sequence[str],
    sets: Mapping[str, Float[np.ndarray, " weights"]],
) -> str:
    """Weights before and after, as ratios to the nominal ones.

    Args:
        path: file to write.
        names: of the weights, such as `WEIGHT_NAMES`.
        sets: `nominal`, `expert` and the tuned `without`, `with`, flat in the order of `names`.
    """
    base = np.asarray(sets["nominal"])
    tuned = [name for name in ("without", "with") if name in sets]
    at = np.arange(len(names))
    with drawing(path, 10.0, 3.4) as figure:
        axes = figure.subplots()
        for i, name in enumerate(tuned):
            ratio = np.asarray(sets[name]) / base
            axes.bar(
                at + 0.38 * (i - (len(tuned) - 1) / 2),
                ratio - 1.0,
                0.36,
                bottom=1.0,
                color=SETS[name]["color"],
                hatch="////" if name == "without" else None,
                edgecolor="white",
                linewidth=0.0,
                label=named(name),
            )
        if "expert" in sets:
            axes.plot(
                at,
                np.asarray(sets["expert"]) / base,
                **looks_of(["expert"])["expert"].dot,
                markerfacecolor="white",
                label="expert",
            )
        axes.axhline(1.0, color="black", linewidth=0.8)
        for edge in range(3, len(names), 3):  # Euler angles, position, and so on
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8, zorder=0)
        log_axis(axes, "y")
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, [weight_label(n) for n in names], rotation=60, ha="right", va="center")
        for label in axes.get_xticklabels():
            label.set_rotation_mode("anchor")
        axes.tick_params(axis="x", length=0)
        axes.set(ylabel="weight / nominal", xlim=(-0.7, len(names) - 0.3))
        legend(figure, axes)
    return "Tuned weights as ratios to the nominal ones (1); diamonds are the expert's."


_ARMS = {
    "fixed": ("weights stay", SETS["nominal"]),
    "until": ("tuned until the change", SETS["without"]),
    "carried": ("tuned all the way", SETS["with"]),
}


def while_walking(
    path: Path,
    change: float,
    times: Float[np.ndarray, " windows"],
    curves: Mapping[tuple[str, str], Mapping[str, Float[np.ndarray, "plants windows"]]],
) -> str:
    """Loss along walks on which the plant changes, with weights that stay or are tuned.

    Args:
        path: file to write.
        change: when the plant changes [s].
        times: middles of the windows of which the losses are [s].
        curves: losses by trajectory and start weights, the columns and rows of panels, and by arm.
    """
    columns, rows = (list(dict.fromkeys(key[i] for key in curves)) for i in (0, 1))
    size = (3.3 * len(columns) + 0.2, 2.0 * len(rows) + 0.5)
    with drawing(path, *size) as figure:
        panels = figure.subplots(len(rows), len(columns), sharex=True, squeeze=False)
        for (trajectory, which), arms in curves.items():
            panel = panels[rows.index(which), columns.index(trajectory)]
            panel.axvline(change, color="0.5", linestyle=(0, (2, 2)), linewidth=0.9, zorder=0)
            for arm, found in arms.items():
                label, look = _ARMS[arm]
                panel.plot(times, np.median(found, axis=0) / 1e6, **look, label=label)
            panel.set(title=f"{trajectory}, from {which}", ylim=(0, 1.05 * panel.get_ylim()[1]))
        for panel in panels[-1]:
            panel.set_xlabel("time [s]")
        for panel in panels[:, 0]:
            panel.set_ylabel(f"L of {times[1] - times[0]:.1f} s [10$^6$]")
        legend(figure, panels[0, 0], columns=len(columns))
    return "Loss along the walk, median over the plants; the line is where the plant changes."


def weight_courses(
    path: Path,
    change: float,
    times: Float[np.ndarray, " steps"],
    names: Sequence[str],
    courses: Mapping[str, Float[np.ndarray, "steps weights"]],
    most: int = 6,
) -> str:
    """How weights moved while walking: those that moved most, as ratios to where they started.

    Args:
        path: file to write.
        change: when the plant changes [s].
        times: of the steps [s].
        names: of the weights.
        courses: ratios by trajectory; a walk that ended early has fewer steps.
        most: how many weights to draw in each panel.
    """
    colors = (BLUE, ORANGE, GREEN, PURPLE, "0.35", "black")
    marks = "osD^vP"
    with drawing(path, 3.3 * len(courses) + 0.2, 3.4) as figure:
        panels = figure.subplots(1, len(courses), squeeze=False)[0]
        for panel, (trajectory, ratios) in zip(panels, courses.items(), strict=True):
            panel.axvline(change, color="0.5", linestyle=(0, (2, 2)), linewidth=0.9, zorder=0)
            single = [i for i, name in enumerate(names) if not name.endswith("_right")]
            moved = np.abs(np.log(ratios[:, single])).max(axis=0)
            for i, color, mark in zip(np.argsort(-moved)[:most], colors, marks, strict=False):
                label = weight_label(names[single[i]].removesuffix("_left"))
                values = ratios[:, single[i]]
                panel.plot(
                    times[: len(values)], values, color=color, marker=mark, ms=2.6, label=label
                )
            panel.set(title=trajectory, xlabel="time [s]")
            log_axis(panel, "y")
            panel.legend(
                ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.18), columnspacing=1.2
            )
        panels[0].set_ylabel("weight / its start")
    return f"The {most} weights that moved most; both feet share one R."


def front(
    path: Path,
    prices: Float[np.ndarray, " points"],
    worlds: Mapping[str, Float[np.ndarray, "points 2"]],
    beside: Mapping[str, tuple[float, float]],
) -> str:
    """Tracking against smoothness of weights tuned at several prices of tracking.

    Args:
        path: file to write.
        prices: factors of the paper's loss weights.
        worlds: by name, tracking and L_ctrl by price.
        beside: the same of other weight sets, in the world named last.
    """
    with drawing(path, 4.0 * len(worlds), 3.6) as figure:
        panels = figure.subplots(1, len(worlds), squeeze=False)[0]
        for panel, (world, values) in zip(panels, worlds.items(), strict=True):
            kept = np.isfinite(values).all(axis=1)
            points, factors = values[kept] / 1e6, prices[kept]
            panel.plot(*points.T, "o-", color=GREEN, label="tuned")
            if world == list(worlds)[-1]:
                for name, look in looks_of(beside).items():
                    panel.plot(*np.divide(beside[name], 1e6), label=named(name), **look.dot)
            paper = int(np.argmin(np.abs(np.log(factors))))
            for i, (x, y, side) in {
                0: (6, 0, "left"),
                paper: (-6, -4, "right"),
                -1: (0, 6, "center"),
            }.items():
                text = f"x{float(f'{factors[i]:.2g}'):g}"
                panel.annotate(text, points[i], (x, y), textcoords="offset points", ha=side)
            panel.margins(0.15, 0.1)
            log_axis(panel, "x")
            panel.set(title=world, xlabel="tracking [10$^6$]")
        panels[0].set_ylabel(r"$L_\mathrm{ctrl}$ [10$^6$]")
        legend(figure, panels[-1])
    return (
        "Each point is a tuning. Along the line the price of tracking grows by one factor from "
        "point to point; labels stand at its ends and at the paper's price (x1). Left and down is "
        "better."
    )


def starts(path: Path, curves: Float[np.ndarray, "starts iterations"]) -> str:
    """Loss by iteration from several starts, and where they end.

    Args:
        path: file to write.
        curves: losses that were accepted, NaN elsewhere; the first row starts at nominal.
    """
    with drawing(path, 7.5, 3.4) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
        ends = []
        for i, row in enumerate(curves):
            kept = np.flatnonzero(np.isfinite(row))
            look = {"color": "0.7", "linewidth": 0.8} if i else SETS["with"] | {"zorder": 3}
            label = {0: "from nominal", 1: "from elsewhere"}.get(i)
            left.plot(kept, row[kept] / 1e6, label=label, **look)
            ends.append(row[kept[-1]] / 1e6)
        order = np.sort(ends)
        share = 100 * (np.arange(len(ends)) + 0.5) / len(ends)
        right.plot(share, order, "o", color="0.5", markersize=3)
        right.plot(share[np.searchsorted(order, ends[0])], ends[0], "o", color=GREEN)
        log_axis(left, "y")
        left.set(xlabel="iteration", ylabel="L on the model [10$^6$]", title="on the way")
        left.xaxis.get_major_locator().set_params(integer=True)
        right.set(xlabel="starts [%]", title="at the end", xlim=(0, 100))
        legend(figure, left)
    return "Loss on the model by iteration from each start, and the losses at the end in order."


_RIVAL_LOOK = {
    "without": SETS["without"],
    "with": SETS["with"] | {"linewidth": 1.8},
    "adam": {"color": "#63b89f", "linestyle": (0, (3, 1.2))},
    "differences": {"color": "black", "linestyle": (0, (5, 1.5)), "linewidth": 1.1},
    "cma-es": SETS["searched"],
    "bayes": {"color": BLUE, "linestyle": (0, (5, 1.5))},
    "bayes near": {"color": BLUE, "linestyle": "-"},
    "random": {"color": GREY, "linestyle": "-"},
}


RIVALS = {
    "without": "DiffTune without net",
    "with": "DiffTune with net",
    "adam": "Adam with net",
    "differences": "differences on the simulator",
    "cma-es": "CMA-ES",
    "bayes": "Bayesian, whole box",
    "bayes near": "Bayesian, near the start",
    "random": "random",
}

"""Names of the ways of tuning that race."""


def race(
    path: Path,
    curves: Mapping[str, Sequence[tuple[Float[np.ndarray, " walks"], Float[np.ndarray, " walks"]]]],
    abscissa: str,
) -> str:
    """Lowest loss so far of each way of tuning: its repeats, and their median.

    Args:
        path: file to write.
        curves: by method, abscissa and loss of each repeat.
        abscissa: what the losses are drawn against.
    """
    with drawing(path, 7.0, 4.4) as figure:
        axes = figure.subplots()
        for name, repeats in curves.items():
            count = min(len(losses) for _, losses in repeats)
            x = np.median([at[:count] for at, _ in repeats], axis=0)
            losses = np.array([losses[:count] for _, losses in repeats]) / 1e6
            look = _RIVAL_LOOK[name]
            if len(losses) > 1:
                axes.step(x, losses.T, where="post", color=look["color"], alpha=0.45, lw=0.6)
            middle = np.median(losses, axis=0)
            axes.step(x, middle, where="post", **look, label=RIVALS[name])
            axes.plot(x[-1], middle[-1], "o", color=look["color"], markersize=3)
        axes.set(xlabel=abscissa, ylabel="lowest L on the simulator so far [10$^6$]")
        log_axis(axes, "y")
        legend(figure, axes, columns=3)
    return (
        f"Lowest loss on the high-fidelity simulator so far, by {abscissa}: median of the repeats, "
        "each of them thin."
    )
