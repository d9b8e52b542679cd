"""metrics.jsonl of a run folder: what its tunings did, a line for each iteration."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np

from hector_jax.control.weights import WEIGHT_NAMES, weights_to_vector
from hector_jax.core.files import append_file, as_json, write_file
from hector_jax.tuning.difftune import Iteration


def as_line(name: str, iteration: Iteration) -> str:
    """A line of metrics.jsonl."""
    evaluation = iteration.evaluation
    gradient = jax.tree.map(np.multiply, evaluation.gradient, iteration.weights)
    vector = lambda tree: np.asarray(weights_to_vector(tree)).tolist()  # noqa: E731
    row = {
        "set": name,
        "iteration": iteration.iteration,
        "accepted": iteration.accepted,
        "reason": iteration.reason,
        "step": iteration.step,
        "L": float(evaluation.loss),
        "L_Eul": float(evaluation.parts.euler),
        "L_pos": float(evaluation.parts.position),
        "L_ctrl": float(evaluation.parts.control),
        "fallen": float(evaluation.fallen),
        "residual": float(evaluation.residual),
        "weights": dict(zip(WEIGHT_NAMES, vector(iteration.weights), strict=True)),
        "gradient_log": dict(zip(WEIGHT_NAMES, vector(gradient), strict=True)),
    }
    return as_json(row) + "\n"


class Journal:
    """metrics.jsonl, a line for each iteration: as they come; in order when tunings are over."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._histories: dict[str, Sequence[Iteration]] = {}

    def write(self, histories: Mapping[str, Sequence[Iteration]]) -> None:
        """Write the file anew, with these tunings after or instead of those written before.

        Raises:
            WriteError: where the file cannot be written; the old one stays.
        """
        self._histories.update(histories)
        lines = (as_line(name, i) for name, history in self._histories.items() for i in history)
        write_file(self.path, "".join(lines).encode())

    def add(self, name: str, iteration: Iteration) -> None:
        """Write one line more.

        Raises:
            WriteError: where the file cannot be written.
        """
        append_file(self.path, as_line(name, iteration).encode())
