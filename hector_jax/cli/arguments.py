"""What commands share: weights, robots, plants and trajectories of flags, and how they answer."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from hector_jax.cli.flags import View, Walk
from hector_jax.control import trajectories
from hector_jax.control.controller import walk_config
from hector_jax.control.gait import gait_named
from hector_jax.control.reference import COMMANDS
from hector_jax.control.trajectories import NamedCommand, beyond, limits
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import best, load_weights
from hector_jax.core.console import say
from hector_jax.core.files import as_json
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import to_table
from hector_jax.core.trajectory import Trajectory
from hector_jax.robot.description import Description
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import verdicts
from hector_jax.runs.cache import robot_hash
from hector_jax.runs.folder import RunRequest
from hector_jax.runs.metrics import family_of
from hector_jax.sim.engine import MUJOCO_C, Engine
from hector_jax.sim.loop import Job, check_plant
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.tuning.difftune import TuneConfig


def weights(text: str, robot: Robot) -> Weights:
    """A weight set by its name, or from a file.

    Raises:
        InputError: the file holds none.
    """
    named = {"nominal": nominal, "expert": expert, "best": best}
    return named[text](robot) if text in named else load_weights(Path(text), robot)


def short_names(texts: Sequence[str]) -> dict[str, str]:
    """Names of weight sets for a table: of a file as much of its path as tells it from the others.

    >>> short_names(["nominal", "runs/a/weights/with.json", "runs/b/other.json"])
    {'nominal': 'nominal', 'runs/a/weights/with.json': 'with', 'runs/b/other.json': 'other'}
    """
    parts = {text: Path(text).with_suffix("").parts for text in texts}
    names = {}
    for text, own in parts.items():
        others = [part for other, part in parts.items() if other != text]
        tails = (own[-k:] for k in range(1, len(own) + 1))
        unique = (tail for tail in tails if not any(o[-len(tail) :] == tail for o in others))
        names[text] = "/".join(next(unique, (text,)))
    return names


def print_result(json: bool, result: Any, in_words: Callable[[], None], **form: Any) -> None:
    """Print the result of a command: as JSON where --json asks for it, else in words."""
    if json:
        print(as_json(result, **form))
    else:
        in_words()


def print_errors(errors: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the errors of nets, as `training.report` gives them."""
    print("mean square errors on held-out walks")
    for name, of in errors.items():
        print(f"{name:9s} force {of['force']:8.2f} N^2   moment {of['moment']:7.4f} (N m)^2")


def folder_of(folder: Path, path: Path | None, robot: Robot) -> Path:
    """Another robot than the packaged one, so one with a `path`, has its own folder in there."""
    return folder if path is None else folder / robot.description.name


def robot_of(run: Path, begun: RunRequest) -> Robot:
    """The robot that a run was tuned for.

    Raises:
        InputError: its files say something else now.
    """
    robot = load_robot(begun.robot)
    if begun.body not in (None, robot_hash(robot)):
        path = robot.description.path
        raise InputError(f"{run} was tuned for another robot: {path} or its MJCF has changed")
    return robot


def default_of(flag: Path, usual: Path, path: Path | None, robot: Robot) -> Path:
    """A folder as it was given; where it was not, that of the robot: DATA/NAME for DATA/..."""
    if path is None or flag != usual:
        return flag
    return folder_of(Path(usual.parts[0]), path, robot).joinpath(*usual.parts[1:])


def plants(world: str, seeds: range, description: Description) -> list[Imperfections]:
    """One plant of a world for each seed, sized for the robot of a description."""
    family = family_of(world)
    draw = FAMILIES[family] if family else partial(named_world, world)
    return [draw(seed, description) for seed in seeds]


def plant_of(path: Path | None, robot: Robot) -> Robot | None:
    """The model of the robot that is walked on, where it is another.

    Raises:
        InputError: its file is wrong, or its joints are not the robot's.
    """
    if path is None:
        return None
    plant = load_robot(path)
    check_plant(robot.description, plant.description)
    return plant


def with_gait(robot: Robot, name: str) -> Robot:
    """The robot with a gait; `own` is that of its file.

    Raises:
        InputError: it has other feet than the gait.
    """
    if name == "own":
        return robot
    description = robot.description
    try:
        gait = gait_named(walk_config(robot).gait, name)
    except InputError as error:
        raise InputError(f"--gait: {error}") from None
    control = dict(description.control) | {"gait": tuple(to_table(gait).items())}
    return robot._replace(description=replace(description, control=tuple(control.items())))


def course(text: str, robot: Robot) -> NamedCommand:
    """What to walk; one line says where a file asks for more than the robot may be able to.

    A robot whose feet all stand stays where it is.

    Raises:
        InputError: there is no such trajectory, or its file is wrong.
    """
    trajectory, gait = trajectories.command_of(text), walk_config(robot).gait
    if gait.swing == 0:
        say(f"{text} is not walked: all feet stand")
        moves = trajectory.command
        still = moves._replace(velocity=0.0 * moves.velocity, yaw_rate=0.0 * moves.yaw_rate)
        return trajectory._replace(command=still)
    if trajectory.seconds and (excess := beyond(limits(robot, gait), trajectory.command)):
        say(f"warning: {text}: {excess}")
    return trajectory


def by_name(texts: Sequence[str]) -> dict[str, str]:
    """Trajectories by their names; `all` are the three of the paper.

    Raises:
        InputError: two have one name, or there is no such trajectory.
    """
    names: dict[str, str] = {}
    for text in dict.fromkeys(t for one in texts for t in (COMMANDS if one == "all" else (one,))):
        other = names.setdefault(name := trajectories.command_of(text).name, text)
        if other != text:
            raise InputError(f"--traj {other} and {text} are both named {name}")
    return names


def courses(texts: Sequence[str], robot: Robot, hint: str = "") -> tuple[NamedCommand, ...]:
    """What one weight set is to walk; `all` are the three of the paper.

    `hint` ends the message where they last differently.

    Raises:
        InputError: see `course` and `by_name`; or they last differently.
    """
    found = tuple(course(text, robot) for text in by_name(texts).values())
    if len({one.seconds or Walk.seconds for one in found}) > 1:
        lasts = ", ".join(f"{one.name} {one.seconds or Walk.seconds:g} s" for one in found)
        raise InputError(f"--traj expects trajectories of one length, got {lasts}{hint}")
    return found


def seconds(flag: float, trajectory: NamedCommand) -> float:
    """Length of a walk [s]: what the trajectory's file says, else what the flag does.

    Raises:
        InputError: both say one.
    """
    if trajectory.seconds is None:
        return flag
    if flag != Walk.seconds:
        raise InputError(
            f"--seconds is for built-in trajectories: {trajectory.name} lasts "
            f"{trajectory.seconds:g} s, as its file says, got {flag:g}"
        )
    return trajectory.seconds


def with_length(config: TuneConfig, trajectory: NamedCommand) -> TuneConfig:
    """The tuning with rollouts as long as the trajectory, where its file says how long."""
    if trajectory.seconds is None:
        return config
    ticks = round(trajectory.seconds / config.rollout.walk.gait.tick)
    return replace(config, rollout=replace(config.rollout, ticks=ticks))


def walk_once(
    args: Walk | View,
    robot: Robot,
    course: NamedCommand,
    weights: Weights,
    plant: Robot | None,
    engine: Engine = MUJOCO_C,
) -> Trajectory:
    """One walk in the world of the flags; `plant` is another model of the robot."""
    if args.world == "srbm":
        lasts = seconds(args.seconds, course)
        return verdicts.walk_rigid_body(robot, weights, course.command, lasts)
    jobs = [job_of(args, robot, course, weights, plant)]
    return next(engine.walk(None, walk_config(robot), robot, jobs))


def job_of(
    args: Walk | View, robot: Robot, course: NamedCommand, weights: Weights, plant: Robot | None
) -> Job:
    """The walk of the flags in a world of MuJoCo; `plant` is another model of the robot."""
    body = (plant or robot).description
    (imperfections,) = plants(args.world, range(args.seed, args.seed + 1), body)
    lasts = seconds(args.seconds, course)
    return Job(weights, course.command, imperfections, lasts, args.seed, plant=plant)
