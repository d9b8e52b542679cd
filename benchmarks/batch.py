"""Tuning in batches: beside single tunings, many at once, and over several devices.

On a CPU, tunings of ten iterations one after the other against the same in one batch, every core a
device; both compiled before. Many at once on whatever devices there are; and, with --devices, the
same on some of them: the same number in all (strong) and the same number on each (weak).

    python -m benchmarks.batch --many 1024 --devices 1 2 4 --net data/grfm.npz
    python -m benchmarks.batch --singles 64 --lanes 1 4 0     # problems side by side on a core
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.measuring import Check, Report, show
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal, sample_weights
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import all_devices, setup_jax
from hector_jax.core.tree import stack
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.robot.model import load_robot
from hector_jax.tuning.batch import Problem, Scenario, lanes_of, tune_batch
from hector_jax.tuning.difftune import PAPER_ITERATIONS, TuneConfig, tune
from hector_jax.tuning.rollout import RolloutConfig
from hector_jax.tuning.status import Stop

NAME = "straight"
DRAWN = 256  # different starts within x/1.5 of nominal; larger batches repeat them
BAR, EFFICIENCY = 0.6, 0.9


class _Run(NamedTuple):
    wall: float  # [s]
    cpu: float  # [s] on all cores
    compiled: float  # [s] of the first call on top
    found: Any


def _timed(first: Callable[[], Any], run: Callable[[], Any]) -> _Run:
    start = time.perf_counter()
    first()
    wall, cpu = time.perf_counter(), time.process_time()
    before, found = wall - start, run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return _Run(wall, cpu, before, found)


def measure(
    config: TuneConfig,
    net: Path | None,
    singles: int,
    many: int,
    counts: list[int],
    lanes: list[int],
) -> Report:
    """Time tunings.

    Args:
        config: of each.
        net: GRFM-Net to tune through; None takes the plain rigid body.
        singles: tunings to compare with as many single ones; 0 for no comparison.
        many: tunings at once; 0 for none.
        counts: numbers of devices for the table of efficiency.
        lanes: numbers of problems side by side that are compared with single ones; the first is
            held against the bar.
    """
    robot, command = load_robot(), named_command(NAME)
    anchor = standing_anchor(robot)
    effect = last_command if net is None else as_effect(load_net(net, robot)[0])
    starts = sample_weights(nominal(), 1.5, min(DRAWN, max(singles, many, 1)))
    scenario = Scenario(command, anchor, np.asarray(0), config.loss, np.asarray(1.0))

    def start(i: int) -> Weights:
        return starts[i % len(starts)]

    def at_once(count: int, devices: list[jax.Device], lanes: int | None = None) -> _Run:
        problems = stack(
            [Problem(start(i), stack([scenario]), np.asarray(1.0)) for i in range(count)]
        )
        phis = stack([effect])
        run = partial(tune_batch, config, robot, problems, phis, devices=devices, lanes=lanes)
        told = _timed(run, run)
        return told._replace(compiled=told.compiled - told.wall)

    def row(what: str, used: int, count: int, told: _Run, left: Any, refused: Any) -> list[str]:
        """`left` are losses at the end by those at the start."""
        times = f"{told.wall:.2f}", f"{told.cpu:.2f}", f"{1e3 * told.wall / count:.2f}"
        down = f"{1 - np.median(left):.0%}"
        return [what, str(used), str(count), *times, f"{told.compiled:.0f}", down, f"{refused:.0%}"]

    def of_batch(what: str, used: int, count: int, told: _Run) -> list[str]:
        found = told.found
        left = np.where(
            found.stop == Stop.BAD_START, 1.0, found.loss / found.history.evaluation.loss[:, 0]
        )
        return row(what, used, count, told, left, np.mean(found.stop == Stop.BAD_START))

    devices, rows, checks = jax.devices(), [], []
    if singles:
        one = lambda i: tune(config, robot, start(i), command, anchor, effect)  # noqa: E731
        alone = _timed(lambda: one(0), lambda: [one(i) for i in range(singles)])
        told = [[i.evaluation.loss for i in t.history if i.accepted] for t in alone.found]
        then, now = (np.array([losses[i] for losses in told]) for i in (0, -1))
        rows.append(row("one after the other", 1, singles, alone, now / then, 0.0))
        for i, side in enumerate(lanes):
            told = at_once(singles, devices, side)
            way = {0: "all", 1: "none"}.get(side, str(side))
            what = f"one batch, {way} side by side"
            rows.append(of_batch(what, len(devices), singles, told))
            bar = BAR if i == 0 else None
            what = f"batch of {singles}, {way} side by side, to single ones"
            checks.append(Check(what, told.wall / alone.wall, "x", bar))
            apart = np.max(np.abs(told.found.loss / now - 1.0))
            checks.append(Check("largest relative difference of their losses", apart))
    if many and not counts:
        rows.append(of_batch("many", len(devices), many, at_once(many, devices)))
    base = None
    for used in counts:
        if used > len(devices):
            raise InputError(f"--devices {used}: there are {len(devices)}")
        strong = at_once(many, devices[:used])
        weak = at_once(many * used, devices[:used]) if used > 1 else strong
        base = base or strong.wall * used  # of one device, where the table begins with one
        rows.append(of_batch("strong", used, many, strong))
        if used > 1:
            rows.append(of_batch("weak", used, many * used, weak))
            for name, inverse in (
                ("strong", used * strong.wall / base),
                ("weak", weak.wall / base),
            ):
                what = f"1 / efficiency on {used} devices, {name}"
                checks.append(Check(what, inverse, "x", 1.0 / EFFICIENCY))
    columns = (
        "ten iterations",
        "devices",
        "tunings",
        "s",
        "CPU s",
        "ms each",
        "compile s",
        "L down",
        "refused",
    )
    kind = devices[0].device_kind
    notes = [
        f"{config.rollout.ticks} ticks, {NAME}, starts within x/1.5 of nominal, {net or 'no net'}"
    ]
    return Report(f"Tuning in batches on {kind}", columns, rows, checks, notes)


def main(arguments: list[str]) -> None:
    """Measure and print JSON."""
    setup_jax()
    all_devices()
    slow = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--singles", type=int, default=64 if slow else 0)
    parser.add_argument("--many", type=int, default=0 if slow else 1024)
    parser.add_argument("--devices", type=int, nargs="*", default=[])
    parser.add_argument("--lanes", type=int, nargs="+", default=[lanes_of(jax.default_backend())])
    parser.add_argument("--ticks", type=int, default=400)
    parser.add_argument("--net", type=Path)
    chosen = parser.parse_args(arguments)
    if chosen.devices and not chosen.many:
        parser.error("--devices needs --many")
    config = TuneConfig(rollout=RolloutConfig(ticks=chosen.ticks), iterations=PAPER_ITERATIONS)
    counts = chosen.singles, chosen.many, chosen.devices, chosen.lanes
    show(measure(config, chosen.net, *counts))


if __name__ == "__main__":
    main(sys.argv[1:])
