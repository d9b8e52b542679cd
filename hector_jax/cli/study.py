"""The whole table: search, tune and judge every set on every trajectory, and write what came out.

Each step takes up what is kept of it (kept.py, tuning/search.py), so that a run that was cut goes
on where it was, and another set or more plants cost only what is new.
"""

import re
import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from hector_jax.cli import flags, parse
from hector_jax.control.reference import COMMANDS, Command, named_command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import locked, make_folder
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.core.settings import read_json
from hector_jax.core.trajectory import Trajectory
from hector_jax.grfm.network import Params
from hector_jax.report import plots, table
from hector_jax.report.motion import motions
from hector_jax.report.report import Picture
from hector_jax.report.table import PAPER, Earlier, Fall, Search, Table
from hector_jax.report.video import VideoConfig, VideoUnavailable, write_strip
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import kept, metrics, pipeline
from hector_jax.runs.cache import content_key
from hector_jax.runs.kept import Judged
from hector_jax.runs.metrics import BASELINES, Verdict
from hector_jax.runs.pipeline import Tuned
from hector_jax.search.cmaes import Found, SearchConfig
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
    """What the flags ask for, found sound."""

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
        None if args.earlier is None else table.load_earlier(args.earlier, seeds),
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
    found = {}
    for trajectory in args.trajectories:
        ceiling = args.ceiling / f"{trajectory}.json"
        paths = {CEILING: ceiling} if ceiling.exists() else {}
        paths |= {name: folder / f"{trajectory}.json" for name, folder in folders.items()}
        found[trajectory] = {name: load_weights(path) for name, path in paths.items()}
    return found


def _long_search(card: Path) -> Search:
    """What the card beside the ceiling's weights tells of its search."""
    told = read_json(card, "the card of a search")
    try:
        return Search(told["walks"], told["best_at"], told["L"]["best"], told["stop"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{card}: not the card of a search: {error!r}") from None


def make_table(
    args: flags.Table, plants: Callable[[range], list[Imperfections]]
) -> tuple[Path, dict[str, Verdict]]:
    """Everything from the net to the files.

    Args:
        args: what is asked for.
        plants: those of the verdict, by their seeds.

    Returns:
        report.md, and the verdict of each trajectory.

    Raises:
        InputError: the flags ask for what cannot be, or a file is damaged.
        InputError: the folder cannot be written.
    """
    asked = args
    if args.quick:
        args = replace(args, **{n: min(getattr(args, n), most) for n, most in _QUICK.items()})
    plan, out = _plan(args), args.out / "quick" if args.quick else args.out
    with locked(out):
        return _make_table(args, asked, plan, out, plants)


def _make_table(
    args: flags.Table,
    asked: flags.Table,
    plan: _Plan,
    out: Path,
    plants: Callable[[range], list[Imperfections]],
) -> tuple[Path, dict[str, Verdict]]:
    robot, shelf = load_robot(), args.kept or args.out / "kept"
    for folder in (out / "pictures", shelf):
        make_folder(folder)
    made_with = environment()
    with workers(args.processes) as pool:
        net = pipeline.ground(pool, robot, args.data)
        searches = _search(pool, plan, robot, shelf)
        commit = made_with.get("commit", "")
        tunings = {
            name: _tune(pool, plan, robot, name, net.params, shelf / name, commit)
            for name in plan.commands
        }
        # nothing that tunes or searches runs once the plants of the verdict are known
        judges = plants(plan.seeds)
        judged = {
            name: _walk_sets(
                pool, plan, robot, name, tuned, searches[name], judges, shelf / name, commit
            )
            for name, tuned in tunings.items()
        }
    verdicts = {name: _verdict(plan, found) for name, found in judged.items()}
    commits = {tuned.commit for each in tunings.values() for tuned in each.values()}
    commits |= {w.commit for found in judged.values() for ws in found.walks.values() for w in ws}
    told = table.write_table(
        out,
        Table(
            verdicts,
            falls=[fall for name, one in judged.items() for fall in _falls(plan, name, one)],
            tunings={n: {k: t.tuning for k, t in each.items()} for n, each in tunings.items()},
            searches={name: _told(plan, found) for name, found in searches.items()},
            ceilings=plan.ceilings,
            pictures=_draw(out, robot, verdicts, judged),
            config={
                "flags": parse.as_table(args),
                "tune": asdict(plan.tune),
                "search": asdict(plan.search),
            },
            environment=made_with,
            commits=sorted(commits),
            command=parse.as_command("table", asked),
            earlier=plan.earlier,
        ),
    )
    return told, verdicts


def _search(pool: Executor, plan: _Plan, robot: Robot, shelf: Path) -> dict[str, Found]:
    """The derivative-free baseline of all trajectories, in lock-step."""
    settings = replace(plan.search, budget=plan.search.population)  # a record serves any budget
    engine, model = choose_engine("auto"), plan.tune.rollout
    follows_from = engine.name, model, plan.tune.loss, settings, robot, hfs(), nominal()
    key = content_key(*follows_from, code=pipeline.SEARCH_CODE)
    starts = dict.fromkeys(plan.commands, nominal())
    folder = shelf / f"search-{key}"
    return pipeline.search(pool, plan.search, plan.tune, robot, starts, engine, folder)


def _tune(
    pool: Executor,
    plan: _Plan,
    robot: Robot,
    name: str,
    params: Params | None,
    folder: Path,
    commit: str,
) -> dict[str, Tuned]:
    """The tunings of one trajectory."""
    command = plan.commands[name]
    problems = {"without": (command, None), "with": (command, params)}
    title = f"tuning {name} without and with GRFM-Net"
    tuned = pipeline.tune(pool, plan.tune, robot, problems, folder, title=title, commit=commit)
    if plan.walks is not None:
        try:
            tuned[WALKS] = pipeline.tune_measured(
                pool,
                plan.walks,
                robot,
                tuned["with"].tuning.converged,
                command,
                params,
                pipeline.measured_plants(plan.plants),
                folder,
                title=f"tuning {name} further, along walks on the simulator",
                commit=commit,
            )
        except InputError as error:  # a walk with the tuned weights falls
            say(f"{name}: no row {WALKS}: {error}")
    return tuned


def _walk_sets(
    pool: Executor,
    plan: _Plan,
    robot: Robot,
    name: str,
    tuned: Mapping[str, Tuned],
    searched: Found,
    plants: list[Imperfections],
    folder: Path,
    commit: str,
) -> Judged:
    """The walks of all sets of one trajectory."""
    sets = {
        "nominal": nominal(),
        "expert": expert(),
        "searched": searched.weights,
        **{f"{which}_ten": tuned[which].tuning.ten for which in ("without", "with")},
        **{which: one.tuning.converged for which, one in tuned.items()},
        **plan.extra[name],
    }
    title = f"evaluating {name} on {plural(len(plan.seeds), 'stand-in plant')}"
    command, seeds = plan.commands[name], plan.seeds
    known = (sets, command, plants, seeds, folder, commit, title)
    return kept.judge(pool, plan.tune, robot, *known)


def _verdict(plan: _Plan, judged: Judged) -> Verdict:
    scores = {name: [walk.score for walk in walks] for name, walks in judged.walks.items()}
    return metrics.make_verdict(plan.tune.loss, plan.seeds, scores)


def _falls(plan: _Plan, trajectory: str, judged: Judged) -> list[Fall]:
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


def _told(plan: _Plan, found: Found) -> Search:
    walks = len(found.history) * plan.search.population
    return Search(walks, found.walk, found.loss, found.stop)


def _draw(
    out: Path, robot: Robot, verdicts: Mapping[str, Verdict], judged: Mapping[str, Judged]
) -> list[Picture]:
    """All pictures, in the order of the report."""
    say("drawing the pictures")
    paper = {
        (trajectory, name, baseline): table.paper_change(trajectory, name, baseline)
        for trajectory in verdicts
        for name in PAPER[trajectory]
        for baseline in BASELINES
        if name not in BASELINES
    }
    caption = plots.changes(out / "pictures" / "changes.png", verdicts, paper)
    pictures = [Picture("pictures/changes.png", caption)]
    for name, found in judged.items():
        # the last one's footprints are drawn
        walks = {key: walk for key, walk in found.shown.items() if key != "with"}
        walks["with"] = found.shown["with"]
        with tempfile.TemporaryDirectory() as folder:
            strip = _snapshots(Path(folder), robot, found.shown)
            file = f"pictures/{name}.png"
            pictures.append(Picture(file, f"{name}: {plots.collective(out / file, walks, strip)}"))
    return pictures


def _snapshots(folder: Path, robot: Robot, shown: Mapping[str, Trajectory]) -> Path | None:
    """A strip of both walks; None, with one line, where nothing can be drawn here."""
    pair = {name: shown[name] for name in ("nominal", "with")}
    try:
        write_strip(folder / "strip.png", robot, motions(robot, pair), _SNAPSHOTS)
    except VideoUnavailable as error:
        say(f"no snapshots: {error}")
        return None
    return folder / "strip.png"
