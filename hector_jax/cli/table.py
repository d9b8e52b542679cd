"""`hector table`: search, tune and judge every set on every trajectory, and write the report.

Each step reads the artefacts that are there, so that a run that was cut goes on where it was, and
another set or more plants cost only what is new.
"""

import re
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from hector_jax.cli import arguments, flags, parse
from hector_jax.control.reference import COMMANDS, Command, named_command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import as_json, locked, make_folder
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.core.settings import read_json
from hector_jax.core.trajectory import Trajectory
from hector_jax.report import plots
from hector_jax.report.motion import motions
from hector_jax.report.report import Picture, print_table
from hector_jax.report.table import (
    PAPER,
    Earlier,
    Fall,
    Search,
    Table,
    load_earlier,
    paper_change,
    write_table,
)
from hector_jax.report.video import VideoConfig, VideoUnavailable, write_strip
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import metrics, nets, searches, tunings, verdicts
from hector_jax.runs.cache import content_key
from hector_jax.runs.metrics import BASELINES, Verdict
from hector_jax.runs.nets import TrainedNet
from hector_jax.runs.tunings import Problem, Tuned
from hector_jax.runs.verdicts import ScoredWalks
from hector_jax.search.cmaes import SearchConfig, SearchResult
from hector_jax.sim.engine import choose_engine
from hector_jax.sim.world import Imperfections, hfs
from hector_jax.tuning.difftune import PAPER_ITERATIONS, TuneConfig

WALKS = "with_walks"
SETS = (
    "nominal",
    "expert",
    "searched",
    "without_ten",
    "with_ten",
    "without",
    "with",
    WALKS,
)
CEILING = "ceiling"

# what `quick` cuts down to, so that all is done in under five minutes on two cores
_QUICK = {"seeds": 4, "rollouts": 10, "iterations": 20, "steps": 2}

_SNAPSHOTS = VideoConfig(height=360)


@dataclass(frozen=True)
class _Plan:
    """What the flags ask for, checked."""

    commands: Mapping[str, Command]
    seeds: range
    tune: TuneConfig
    walks: TuneConfig | None  # of the tuning along walks
    plants: int  # that it walks on
    search: SearchConfig
    extra: Mapping[str, Mapping[str, Weights]]  # by trajectory, the sets from files
    ceilings: Mapping[str, Search]  # what the long searches say of themselves
    earlier: Earlier | None


def _plan(args: flags.Table) -> _Plan:
    """Raises InputError, before anything is computed, where the flags ask for what cannot be."""
    parse.check(args)
    for name in args.trajectories:
        if name not in COMMANDS:
            raise InputError(f"--trajectories must be of {', '.join(COMMANDS)}, got {name}")
    commands = {name: named_command(name) for name in args.trajectories}
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    return _Plan(
        commands,
        seeds,
        TuneConfig(iterations=args.iterations),
        TuneConfig(iterations=PAPER_ITERATIONS + args.steps) if args.steps else None,
        args.step_plants,
        SearchConfig(budget=args.rollouts),
        _sets_from_files(args),
        {
            name: _long_search(args.ceiling / f"{name}-card.json")
            for name in args.trajectories
            if (args.ceiling / f"{name}.json").exists()
        },
        None if args.earlier is None else load_earlier(args.earlier, seeds),
    )


def _sets_from_files(args: flags.Table) -> dict[str, dict[str, Weights]]:
    """The ceiling, where there is one, and the extra sets, by trajectory."""
    folders: dict[str, Path] = {}
    for text in args.extra:
        name, _, folder = text.partition("=")
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or not folder:
            raise InputError(f"--extra must be NAME=FOLDER, NAME of letters and digits, got {text}")
        if name in (*SETS, CEILING, *folders):
            raise InputError(f"--extra {text}: there is a set '{name}' already")
        folders[name] = Path(folder)
    sets = {}
    for trajectory in args.trajectories:
        ceiling = args.ceiling / f"{trajectory}.json"
        paths = {CEILING: ceiling} if ceiling.exists() else {}
        paths |= {name: folder / f"{trajectory}.json" for name, folder in folders.items()}
        sets[trajectory] = {name: load_weights(path) for name, path in paths.items()}
    return sets


def _long_search(card: Path) -> Search:
    """What the card beside the ceiling's weights tells of its search."""
    content = read_json(card, "the card of a search")
    try:
        return Search(content["walks"], content["best_at"], content["L"]["best"], content["stop"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{card}: not the card of a search: {error!r}") from None


class _Bench(NamedTuple):
    """What the steps of a table share."""

    pool: Executor
    plan: _Plan
    robot: Robot
    net: TrainedNet
    kept: Path  # folder of the artefacts
    commit: str


def table(args: flags.Table) -> None:
    """Make the table of all sets on all trajectories."""
    report, by_trajectory = make_table(args, partial(arguments.plants, "standin"))
    if args.json:
        results = {name: metrics.as_result(verdict) for name, verdict in by_trajectory.items()}
        print(as_json({"report": str(report), "trajectories": results}))
    else:
        for name, verdict in by_trajectory.items():
            print_table(verdict, f"{name}, {plural(len(verdict.seeds), 'plant')}")
    say(f"the report is {report}")


def make_table(
    args: flags.Table, plants: Callable[[range], list[Imperfections]]
) -> tuple[Path, dict[str, Verdict]]:
    """Everything from the net to the files.

    Args:
        args: the flags.
        plants: those of the verdict, by their seeds.

    Returns:
        report.md, and the verdict of each trajectory.

    Raises:
        InputError: the flags ask for what cannot be, or a file is damaged, or the folder cannot be
            written.
    """
    command = parse.as_command("table", args)
    if args.quick:
        args = replace(args, **{n: min(getattr(args, n), most) for n, most in _QUICK.items()})
    plan, out = _plan(args), args.out / "quick" if args.quick else args.out
    with locked(out):
        return _make_table(args, plan, out, plants, command=command)


def _make_table(
    args: flags.Table,
    plan: _Plan,
    out: Path,
    plants: Callable[[range], list[Imperfections]],
    *,
    command: str,
) -> tuple[Path, dict[str, Verdict]]:
    robot, shelf = load_robot(), args.kept or args.out / "kept"
    for folder in (out / "pictures", shelf):
        make_folder(folder)
    made_with = environment()
    with workers(args.processes) as pool:
        net = nets.load_or_train(pool, robot, args.data)
        bench = _Bench(pool, plan, robot, net, shelf, made_with.get("commit", ""))
        searched = _search(bench)
        tuned = {name: _tune(bench, name) for name in plan.commands}
        # nothing that tunes or searches runs once the plants of the verdict are known
        judges = plants(plan.seeds)
        judged = {
            name: _judge(bench, name, judges, _sets(plan, name, one, searched[name]))
            for name, one in tuned.items()
        }
    by_trajectory = {name: _verdict(plan, one) for name, one in judged.items()}
    commits = {one.commit for each in tuned.values() for one in each.values()}
    commits |= {w.commit for one in judged.values() for ws in one.walks.values() for w in ws}
    report = write_table(
        out,
        Table(
            by_trajectory,
            falls=[fall for name, one in judged.items() for fall in _falls(plan, name, one)],
            tunings={n: {k: t.tuning for k, t in each.items()} for n, each in tuned.items()},
            searches={name: _search_in_table(plan, one) for name, one in searched.items()},
            ceilings=plan.ceilings,
            pictures=_draw(out, robot, by_trajectory, judged),
            config={
                "flags": parse.as_table(args),
                "tune": plan.tune.as_table(),
                "search": asdict(plan.search),
            },
            environment=made_with,
            commits=sorted(commits),
            command=command,
            earlier=plan.earlier,
        ),
    )
    return report, by_trajectory


def _search(bench: _Bench) -> dict[str, SearchResult]:
    """The derivative-free baseline of all trajectories, in lock-step."""
    plan, engine = bench.plan, choose_engine("auto")
    settings = replace(plan.search, budget=plan.search.population)  # a record serves any budget
    model = engine.name, plan.tune.rollout, repr(plan.tune.loss)
    key = content_key(*model, settings, bench.robot, hfs(), nominal(), code=searches.SEARCH_CODE)
    return searches.search(
        bench.pool,
        plan.search,
        plan.tune,
        bench.robot,
        dict.fromkeys(plan.commands, nominal()),
        commands=plan.commands,
        engine=engine,
        folder=bench.kept / f"search-{key}",
    )


def _tune(bench: _Bench, name: str) -> dict[str, Tuned]:
    """The tunings of one trajectory."""
    pool, plan, robot, params = bench.pool, bench.plan, bench.robot, bench.net.params
    command, folder = plan.commands[name], bench.kept / name
    problems = {"without": Problem(command, None), "with": Problem(command, params)}
    title = f"tuning {name} without and with GRFM-Net"
    tuned = tunings.tune(pool, plan.tune, robot, problems, folder, title=title, commit=bench.commit)
    if plan.walks is not None:
        try:
            tuned[WALKS] = tunings.tune_measured(
                pool,
                plan.walks,
                robot,
                tuned["with"].tuning.converged,
                command,
                params,
                plants=tunings.measured_plants(plan.plants),
                folder=folder,
                title=f"tuning {name} further, along walks on the simulator",
                commit=bench.commit,
            )
        except InputError as error:  # a walk with the tuned weights falls
            say(f"{name}: no row {WALKS}: {error}")
    return tuned


def _sets(
    plan: _Plan, name: str, tuned: Mapping[str, Tuned], searched: SearchResult
) -> dict[str, Weights]:
    return {
        "nominal": nominal(),
        "expert": expert(),
        "searched": searched.weights,
        **{f"{which}_ten": tuned[which].tuning.ten for which in ("without", "with")},
        **{which: one.tuning.converged for which, one in tuned.items()},
        **plan.extra[name],
    }


def _judge(
    bench: _Bench, name: str, plants: list[Imperfections], sets: Mapping[str, Weights]
) -> ScoredWalks:
    plan = bench.plan
    return verdicts.judge(
        bench.pool,
        plan.tune,
        bench.robot,
        sets,
        plan.commands[name],
        plants,
        plan.seeds,
        title=f"evaluating {name} on {plural(len(plan.seeds), 'stand-in plant')}",
        folder=bench.kept / name,
        commit=bench.commit,
    )


def _verdict(plan: _Plan, judged: ScoredWalks) -> Verdict:
    return metrics.make_verdict(plan.tune.loss, plan.seeds, judged.scores)


def _falls(plan: _Plan, trajectory: str, judged: ScoredWalks) -> list[Fall]:
    return [
        Fall(
            trajectory,
            name,
            seed,
            float(walk.upright),
            float(walk.last.position[2]),
            *(float(angle) for angle in walk.last.euler[:2]),
        )
        for name, walks in judged.walks.items()
        for seed, walk in zip(plan.seeds, walks, strict=True)
        if walk.score.fallen
    ]


def _search_in_table(plan: _Plan, result: SearchResult) -> Search:
    walks = len(result.history) * plan.search.population
    return Search(walks, result.walk, result.loss, result.stop)


def _draw(
    out: Path, robot: Robot, verdicts: Mapping[str, Verdict], judged: Mapping[str, ScoredWalks]
) -> list[Picture]:
    """All pictures, in the order of the report."""
    say("drawing the pictures")
    paper = {
        (trajectory, name, baseline): change
        for trajectory in verdicts
        for name in PAPER[trajectory]
        for baseline in BASELINES
        if name not in BASELINES
        and (change := paper_change(trajectory, name, baseline)) is not None
    }
    caption = plots.changes(out / "pictures" / "changes.png", verdicts, paper)
    pictures = [Picture("pictures/changes.png", caption)]
    for name, one in judged.items():
        # the last one's footprints are drawn
        walks = {key: walk for key, walk in one.first.items() if key != "with"}
        walks["with"] = one.first["with"]
        with tempfile.TemporaryDirectory() as folder:
            strip = _snapshots(Path(folder), robot, one.first)
            file = f"pictures/{name}.png"
            pictures.append(Picture(file, f"{name}: {plots.collective(out / file, walks, strip)}"))
    return pictures


def _snapshots(folder: Path, robot: Robot, walks: Mapping[str, Trajectory]) -> Path | None:
    """A strip of both walks; None, with one line, where nothing can be drawn here."""
    pair = {name: walks[name] for name in ("nominal", "with")}
    try:
        write_strip(folder / "strip.png", robot, motions(robot, pair), _SNAPSHOTS)
    except VideoUnavailable as error:
        say(f"no snapshots: {error}")
        return None
    return folder / "strip.png"
