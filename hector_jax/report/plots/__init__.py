"""The pictures of a run; matplotlib is imported nowhere else in the package.

Each function draws one picture to a file (the ending of its name decides the format) and returns
its caption. Weight sets keep their colour, line and marker through all pictures, so that they can
be told apart in grey too. Figures are made without pyplot: no display, no global state. Scripts
draw pictures of their own with `style`.
"""

from hector_jax.report.plots.grfm import open_loop, training, wrenches
from hector_jax.report.plots.style import titles
from hector_jax.report.plots.tuning import losses, weights
from hector_jax.report.plots.walks import path_from_above, tracking

__all__ = [
    "losses",
    "open_loop",
    "path_from_above",
    "titles",
    "tracking",
    "training",
    "weights",
    "wrenches",
]
