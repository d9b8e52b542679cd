"""report.md in the folder of a `hector tune` run."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import Weights, weight_names, weights_to_vector
from hector_jax.core.files import write_file
from hector_jax.report.fidelity import error_rows
from hector_jax.report.report import render
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration, Tuning
from hector_jax.tuning.evaluate import aligned


def write_report(folder: Path, **contents: Any) -> Path:
    """Write report.md into the run folder, whole or not at all.

    Args:
        folder: where the pictures are.
        contents: all of these:
            trajectory, verdict: what was walked, and the walks of all sets on the stand-in.
            tunings: by set, `without`, `with` and, refreshed, `with_refreshed`.
            norms: of the terms' gradients in log-weights at nominal, by model.
            curvature: of the loss in the starting weights.
            errors: held-out, of `raw`, `linear`, `net`, as `training.report` has them.
            shifts: of each refresh, by `nets.refresh`.
            walked, cases: `Change`s of the tuning on walks; walks of each weight set.
            chosen: by set, iteration that was taken, where not the last.
            pictures, film: `Picture`s; of the film, or why there is none.
            config, environment: resolved settings, as JSON values, and what it was made with.
            command: that makes this run again.

    Returns:
        The file.
    """
    functions = {"aligned": aligned, "error_rows": error_rows, "tuning_section": tuning_section}
    write_file(folder / "report.md", render("run.md.j2", **contents, **functions).encode())
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
        for tree in (weights, *bounds(others, weights))
    )
    close = np.any([np.isclose(values, bound, rtol=1e-9) for bound in box], axis=0)
    return (
        ", ".join(f"`{name}`" for name in np.array([*weight_names(weights), *others])[close])
        or "none"
    )
