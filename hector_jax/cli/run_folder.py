"""The folder of a run of `hector tune`: create it with its flags, and resume it."""

import dataclasses
import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from hector_jax.cli import arguments
from hector_jax.cli.flags import Flags, Tune, with_given
from hector_jax.cli.parse import as_table, from_file
from hector_jax.control.parameters import tunables
from hector_jax.control.trajectories import NamedCommand
from hector_jax.core.environment import code_hash, environment
from hector_jax.core.files import as_json, make_folder, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.journal import check_settings
from hector_jax.core.settings import convert
from hector_jax.robot.model import Robot, load_robot
from hector_jax.store import tunings
from hector_jax.store.cache import robot_hash
from hector_jax.store.nets import COLLECTION_CODE, load_trained
from hector_jax.store.run import CONFIG, VERSIONS, Run, flattened
from hector_jax.walk_tuning import best_set
from hector_jax.walk_tuning.moved import along_of

F = TypeVar("F", bound=Flags)

_REMEDY = "start a new run"
TIME = "%Y%m%d-%H%M%S"  # names a run
_CODE = (
    *COLLECTION_CODE,
    "grfm.training",
    "sim.standin",
    "walk_tuning.best_set",
    "walk_tuning.walks",
)
# flags of a call, not of the run that it begins or resumes
_CALL_FLAGS = ("config", "out", "resume")
# flags that may change when a run is resumed
_FREE_FLAGS = (
    *("cluster", "data", "json", "processes", "video"),
    *("walker", "walker_limit", "walker_uses"),  # the record of its walks tells what it is
    "planner",  # of which walks do not depend: it may be fixed in between
)
# flags that say nothing to a program of the user
_OF_OUR_CONTROLLER = "alpha data iterations net safe smooth variant".split()


def _exists_error(folder: Path) -> InputError:
    """Return the error for a run folder that exists."""
    return InputError(f"run folder {folder} exists; --resume continues it, --out names another")


def trajectories(args: Tune, robot: Robot) -> tuple[NamedCommand, ...]:
    """Load the trajectories of a tuning and check them against the other flags.

    Raises:
        InputError: there is no such trajectory, their lengths differ, or --walks is too few for
            them; --walk-engine is not installed; --safe beside a position limit; --tune names
            numbers that no gradient tunes; --start is out of their box; --net is not its net.
    """
    loaded = arguments.load_trajectories(args.traj, robot)
    _check_walker(args, robot)
    numbers = arguments.own_numbers(args, robot)
    config = tunings.tune_config(robot, others=(*tunables(args.tune), *numbers))
    start = arguments.weights_to_tune(args.start, robot, config)
    kept = len(kept_trajectories(args, robot, loaded))
    along = len(along_of(start, numbers, args.slopes == "walks"))
    best_set.walk_plants(robot, args.walk_plants, args.walks, len(loaded), along=along, kept=kept)
    if args.net:
        load_trained(args.net, robot, args.variant)
    arguments.engine_of(args)  # whether it is installed
    if args.safe and "position_limit" in start.others:
        raise InputError("--safe sets the position limit, which --start has already")
    return loaded


def kept_trajectories(
    args: Tune, robot: Robot, tuned: Sequence[NamedCommand]
) -> tuple[NamedCommand, ...]:
    """Load the trajectories that a tuning keeps.

    Raises:
        InputError: there is no such trajectory, it is tuned, or is of another length.
    """
    loaded = arguments.load_trajectories((*args.traj, *args.keep), robot, "--traj and --keep")
    names = [trajectory.name for trajectory in tuned]
    for name in arguments.trajectories_by_name(args.keep):
        if name in names:
            raise InputError(f"--keep {name} is tuned: it stands in --traj")
    return tuple(x for x in loaded if x.name not in names)


def _check_walker(args: Tune, robot: Robot) -> None:
    """Raise an InputError if the flags of a tuning do not go with a program of the user."""
    if args.walker is None:
        if args.planner:
            raise InputError("--planner plans for the walks of a --walker, which is not given")
        if given := [flag for flag in ("keep", "slopes") if args.is_given(flag)]:
            raise InputError(f"--{given[0]} is for the walks of a --walker, which is not given")
        arguments.require_walker(args, robot)
        return
    if not args.walks:
        raise InputError("--walker needs --walks, the number of its walks that a tuning may take")
    if args.slopes == "walks" and args.planner:
        raise InputError("--slopes walks and --planner: only one can be given")
    if args.tune != ("weights",):
        raise InputError(f"--tune must be weights beside --walker, got {' '.join(args.tune)}")
    if given := [name for name in _OF_OUR_CONTROLLER if args.is_given(name)]:
        flag = given[0].replace("_", "-")
        raise InputError(f"--{flag} is for this project's controller, so not beside --walker")


def run_flags(args: Tune) -> Tune:
    """Return the flags of one run without its folders, which do not change the results."""
    return replace(args, out=None, resume=None)


def begin(folder: Path, args: Tune) -> Path:
    """Create the folder of a new run with its flags in one step, so that it can be resumed.

    Returns:
        The folder; if its name was not set by a flag and exists, that of the next free second.
    """
    make_folder(folder.parent)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as part:
        new = Path(part) / "run"
        write_json(new / VERSIONS, environment())
        config = {
            "flags": as_table(run_flags(args)),
            "began": f"{datetime.now():{TIME}}",
            "directory": str(Path.cwd()),
            "robot": robot_hash(load_robot(args.robot)),
            "code": code_hash(_CODE),
        }
        write_json(new / CONFIG, config)
        while True:
            try:
                return new.rename(folder)
            except OSError as error:
                if not folder.exists():
                    raise InputError(f"cannot write {folder}: {error.strerror}") from None
                if args.out:
                    raise _exists_error(folder) from None
            later = datetime.strptime(folder.name, TIME) + timedelta(seconds=1)
            folder = folder.with_name(f"{later:{TIME}}")


def resume(folder: Path, args: Tune) -> Tune:
    """Return the flags of the run in `folder`; those that were given must agree with them.

    Flags that change no number may differ; this call's value is used.

    Raises:
        InputError: one line naming the file: no run, other flags, other code, another robot, or
            no data in this directory.
    """
    path, run = folder / CONFIG, Run(folder)
    config, made_with = run.config, run.made_with
    for name in ("robot", "code", "directory"):
        convert(config.get(name), str, name=f"{path}: {name}")
    remedy = f"{_REMEDY} ({made_with.get('commit', 'no commit is noted')})"
    # the flags of other code may be others
    check_settings(folder, {"code": config["code"]}, {"code": code_hash(_CODE)}, remedy)
    begun = from_file(Tune, path)
    robot = robot_hash(load_robot(begun.robot))
    check_settings(folder, {"robot": config["robot"]}, {"robot": robot}, remedy)
    asked = with_given(_named(args), args.given)
    flags = merge_flags(folder, begun, asked, call_flags=_CALL_FLAGS)
    data = arguments.data_folder(flags.data, flags.robot, load_robot(flags.robot))
    is_made = flags.walker or flags.net or data.exists()
    if not is_made and Path(config["directory"]) != Path.cwd():
        raise InputError(
            f"{data}: no data here; the run was begun in {config['directory']}: resume it there, "
            "or name the folder by --data"
        )
    return flags


def merge_flags(folder: Path, begun: F, args: F, call_flags: Sequence[str]) -> F:
    """Merge the flags of a folder with those of this call, which must agree.

    Args:
        folder: for the message.
        begun, args: flags of the folder and of this call.
        call_flags: names of the flags that are taken from this call alone.

    Raises:
        InputError: one line with the first flag that differs.
    """
    flags = {}
    for field in dataclasses.fields(begun):
        name = field.name
        if name in call_flags:
            continue
        old, new = getattr(begun, name), getattr(args, name)
        flags[name] = new if args.is_given(name) else old
        is_free = name in _FREE_FLAGS and not (name == "walker" and old is None)
        if not is_free and flags[name] != old:
            old, new = (" ".join(x) if isinstance(x, tuple) else x for x in (old, new))
            flag = f"--{name.replace('_', '-')}"
            raise InputError(f"{folder}: begun with {flag} {old}, got {new}")
    return replace(args, **flags)


def note_settings(folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Add resolved settings to config.json and return all that is in it.

    Raises:
        InputError: they differ from those recorded when the run was begun.
    """
    path = folder / CONFIG
    recorded, as_read = Run(folder).config, json.loads(as_json(settings))
    if before := {name: recorded[name] for name in as_read if name in recorded}:
        check_settings(folder, flattened(before), flattened(as_read), _REMEDY)
    write_json(path, recorded | settings)
    return recorded | settings


def _named(args: Tune) -> Tune:
    """Return the flags with each trajectory by itself."""
    names = arguments.trajectories_by_name
    one = {flag: tuple(names(getattr(args, flag)).values()) for flag in ("traj", "keep")}
    return replace(args, traj=one["traj"], keep=one["keep"])


def plan_run(args: Tune) -> tuple[Path, Tune]:
    """Return the folder of a new run and its flags, checked.

    Raises:
        InputError: one line with the flag that is wrong, or the folder exists.
    """
    robot = load_robot(args.robot)
    flags = with_given(_named(args), args.given)
    name = "-".join(trajectory.name for trajectory in trajectories(flags, robot))
    if args.out and args.out.exists():
        raise _exists_error(args.out)
    runs = arguments.robot_folder(Path("runs"), args.robot, robot)
    return args.out or runs / name / f"{datetime.now():{TIME}}", flags
