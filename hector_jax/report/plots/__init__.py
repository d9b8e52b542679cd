"""The pictures of a run, and the only door to matplotlib.

Each function draws one picture to a file (the ending of its name decides the format) and returns
its caption. Weight sets keep their colour, line and marker through all pictures, so that they can
be told apart in grey too. Figures are made without pyplot: no display, no global state.
"""

from hector_jax.report.plots.ground import gradients, open_loop, ranks, training, wrenches
from hector_jax.report.plots.sets import by_plant, changes, push_directions, ratios, survival
from hector_jax.report.plots.style import named
from hector_jax.report.plots.tunings import (
    RIVALS,
    front,
    losses,
    race,
    starts,
    weight_courses,
    weights,
    while_walking,
)
from hector_jax.report.plots.walks import collective, distances, path_from_above, tracking

__all__ = [
    "RIVALS",
    "by_plant",
    "changes",
    "collective",
    "distances",
    "front",
    "gradients",
    "losses",
    "named",
    "open_loop",
    "path_from_above",
    "push_directions",
    "race",
    "ranks",
    "ratios",
    "starts",
    "survival",
    "tracking",
    "training",
    "weight_courses",
    "weights",
    "while_walking",
    "wrenches",
]
