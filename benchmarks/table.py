"""The table of docs/performance.md: what, on what, how long, beside which peer.

Every run of `python -m benchmarks` writes its lines into its JSON. This takes runs for the page,
one file for each kind of device into experiments/reports/performance, and writes the table:

python -m benchmarks.table runs/bench/TIME.json ...
"""

import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"
RUNS = ROOT / "experiments" / "reports" / "performance"
HEAD = ["| what | on | time | beside |", "|---|---|---|---|"]


class Line(NamedTuple):
    """A line of the table: its text and where its numbers are; {1} is the second cell of a row."""

    section: str
    what: str
    row: str
    time: str
    peers: Mapping[str, str] = {}  # text by row; those that are not installed are left out


_QP, _ROLLOUTS = "ours f64, lax.map", "rollouts at once, 400 ticks"
LINES = (
    Line(
        "qp_layer",
        "one QP of the MPC, condensing included",
        _QP,
        "{1} us",
        {"DAQP": "DAQP, the ready QP: {1} us"},
    ),
    Line(
        "qp_layer",
        "the same with its gradient",
        _QP,
        "{3} us",
        {
            "qpax e, kappa 1e-5, lax.map": "qpax: {3} us",
            "jaxopt BoxOSQP 1e-5, lax.map": "jaxopt's BoxOSQP: {3} us",
        },
    ),
    Line(
        "throughput",
        "each of 4096 at once, with its gradient",
        "ours f64, vmap, 4096",
        "{2} us",
        {"ours f32, vmap, 4096": "in 32 bits: {2} us"},
    ),
    Line("realtime", "a controller tick, median and 99 %", "CPU", "{1} ms, {2} ms"),
    Line(
        "exported",
        "a plan of the exported controller in C, median and 99.9 %",
        "hector",
        "{1} ms, {2} ms",
        {"hector": "DAQP, the ready QP: {4} ms"},
    ),
    Line("exported", "a call of it between plans", "hector", "{3} ms"),
    Line(
        "closed_loop",
        "a walk of 4 s on the rigid body, with its gradient",
        "1 rollout, 400 ticks, warm cache",
        "{2} s",
    ),
    Line("closed_loop", "256 such walks at once", f"256 {_ROLLOUTS}", "{2} s, {3} GiB"),
    Line("batch", "1024 tunings of ten steps", "many, gauss_newton", "{3} s"),
)


def lines_of(run: Mapping[str, Any]) -> list[list[str]]:
    """Return the lines of the table that the sections of a run have."""
    machine, found = run["machine"], []
    on = machine["processor"] if machine["device"] == "cpu" else machine["device"]
    for line in LINES:
        rows = {row[0]: row for row in run["sections"].get(line.section, {"rows": []})["rows"]}
        if line.row in rows:
            peers = (text.format(*rows[row]) for row, text in line.peers.items() if row in rows)
            found.append([line.what, on, line.time.format(*rows[line.row]), "; ".join(peers)])
    return found


def with_table(page: str) -> str:
    """Return a page with the lines of the runs in `RUNS` in place of its table."""
    rows = [
        line for path in sorted(RUNS.iterdir()) for line in json.loads(path.read_text())["table"]
    ]
    table = "\n".join([*HEAD, *("| " + " | ".join(row) + " |" for row in rows), ""])
    return re.sub(r"(?:^\|.*\n)+", lambda _: table, page, count=1, flags=re.MULTILINE)


def take(path: Path) -> None:
    """Take the sections of a run for the page; those that it lacks stay as they are."""
    run = json.loads(path.read_text())
    name = re.sub(r"\W+", "-", run["machine"]["device"].lower())
    own = RUNS / f"{name}.json"
    before = json.loads(own.read_text())["sections"] if own.exists() else {}
    run["sections"] = before | run["sections"]
    run["table"] = lines_of(run)
    own.write_text(json.dumps(run, indent=1) + "\n")


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        take(Path(argument))
    PAGE.write_text(with_table(PAGE.read_text()))
