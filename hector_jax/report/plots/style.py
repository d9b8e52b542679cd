"""How all pictures look: figure and legend, axes, and what each weight set is drawn with."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

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
    "savefig.dpi": "figure",
    "svg.hashsalt": "hector_jax",  # the same picture gives the same bytes
}

# from dark to light in grey: green, purple, blue, grey, orange
GREEN, PURPLE, BLUE, GREY, ORANGE = "#00563f", "#7a3e9d", "#1480c4", "0.55", "#e07c24"

SETS = {
    "nominal": {"color": "0.7", "linestyle": "-", "linewidth": 2.2},
    "expert": {"color": BLUE, "linestyle": (0, (5, 1.5))},
    "without": {"color": ORANGE, "linestyle": (0, (4, 1.2, 1, 1.2))},
    "with": {"color": GREEN, "linestyle": "-"},
    "searched": {"color": "#a566c7", "linestyle": (0, (1.2, 1.2))},
    "without_ten": {"color": "#ecb27c", "linestyle": (0, (4, 1.2, 1, 1.2)), "linewidth": 0.9},
    "with_ten": {"color": "#63b89f", "linestyle": "-", "linewidth": 0.9},
    "with_walks": {"color": "#00805f", "linestyle": (0, (3, 1))},
    "shared_mean": {"color": "#b0186a", "linestyle": (0, (8, 1.5))},
    "shared_worst": {"color": "#d670a5", "linestyle": (0, (8, 1.5, 1, 1.5, 1, 1.5))},
    "ceiling": {"color": "#5c3a1e", "linestyle": (0, (8, 1.5, 1, 1.5))},
}
"""Lines of the weight sets that we know by name; `looks_of` has those of any."""

CURVES = {
    "reference": {"color": "black", "linestyle": (0, (1, 1)), "linewidth": 1.1},
    "commanded": {"color": "black", "linestyle": "-", "linewidth": 0.9},
    "measured": {"color": GREY, "linestyle": "-", "linewidth": 2.2},
    "predicted": {"color": GREEN, "linestyle": (0, (5, 1.2))},
    "linear": {"color": PURPLE, "linestyle": (0, (1.2, 0.7)), "linewidth": 1.9},
    "paper": {"color": ORANGE, "linestyle": (0, (4, 1.2, 1, 1.2))},
    "gated": {"color": BLUE, "linestyle": (0, (5, 1.5))},
}
"""Lines of what is no weight set."""
CURVES |= {"raw": CURVES["commanded"], "residual": SETS["with"]}

_MARKER = {
    "nominal": "v",
    "expert": "D",
    "without": "s",
    "with": "o",
    "ceiling": "*",
    "shared_mean": "<",
    "shared_worst": ">",
}
_SPARE = tuple(
    ({"color": color, "linestyle": (0, (2.5, 1, 1, 1, 1, 1)), "linewidth": 1.1}, marker)
    for color, marker in (
        ("#b0186a", "s"),
        ("#6cb0dc", "^"),
        ("#8a8a00", "h"),
        ("black", "P"),
        ("#c07a3a", "X"),
    )
)
_NAMES = {
    "without": "without (tuned, no net)",
    "with": "with (tuned, net)",
    "ceiling": "ceiling (long search)",
    "predicted": "predicted by the net",
    "linear": "predicted by a linear map",
    "paper": "predicted by the paper's net",
    "raw": "commanded",
    "gated": "gated linear part of the net",
    "residual": "predicted by the net",
}


class Look(NamedTuple):
    """How a weight set is drawn."""

    line: dict[str, Any]  # colour, style and, where it is not the usual one, width
    marker: str

    @property
    def color(self) -> str:
        """Of line and marker."""
        return self.line["color"]

    @property
    def dot(self) -> dict[str, str]:
        """The marker in its colour, for sets drawn as points."""
        return {"linestyle": "none", "color": self.color, "marker": self.marker}


def looks_of(names: Iterable[str]) -> dict[str, Look]:
    """How each weight set is drawn; those that are none of ours take what is spare, in turn."""
    names = list(names)
    unknown = [name for name in names if name not in SETS]
    spare = {name: Look(*_SPARE[i % len(_SPARE)]) for i, name in enumerate(unknown)}
    return {name: spare.get(name) or Look(SETS[name], _MARKER.get(name, "^")) for name in names}


def named(name: str) -> str:
    """What a legend calls a weight set, by its name in the tables, or a curve."""
    return _NAMES.get(name, name)


@contextmanager
def drawing(path: Path, width: float, height: float, dpi: float = 160) -> Iterator[Figure]:
    """A figure [inch] that is written when its block ends."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
        yield figure
        # no date and no version inside: the same picture gives the same bytes
        metadata = {
            ".png": {"Software": None},
            ".svg": {"Date": None},
            ".pdf": {"CreationDate": None},
        }
        figure.savefig(path, metadata=metadata.get(path.suffix.lower()))


def legend(figure: Figure, axes: Axes, columns: int = 6) -> None:
    """One legend above all panels, from the labels of one of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), columns))


def widen(axes: Axes, least: float) -> None:
    """Keep an axis from blowing noise up: at least `least` either side of its middle."""
    low, high = axes.get_ylim()
    if high - low < 2 * least:
        axes.set_ylim((low + high) / 2 - least, (low + high) / 2 + least)


def weight_label(name: str) -> str:
    """A weight's name as a tick's label."""
    matrix, _, rest = name.partition("_")
    return f"{matrix} {rest.replace('_', ' ')}"


def log_axis(axes: Axes, which: str) -> None:
    """Make the axis `which` (x or y) logarithmic, with a few plain numbers whatever it spans."""
    axes.set(**{f"{which}scale": "log"})
    axis = getattr(axes, f"{which}axis")
    low, high = axis.get_view_interval()
    for span, digits in (
        (2, np.arange(1, 10, 0.5)),
        (4, (1, 1.5, *range(2, 10))),
        (30, (1, 1.5, 2, 3, 5, 7)),
        (1e3, (1, 2, 5)),
        (np.inf, (1,)),
    ):
        if high < span * low:
            axis.set_major_locator(LogLocator(subs=digits))
            break
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())
