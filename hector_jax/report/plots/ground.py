"""What the ground returns: wrenches, the nets that tell them, and what that does to gradients."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.trajectory import LEFT, Wrench
from hector_jax.grfm.nets import History
from hector_jax.report.fidelity import Drift
from hector_jax.report.plots.style import (
    BLUE,
    CURVES,
    GREEN,
    ORANGE,
    PURPLE,
    SETS,
    drawing,
    legend,
    log_axis,
    named,
    weight_label,
    widen,
)


def wrenches(
    path: Path, period: float, curves: Mapping[str, Wrench], foot: int = LEFT, seconds: float = 0.4
) -> str:
    """Commanded, predicted and measured wrench of one foot over the first steps.

    Args:
        path: file to write.
        period: [s] between samples.
        curves: `commanded`, `predicted`, `paper`, `linear`, `measured`, or some of them, one per
            period, (T, 2, 3) each; held over the period.
        foot: which.
        seconds: of the walk's beginning; two steps by default.
    """
    count = round(seconds / period)
    edges = period * np.arange(count + 1)
    labels = ["$F_x$ [N]", "$F_y$ [N]", "$F_z$ [N]", "$M_x$ [N m]", "$M_y$ [N m]", "$M_z$ [N m]"]
    order = ("measured", "commanded", "linear", "paper", "predicted")
    order = [name for name in order if name in curves]
    side = ("left", "right")[foot]
    with drawing(path, 10.0, 4.4) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        for name in order:
            both = np.concatenate([np.asarray(part)[:count, foot] for part in curves[name]], axis=1)
            for panel, values in zip(panels.flat, both.T, strict=True):
                panel.stairs(values, edges, baseline=None, label=named(name), **CURVES[name])
        for panel, label in zip(panels.flat, labels, strict=True):
            panel.axvline(seconds / 2, color="0.75", linewidth=0.8, zorder=0)
            panel.set_ylabel(label)
            widen(panel, 5.0 if "[N]" in label else 0.5)
        for panel in panels[1]:
            panel.set_xlabel("time [s]")
        legend(figure, panels[0, 0])
    return (
        f"Wrench of the ground on the {side} foot over the first two steps; "
        "the line is the switch of stance."
    )


def open_loop(path: Path, worlds: Mapping[str, Mapping[str, Drift]]) -> str:
    """How far the rigid body strays from the robot, by time ahead.

    Args:
        path: file to write.
        worlds: by the name of a world and of a phi.
    """
    with drawing(path, 7.0, 2.6 * len(worlds) + 0.3) as figure:
        panels = figure.subplots(len(worlds), 2, squeeze=False, sharex=True)
        for row, (world, found) in zip(panels, worlds.items(), strict=True):
            for name, one in found.items():
                row[0].plot(one.time, 100 * one.position, label=named(name), **CURVES[name])
                row[1].plot(one.time, np.rad2deg(one.euler), **CURVES[name])
            row[0].set(title=world, ylabel="error of the CoM [cm]", ylim=(0, None))
            row[1].set(title=world, ylabel="error of the angles [deg]", ylim=(0, None))
        for panel in panels[-1]:
            panel.set_xlabel("time ahead [s]")
        legend(figure, panels[0, 0], columns=3)
    return (
        "How far a rigid body under recorded commands strays from the robot, RMS over starts in "
        "all phases of the step. `measured` moves it by the measured wrench itself, without what "
        "the legs do."
    )


def training(path: Path, course: History) -> str:
    """Errors of the net by epoch, on the walks it learns from and on those that choose the epoch.

    Args:
        path: file to write.
        course: mean square errors in physical units.
    """
    with drawing(path, 7.0, 2.7) as figure:
        panels = figure.subplots(1, 2)
        kinds = {"force": "mean square error [N$^2$]", "moment": "mean square error [(N m)$^2$]"}
        for panel, (kind, label) in zip(panels, kinds.items(), strict=True):
            seen, held = (np.asarray(getattr(course, f"{p}_{kind}")) for p in ("train", "valid"))
            epochs = np.arange(1, len(seen) + 1)
            panel.plot(epochs, seen, **SETS["expert"], label="training walks")
            panel.plot(epochs, held, color=ORANGE, label="validation walks")
            best = int(np.argmin(held))
            panel.plot(epochs[best], held[best], "o", color=ORANGE, label="least")
            # the first epochs of a fresh net may be far off: they need not be seen whole
            top = 1.6 * np.percentile(np.concatenate([seen, held]), 90)
            panel.set(title=kind, xlabel="epoch", ylabel=label, ylim=(0.0, top))
        legend(figure, panels[0])
    return (
        "Errors of GRFM-Net by epoch, mean over the members where it is an ensemble; of each net "
        "the epoch with the least error on the validation walks is kept."
    )


class _Phi(NamedTuple):
    """How what is learned or computed from one phi is drawn."""

    color: str
    marker: str
    hatch: str | None = None  # of bars


_PHI = {
    "command": _Phi("black", "."),
    "linear": _Phi(PURPLE, "^", "//////"),
    "paper": _Phi(ORANGE, "x"),
    "net": _Phi(GREEN, "o"),
    "net without legs": _Phi(BLUE, "s", "......"),
}


def gradients(
    path: Path,
    names: Sequence[str],
    simulator: Float[np.ndarray, "phases weights"],
    models: Mapping[str, Float[np.ndarray, "phases weights"]],
) -> str:
    """Gradients of the loss in log-weights, scaled to unit length: hfs, and the model by phi.

    Args:
        path: file to write.
        names: of the weights.
        simulator: those of the hfs by start phase.
        models: those of the model likewise, by the name of a phi.
    """
    at, width = np.arange(len(names)), 0.8 / len(models)
    with drawing(path, 10.0, 4.2) as figure:
        axes = figure.subplots()

        def bars(x: np.ndarray, rows: np.ndarray, width: float, name: str, **look: Any) -> None:
            mean = rows.mean(axis=0)
            size = np.linalg.norm(mean)
            axes.bar(x, mean / size, width, label=f"{name}, {size / 1e6:.1f}e6", **look)

        bars(at, simulator, 0.9, "hfs", facecolor="0.95", edgecolor="0.3", linewidth=0.9)
        size = np.linalg.norm(simulator.mean(axis=0))
        low, high = simulator.min(axis=0) / size, simulator.max(axis=0) / size
        axes.vlines(at - 0.45, low, high, color="black", linewidth=2.0, zorder=3)
        for i, (name, rows) in enumerate(models.items()):
            x = at + width * (i - (len(models) - 1) / 2)
            look = {"color": _PHI[name].color, "hatch": _PHI[name].hatch}
            bars(x, rows, 0.8 * width, name, **look, edgecolor="white", linewidth=0.0)
        axes.axhline(0.0, color="black", linewidth=0.8)
        for edge in range(3, len(names), 3):  # Euler angles, position, and so on
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8, zorder=0)
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, [weight_label(name) for name in names])
        axes.tick_params(axis="x", length=0)
        axes.set(ylabel="dL / d log weight, unit length", xlim=(-0.6, len(names) - 0.4))
        legend(figure, axes, columns=3)
    return (
        "Gradients of L in log-weights, mean over start phases, each scaled to unit length; the "
        "lengths are in the legend. The line at the left of each wide bar spans the start phases "
        f"on the hfs; the narrow ones are, from the left, {', '.join(models)}."
    )


def ranks(
    path: Path,
    simulator: Mapping[tuple[str, str], Float[np.ndarray, " sets"]],
    models: Mapping[tuple[str, str], Mapping[str, Float[np.ndarray, " sets"]]],
    correlations: Mapping[tuple[str, str], Mapping[str, float]],
) -> str:
    """Loss of disturbed weight sets on the model against that on the hfs.

    Args:
        path: file to write.
        simulator: losses on the hfs by trajectory and factor, the rows and columns of panels.
        models: losses on the model, likewise and by the name of a phi.
        correlations: of ranks, likewise.
    """
    trajectories, factors = (list(dict.fromkeys(k[i] for k in simulator)) for i in (0, 1))
    size = (3.3 * len(trajectories) + 0.2, 3.0 * len(factors) + 0.4)
    with drawing(path, *size) as figure:
        panels = figure.subplots(len(factors), len(trajectories), squeeze=False)
        for (trajectory, factor), truth in simulator.items():
            panel = panels[factors.index(factor), trajectories.index(trajectory)]
            for name, found in models[trajectory, factor].items():
                panel.plot(
                    truth / 1e6,
                    found / 1e6,
                    _PHI[name].marker,
                    color=_PHI[name].color,
                    markerfacecolor="none",
                    markersize=3.5,
                    mew=0.8,
                    label=f"{name}: {correlations[trajectory, factor][name]:.2f}",
                )
            panel.legend(loc="upper left", handlelength=1.0, borderaxespad=0.2)
            panel.set_title(f"{trajectory}, within x/{factor}")
            log_axis(panel, "x")
            panel.set_yscale("log")
            low, high = panel.get_ylim()
            panel.set_ylim(low, high * (high / low) ** 0.6)  # room for the numbers
            log_axis(panel, "y")
        for panel in panels[-1]:
            panel.set_xlabel("L on the hfs [10$^6$]")
        for panel in panels[:, 0]:
            panel.set_ylabel("L on the model [10$^6$]")
    return "Loss of disturbed weight sets, model against hfs; the numbers are rank correlations."
