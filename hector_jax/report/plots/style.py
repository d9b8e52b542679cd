"""Style of all pictures: figure and legend, axes, and line and marker of each weight set."""

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from hector_jax.core.files import write_file

T = TypeVar("T")

# from dark to light in greyscale
GREEN, PURPLE, BLUE, GREY, ORANGE = "#00563f", "#7a3e9d", "#1480c4", "0.55", "#e07c24"

SETS = {
    "nominal": {"color": "0.7", "linestyle": "-", "linewidth": 2.2},
    "expert": {"color": BLUE, "linestyle": (0, (5, 1.5))},
    "without": {"color": ORANGE, "linestyle": (0, (4, 1.2, 1, 1.2))},
    "with": {"color": GREEN, "linestyle": "-"},
    "best": {"color": "#1f2f8f", "linestyle": "-"},
    "shipped": {"color": "#5a1f8f", "linestyle": (0, (5, 1, 1, 1))},
}
"""Lines of the package's weight sets; `looks_of` returns a look for any set."""

CURVES = {
    "reference": {"color": "black", "linestyle": (0, (1, 1)), "linewidth": 1.1},
    "commanded": {"color": "black", "linestyle": "-", "linewidth": 0.9},
    "measured": {"color": GREY, "linestyle": "-", "linewidth": 2.2},
    "predicted": {"color": GREEN, "linestyle": (0, (5, 1.2))},
    "linear": {"color": PURPLE, "linestyle": (0, (1.2, 0.7)), "linewidth": 1.9},
    "paper": {"color": ORANGE, "linestyle": (0, (4, 1.2, 1, 1.2))},
    "gated": {"color": BLUE, "linestyle": (0, (5, 1.5))},
}
"""Lines of references and wrenches."""
CURVES |= {"raw": CURVES["commanded"], "residual": SETS["with"]}

_MARKER = {"nominal": "v", "expert": "D", "without": "s", "with": "o", "best": "p", "shipped": "*"}
_SPARE_STYLE = {"linestyle": (0, (2.5, 1, 1, 1, 1, 1)), "linewidth": 1.1}
_SPARE = (("#b8447a", "s"), ("#6cb0dc", "^"), ("#8a8a00", "h"), ("black", "P"), ("#c07a3a", "X"))
_NAMES = {
    "without": "without (tuned, no net)",
    "with": "with (tuned, net)",
    "best": "best (tuned)",
    "shipped": "shipped (tuned)",
    "predicted": "predicted by the net",
    "linear": "predicted by a linear map",
    "paper": "predicted by the paper's net",
    "raw": "commanded",
    "gated": "gated linear part of the net",
    "residual": "predicted by the net",
}


class Look(NamedTuple):
    """Line and marker of a weight set or a curve."""

    line: dict[str, Any]  # arguments of plot: colour, style and, unless it is the default, width
    marker: str

    @property
    def color(self) -> str:
        """Colour of line and marker."""
        return self.line["color"]

    @property
    def dot(self) -> dict[str, Any]:
        """Arguments of plot for sets drawn as points."""
        return {"linestyle": "none", "color": self.color, "marker": self.marker}


def looks_of(names: Iterable[str], table: Mapping[str, Any] = SETS) -> dict[str, Look]:
    """Return the look of each weight set (or curve, from `CURVES`); others take spare looks."""
    looks, spare = {}, cycle(_SPARE)
    for name in names:
        if name in table:
            looks[name] = Look(table[name], _MARKER.get(name, "^"))
        else:
            color, marker = next(spare)
            looks[name] = Look({"color": color, **_SPARE_STYLE}, marker)
    return looks


def label_of(name: str) -> str:
    """Return the legend text of a weight set, by its name in the tables, or of a curve."""
    return _NAMES.get(name, name)


def rgb_of(titles: Iterable[str]) -> list[tuple[int, int, int]]:
    """Return the colours, 0 to 255, of weight sets by their names or titles (of `titled`)."""
    known = {label_of(name): name for name in SETS}
    names = [title.partition(": ")[2] or title for title in titles]
    looks = looks_of(known.get(name, name) for name in names)
    colours = [to_rgb(looks[known.get(name, name)].color) for name in names]
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in colours]


def titled(walks: Mapping[str, T]) -> dict[str, T]:
    """Return two walks by their titles, before and after."""
    items = zip(("before", "after"), walks.items(), strict=True)
    return {f"{when}: {label_of(name)}": walk for when, (name, walk) in items}


@contextmanager
def drawing(
    path: Path, width: float, height: float, *, dpi: float = 160, legend_columns: int = 6
) -> Iterator[Figure]:
    """Make a figure that is written to a file at the end of its block, with a legend above.

    Args:
        path: file to write.
        width: width of the figure [inch].
        height: height of the figure [inch].
        dpi: pixels per inch.
        legend_columns: maximum number of legend columns; 0 for no common legend.
    """
    with matplotlib.rc_context(fname=Path(__file__).with_name("hector.mplstyle")):
        figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
        yield figure
        handles: dict[str, Any] = {}
        for axes in figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
        if legend_columns and handles:
            place, columns = "outside upper center", min(len(handles), legend_columns)
            figure.legend([*handles.values()], [*handles], loc=place, ncols=columns)
        # without date or version, so that the same picture has the same bytes
        fields = {".png": "Software", ".svg": "Date", ".pdf": "CreationDate"}
        field = fields.get(path.suffix.lower())
        content = io.BytesIO()
        metadata = {field: None} if field else None
        figure.savefig(content, format=path.suffix[1:], metadata=metadata)
    write_file(path, content.getvalue())


def widen(axes: Axes, least: float) -> None:
    """Widen a y axis to `least` on either side of its middle or more, so that noise stays small."""
    low, high = axes.get_ylim()
    if high - low < 2 * least:
        axes.set_ylim((low + high) / 2 - least, (low + high) / 2 + least)


def category_axis(axes: Axes, labels: Sequence[str], group: int = 1, **text: Any) -> None:
    """Label the positions 0, 1, ... of an x axis, with a thin line between groups of them."""
    axes.grid(visible=False, axis="x")
    axes.set_xticks(range(len(labels)), labels, **text)
    axes.tick_params(axis="x", length=0)
    axes.set_xlim(-0.6, len(labels) - 0.4)
    for edge in range(group, len(labels), group):
        axes.axvline(edge - 0.5, color="0.8", linewidth=0.8, zorder=0)


def log_axis(axes: Axes, which: str) -> None:
    """Make the axis `which` (x or y) logarithmic, with a few plain numbers for any range."""
    axes.set(**{f"{which}scale": "log"})
    axis = getattr(axes, f"{which}axis")
    low, high = axis.get_view_interval()
    for span, digits in (
        (2, [x / 2 for x in range(2, 20)]),
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
