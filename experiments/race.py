"""Do gradients through the model beat what needs walks on the simulator? The race.

DiffTune with and without GRFM-Net, Adam in log-weights through the net, CMA-ES, Bayesian
optimisation (in the whole box, and near the start), random draws, and DiffTune's step along forward
differences on the simulator: from the nominal weights, in one box, judged by the loss on the
high-fidelity simulator (hfs), against walks there and against seconds.

    python experiments/race.py --traj s --out runs/race

What is random is repeated with other seeds. All go in lock-step, so that a round is one batch in
MJX, or walks on the processes. Everything is kept under OUT and taken up again.
"""

import json
import shutil
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import plots
import tyro

from hector_jax.control.reference import Command, named_command, standing_anchor
from hector_jax.control.weights import Weights, nominal
from hector_jax.core.console import bar, exit_code, made_at, say
from hector_jax.core.environment import environment
from hector_jax.core.files import make_folder, write_file, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.tree_file import tree_hash
from hector_jax.grfm.network import Params, effect_of, load_net
from hector_jax.grfm.training import TrainConfig
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import nets, searches
from hector_jax.runs.cache import content_key, robot_hash
from hector_jax.search.cmaes import Generation, SearchConfig
from hector_jax.search.race import Raced, Turn, lowest, race, walks
from hector_jax.search.rivals import (
    Bayes,
    CmaEs,
    Differences,
    Given,
    Random,
    Rival,
    Steps,
    adam,
    steps_to,
)
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning import difftune
from hector_jax.tuning.difftune import Iteration, TuneConfig
from hector_jax.tuning.rollout import RolloutConfig

MARKS = (25, 50, 100, 200)  # walks after which the table tells the lowest loss
ON_MODEL = ("without", "with", "adam")
WITH_NET = ("with", "adam")
NEAR = 3.0  # log-weights: a factor of 20 either way
CODE = ("tuning.rivals", "grfm.network", "sim.walk")  # that decides the numbers
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
        for name, least in {"rollouts": 1, "repeats": 1, "batch": 4, "processes": 1}.items():
            if getattr(self, name) < least:
                raise InputError(f"--{name} must be at least {least}, got {getattr(self, name)}")


class Course(NamedTuple):
    """Weights that a method found on the model, one after the other, without those refused."""

    steps: list[list[float]]  # in 18 log-weights
    seconds: list[float]  # on the model, until each; what was refused is paid for too
    compiling: float  # [s], before
    iterations: int  # of the model, refused ones too
    iteration: float  # [s] each


class Prices(NamedTuple):
    """Seconds of one core, measured here."""

    walk: float  # on the hfs in MuJoCo C, as long as those of the race
    iterations: dict[str, float]  # on the model with its gradient, by method
    collection: float  # for the net: its walks, and the plain tunings that they follow
    training: float  # of the net; zero where it was made before


def _course_job(
    method: str, config: TuneConfig, robot: Robot, command: Command, params: Params | None
) -> Course:
    effect = effect_of(params, config.rollout.walk.gait)
    start, anchor, begin = nominal(), standing_anchor(robot), time.monotonic()
    first = difftune.tune_step(config, robot, start, command, anchor, effect)
    jax.block_until_ready(first)
    compiled = time.monotonic()
    told: list[tuple[Iteration, float]] = []
    note = lambda iteration: told.append((iteration, time.monotonic() - compiled))  # noqa: E731
    if method == "adam":
        adam(config, RATE, robot, start, command, anchor, effect, note)
    else:
        difftune.tune(config, robot, start, command, anchor, effect, note)
    kept = [(i.weights, seconds) for i, seconds in told[1:] if i.accepted]
    return Course(
        [steps_to(start, weights).tolist() for weights, _ in kept],
        [seconds for _, seconds in kept],
        compiled - begin,
        len(told),
        told[-1][1] / len(told),
    )


def _price_job(config: TuneConfig, robot: Robot, command: Command) -> float:
    """Seconds of a walk, the mean of three, when all is compiled."""
    seconds = config.rollout.ticks * config.rollout.walk.gait.tick
    job = Job(nominal(), command, hfs(), seconds)
    walk(config.rollout.walk, robot, job)
    begin = time.monotonic()
    for _ in range(3):
        walk(config.rollout.walk, robot, job)
    return (time.monotonic() - begin) / 3


def _think_job(rival: Rival, start: Weights, past: Sequence[Generation]) -> tuple[Steps, float]:
    begin = time.monotonic()
    return rival.ask(start, past), time.monotonic() - begin


def prepare(pool: Executor, flags: Flags, robot: Robot) -> tuple[Params, dict[str, float] | None]:
    """The net, and how long it took [s] where it was made here."""
    if flags.net is not None:
        return load_net(flags.net, robot, TrainConfig().variant)[0], None
    folder, part = flags.out / "data", flags.out / "data.part"
    if not folder.exists():
        shutil.rmtree(part, ignore_errors=True)  # a cut would leave its seconds unknown
        begin = time.monotonic()
        nets.collect(pool, nets.CollectConfig(), robot, part / "walks")  # see `ground`
        collected = time.monotonic()
        path = nets.net_path(part, TrainConfig().variant)
        nets.train(TrainConfig(), robot, part / "walks", path)
        took = {"collection": collected - begin, "training": time.monotonic() - collected}
        write_json(part / "seconds.json", took)
        part.rename(folder)
    took = json.loads((folder / "seconds.json").read_text())
    return nets.ground(pool, robot, folder).params, took


def on_model(
    pool: Executor,
    flags: Flags,
    config: TuneConfig,
    robot: Robot,
    command: Command,
    params: Params,
) -> tuple[dict[str, Course], float]:
    """Courses of the methods that follow the model, and the seconds of a walk; kept under OUT."""
    # seconds are kept too: they are of this code and so many at once
    made = flags.processes, environment().get("commit")
    key = content_key(config, RATE, command, params, robot, repr(made), code=CODE)
    path = flags.out / f"model-{key}.json"
    if not path.exists():
        with bar("tuning on the model, and the price of a walk") as tell:
            tell(0, len(ON_MODEL), "compiling")
            price = pool.submit(_price_job, config, robot, command).result()
            running = {
                name: pool.submit(
                    _course_job, name, config, robot, command, params if name in WITH_NET else None
                )
                for name in ON_MODEL
            }
            told = {name: future.result()._asdict() for name, future in running.items()}
        write_json(path, {"walk": price, "courses": told})
    told = json.loads(path.read_text())
    return {name: Course(**told["courses"][name]) for name in ON_MODEL}, told["walk"]


def entrants(
    flags: Flags, config: TuneConfig, courses: Mapping[str, Course]
) -> dict[str, dict[str, Rival]]:
    """All who race, by method and repeat."""
    size, seeds = flags.batch, range(flags.repeats)
    budget = max(flags.rollouts // size, 1) * size
    given = {n: Given(tuple(map(tuple, course.steps)), size) for n, course in courses.items()}
    drawn = {
        "cma-es": lambda seed: CmaEs(SearchConfig(budget, size, seed)),
        "bayes near": lambda seed: Bayes(seed, NEAR, most=size),
        "bayes": lambda seed: Bayes(seed, most=size),
        "random": lambda seed: Random(seed, most=size),
    }
    return {
        **{name: {name: rival} for name, rival in given.items()},
        "differences": {"differences": Differences(config)},
        **{name: {f"{name} {i}": make(i) for i in seeds} for name, make in drawn.items()},
    }


def run(
    pool: Executor,
    flags: Flags,
    config: TuneConfig,
    robot: Robot,
    command: Command,
    engine: Engine,
    rivals: Mapping[str, Rival],
) -> Raced:
    """The race, taking up its record."""
    size = sum(rival.most for rival in rivals.values())
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
        "settings": content_key(sorted(rivals.items()), code=CODE),
    }

    def think(
        asked: Mapping[str, tuple[Rival, Weights, Sequence[Generation]]],
    ) -> dict[str, tuple[Steps, float]]:
        running = {name: pool.submit(_think_job, *known) for name, known in asked.items()}
        return {name: future.result() for name, future in running.items()}

    def walk(sets: Mapping[str, Sequence[Weights]]) -> dict[str, np.ndarray]:
        every = {flags.traj: [weights for each in sets.values() for weights in each]}
        told = searches.losses_on_hfs(pool, config, robot, every, engine=engine, at_once=size)[
            flags.traj
        ]
        ends = np.cumsum([len(each) for each in sets.values()])
        return dict(zip(sets, np.split(told, ends[:-1]), strict=True))

    with bar(f"racing on the high-fidelity simulator, engine {engine.name}") as tell:

        def on_round(raced: Raced) -> None:
            done = sum(map(walks, raced.turns.values()))
            best = {name: lowest(raced.start, turns)[-1] for name, turns in raced.turns.items()}
            first = min(best, key=best.__getitem__)
            remark = f"first {first}, L {best[first] / 1e6:.3f}e6" if done else "compiling"
            tell(done, flags.rollouts * len(rivals), remark)

        path = flags.out / "race.jsonl"
        return race(rivals, nominal(), flags.rollouts, think, walk, path, about, on_round)


def paid(
    name: str,
    turns: Sequence[Turn],
    courses: Mapping[str, Course],
    prices: Prices,
) -> np.ndarray:
    """Seconds of one core after each walk, that of the start first."""
    count = walks(turns)
    if name in courses:
        thought = np.diff([0.0, *courses[name].seconds[:count]])
    else:
        each = [np.full(len(t.walked.losses), t.seconds / len(t.walked.losses)) for t in turns]
        thought = np.concatenate([np.zeros(0), *each])
    before = prices.collection + prices.training if name in WITH_NET else 0.0
    return before + np.concatenate([[0.0], np.cumsum(thought + prices.walk)])


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
        courses, walk = on_model(pool, flags, config, robot, command, params)
        methods = entrants(flags, config, courses)
        rivals = {name: rival for each in methods.values() for name, rival in each.items()}
        raced = run(pool, flags, config, robot, command, engine, rivals)
    full = RolloutConfig().ticks / flags.ticks  # data are walked, and their tunings run, 4 s each
    plain = courses["without"]
    prices = Prices(
        walk,
        {name: course.iteration for name, course in courses.items()},
        full * (nets.CollectConfig.walks * walk + 3 * plain.iterations * plain.iteration),
        took["training"] if took else 0.0,
    )
    groups = {
        method: [
            (raced.turns[name], paid(method, raced.turns[name], courses, prices)) for name in each
        ]
        for method, each in methods.items()
    }
    told = report(flags, engine.name, raced.start, groups, courses, prices, took)
    say(f"the report is {told}")


def report(
    flags: Flags,
    engine: str,
    start: float,
    groups: Mapping[str, Sequence[tuple[Sequence[Turn], np.ndarray]]],
    courses: Mapping[str, Course],
    prices: Prices,
    took: Mapping[str, float] | None,
) -> Path:
    """Write the report with its pictures and its numbers as JSON; returns its path.

    Args:
        flags: what was asked for.
        engine: of the walks.
        start: loss of the start.
        groups: of each method's repeats, the turns and the seconds after each walk.
        courses: on the model.
        prices: in seconds of one core.
        took: seconds of collection and training on this machine; None where made before.
    """
    best = {m: [lowest(start, turns) for turns, _ in each] for m, each in groups.items()}
    marks = [mark for mark in MARKS if mark < flags.rollouts] + [flags.rollouts]

    def cell(losses: Sequence[float]) -> str:
        middle = f"{statistics.median(losses) / 1e6:.3f}"
        if len(losses) == 1:
            return middle
        return f"{middle} [{min(losses) / 1e6:.3f}, {max(losses) / 1e6:.3f}]"

    rows, told = [], {}
    for method, each in groups.items():
        after = {m: [float(x[min(m, len(x) - 1)]) for x in best[method]] for m in marks}
        seconds = [float(spent[-1]) for _, spent in each]
        last = [float(turns[-1].walked.losses[-1]) for turns, _ in each if turns]
        own = cell(last) if method in courses and last else ""
        count = [walks(turns) for turns, _ in each]
        rows.append(
            [
                plots.METHODS[method],
                str(len(each)),
                *(cell(losses) for losses in after.values()),
                own,
                f"{statistics.median(count):g}",
                f"{statistics.median(seconds):.0f}",
            ]
        )
        told[method] = {
            "best": {str(mark): losses for mark, losses in after.items()},
            "walks": count,
            "seconds": seconds,
            "losses": [[x for t in turns for x in t.walked.losses.tolist()] for turns, _ in each],
            "spent": [spent.tolist() for _, spent in each],
            "last": last,
        }
    head = ["method", "repeats", *(f"after {m}" for m in marks), "its own last", "walks", "s"]
    table = markdown_table(head, rows)
    count = {m: [(np.arange(len(x), dtype=float), x) for x in losses] for m, losses in best.items()}
    spent = {
        m: [(seconds, x) for (_, seconds), x in zip(groups[m], losses, strict=True)]
        for m, losses in best.items()
    }
    captions = {
        "rollouts.png": plots.race(
            flags.out / "rollouts.png", count, "walks on the high-fidelity simulator"
        ),
        "seconds.png": plots.race(flags.out / "seconds.png", spent, "seconds of one core")
        + " The methods with the net begin after its walks and its training.",
    }
    about = environment()
    write_json(
        flags.out / "race.json",
        {
            "flags": {n: str(v) for n, v in asdict(flags).items()},
            "engine": engine,
            "environment": about,
            "start": start,
            "prices": prices._asdict(),
            "took": took,
            "courses": {n: c._asdict() for n, c in courses.items()},
            "methods": told,
        },
    )
    text = _words(flags, engine, start, table, courses, prices, took)
    text.insert(1, made_at(about))
    text += [f"![{name}]({name})\n\n{caption}" for name, caption in captions.items()]
    write_file(flags.out / "report.md", ("\n\n".join(text) + "\n").encode())
    return flags.out / "report.md"


def _words(
    flags: Flags,
    engine: str,
    start: float,
    table: str,
    courses: Mapping[str, Course],
    prices: Prices,
    took: Mapping[str, float] | None,
) -> list[str]:
    iterations = ", ".join(
        f"{plots.METHODS[n]} {prices.iterations[n]:.2f} s ({c.iterations} of them; compiling took "
        f"{c.compiling:.0f} s and is not counted)"
        for n, c in courses.items()
    )
    made = (
        f"On this machine, {flags.processes} processes, collection took {took['collection']:.0f} s "
        f"and training {took['training']:.0f} s, compiling included."
        if took
        else f"The net was taken from {flags.net}; **its training is not in the seconds**."
    )
    return [
        "# The race",
        f"Trajectory {flags.traj}, {flags.ticks} ticks, engine {engine}. Lowest L [1e6] on the "
        f"high-fidelity simulator so far; all start from the nominal weights, {start / 1e6:.3f}, "
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
