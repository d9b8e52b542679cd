"""A controller of the user: what the logs of its walks show, its twin, a tuning on its walks."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from hector_jax.cli import arguments, run_folder
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Check, Tune, Twin
from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.control.reference import Command
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.twin import TwinConfig
from hector_jax.control.weights import Weights
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import say
from hector_jax.core.files import write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.pool import workers
from hector_jax.core.trajectory import FEET, State, Trajectory
from hector_jax.own.conventions import find_conventions, lines_of, settings_of
from hector_jax.own.log_check import check_log, read_check, unasked
from hector_jax.own.parity import COMPONENTS, Parity, compare_plans
from hector_jax.own.planner import (
    JUMP,
    CallCheck,
    call_planner,
    compare_calls,
    distance_to_log,
    plan_inputs,
)
from hector_jax.own.program import Program, program_of
from hector_jax.own.walk_file import read_entries, read_walk
from hector_jax.own.walk_log import at_ticks, log_of, trajectory_of
from hector_jax.own.walker import write_log
from hector_jax.report.report import first_lines, print_tables
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs
from hector_jax.store import tunings
from hector_jax.store.run import RESULT
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging, metrics
from hector_jax.walk_tuning import best_set
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.moved import along_of, walks_needed
from hector_jax.walk_tuning.walks import WalkTuning, tune_on_walks


def run_check(args: Check) -> None:
    """Say what of a log no weights can fix."""
    robot = load_robot(args.robot)
    trajectory = arguments.load_trajectory(args.traj, robot)
    seconds, config = arguments.walk_seconds(args, trajectory), walk_config(robot)
    tick = config.gait.tick
    with arguments.logs_of(args, [args.log], robot, seconds, tick) as (path,):
        log, end = read_check(path, robot, trajectory.command, seconds, tick)
    lines = [*([end] if end else []), *check_log(log, config.plan_interval)]
    if note := unasked(log):
        say(note)
    text = "\n".join(lines or ["nothing is found that weights could not fix"])
    print_result(args.json, {"found": lines}, lambda: print(text))


def run_twin(args: Twin) -> None:
    """Say how far the plans of a log are from those of the robot's file, or of a program."""
    robot = load_robot(args.robot)
    config, trajectory = walk_config(robot), arguments.load_trajectory(args.traj, robot)
    seconds = arguments.walk_seconds(args, trajectory)
    weights, tick = arguments.weights_by_name(args.weights, robot), config.gait.tick
    inputs = _Inputs(config, robot, weights, trajectory.command)
    planner = arguments.planner_of(args)
    with arguments.logs_of(args, [args.log], robot, seconds, tick) as (path,):
        read = cache(lambda twin: read_walk(path, robot, seconds, tick, twin=twin))
        if planner:
            found = _by_planner(planner, read, inputs)
        else:
            found = _by_twin(read, inputs, ours="card" in read_entries(path, ["card"]))
    result = _parity_result(found.parity)
    result |= {"ended": found.ended, "conventions": found.conventions}
    end = [found.ended] if found.ended else []
    lines = [*end, *_parity_lines(result, robot, args.planner)]
    if calls := found.calls:
        result["calls"] = {name: x for name, x in calls._asdict().items() if name != "parity"}
        lines += _call_lines(calls)
    print_result(args.json, result, lambda: print(*lines, sep="\n"))


class _Inputs(NamedTuple):
    """What a log is compared with."""

    config: WalkConfig
    robot: Robot
    weights: Weights
    command: Command


class _Compared(NamedTuple):
    """What `hector log twin` finds."""

    parity: Parity
    ended: str  # how the walk ended
    calls: CallCheck | None = None
    conventions: Mapping[str, Any] = {}  # lines of [twin], if others than those of the file fit


def _by_planner(
    planner: Program, read: Callable[[TwinConfig], tuple[Trajectory, str]], inputs: _Inputs
) -> _Compared:
    """Compare a log with the plans of a program."""
    config, robot, weights, command = inputs
    walk, end = read(config.twin)
    ticks = trajectory_of(at_ticks(log_of(walk), config.gait.tick))
    asked = plan_inputs(config, robot, weights, command, ticks)
    calls = compare_calls(partial(call_planner, planner), config, robot, asked, ticks)
    return _Compared(calls.parity, end, calls)


def _by_twin(
    read: Callable[[TwinConfig], tuple[Trajectory, str]], inputs: _Inputs, *, ours: bool
) -> _Compared:
    """Compare a log with the plans of a twin, and look for conventions by which they fit.

    `ours`: `hector walk` wrote the log, whose conventions are those of this project.
    """
    config, robot, weights, command = inputs
    if ours:
        walk, end = read(config.twin)
        return _Compared(compare_plans(config, robot, weights, command, walk), end)
    as_is, fit = find_conventions(lambda twin: read(twin)[0], config, robot, weights, command)
    readable = bool(np.isfinite(as_is.error))
    walk, end = read(config.twin if readable else fit.twin)
    parity = compare_plans(config, robot, weights, command, walk)
    if not (settings := settings_of(fit, as_is, robot)):
        return _Compared(parity, end)
    before = as_is.error if readable else None
    return _Compared(
        parity, end, conventions={"twin": settings, "error": fit.error, "as_is": before}
    )


def _call_lines(calls: CallCheck) -> Iterator[str]:
    """Return what of a planner a tuning cannot use."""
    if calls.memory > 1e-6:
        text = "called in reverse order its plans differ by"
        yield f"{text} {calls.memory:.2g}: the plan has a memory, such as a warm start or a filter"
    if calls.convention:
        told = " and ".join(calls.convention)
        yield f"its plans are those of the log, to {calls.distance:.2g}, {told}"
    if calls.jumps:
        share = 100 * calls.jumps
        yield f"{share:.0f} % of the plans jump when a state or a foot is moved by 0.1 mm or so"
    if calls.unused_weights:
        yield f"no plan depends on {', '.join(calls.unused_weights)}"
    if not calls.touchdowns_follow:
        yield "no touchdown depends on the velocity: a robot that steps so would fall"


def _parity_result(parity: Parity) -> dict[str, Any]:
    """Return the differences of plans as JSON values."""
    shares = {"median": 0.5, "99 %": 0.99, "worst": 1.0}
    row, axis = parity.worst
    return {
        "plans": parity.plans,
        "differences": {
            component: {name: float(np.quantile(x, share)) for name, share in shares.items()}
            for component, x in zip(COMPONENTS, parity.distance.T, strict=True)
        },
        "worst": {
            "at": float(parity.time[row]),
            "foot": int(parity.foot[row]),
            "component": COMPONENTS[axis],
            "logged": float(parity.logged[row, axis]),
            "twin": float(parity.twin[row, axis]),
        },
        "by_log": parity.by_log,
        "other_contact": parity.other_contact,
        "unsolved": parity.unsolved,
    }


def _parity_lines(result: Mapping[str, Any], robot: Robot, planner: Path | None) -> Iterator[str]:
    """Return the lines that `hector log twin` prints of its result."""
    yield f"{plural(result['plans'], 'plan')}; differences in N and N m, world frame"
    yield f"{'':5}" + "".join(f"{name:>10}" for name in result["differences"]["F_x"])
    for name, row in result["differences"].items():
        yield f"{name:5}" + "".join(f"{x:10.2g}" for x in row.values())
    most, other = result["worst"], planner.name if planner else "the twin"
    side = FEET[len(robot.foot_point)][most["foot"]].replace("_", " ")
    at = f"most at {most['at']:.3f} s, {side} foot, {most['component']}"
    yield f"{at}: {most['logged']:.6g} in the log, {most['twin']:.6g} of {other}"
    by_log, largest = result["by_log"], max(x["worst"] for x in result["differences"].values())
    if by_log is not None and by_log < 0.9 * largest:
        yield f"from the reference in the log on, at most {by_log:.2g}: see [twin] reference"
    if result["other_contact"]:
        share = 100 * result["other_contact"]
        yield f"in {share:.0f} % of the plans the log has other feet on the floor: see [gait]"
    if result["unsolved"]:
        yield f"{plural(result['unsolved'], 'plan')} of the twin not solved"
    if found := result["conventions"]:
        before = "" if found["as_is"] is None else f" instead of {found['as_is']:.2g}"
        text = f"in the mean the largest difference is {found['error']:.2g}{before}"
        yield f"{text} with these lines in the robot's file:"
        yield "[twin]"
        yield from lines_of(found["twin"])


def tune_walker(folder: Path, args: Tune) -> None:
    """Tune on the walks of a program, from those in the folder on; compare start and `best`.

    The table is of plants that were not walked.
    """
    robot = load_robot(args.robot)
    trajectories = run_folder.trajectories(args, robot)
    config = tunings.tune_config(robot, others=arguments.own_numbers(args, robot))
    config = arguments.with_length(config, trajectories[0].seconds)
    campaign = _campaign(folder, args, config, robot, trajectories)
    first = _check_first(args, campaign)
    if not first.takes_plants and args.walk_plants is None:
        campaign = replace(campaign, plants=campaign.plants[:1])
    _say_cost(args, campaign, first)
    commands, seconds = campaign.commands, campaign.seconds
    with workers(args.processes, args.cluster) as pool:
        tuned = tune_on_walks(pool, campaign, walks=args.walks)
        if not tuned.sets[0].accepted:
            raise InputError(f"--start {args.start}: {tuned.reason}; tune from another")
        compared = {"start": campaign.start, "best": tuned.sets[tuned.best].weights}
        setup = Setup(pool, config, robot)
        options: dict[str, Any] = {
            "seconds": seconds,
            "folder": folder,
            "engine": campaign.engine,
            "about": {"world": "standin"},
        }
        for name, weights in compared.items():
            save_weights(folder / "weights" / f"{name}.json", weights)
        seeds = range(args.seeds)
        drawn = arguments.plants("standin", seeds, robot.description)
        options["title"] = f"evaluating on {plural(len(seeds), 'plant')}"
        judged = judging.judge(setup, compared, commands, drawn, seeds, **options)
    verdict = judged.verdict
    result = {**metrics.verdict_result({"standin": verdict}), "walks": tuned.rows}
    result["kept"] = {name: x._asdict() for name, x in tuned.kept(tuned.best).items()}
    write_json(folder / RESULT, result)

    def print_text() -> None:
        print(*first_lines(verdict, ""), "", sep="\n")
        print_tables(verdict, campaign.engine.title)

    print_result(args.json, {"run": str(folder), **result}, print_text)
    means = {name: np.log(verdict.scores[name].L).mean() for name in compared}
    if means["best"] >= means["start"]:
        say("on plants that were not walked `best` is no better than the start: keep that")
    for line in _kept_lines(tuned):
        say(line)
    say(f"the weights are {folder / 'weights' / 'best.json'}")


def _kept_lines(tuned: WalkTuning) -> Iterator[str]:
    """Return what became of the commands to keep."""

    def told(number: int, broken: bool) -> str:
        found = {n: x for n, x in tuned.kept(number).items() if x.broken or not broken}
        return ", ".join(
            f"{name} {f'{x.change:+.0f} %' if x.change is not None else 'falls'}"
            + f", {plural(x.falls, 'fall')}" * bool(x.falls)
            for name, x in found.items()
        )

    if tuned.best:
        yield from (f"kept, against the start: {x}" for x in [told(tuned.best, False)] if x)
    elif refused := {i: x for i in range(len(tuned.sets)) if (x := told(i, True))}:
        sets = "; ".join(f"set {i} {x}" for i, x in refused.items())
        yield f"no better set keeps what it should ({sets}): `best` is the start"


def _campaign(
    folder: Path,
    args: Tune,
    config: TuneConfig,
    robot: Robot,
    trajectories: Sequence[NamedCommand],
) -> Campaign:
    """Return the settings of a tuning on the walks of a program."""
    kept = run_folder.kept_trajectories(args, robot, trajectories)
    groups, commands = args.slopes == "walks", len(trajectories)
    start = arguments.weights_by_name(args.start, robot)
    along = len(along_of(start, config.others, groups))
    plants, _ = best_set.walk_plants(
        robot, args.walk_plants, args.walks, commands, along=along, kept=len(kept)
    )
    return Campaign(
        folder / "walks",
        best_set.on_walks(config),
        robot,
        start,
        {trajectory.name: trajectory.command for trajectory in trajectories},
        plants,
        arguments.engine_of(args),
        arguments.planner_of(args),
        groups,
        {trajectory.name: trajectory.command for trajectory in kept},
    )


class _First(NamedTuple):
    """What the first walks of a program tell."""

    seconds: float  # that one takes
    takes_plants: bool  # whether another plant walks otherwise


def _say_cost(args: Tune, campaign: Campaign, first: _First) -> None:
    """Say on how many plants the commands walk, and what slopes by walks cost."""
    plants = plural(len(campaign.plants), "plant")
    takes = "depend on `plant`" if first.takes_plants else "do not depend on `plant`"
    say(f"the walks of {args.walker} {takes}: {plants} for each command")
    if along := campaign.along:
        sets = walks_needed(len(campaign.cases), len(along))
        more = campaign.set_walks - len(campaign.cases)  # of commands to keep
        names = ", ".join(of.name for of in along)
        text = f"the first set takes {sets[0] + more} walks, each better one {sets[1] + more}, "
        text += f"one that is no better {len(campaign.cases)}"
        say(f"the slopes by {names} are by walks: {text}")
        minutes = (args.walks or 0) * first.seconds / args.processes / 60.0
        text = f"a walk takes {first.seconds:.2g} s, so {plural(args.walks or 0, 'walk')}"
        say(f"{text} about {minutes:.2g} min with --processes {args.processes}")


def _check_first(args: Tune, campaign: Campaign) -> _First:
    """Walk once with the weights at the start, and say what no weights can fix.

    Another walk, on another plant, tells whether the program takes plants.
    """
    assert args.walker is not None
    (name, command), *_ = campaign.commands.items()
    seconds, walk = campaign.seconds, campaign.config.rollout.walk
    program = program_of(args.walker, args.walker_limit, args.walker_uses)
    job = Job(campaign.start, command, campaign.plants[0] or hfs(), seconds)
    other = best_set.drawn_plants(campaign.robot, 2)[1]
    with TemporaryDirectory() as folder, ThreadPoolExecutor(1) as pool:
        path, second = (Path(folder) / f"{x}.npz" for x in ("first", "second"))
        begun = time.monotonic()
        beside = pool.submit(write_log, program, job._replace(imperfections=other), second)
        write_log(program, job, path)
        spent = time.monotonic() - begun
        try:
            log, end = read_check(path, campaign.robot, command, seconds, walk.gait.tick)
            walked, _ = read_walk(path, campaign.robot, seconds, walk.gait.tick)
        except InputError as error:
            raise InputError(str(error).replace(str(path), f"{args.walker}: its log")) from None
        takes_plants = beside.exception() is not None or not _same_states(path, second)
    lines = [*([end] if end else []), *check_log(log, walk.plan_interval)]
    if campaign.planner and not end:
        ticks = trajectory_of(at_ticks(log_of(walked), walk.gait.tick))
        inputs = plan_inputs(walk, campaign.robot, campaign.start, command, ticks)
        away = distance_to_log(partial(call_planner, campaign.planner), walk, inputs, ticks)
        if away > JUMP * float(campaign.robot.mass * np.linalg.norm(campaign.robot.gravity)):
            text = f"the plans of {args.planner} differ from its commands by up to {away:.0f} N"
            lines.append(f"{text}: hector log twin --planner tells where")
    for line in lines:
        say(f"before any tuning, {name}: {line}")
    return _First(spent, takes_plants)


def _same_states(*paths: Path) -> bool:
    """Return whether the states in two logs are the same."""
    names = [f"state.{name}" for name in State._fields]
    one, other = (read_entries(path, names) for path in paths)
    same = one.keys() == other.keys()
    return same and all(np.array_equal(x, other[name], equal_nan=True) for name, x in one.items())
