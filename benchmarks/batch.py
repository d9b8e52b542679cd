"""Tuning in batches: beside single tunings, many at once, and over several devices.

On a CPU, tunings one after the other against the same in one batch, every core a device; both
compiled before. Many at once on whatever devices there are; and, with --devices, the same on some
of them: the same number in all (strong) and the same number on each (weak). Of several rules, the
first is used for these, and each is timed until its tunings are near the lowest loss of all rules.

    python -m benchmarks.batch --many 1024 --devices 1 2 4 --net data/grfm.npz
    python -m benchmarks.batch --singles 64 --lanes 1 4 0     # problems side by side on a core
    python -m benchmarks.batch --many 1024 --rules gauss_newton=20 relative=300
"""

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.measuring import Check, Report, show
from experiments.lib import all_devices, sample_weights
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax
from hector_jax.core.tree import stack
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect, load_net
from hector_jax.robot.model import load_robot
from hector_jax.tuning.batch import PER_CALL, BatchProblem, BatchScenario, lanes_of, tune_batch
from hector_jax.tuning.difftune import TuneConfig, Tuning, tune
from hector_jax.tuning.rollout import RolloutConfig, Scenario
from hector_jax.tuning.status import Stop

NAME = "straight"
DRAWN = 256  # different starts within x/1.5 of nominal; larger batches repeat them
BAR, EFFICIENCY = 0.6, 0.9
NEAR, FASTER = 1.01, 0.5  # of the lowest loss; of the time of another rule to it
SHARES = (0.5, 0.9, 1.0)  # of the tunings


class _Run(NamedTuple):
    wall: float  # [s]
    cpu: float  # [s] on all cores
    compiled: float  # [s] of the first call
    found: Any
    times: list[float]  # [s] on the clock at the start of a batch and after each call of the device


def _timed(first: Callable[[], Any], run: Callable[[], Any]) -> _Run:
    start = time.perf_counter()
    first()
    wall, cpu = time.perf_counter(), time.process_time()
    before, found = wall - start, run()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return _Run(wall, cpu, before, found, [])


def _lowest(found: Tuning) -> np.ndarray:
    """Return the lowest loss so far of each tuning (tunings, iterations + 1)."""
    history, count = found.history, found.history.iteration.max(axis=1)
    going = np.arange(history.iteration.shape[1]) <= count[:, None]
    losses = np.where(going & history.accepted, history.evaluation.loss, np.inf)
    return np.minimum.accumulate(losses, axis=1)


def _race(runs: Mapping[str, _Run]) -> tuple[list[str], list[Check]]:
    """Compare the times of rules until shares of the tunings are near the lowest loss of all."""
    lowest = {name: _lowest(run.found) for name, run in runs.items()}
    best = np.min([losses[:, -1] for losses in lowest.values()], axis=0)
    best, used = best[:, None], np.isfinite(best)  # a start may be refused
    notes, reached = [], {}
    for name, losses in lowest.items():
        away = losses > NEAR * best
        after = np.where(away[:, -1], np.inf, away.sum(axis=1))[used]
        after = np.quantile(after, SHARES, method="higher")
        marks = np.minimum(PER_CALL * np.arange(len(runs[name].times)), losses.shape[1])
        spent = np.interp(after + 1, marks, runs[name].times) - runs[name].times[0]
        reached[name] = np.where(np.isfinite(after), spent, np.inf)
        for share, count, seconds in zip(SHARES, after, reached[name], strict=True):
            what = f"{share:.0%} within {NEAR - 1:.0%} of the lowest"
            notes.append(f"{name}: {what} after {count:g} iterations, {seconds:.2f} s")
        for i in (i for i in (1, 2, 4, 6, 10, 20, 50, 100, 200, 300) if i < losses.shape[1]):
            half, most = np.quantile((losses / best)[used, i], (0.5, 0.9))
            notes.append(f"{name}: L by the lowest after {i}: median {half:.3f}, 90 % {most:.3f}")
    first, *others = reached
    checks = [
        Check(f"{first} to {other}, time until {share:.0%} are near", one / two, "x", FASTER)
        for other in others
        for share, one, two in zip(SHARES, reached[first], reached[other], strict=True)
    ]
    return notes, checks


def measure(
    configs: Mapping[str, TuneConfig],
    net: Path | None,
    singles: int,
    many: int,
    counts: list[int],
    lanes: list[int],
) -> Report:
    """Time tunings.

    Args:
        configs: by rule; all but the first are for many at once only.
        net: GRFM-Net to tune through; None takes the plain rigid body.
        singles: tunings to compare with as many single ones; 0 for no comparison.
        many: tunings at once; 0 for none.
        counts: numbers of devices for the table of efficiency.
        lanes: numbers of problems side by side that are compared with single ones; the first is
            held against the bar.
    """
    robot, command, config = load_robot(), named_command(NAME), next(iter(configs.values()))
    anchor = standing_anchor(robot)
    effect = last_command if net is None else as_effect(load_net(net, robot)[0])
    starts = sample_weights(nominal(), 1.5, min(DRAWN, max(singles, many, 1)))
    scenario = BatchScenario(command, anchor, np.asarray(0), config.loss, np.asarray(1.0))

    def start(i: int) -> Weights:
        return starts[i % len(starts)]

    def at_once(
        count: int, devices: list[jax.Device], lanes: int | None = None, config: TuneConfig = config
    ) -> _Run:
        problems = stack(
            [BatchProblem(start(i), stack([scenario]), np.asarray(1.0)) for i in range(count)]
        )
        phis, times = stack([effect]), []
        options = {"devices": devices, "lanes": lanes}
        options["report_progress"] = lambda *_: times.append(time.perf_counter())
        run = partial(tune_batch, config, robot, effects=phis, **options)
        # starts that are refused at once compile the same program
        refused = problems._replace(start=jax.tree.map(lambda w: w * np.nan, problems.start))
        told = _timed(lambda: (run(refused), times.clear()), lambda: run(problems))
        return told._replace(times=times)

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
    notes = [
        f"{config.rollout.ticks} ticks, {NAME}, starts within x/1.5 of nominal, {net or 'no net'}"
    ]
    if singles:
        model = Scenario(robot, command, anchor, effect)
        one = lambda i: tune(config, model, start(i))  # noqa: E731
        alone = _timed(lambda: one(0), lambda: [one(i) for i in range(singles)])
        told = [[i.evaluation.loss for i in t.iterations if i.accepted] for t in alone.found]
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
        runs = {name: at_once(many, devices, config=one) for name, one in configs.items()}
        rows += [of_batch(f"many, {name}", len(devices), many, run) for name, run in runs.items()]
        if len(runs) > 1:
            remarks, found = _race(runs)
            notes, checks = notes + remarks, checks + found
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
        f"{config.iterations} iterations",
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
    return Report(f"Tuning in batches on {kind}", columns, rows, checks, notes)


def main(arguments: list[str]) -> None:
    """Measure and print JSON."""
    setup_jax()
    if "--lanes" not in arguments:  # several need a CPU that is one device
        all_devices()
    slow = jax.default_backend() == "cpu"
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--singles", type=int, default=64 if slow else 0)
    parser.add_argument("--many", type=int, default=0 if slow else 1024)
    parser.add_argument("--devices", type=int, nargs="*", default=[])
    parser.add_argument("--lanes", type=int, nargs="+", default=[lanes_of(jax.default_backend())])
    parser.add_argument("--ticks", type=int, default=400)
    parser.add_argument("--net", type=Path)
    parser.add_argument("--rules", nargs="+", default=["gauss_newton=10"], help="RULE=ITERATIONS")
    parser.add_argument("--ridge", type=float, default=TuneConfig.ridge)
    chosen = parser.parse_args(arguments)
    if chosen.devices and not chosen.many:
        parser.error("--devices needs --many")
    shared = {"rollout": RolloutConfig(ticks=chosen.ticks), "ridge": chosen.ridge}
    rules = [rule.split("=") for rule in chosen.rules]
    configs = {n: TuneConfig(rule=n, iterations=int(count), **shared) for n, count in rules}
    counts = chosen.singles, chosen.many, chosen.devices, chosen.lanes
    show(measure(configs, chosen.net, *counts))


if __name__ == "__main__":
    main(sys.argv[1:])
