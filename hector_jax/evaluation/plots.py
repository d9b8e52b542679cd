"""The pictures of a run, and the only door to matplotlib.

Each function draws one picture to a file (the ending of its name decides the format) and returns
its caption. Weight sets keep their colour, line and marker through all pictures, so that they can
be told apart in grey too. Figures are made without pyplot: no display, no global state.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from hector_jax.evaluation.fidelity import Drift
from hector_jax.evaluation.metrics import BASELINES, Verdict, compare
from hector_jax.evaluation.robustness import DIRECTIONS, Cell
from hector_jax.grfm.training import History
from hector_jax.trajectory import LEFT, Trajectory, Wrench
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration
from hector_jax.tuning.loss import LossConfig

_STYLE = {
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.labelsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.8,
    "savefig.dpi": 160,
    "svg.hashsalt": "hector_jax",  # the same picture gives the same bytes
}

_BLUE, _ORANGE, _GREEN, _GREY, _PURPLE = "#0072b2", "#d55e00", "#007a5e", "0.55", "#7a3e9d"

_LOOK = {
    "reference": {"color": "black", "linestyle": (0, (1, 1)), "linewidth": 1.1},
    "nominal": {"color": _GREY, "linestyle": "-", "linewidth": 1.8},
    "expert": {"color": _BLUE, "linestyle": (0, (5, 1.5))},
    "without": {"color": _ORANGE, "linestyle": (0, (4, 1.2, 1, 1.2))},
    "with": {"color": _GREEN, "linestyle": "-"},
    "searched": {"color": _PURPLE, "linestyle": (0, (1.2, 1.2))},
    "without_ten": {"color": "#e8a36a", "linestyle": (0, (4, 1.2, 1, 1.2)), "linewidth": 0.9},
    "with_ten": {"color": "#63b89f", "linestyle": "-", "linewidth": 0.9},
    "with_walks": {"color": "#00402f", "linestyle": (0, (3, 1))},
    "ceiling": {"color": "#5c3a1e", "linestyle": (0, (8, 1.5, 1, 1.5))},
    "commanded": {"color": "black", "linestyle": "-", "linewidth": 0.9},
    "measured": {"color": _GREY, "linestyle": "-", "linewidth": 2.2},
    "predicted": {"color": _GREEN, "linestyle": (0, (5, 1.2))},
    "linear": {"color": _PURPLE, "linestyle": (0, (1.2, 1.2))},
    "paper": {"color": _ORANGE, "linestyle": (0, (4, 1.2, 1, 1.2))},
    "gated": {"color": _BLUE, "linestyle": (0, (5, 1.5))},
}
_LOOK |= {"raw": _LOOK["commanded"], "residual": _LOOK["with"]}
_MARKER = {"nominal": "o", "expert": "D", "without": "s", "with": "o"}
_NAMES = {
    "without": "tuned without net",
    "with": "tuned with net",
    "without_ten": "without net, ten iterations",
    "with_ten": "with net, ten iterations",
    "with_walks": "with net, then along walks",
    "searched": "searched on the simulator",
    "ceiling": "long search",
    "predicted": "predicted by the net",
    "linear": "predicted by a linear map",
    "paper": "predicted by the paper's net",
    "raw": "commanded",
    "gated": "gated linear part of the net",
    "residual": "predicted by the net",
}


@contextmanager
def _figure(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure [inch] that is written when its block ends."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        # no date and no version inside: the same picture gives the same bytes
        metadata = {
            ".png": {"Software": None},
            ".svg": {"Date": None},
            ".pdf": {"CreationDate": None},
        }
        figure.savefig(path, metadata=metadata.get(path.suffix.lower()))


def _legend(figure: Figure, axes: Axes, columns: int = 6) -> None:
    """One legend above all panels, from the labels of one of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), columns))


def _named(name: str) -> str:
    return _NAMES.get(name, name)


_SPARE = tuple(
    {"color": color, "linestyle": (0, (2.5, 1, 1, 1, 1, 1)), "linewidth": 1.1}
    for color in ("#b0186a", "#2f7fb8", "#8a8a00")
)


def _looks(names: Iterable[str]) -> dict[str, dict]:
    """How each weight set is drawn; those that are none of ours take what is spare, in turn."""
    unknown = [name for name in names if name not in _LOOK]
    spare = {name: _SPARE[i % len(_SPARE)] for i, name in enumerate(unknown)}
    return {name: _LOOK.get(name) or spare[name] for name in names}


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
    with _figure(path, 10.0, 2.7) as figure:
        panels = figure.subplots(1, 4)
        for panel, (title, part) in zip(panels, parts.items(), strict=True):
            panel.axvline(ten, color="0.5", linestyle=(0, (2, 2)), linewidth=0.9, zorder=0)
            for name, history in histories.items():
                values = np.array([float(part(i.evaluation)) for i in history]) / 1e6
                tried, kept = np.arange(len(values)), accepted[name]
                panel.plot(
                    tried[kept],
                    values[kept],
                    **_LOOK[name],
                    marker=_MARKER[name],
                    markersize=2.6,
                    label=_named(name),
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
        _legend(figure, panels[0])
    return (
        f"Loss on the model by iteration, whole and by part; the line is iteration {ten}, "
        "a cross is a refused step."
    )


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
    with _figure(path, 10.0, 6.2) as figure:
        panels = figure.subplots(3, 3, sharex=True)
        _draw_tracking(panels, walks)
        _legend(figure, panels[0, 0])
    return "Centre of mass and Euler angles of one stand-in walk of each set against the reference."


def _draw_tracking(panels: np.ndarray, walks: Mapping[str, Trajectory]) -> None:
    """Fill 3 x 3 panels."""
    first, looks = next(iter(walks.values())), _looks(walks)
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
            panel.plot(_times(walk), kept, **looks[name], label=_named(name))
        panel.plot(_times(first), value(first.reference), **_LOOK["reference"], label="reference")
        panel.set_ylabel(label)
    for panel, (label, value) in zip(panels[2], errors.items(), strict=True):
        for name, walk in walks.items():
            kept = _standing(walk, value(walk.state, walk.reference)[:, None])
            panel.plot(_times(walk), kept, **looks[name])
        panel.axhline(0.0, **_LOOK["reference"])
        panel.set(ylabel=label, xlabel="time [s]")
    for panel in panels.flat:
        _widen(panel, 0.02 if "[m]" in panel.get_ylabel() else 1.0)


def _widen(axes: Axes, least: float) -> None:
    """Keep an axis from blowing noise up: at least `least` either side of its middle."""
    low, high = axes.get_ylim()
    if high - low < 2 * least:
        axes.set_ylim((low + high) / 2 - least, (low + high) / 2 + least)


def path_from_above(path: Path, walks: Mapping[str, Trajectory]) -> str:
    """Top view of where the centre of mass went, with the footprints of the last set.

    Args:
        path: file to write.
        walks: by set, on the same plant and command.
    """
    span, width = _span(walks), 7.0
    with _figure(path, width, float(np.clip(width * span[1] / span[0], 1.4, 5.0)) + 0.9) as figure:
        axes = figure.subplots()
        _draw_path(axes, walks)
        figure.legend(loc="outside upper center", ncols=4)
    return f"Path from above; foot marks are those of the set '{list(walks)[-1]}'."


def _span(walks: Mapping[str, Trajectory]) -> np.ndarray:
    """Extent of all paths in x and y [m], with room for the feet."""
    reference = next(iter(walks.values())).reference.position
    points = np.concatenate([walk.state.position[~walk.fallen, :2] for walk in walks.values()])
    return np.ptp(np.concatenate([points, reference[:, :2]]), axis=0) + 0.35


def _draw_path(axes: Axes, walks: Mapping[str, Trajectory]) -> None:
    last, looks = list(walks.values())[-1], _looks(walks)
    reference = next(iter(walks.values())).reference.position
    stands = np.asarray(last.contact)
    landed = stands & ~np.roll(stands, 1, axis=0)
    landed[0] = stands[0]
    for name, walk in walks.items():
        kept = _standing(walk, np.asarray(walk.state.position))
        axes.plot(kept[:, 0], kept[:, 1], **looks[name], label=_named(name))
    axes.plot(*np.asarray(reference)[:, :2].T, **_LOOK["reference"], label="reference")
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


def collective(path: Path, walks: Mapping[str, Trajectory], snapshots: Path | None) -> str:
    """The paper's collective figure: snapshots, path from above, and tracking of all sets.

    Args:
        path: file to write.
        walks: by set, on the same plant and command.
        snapshots: picture of the walk, two rows of tiles; None where there is none.
    """
    width = 10.0
    image = None if snapshots is None else imread(snapshots)
    top = 0.0 if image is None else 0.97 * width * image.shape[0] / image.shape[1] + 0.1
    span = _span(walks)
    flat = span[0] > 3.0 * span[1]  # a straight line has a row of its own
    middle, bottom = (0.85 * width * span[1] / span[0] + 0.7 if flat else 0.0), 6.2
    legend = 0.55
    with _figure(path, width, top + middle + bottom + legend) as figure:
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
        _draw_path(axes, walks)
        _draw_tracking(beside.subplots(3, 3, sharex=True), walks)
        _legend(figure, axes, columns=4)
    seen = "" if image is None else "Snapshots; "
    return (
        f"{seen}path of the centre of mass from above, foot marks those of "
        f"'{_named(list(walks)[-1])}'; centre of mass and Euler angles of all sets against the "
        "reference. One stand-in plant."
    )


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
    with _figure(path, *size) as figure:
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
        panels[0, 0].set_yticks(range(len(names)), [_named(name) for name in names])
        panels[0, 0].set_ylim(len(names) - 0.5, -0.5)
        _legend(figure, panels[0, 0])
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
    looks = _looks(names)
    for row, name in enumerate(names):
        if name not in verdict.scores:
            continue
        score, color = verdict.scores[name], looks[name]["color"]
        ratio = score.L / verdict.scores[baseline].L
        fell, up = ratio[score.fallen], ratio[~score.fallen]
        panel.plot(up, np.full(len(up), row), "o", color=color, alpha=0.3, markersize=3, mew=0)
        panel.plot(fell, np.full(len(fell), row), "x", color=color, markersize=5)
        value, low, high = (1 + x / 100 for x in compare(verdict, name, baseline).change["L"])
        panel.hlines(row, low, high, color=color, linewidth=2.2, zorder=3)
        panel.plot(value, row, "|", color=color, markersize=11, mew=2.2, zorder=3)
    panel.grid(visible=False, axis="y")


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
    with _figure(path, 10.0, 3.4) as figure:
        axes = figure.subplots()
        for i, name in enumerate(tuned):
            ratio = np.asarray(sets[name]) / base
            axes.bar(
                at + 0.38 * (i - (len(tuned) - 1) / 2),
                ratio - 1.0,
                0.36,
                bottom=1.0,
                color=_LOOK[name]["color"],
                hatch="////" if name == "without" else None,
                edgecolor="white",
                linewidth=0.0,
                label=_named(name),
            )
        if "expert" in sets:
            axes.plot(
                at,
                np.asarray(sets["expert"]) / base,
                linestyle="none",
                marker=_MARKER["expert"],
                color=_BLUE,
                markerfacecolor="white",
                label="expert",
            )
        axes.axhline(1.0, color="black", linewidth=0.8)
        for edge in range(3, len(names), 3):  # Euler angles, position, and so on
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8, zorder=0)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, [_weight_label(n) for n in names], rotation=60, ha="right", va="center")
        for label in axes.get_xticklabels():
            label.set_rotation_mode("anchor")
        axes.tick_params(axis="x", length=0)
        axes.set(ylabel="weight / nominal", xlim=(-0.7, len(names) - 0.3))
        _legend(figure, axes)
    return "Tuned weights as ratios to the nominal ones (1); diamonds are the expert's."


def _weight_label(name: str) -> str:
    matrix, _, rest = name.partition("_")
    return f"{matrix} {rest.replace('_', ' ')}"


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
    with _figure(path, 10.0, 4.4) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        for name in order:
            both = np.concatenate([np.asarray(part)[:count, foot] for part in curves[name]], axis=1)
            for panel, values in zip(panels.flat, both.T, strict=True):
                panel.stairs(values, edges, baseline=None, label=_named(name), **_LOOK[name])
        for panel, label in zip(panels.flat, labels, strict=True):
            panel.axvline(seconds / 2, color="0.75", linewidth=0.8, zorder=0)
            panel.set_ylabel(label)
            _widen(panel, 5.0 if "[N]" in label else 0.5)
        for panel in panels[1]:
            panel.set_xlabel("time [s]")
        _legend(figure, panels[0, 0])
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
    with _figure(path, 7.0, 2.6 * len(worlds) + 0.3) as figure:
        panels = figure.subplots(len(worlds), 2, squeeze=False, sharex=True)
        for row, (world, found) in zip(panels, worlds.items(), strict=True):
            for name, one in found.items():
                row[0].plot(one.time, 100 * one.position, label=_named(name), **_LOOK[name])
                row[1].plot(one.time, np.rad2deg(one.euler), **_LOOK[name])
            row[0].set(title=world, ylabel="error of the CoM [cm]", ylim=(0, None))
            row[1].set(title=world, ylabel="error of the angles [deg]", ylim=(0, None))
        for panel in panels[-1]:
            panel.set_xlabel("time ahead [s]")
        _legend(figure, panels[0, 0], columns=3)
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
    with _figure(path, 7.0, 2.7) as figure:
        panels = figure.subplots(1, 2)
        kinds = {"force": "mean square error [N$^2$]", "moment": "mean square error [(N m)$^2$]"}
        for panel, (kind, label) in zip(panels, kinds.items(), strict=True):
            seen, held = (np.asarray(getattr(course, f"{p}_{kind}")) for p in ("train", "valid"))
            epochs = np.arange(1, len(seen) + 1)
            panel.plot(epochs, seen, **_LOOK["expert"], label="training walks")
            panel.plot(epochs, held, color=_ORANGE, label="validation walks")
            best = int(np.argmin(held))
            panel.plot(epochs[best], held[best], "o", color=_ORANGE, label="least")
            # the first epochs of a fresh net may be far off: they need not be seen whole
            top = 1.6 * np.percentile(np.concatenate([seen, held]), 90)
            panel.set(title=kind, xlabel="epoch", ylabel=label, ylim=(0.0, top))
        _legend(figure, panels[0])
    return (
        "Errors of GRFM-Net by epoch, mean over the members where it is an ensemble; of each net "
        "the epoch with the least error on the validation walks is kept."
    )


_PHI = {
    "command": "black",
    "linear": _PURPLE,
    "paper": _ORANGE,
    "net": _GREEN,
    "net without legs": _BLUE,
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
    with _figure(path, 10.0, 4.2) as figure:
        axes = figure.subplots()

        def bars(x: np.ndarray, rows: np.ndarray, width: float, name: str, color: str) -> None:
            mean = rows.mean(axis=0)
            size = np.linalg.norm(mean)
            axes.bar(x, mean / size, width, color=color, label=f"{name}, {size / 1e6:.1f}e6")

        bars(at, simulator, 0.9, "hfs", "0.82")
        size = np.linalg.norm(simulator.mean(axis=0))
        low, high = simulator.min(axis=0) / size, simulator.max(axis=0) / size
        axes.vlines(at - 0.45, low, high, color="black", linewidth=2.0, zorder=3)
        for i, (name, rows) in enumerate(models.items()):
            x = at + width * (i - (len(models) - 1) / 2)
            bars(x, rows, 0.8 * width, name, _PHI[name])
        axes.axhline(0.0, color="black", linewidth=0.8)
        for edge in range(3, len(names), 3):  # Euler angles, position, and so on
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8, zorder=0)
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, [_weight_label(name) for name in names])
        axes.tick_params(axis="x", length=0)
        axes.set(ylabel="dL / d log weight, unit length", xlim=(-0.6, len(names) - 0.4))
        _legend(figure, axes, columns=3)
    return (
        "Gradients of L in log-weights, mean over start phases, each scaled to unit length; the "
        "lengths are in the legend. The line at the left of each grey bar spans the start phases "
        "on the hfs."
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
    with _figure(path, *size) as figure:
        panels = figure.subplots(len(factors), len(trajectories), squeeze=False)
        for (trajectory, factor), truth in simulator.items():
            panel = panels[factors.index(factor), trajectories.index(trajectory)]
            for i, (name, found) in enumerate(models[trajectory, factor].items()):
                color = _PHI[name]
                panel.plot(truth / 1e6, found / 1e6, "o", color=color, alpha=0.6, markersize=2.5)
                panel.text(
                    0.03,
                    0.97 - 0.075 * i,
                    f"{name}: {correlations[trajectory, factor][name]:.2f}",
                    color=color,
                    transform=panel.transAxes,
                    va="top",
                )
            panel.set(xscale="log", yscale="log", title=f"{trajectory}, within x/{factor}")
            low, high = panel.get_ylim()
            panel.set_ylim(low, high * (high / low) ** 0.6)  # room for the numbers
            for axis in (panel.xaxis, panel.yaxis):
                low, high = axis.get_view_interval()
                digits = "23456789" if high < 6 * low else "25"
                axis.set_major_formatter(lambda y, _: f"{y:g}")
                axis.set_minor_formatter(
                    lambda y, _, digits=digits: f"{y:g}" if f"{y:.0e}"[0] in digits else ""
                )
        for panel in panels[-1]:
            panel.set_xlabel("L on the hfs [10$^6$]")
        for panel in panels[:, 0]:
            panel.set_ylabel("L on the model [10$^6$]")
    return "Loss of disturbed weight sets, model against hfs; the numbers are rank correlations."


def _plain_log(axis: Axis) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5, written out."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def survival(path: Path, curves: Mapping[str, Mapping[float, Mapping[str, Cell]]]) -> str:
    """Share of walks without a fall and loss against the baseline, by the size of a disturbance.

    Args:
        path: file to write.
        curves: `push` by force and `friction` by the floor's friction, cells by set, the baseline
            first.
    """
    labels = {"push": "push [N]", "friction": "friction that the floor steps to"}
    with _figure(path, 7.0, 2.5 * len(curves) + 0.3) as figure:
        panels = figure.subplots(len(curves), 2, squeeze=False, sharex="row")
        for row, (kind, found) in zip(panels, curves.items(), strict=True):
            sizes = sorted(found)
            names = list(found[sizes[0]])
            for name, look in _looks(names).items():
                cells = [found[size][name] for size in sizes]
                stood = np.array([cell.survived for cell in cells])
                ratio = np.array([cell.ratio for cell in cells])
                for panel, values in zip(row, (100 * stood, ratio), strict=True):
                    marker = {"marker": _MARKER.get(name, "^"), "markersize": 3.5}
                    panel.plot(sizes, values[:, 0], **look, **marker, label=_named(name))
                    panel.fill_between(
                        sizes, values[:, 1], values[:, 2], color=look["color"], alpha=0.12, lw=0
                    )
            row[0].set(ylabel="walks without a fall [%]", ylim=(-4, 104), xlabel=labels[kind])
            row[1].set(ylabel=f"median L / {names[0]}", yscale="log", xlabel=labels[kind])
            _plain_log(row[1].yaxis)
            row[0].set_xticks(sizes, [f"{size:g}" for size in sizes])
            if kind == "friction":  # the harder the further to the right
                row[0].invert_xaxis()
        _legend(figure, panels[0, 0])
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
    with _figure(path, 7.0, 0.3 * len(rows) + 0.9) as figure:
        panels = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
        looks = _looks([baseline, *others])
        for i, (name, look) in enumerate(looks.items()):
            y = at + 0.2 * ((len(looks) - 1) / 2 - i)
            dot = {
                "linestyle": "none",
                "marker": _MARKER.get(name, "^"),
                "color": look["color"],
                "label": _named(name),
            }
            stood = np.array([row[name].survived for row in rows.values()])
            ratio = np.array([row[name].ratio for row in rows.values()])
            if name != baseline:
                panels[0].hlines(y, ratio[:, 1], ratio[:, 2], color=look["color"], linewidth=1.0)
                panels[0].plot(ratio[:, 0], y, **dot)
            panels[1].plot(100 * stood[:, 0], y, **dot)
        panels[0].axvline(1.0, **_LOOK["nominal"])
        panels[0].set(xscale="log", xlabel=f"median L / {baseline}")
        _plain_log(panels[0].xaxis)
        panels[0].set_yticks(at, list(rows))
        panels[1].set(xlabel="walks without a fall [%]", xlim=(-5, 105))
        _legend(figure, panels[1])
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
    with _figure(path, 4.6, 4.4) as figure:
        axes = figure.subplots(subplot_kw={"projection": "polar", "theta_offset": np.pi / 2})
        for name, look in _looks(endured).items():
            closed = np.append(endured[name], endured[name][0])
            marker = {"marker": _MARKER.get(name, "^"), "markersize": 3.5}
            axes.plot(angles, closed, **look, **marker, label=_named(name))
        axes.set_rmin(0.0)
        axes.set_rlabel_position(22.5)
        names = {0: "ahead", 90: "left", 180: "back", 270: "right"}
        axes.set_xticks(angles[:-1], [names.get(int(d), "") for d in DIRECTIONS])
        _legend(figure, axes, columns=3)
    return (
        "Largest push [N] of 0.1 s that is survived together with all smaller ones, by where it "
        "pushes to; mean over plants and gait phases."
    )


_ARMS = {
    "fixed": ("weights stay", _LOOK["nominal"]),
    "until": ("tuned until the change", _LOOK["without"]),
    "carried": ("tuned all the way", _LOOK["with"]),
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
    with _figure(path, *size) as figure:
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
        _legend(figure, panels[0, 0], columns=len(columns))
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
    colors = (_BLUE, _ORANGE, _GREEN, _PURPLE, "0.35", "black")
    marks = "osD^vP"
    with _figure(path, 3.3 * len(courses) + 0.2, 3.4) as figure:
        panels = figure.subplots(1, len(courses), squeeze=False)[0]
        for panel, (trajectory, ratios) in zip(panels, courses.items(), strict=True):
            panel.axvline(change, color="0.5", linestyle=(0, (2, 2)), linewidth=0.9, zorder=0)
            single = [i for i, name in enumerate(names) if not name.endswith("_right")]
            moved = np.abs(np.log(ratios[:, single])).max(axis=0)
            for i, color, mark in zip(np.argsort(-moved)[:most], colors, marks, strict=False):
                label = _weight_label(names[single[i]].removesuffix("_left"))
                values = ratios[:, single[i]]
                panel.plot(
                    times[: len(values)], values, color=color, marker=mark, ms=2.6, label=label
                )
            panel.set(title=trajectory, xlabel="time [s]", yscale="log")
            panel.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
            panel.yaxis.set_minor_formatter(lambda y, _: f"{y:g}")
            panel.legend(
                ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.18), columnspacing=1.2
            )
        panels[0].set_ylabel("weight / its start")
    return f"The {most} weights that moved most; both feet share one R."


_BASES = ("nominal", "expert")
_TUNED = ((_ORANGE, "s"), (_GREEN, "^"), (_PURPLE, "v"), ("black", "P"), ("#8a6d00", "X"))


def _dots(names: Iterable[str]) -> dict[str, dict[str, str]]:
    """Colour and marker of weight sets of which only the baselines are known everywhere."""
    others = cycle(_TUNED)
    pairs = {n: (_LOOK[n]["color"], _MARKER[n]) if n in _BASES else next(others) for n in names}
    return {name: {"color": color, "marker": marker} for name, (color, marker) in pairs.items()}


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
    with _figure(path, 7.5, 3.2) as figure:
        axes, looks = figure.subplots(), _dots(sets)
        for i, (name, values) in enumerate(sets.items()):
            x = at + width * (i - (len(sets) - 1) / 2)
            axes.plot(x, values, linestyle="none", markersize=6, label=name, **looks[name])
        axes.axhline(1.0, color="black", linewidth=0.8)
        for edge in at[1:]:
            axes.axvline(edge - 0.5, color="0.8", linewidth=0.8)
        axes.grid(visible=False, axis="x")
        axes.set_xticks(at, columns)
        axes.tick_params(axis="x", length=0)
        _log_axis(axes.yaxis, axes.set_yscale)
        axes.set(ylabel="L / nominal", xlim=(-0.5, len(columns) - 0.5))
        _legend(figure, axes)
    return "Loss on the hfs as a ratio to that of the nominal weights (1)."


def _log_axis(axis: Axis, set_scale: Callable[[str], None]) -> None:
    """A logarithmic axis with plain numbers, and few where it spans much."""
    set_scale("log")
    low, high = axis.get_view_interval()
    digits = "23456789" if high < 3 * low else "25" if high < 30 * low else ""
    axis.set_major_formatter(lambda y, _: f"{y:g}")
    axis.set_minor_formatter(lambda y, _: f"{y:g}" if f"{y:.0e}"[0] in digits else "")


def by_plant(path: Path, sets: Mapping[str, Float[np.ndarray, " plants"]]) -> str:
    """Losses of weight sets on many plants, each set's in rising order.

    Args:
        path: file to write.
        sets: by name, a loss per plant.
    """
    with _figure(path, 6.0, 3.4) as figure:
        axes, looks = figure.subplots(), _dots(sets)
        for name, values in sets.items():
            share = 100 * (np.arange(len(values)) + 0.5) / len(values)
            axes.plot(share, np.sort(values) / 1e6, label=name, **looks[name])
        _log_axis(axes.yaxis, axes.set_yscale)
        axes.set(xlabel="plants [%], by their loss", ylabel="L [10$^6$]", xlim=(0, 100))
        _legend(figure, axes)
    return "Loss on each plant, in rising order for each set: the right end is the tail."


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
    with _figure(path, 4.0 * len(worlds), 3.6) as figure:
        panels = figure.subplots(1, len(worlds), squeeze=False)[0]
        for panel, (world, values) in zip(panels, worlds.items(), strict=True):
            known = np.isfinite(values).all(axis=1)
            panel.plot(*values[known].T / 1e6, "o-", color=_GREEN, label="tuned")
            for price, (x, y) in zip(prices[known], values[known] / 1e6, strict=True):
                panel.annotate(
                    f"x{price:.2g}", (x, y), (4, 4), textcoords="offset points", fontsize=7
                )
            if world == list(worlds)[-1]:
                for name, look in _dots(beside).items():
                    x, y = beside[name]
                    panel.plot(x / 1e6, y / 1e6, linestyle="none", label=name, **look)
            _log_axis(panel.xaxis, panel.set_xscale)
            panel.set(title=world, xlabel="tracking [10$^6$]")
        panels[0].set_ylabel(r"$L_\mathrm{ctrl}$ [10$^6$]")
        _legend(figure, panels[-1])
    return "Each point is a tuning, its tracking priced as the label says; left and down is better."


def starts(path: Path, curves: Float[np.ndarray, "starts iterations"]) -> str:
    """Loss by iteration from several starts, and where they end.

    Args:
        path: file to write.
        curves: losses that were accepted, NaN elsewhere; the first row starts at nominal.
    """
    with _figure(path, 7.5, 3.4) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True)
        ends = []
        for i, row in enumerate(curves):
            kept = np.flatnonzero(np.isfinite(row))
            look = {"color": "0.7", "linewidth": 0.8} if i else _LOOK["with"] | {"zorder": 3}
            label = {0: "from nominal", 1: "from elsewhere"}.get(i)
            left.plot(kept, row[kept] / 1e6, label=label, **look)
            ends.append(row[kept[-1]] / 1e6)
        order = np.sort(ends)
        share = 100 * (np.arange(len(ends)) + 0.5) / len(ends)
        right.plot(share, order, "o", color="0.5", markersize=3)
        right.plot(share[np.searchsorted(order, ends[0])], ends[0], "o", color=_GREEN)
        _log_axis(left.yaxis, left.set_yscale)
        left.set(xlabel="iteration", ylabel="L on the model [10$^6$]", title="on the way")
        left.xaxis.get_major_locator().set_params(integer=True)
        right.set(xlabel="starts [%]", title="at the end", xlim=(0, 100))
        _legend(figure, left)
    return "Loss on the model by iteration from each start, and the losses at the end in order."


_RIVAL_LOOK = {
    "without": _LOOK["without"],
    "with": _LOOK["with"] | {"linewidth": 1.8},
    "adam": {"color": "#63b89f", "linestyle": (0, (3, 1.2))},
    "differences": {"color": "black", "linestyle": (0, (5, 1.5)), "linewidth": 1.1},
    "cma-es": _LOOK["searched"],
    "bayes": {"color": _BLUE, "linestyle": (0, (5, 1.5))},
    "bayes near": {"color": _BLUE, "linestyle": "-"},
    "random": {"color": _GREY, "linestyle": "-"},
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
    """Lowest loss so far of each way of tuning: median over its repeats, and their range.

    Args:
        path: file to write.
        curves: by method, abscissa and loss of each repeat.
        abscissa: what the losses are drawn against.
    """
    with _figure(path, 7.0, 4.4) as figure:
        axes = figure.subplots()
        for name, repeats in curves.items():
            count = min(len(losses) for _, losses in repeats)
            x = np.median([at[:count] for at, _ in repeats], axis=0)
            losses = np.array([losses[:count] for _, losses in repeats]) / 1e6
            look = _RIVAL_LOOK[name]
            if len(losses) > 1:
                low, high = losses.min(axis=0), losses.max(axis=0)
                axes.fill_between(x, low, high, step="post", color=look["color"], alpha=0.1, lw=0)
            middle = np.median(losses, axis=0)
            axes.step(x, middle, where="post", **look, label=RIVALS[name])
            axes.plot(x[-1], middle[-1], "o", color=look["color"], markersize=3)
        axes.set(yscale="log", xlabel=abscissa, ylabel="lowest L on the simulator [10$^6$]")
        _plain_log(axes.yaxis)
        axes.yaxis.set_minor_locator(NullLocator())
        _legend(figure, axes, columns=3)
    return (
        "Lowest loss so far on the high-fidelity simulator: median of the repeats, and their range."
    )
