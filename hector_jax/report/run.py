"""report.md in the folder of a `hector tune` run."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import Weights, weight_names, weights_to_vector
from hector_jax.core.files import write_file
from hector_jax.report.fidelity import error_rows
from hector_jax.report.report import render
from hector_jax.tuning.difftune import Iteration, Tuning
from hector_jax.tuning.evaluate import aligned


def write_run_report(folder: Path, **contents: Any) -> Path:
    """Write report.md into the run folder, whole or not at all.

    Args:
        folder: where the pictures are.
        contents: all of these:
            elsewhere: line of what to expect on another robot; may be empty.
            trajectory, verdict: names of the trajectories; verdict of all sets on the stand-in.
            tunings: by set, `without`, `with` and `best`.
            norms: gradient norms of the terms in log-weights at nominal, by model.
            determined: what the tuning `with` knows about its weights.
            errors: held-out errors of `raw`, `linear`, `net`, from `training.errors_by_phi`.
            walks: the `WalkTuning` that made `best`; None with --walks 0.
            begun_with: name of the set that these walks began with.
            smooth: price of changes of the command between switches of stance in `best`.
            draws: variations of the model for each trajectory of `best`.
            pictures, film: list of `Picture`; `Picture` of the film, or why there is none.
            config, environment: resolved settings, as JSON values; versions and machine.
            command: command line that repeats this run.
            run: name of the run for the next commands, `latest` or its folder.

    Returns:
        The file.
    """
    functions = (aligned, error_rows, tuning_section)
    values = contents | {function.__name__: function for function in functions}
    write_file(folder / "report.md", render("run.md.j2", **values).encode())
    return folder / "report.md"


def tuning_section(name: str, tuning: Tuning) -> str:
    """Return the section of a tuning, by the name of its set."""
    values = {"name": name, "tuning": tuning, "refusals": _refusals, "at_bounds": _at_bounds}
    return render("tuning.md.j2", **values)


def _refusals(refused: Sequence[Iteration]) -> list[str]:
    """List the reasons for refused steps, each with its iterations."""
    iterations: dict[str, list[str]] = {}
    for step in refused:
        # without the numbers, which differ from step to step
        reason = re.sub(r" (\d|inf|nan).*", "", step.reason)
        iterations.setdefault(reason, []).append(str(step.iteration))
    return [f"{reason} (iteration {', '.join(steps)})" for reason, steps in iterations.items()]


def _at_bounds(weights: Weights) -> str:
    others = [name for name, value in weights.others.items() if np.ndim(value) == 0]
    values, *limits = (
        np.append(weights_to_vector(tree), [tree.others[name] for name in others])
        for tree in (weights, *bounds(others, weights))
    )
    close = np.any(np.isclose(values, limits, rtol=1e-9), axis=0)
    names = np.array([*weight_names(weights), *others])[close]
    return ", ".join(f"`{name}`" for name in names) or "none"
