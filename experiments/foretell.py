"""How far off is what a log foretells? Foretold and walked, over plants, commands, sets and robots.

One set of weights walks on a drawn plant, and its log foretells the walks of other sets there; then
these walk. The pairs are the calibration of `hector log foretell`:

    python experiments/foretell.py --robots hector=- quadruped=examples/quadruped/robot.toml

Sets are nominal, expert, and random steps from nominal, some of them towards `shipped`. The
calibration is of plants of hfs-varied, which no verdict uses: OUT/foretold.json is what the package
has. On plants of a verdict the report counts the intervals that hold what was walked.
"""

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import jax
import lib
import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import GROUPS as GROUPS_OF_NUMBERS
from hector_jax.control.parameters import TUNABLES, steps_between, weights_after
from hector_jax.control.reference import Command, named_command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import shipped
from hector_jax.core.console import bar, say
from hector_jax.core.environment import code_hash
from hector_jax.core.files import as_json, write_file
from hector_jax.core.inputs import InputError
from hector_jax.core.pool import workers
from hector_jax.core.tree_file import save_tree
from hector_jax.own.planner import call_planner
from hector_jax.own.program import program_of
from hector_jax.own.walk_log import Log
from hector_jax.own.walker import Walker, walker_engine
from hector_jax.report.report import markdown_table
from hector_jax.robot.description import Description
from hector_jax.robot.model import Robot, describe, load_robot
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import MOTOR_DELAY, Imperfections, hfs_with_motors, named_world, noisy
from hector_jax.store import tunings
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import metrics
from hector_jax.verdict.foretell import (
    ELSEWHERE,
    HERE,
    calibrated,
    foretell,
    interval,
    log_ratio,
    quantities,
    read_logged,
)

ROOT = Path(__file__).parents[1]
PACKAGED = ROOT / "hector_jax" / "verdict" / "foretold.json"
VERDICT = ROOT / "experiments" / "reports" / "verdict" / "verdict.json"
_LIMIT = 600.0  # [s] of a call of a program of the user
_OTHER_NOISE = 100_000  # from the seed of a walk to one with other noise on the same plant
SPREAD = 0.4  # standard deviation of a random step, in log-weights


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to walk."""

    robots: tuple[str, ...] = ("hector=-",)  # NAME=FILE, its TOML; - is HECTOR; empty: --add alone
    traj: tuple[str, ...] = ("straight", "c", "s", "sideways", "turn")
    engines: tuple[str, ...] = ("c",)
    world: str = "hfs-varied"  # of the plants; standin and standin-even are for verdicts
    plants: int = 24
    first_plant: int = 9200
    sets: int = 4  # that each log foretells
    logs: int = 1  # of each plant, each with a noise of its own, as the walks of the sets
    walker: Path | None = None  # program that walks with a controller of its own, and
    planner: Path | None = None  # that plans with it
    add: tuple[Path, ...] = ()  # foretell.json of earlier calls, whose pairs are taken in
    extend: bool = False  # the pairs of the package, instead of replacing them
    out: Path = Path("runs/foretell")


class Case(NamedTuple):
    """A log, and whose it is."""

    robot: str
    file: str
    engine: str
    traj: str
    world: str
    seed: int
    walker: Path | None
    planner: Path | None


class Pair(NamedTuple):
    """What a log foretold of a set, and what was walked: log ratios to the walk of the log."""

    robot: str
    engine: str
    traj: str
    world: str
    seed: int
    far: float  # see `foretell.distance`
    foretold: dict[str, float]
    walked: dict[str, float]
    unexplained: float = np.nan  # see `foretell.Foretold`
    logs: Sequence[Sequence[float]] = ()  # of L, by each of several logs: foretold, walked


def drawn_sets(
    robot: Robot, config: WalkConfig, seed: int, count: int, *, gains: bool = True
) -> list[Weights]:
    """Draw weight sets: nominal, expert, or random steps from nominal and of the integral gains.

    Half of HECTOR's go some way towards `shipped`, as a tuning does.
    """
    start, rng, sets = nominal(robot), np.random.default_rng(seed), []
    zero = np.asarray(steps_between(start, start))
    ours = robot.description == describe()
    way = np.asarray(steps_between(start, shipped())) if ours else zero
    for _ in range(count):
        steps, known = rng.normal(0.0, SPREAD, len(zero)), rng.random()
        if rng.random() < 0.5:
            steps = steps / 2.0 + rng.random() * way
        others = {
            name: TUNABLES[name].read(config.parameters(start))
            * float(np.exp(rng.normal(0.0, 0.5)))
            for name in GROUPS_OF_NUMBERS["integral"]
        }
        drawn = weights_after(start._replace(others=others if gains else {}), steps)
        published = nominal(robot) if known < 0.25 else expert(robot)
        sets.append(published if known < 0.375 else jax.tree.map(np.asarray, drawn))
    return sets


def plant_of(case: Case, description: Description) -> Imperfections:
    """Return the plant of a case.

    Those of a tuning on walks, of any motors, are called `drawn`; `shifted` are these with two
    standard deviations more mass and delay.
    """
    if case.world in ("drawn", "shifted"):
        plant = hfs_with_motors(case.seed, 0.4, description)._replace(estimator=noisy())
        if case.world == "drawn":
            return plant
        mass, delay = 0.08, MOTOR_DELAY[1] - MOTOR_DELAY[0]  # widths of uniform distributions
        more = 2.0 / np.sqrt(12.0)
        return plant._replace(mass=plant.mass + more * mass, delay=plant.delay + more * delay)
    family = metrics.family_of(case.world)
    return FAMILIES.get(family or "", partial(named_world, case.world))(case.seed, description)


def log_job(case: Case, logs: int, count: int) -> list[Pair]:
    """Walk logs and the sets that they foretell; those that fall make no pair."""
    robot = load_robot(None if case.file == "-" else Path(case.file))
    config, command = tunings.tune_config(robot), named_command(case.traj)
    plant, controller = plant_of(case, robot.description), config.rollout.walk
    program = case.walker and Walker(program_of(case.walker, _LIMIT))
    engine = walker_engine(program) if program else choose_engine(case.engine)
    call = case.planner and partial(call_planner, program_of(case.planner, _LIMIT))

    def walk(weights: Weights, other: int = 0) -> Any:
        job = Job(weights, command, plant, 4.0, case.seed + _OTHER_NOISE * other)
        return jax.device_get(next(engine.walk(None, controller, robot, [job])))

    walked, *sets = drawn_sets(robot, controller, case.seed, count + 1, gains=call is None)
    named = {str(i): weights for i, weights in enumerate(sets)}
    logged = [walk(walked, i if logs > 1 else 0) for i in range(1, logs + 1)]
    found, before = [], []
    try:
        for one in logged:
            log, score = _as_read(one, config, robot, command)
            before.append(quantities(score))
            options: dict[str, Any] = {"walked": walked, "call": call}
            found.append(foretell(config, robot, command, log, named, **options))
    except InputError as error:  # as the command would refuse it
        say(f"{case.robot}, {case.traj}, {case.seed}: {error}")
        return []
    pairs = []
    for name, weights in named.items():
        score = metrics.score(config.loss, walk(weights))
        if not score.fallen and not any(one.scores[name].fallen for one in found):
            after = quantities(score)
            each = [
                [
                    {x: log_ratio(new[x], old[x]) for x in new}
                    for new, old in (
                        (quantities(one.scores[name]), quantities(one.walked)),
                        (after, old),
                    )
                ]
                for one, old in zip(found, before, strict=True)
            ]
            far, unexplained = found[0].distances[name], max(one.unexplained for one in found)
            of_L = [[ratios["L"] for ratios in two] for two in each]
            said, came = each[0]
            labels = case.robot, case.engine, case.traj, case.world, case.seed, far
            pairs.append(Pair(*labels, said, came, unexplained, of_L))
    return pairs


def _as_read(
    walk: Any, config: TuneConfig, robot: Robot, command: Command
) -> tuple[Log, metrics.Score]:
    """Return log and score of a walk as the command reads them from its file."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        save_tree(path, walk, kind="trajectory", robot=robot)
        return read_logged(path, config, robot, command)


def calibration(pairs: Sequence[Pair], known: Mapping[str, Any]) -> dict[str, Any]:
    """Return the pairs by group, as `verdict.foretell` reads them.

    Args:
        pairs: new ones.
        known: groups to which they are added.
    """
    groups: dict[str, Any] = {"carried": carried_pairs(json.loads(VERDICT.read_text())["columns"])}
    for group in (HERE, ELSEWHERE):
        found = [p for p in pairs if is_here(p) == (group == HERE)]
        before = known.get(group, {"farthest": 0.0, "pairs": {}})
        rows = {
            name: [
                *before["pairs"].get(name, []),
                *(
                    [round(p.foretold[name], 4), round(p.walked[name], 4)]
                    for p in found
                    if np.isfinite(p.foretold[name] + p.walked[name])
                ),
            ]
            for name in (found[0].walked if found else before["pairs"])
        }
        largest = [before.get("largest", 0.0), *(p.unexplained for p in found)]
        groups[group] = {
            "farthest": max([before["farthest"], *(p.far for p in found)]),
            "largest": round(max(largest), 3),
            "several": several(found) or before.get("several", {}),
            "pairs": rows,
        }
    return {"code": code_hash(("verdict.foretell",)), "pairs": groups}


def several(pairs: Sequence[Pair]) -> dict[str, tuple[int, int]]:
    """Count the means of several logs' forecasts that intervals hold, by number of logs.

    The intervals are those of single logs of all other plants.

    Args:
        pairs: by one or more logs each.

    Returns:
        Means that held and all of them.
    """
    counts = {}
    for logs in range(1, 1 + max((len(pair.logs) for pair in pairs), default=0)):
        cases, held = [pair for pair in pairs if len(pair.logs) >= logs], 0
        for case in cases:
            known = [of_first_log(pair) for pair in pairs if pair.seed != case.seed]
            ends = np.mean([interval(said, known) for said, _ in case.logs[:logs]], axis=0)
            held += bool(ends[1] <= np.mean([came for _, came in case.logs[:logs]]) <= ends[2])
        counts[str(logs)] = held, len(cases)
    return counts


def of_first_log(pair: Pair) -> tuple[float, float]:
    """Return what a pair's first log foretold of L, and what was walked."""
    return pair.foretold["L"], pair.walked["L"]


def carried_pairs(columns: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return pairs of changes of L: the median in MuJoCo, and each plant of another column.

    `held` counts the walks that are held by the interval of the other set in all other columns.

    Args:
        columns: of verdict.json, the first one of HECTOR in MuJoCo.
    """
    first, *others = columns
    parts: dict[tuple[str, int], list[list[float]]] = {}
    for name, (i, column) in product(("expert", "shipped"), enumerate(others)):
        parts[name, i] = []
        for traj, sets in column["trajectories"].items():
            walked = changes_of(sets, name)
            here = changes_of(first["trajectories"][traj], name)[: len(walked)]
            median = round(float(np.median(here)), 4)
            parts[name, i] += [[median, round(float(x), 4)] for x in walked if np.isfinite(x)]
    held = 0
    for (name, i), part in parts.items():
        rest = [x for (other, j), more in parts.items() if name != other and i != j for x in more]
        ends = [(interval(here, rest), walked) for here, walked in part]
        held += sum(bool(one.low <= walked <= one.high) for one, walked in ends)
    pairs = [pair for part in parts.values() for pair in part]
    return {"held": [held, len(pairs)], "pairs": {"L": pairs}}


def changes_of(sets: Mapping[str, Any], name: str) -> np.ndarray:
    """Return the log ratios of L to that of nominal, by plant; of a column of verdict.json."""
    ours, nominal_ones = (np.array(sets[x]["L"]["by_seed"][:16]) for x in (name, "nominal"))
    return np.log(ours / nominal_ones)


def _row(pairs: Sequence[Pair]) -> list[str]:
    """Return the cells of some pairs: their number, bias, spread, signs, intervals that hold."""
    said, came = np.array([(p.foretold["L"], p.walked["L"]) for p in pairs]).T
    error, large = said - came, np.abs(came) > 0.05
    right = np.sign(said[large]) == np.sign(came[large])
    known = [calibrated(HERE if is_here(p) else ELSEWHERE).get("L", []) for p in pairs]
    ends = [interval(x, pairs) for x, pairs in zip(said, known, strict=True)]
    held = sum(low <= x <= high for x, (_, low, high) in zip(came, ends, strict=True))
    share = f"{100 * right.mean():.0f}" if large.any() else "-"
    return [str(len(said)), f"{error.mean():+.2f}", f"{error.std():.2f}", share, str(held)]


def is_here(pair: Pair) -> bool:
    """Tell whether a pair is of HECTOR in MuJoCo."""
    return (pair.robot, pair.engine) == ("hector", "c")


def main(flags: Flags) -> Path:
    """Walk, and write report.md, foretell.json and foretold.json."""
    robots = lib.named_files("robots", flags.robots).items()
    seeds = range(flags.first_plant, flags.first_plant + flags.plants)
    cases = [
        Case(name, file, engine, traj, flags.world, seed, flags.walker, flags.planner)
        for (name, file), engine, traj, seed in product(robots, flags.engines, flags.traj, seeds)
    ]
    pairs = [Pair(**pair) for path in flags.add for pair in json.loads(path.read_text())["pairs"]]
    with workers(flags.processes) as pool, bar("logs and what they foretell") as report_progress:
        running = [pool.submit(log_job, case, flags.logs, flags.sets) for case in cases]
        for done, job in enumerate(as_completed(running), 1):
            report_progress(done, len(cases), f"{len(pairs)} pairs")
            pairs += job.result()
    pairs = [pair for pair in pairs if pair.far]  # else it is the set of the log
    pairs.sort(key=lambda p: (p.robot, p.engine, p.traj, p.seed, p.far))
    known = json.loads(PACKAGED.read_text())["pairs"] if flags.extend else {}
    if metrics.family_of(flags.world) is None:
        write_file(flags.out / "foretold.json", as_json(calibration(pairs, known)).encode())
    labels = dict.fromkeys((p.robot, p.engine, p.traj) for p in pairs)
    each = {at: [p for p in pairs if (p.robot, p.engine, p.traj) == at] for at in labels}
    rows = [[*at, *_row(found)] for at, found in each.items()]
    head = ["robot", "engine", "trajectory", "pairs", "bias", "spread", "sign right [%]", "held"]
    text = (
        "Foretold less walked change of L against the walk of the log, natural logarithm: mean and "
        "standard deviation over plants and sets; the sign where L changes by more than 5 %; the "
        "pairs whose 90 % interval, by the calibration of the package, holds what was walked."
    )
    return lib.write_report(
        flags.out / "foretell.json",
        "What a log foretells, and what is walked",
        [text, markdown_table(head, rows, words=3)],
        {
            "flags": {k: str(v) for k, v in asdict(flags).items()},
            "pairs": [p._asdict() for p in pairs],
        },
    )


if __name__ == "__main__":
    lib.run(main, Flags)
