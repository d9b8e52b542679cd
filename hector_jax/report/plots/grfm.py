"""Pictures of GRFM-Net: the wrenches that it predicts, its training, and open-loop prediction."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hector_jax.core.trajectory import Wrench
from hector_jax.grfm.nets import History
from hector_jax.report.fidelity import Drift
from hector_jax.report.plots import style
from hector_jax.report.plots.style import CURVES, ORANGE, SETS, drawing, looks_of, named


def wrenches(
    path: Path, period: float, curves: Mapping[str, Wrench], *, seconds: float = 0.4
) -> str:
    """Draw the commanded, predicted and measured wrench of the left foot over the first steps.

    Args:
        path: file to write.
        period: [s] between samples.
        curves: `commanded`, `predicted`, `paper`, `linear`, `measured`, or some of them, one per
            period, (T, 2, 3) each; held over the period.
        seconds: of the walk's beginning; two steps by default.
    """
    count = round(seconds / period)
    labels = ["$F_x$ [N]", "$F_y$ [N]", "$F_z$ [N]", "$M_x$ [N m]", "$M_y$ [N m]", "$M_z$ [N m]"]
    order = ("measured", "commanded", "linear", "paper", "predicted")
    with drawing(path, 10.0, 4.4) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        for name in (name for name in order if name in curves):
            both = np.concatenate([np.asarray(part)[:count, 0] for part in curves[name]], axis=1)
            look = {"baseline": None, "label": named(name), **CURVES[name]}
            for panel, values in zip(panels.flat, both.T, strict=True):
                panel.stairs(values, period * np.arange(count + 1), **look)
        for panel, label in zip(panels.flat, labels, strict=True):
            panel.axvline(seconds / 2, color="0.75", linewidth=0.8, zorder=0)
            panel.set_ylabel(label)
            style.widen(panel, 5.0 if "[N]" in label else 0.5)
        style.set_all(panels[-1], xlabel="time [s]")
    return (
        "Wrench of the ground on the left foot over the first two steps; "
        "the line is the switch of stance."
    )


def open_loop(path: Path, worlds: Mapping[str, Mapping[str, Drift]]) -> str:
    """Draw how far the rigid body strays from the robot, by time ahead.

    Args:
        path: file to write.
        worlds: by the name of a world and of a phi.
    """
    with drawing(path, 7.0, 2.6 * len(worlds) + 0.3, legend_columns=3) as figure:
        panels = figure.subplots(len(worlds), 2, squeeze=False, sharex=True)
        for row, (world, drifts) in zip(panels, worlds.items(), strict=True):
            for name, look in looks_of(drifts, CURVES).items():
                time, position, euler = drifts[name]
                row[0].plot(time, 100 * position, label=named(name), **look.line)
                row[1].plot(time, np.rad2deg(euler), **look.line)
            row[0].set(title=world, ylabel="error of the CoM [cm]", ylim=(0, None))
            row[1].set(title=world, ylabel="error of the angles [deg]", ylim=(0, None))
        style.set_all(panels[-1], xlabel="time ahead [s]")
    return (
        "How far a rigid body under recorded commands strays from the robot, RMS over starts in "
        "all phases of the step. `measured` moves it by the measured wrench itself, without what "
        "the legs do."
    )


def training(path: Path, history: History) -> str:
    """Draw the errors of the net by epoch, on the training and on the validation walks.

    Args:
        path: file to write.
        history: mean square errors in physical units.
    """
    kinds = {"force": "mean square error [N$^2$]", "moment": "mean square error [(N m)$^2$]"}
    with drawing(path, 7.0, 2.7) as figure:
        for panel, (kind, label) in zip(figure.subplots(1, 2), kinds.items(), strict=True):
            train, valid = (np.asarray(getattr(history, f"{p}_{kind}")) for p in ("train", "valid"))
            epochs, best = np.arange(1, len(train) + 1), int(np.argmin(valid))
            panel.plot(epochs, train, **SETS["expert"], label="training walks")
            panel.plot(epochs, valid, color=ORANGE, label="validation walks")
            panel.plot(epochs[best], valid[best], "o", color=ORANGE, label="least")
            # the first epochs of a fresh net may be far off: they need not be seen whole
            top = 1.6 * np.percentile(np.concatenate([train, valid]), 90)
            panel.set(title=kind, xlabel="epoch", ylabel=label, ylim=(0.0, top))
    return (
        "Errors of GRFM-Net by epoch, mean over the members where it is an ensemble; of each net "
        "the epoch with the least error on the validation walks is kept."
    )
