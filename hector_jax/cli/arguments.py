"""Shared parts of the commands: weights, robots, plants and trajectories of flags, and printing."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hector_jax.cli.flags import (
    ByMapping,
    ByPlanner,
    ByWalker,
    Check,
    Collect,
    Evaluate,
    Foretell,
    Train,
    Tune,
    View,
    Walk,
)
from hector_jax.control import trajectories
from hector_jax.control.controller import walk_config
from hector_jax.control.gait import gait_named
from hector_jax.control.parameters import Tunable, check_in_box, numbers_of
from hector_jax.control.reference import COMMANDS
from hector_jax.control.trajectories import NamedCommand, beyond, limits
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights, shipped, with_numbers
from hector_jax.core.console import say
from hector_jax.core.files import as_json
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import to_table
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree_file import ROBOT_DIGITS, read_card, tree_hash
from hector_jax.own.bag import read_bag, read_mapping
from hector_jax.own.program import Program, program_of
from hector_jax.own.walker import Walker, walker_engine
from hector_jax.robot.description import Description
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import MUJOCO_C, Engine, choose_engine
from hector_jax.sim.loop import Job, check_plant
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.tuning import difftune
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging
from hector_jax.verdict.metrics import family_of


def weights_by_name(text: str, robot: Robot) -> Weights:
    """Return a weight set by its name, or from a file, with all of the robot's numbers.

    Raises:
        InputError: the file holds none.
    """
    named = {"nominal": nominal, "expert": expert, "shipped": shipped}
    if text in named:
        return with_numbers(named[text](robot), robot)
    return load_weights(Path(text), robot)


def weights_to_tune(text: str, robot: Robot, config: TuneConfig) -> Weights:
    """Return the weight set of this name, or of a file, from which a tuning is to start.

    Raises:
        InputError: the file holds none, or a number is out of the box of the tuning.
    """
    weights = weights_by_name(text, robot)
    try:
        check_in_box(difftune.init(config, weights).start, config.others)
    except InputError as error:
        raise InputError(f"--start {text}: {error}") from None
    return weights


def engine_of(args: Evaluate | Tune | Walk) -> Engine:
    """Return the engine that the flags name, or the program of the user in its place.

    Raises:
        InputError: both are given, or it is not there.
    """
    flag = "walk_engine" if isinstance(args, Tune) else "engine"
    if args.walker is None:
        return choose_engine(getattr(args, flag))
    if args.is_given(flag):
        raise InputError(f"--{flag.replace('_', '-')} and --walker: only one can be given")
    for name in ("gait", "plant"):
        if hasattr(args, name) and args.is_given(name):
            text = f"--{name.replace('_', '-')} is for this project's controller and simulators"
            raise InputError(f"{text}, so not beside --walker")
    program = program_of(args.walker, args.walker_limit, args.walker_uses)
    strict = not isinstance(args, Tune)  # which goes on over night
    return walker_engine(Walker(program, strict, args.out if isinstance(args, Walk) else None))


def planner_of(args: ByPlanner) -> Program | None:
    """Return the program that plans, or None; InputError if it is not there."""
    if args.planner is None:
        return None
    settings = args if isinstance(args, ByWalker) else ByWalker()
    return program_of(args.planner, settings.walker_limit, settings.walker_uses)


@contextmanager
def logs_of(
    args: ByMapping, paths: Sequence[Path], robot: Robot, seconds: float, tick: float
) -> Iterator[list[Path]]:
    """Yield logs: those of a --mapping are bags, of which logs are made for as long.

    Args:
        args: with the mapping, if any.
        paths: logs, or bags.
        robot, seconds, tick: see `own.bag.read_bag`.

    Raises:
        InputError: see `own.bag.read_bag`; or a log is a folder.
    """
    if args.mapping is None:
        if folder := next(filter(Path.is_dir, paths), None):
            raise InputError(f"{folder}: a bag needs a --mapping, else a log is a file (.npz)")
        yield list(paths)
        return
    mapping = read_mapping(args.mapping)
    with TemporaryDirectory(prefix="hector-bag-") as folder:
        logs = [Path(folder) / f"{number}-{path.name}.npz" for number, path in enumerate(paths)]
        for path, log in zip(paths, logs, strict=True):
            entries: dict[str, Any] = {**read_bag(path, mapping, robot, seconds, tick)}
            np.savez(log, by_name=np.array(True), **entries)
        try:
            yield logs
        except InputError as error:
            text = str(error)
            for path, log in zip(paths, logs, strict=True):
                text = text.replace(str(log), str(path))
            raise InputError(text) from None


def require_walker(args: ByWalker, robot: Robot) -> None:
    """Raise an InputError for a robot with numbers of another controller, without a --walker."""
    if robot.description.numbers and args.walker is None:
        text = "[numbers] are of a controller of your own, which walks with --walker"
        raise InputError(f"{robot.description.path}: {text}")


def own_numbers(args: ByPlanner, robot: Robot) -> tuple[Tunable, ...]:
    """Return the robot's numbers; without a planner all are as those of the legs, by walks."""
    numbers = numbers_of(robot.description)
    return numbers if args.planner else tuple(x._replace(path="legs") for x in numbers)


def short_names(texts: Sequence[str]) -> dict[str, str]:
    """Return names of weight sets for a table; for a file, the shortest unique end of its path.

    >>> short_names(["nominal", "runs/a/weights/with.json", "runs/b/other.json"])
    {'nominal': 'nominal', 'runs/a/weights/with.json': 'with', 'runs/b/other.json': 'other'}
    """
    parts = {text: Path(text.removesuffix(Path(text).suffix)).parts for text in texts}
    names = {}
    for text, path in parts.items():
        others = [other for other_text, other in parts.items() if other_text != text]
        ends = (path[-k:] for k in range(1, len(path) + 1))
        unique = (end for end in ends if not any(other[-len(end) :] == end for other in others))
        names[text] = "/".join(next(unique, (text,)))
    return names


def print_result(json: bool, result: Any, print_text: Callable[[], None]) -> None:
    """Print the result of a command: as JSON if --json is set, else as text."""
    if json:
        print(as_json(result))
    else:
        print_text()


def print_errors(errors: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the errors of nets, as `training.errors_by_phi` returns them."""
    print("mean square errors on held-out walks")
    for name, error in errors.items():
        print(f"{name:9s} force {error['force']:8.2f} N^2   moment {error['moment']:7.4f} (N m)^2")


def robot_folder(folder: Path, path: Path | None, robot: Robot) -> Path:
    """Return the folder, or its subfolder for a robot from a TOML file at `path`."""
    return folder if path is None else folder / robot.description.name


def data_folder(folder: Path, path: Path | None, robot: Robot) -> Path:
    """Return `robot_folder`; with a hash of the robot if it has data of another robot."""
    named, own = robot_folder(folder, path, robot), tree_hash(robot, ROBOT_DIGITS)
    if path is None:
        return named
    apart = named.with_name(f"{named.name}-{own[:6]}")
    if apart.exists():
        return apart
    first = min(named.rglob("*.npz"), default=None)
    with suppress(InputError):  # a damaged file is told where it is used
        if first is not None and read_card(first)["robot"] not in (None, own):
            return apart
    return named


def flag_folder(args: Collect | Train, name: str, robot: Robot) -> Path:
    """Return the folder of a flag; for another robot its default DATA/... is DATA/NAME/..."""
    folder = getattr(args, name)
    if args.is_given(name):
        return folder
    return data_folder(Path(folder.parts[0]), args.robot, robot).joinpath(*folder.parts[1:])


def plants(world: str, seeds: range, description: Description) -> list[Imperfections]:
    """Draw one plant of a world for each seed, sized for the robot of a description."""
    family = family_of(world)
    draw = FAMILIES[family] if family else partial(named_world, world)
    return [draw(seed, description) for seed in seeds]


def load_plant(path: Path, robot: Robot) -> Robot:
    """Load another model of the robot.

    Raises:
        InputError: its file is wrong, or its joints are not the robot's.
    """
    plant = load_robot(path)
    check_plant(robot.description, plant.description)
    return plant


def with_gait(robot: Robot, name: str) -> Robot:
    """Return the robot with a named gait; `own` is the gait of its file.

    Raises:
        InputError: its number of feet does not match the gait.
    """
    if name == "own":
        return robot
    description, own = robot.description, walk_config(robot).gait
    try:
        gait = gait_named(own, name)
    except InputError as error:
        raise InputError(f"--gait: {error}") from None
    if gait == own:
        return robot
    control = dict(description.control) | {"gait": tuple(to_table(gait).items())}
    return robot._replace(description=replace(description, control=tuple(control.items())))


def load_trajectory(text: str, robot: Robot) -> NamedCommand:
    """Load a trajectory by name or file; one line warns if it may exceed what the robot can do.

    A robot whose feet all stand stays in place.

    Raises:
        InputError: there is no such trajectory, or its file is wrong.
    """
    trajectory, gait = trajectories.command_of(text), walk_config(robot).gait
    if gait.swing == 0:
        say(f"{text} is not walked: all feet stand")
        command = trajectory.command
        still = command._replace(velocity=0.0 * command.velocity, yaw_rate=0.0 * command.yaw_rate)
        return trajectory._replace(command=still)
    # rows of a twist that a leg controls: 5 is the yaw of its sole; a point turns on the floor
    turns, structure = np.any(trajectory.command.yaw_rate), robot.structure
    if turns and structure.contact != "point" and 5 not in structure.placed:
        say(
            f"warning: {text}: the legs cannot turn their soles (no yaw joint), so that a curve "
            "makes them slip; expect falls, or take a straight trajectory"
        )
    if trajectory.seconds and (excess := beyond(limits(robot, gait), trajectory.command)):
        say(f"warning: {text}: {excess}")
    return trajectory


def trajectories_by_name(texts: Sequence[str]) -> dict[str, str]:
    """Return the texts of the trajectories by name; `all` are the three of the paper.

    Raises:
        InputError: two have one name, or there is no such trajectory.
    """
    names: dict[str, str] = {}
    for text in [name for t in texts for name in (COMMANDS if t == "all" else [t])]:
        other = names.setdefault(name := trajectories.command_of(text).name, text)
        if other != text:
            raise InputError(f"--traj {other} and {text} are both named {name}")
    return names


def load_trajectories(
    texts: Sequence[str], robot: Robot, flags: str = "--traj"
) -> tuple[NamedCommand, ...]:
    """Load the trajectories of one weight set; `all` are the three of the paper.

    Args:
        texts, robot: names or files, and who walks.
        flags: by which they are given, for messages.

    Raises:
        InputError: see `load_trajectory` and `trajectories_by_name`; or their lengths differ.
    """
    loaded = tuple(load_trajectory(text, robot) for text in trajectories_by_name(texts).values())
    lengths = {trajectory.name: trajectory.seconds or Walk.seconds for trajectory in loaded}
    if len(set(lengths.values())) > 1:
        lasts = ", ".join(f"{name} {seconds:g} s" for name, seconds in lengths.items())
        raise InputError(f"{flags}: expected trajectories of one length, got {lasts}")
    return loaded


def walk_seconds(
    args: Check | Evaluate | Foretell | Walk | View, trajectory: NamedCommand
) -> float:
    """Return the length of a walk [s]: from the trajectory's file if it has one, else --seconds.

    Raises:
        InputError: both set a length.
    """
    if trajectory.seconds is None:
        return args.seconds
    if args.is_given("seconds"):
        raise InputError(
            f"--seconds is for built-in trajectories: {trajectory.name} lasts "
            f"{trajectory.seconds:g} s, as its file says, got {args.seconds:g}"
        )
    return trajectory.seconds


def with_length(config: TuneConfig, seconds: float | None) -> TuneConfig:
    """Return the tuning with rollouts of this length [s]; None, as of a trajectory: unchanged."""
    if seconds is None:
        return config
    ticks = round(seconds / config.rollout.walk.gait.tick)
    return replace(config, rollout=replace(config.rollout, ticks=ticks))


def walk_once(
    args: Walk | View,
    robot: Robot,
    trajectory: NamedCommand,
    weights: Weights,
    *,
    plant: Robot | None = None,
    engine: Engine = MUJOCO_C,
) -> Trajectory:
    """Walk once in the world of the flags; `plant` is another model of the robot."""
    if args.world == "srbm":
        seconds = walk_seconds(args, trajectory)
        return judging.walk_rigid_body(robot, weights, trajectory.command, seconds)
    job = job_of(args, robot, trajectory, weights, plant)
    return next(engine.walk(None, walk_config(robot), robot, [job]))


def job_of(
    args: Walk | View, robot: Robot, trajectory: NamedCommand, weights: Weights, plant: Robot | None
) -> Job:
    """Return the walk of the flags in a world of MuJoCo; `plant` is another model of the robot."""
    body = (plant or robot).description
    (imperfections,) = plants(args.world, range(args.seed, args.seed + 1), body)
    seconds = walk_seconds(args, trajectory)
    return Job(weights, trajectory.command, imperfections, seconds, args.seed, plant=plant)
