"""`hector evaluate`: weight sets in engines and models of the robot, or finished runs."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import (
    NAMED_WEIGHTS,
    OF_ROBOT,
    OTHER_MASSES,
    Evaluate,
    WalkEngine,
    named_file,
)
from hector_jax.cli.parse import as_command, as_table
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import Weights
from hector_jax.core.console import say
from hector_jax.core.environment import environment
from hector_jax.core.files import locked
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.pool import workers
from hector_jax.core.settings import SEED
from hector_jax.report import matrix as report
from hector_jax.report.compare import compare_runs, print_comparison
from hector_jax.report.report import print_tables
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import Engine, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.world import Imperfections
from hector_jax.store import tunings
from hector_jax.store.run import Run
from hector_jax.store.setup import Setup
from hector_jax.verdict import judging
from hector_jax.verdict.matrix import OWN, Column, Columns, cells_of
from hector_jax.verdict.metrics import BASELINES
from hector_jax.verdict.stopping import StoppingRule

_BATCH = 4  # plants between two looks of --until-clear: where it stops is no matter of the machine


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
    rule: StoppingRule | None  # None: all plants walk

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
            columns = _walk(setup, plan, out)
        cells = cells_of(columns)
        result = report.matrix_report(cells, plan.differs, plan.world)
        stops: list[str] = []
        if plan.rule:
            result["stopping"] = report.stopping_result(columns, plan.columns)
            stops = report.stopping_lines(result["stopping"])
            result["claims"] = [*stops, *result["claims"]]
        if out is not None:
            result |= {"config": {"flags": as_table(args)}, "environment": made_with}
            report.write_matrix_report(out, cells, result, as_command("hector evaluate", args))
    world = next(iter(plan.engines.values())).title if args.walker else args.world
    print_text = partial(report.print_matrix, cells, result["claims"])
    if len(columns) == 1:
        print_text = partial(print_tables, *columns.values(), world, more=stops)
    print_result(args.json, result, print_text)
    if out is not None:
        say(f"the report is {out / 'report.md'}")


def _compare(args: Evaluate) -> None:
    """Put finished runs side by side."""
    names = (flag.name for flag in fields(args) if flag.name not in ("runs", "json", "config"))
    if beside := [f"--{name.replace('_', '-')}" for name in names if args.is_given(name)]:
        raise InputError(f"--runs compares what has walked already, so not beside {beside[0]}")
    runs = list(map(Run, args.runs))
    finished = [run for run in runs if run.is_finished]
    for run in runs:
        if finished and run not in finished:
            say(f"{run.folder} is left out: it is not a finished run")
    comparison = compare_runs(finished or runs)
    print_result(args.json, comparison, partial(print_comparison, comparison))


def plan_of(args: Evaluate) -> EvaluationPlan:
    """Make the plan of the flags, checked before any walk.

    Raises:
        InputError: one line with the flag or the file.
    """
    robot = load_robot(args.robot)
    arguments.require_walker(args, robot)
    trajectories = {}
    for name, text in arguments.trajectories_by_name(args.traj).items():
        trajectory = arguments.load_trajectory(text, robot)
        trajectories[name] = trajectory, arguments.walk_seconds(args, trajectory)
    models = {OWN: PlantModel()}
    for text in args.plant:
        if text in OTHER_MASSES:
            name, model = text, PlantModel(mass=OTHER_MASSES[text])
        else:
            plant = arguments.load_plant(Path(text), robot)
            name, model = plant.description.name, PlantModel(plant=plant)
        if name in models:
            raise InputError(f"--plant {text}: there is a model {name!r} already")
        models[name] = model
    engines, columns = _engines(args), {}
    for column in (Column(engine, model) for engine in engines for model in models):
        columns[column] = _seeds(args, args.other_seeds if columns else args.seeds)
    first = next(iter(columns.values()))[:1]
    _check_exact(engines, arguments.plants(args.world, first, robot.description))
    paired = len(columns) > 1 or args.out is not None or args.until_clear
    sets = _sets(args, robot, trajectories, paired=paired)
    rule = _rule(args, sets, columns) if args.until_clear else None
    return EvaluationPlan(robot, args.world, trajectories, sets, models, columns, engines, rule)


def _engines(args: Evaluate) -> dict[str, Engine]:
    if args.walker:
        engine = arguments.engine_of(args)
        return {engine.name: engine}
    if "all" in args.engine:
        if len(args.engine) > 1:
            raise InputError(f"--engine all stands alone, got {' '.join(args.engine)}")
        return _installed()
    return {name: choose_engine(name) for name in args.engine}


def _check_exact(engines: Mapping[str, Engine], plants: Sequence[Imperfections]) -> None:
    """Raise an InputError, before anything walks, if MJX cannot walk on the plants."""
    if "mjx" in engines and any(np.any(x) for plant in plants for x in plant.estimator):
        raise InputError(
            "--engine mjx knows its state exactly: expected a --world whose estimator errs 0"
        )


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
    """Load the weight sets of each trajectory; a folder is a run or has a file per trajectory.

    Raises:
        InputError: a name is repeated; a file is not a weight set; or, where claims are made of
            pairs, there is no baseline or no other set.
    """
    given = [named_file(text) for text in args.weights]
    short = arguments.short_names([file for name, file in given if not name])
    files: dict[str, str] = {}
    for name, file in ((name or short[file], file) for name, file in given):
        if name in files or (name in OF_ROBOT and file != name):
            raise InputError(f"--weights {file}: there is a set {name!r} already; use NAME={file}")
        files[name] = file
    if paired and (len(files) < 2 or not {*BASELINES} & {*files}):
        against = "nominal, expert or start=FILE, which changes are against, and other sets"
        raise InputError(f"--weights must have {against}")

    def load(file: str, trajectory: str) -> Weights:
        if file not in NAMED_WEIGHTS and Path(file).is_dir():
            of_run = Path(file, "weights", "best.json")
            file = str(of_run if of_run.exists() else Path(file, f"{trajectory}.json"))
        return arguments.weights_by_name(file, robot)

    return {
        trajectory: {name: load(file, trajectory) for name, file in files.items()}
        for trajectory in trajectories
    }


def _rule(
    args: Evaluate, sets: Mapping[str, Mapping[str, Weights]], columns: Mapping[Column, range]
) -> StoppingRule:
    """Return the rule by which plants stop to walk.

    Raises:
        InputError: some column has too few plants for any claim.
    """
    per_plant = sum(map(len, sets.values()))
    claims = (per_plant - len(sets)) * len(columns)  # none about nominal
    rule = StoppingRule(claims, batch=_BATCH)
    for column, seeds in columns.items():
        if len(seeds) < rule.fewest:
            needs = (
                f"--until-clear needs {rule.fewest} plants or more for {plural(claims, 'claim')}"
            )
            raise InputError(f"{needs}, got {len(seeds)} in {report.title_of(column)}")
    return rule


def _plan_text(plan: EvaluationPlan) -> str:
    """Describe the number of walks, the plants, and the differences between engines."""
    per_plant = sum(map(len, plan.sets.values()))
    walks = plural(per_plant * sum(map(len, plan.columns.values())), "walk")
    texts = [f"{report.title_of(column)} ({len(seeds)})" for column, seeds in plan.columns.items()]
    parts = [
        f"{'at most ' if plan.rule else ''}{walks}: {per_plant} on each plant",
        f"plants: {', '.join(texts)}",
    ]
    parts += [f"in {plan.engines[name].title} {text}" for name, text in plan.differs.items()]
    return "; ".join(parts)


def _walk(setup: Setup, plan: EvaluationPlan, folder: Path | None) -> Columns:
    """Do all walks, column by column; walks whose scores are in the folder are not repeated."""
    return {
        column: judging.judge_jobs(
            setup,
            _jobs(plan, column),
            title=f"walking in {report.title_of(column)}",
            where=f" in {report.title_of(column)}" * (len(plan.columns) > 1),
            rule=plan.rule,
            folder=folder,
            engine=plan.engines[column.engine],
            about={"world": plan.world, "model": column.model},
        ).verdict
        for column in plan.columns
    }


def _jobs(plan: EvaluationPlan, column: Column) -> dict[judging.Case, Job]:
    """Return the walks of a column."""
    seeds, model = plan.columns[column], plan.models[column.model]
    drawn = arguments.plants(plan.world, seeds, (model.plant or plan.robot).description)
    plants = [plant._replace(mass=model.mass * plant.mass) for plant in drawn]
    return {
        (name, set_name, seed): Job(
            weights, command.command, plant, seconds, seed, plant=model.plant
        )
        for name, (command, seconds) in plan.trajectories.items()
        for seed, plant in zip(seeds, plants, strict=True)
        for set_name, weights in plan.sets[name].items()
    }
