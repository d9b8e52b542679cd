"""Run the sections, print their tables, and write them as JSON to runs/bench/<time>.json.

`python -m benchmarks.table` takes such a file for docs/performance.md.

Times and ratios are compared with the last run in that folder on the same kind of machine.

python -m benchmarks                     everything that this machine can run
python -m benchmarks qp_layer realtime   some sections
python -m benchmarks --quick             small sizes, to see that everything runs
"""

import argparse
import json
import os
import platform
import re
import sys
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from benchmarks.measuring import Check, Report, child, compare, last_run
from benchmarks.table import lines_of
from hector_jax.core.console import say

SECTIONS = ("qp_layer", "closed_loop", "realtime", "exported", "collection", "batch", "throughput")
QUICK = {
    "qp_layer": ["--problems=20", "--timed=10", "--slow=2", "--rounds=2"],
    "closed_loop": ["--lengths", "40", "200", "--batches", "2", "4"],
    "realtime": ["0.5"],
    "exported": ["0.5"],
    "collection": ["--batches", "2", "--seconds", "0.05"],
    "batch": ["--singles=2", "--many=4", "--ticks=40"],
    "throughput": ["--batches", "16", "64", "--rollouts=4", "--rounds=2"],
}


def _print_report(report: Report, before: Mapping[str, float]) -> None:
    cells = [list(report.columns), *report.rows]
    widths = [max(len(row[i]) for row in cells) for i in range(len(report.columns))]
    print(f"\n{report.title}")
    for row in cells:
        first, *others = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        print("  " + "  ".join([row[0].ljust(widths[0]), *others]))
    for check in (Check(*values) for values in report.checks):
        verdict = ""
        if check.bar is not None:
            verdict = f"{'meets' if check.value <= check.bar else 'MISSES'} {check.bar:.3g}"
        text = f"{check.what:<58} {check.value:>10.3g} {check.unit:<5} {verdict:<15}"
        print(f"  {text} {compare(check.value, before.get(check.what))}".rstrip())
    for note in report.notes:
        print(f"  ({note})")


def _processor() -> str:
    """Return the name of the processor, where Linux tells it, or its architecture."""
    path = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.+)", path.read_text() if path.exists() else "")
    return names[0] if names else platform.machine()


def main(arguments: list[str]) -> int:
    """Run sections by name; a section that cannot run is told and skipped. 1 if one failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("sections", nargs="*", help=f"of {', '.join(SECTIONS)}; all by default")
    parser.add_argument("--quick", action="store_true", help="small sizes, for a trial")
    parser.add_argument("--out", type=Path, default=Path("runs/bench"), help="folder of the JSON")
    chosen = parser.parse_args(arguments)
    unknown = [name for name in chosen.sections if name not in SECTIONS]
    if unknown:
        parser.error(f"unknown section {unknown[0]!r}; there are: {', '.join(SECTIONS)}")
    names = chosen.sections or list(SECTIONS)
    device = child("benchmarks.device")
    if "throughput" in names and not chosen.sections and device["platform"] == "cpu":
        say("throughput: no accelerator here, left out")
        names.remove("throughput")

    machine = {
        "time": time.strftime("%Y-%m-%dT%H:%M:%S"),
        "platform": f"{platform.system()}, {platform.machine()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "device": device["kind"],
        "quick": chosen.quick,
        "load": list(os.getloadavg()),
        "python": platform.python_version(),
        "jax": version("jax"),
    }
    load = machine["load"][0]
    print(f"{machine['cores']} cores, load {load:.1f}, jax {machine['jax']}")
    reports, failed, before = {}, False, last_run(chosen.out, machine)
    for name in names:
        say(f"{name} ...")
        try:
            found = child(f"benchmarks.{name}", *(QUICK[name] if chosen.quick else []))
        except RuntimeError as error:
            say(str(error))
            failed = True
            continue
        reports[name] = found
        _print_report(Report(**found), before.get(name, {}))
        sys.stdout.flush()
    chosen.out.mkdir(parents=True, exist_ok=True)
    path = chosen.out / f"{machine['time'].replace(':', '-')}.json"
    run = {"machine": machine, "sections": reports}
    path.write_text(json.dumps(run | {"table": lines_of(run)}, indent=1))
    say(f"written to {path}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
