"""Do gradients through the model beat what needs walks on the simulator? The race.

DiffTune with and without GRFM-Net, Adam in log-weights through the net, CMA-ES, Bayesian
optimisation (in the whole box, and near the start), random draws, and DiffTune's step along forward
differences on the simulator: from the nominal weights, in one box, judged by the loss on the
high-fidelity simulator (hfs), against walks there and against seconds.

    python experiments/race.py --traj s --out runs/race

What is random is repeated with other seeds. All go in lock-step, so that a round is one batch in
MJX, or walks on the processes. Everything is kept under OUT and taken up again.
"""

import shutil
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import optimizers
import plots
import tyro
from lib import write_report
from lockstep import BenchmarkResult, Round, benchmark, lowest, walks
from optimizers import Bayes, CmaEs, Differences, Given, Optimizer, Random, Steps, adam, steps_to

from hector_jax.control.reference import Command, named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import bar, exit_code, say
from hector_jax.core.environment import environment
from hector_jax.core.files import make_folder, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, Range, check, read_json
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.network import Params, effect_of, load_net
from hector_jax.grfm.training import TrainConfig
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import nets, searches
from hector_jax.runs.cache import content_key, robot_hash
from hector_jax.runs.setup import Setup
from hector_jax.search.cmaes import Generation, SearchConfig
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning import difftune
from hector_jax.tuning.difftune import Iteration, TuneConfig
from hector_jax.tuning.rollout import RolloutConfig

MARKS = (25, 50, 100, 200)  # the table has the lowest loss after so many walks
ON_MODEL = ("without", "with", "adam")
WITH_NET = ("with", "adam")
NEAR = 3.0  # log-weights: a factor of 20 up and down
# modules that decide the numbers
CODE = ("search.cmaes", "tuning.difftune", "grfm.network", "sim.walk", "sim.parallel")
OPTIMIZERS = Path(optimizers.__file__).read_text()  # part of the cache keys, as CODE
RATE = 0.05  # of Adam, in log-weights: DiffTune's step in Q


@dataclass(frozen=True)
class Flags:
    """What to race."""

    traj: str = "s"  # straight, c or s
    rollouts: int = 200  # walks on the simulator, of each method and repeat
    repeats: int = 3  # seeds of what is random
    ticks: int = 400  # of a walk, 10 ms each
    batch: int = 10  # walks in a round, of each method and repeat
    net: Path | None = None  # by default made here and timed, in OUT/data
    out: Path = Path("runs/race")  # folder of the report
    engine: str = "auto"  # c (MuJoCo, on the processes), mjx (all at once), auto: mjx on a GPU
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        count = AT_LEAST_ONE
        check(self, rollouts=count, repeats=count, ticks=count, batch=Range(4), processes=count)


class ModelRun(NamedTuple):
    """Accepted weights of a method on the model, in their order."""

    steps: list[list[float]]  # in 18 log-weights
    seconds: list[float]  # computing time until each, including rejected iterations
    compiling: float  # [s], not in `seconds`
    iterations: int  # number, including the rejected
    iteration: float  # [s] mean time


class Prices(NamedTuple):
    """Seconds of one core, measured on this machine."""

    walk: float  # of a walk on the hfs in MuJoCo C, as long as those of the race
    iterations: dict[str, float]  # of an iteration on the model with its gradient, by method
    collection: float  # of the walks for the net, and of the plain tunings before them
    training: float  # of the net; zero if the net was given


class Repeat(NamedTuple):
    """A repeat of a method."""

    rounds: list[Round]
    lowest: np.ndarray  # loss after each walk, first that of the start
    seconds: np.ndarray  # of one core after each walk


class Results(NamedTuple):
    """Contents of the report."""

    engine: str
    start: float  # loss
    methods: dict[str, list[Repeat]]
    model: dict[str, ModelRun]
    prices: Prices
    took: dict[str, float] | None  # [s] collection and training; None if the net was given


def _model_job(
    method: str, config: TuneConfig, robot: Robot, command: Command, params: Params | None
) -> ModelRun:
    effect = effect_of(params, config.rollout.walk)
    start, anchor, begin = nominal(), standing_anchor(robot), time.monotonic()
    first = difftune.tune_step(config, robot, start, command, anchor, effect)
    jax.block_until_ready(first)
    compiled = time.monotonic()
    rows: list[tuple[Iteration, float]] = []
    record = lambda iteration: rows.append((iteration, time.monotonic() - compiled))  # noqa: E731
    if method == "adam":
        adam(config, RATE, robot, start, command, anchor, effect, record)
    else:
        difftune.tune(config, robot, start, command, anchor, effect, record)
    accepted = [(i.weights, seconds) for i, seconds in rows[1:] if i.accepted]
    return ModelRun(
        [steps_to(start, weights).tolist() for weights, _ in accepted],
        [seconds for _, seconds in accepted],
        compiled - begin,
        len(rows),
        rows[-1][1] / len(rows),
    )


def _price_job(config: TuneConfig, robot: Robot, command: Command) -> float:
    """Measure the seconds of a compiled walk, as the mean of three."""
    seconds = config.rollout.ticks * config.rollout.walk.gait.tick
    job = Job(nominal(), command, hfs(), seconds)
    walk(config.rollout.walk, robot, job)
    begin = time.monotonic()
    for _ in range(3):
        walk(config.rollout.walk, robot, job)
    return (time.monotonic() - begin) / 3


def _propose_job(
    optimizer: Optimizer, start: Weights, past: Sequence[Generation]
) -> tuple[Steps, float]:
    begin = time.monotonic()
    return optimizer.ask(start, past), time.monotonic() - begin


def prepare(pool: Executor, flags: Flags, robot: Robot) -> tuple[Params, dict[str, float] | None]:
    """Return the net, and the times of its making [s]; None if the net was given."""
    if flags.net is not None:
        return load_net(flags.net, robot, TrainConfig().variant)[0], None
    folder, part = flags.out / "data", flags.out / "data.part"
    if not folder.exists():
        shutil.rmtree(part, ignore_errors=True)  # after an interruption its seconds are unknown
        begin = time.monotonic()
        nets.collect(pool, nets.CollectConfig(), robot, part / "walks")  # see `load_or_train`
        collected = time.monotonic()
        path = nets.net_path(part, TrainConfig().variant)
        nets.train(TrainConfig(), robot, part / "walks", path)
        seconds = {"collection": collected - begin, "training": time.monotonic() - collected}
        write_json(part / "seconds.json", seconds)
        part.rename(folder)
    took = read_json(folder / "seconds.json", "the seconds of a collection and a training")
    return nets.load_or_train(pool, robot, folder).params, took


def on_model(
    pool: Executor,
    flags: Flags,
    config: TuneConfig,
    robot: Robot,
    command: Command,
    params: Params,
) -> tuple[dict[str, ModelRun], float]:
    """Run the methods on the model and measure the seconds of a walk; cached under OUT."""
    # the seconds depend on the commit and on the number of processes
    about = repr((flags.processes, environment().get("commit")))
    key = content_key(config, RATE, command, params, robot, about, OPTIMIZERS, code=CODE)
    path = flags.out / f"model-{key}.json"
    if not path.exists():
        with bar("tuning on the model, and the price of a walk") as report_progress:
            report_progress(0, len(ON_MODEL), "compiling")
            price = pool.submit(_price_job, config, robot, command).result()
            running = {}
            for name in ON_MODEL:
                net = params if name in WITH_NET else None
                running[name] = pool.submit(_model_job, name, config, robot, command, net)
            runs = {name: future.result()._asdict() for name, future in running.items()}
        write_json(path, {"walk": price, "courses": runs})
    data = read_json(path, "runs on the model")
    return {name: ModelRun(**data["courses"][name]) for name in ON_MODEL}, data["walk"]


def all_contestants(
    flags: Flags, config: TuneConfig, model: Mapping[str, ModelRun]
) -> dict[str, dict[str, Optimizer]]:
    """Return all optimizers, by method and repeat."""
    size, seeds = flags.batch, range(flags.repeats)
    budget = max(flags.rollouts // size, 1) * size
    random = {
        "cma-es": lambda seed: CmaEs(SearchConfig(budget, size, seed)),
        "bayes near": lambda seed: Bayes(seed, NEAR, most=size),
        "bayes": lambda seed: Bayes(seed, most=size),
        "random": lambda seed: Random(seed, most=size),
    }
    return {
        **{n: {n: Given(tuple(map(tuple, run.steps)), size)} for n, run in model.items()},
        "differences": {"differences": Differences(config)},
        **{name: {f"{name} {i}": make(i) for i in seeds} for name, make in random.items()},
    }


def race(
    pool: Executor,
    flags: Flags,
    config: TuneConfig,
    robot: Robot,
    command: Command,
    engine: Engine,
    contestants: Mapping[str, Optimizer],
) -> BenchmarkResult:
    """Run the race, continuing its journal."""
    size = sum(optimizer.most for optimizer in contestants.values())
    about = {
        "trajectory": flags.traj,
        "engine": engine.name,
        "ticks": config.rollout.ticks,
        "controller": repr(config.rollout.walk),
        "loss": repr(config.loss),
        "robot": robot_hash(robot),
        "plant": tree_hash(hfs()),
        "command": tree_hash(command),
        "start": tree_hash(nominal()),
        "settings": content_key(sorted(contestants.items()), OPTIMIZERS, code=CODE),
    }

    def propose(
        inputs: Mapping[str, tuple[Optimizer, Weights, Sequence[Generation]]],
    ) -> dict[str, tuple[Steps, float]]:
        running = {name: pool.submit(_propose_job, *row) for name, row in inputs.items()}
        return {name: future.result() for name, future in running.items()}

    def walk(sets: Mapping[str, Sequence[Weights]]) -> dict[str, np.ndarray]:
        commands = dict.fromkeys(sets, command)
        setup, options = Setup(pool, config, robot), {"engine": engine, "at_once": size}
        return searches.losses_on_hfs(setup, sets, commands=commands, **options)

    with bar(f"racing on the high-fidelity simulator, engine {engine.name}") as report_progress:

        def on_round(result: BenchmarkResult) -> None:
            done = sum(map(walks, result.rounds.values()))
            best = {n: lowest(result.start, rounds)[-1] for n, rounds in result.rounds.items()}
            first = min(best, key=best.__getitem__)
            message = f"first {first}, L {best[first] / 1e6:.3f}e6" if done else "compiling"
            report_progress(done, flags.rollouts * len(contestants), message)

        return benchmark(
            contestants,
            nominal(),
            flags.rollouts,
            propose=propose,
            walk=walk,
            path=flags.out / "race.jsonl",
            about=about,
            on_round=on_round,
        )


def seconds_spent(
    name: str, rounds: Sequence[Round], model: Mapping[str, ModelRun], prices: Prices
) -> np.ndarray:
    """Return the seconds of one core after each walk, first that of the start."""
    if name in model:
        computing = np.diff([0.0, *model[name].seconds[: walks(rounds)]])
    else:
        parts = [np.full(n := len(r.generation.losses), r.seconds / n) for r in rounds]
        computing = np.concatenate([np.zeros(0), *parts])
    before = prices.collection + prices.training if name in WITH_NET else 0.0
    return before + np.concatenate([[0.0], np.cumsum(computing + prices.walk)])


def main() -> None:
    """Write report.md, race.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    command, engine = named_command(flags.traj), choose_engine(flags.engine)
    if not all(find_spec(package) for package in ("cmaes", "sklearn")):
        raise InputError('the race needs its extra: pip install "hector-jax[race]"')
    make_folder(flags.out)
    robot = jax.tree.map(np.asarray, load_robot())
    config = TuneConfig(RolloutConfig(ticks=flags.ticks), iterations=flags.rollouts)
    with workers(flags.processes) as pool:
        params, took = prepare(pool, flags, robot)
        params = jax.tree.map(np.asarray, params)
        model, walk = on_model(pool, flags, config, robot, command, params)
        methods = all_contestants(flags, config, model)
        contestants = {k: v for repeats in methods.values() for k, v in repeats.items()}
        result = race(pool, flags, config, robot, command, engine, contestants)
    full = RolloutConfig().ticks / flags.ticks  # walks and tunings of the collection have 4 s
    plain = model["without"]
    prices = Prices(
        walk,
        {name: run.iteration for name, run in model.items()},
        full * (nets.CollectConfig.walks * walk + 3 * plain.iterations * plain.iteration),
        took["training"] if took else 0.0,
    )

    def repeat(method: str, name: str) -> Repeat:
        rounds = result.rounds[name]
        seconds = seconds_spent(method, rounds, model, prices)
        return Repeat(rounds, lowest(result.start, rounds), seconds)

    repeats = {m: [repeat(m, name) for name in contestants] for m, contestants in methods.items()}
    path = report(flags, Results(engine.name, result.start, repeats, model, prices, took))
    say(f"the report is {path}")


def _millions(losses: Sequence[float]) -> str:
    """Format the median of losses and, of several, their range [1e6]."""
    median = f"{statistics.median(losses) / 1e6:.3f}"
    if len(losses) == 1:
        return median
    return f"{median} [{min(losses) / 1e6:.3f}, {max(losses) / 1e6:.3f}]"


def as_numbers(flags: Flags, results: Results) -> dict[str, dict[str, Any]]:
    """Return the numbers of the methods for race.json."""
    marks = [mark for mark in MARKS if mark < flags.rollouts] + [flags.rollouts]
    return {
        method: {
            "best": {
                str(mark): [float(r.lowest[min(mark, len(r.lowest) - 1)]) for r in repeats]
                for mark in marks
            },
            "walks": [walks(r.rounds) for r in repeats],
            "seconds": [float(r.seconds[-1]) for r in repeats],
            "losses": [
                [x for part in r.rounds for x in part.generation.losses.tolist()] for r in repeats
            ],
            "spent": [r.seconds.tolist() for r in repeats],
            "last": [float(r.rounds[-1].generation.losses[-1]) for r in repeats if r.rounds],
        }
        for method, repeats in results.methods.items()
    }


def report(flags: Flags, results: Results) -> Path:
    """Write the report with its pictures and its numbers as JSON; returns its path."""
    numbers = as_numbers(flags, results)
    rows = [
        [
            plots.METHODS[method],
            str(len(results.methods[method])),
            *map(_millions, row["best"].values()),
            _millions(row["last"]) if method in results.model and row["last"] else "",
            f"{statistics.median(row['walks']):g}",
            f"{statistics.median(row['seconds']):.0f}",
        ]
        for method, row in numbers.items()
    ]
    marks = next(iter(numbers.values()))["best"]
    head = ["method", "repeats", *(f"after {m}" for m in marks), "its own last", "walks", "s"]
    by_walks, by_seconds = (
        {m: [(x(r), r.lowest) for r in repeats] for m, repeats in results.methods.items()}
        for x in (lambda r: np.arange(len(r.lowest), dtype=float), lambda r: r.seconds)
    )
    out = flags.out
    abscissa = "walks on the high-fidelity simulator"
    captions = {
        "rollouts.png": plots.race(out / "rollouts.png", by_walks, abscissa),
        "seconds.png": plots.race(out / "seconds.png", by_seconds, "seconds of one core")
        + " The methods with the net begin after its walks and its training.",
    }
    data = {
        "flags": {n: str(v) for n, v in asdict(flags).items()},
        "engine": results.engine,
        "start": results.start,
        "prices": results.prices._asdict(),
        "took": results.took,
        "courses": {name: run._asdict() for name, run in results.model.items()},
        "methods": numbers,
    }
    return write_report(
        out / "report.md",
        "The race",
        _text(flags, results, markdown_table(head, rows)),
        numbers=data,
        json_name="race.json",
        pictures=captions,
    )


def _text(flags: Flags, results: Results, table: str) -> list[str]:
    prices, took, start = results.prices, results.took, results.start
    iterations = ", ".join(
        f"{plots.METHODS[n]} {prices.iterations[n]:.2f} s ({run.iterations} of them; compiling "
        f"took {run.compiling:.0f} s and is not counted)"
        for n, run in results.model.items()
    )
    made = (
        f"On this machine, {flags.processes} processes, collection took {took['collection']:.0f} s "
        f"and training {took['training']:.0f} s, compiling included."
        if took
        else f"The net was taken from {flags.net}; **its training is not in the seconds**."
    )
    return [
        f"Trajectory {flags.traj}, {flags.ticks} ticks, engine {results.engine}. Lowest L [1e6] on "
        f"the high-fidelity simulator so far; all start from the nominal weights, "
        f"{start / 1e6:.3f}, "
        "and stay in one box. What is random: median over the repeats, and their range.",
        table,
        "## What is counted",
        f"- **Walks.** Every walk counts but that of the start. The three that follow the model "
        "learn nothing from theirs: each iterate that they accept is walked once, to be judged. "
        "`its own last` is the loss of the iterate at which they end, without a choice by the "
        f"simulator. The net has seen {nets.CollectConfig.walks} walks before, of all "
        "trajectories, which are in the seconds and not in the walks.",
        f"- **Seconds** are of one core: a walk {prices.walk:.2f} s (MuJoCo C, the mean of three "
        "on this machine, whatever engine raced); what a method thought, measured; an iteration on "
        f"the model with its gradient: {iterations}. The methods with the net begin "
        f"{prices.collection + prices.training:.0f} s late: {prices.collection:.0f} s for its "
        "walks and the three plain tunings that they follow, each priced as the plain one here, "
        f"and {prices.training:.0f} s of training, all of it, though one net serves every "
        "trajectory. " + made,
        f"- **Rounds.** All go in lock-step, {flags.batch} walks a round. Bayesian optimisation is "
        "scikit-learn's Gaussian process (Matern 5/2, a length for each weight, noise, on log L) "
        "and the largest expected improvement, a round chosen by constant liar with the lowest "
        "loss; its first round is that of the random draws, normal about the start with deviation "
        f"1 in log-weights, as are those of CMA-ES. `near` may leave the start by a factor of "
        f"{np.exp(NEAR):.0f}. Differences: 18 forward differences of 5 %, then DiffTune's step, "
        "halved while the loss rises.",
    ]


if __name__ == "__main__":
    sys.exit(exit_code("race", main))
