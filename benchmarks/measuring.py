"""How the benchmarks measure, and what they report.

Every section is a program of its own, so that threads, precision and memory of one leave the others
alone. Contenders take turns, so that what else the machine does hits all alike, and on a pinned
core CPU time is read instead of the clock on the wall: waiting for one's turn is not counted.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ONE_THREAD = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


class Check(NamedTuple):
    """A figure that is held against a bar; a bar of None means it is only told."""

    what: str
    value: float
    unit: str = ""
    bar: float | None = None


class Report(NamedTuple):
    """What a section found: a table for people, checks, and remarks."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    checks: Sequence[Check]
    notes: Sequence[str] = ()


SLOWER = 1.1  # by the last run
TIMES = ("us", "ms", "s", "s CPU", "x")
SAME = ("platform", "cores", "device", "quick")  # what runs must share to be compared


def last_run(folder: Path, machine: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Times and ratios of each section's last run on such a machine, by their names."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        run = json.loads(path.read_text())
        if all(run["machine"].get(key) == machine[key] for key in SAME):
            for section, report in run["sections"].items():
                checks = [Check(*values) for values in report["checks"]]
                found[section] = {c.what: c.value for c in checks if c.unit in TIMES}
    return found


def compare(value: float, before: float | None) -> str:
    """What to print of a time beside that of the last run.

    >>> compare(1.2, 1.0), compare(1.05, 1.0), compare(1.0, None)
    ('1.20 of the last run SLOWER', '1.05 of the last run', '')
    """
    if not before:
        return ""
    ratio = value / before
    return f"{ratio:.2f} of the last run{' SLOWER' if ratio > SLOWER else ''}"


def pin_one_core() -> None:
    """Keep this process on one CPU core and XLA on one thread; call before jax is imported."""
    os.environ["JAX_PLATFORMS"] = "cpu"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {ONE_THREAD}"
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def take_turns(
    contenders: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, np.ndarray]:
    """Seconds (rounds,) that each contender took; all run once before the first round."""
    for run in contenders.values():
        run()
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, run in contenders.items():
            start = clock()
            run()
            spent[name].append(clock() - start)
    return {name: np.array(values) for name, values in spent.items()}


def show(report: Report) -> None:
    """Hand a section's report to the program that started it."""
    print(json.dumps(report._asdict()))


def child(module: str, *arguments: str, **environment: str) -> dict:
    """What `python -m module arguments` prints as JSON in its last line.

    Raises:
        RuntimeError: it failed; tells its last line.
    """
    ran = subprocess.run(
        [sys.executable, "-m", module, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    if ran.returncode:
        last = (ran.stderr.strip().splitlines() or ["nothing on stderr"])[-1]
        raise RuntimeError(f"{module} {' '.join(arguments)} ended with {ran.returncode}: {last}")
    return json.loads(ran.stdout.strip().splitlines()[-1])
