"""The exported controller in C beside the live one and beside DAQP, one pinned core.

Walks with pushes are recorded and replayed; each plan's QP is then solved by DAQP, ready and dense.
Times are those of the thread, called from Python, of each call the shortest of several rounds: what
other programs on the core do to the caches is not counted.

python -m benchmarks.exported 4 examples/quadruped/robot.toml
"""

import ctypes
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.measuring import Check, Report, pin_one_core, show

if __name__ == "__main__":
    pin_one_core()

import numpy as np

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import nominal
from hector_jax.core.runtime import setup_jax
from hector_jax.export.check import (
    Library,
    WalkRecord,
    compare_with_live,
    compile_controller,
    inputs_of,
    layout_of,
    record,
)
from hector_jax.export.source import controller_source
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.loop import Job, substeps
from hector_jax.sim.world import Push, ideal

SECONDS = 4.0
ROUNDS = 7
# what the QP of the last plan was: n, the number of rows, P, q, A, bounds
_WITNESS = """
static struct controller_qp before;
void last_qp(int *sizes, double *P, double *q, double *A, double *bound) {
    int n = before.n, m = before.contacts * SIDES;
    sizes[0] = n, sizes[1] = m;
    FOR(i, n) FOR(j, n) P[i * n + j] = before.P[i][j];
    FOR(i, n) q[i] = before.q[i];
    FOR(i, m) FOR(j, n) A[i * n + j] = 0.0;
    FOR(i, m) FOR(j, INPUTS) A[i * n + i / SIDES * INPUTS + j] = before.A[i][j];
    FOR(i, m) bound[i] = before.bound[i];
}
"""


def times_of(library: Path, robot: Robot, walked: WalkRecord) -> np.ndarray:
    """Thread CPU times [ms] of the calls along a walk."""
    inputs, out, rounds = inputs_of(walked, robot), np.zeros(1, layout_of(robot).output), []
    for _ in range(ROUNDS):
        compiled = Library(library)
        rounds.append([compiled.step(inputs, out, i) for i in range(len(walked.torque))])
    return np.min(rounds, axis=0)


def daqp_times(source: dict[str, str], folder: Path, robot: Robot, walked: WalkRecord) -> list:
    """Thread CPU times [ms] of DAQP for the QPs of a walk's plans."""
    import daqp

    code, spent = source["controller.c"], []
    for old, new in (
        ("/* MPC */", _WITNESS + "/* MPC */"),
        ("    out->status = solve(", "    before = c->qp;\n    out->status = solve("),
    ):
        assert old in code
        code = code.replace(old, new, 1)
    compiled = Library(compile_controller({**source, "controller.c": code}, folder))
    inputs, layout = inputs_of(walked, robot), layout_of(robot)
    out, sizes, room = np.zeros(1, layout.output), np.zeros(2, np.int32), np.zeros((4, 2_000_000))
    at = [ctypes.c_void_p(x.ctypes.data) for x in (sizes, *room)]
    for i in range(len(walked.torque)):
        compiled.step(inputs, out, i)
        if i % substeps(walk_config(robot)):
            continue
        compiled.functions.last_qp(*at)
        n, m = sizes
        P, q, A, upper = (x[:k] for x, k in zip(room, (n * n, n, m * n, m), strict=True))
        qp = (
            P.reshape(n, n).copy(),
            q.copy(),
            A.reshape(m, n).copy(),
            upper.copy(),
            np.full(m, -1e30),
        )
        times = []
        for _ in range(ROUNDS):
            begin = time.thread_time_ns()
            _, _, flag, _ = daqp.solve(*qp, np.zeros(m, np.int32))
            times.append(1e-6 * (time.thread_time_ns() - begin))
            assert flag == 1
        spent.append(min(times))
    return spent


def measure(seconds: float, robot: Robot) -> tuple[list[str], list[Check]]:
    """Row and checks of a robot over the three trajectories."""
    config, weights = walk_config(robot), nominal(robot)
    push = Push(np.array([[0.0, 1.0 * robot.mass, 0.0]]), np.array([1.0]), np.array([0.1]))
    source = controller_source(config, robot, weights, name="nominal", content=b"")
    found, spent, daqp = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        library = compile_controller(source, Path(folder))
        for name in COMMANDS:
            job = Job(weights, named_command(name), ideal(robot.description), seconds, push=push)
            walked = record(config, robot, job)
            found.append(compare_with_live(config, robot, library, walked))
            spent.append(times_of(library, robot, walked))
            daqp += daqp_times(source, Path(folder) / name, robot, walked)
    name, ready = robot.description.name, float(np.median(daqp))
    calls, plans = np.stack(spent), np.arange(len(spent[0])) % substeps(config) == 0
    plan, hold = (float(np.median(calls[:, kind], axis=1).max()) for kind in (plans, ~plans))
    worst = float(np.quantile(calls[:, plans], 0.999, axis=1).max())
    off = max(max(one.force, one.moment, one.torque) for one in found)
    unsolved = sum(one.unsolved for one in found)
    row = [name, f"{plan:.3f}", f"{worst:.3f}", f"{hold:.4f}", f"{ready:.3f}", f"{off:.1e}"]
    return row, [
        Check(f"{name}: plan by DAQP's ready solve", plan / ready, "x", 2.0),
        Check(f"{name}: plan, 99.9 %", worst, "ms", 0.4),
        Check(f"{name}: call that holds", hold, "ms", 0.01),
        Check(f"{name}: difference from the live one", off, "N, N m", 1e-8),
        Check(f"{name}: plans without a solution", unsolved, "", 0),
    ]


if __name__ == "__main__":
    setup_jax()
    seconds, *files = sys.argv[1:] or [SECONDS]
    robots = [load_robot(), *(load_robot(Path(file)) for file in files)]
    rows, checks = zip(*(measure(float(seconds), robot) for robot in robots), strict=True)
    columns = ("robot", "plan ms", "99.9 %", "hold ms", "DAQP ms", "difference")
    show(Report("The controller in C", columns, rows, [c for found in checks for c in found]))
