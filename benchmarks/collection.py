"""Collection in MJX: 1 kHz robot-steps per second of the whole closed loop, by batch size.

A batch is walked twice; the first pass compiles, the second is timed from the call that starts it
to the last walk on the host. Building the plants' models is told apart, as it is done once. The
jobs are those that `hector steps collect` draws, start-up included in the count.
"""

import argparse
import sys
import time

import jax

from benchmarks.measuring import Check, Report, show
from hector_jax.control.controller import WalkConfig
from hector_jax.core.runtime import setup_jax
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import first_tick, substeps
from hector_jax.sim.parallel import walk_batch

BAR = 0.7  # million robot-steps per second of 4096 walks at once, on one H200


def measure(batches: list[int], seconds: float, single: bool) -> Report:
    """Walk each batch; `single` is physics in 32 bits."""
    config, robot = WalkConfig(), load_robot()
    walked = round(seconds / config.gait.tick) - first_tick(config)
    bits = 32 if single else 64
    rows, checks = [], []
    for batch in batches:
        jobs, spent = draw_jobs(0, batch, seconds=seconds), []
        for _ in range(2):
            start = time.perf_counter()
            walks = walk_batch(config, robot, jobs, chunk=batch, single=single)
            built = time.perf_counter()
            falls = sum(bool(walk.fallen.any()) for walk in walks)
            spent.append(time.perf_counter() - built)
        rate = 1e-6 * batch * walked * substeps(config) / spent[1]
        rows.append(
            [
                f"{batch} walks of {seconds:g} s, physics in {bits} bits",
                f"{rate:.4f}",
                f"{spent[1]:.1f}",
                f"{spent[0] - spent[1]:.1f}",
                f"{built - start:.1f}",
                f"{falls / batch:.1%}",
            ]
        )
        bar = 1.0 / BAR if batch == 4096 and jax.default_backend() != "cpu" else None
        checks.append(Check(f"a million robot-steps, {batch} at once", 1.0 / rate, "s", bar))
    columns = ("collection", "million steps/s", "run s", "compile s", "models s", "fallen")
    return Report(f"Collection in MJX on {jax.devices()[0].device_kind}", columns, rows, checks)


def main(arguments: list[str]) -> None:
    """Measure and print JSON."""
    setup_jax()
    jax.config.update("jax_enable_compilation_cache", False)
    slow = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batches", type=int, nargs="+", default=[8, 32] if slow else [512, 4096])
    parser.add_argument("--seconds", type=float, default=0.2 if slow else 1.0, help="from t = 0")
    parser.add_argument("--bits", type=int, choices=(32, 64), default=64 if slow else 32)
    chosen = parser.parse_args(arguments)
    show(measure(chosen.batches, chosen.seconds, chosen.bits == 32))


if __name__ == "__main__":
    main(sys.argv[1:])
