"""`hector evaluate`: weight sets in engines and models of the robot, or finished runs."""

from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import NamedTuple, get_args

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import BASELINES, OTHER_MASSES, Evaluate, WalkEngine, named_file
from hector_jax.cli.parse import as_command, as_table
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import locked
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.core.settings import SEED
from hector_jax.report import matrix as report
from hector_jax.report.compare import compare_runs, print_comparison
from hector_jax.report.report import print_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.store import tunings
from hector_jax.store.folder import RESULT, load_run
from hector_jax.store.setup import Setup
from hector_jax.verdict import judging, metrics
from hector_jax.verdict.matrix import OWN, Cells, Column


class PlantModel(NamedTuple):
    """A model of the robot that plants are drawn from."""

    mass: float = 1.0  # factor of the mass of each plant
    plant: Robot | None = None  # None: the robot's own model


class EvaluationPlan(NamedTuple):
    """The walks to make."""

    robot: Robot
    world: str
    trajectories: dict[str, tuple[NamedCommand, float]]  # by name, with the length of walks [s]
    sets: dict[str, dict[str, Weights]]  # by trajectory and set
    models: dict[str, PlantModel]
    columns: dict[Column, range]  # with the seeds of its plants
    engines: dict[str, Engine]

    @property
    def differs(self) -> dict[str, str]:
        """Differences of the plants in each engine from those in MuJoCo C."""
        return {name: engine.differs for name, engine in self.engines.items() if engine.differs}


def run_evaluate(args: Evaluate) -> None:
    """Walk weight sets in engines and models, and print a table or the claims that hold."""
    if args.runs:
        _compare(args)
        return
    plan = plan_of(args)
    say(_plan_text(plan))
    made_with, out = environment(), args.out
    with nullcontext() if out is None else locked(out):
        with workers(args.processes, args.cluster) as pool:
            setup = Setup(pool, tunings.tune_config(plan.robot), plan.robot)
            cells = walk_cells(setup, plan, out / "scores" if out else None)
        result = report.matrix_report(cells, plan.differs, plan.world)
        if out is not None:
            facts = {"config": {"flags": as_table(args)}, "environment": made_with}
            command = as_command("hector evaluate", args)
            result = report.write_matrix_report(out, cells, result | facts, command)
    world = next(iter(plan.engines.values())).title if args.walker else args.world
    print_result(args.json, result, partial(_print_cells, cells, result["claims"], world))
    if out is not None:
        say(f"the report is {out / 'report.md'}")


def _print_cells(cells: Cells, claims: Iterable[str], world: str) -> None:
    """Print a table for each trajectory of one column; of several, the changes and the claims."""
    if len({column for column, _ in cells}) > 1:
        report.print_matrix(cells, claims)
        return
    for (_, trajectory), verdict in cells.items():
        print_table(verdict, f"{trajectory}, {plural(len(verdict.seeds), 'plant')}", world)


def _compare(args: Evaluate) -> None:
    """Put finished runs side by side."""
    names = (flag.name for flag in fields(args) if flag.name not in ("runs", "json", "config"))
    if beside := [f"--{name.replace('_', '-')}" for name in names if args.is_given(name)]:
        raise InputError(f"--runs compares what has walked already, so not beside {beside[0]}")
    finished = [folder for folder in args.runs if (folder / RESULT).exists()]
    for folder in args.runs:
        if finished and folder not in finished:
            say(f"{folder} is left out: it is not a finished run")
    comparison = compare_runs([load_run(folder) for folder in finished or args.runs])
    print_result(args.json, comparison, partial(print_comparison, comparison))


def plan_of(args: Evaluate) -> EvaluationPlan:
    """Make the plan of the flags, checked before any walk.

    Raises:
        InputError: one line with the flag or the file.
    """
    robot = load_robot(args.robot)
    trajectories = {}
    for name, text in arguments.trajectories_by_name(args.traj).items():
        trajectory = arguments.load_trajectory(text, robot)
        trajectories[name] = trajectory, arguments.walk_seconds(args, trajectory)
    models = {OWN: PlantModel()}
    for text in args.plant:
        model = PlantModel(OTHER_MASSES[text]) if text in OTHER_MASSES else _model_of(text, robot)
        name = text if model.plant is None else model.plant.description.name
        if name in models:
            raise InputError(f"--plant {text}: there is a model {name!r} already")
        models[name] = model
    engines, columns = _engines(args), {}
    for column in (Column(engine, model) for engine in engines for model in models):
        columns[column] = _seeds(args, args.other_seeds if columns else args.seeds)
    cases = len(columns) * len(trajectories)
    sets = _sets(args, robot, trajectories, paired=cases > 1 or args.out is not None)
    return EvaluationPlan(robot, args.world, trajectories, sets, models, columns, engines)


def _model_of(text: str, robot: Robot) -> PlantModel:
    return PlantModel(plant=arguments.plant_of(Path(text), robot))


def _engines(args: Evaluate) -> dict[str, Engine]:
    if args.walker:
        engine = arguments.engine_of(args)
        return {engine.name: engine}
    if "all" in args.engine:
        return _installed()
    return {name: choose_engine(name) for name in args.engine}


def _seeds(args: Evaluate, count: int) -> range:
    """Return the seeds of a column; a world without seeds is one plant."""
    if args.world in ("ideal", "hfs"):
        for name, only in (("seeds", 1), ("other_seeds", 1), ("first_seed", 0)):
            if args.is_given(name) and getattr(args, name) != only:
                flag = f"--{name.replace('_', '-')} {getattr(args, name)}"
                raise InputError(f"{flag}: --world {args.world} is one plant without a seed")
        return range(1)
    if args.first_seed + count - 1 not in SEED:
        raise InputError(f"seeds from {args.first_seed} on: the largest is {SEED.high}")
    return range(args.first_seed, args.first_seed + count)


def _installed() -> dict[str, Engine]:
    """Return the engines installed on this machine; say the reason for each missing engine."""
    engines = {}
    for name in get_args(WalkEngine):
        try:
            engines[name] = choose_engine(name)
        except InputError as error:
            say(f"left out: {error}")
    return engines


def _sets(
    args: Evaluate, robot: Robot, trajectories: Iterable[str], *, paired: bool
) -> dict[str, dict[str, Weights]]:
    """Load the weight sets of each trajectory; a folder has one file per trajectory.

    Raises:
        InputError: a name is repeated; a file is not a weight set; or, where claims are made of
            pairs, there is no other set beside nominal.
    """
    given = [named_file(text) for text in args.weights]
    short = arguments.short_names([file for _, file in given])
    paths: dict[str, Path] = {}
    for name, file in ((name or short[file], file) for name, file in given):
        if name in paths or (name in BASELINES and file != name):
            raise InputError(f"--weights {file}: there is a set {name!r} already; use NAME={file}")
        paths[name] = Path(file)
    if paired and ("nominal" not in paths or len(paths) < 2):
        raise InputError("--weights must be nominal, which changes are against, and other sets")

    def load(path: Path, trajectory: str) -> Weights:
        file = path / f"{trajectory}.json" if path.is_dir() else path
        return arguments.weights_by_name(str(file), robot)

    return {
        trajectory: {name: load(path, trajectory) for name, path in paths.items()}
        for trajectory in trajectories
    }


def _plan_text(plan: EvaluationPlan) -> str:
    """Describe the number of walks, the plants, and the differences between engines."""
    per_plant = sum(map(len, plan.sets.values()))
    walks = plural(per_plant * sum(map(len, plan.columns.values())), "walk")
    texts = [f"{report.title_of(column)} ({len(seeds)})" for column, seeds in plan.columns.items()]
    parts = [f"{walks}: {per_plant} on each plant", f"plants: {', '.join(texts)}"]
    parts += [f"in {plan.engines[name].title} {text}" for name, text in plan.differs.items()]
    return "; ".join(parts)


def walk_cells(setup: Setup, plan: EvaluationPlan, folder: Path | None) -> Cells:
    """Do all walks, engine by engine; walks whose scores are in the folder are not repeated."""
    scored = {}
    for name, engine in plan.engines.items():
        options = {"title": f"walking in {engine.title}", "folder": folder, "engine": engine}
        scored |= judging.score_jobs(setup, _jobs(plan, name), **options)
    cells = {}
    for column, seeds in plan.columns.items():
        for trajectory, sets in plan.sets.items():
            case, where = (*column, trajectory), report.cell_text((column, trajectory))
            walks = {name: [scored[*case, name, seed][0] for seed in seeds] for name in sets}
            judging.say_faults({f"{name} on {where}": of_set for name, of_set in walks.items()})
            scores = {name: [walk.score for walk in of_set] for name, of_set in walks.items()}
            by_scene, loss = {trajectory: scores}, setup.config.loss
            cells[column, trajectory] = metrics.make_verdict(loss, seeds, by_scene)
    return cells


def _jobs(plan: EvaluationPlan, engine: str) -> dict[judging.Case, Job]:
    """Return the walks of an engine."""
    jobs = {}
    for column, seeds in plan.columns.items():
        if column.engine != engine:
            continue
        model = plan.models[column.model]
        body = (model.plant or plan.robot).description
        for seed, drawn in zip(seeds, arguments.plants(plan.world, seeds, body), strict=True):
            plant = drawn._replace(mass=model.mass * drawn.mass)
            for trajectory, (command, seconds) in plan.trajectories.items():
                for name, weights in plan.sets[trajectory].items():
                    job = Job(weights, command.command, plant, seconds, seed, plant=model.plant)
                    jobs[*column, trajectory, name, seed] = job
    return jobs
