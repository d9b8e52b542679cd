"""A tuning on disk, iteration by iteration: what a cut one goes on from and a finished one is."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from hector_jax.control.weights import Weights, nominal
from hector_jax.storage import Checkpoint
from hector_jax.tuning.difftune import NOT_ENDED, Evaluation, Iteration, Tuning
from hector_jax.tuning.loss import Losses

KIND = "tuning"  # of a checkpoint


class Record(NamedTuple):
    """Where a tuning is kept, and what was found there."""

    kept: Checkpoint
    past: Tuning | None = None  # finished or not
    notes: Mapping[str, Any] = {}  # of its card

    @property
    def is_finished(self) -> bool:
        """Whether the tuning that was found came to its end."""
        return self.past is not None and self.past.stop != NOT_ENDED


class _Course(NamedTuple):
    """The arrays of a tuning, iterations stacked; the words go into the card."""

    weights: Weights
    evaluation: Evaluation
    accepted: Any
    step: Any
    ten: Weights
    converged: Weights


def _course_like() -> _Course:
    none = np.zeros(0)
    rows = jax.tree.map(lambda w: np.zeros((0, *w.shape)), nominal())
    seen = Evaluation(none, Losses(none, none, none), rows, none, none)
    return _Course(rows, seen, none, none, nominal(), nominal())


def save_tuning(kept: Checkpoint, tuning: Tuning) -> None:
    """Keep a tuning with its history, finished or not.

    Raises:
        WriteError: where the file cannot be written.
    """
    stack = lambda trees: jax.tree.map(lambda *x: np.stack(x), *trees)  # noqa: E731
    course = _Course(
        weights=stack([i.weights for i in tuning.history]),
        evaluation=stack([i.evaluation for i in tuning.history]),
        accepted=np.array([i.accepted for i in tuning.history]),
        step=np.array([i.step for i in tuning.history]),
        ten=tuning.ten,
        converged=tuning.converged,
    )
    first = tuning.history[0].iteration
    reasons = [i.reason for i in tuning.history]
    kept.save(course, {"first": first, "reasons": reasons, "stop": tuning.stop})


def load_tuning(kept: Checkpoint) -> Record:
    """What `save_tuning` kept, where it is sound."""
    taken = kept.load(_course_like())
    if taken is None:
        return Record(kept)
    course, about = taken
    row = lambda tree, i: jax.tree.map(lambda x: np.asarray(x[i]), tree)  # noqa: E731
    history = [
        Iteration(
            about.get("first", 0) + i,
            row(course.weights, i),
            row(course.evaluation, i),
            bool(course.accepted[i]),
            reason,
            float(course.step[i]),
        )
        for i, reason in enumerate(about["reasons"])
    ]
    return Record(kept, Tuning(history, course.ten, course.converged, about["stop"]), about)
