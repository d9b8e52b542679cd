"""Throughput on an accelerator by batch size: the QP layer in both precisions, and the closed loop.

Wall time of a whole batch, every call waited for, divided by its size.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable

import jax
import numpy as np

from benchmarks.measuring import Check, Report, child, show, take_turns
from benchmarks.problems import draw_problems, pick
from benchmarks.qp_layer import layer, ours
from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal
from hector_jax.core.runtime import setup_jax
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.tuning.batch import COMPILER_OPTIONS
from hector_jax.tuning.difftune import TuneConfig, tune_step
from hector_jax.tuning.rollout import Scenario

DRAWN = 256  # different problems; larger batches repeat them


def layer_times(batches: list[int], rounds: int) -> dict[str, list[float]]:
    """Microseconds per problem, forward and value-and-gradient, and share solved, by batch."""
    config, robot = WalkConfig(), load_robot()
    made, drawn = layer(config, robot, ours), draw_problems(config, robot, DRAWN)
    found = {}
    for batch in batches:
        problems = jax.device_put(pick(drawn, np.arange(batch) % DRAWN))
        forward, gradient = jax.jit(jax.vmap(made.forward)), jax.jit(jax.vmap(made.gradient))

        def call(run: Callable, problems=problems) -> Callable[[], object]:
            return lambda: jax.block_until_ready(run(problems))

        spent = take_turns(
            {"forward": call(forward), "gradient": call(gradient)}, rounds, time.perf_counter
        )
        solved = float(np.mean(forward(problems)[1]))
        each = [1e6 * float(np.median(t)) / batch for t in spent.values()]
        found[str(batch)] = [*each, solved]
    return found


def loop_time(batch: int) -> tuple[float, float]:
    """Seconds of value-and-gradient of `batch` rollouts of 400 ticks; share that fell."""
    config, robot = TuneConfig(), load_robot()
    scenario = Scenario(robot, named_command("straight"), standing_anchor(robot), last_command)
    rng = np.random.default_rng(0)
    weights = jax.tree.map(
        lambda w: w * np.exp(rng.uniform(-0.3, 0.3, (batch, *w.shape))), nominal()
    )
    run = jax.jit(
        jax.vmap(lambda weights: tune_step(config, scenario, weights)),
        compiler_options=COMPILER_OPTIONS,
    )
    result = jax.block_until_ready(run(weights))
    start = time.perf_counter()
    jax.block_until_ready(run(weights))
    return time.perf_counter() - start, float(np.mean(np.asarray(result.fallen) > 0))


def measure(batches: list[int], rollouts: int, rounds: int) -> Report:
    """Both precisions of the layer, then the closed loop in 64 bits."""
    options = ("--batches", *map(str, batches), f"--rounds={rounds}")
    # 32 bits in a process of its own, and first: this one will hold most of the device's memory
    single = child("benchmarks.throughput", "--single", *options)
    by_precision = {"f64": layer_times(batches, rounds), "f32": single}
    device = jax.devices()[0]
    rows, checks = [], []
    for name, bar in (("f64", 4.0), ("f32", 2.5)):
        for batch in batches:
            forward, gradient, solved = by_precision[name][str(batch)]
            rows.append(
                [
                    f"ours {name}, vmap, {batch}",
                    f"{forward:.2f}",
                    f"{gradient:.2f}",
                    f"{solved:.1%}",
                ]
            )
            if batch == 4096:
                what = f"value-and-gradient per problem, batch 4096, {name}"
                checks.append(Check(what, gradient, "us", bar))
    spent, fallen = loop_time(rollouts)
    checks.append(Check(f"{rollouts} rollouts of 400 ticks, value-and-gradient", spent, "s", 10.0))
    notes = [f"closed loop: {fallen:.0%} of the {rollouts} weight sets fell"]
    columns = ("QP layer", "forward us", "val+grad us", "solved")
    return Report(f"Throughput on {device.device_kind}", columns, rows, checks, notes)


def main(arguments: list[str]) -> None:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 4096, 16384])
    parser.add_argument("--rollouts", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--single", action="store_true", help="the layer in 32 bits alone")
    chosen = parser.parse_args(arguments)
    setup_jax()
    if chosen.single:
        jax.config.update("jax_enable_x64", False)
        print(json.dumps(layer_times(chosen.batches, chosen.rounds)))
        return
    show(measure(chosen.batches, chosen.rollouts, chosen.rounds))


if __name__ == "__main__":
    main(sys.argv[1:])
