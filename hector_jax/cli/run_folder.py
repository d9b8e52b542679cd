"""The folder of a run of `hector tune`: begun with its flags, and resumed by them."""

import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from hector_jax.cli import arguments
from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table, from_file
from hector_jax.core.environment import code_hash, environment
from hector_jax.core.files import make_folder, write_json
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs.cache import robot_hash
from hector_jax.runs.folder import CONFIG, VERSIONS, read_object
from hector_jax.runs.nets import COLLECTION_CODE

Flags = TypeVar("Flags")

TIME = "%Y%m%d-%H%M%S"  # names a run
_CODE = (*COLLECTION_CODE, "grfm.training", "sim.standin", "runs.choice", "runs.walks")
# flags of a call, not of the run that it begins or resumes
_OF_A_CALL = ("config", "each", "out", "resume", "run", "runs")
_FREE = ("data", "json", "processes", "verdict", "video")  # may be others when a run is resumed


def exists_error(folder: Path) -> InputError:
    """The error of a run folder that exists."""
    return InputError(
        f"run folder {folder} exists; continue it with --resume or name another with --out"
    )


def as_begun(args: Tune) -> Tune:
    """The flags of one run, without the folders: in another folder they ask for the same."""
    return replace(args, each=False, out=None, run=None, resume=None)


def begin(folder: Path, args: Tune) -> Path:
    """Make the folder of a new run, at once with its flags: one that is there can be resumed.

    Returns:
        The folder; if nobody named it and it is there, that of the next free second.
    """
    make_folder(folder.parent)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as part:
        new = Path(part) / "run"
        write_json(new / VERSIONS, environment())
        config = {
            "flags": as_table(as_begun(args)),
            "directory": str(Path.cwd()),
            "robot": robot_hash(load_robot(args.robot)),
            "code": code_hash(*_CODE),
        }
        write_json(new / CONFIG, config)
        while True:
            try:
                return new.rename(folder)
            except OSError as error:
                if not folder.exists():
                    raise InputError(f"cannot write {folder}: {error.strerror}") from None
                if args.out or args.run:
                    raise exists_error(folder) from None
            later = datetime.strptime(folder.name, TIME) + timedelta(seconds=1)
            folder = folder.with_name(f"{later:{TIME}}")


def resume(folder: Path, args: Tune) -> Tune:
    """The flags of the run in `folder`; those given beside --resume have to agree.

    A flag at its default counts as not given. Of those that change no number the given one is
    taken.

    Raises:
        InputError: one line naming the file: no run, one of other flags, other code, another robot,
            or one whose data are not here.
    """
    path = folder / CONFIG
    config, made_with = read_object(path), read_object(folder / VERSIONS)
    for name in ("robot", "code", "directory"):
        if not isinstance(config.get(name), str):
            raise InputError(f"{path}: {name} must be text, got {short_repr(config.get(name))}")
    begun = from_file(Tune, path)
    if config["code"] != code_hash(*_CODE):
        commit = made_with.get("commit", "no commit is noted")
        raise InputError(
            f"{folder}: begun with other code or other versions of its packages ({commit}); "
            "start a new run"
        )
    check_agreement(folder, config, {"robot": robot_hash(load_robot(begun.robot))})
    now = agreed(folder, begun, args, of_a_call=_OF_A_CALL)
    data = arguments.folder_of(now.data, now.robot, load_robot(now.robot))
    if not now.net and not data.exists() and Path(config["directory"]) != Path.cwd():
        raise InputError(
            f"{data}: no data here; the run was begun in {config['directory']}: resume it there, "
            "or name the folder by --data"
        )
    return now


def agreed(folder: Path, begun: Flags, args: Flags, of_a_call: Sequence[str]) -> Flags:
    """The flags with which a folder was begun; those given beside it have to agree.

    Args:
        folder: for the message.
        begun, args: flags of the folder and of this call, where a default counts as not given.
        of_a_call: names of those that are the call's.

    Raises:
        InputError: one line with the first flag that differs.
    """
    flags = {}
    for field in dataclasses.fields(begun):  # pyright: ignore[reportArgumentType]
        name = field.name
        if name in of_a_call:
            continue
        before, given = getattr(begun, name), getattr(args, name)
        flags[name] = before if given == field.default else given
        if name not in _FREE and flags[name] != before:
            before, given = (" ".join(x) if isinstance(x, tuple) else x for x in (before, given))
            raise InputError(f"{folder}: begun with --{name} {before}, got {given}")
    return replace(args, **flags)  # pyright: ignore[reportArgumentType]


def check_agreement(folder: Path, begun: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Hold what a run follows from against what it followed from when it was begun.

    Raises:
        InputError: one line naming the folder and the first setting that differs.
    """
    for name, value in now.items():
        if isinstance(value, dict):
            before = begun.get(name, {})
            if not isinstance(before, dict):
                raise InputError(f"{folder / CONFIG}: {name}: no settings: {before!r}")
            check_agreement(folder, before, value)
        elif begun.get(name, value) != value:
            raise InputError(f"{folder}: begun with {name} {begun[name]}, here is {value}")


def by_folder(args: Tune, base: Path | None, robot: Robot) -> dict[Path, Tune]:
    """The flags of each run by its folder.

    Args:
        args: of the command.
        base: the folder that was named, if any.
        robot: that is tuned.

    Raises:
        InputError: two trajectories of one name, or of runs that were tuned one by one.
    """
    names = arguments.by_name(args.traj)
    if args.resume and not args.each and (args.resume / next(iter(names)) / CONFIG).exists():
        raise InputError(f"{args.resume}: its trajectories were tuned one by one; add --each")
    now = f"{datetime.now():{TIME}}"
    parent = arguments.folder_of(args.runs, args.robot, robot)
    # beside --resume a trajectory that was not given is that of the run
    as_before = args.resume and args.traj == Tune.traj
    shared = args if as_before else replace(args, traj=tuple(names.values()))
    if args.each:
        each = {name: replace(args, traj=(text,)) for name, text in names.items()}
        return {base / n if base else parent / n / now: one for n, one in each.items()}
    return {base or parent / "-".join(names) / now: shared}
