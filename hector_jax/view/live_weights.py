"""The weights of the sets of a live page: sliders, undo, files.

A slider moves a weight as a tuning does: its logarithm, and for all feet at once.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control import parameters
from hector_jax.control.weights import (
    Weights,
    direction_names,
    directions,
    scale_weights,
    weights_to_vector,
)
from hector_jax.control.weights_file import save_weights
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import Robot

_GROUPS = {  # of three weights, in their order, with their unit
    "Orientation": "1/rad²",
    "Position": "1/m²",
    "Turning rates": "s²/rad²",
    "Velocity": "s²/m²",
    "Forces of the feet": "1/N²",
    "Moments of the feet": "1/(N m)²",  # not of point feet
}
_STEP = 0.02  # of a slider, in decades


class PageSetup(NamedTuple):
    """What a page is opened with."""

    robot: Robot
    sets: dict[str, Weights]  # one or two, by their names
    texts: list[str]  # of the line, that named them
    named: dict[str, Weights]  # sets that a button takes
    world: str  # of WORLDS
    seed: int  # of the plant
    at: dict[str, float]  # numbers of command and plant that are not the usual or the world's
    line: Callable[..., str]  # that repeats the page, from its flags


class WeightsPanel:
    """The part of the panel with the weights."""

    def __init__(
        self,
        gui: Any,
        when: Callable[[Any, Callable[..., None]], Any],
        setup: PageSetup,
        send: Callable[..., None],
        line: Callable[[Sequence[str]], str],
    ) -> None:
        """Add it to viser's panel.

        Args:
            gui, when, setup, send: of the page, see `LivePage`.
            line: returns what is shown of saved files.
        """
        self._send, self._repeat = send, line
        self._names = list(setup.sets)
        self._past = [[weights] for weights in setup.sets.values()]  # for each set, now last
        self._texts, self._saved = list(setup.texts), set[str]()
        self._sliders: dict[str, tuple[Any, str]] = {}  # with their units
        with gui.add_folder("Weights"):
            self._set = gui.add_dropdown("of the set", self._names, visible=len(self._names) > 1)
            when(self._set, lambda _: self._show())
            take = gui.add_button_group("as", list(setup.named))
            when(take, lambda name: self.set(self.chosen, setup.named[name]))
            when(gui.add_button("Undo"), lambda _: self._undo())
            names = np.reshape(direction_names(self._past[0][0]), (-1, 3)).tolist()
            for (title, unit), members in zip(_GROUPS.items(), names, strict=False):
                self._add_group(gui, when, title, unit, members)
            self._file = gui.add_text("file", "live.json")
            when(gui.add_button("Save these weights"), lambda _: self._save())
            self._line = gui.add_markdown("")
        self._show()

    @property
    def chosen(self) -> int:
        """Number of the set that is turned."""
        return self._names.index(self._set.value)

    def set(self, i: int, weights: Weights) -> None:
        """Give a set other weights."""
        self._past[i].append(weights)
        self._send("set_weights", i, weights)
        self._show()

    def _add_group(
        self, gui: Any, when: Callable[..., Any], title: str, unit: str, names: Sequence[str]
    ) -> None:
        box = parameters.Q if names[0].startswith("Q") else parameters.R
        low, high = np.log10([box.lower, box.upper]).round(9).tolist()
        marks = tuple((d, f"{10.0**d:g}") for d in np.arange(low, high + 1.0, 2.0).tolist())
        with gui.add_folder(title, expand_by_default=title == "Orientation"):
            for name in names:
                slider = gui.add_slider(name, low, high, _STEP, low, marks=marks)
                self._sliders[name] = slider, unit
                when(slider, lambda log, name=name: self._turn(name, log))

    def _show(self) -> None:
        weights = self._past[self.chosen][-1]
        for name, value in zip(direction_names(weights), _values(weights), strict=True):
            slider, unit = self._sliders[name]
            slider.value = float(np.clip(np.log10(value), slider.min, slider.max))
            slider.label = f"{name} = {value:.3g} {unit}"

    def _turn(self, name: str, log: float) -> None:
        weights = self._past[self.chosen][-1]
        at = np.array(direction_names(weights)) == name
        steps = np.where(at, np.log(10.0**log / _values(weights)), 0.0)
        if np.abs(steps).max() > 1e-9:  # a browser may tell a value twice, Undo shall not need two
            self.set(self.chosen, jax.tree.map(np.asarray, scale_weights(weights, steps)))

    def _undo(self) -> None:
        if len(past := self._past[self.chosen]) > 1:
            _, before = past.pop(), past.pop()
            self.set(self.chosen, before)

    def _save(self) -> None:
        """Write the set to a file of this folder, where alone a client of the page can write."""
        name = self._file.value
        try:
            if not re.fullmatch(r"\w[\w.-]*\.json", name):
                raise InputError("A file is named `NAME.json`, without a folder.")
            if name not in self._saved and Path(name).exists():
                raise InputError(f"`{name}` exists: choose another name.")
            save_weights(Path(name), self._past[self.chosen][-1])
        except InputError as error:
            self._line.content = str(error)
            return
        self._saved.add(name)
        self._texts[self.chosen] = name
        self._line.content = self._repeat(self._texts)


def _values(weights: Weights) -> Float[np.ndarray, " n"]:
    """Return the weights of `direction_names`, those of the first foot."""
    return np.asarray(weights_to_vector(weights))[directions(weights).argmax(axis=1)]
