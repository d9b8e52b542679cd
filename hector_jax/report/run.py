"""report.md in the folder of a `hector tune` run."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import WEIGHT_NAMES, Weights, weights_to_vector
from hector_jax.core.files import write_file
from hector_jax.report.fidelity import error_rows
from hector_jax.report.report import Picture, render
from hector_jax.runs.metrics import Verdict
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration, Tuning
from hector_jax.tuning.evaluate import aligned


class Report(NamedTuple):
    """All that report.md contains."""

    trajectory: str
    verdict: Verdict
    tunings: Mapping[str, Tuning]  # `without`, `with` and, refreshed, `with_refreshed`
    # norms of the terms' gradients in log-weights at nominal, by model
    norms: Mapping[str, Mapping[str, float]]
    errors: Mapping[str, Mapping[str, Any]]  # held-out, of `raw`, `linear`, `net`: training.report
    pictures: Sequence[Picture]
    film: Picture | str  # or why there is none
    config: Mapping[str, Any]  # resolved, as JSON values
    environment: Mapping[str, str]
    command: str  # that makes this run again
    shifts: Sequence[Mapping[str, Any]] = ()  # of each refresh: nets.refresh
    chosen: Mapping[str, Mapping[str, int]] = {}  # iteration that was taken, where not the last


def write_report(folder: Path, report: Report) -> Path:
    """Write report.md into the run folder, whole or not at all.

    Args:
        folder: where the pictures are.
        report: its contents.

    Returns:
        The file.
    """
    functions = {"aligned": aligned, "error_rows": error_rows, "tuning_section": tuning_section}
    write_file(folder / "report.md", render("run.md.j2", **report._asdict(), **functions).encode())
    return folder / "report.md"


def tuning_section(name: str, tuning: Tuning, chosen: Mapping[str, int] | None = None) -> str:
    """What a tuning did, under a heading of its name; one along walks begins after the paper's."""
    return render(
        "tuning.md.j2",
        name=name,
        tuning=tuning,
        chosen=chosen,
        paper=PAPER_ITERATIONS,
        refusals=_refusals,
        at_bounds=_at_bounds,
    )


def _refusals(refused: Sequence[Iteration]) -> list[str]:
    """Why steps were refused, and which."""
    iterations: dict[str, list[str]] = {}
    for i in refused:
        # without the numbers, which differ from step to step
        reason = re.sub(r" (\d|inf|nan).*", "", i.reason)
        iterations.setdefault(reason, []).append(str(i.iteration))
    return [f"{reason} (iteration {', '.join(which)})" for reason, which in iterations.items()]


def _at_bounds(weights: Weights) -> str:
    others = [name for name, value in weights.others.items() if np.ndim(value) == 0]
    values, *box = (
        np.append(weights_to_vector(tree), [tree.others[name] for name in others])
        for tree in (weights, *bounds(others))
    )
    close = np.any([np.isclose(values, bound, rtol=1e-9) for bound in box], axis=0)
    return ", ".join(f"`{name}`" for name in np.array([*WEIGHT_NAMES, *others])[close]) or "none"
