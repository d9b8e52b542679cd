"""How many planted faults the fast tests catch: mutation testing of the method.

    python -m benchmarks.mutation --root . --count 200 --workers 16 --out survivors.json

Each fault changes one operator, number or function name in the source of the controller, the QP
solver, the tuner or the simulation, drawn with a fixed seed. The tests of that part run on a copy
of the repository in a process of one core; a failure or a hang catches the fault.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

# by part: its sources, and the test files that run, the quickest first
PARTS = {
    "control": (
        "control/footstep control/gait control/legs control/mpc control/reference"
        " control/trajectories control/controller control/weights control/contact"
        " control/parameters",
        "gait footstep legs reference trajectories weights config mpc controller rollout humanoid"
        " quadruped export",
    ),
    "qp": (
        "qp/problem qp/active_set qp/interior_point qp/certificates qp/method qp/derivative"
        " qp/gpu_kernel qp/linear qp/solver",
        "qp gpu_kernel mpc",
    ),
    "tuning": (
        "tuning/batch tuning/difftune tuning/step_rules tuning/curvature tuning/loss"
        " tuning/grounded tuning/rollout tuning/variation tuning/evaluate",
        "loss variation config rollout difftune step_rules curvature faults grounded batch",
    ),
    "sim": (
        "sim/actuators sim/loop sim/mjx_model sim/parallel sim/sensing sim/walk sim/world",
        "sensing world sizes walk engine parallel fidelity",
    ),
}
COMPARISONS = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
OPERATORS = {"+": "-", "-": "+", "*": "/", "/": "*", "**": "*", "//": "*", "&": "|", "|": "&"}
NAMES = {
    "minimum": "maximum",
    "maximum": "minimum",
    "sin": "cos",
    "cos": "sin",
    "any": "all",
    "all": "any",
    "zeros": "ones",
    "ones": "zeros",
    "zeros_like": "ones_like",
    "ones_like": "zeros_like",
    "floor": "ceil",
    "ceil": "floor",
}
WORDS = {"and": "or", "or": "and"}


@dataclass(frozen=True)
class Fault:
    """A replacement of source text."""

    part: str
    file: str
    line: int
    begin: int  # characters from the start of the file
    end: int
    before: str
    after: str


def _numbers(node: ast.Constant) -> str | None:
    value = node.value
    if isinstance(value, bool):
        return str(not value)
    if isinstance(value, int):
        return str(value + 1)
    if isinstance(value, float):
        return repr(2.0 * value or 1.0)
    return None


def _faults(part: str, file: str, source: str) -> Iterator[Fault]:
    starts = [0]
    for text in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(text.encode()))
    data = source.encode()

    def fault(begin: int, end: int, after: str) -> Fault:
        line = data[:begin].count(b"\n") + 1
        return Fault(part, file, line, begin, end, data[begin:end].decode(), after)

    def first(node: ast.AST) -> int:
        return starts[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]

    def last(node: ast.AST) -> int:
        return starts[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]

    def between(left: ast.AST, right: ast.AST, table: dict[str, str]) -> Iterator[Fault]:
        begin, gap = last(left), data[last(left) : first(right)].decode()
        sign = gap.strip(" ()\n")
        if sign in table:
            at = begin + gap.index(sign)
            yield fault(at, at + len(sign), table[sign])

    def look(node: ast.AST) -> Iterator[Fault]:
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], COMPARISONS)
        elif isinstance(node, ast.BinOp):
            yield from between(node.left, node.right, OPERATORS)
        elif isinstance(node, ast.BoolOp):
            yield from between(node.values[0], node.values[1], WORDS)
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Invert | ast.Not):
            yield fault(first(node), first(node) + (4 if isinstance(node.op, ast.Not) else 1), "")
        elif isinstance(node, ast.Constant) and (after := _numbers(node)):
            yield fault(first(node), last(node), after)
        elif isinstance(node, ast.Attribute) and node.attr in NAMES:
            yield fault(last(node) - len(node.attr), last(node), NAMES[node.attr])
        elif isinstance(node, ast.IfExp):
            yield fault(first(node.test), last(node.test), "True")

    def walk(node: ast.AST) -> Iterator[Fault]:
        if isinstance(node, ast.Raise | ast.JoinedStr):
            return
        if isinstance(node, ast.AnnAssign):
            children = [node.value] if node.value else []
        elif isinstance(node, ast.FunctionDef | ast.Lambda):
            body = node.body if isinstance(node.body, list) else [node.body]
            children = [*node.args.defaults, *filter(None, node.args.kw_defaults), *body]
        else:
            children = list(ast.iter_child_nodes(node))
        yield from look(node)
        for child in children:
            yield from walk(child)

    yield from walk(ast.parse(source))


def draw(root: Path, count: int, seed: int) -> list[Fault]:
    """Faults of a repository, as many of each part."""
    chosen = []
    for part, (sources, _) in PARTS.items():
        every = []
        for name in sources.split():
            file = f"hector_jax/{name}.py"
            every += _faults(part, file, (root / file).read_text())
        chosen += random.Random(seed).sample(every, count // len(PARTS))
    return chosen


def _copy(root: Path, folder: Path) -> None:
    for name in ("hector_jax", "tests", "experiments", "examples", "benchmarks", "assets"):
        shutil.copytree(root / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("docs", "pyproject.toml", "README.md", "CHANGELOG.md", "Makefile"):
        (folder / name).symlink_to(root / name)


def _exit_code(part: str, folder: Path, core: int, limit: float) -> int:
    files = [f"tests/test_{name}.py" for name in PARTS[part][1].split()]
    if missing := [name for name in files if not (folder / name).exists()]:
        raise FileNotFoundError(f"{', '.join(missing)}: named in PARTS, and not there")
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *files]
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    with (folder / "log").open("w") as log:
        return subprocess.run(
            ["taskset", "-c", str(core), *words],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=log,
            timeout=limit,
        ).returncode


def try_fault(root: Path, fault: Fault, core: int, limit: float) -> dict:
    """What the tests say of one fault."""
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _copy(root, folder)
        path = folder / fault.file
        data = path.read_bytes()
        path.write_bytes(data[: fault.begin] + fault.after.encode() + data[fault.end :])
        try:
            code = _exit_code(fault.part, folder, core, limit)
            failed = [
                line.split(" - ")[0].removeprefix("FAILED ").removeprefix("ERROR ")
                for line in (folder / "log").read_text().splitlines()
                if line.startswith(("FAILED", "ERROR "))
            ]
            verdict = {0: "survived", 1: "caught"}.get(code, f"caught (exit {code})")
        except subprocess.TimeoutExpired:
            failed, verdict = [], "hung"
    seconds = round(time.monotonic() - begin, 1)
    return asdict(fault) | {"verdict": verdict, "by": failed[:1], "seconds": seconds}


def main() -> int:
    """Plant, test, count."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutation", description=__doc__)
    parser.add_argument("--root", type=Path, default=Path.cwd(), help="the repository")
    parser.add_argument("--count", type=int, default=200, help="faults, over the four parts")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="one core each")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for one fault")
    parser.add_argument("--out", type=Path, default=Path("mutation.json"))
    flags = parser.parse_args()
    root, cores, results = flags.root.resolve(), SimpleQueue(), []
    for core in sorted(os.sched_getaffinity(0))[: flags.workers]:
        cores.put(core)

    def job(fault: Fault) -> dict:
        core = cores.get()
        try:
            return try_fault(root, fault, core, flags.limit)
        finally:
            cores.put(core)

    with ThreadPoolExecutor(flags.workers) as pool:
        jobs = [pool.submit(job, fault) for fault in draw(root, flags.count, flags.seed)]
        for done in as_completed(jobs):
            results.append(done.result())
            flags.out.write_text(json.dumps(results, indent=1))
    for part in PARTS:
        of_part = [one for one in results if one["part"] == part]
        survived = [one for one in of_part if one["verdict"] == "survived"]
        print(f"{part}: {len(of_part) - len(survived)} of {len(of_part)} caught")
        for one in sorted(survived, key=lambda one: (one["file"], one["line"])):
            print(f"  {one['file']}:{one['line']}: {one['before']!r} -> {one['after']!r}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
