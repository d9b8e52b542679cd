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
from hector_jax.report.report import Picture, markdown_table, power_text, render, summaries
from hector_jax.runs.metrics import Verdict
from hector_jax.tuning.difftune import PAPER_ITERATIONS, Iteration, Tuning
from hector_jax.tuning.evaluate import aligned
from hector_jax.tuning.loss import Loss

TUNED = {  # weight sets that the summary names
    "with": "through the net",
    "without": "without the net",
    "with_refreshed": "through the net refreshed",
}


class Report(NamedTuple):
    """All that report.md contains."""

    trajectory: str
    verdict: Verdict
    tunings: Mapping[str, Tuning]  # `without`, `with` and, refreshed, `with_refreshed`
    norms: Mapping[
        str, Mapping[str, float]
    ]  # of the terms' gradients in log-weights at nominal, by model
    errors: Mapping[str, Mapping[str, Any]]  # held-out, of `raw`, `linear`, `net`: training.report
    pictures: Sequence[Picture]
    film: Picture | str  # or why there is none
    config: Mapping[str, Any]  # resolved, as JSON values
    environment: Mapping[str, str]
    command: str  # that makes this run again
    shifts: Sequence[Mapping[str, Any]] = ()  # of each refresh: nets.refresh


def write_report(folder: Path, report: Report) -> Path:
    """Write report.md into the run folder, whole or not at all.

    Args:
        folder: where the pictures are.
        report: its contents.

    Returns:
        The file.
    """
    text = render(
        "run.md.j2",
        **report._asdict(),
        tuned=TUNED,
        sets=summaries(report.verdict),
        sections=[tuning_section(name, tuning) for name, tuning in report.tunings.items()],
        alpha=_weights_text(report.verdict.loss),
        norms_table=_norms_table(report.verdict.loss, report.norms),
        net_table=_net_table(report.errors),
    )
    path = folder / "report.md"
    write_file(path, text.encode())
    return path


def tuning_section(name: str, tuning: Tuning) -> str:
    """What a tuning did, under a heading of its name; one along walks begins after the paper's."""
    history = tuning.history
    accepted = [i for i in history if i.accepted]
    refused = [i for i in history if not i.accepted]
    early = [i for i in accepted if i.iteration <= PAPER_ITERATIONS]

    return render(
        "tuning.md.j2",
        name=name,
        tuning=tuning,
        whole=history[0].iteration < PAPER_ITERATIONS,
        paper=PAPER_ITERATIONS,
        reasons=_reasons(refused),
        refused=len(refused),
        losses=[float(i.evaluation.loss) / 1e6 for i in (history[0], *early[-1:], accepted[-1])],
        at_bounds=_at_bounds,
        residual=max(float(i.evaluation.residual) for i in accepted),
    )


def _reasons(refused: Sequence[Iteration]) -> list[str]:
    """Why steps were refused, and which."""
    iterations: dict[str, list[str]] = {}
    for i in refused:
        # without the numbers, which differ from step to step
        reason = re.sub(r" (\d|inf|nan).*", "", i.reason)
        iterations.setdefault(reason, []).append(str(i.iteration))
    return [f"{reason} (iteration {', '.join(which)})" for reason, which in iterations.items()]


def _at_bounds(weights: Weights) -> str:
    vector, *box = (np.asarray(weights_to_vector(w)) for w in (weights, *bounds()))
    close = np.any([np.isclose(vector, bound, rtol=1e-9) for bound in box], axis=0)
    names = [f"`{name}`" for name, hit in zip(WEIGHT_NAMES, close, strict=True) if hit]
    return ", ".join(names) or "none"


def _norms_table(loss: Loss, norms: Mapping[str, Mapping[str, float]]) -> str:
    rows = []
    for name, norm in norms.items():
        parts = [norm[term.name] for term in loss]
        # the weight of the last part is 1
        products = [term.weight * x for term, x in zip(loss, parts, strict=True)][:-1]
        cells = (f"{x:.3g}" for x in (*parts, *products))
        rows.append([name, *cells, _weights_text(aligned(loss, norm, loss[-1].name))])
    names = [term.name for term in loss]
    heads = [f"alpha_{k} {name}" for k, name in enumerate(names[:-1], 1)]
    return markdown_table(("model", *names, *heads, "auto"), rows)


def _weights_text(loss: Loss) -> str:
    return ", ".join(power_text(term.weight) for term in loss[:-1])


def _net_table(errors: Mapping[str, Mapping[str, Any]]) -> str:
    """Errors by axis, and the net's as ratios."""
    rows = []
    for label, (raw, linear, net) in error_rows([errors[n] for n in ("raw", "linear", "net")]):
        ratios = (f"{net / other:.2f}" if other > 0.0 else "-" for other in (raw, linear))
        rows.append([label, *(f"{x:.3g}" for x in (raw, linear, net)), *ratios])
    head = ("", "raw command", "linear map", "GRFM-Net", "net / raw", "net / linear")
    return markdown_table(head, rows)
