"""What weight sets are worth in several engines and models of the robot."""

import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import BASELINES, JudgingEngine, Verdict
from hector_jax.cli.parse import as_command, as_table
from hector_jax.control.reference import COMMANDS
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.core.settings import SEED
from hector_jax.report import matrix as report
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import metrics, tunings, verdicts
from hector_jax.runs.matrix import HEAVY, LIGHT, OWN, Cells, Column
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.tuning.difftune import TuneConfig

_ENGINES = get_args(JudgingEngine)[:-1]  # all but `all`
_MASSES = {LIGHT: 0.9, HEAVY: 1.1}  # times those of a plant, of the robot's own model


class Model(NamedTuple):
    """A model of the robot, of which the plants are."""

    mass: float = 1.0  # times that of each plant
    plant: Robot | None = None  # None: the robot's own


class Plan(NamedTuple):
    """What is to be walked."""

    robot: Robot
    family: str
    courses: dict[str, tuple[NamedCommand, float]]  # and how long [s], by the trajectory's name
    sets: dict[str, dict[str, Weights]]  # by trajectory and set
    models: dict[str, Model]
    columns: dict[Column, range]  # and the seeds of its plants
    engines: dict[str, Engine]

    @property
    def differs(self) -> dict[str, str]:
        """What plants have otherwise in each engine than in MuJoCo C."""
        return {name: engine.differs for name, engine in self.engines.items() if engine.differs}


def verdict(args: Verdict) -> None:
    """Walk weight sets in several engines and models, and report what may be claimed."""
    plan = plan_of(args)
    say(_in_words(plan))
    make_folder(args.out)
    about, config = environment(), tunings.tune_config(plan.robot)
    with workers(args.processes) as pool:
        cells = walk_cells(pool, config, plan, args.out / "scores", about.get("commit", ""))
    result = report.write_report(
        args.out,
        cells,
        family=args.family,
        differs=plan.differs,
        config={"flags": as_table(args)},
        environment=about,
        command=as_command("hector verdict", args),
    )
    path = args.out / "report.md"
    in_words = partial(report.print_verdict, cells, plan.differs, args.family)
    print_result(args.json, {"report": str(path), **result}, in_words)
    say(f"the report is {path}")


def plan_of(args: Verdict) -> Plan:
    """What the flags ask for, checked before anything is walked.

    Raises:
        InputError: one line with the flag or the file.
    """
    robot = load_robot(args.robot)
    texts = dict.fromkeys(t for one in args.traj for t in (COMMANDS if one == "all" else (one,)))
    courses = {}
    for text in texts:
        course = arguments.course(text, robot)
        if course.name in courses:
            raise InputError(f"--traj names two trajectories {course.name}")
        courses[course.name] = course, arguments.seconds(args.seconds, course)
    models = {OWN: Model()}
    if args.light_heavy:
        models |= {name: Model(mass) for name, mass in _MASSES.items()}
    for path in args.plant:
        plant = arguments.plant_of(path, robot)
        assert plant is not None  # there is a path
        if (name := plant.description.name) in models:
            raise InputError(f"--plant {path}: there is a model {name!r} already")
        models[name] = Model(plant=plant)
    engines = _engines(args.engine)
    columns = {
        Column(engine, model): _seeds(args, first=engine == next(iter(engines)), own=model == OWN)
        for engine in engines
        for model in models
    }
    sets = _sets(args, robot, courses)
    return Plan(robot, args.family, courses, sets, models, columns, engines)


def _seeds(args: Verdict, *, first: bool, own: bool) -> range:
    count = args.engine_seeds if not first else args.seeds if own else args.model_seeds
    if args.first_seed + count - 1 not in SEED:
        raise InputError(f"seeds from {args.first_seed} on: the largest is {SEED.high}")
    return range(args.first_seed, args.first_seed + count)


def _engines(names: Sequence[str]) -> dict[str, Engine]:
    """The engines of the flag; `all` are those that can be used here.

    Raises:
        InputError: an engine that is named cannot be used.
    """
    if "all" not in names:
        return {name: choose_engine(name) for name in names}
    return _installed(say)


def _installed(tell: Callable[[str], None]) -> dict[str, Engine]:
    """The engines that can be used here; tells of the others why not."""
    engines = {}
    for name in _ENGINES:
        try:
            engines[name] = choose_engine(name)
        except InputError as error:
            tell(f"left out: {error}")
    return engines


def _sets(args: Verdict, robot: Robot, courses: Mapping[str, Any]) -> dict[str, dict[str, Weights]]:
    """The weight sets of each trajectory; a folder has a file for each.

    Raises:
        InputError: a name that cannot be part of a file's, or is taken; a file that is no set.
    """
    paths: dict[str, Path] = {}
    for text in args.weights:
        name, _, file = text.rpartition("=")
        path = Path(file)
        name = name or path.stem
        # names are parts of files' names, where other characters might make two of them one
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

    def load(path: Path, course: str) -> Weights:
        file = path / f"{course}.json" if path.is_dir() else path
        return arguments.weights(str(file), robot)

    return {
        course: {name: load(path, course) for name, path in paths.items()} for course in courses
    }


def _in_words(plan: Plan) -> str:
    """How many walks there are to be, and what engines cannot have."""
    each = len(plan.courses) * len(next(iter(plan.sets.values())))
    texts = [f"{report.title_of(column)} ({len(seeds)})" for column, seeds in plan.columns.items()]
    text = f"{plural(each * sum(map(len, plan.columns.values())), 'walk')}: {each} on each plant"
    text += f"; plants: {', '.join(texts)}"
    for name, what in plan.differs.items():
        text += f"; in {report.TITLES[name]} {what}"
    return text


def walk_cells(
    pool: Executor, config: TuneConfig, plan: Plan, folder: Path, commit: str = ""
) -> Cells:
    """All walks, engine by engine; those whose scores are in the folder are not walked again."""
    scores: dict[tuple[Column, str, str, int], verdicts.ScoredWalk] = {}
    for name, engine in plan.engines.items():
        jobs, title = _jobs(plan, name), f"walking in {report.TITLES[name]}"
        inputs = pool, config, plan.robot, {case: job for case, job in jobs.values()}
        found = verdicts.score_jobs(
            *inputs, title=title, folder=folder, commit=commit, engine=engine
        )
        scores |= {key: found[case][0] for key, (case, _) in jobs.items()}
    cells = {}
    for column, seeds in plan.columns.items():
        for course, sets in plan.sets.items():
            walks = {name: [scores[column, course, name, s] for s in seeds] for name in sets}
            where = report.cell_text((column, course))
            verdicts.say_faults({f"{name} on {where}": each for name, each in walks.items()})
            each = {name: [walk.score for walk in of] for name, of in walks.items()}
            cells[column, course] = metrics.make_verdict(config.loss, seeds, each)
    return cells


def _jobs(plan: Plan, engine: str) -> dict[tuple[Column, str, str, int], tuple[verdicts.Case, Job]]:
    """The walks of an engine with the case that each is stored as."""
    jobs, world = {}, "standin" if plan.family == "standin" else f"standin-{plan.family}"
    for column, seeds in plan.columns.items():
        if column.engine != engine:
            continue
        model = plan.models[column.model]
        body = (model.plant or plan.robot).description
        for seed, drawn in zip(seeds, arguments.plants(world, seeds, body), strict=True):
            plant = drawn._replace(mass=model.mass * drawn.mass)
            for course, (command, seconds) in plan.courses.items():
                for name, weights in plan.sets[course].items():
                    job = Job(weights, command.command, plant, seconds, seed, plant=model.plant)
                    case = f"{engine}-{column.model}-{course}-{name}", seed
                    jobs[column, course, name, seed] = case, job
    return jobs


def small_verdict(
    pool: Executor,
    config: TuneConfig,
    robot: Robot,
    sets: Mapping[str, Weights],
    course: NamedCommand,
    seconds: float,
    folder: Path,
) -> Callable[[], None]:
    """At most twelve walks of a run's sets on one plant, where the run itself has not walked.

    Those are the other engines that are installed, or else the robot with other masses.

    Returns:
        What prints the table.
    """
    few = {name: sets[name] for name in ("nominal", "expert", "with", "best")}
    others = list(_installed(lambda text: None).items())[1:4]
    engines = dict(others) or {"c": choose_engine("c")}
    models = {OWN: Model()} if others else {n: Model(mass) for n, mass in _MASSES.items()}
    columns = {Column(engine, model): range(1) for engine in engines for model in models}
    walks = {course.name: (course, seconds)}, {course.name: few}
    plan = Plan(robot, "standin", *walks, models, columns, engines)
    cells = walk_cells(pool, config, plan, folder)
    return partial(report.print_verdict, cells, plan.differs, plan.family)
