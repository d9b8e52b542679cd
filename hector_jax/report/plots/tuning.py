"""Pictures of a tuning: losses by iteration, and weights."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from hector_jax.report.plots import style
from hector_jax.report.plots.style import SETS, drawing, log_axis, looks_of, named
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration
from hector_jax.tuning.loss import Loss


def losses(path: Path, loss: Loss, histories: Mapping[str, Sequence[Iteration]]) -> str:
    """Draw the loss on the model by iteration, whole and by part.

    Args:
        path: file to write.
        loss: terms, which are multiplied by their weights.
        histories: of the tunings, by weight set: `without` and `with`.
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
            panel.axvline(
                PAPER_ITERATIONS, color="0.5", linestyle=(0, (2, 2)), linewidth=0.9, zorder=0
            )
            for name, look in looks_of(histories).items():
                values = np.array([float(part(i.evaluation)) for i in histories[name]]) / 1e6
                good, bad = np.flatnonzero(accepted[name]), np.flatnonzero(~accepted[name])
                # a marker at each iteration would hide how the line is dashed
                marks = {"marker": look.marker, "markersize": 3.2, "markevery": 10}
                panel.plot(good, values[good], **look.line, **marks, label=named(name))
                if title == "$L$":
                    top = 1.1 * values[good].max()  # a rejected step need not have a finite loss
                    panel.plot(bad, np.where(values < top, values, top)[bad], **cross)
            panel.set(title=title, xlabel="iteration", ylim=(0, 1.12 * panel.get_ylim()[1]))
            panel.xaxis.get_major_locator().set_params(integer=True)
        panels[0].set_ylabel("loss on the model [10$^6$]")
        if not all(flags.all() for flags in accepted.values()):
            panels[0].plot([], [], **cross, label="refused step")
    return (
        "Loss on the model by iteration, whole and by part; the line is iteration "
        f"{PAPER_ITERATIONS}, "
        "a cross is a refused step; every tenth accepted one has a marker."
    )


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
    tuned = [name for name in ("without", "with") if name in sets]
    with drawing(path, 10.0, 3.4) as figure:
        axes = figure.subplots()
        for i, name in enumerate(tuned):
            x = np.arange(len(names)) + 0.38 * (i - (len(tuned) - 1) / 2)
            look = {"color": SETS[name]["color"], "hatch": "////" if name == "without" else None}
            look |= {"edgecolor": "white", "linewidth": 0.0}
            axes.bar(x, ratio[name] - 1.0, 0.36, bottom=1.0, **look, label=named(name))
        if "expert" in sets:
            look = looks_of(["expert"])["expert"].dot
            axes.plot(ratio["expert"], **look, markerfacecolor="white", label="expert")
        axes.axhline(1.0, color="black", linewidth=0.8)
        log_axis(axes, "y")
        labels = {"rotation": 60, "ha": "right", "va": "center", "rotation_mode": "anchor"}
        style.category_axis(axes, [style.weight_label(name) for name in names], 3, **labels)
        axes.set_ylabel("weight / nominal")
    return "Tuned weights as ratios to the nominal ones (1); diamonds are the expert's."
