"""Shared parts of the experiments: how they start, their flags, and the writing of reports."""

import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import jax
import numpy as np
import tyro
from jaxtyping import Shaped
from scipy import stats

from hector_jax.cli.flags import named_file
from hector_jax.control.weights import Weights, direction_names, scale_weights
from hector_jax.core.console import exit_code
from hector_jax.core.environment import environment
from hector_jax.core.files import make_folder, write_file, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax
from hector_jax.core.settings import AT_LEAST_ONE, check
from hector_jax.verdict.metrics import COVERAGE, Interval

RESAMPLES, FEWEST = 10_000, 4  # resamples of a bootstrap; fewest samples for an interval


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Flags of every experiment."""

    out: Path = Path("runs")  # folder of the report
    processes: Annotated[int, AT_LEAST_ONE] = 2  # that walk in MuJoCo, one core each

    def __post_init__(self) -> None:
        check(self)


def run(experiment: Callable[[Any], Path | None], flags: Any, about: str | None = None) -> NoReturn:
    """Run an experiment as a program, which prints the path of its report.

    Args:
        experiment: function of the flags.
        flags: their class, or classes, each of which is a sub-command.
        about: the text of --help, by default that of the class.
    """

    def work() -> None:
        given = tyro.cli(flags, description=about)
        setup_jax()
        make_folder(given.out)
        if report := experiment(given):
            print(report)

    sys.exit(exit_code(Path(sys.argv[0]).stem, work))


def named_files(flag: str, texts: Sequence[str]) -> dict[str, str]:
    """Return the files of a flag by their names.

    Raises:
        InputError: one is no NAME=FILE, or two have one name.
    """
    files = dict(map(named_file, texts))
    if "" in files or len(files) < len(texts):
        text = f"--{flag} must be NAME=FILE, each with a NAME of its own"
        raise InputError(f"{text}, got {' '.join(texts)}")
    return files


def write_report(
    path: Path,
    title: str,
    paragraphs: Sequence[str],
    numbers: Mapping[str, Any],
    pictures: Mapping[str, str] | None = None,
) -> Path:
    """Write numbers as JSON and, beside them, a report in Markdown.

    Args:
        path: file of the numbers, in the folder of the report and its pictures.
        title: its heading; commit and command follow.
        paragraphs: its text, in Markdown.
        numbers: JSON values; `environment` is added.
        pictures: captions by the names of files.

    Returns:
        The path of the report, `report.md`.
    """
    about = environment()
    images = [f"![{file}]({file})\n\n{caption}" for file, caption in (pictures or {}).items()]
    script = "/".join(Path(sys.argv[0]).resolve().parts[-2:])
    command = shlex.join(["python", script, *sys.argv[1:]])
    # outside a checkout there is none
    made = f"Made at {about.get('commit', 'an unknown commit')} by `{command}`."
    text = [f"# {title}", made, *paragraphs, *images]
    write_json(path, {"environment": about, **numbers})
    report = path.with_name("report.md")
    write_file(report, ("\n\n".join(text) + "\n").encode())
    return report


def bootstrap(statistic: Callable[..., Any], *samples: Shaped[np.ndarray, "n ..."]) -> Interval:
    """Compute a statistic with its percentile bootstrap interval, reproducibly.

    With few samples it is too narrow: of 8, a median's covers 92 %, a mean's 86 %.

    Args:
        statistic: function of arrays like `samples`, possibly with leading axes.
        samples: arrays to resample along their first axis, all with the same rows.

    Returns:
        The value and the interval, whose ends are NaN for fewer than `FEWEST` samples.
    """
    value, count = float(statistic(*samples)), len(samples[0])
    if count < FEWEST:
        return Interval(value, np.nan, np.nan)
    ends = stats.bootstrap(
        (np.arange(count),),  # rows, so that all arrays are resampled in the same way
        lambda rows, axis: statistic(*(x[rows] for x in samples)),
        n_resamples=RESAMPLES,
        confidence_level=COVERAGE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value, float(ends.low), float(ends.high))


def all_devices() -> None:
    """Make every CPU core a JAX device, and join the hosts of a cluster.

    Call after `setup_jax` and before the first array. Hosts are joined if the environment names a
    coordinator (`JAX_COORDINATOR_ADDRESS`, with `JAX_NUM_PROCESSES` and `JAX_PROCESS_ID` unless JAX
    detects the cluster) or inside a job step of Slurm or Open MPI.
    """
    if "host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        cores = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))(0)
        jax.config.update("jax_num_cpu_devices", len(cores))
    clusters = ("JAX_COORDINATOR_ADDRESS", "SLURM_STEP_NODELIST", "OMPI_MCA_orte_hnp_uri")
    if any(name in os.environ for name in clusters):
        variables = ("JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
        count, rank = (int(os.environ[v]) if v in os.environ else None for v in variables)
        jax.distributed.initialize(num_processes=count, process_id=rank)


def sample_weights(weights: Weights, factor: float, count: int) -> list[Weights]:
    """Draw weight sets log-uniformly within a factor of given weights, with a fixed seed."""
    draws = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(direction_names(weights))))
    return jax.device_get([scale_weights(weights, np.log(factor) * row) for row in draws])
