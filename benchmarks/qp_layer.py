"""The QP layer on one pinned core: weights and state in, first input and its gradient out.

Ours and the JAX peers solve the whole layer, condensing included; the compiled peers solve the same
QPs ready condensed. Times are CPU time per problem; a ratio is that to DAQP within a round, its
median over the rounds. The gradient is that of the first input along a random direction, towards
log-weights and state; its error is relative, the worst of Q, R and x_0.
"""

import argparse
import pickle
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.measuring import Check, Report, child, pin_one_core, show, take_turns

if __name__ == "__main__":
    pin_one_core()

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import exact
from benchmarks.peers import Traced, compiled_peers, traced_peers
from benchmarks.problems import INPUTS, Problem, Ready, condense, draw_problems, layer_qp, pick
from hector_jax.control.controller import WalkConfig
from hector_jax.core.runtime import setup_jax
from hector_jax.core.trajectory import State
from hector_jax.qp import QP, Status, solve_qp
from hector_jax.robot.model import Robot, load_robot

BLOCKS = (slice(0, 12), slice(12, 24), slice(24, 36))  # Q, R, x_0 in `parameters`
TITLE = "QP layer, one pinned CPU core"
WAYS = ("lax.map", "vmap", "one by one")
NUMBERS = ("timed", "slow", "rounds")
COLUMNS = (
    "solver",
    "forward us",
    "/DAQP",
    "val+grad us",
    "/DAQP",
    "u0 error N median",
    "max",
    "gradient error median",
    "p95",
    "max",
    "not solved",
)


class Layer(NamedTuple):
    """A solver in the layer, one problem; what it is asked for shapes the program."""

    forward: Callable[[Problem], Any]  # first input (5,), whether it says solved
    gradient: Callable[[Problem], Any]  # the same, and the gradient (36,)


def ours(qp: QP) -> tuple[jax.Array, jax.Array]:
    """Our solver: minimiser, and whether it says solved."""
    solution = solve_qp(qp, WalkConfig().mpc.qp)
    return solution.x, solution.status == Status.SOLVED


def layer(config: WalkConfig, robot: Robot, solve: Traced) -> Layer:
    """The layer around a solver."""

    def forward(problem: Problem) -> tuple[jax.Array, jax.Array]:
        x, solved = solve(layer_qp(config, robot, problem))
        return x[:INPUTS], solved

    def gradient(problem: Problem) -> tuple[jax.Array, jax.Array, Problem]:
        def objective(weights: Any, state: State) -> tuple[jax.Array, tuple]:
            first, solved = forward(problem._replace(weights=weights, state=state))
            return jnp.dot(problem.pull, first), (first, solved)

        both = jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)
        (_, (first, solved)), slopes = both(problem.weights, problem.state)
        return first, solved, slopes

    return Layer(forward, gradient)


def _in_order(problem: Problem, slopes: tuple) -> np.ndarray:
    """Gradients (B, 36) towards `parameters`, from those towards weights and state."""
    slopes = jax.tree.map(lambda g: np.asarray(g, float), slopes)
    towards_logs = jax.tree.map(lambda g, w: g * w, slopes[0], problem.weights)
    rows = [*towards_logs.Q, *(g.reshape(-1, 6) for g in towards_logs.R), *slopes[1]]
    return np.concatenate(rows, axis=1)


class Errors(NamedTuple):
    """How far a solver is off, problem by problem."""

    first: np.ndarray  # (B,) largest of the first input [N, N m]
    gradient: np.ndarray | None  # (regular problems,) relative
    solved: np.ndarray  # (B,) by its own word


def _gradient_errors(found: np.ndarray, pull: np.ndarray, answers: list[exact.Answer]):
    errors = []
    for slope, direction, truth in zip(found, pull, answers, strict=True):
        if truth.regular:
            right = direction @ truth.slope
            errors.append(
                max(
                    np.linalg.norm(slope[block] - right[block]) / np.linalg.norm(right[block])
                    for block in BLOCKS
                )
            )
    return np.array(errors)


def _traced_errors(made: Layer, problems: Problem, answers: list[exact.Answer]) -> Errors:
    run = jax.jit(lambda batch: jax.lax.map(made.gradient, batch))
    first, solved, slopes = jax.tree.map(np.asarray, run(problems))
    right = np.array([truth.first for truth in answers])
    return Errors(
        np.abs(first - right).max(axis=1),
        _gradient_errors(_in_order(problems, slopes), problems.pull, answers),
        solved,
    )


def _timed(function: Callable, problems: Problem, how: str) -> Callable[[], object]:
    """A run of one problem's function over all of them, to be timed."""
    batch = jax.device_put(problems)
    if how == "one by one":
        run = jax.jit(function)
        ones = [pick(batch, i) for i in range(len(problems.pull))]
        return lambda: [jax.block_until_ready(run(one)) for one in ones]
    run = jax.jit(jax.vmap(function) if how == "vmap" else partial(jax.lax.map, function))
    return lambda: jax.block_until_ready(run(batch))


def _error_cells(errors: Errors | None) -> list[str]:
    if errors is None:
        return [""] * 6
    cells = [f"{np.median(errors.first):.0e}", f"{errors.first.max():.0e}"]
    if errors.gradient is None:
        cells += [""] * 3
    else:
        g = errors.gradient
        cells += [f"{np.median(g):.0e}", f"{np.quantile(g, 0.95):.0e}", f"{g.max():.0e}"]
    return [*cells, str(int(np.sum(~errors.solved)))]


class Work(NamedTuple):
    """The problems, ready QPs and, where DAQP is here, exact answers; made in 64 bits."""

    problems: Problem
    ready: list[Ready]
    answers: list[exact.Answer] | None


def prepare(count: int) -> Work:
    """The first `count` problems with their answers."""
    config, robot = WalkConfig(), load_robot()
    problems = draw_problems(config, robot, count)
    ready = condense(config, robot, problems, count)
    answers = [exact.answer(one) for one in ready] if find_spec("daqp") else None
    return Work(problems, ready, answers)


def measure(work: Work, single: bool, timed: int, slow: int, rounds: int) -> Report:
    """Run the contenders of one precision.

    Args:
        work: what to solve; all of it judges the errors.
        single: 32 bits: ours, beside DAQP. Otherwise ours in 64 and all peers.
        timed: problems that are timed.
        slow: problems of the JAX peers, timed and judged.
        rounds: how often the contenders take turns.
    """
    config, robot = WalkConfig(), load_robot()
    problems, ready, answers = work
    count = len(ready)
    compiled, missing = compiled_peers()
    finite = [np.flatnonzero(np.isfinite(bound)) for bound in (ready[0].qp.u, ready[0].qp.l)]
    traced, absent = traced_peers(*finite)
    if single:
        compiled = {name: solve for name, solve in compiled.items() if name == "DAQP"}
        traced = {}

    contenders: dict[str, Callable[[], object]] = {}
    sizes, errors = {}, {}
    for name, solve in compiled.items():
        contenders[name] = partial(lambda solve: [solve(r.qp) for r in ready[:timed]], solve)
        sizes[name] = timed
        if answers:
            found = [solve(one.qp)[:INPUTS] for one in ready]
            right = np.array([truth.first for truth in answers])
            errors[name] = Errors(
                np.abs(np.array(found) - right).max(axis=1), None, np.ones(count, bool)
            )
    mine = "ours f32" if single else "ours f64"
    layers = {mine: (ours, WAYS, timed, count)}
    layers |= {name: (solve, WAYS[:2], slow, slow) for name, solve in traced.items()}
    for name, (solve, ways, size, judged) in layers.items():
        made = layer(config, robot, solve)
        for how in ways:
            some = pick(problems, slice(size))
            contenders[f"{name}, {how}/forward"] = _timed(made.forward, some, how)
            contenders[f"{name}, {how}/gradient"] = _timed(made.gradient, some, how)
            sizes[f"{name}, {how}"] = size
        if answers:
            some = pick(problems, slice(judged))
            errors[f"{name}, {ways[0]}"] = _traced_errors(made, some, answers[:judged])

    spent = take_turns(contenders, rounds)
    each = {name: 1e6 * t / sizes[name.split("/")[0]] for name, t in spent.items()}
    base = each.get("DAQP")

    def cells(name: str) -> list[str]:
        if name not in each:
            return ["", ""]
        ratio = "" if base is None else f"{np.median(each[name] / base):.1f}"
        return [f"{np.median(each[name]):.0f}", ratio]

    rows = []
    for name in sizes:
        times = cells(name) if name in compiled else cells(f"{name}/forward")
        rows.append([name, *times, *cells(f"{name}/gradient"), *_error_cells(errors.get(name))])
    notes = []
    if base is not None:
        notes.append(f"DAQP took {base.min():.1f} to {base.max():.1f} us in the {mine} rounds")
    if not single:
        notes += [f"not installed, left out: {name}" for name in missing + absent]
        notes.append(f"{count} problems judged, {timed} timed; of the JAX peers {slow}")
        if answers:
            kinks = sum(not truth.regular for truth in answers)
            notes.append(f"{kinks} of them sit at a kink and have no gradient to compare")
    check = _single_checks if single else _checks
    return Report(TITLE, COLUMNS, rows, check(each, errors, count), notes)


def _single_checks(
    each: dict[str, np.ndarray], errors: dict[str, Errors], count: int
) -> list[Check]:
    found = errors.get("ours f32, lax.map")
    if found is None:
        return []
    return [
        Check(
            "f32: share of first inputs off by more than 0.1 N",
            float(np.mean(found.first > 0.1)),
            "",
            0.01,
        ),
        Check("f32: first input, worst error", float(found.first.max()), "N"),
        Check(f"f32: says itself that it is not solved, of {count}", int(np.sum(~found.solved))),
        Check("f32: wrong in silence", int(np.sum((found.first > 0.1) & found.solved)), "", 0.0),
    ]


def _checks(each: dict[str, np.ndarray], errors: dict[str, Errors], count: int) -> list[Check]:
    checks = []

    def ratio(what: str, of: str, to: str, bar: float) -> None:
        if of in each and to in each:
            checks.append(Check(what, float(np.median(each[of] / each[to])), "x", bar))

    def best(what: str) -> str:
        return min(
            (f"ours f64, {how}/{what}" for how in ("lax.map", "vmap")),
            key=lambda name: np.median(each[name]),
        )

    ratio("forward to DAQP's ready solve", best("forward"), "DAQP", 5.0)
    ratio("value-and-gradient to DAQP's ready solve", best("gradient"), "DAQP", 6.0)
    ratio("a single compiled solve to DAQP's", "ours f64, one by one/forward", "DAQP", 8.0)
    for peer, bar in (("qpax e, kappa 1e-5", 6.0), ("jaxopt BoxOSQP 1e-5", 50.0)):
        mine, its = best("gradient"), [f"{peer}, {how}/gradient" for how in ("lax.map", "vmap")]
        its = [name for name in its if name in each]
        if its:
            other = min(its, key=lambda name: np.median(each[name]))
            slower = float(np.median(each[mine] / each[other]))
            checks.append(Check(f"value-and-gradient to {peer}", slower, "x", 1.0 / bar))
    found = errors.get("ours f64, lax.map")
    if found is not None:
        g = found.gradient
        checks += [
            Check(f"f64: not solved, of {count}", int(np.sum(~found.solved)), "", 0.0),
            Check("f64: first input, median error", float(np.median(found.first)), "N", 1e-8),
            Check("f64: first input, worst error", float(found.first.max()), "N", 1e-4),
            Check("f64: gradient, median error", float(np.median(g)), "", 1e-7),
            Check("f64: gradient, p95 error", float(np.quantile(g, 0.95)), "", 1e-6),
            Check("f64: gradient, worst error", float(g.max()), "", 1e-3),
        ]
    return checks


def main(arguments: list[str]) -> None:
    """Measure and print the report as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=500)
    parser.add_argument("--timed", type=int, default=100)
    parser.add_argument("--slow", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--single", type=Path, help="32 bits, the problems of this file")
    chosen = parser.parse_args(arguments)
    numbers = (chosen.timed, chosen.slow, chosen.rounds)
    setup_jax()
    if chosen.single:
        jax.config.update("jax_enable_x64", False)
        show(measure(pickle.loads(chosen.single.read_bytes()), True, *numbers))
        return
    work = prepare(chosen.problems)
    report = measure(work, False, *numbers)
    # 32 bits hold for a whole process: the MPC's own constants follow the setting, not the inputs
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "work"
        path.write_bytes(pickle.dumps(work))
        options = [f"--{name}={value}" for name, value in zip(NUMBERS, numbers, strict=True)]
        other = Report(**child("benchmarks.qp_layer", f"--single={path}", *options))
    show(
        report._replace(
            rows=[*report.rows, *other.rows[1:]],
            checks=[*report.checks, *other.checks],
            notes=[*report.notes, *other.notes],
        )
    )


if __name__ == "__main__":
    main(sys.argv[1:])
