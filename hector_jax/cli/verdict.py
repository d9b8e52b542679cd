"""`hector verdict`: evaluate weight sets in several engines and models of the robot."""

import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple, get_args

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import BASELINES, JudgingEngine, Verdict, named_file
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
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.store import tunings
from hector_jax.store.setup import Setup
from hector_jax.verdict import judging, metrics
from hector_jax.verdict.matrix import HEAVY, LIGHT, OWN, Cells, Column

_ENGINES = get_args(JudgingEngine)[:-1]  # without `all`


class PlantModel(NamedTuple):
    """A model of the robot that plants are drawn from."""

    mass: float = 1.0  # factor of the mass of each plant
    plant: Robot | None = None  # None: the robot's own model


_OTHER_MASSES = {LIGHT: PlantModel(mass=0.9), HEAVY: PlantModel(mass=1.1)}


class VerdictPlan(NamedTuple):
    """The walks of a verdict."""

    robot: Robot
    family: str
    trajectories: dict[str, tuple[NamedCommand, float]]  # by name, with the length of walks [s]
    sets: dict[str, dict[str, Weights]]  # by trajectory and set
    models: dict[str, PlantModel]
    columns: dict[Column, range]  # with the seeds of its plants
    engines: dict[str, Engine]

    @property
    def differs(self) -> dict[str, str]:
        """Differences of the plants in each engine from those in MuJoCo C."""
        return {name: engine.differs for name, engine in self.engines.items() if engine.differs}


def run_verdict(args: Verdict) -> None:
    """Walk weight sets in several engines and models, and report which claims hold."""
    plan = plan_of(args)
    say(_plan_text(plan))
    made_with, config = environment(), tunings.tune_config(plan.robot)
    with locked(args.out):
        with workers(args.processes, args.cluster) as pool:
            setup = Setup(pool, config, plan.robot)
            cells = walk_cells(setup, plan, args.out / "scores")
        result = report.write_verdict_report(
            args.out,
            cells,
            family=args.family,
            differs=plan.differs,
            config={"flags": as_table(args)},
            environment=made_with,
            command=as_command("hector verdict", args),
        )
    path = args.out / "report.md"
    print_text = partial(report.print_verdict, cells, plan.differs, args.family)
    print_result(args.json, {"report": str(path), **result}, print_text)
    say(f"the report is {path}")


def plan_of(args: Verdict) -> VerdictPlan:
    """Make the plan of the flags, checked before any walk.

    Raises:
        InputError: one line with the flag or the file.
    """
    robot = load_robot(args.robot)
    trajectories = {}
    for name, text in arguments.trajectories_by_name(args.traj).items():
        trajectory = arguments.load_trajectory(text, robot)
        trajectories[name] = trajectory, arguments.walk_seconds(args, trajectory)
    models = {OWN: PlantModel()} | (_OTHER_MASSES if args.light_heavy else {})
    for path in args.plant:
        plant = arguments.plant_of(path, robot)
        assert plant is not None  # the path is set
        if (name := plant.description.name) in models:
            raise InputError(f"--plant {path}: there is a model {name!r} already")
        models[name] = PlantModel(plant=plant)
    engines = _engines(args)
    columns = {
        Column(engine, model): _seeds(args, first=engine == next(iter(engines)), own=model == OWN)
        for engine in engines
        for model in models
    }
    sets = _sets(args, robot, trajectories)
    return VerdictPlan(robot, args.family, trajectories, sets, models, columns, engines)


def _engines(args: Verdict) -> dict[str, Engine]:
    if args.walker:
        engine = arguments.engine_of(args)
        return {engine.name: engine}
    if "all" in args.engine:
        return _installed(say)
    return {name: choose_engine(name) for name in args.engine}


def _seeds(args: Verdict, *, first: bool, own: bool) -> range:
    count = args.engine_seeds if not first else args.seeds if own else args.model_seeds
    if args.first_seed + count - 1 not in SEED:
        raise InputError(f"seeds from {args.first_seed} on: the largest is {SEED.high}")
    return range(args.first_seed, args.first_seed + count)


def _installed(report_missing: Callable[[str], None]) -> dict[str, Engine]:
    """Return the engines installed on this machine; report the reason for each missing engine."""
    engines = {}
    for name in _ENGINES:
        try:
            engines[name] = choose_engine(name)
        except InputError as error:
            report_missing(f"left out: {error}")
    return engines


def _sets(
    args: Verdict, robot: Robot, trajectories: Iterable[str]
) -> dict[str, dict[str, Weights]]:
    """Load the weight sets of each trajectory; a folder has one file per trajectory.

    Raises:
        InputError: a name is not valid in a file name, or is repeated; a file is not a weight set.
    """
    paths: dict[str, Path] = {}
    for text in args.weights:
        name, file = named_file(text)
        path = Path(file)
        name = name or path.stem
        # names become parts of file names, where other characters might not stay distinct
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
            raise InputError(
                f"--weights {text}: {name!r} is no name of letters, digits and _; give it one: "
                f"NAME={file}"
            )
        if name in paths or (name in BASELINES and file != name):
            raise InputError(f"--weights {text}: there is a set {name!r} already; use NAME={file}")
        paths[name] = path
    if "nominal" not in paths or len(paths) < 2:
        raise InputError("--weights must be nominal, which changes are against, and other sets")

    def load(path: Path, trajectory: str) -> Weights:
        file = path / f"{trajectory}.json" if path.is_dir() else path
        return arguments.weights_by_name(str(file), robot)

    return {
        trajectory: {name: load(path, trajectory) for name, path in paths.items()}
        for trajectory in trajectories
    }


def _plan_text(plan: VerdictPlan) -> str:
    """Describe the number of walks, the plants, and the differences between engines."""
    per_plant = sum(map(len, plan.sets.values()))
    walks = plural(per_plant * sum(map(len, plan.columns.values())), "walk")
    texts = [f"{report.title_of(column)} ({len(seeds)})" for column, seeds in plan.columns.items()]
    parts = [f"{walks}: {per_plant} on each plant", f"plants: {', '.join(texts)}"]
    parts += [f"in {plan.engines[name].title} {text}" for name, text in plan.differs.items()]
    return "; ".join(parts)


def walk_cells(setup: Setup, plan: VerdictPlan, folder: Path) -> Cells:
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


def _jobs(plan: VerdictPlan, engine: str) -> dict[judging.Case, Job]:
    """Return the walks of an engine."""
    jobs, world = {}, "standin" if plan.family == "standin" else f"standin-{plan.family}"
    for column, seeds in plan.columns.items():
        if column.engine != engine:
            continue
        model = plan.models[column.model]
        body = (model.plant or plan.robot).description
        for seed, drawn in zip(seeds, arguments.plants(world, seeds, body), strict=True):
            plant = drawn._replace(mass=model.mass * drawn.mass)
            for trajectory, (command, seconds) in plan.trajectories.items():
                for name, weights in plan.sets[trajectory].items():
                    job = Job(weights, command.command, plant, seconds, seed, plant=model.plant)
                    jobs[*column, trajectory, name, seed] = job
    return jobs


def small_verdict(
    setup: Setup,
    sets: Mapping[str, Weights],
    trajectory: NamedCommand,
    seconds: float,
    folder: Path,
) -> Callable[[], None]:
    """Do at most twelve walks of a run's sets on one plant, in engines or models new to the run.

    Those are the other installed engines, or, without any, the robot with other masses.

    Returns:
        The function that prints the table.
    """
    others = list(_installed(lambda message: None).items())[1:4]
    engines = dict(others) or {"c": choose_engine("c")}
    models = {OWN: PlantModel()} if others else _OTHER_MASSES
    columns = {Column(engine, model): range(1) for engine in engines for model in models}
    walks = {trajectory.name: (trajectory, seconds)}
    few = {trajectory.name: {name: sets[name] for name in ("nominal", "expert", "with", "best")}}
    plan = VerdictPlan(setup.robot, "standin", walks, few, models, columns, engines)
    cells = walk_cells(setup, plan, folder)
    return partial(report.print_verdict, cells, plan.differs, plan.family)
