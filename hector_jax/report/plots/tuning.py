"""Pictures of a tuning: losses by iteration, weights, and the loss on the stand-in's plants."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from hector_jax.report.plots import style
from hector_jax.report.plots.style import SETS, drawing, label_of, log_axis, looks_of
from hector_jax.report.report import caption
from hector_jax.runs.metrics import BASELINES, Verdict, compare
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration
from hector_jax.tuning.loss import Loss


def losses(
    path: Path,
    loss: Loss,
    histories: Mapping[str, Sequence[Iteration]],
    *,
    ten: int = PAPER_ITERATIONS,
) -> str:
    """Draw the loss on the model by iteration, whole and by part.

    Args:
        path: file to write.
        loss: terms, which are multiplied by their weights.
        histories: of the tunings, by weight set: `without` and `with`.
        ten: the iteration to mark.
    """
    parts = {"$L$": lambda evaluation: evaluation.loss}
    for i, term in enumerate(loss, 1):
        alpha = "" if term.weight == 1.0 else rf"\alpha_{i} "
        title = rf"${alpha}L_\mathrm{{{term.name.removeprefix('L_')}}}$"
        parts[title] = lambda evaluation, term=term: term.weight * evaluation.terms[term.name]
    accepted = {n: np.array([i.accepted for i in history]) for n, history in histories.items()}
    cross = {"linestyle": "none", "marker": "x", "color": "black", "markersize": 4.5}
    with drawing(path, 2.5 * len(parts), 2.7) as figure:
        panels = figure.subplots(1, len(parts))
        for panel, (title, part) in zip(panels, parts.items(), strict=True):
            panel.axvline(ten, **style.MARK)
            for name, look in looks_of(histories).items():
                values = np.array([float(part(i.evaluation)) for i in histories[name]]) / 1e6
                good, bad = np.flatnonzero(accepted[name]), np.flatnonzero(~accepted[name])
                # a marker at each iteration would hide how the line is dashed
                marks = {"marker": look.marker, "markersize": 3.2, "markevery": 10}
                panel.plot(good, values[good], **look.line, **marks, label=label_of(name))
                if title == "$L$":
                    top = 1.1 * values[good].max()  # a rejected step need not have a finite loss
                    panel.plot(bad, np.where(values < top, values, top)[bad], **cross)
            panel.set(title=title, xlabel="iteration", ylim=(0, 1.12 * panel.get_ylim()[1]))
            panel.xaxis.get_major_locator().set_params(integer=True)
        panels[0].set_ylabel("loss on the model [10$^6$]")
        if not all(flags.all() for flags in accepted.values()):
            panels[0].plot([], [], **cross, label="refused step")
    return caption("losses", ten=ten)


def weights(
    path: Path, names: Sequence[str], sets: Mapping[str, Float[np.ndarray, " weights"]]
) -> str:
    """Draw tuned weights as ratios to the nominal ones.

    Args:
        path: file to write.
        names: of the weights, such as `WEIGHT_NAMES`.
        sets: `nominal`, `expert` and the tuned `without`, `with`, flat in the order of `names`.
    """
    ratio = {
        name: np.asarray(values) / np.asarray(sets["nominal"]) for name, values in sets.items()
    }
    bars = [name for name in ("without", "with") if name in sets]
    with drawing(path, 10.0, 3.4) as figure:
        axes = figure.subplots()
        for i, name in enumerate(bars):
            x = np.arange(len(names)) + 0.38 * (i - (len(bars) - 1) / 2)
            look = {"color": SETS[name]["color"], "hatch": "////" if name == "without" else None}
            look |= {"edgecolor": "white", "linewidth": 0.0}
            axes.bar(x, ratio[name] - 1.0, 0.36, bottom=1.0, **look, label=label_of(name))
        if "expert" in sets:
            look = looks_of(["expert"])["expert"].dot
            axes.plot(ratio["expert"], **look, markerfacecolor="white", label="expert")
        axes.axhline(1.0, color="black", linewidth=0.8)
        log_axis(axes, "y")
        labels = {"rotation": 60, "ha": "right", "va": "center", "rotation_mode": "anchor"}
        style.category_axis(axes, [style.weight_label(name) for name in names], 3, **labels)
        axes.set_ylabel("weight / nominal")
    return caption("weights")


def changes(
    path: Path, verdicts: Mapping[str, Verdict], paper: Mapping[tuple[str, str, str], float]
) -> str:
    """Draw the loss of every weight set against nominal and expert on every plant.

    Args:
        path: file to write.
        verdicts: by trajectory.
        paper: the paper's change [%] by trajectory, set and baseline.
    """
    every = dict.fromkeys(name for verdict in verdicts.values() for name in verdict.scores)
    names = [name for name in every if name not in BASELINES]
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
        if len(ratio):  # an interval that falls widen shall not squeeze the axis
            high = min(high, 1.1 * max(*ratio, value))
        panel.hlines(row, low, high, color=color, linewidth=2.2, zorder=3)
        panel.plot(value, row, "|", color=color, markersize=11, mew=2.2, zorder=3)
    panel.grid(visible=False, axis="y")
