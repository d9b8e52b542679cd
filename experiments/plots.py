"""Pictures of the experiments, in the style of the package's own; each returns its caption."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from hector_jax.report.plots import style
from hector_jax.report.plots.style import SETS, drawing, label_of, log_axis, looks_of
from hector_jax.verdict.foretell import interval


def front(
    path: Path,
    prices: Float[np.ndarray, " points"],
    worlds: Mapping[str, Float[np.ndarray, "points 2"]],
    others: Mapping[str, tuple[float, float]],
) -> str:
    """Draw tracking against smoothness of weights tuned at several prices of tracking.

    Args:
        path: file to write.
        prices: factors of the paper's loss weights.
        worlds: by name, tracking and L_ctrl by price.
        others: tracking and L_ctrl of other weight sets, in the last world.
    """
    with drawing(path, 4.0 * len(worlds), 3.6) as figure:
        panels = figure.subplots(1, len(worlds), squeeze=False)[0]
        for panel, (world, values) in zip(panels, worlds.items(), strict=True):
            finite = np.isfinite(values).all(axis=1)
            points, factors = values[finite] / 1e6, prices[finite]
            panel.plot(*points.T, "o-", color=style.GREEN, label="tuned")
            if world == list(worlds)[-1]:
                for name, look in looks_of(others).items():
                    panel.plot(*np.divide(others[name], 1e6), label=label_of(name), **look.dot)
            paper = int(np.argmin(np.abs(np.log(factors))))
            places = {0: (6, 0, "left"), paper: (-6, -4, "right"), -1: (0, 6, "center")}
            for i, (x, y, side) in places.items():
                text = f"x{float(f'{factors[i]:.2g}'):g}"
                panel.annotate(text, points[i], (x, y), textcoords="offset points", ha=side)
            panel.margins(0.15, 0.1)
            log_axis(panel, "x")
            panel.set(title=world, xlabel="tracking [10$^6$]")
        panels[0].set_ylabel(r"$L_\mathrm{ctrl}$ [10$^6$]")
    return (
        "Each point is a tuning. Along the line the price of tracking grows by one factor from "
        "point to point; labels stand at its ends and at the paper's price (x1). Left and down is "
        "better."
    )


def starts(path: Path, curves: Sequence[Float[np.ndarray, " iterations"]]) -> str:
    """Draw the loss by iteration from several starts, and the final losses.

    Args:
        path: file to write.
        curves: accepted losses, NaN elsewhere; the first one starts at nominal.
    """
    with drawing(path, 7.5, 3.4) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
        ends = []
        for i, row in enumerate(curves):
            accepted = np.flatnonzero(np.isfinite(row))
            look = {"color": "0.7", "linewidth": 0.8} if i else SETS["with"] | {"zorder": 3}
            label = {0: "from nominal", 1: "from elsewhere"}.get(i)
            left.plot(accepted, row[accepted] / 1e6, label=label, **look)
            ends.append(row[accepted[-1]] / 1e6)
        order, share = np.sort(ends), 100 * (np.arange(len(ends)) + 0.5) / len(ends)
        right.plot(share, order, "o", color="0.5", markersize=3)
        right.plot(share[np.searchsorted(order, ends[0])], ends[0], "o", color=style.GREEN)
        log_axis(left, "y")
        left.set(xlabel="iteration", ylabel="L on the model [10$^6$]", title="on the way")
        left.xaxis.get_major_locator().set_params(integer=True)
        right.set(xlabel="starts [%]", title="at the end", xlim=(0, 100))
    return "Loss on the model by iteration from each start, and the losses at the end in order."


def draw_repeats(
    axes: Axes, by_count: Mapping[int, Sequence[float]], line: dict[str, Any], alpha: float
) -> None:
    """Draw the median of repeated losses by a count, and their range as a band.

    Args:
        axes: to draw in.
        by_count: losses of the repeats.
        line: arguments of plot; its colour is that of the band.
        alpha: of the band.
    """
    counts, losses = [*by_count], np.array([*by_count.values()]) / 1e6
    axes.plot(counts, np.median(losses, axis=1), **line)
    band = losses.min(axis=1), losses.max(axis=1)
    axes.fill_between(counts, *band, color=line["color"], alpha=alpha, linewidth=0)


def race(path: Path, curves: Mapping[str, Mapping[int, Sequence[float]]]) -> str:
    """Draw the loss of the best set so far of each entry: median and range of the repeats.

    Args:
        path: file to write.
        curves: by entry, the losses of its repeats by number of walks.
    """
    with drawing(path, 7.0, 4.8, legend_columns=2 if max(map(len, curves)) > 20 else 4) as figure:
        axes = figure.subplots()
        for i, (name, by_budget) in enumerate(curves.items()):
            look = {"color": f"C{i % 10}", "linestyle": ("-", "--", ":")[i // 10 % 3]}
            draw_repeats(axes, by_budget, {**look, "label": name}, alpha=0.1)
        axes.set(xlabel="walks", ylabel="L of the best set so far [10$^6$]", xscale="log")
        counts = max(curves.values(), key=len)
        axes.set_xticks([*counts], [*map(str, counts)])
        axes.minorticks_off()
        log_axis(axes, "y")
    return "L of the best set so far by walks: median of the repeats, and their range."


def forecasts(
    path: Path, cases: Mapping[str, Sequence[tuple[float, float]]], pairs: Sequence[Sequence[float]]
) -> str:
    """Draw what was walked by what was foretold, with the interval of each forecast.

    Args:
        path: file to write.
        cases: by trajectory, foretold and walked log ratios of L.
        pairs: log ratios of the calibration, see `foretell.interval`.
    """
    held, count = 0, 0
    with drawing(path, 9.6, 3.6) as figure:
        panels = figure.subplots(1, len(cases), sharex=True, sharey=True)
        for panel, (name, rows) in zip(panels, cases.items(), strict=True):
            for said, came in rows:
                _, low, high = interval(said, pairs)
                inside = bool(low <= came <= high)
                color, label = (
                    (style.GREEN, "interval holds") if inside else (style.ORANGE, "it does not")
                )
                held, count = held + inside, count + 1
                at = np.exp(said)
                panel.vlines(at, *np.exp([low, high]), color=color, alpha=0.35, linewidth=2.5)
                panel.plot(at, np.exp(came), "o", color=color, markersize=4, label=label)
            panel.axline((1.0, 1.0), (2.0, 2.0), color="black", linewidth=0.8)
            panel.set(title=name, xlabel="foretold L / L of the log")
            log_axis(panel, "x")
            log_axis(panel, "y")
        panels[0].set_ylabel("walked L / L of the log")
    return f"Of {count} walks on the hardware stand-in {held} came within the interval foretold."


def survival(path: Path, rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Draw the loss against the baseline and the share of walks without a fall, by disturbance.

    Args:
        path: file to write.
        rows: by disturbance, the results by set, the baseline first: `ratio` of the losses and
            share `survived`, each a value with the ends of its interval.
    """
    looks = looks_of(next(iter(rows.values())))
    baseline, at = next(iter(looks)), -np.arange(len(rows))
    with drawing(path, 7.5, 0.3 * len(rows) + 0.9) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for i, (name, look) in enumerate(looks.items()):
            y = at + 0.25 * ((len(looks) - 1) / 2 - i)
            ratio = np.array([row[name].ratio for row in rows.values()])
            survived = 100 * np.array([row[name].survived for row in rows.values()])
            for panel, (value, low, high) in zip(panels, (ratio.T, survived.T), strict=True):
                panel.plot(value, y, **look.dot, label=label_of(name))
                panel.hlines(y, low, high, color=look.color, linewidth=1.2)
        panels[0].axvline(1.0, color="black", linewidth=0.8, zorder=1)
        panels[0].set_xlabel(f"median of L / L of {baseline}")
        panels[0].set_yticks(at, list(rows))
        log_axis(panels[0], "x")
        panels[1].set(xlabel="walks without a fall [%]", xlim=(-4, 104))
    return (
        "What is in the way, a row each: the median ratio of L to the baseline's in the same scene "
        "on the same plant (left of 1 is better), and the walks without a fall (right is better). "
        "Lines are 95 % intervals from redrawing the plants."
    )


def root_locus(
    path: Path,
    delays: Sequence[float] | Float[np.ndarray, " delays"],
    loci: Mapping[str, Sequence[Sequence[tuple[float, float]]]],
) -> str:
    """Draw growth and frequency of the modes of loops, by the delay of the motors.

    Args:
        path: file to write.
        delays: [ms].
        loci: by controller, for each delay the growth [1/s] and the frequency [Hz] of the modes.
    """
    looks = zip(loci.items(), ((style.ORANGE, "s"), (style.GREEN, "o")), strict=False)
    with drawing(path, 6.0, 3.6) as figure:
        axes = figure.subplots()
        for (name, by_delay), (color, marker) in looks:
            for i, modes in enumerate(by_delay):
                size = 2.0 + 5.0 * i / (len(delays) - 1)  # larger with more delay
                look: Any = {"color": color, "marker": marker, "markersize": size, "ls": "none"}
                label = name if i == len(by_delay) - 1 else None
                growth, frequency = np.reshape(modes, (-1, 2)).T
                axes.plot(growth, frequency, alpha=0.7, label=label, **look)
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set(xlabel="growth [1/s]", ylabel="frequency [Hz]", xlim=(-40, 25), ylim=(0, 35))
    return (
        f"Modes of trunk, legs and plan with motors from {delays[0]:g} (small marks) to "
        f"{delays[-1]:g} ms late: those right of the line grow into a limit cycle."
    )
