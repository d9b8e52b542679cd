"""The closed loop: value and gradient of a rollout, its compile time, memory and many at once.

Each figure comes from a process of its own, with a compilation cache of its own: the first process
of a shape finds it empty and tells the cold compile time, the second tells the warm one and, as it
compiles next to nothing, how much memory the run itself takes.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.measuring import Check, Report, child, pin_one_core, show

GIB = 2.0**30


def _memory() -> float:
    """Most memory that this process has held so far [bytes]."""
    # ru_maxrss of a child is at least that of the process that started it
    status = Path("/proc/self/status").read_text()
    return 1024.0 * float(status.partition("VmHWM:")[2].split()[0])


def one(ticks: int, batch: int, repeats: int) -> dict[str, float]:
    """Seconds and bytes of value-and-gradient of `batch` rollouts of `ticks` ticks."""
    import jax
    import numpy as np

    from hector_jax.control.reference import named_command, standing_anchor
    from hector_jax.control.weights import nominal
    from hector_jax.core.runtime import setup_jax
    from hector_jax.grfm.effect import last_command
    from hector_jax.robot.model import load_robot
    from hector_jax.tuning.difftune import TuneConfig, tune_step
    from hector_jax.tuning.rollout import RolloutConfig, Scenario

    setup_jax()
    robot, command = load_robot(), named_command("straight")
    config = TuneConfig(rollout=RolloutConfig(ticks=ticks))
    scenario = Scenario(robot, command, standing_anchor(robot), last_command)
    weights = nominal()

    def run(weights):
        return tune_step(config, scenario, weights)

    if batch > 1:
        rng = np.random.default_rng(0)
        weights = jax.tree.map(
            lambda w: w * np.exp(rng.uniform(-0.3, 0.3, (batch, *w.shape))), weights
        )
        run = jax.vmap(run)
    start = time.perf_counter()
    lowered = jax.jit(run).lower(weights)
    trace_time = time.perf_counter() - start
    compiled = lowered.compile()
    compile_time = time.perf_counter() - start
    before, spent, result = _memory(), [], None
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(compiled(weights))
        spent.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = np.median(spent, axis=0)
    return {
        "trace": trace_time,
        "compile": compile_time,  # tracing included
        "wall": float(wall),
        "cpu": float(cpu),
        "memory": _memory(),
        "run_memory": _memory() - before,
        "buffers": float(compiled.memory_analysis().temp_size_in_bytes),
        "fallen": float(np.mean(np.asarray(result.fallen) > 0)),
        "residual": float(np.max(result.residual)),
        "finite": float(all(np.isfinite(g).all() for g in jax.tree.leaves(result.gradient))),
    }


def measure(lengths: list[int], batches: list[int]) -> Report:
    """Single rollouts of these lengths [ticks] on one core, then batches of 400 ticks on all.

    The first length is the one that is held against the times.
    """
    rows, found = [], {}

    def ask(ticks: int, batch: int, cache: str, *options: str, repeats: int = 1) -> dict:
        sizes = (f"--ticks={ticks}", f"--batch={batch}", f"--repeats={repeats}")
        return child("benchmarks.closed_loop", *sizes, *options, XDG_CACHE_HOME=cache)

    def note(name: str, told: dict) -> None:
        rows.append(
            [
                name,
                f"{told['wall']:.2f}",
                f"{told['cpu']:.2f}",
                f"{told['memory'] / GIB:.2f}",
                f"{told['run_memory'] / GIB:.3f}",
                f"{told['buffers'] / GIB:.3f}",
                f"{told['trace']:.1f}",
                f"{told['compile']:.1f}",
                f"{told['residual']:.0e}",
                f"{told['fallen']:.0%}",
            ]
        )

    with tempfile.TemporaryDirectory() as cache:
        for ticks in lengths:
            cold = ask(ticks, 1, cache, "--pin")
            warm = ask(ticks, 1, cache, "--pin", repeats=5 if ticks == lengths[0] else 1)
            found[ticks] = cold, warm
            note(f"1 rollout, {ticks} ticks, cold cache", cold)
            note(f"1 rollout, {ticks} ticks, warm cache", warm)
        many = {}
        for batch in batches:
            many[batch] = ask(400, batch, cache)
            note(f"{batch} rollouts at once, 400 ticks", many[batch])

    cold, warm = found[lengths[0]]
    checks = [
        Check("value-and-gradient of 400 ticks, one core", warm["cpu"], "s CPU", 0.4),
        Check("first compile", cold["compile"], "s", 20.0),
        Check("compile from the cache", warm["compile"], "s", 2.0),
    ]
    for shorter, longer in zip(lengths, lengths[1:], strict=False):
        for name, part in (("memory", "whole process"), ("buffers", "buffers alone")):
            what = f"memory of {longer} ticks to that of {shorter}, {part}"
            ratio = found[longer][1][name] / found[shorter][1][name]
            checks.append(Check(what, ratio, "x", 2.5))
    if many:
        few, most = batches[0], batches[-1]
        checks.append(Check(f"memory of {most} rollouts", many[most]["memory"] / GIB, "GiB", 6.0))
        slower = many[most]["wall"] / most / (many[few]["wall"] / few)
        checks.append(Check(f"a rollout among {most} to one among {few}", slower, "x", 1.2))
    columns = (
        "closed loop",
        "wall s",
        "CPU s",
        "process GiB",
        "run adds GiB",
        "buffers GiB",
        "trace s",
        "trace and compile s",
        "QP residual",
        "fallen",
    )
    return Report("Closed loop, value-and-gradient on the CPU", columns, rows, checks)


def main(arguments: list[str]) -> None:
    """One figure (`--ticks`), or all of them; prints JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ticks", type=int)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--pin", action="store_true")
    parser.add_argument("--lengths", type=int, nargs="+", default=[400, 2000, 10000])
    parser.add_argument("--batches", type=int, nargs="*", default=[64, 256])
    chosen = parser.parse_args(arguments)
    os.environ["JAX_PLATFORMS"] = "cpu"
    if chosen.ticks is None:
        show(measure(chosen.lengths, chosen.batches))
        return
    if chosen.pin:
        pin_one_core()
    print(json.dumps(one(chosen.ticks, chosen.batch, chosen.repeats)))


if __name__ == "__main__":
    main(sys.argv[1:])
