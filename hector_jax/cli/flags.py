"""The flags of each command; a field's comment is its help text.

What is allowed stands beside the type. Flags come from a command line (`from_line`) and from a file
(`from_file`), and go out again as JSON (`settings`) or as a command line (`as_command`).
"""

import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from hector_jax.core.inputs import (
    SEED,
    InputError,
    Range,
    check_file,
    did_you_mean,
    one_line,
    plural,
    read_json,
    read_toml,
    short_repr,
    validation_error,
)

NAMED_WEIGHTS = ("nominal", "expert")
LATEST = Path("latest")  # stands for the newest run


class Source(Enum):
    """What a flag names; it is looked for before the slow imports."""

    FILE = "a file"
    RUN = "the folder of a run of `hector tune`"
    FOLDER = "a folder"  # which may be missing
    EXPORTABLE = "a run folder or a weights file"
    WEIGHTS = "nominal, expert or a weights file"
    TRAJECTORY = "a name or a TOML file"
    ROBOT = "a TOML file that names an MJCF (docs/howto/robot.md)"


Processes = Annotated[int, Range(1, 1024)]
Plants = Annotated[int, Range(1, 10_000)]
Seed = Annotated[int, SEED]
Iterations = Annotated[int, Range(10, 10_000)]  # at least the ten of the paper, of which it tells
Seconds = Annotated[float, Range(0.01, 600)]  # at least one tick
Variant = Literal["residual", "paper"]
Engine = Literal["auto", "c", "mjx"]
Robot = Annotated[Path | None, Source.ROBOT]
Weights = Annotated[str, Source.WEIGHTS]
Trajectory = Annotated[str, Source.TRAJECTORY]
Run = Annotated[Path, Source.RUN]
Folder = Annotated[Path, Source.FOLDER]


@dataclass(frozen=True, kw_only=True)
class Configured:
    """A command whose flags may come from a file."""

    config: Path | None = None  # TOML file of flags, or a run's config.json; the line overrides it


@dataclass(frozen=True)
class Collect(Configured):
    """Walk on the high-fidelity simulator and record the measured ground forces.

    Example: hector collect --walks 128 --out data/more
    """

    out: Folder = Path("data/walks")  # folder for the walks; those already in it are kept
    walks: Annotated[int, Range(1, 100_000)] = 64  # number of walks
    seconds: Annotated[float, Range(0, 600, above=True)] = 4.0  # length of each walk [s]
    seed: Seed = 0  # seed of all random numbers: commands, weights, plants, pushes
    engine: Engine = "auto"  # c: MuJoCo, one walk per process; mjx: all at once; auto: mjx on a GPU
    processes: Processes = 2  # worker processes, one core each
    robot: Robot = None  # TOML file of another biped; HECTOR by default


@dataclass(frozen=True)
class Train(Configured):
    """Train GRFM-Net on collected walks.

    Example: hector train --data data/more --out data/more.npz
    """

    data: Folder = Path("data/walks")  # folder of the walks
    out: Path | None = None  # file for the net; by default grfm.npz or grfm-paper.npz beside DATA
    variant: Variant = "residual"  # architecture of the net
    epochs: Annotated[int, Range(1, 100_000)] = 200  # passes over the samples
    seed: Seed = 0  # seed of the initial parameters and of the order of the samples
    json: bool = False  # print JSON instead of text
    robot: Robot = None  # TOML file of another biped; HECTOR by default


@dataclass(frozen=True)
class Grfm(Configured):
    """Report how well the nets predict the ground forces of walks that they never saw.

    Example: hector grfm --seeds 0
    """

    data: Folder = Path("data")  # folder of the walks and nets, which are made if they are missing
    out: Folder = Path("runs/grfm")  # folder for the report
    seeds: Annotated[int, Range(0, 10_000)] = 2  # stand-in plants, for information; 0: none
    processes: Processes = 2  # worker processes, one core each
    json: bool = False  # print JSON instead of text


@dataclass(frozen=True)
class Tune(Configured):
    """Tune the MPC weights for a trajectory, with and without the net, and evaluate them.

    Example: hector tune --traj c --seeds 32
    """

    traj: Trajectory = "straight"  # straight, c, s, all (one after the other) or a TOML file
    seeds: Plants = 8  # stand-in plants to evaluate on
    iterations: Iterations = 100  # largest number of iterations
    variant: Variant = "residual"  # architecture of the net
    alpha: Literal["paper", "auto"] = "paper"  # loss weights; auto makes the gradient norms alike
    refresh: Annotated[int, Range(0, 100)] = 0  # times to collect at the new weights and repeat
    data: Folder = Path("data")  # folder of the walks and the net, which are made if missing
    net: Annotated[Path | None, Source.FILE] = None  # file of another net, instead of that in DATA
    runs: Folder = Path("runs")  # the run folder is RUNS/TRAJ/TIME
    run: Path | None = None  # the run folder itself, which must not exist (with all: RUN/TRAJ)
    resume: Annotated[Path | None, Source.RUN] = None  # continue the interrupted run in this folder
    video: bool = True  # make a film of the nominal and the tuned weights
    processes: Processes = 2  # worker processes, one core each
    json: bool = False  # print JSON instead of the table; `run` is the folder
    robot: Robot = None  # TOML file of another biped, with its data in DATA/NAME; or HECTOR


@dataclass(frozen=True)
class Search(Configured):
    """Search for weights on the high-fidelity simulator without derivatives (CMA-ES).

    Example: hector search --traj s --budget 400
    """

    traj: Trajectory = "straight"  # straight, c, s, all or a TOML file
    budget: Annotated[int, Range(1, 1_000_000)] = 200  # most walks per trajectory
    population: Annotated[int, Range(1, 10_000)] = 10  # walks in a generation
    seed: Seed = 0  # seed of the search
    # initial standard deviation of each log-weight
    spread: Annotated[float, Range(0, 10, above=True)] = 1.0
    start: Weights = "nominal"  # nominal, expert or a weights file
    engine: Engine = "auto"  # c: MuJoCo, one walk per process; mjx: all at once; auto: mjx on a GPU
    out: Folder = Path("runs/search")  # folder for the best weights, each with a card
    record: Path | None = None  # folder of the record that a search resumes from; by default OUT
    processes: Processes = 2  # worker processes, one core each
    json: bool = False  # print JSON instead of text
    robot: Robot = None  # TOML file of another biped; HECTOR by default


@dataclass(frozen=True)
class Table(Configured):
    """Make the table of all weight sets: search, tune and evaluate what is not there yet.

    Example: hector table --quick
    """

    trajectories: tuple[str, ...] = ("straight", "c", "s")  # some of these three
    seeds: Plants = 32  # stand-in plants
    first_seed: Seed = 0  # first plant: 0 in development, 1000 for the final evaluation
    rollouts: Annotated[int, Range(1, 1_000_000)] = 200  # walks of the search, row `searched`
    iterations: Iterations = 100  # largest number of iterations of each tuning
    steps: Annotated[int, Range(0, 10_000)] = 30  # steps of row `with_walks`; 0: no such row
    step_plants: Annotated[int, Range(1, 1000)] = 8  # simulator plants for each of these steps
    extra: tuple[str, ...] = ()  # more rows, NAME=FOLDER of straight.json, c.json and s.json
    ceiling: Path = Path("docs/results/ceiling")  # folder of row `ceiling`, if it exists
    earlier: Path | None = None  # table.json of other plants, to compare the order of the sets
    data: Folder = Path("data")  # folder of the walks and the net, which are made if missing
    out: Folder = Path("runs/table")  # folder for the report
    kept: Path | None = None  # folder of results to reuse; by default OUT/kept
    quick: bool = False  # a trial with 4 plants and short tunings, into OUT/quick
    processes: Processes = 2  # worker processes, one core each
    json: bool = False  # print JSON instead of the tables


@dataclass(frozen=True)
class Evaluate(Configured):
    """Evaluate weight sets on the plants of a world and print a table.

    Example: hector evaluate --traj c --weights nominal expert mine.json
    """

    weights: tuple[Weights, ...] = NAMED_WEIGHTS  # nominal, expert or weights files
    traj: Trajectory = "straight"  # straight, c, s, sideways, turn, eight, stop-and-go or a file
    world: Literal["ideal", "hfs", "hfs-varied", "standin"] = "standin"  # world of the plants
    seconds: Seconds = 4.0  # length of each walk [s]; a whole eight takes 8
    seeds: Plants = 8  # number of plants, in the worlds hfs-varied and standin
    first_seed: Seed = 0  # first plant
    processes: Processes = 2  # worker processes, one core each
    json: bool = False  # print JSON instead of the table
    robot: Robot = None  # TOML file of another biped; HECTOR by default


@dataclass(frozen=True)
class Walk(Configured):
    """Walk once and report losses and tracking errors.

    Example: hector walk --traj s --world standin --seed 3 --weights expert --video walk.mp4
    """

    traj: Trajectory = "straight"  # straight, c, s, sideways, turn, eight, stop-and-go or a file
    world: Literal["srbm", "ideal", "hfs", "hfs-varied", "standin"] = "hfs"  # where to walk
    seed: Seed = 0  # seed of the plant and of the estimator's noise
    weights: Weights = "nominal"  # nominal, expert or a weights file
    seconds: Seconds = 4.0  # length of the walk [s]
    out: Path | None = None  # file for the trajectory (.npz)
    video: Path | None = None  # file for a film beside nominal weights (.mp4; .webp for a page)
    json: bool = False  # print JSON instead of text
    robot: Robot = None  # TOML file of another biped; HECTOR by default


@dataclass(frozen=True)
class Doctor:
    """Report versions, devices, precision, cache and video of this machine, and test it.

    The exit code is 1 if something is broken. Example: hector doctor --json
    """

    json: bool = False  # print JSON instead of text


@dataclass(frozen=True)
class Export:
    """Export weights, lines for the open C++ controller, and the compiled controller.

    Example: hector export latest
    """

    run: Annotated[Path, Source.EXPORTABLE]  # run folder, `latest`, or a weights file
    set: str = "with"  # weight set of the run
    out: Path | None = None  # folder; by default `export` in the run or beside the weights file
    # trajectory to check on; by default that of the run, or straight
    traj: Annotated[str | None, Source.TRAJECTORY] = None
    seconds: Seconds = 1.0  # length of that walk after the start-up [s]
    robot: Robot = None  # TOML file of the biped of a weights file; HECTOR by default
    json: bool = False  # print JSON instead of text


@dataclass(frozen=True)
class View:
    """Show a run in the browser: walks before and after, ground forces, tuning in progress.

    Example: hector view latest --world standin
    """

    run: Run  # folder of a run of `hector tune`, finished or in progress, or `latest`
    sets: tuple[str, str] = ("nominal", "with")  # weight sets of the run: before and after
    world: Literal["srbm", "ideal", "hfs", "hfs-varied", "standin"] = "hfs"  # where both walk
    seed: Seed = 0  # seed of the plant and of the estimator's noise
    seconds: Annotated[float, Range(0.1, 600)] = 4.0  # length of each walk [s]
    data: Path | None = None  # folder of the net that predicts the ground; by default the run's
    host: str = "127.0.0.1"  # address to listen on; the default admits only this machine
    port: Annotated[int, Range(0, 65535)] = 8080  # port; if it is in use, a free one is taken
    headless: bool = False  # write a film and pictures instead of opening a page
    out: Path | None = None  # folder for them (implies --headless); by default `view` in the run


@dataclass(frozen=True)
class Compare:
    """Compare finished runs: losses, falls, iterations, versions, settings.

    Example: hector compare runs/straight/*
    """

    runs: tuple[Run, ...]  # folders of runs of `hector tune`, or `latest`
    json: bool = False  # print JSON instead of the table


@dataclass(frozen=True)
class Tensorboard:
    """Write TensorBoard event files of a run, from its metrics.jsonl.

    Example: hector tensorboard latest
    """

    run: Run  # folder of a run of `hector tune`, or `latest`
    out: Path | None = None  # folder for the event files; by default `tensorboard` in the run


@dataclass(frozen=True)
class Completion:
    """Print the script that completes `hector` in a shell.

    Example: hector completion bash > ~/.local/share/bash-completion/completions/hector
    """

    shell: Literal["bash", "zsh", "fish"]  # shell to write the script for


@dataclass(frozen=True)
class Replay:
    """Repeat an evaluation that a tuning refused: exit code 0 if all bytes agree, else 1.

    Example: hector replay runs/s/20261121-093442/dumps/with-007-fell.npz
    """

    dump: Annotated[Path, Source.FILE]  # file in the folder `dumps` of a run
    json: bool = False  # print JSON instead of the table


Command = (
    Collect
    | Train
    | Grfm
    | Tune
    | Search
    | Table
    | Evaluate
    | Walk
    | Doctor
    | Export
    | View
    | Compare
    | Tensorboard
    | Completion
    | Replay
)

Flags = TypeVar("Flags")


def command_name(kind: type) -> str:
    """What a command is called on the line."""
    return kind.__name__.lower()


def _spelt(name: str) -> str:
    return name.replace("_", "-")


def _positional(kind: type) -> list[str]:
    """Fields that stand on the line without a flag: those that have no default."""
    return [field.name for field in fields(kind) if field.default is MISSING]


def _label(kind: type, name: str) -> str:
    """What a message calls a field."""
    return name.upper() if name in _positional(kind) else f"--{_spelt(name)}"


def check(flags: Any) -> None:
    """Hold flags to their types and ranges, and look whether the files that they name are there.

    Raises:
        InputError: one line with the flag, what was expected and what came.
    """
    defaults = {field.name: field.default for field in fields(flags)}
    for name, hint in _hints(type(flags)).items():
        value, label = getattr(flags, name), _label(type(flags), name)
        if told := validation_error(value, hint):
            raise InputError(f"{label} {told}")
        if value == () != defaults[name]:
            raise InputError(f"{label} expects a value, got none")
        each = value if isinstance(value, tuple) else (value,)
        for i, one in enumerate(each):
            if one in each[:i]:
                raise InputError(f"{label} names {short_repr(str(one))} twice")
            if one is not None and (source := _source(hint)):
                _look(label, one, source)
    if hasattr(flags, "first_seed") and flags.first_seed + flags.seeds - 1 not in SEED:
        raise InputError(
            f"--first-seed {flags.first_seed} and --seeds {flags.seeds} reach beyond the largest "
            f"seed, {SEED.high}"
        )


def _source(hint: Any) -> Source | None:
    if get_origin(hint) is tuple:
        hint = get_args(hint)[0]
    return next((x for x in get_args(hint) if isinstance(x, Source)), None)


def _look(label: str, value: Path | str, source: Source) -> None:
    """Raises InputError where what a flag names is not there."""
    path, hint = Path(value), ""
    named, is_dir = value in NAMED_WEIGHTS, os.path.isdir(path)
    match source:
        case Source.RUN:
            fine = is_dir
        case Source.FOLDER:
            fine = os.path.isdir(next(x for x in (path, *path.parents) if os.path.exists(x)))
        case Source.ROBOT:
            fine = path.suffix == ".toml"
        case Source.WEIGHTS:
            fine = named or path.suffix or os.path.lexists(path)
            hint = did_you_mean(str(value), NAMED_WEIGHTS)
        case _:
            fine = True
    if not fine:
        raise InputError(f"{label} must be {source.value}, got {one_line(str(value))!r}{hint}")
    if (
        source in (Source.FILE, Source.ROBOT)
        or (source is Source.WEIGHTS and not named)
        or (source is Source.EXPORTABLE and not is_dir)
        or (source is Source.TRAJECTORY and path.suffix == ".toml")
    ):
        check_file(path, "the file")


def resolve_latest(flags: Flags) -> Flags:
    """The flags with the newest run under `runs/` wherever `latest` stands for a run folder.

    Raises:
        InputError: there is no run.
    """

    def newest(path: Path) -> Path:
        if path != LATEST or path.exists():
            return path
        found = [file for file in Path("runs").rglob("config.json") if file.is_file()]
        if not found:
            raise InputError("latest: there is no run in the folder `runs` of this directory")
        return max(found, key=lambda file: file.stat().st_mtime).parent

    values = {}
    for name, hint in _hints(type(flags)).items():
        value = getattr(flags, name)
        if value is not None and _source(hint) in (Source.RUN, Source.EXPORTABLE):
            values[name] = tuple(map(newest, value)) if isinstance(value, tuple) else newest(value)
    return replace(flags, **values)


def from_line(words: Sequence[str]) -> Any:
    """A command with its flags, as the words after `hector` give them.

    Flags that are not on the line come from the file of `--config`, else from their defaults.

    Raises:
        InputError: one line with the word that is unknown, given twice, missing, too much, of the
            wrong type or out of range.
    """
    kind = command(words[0] if words else "")
    hints = get_type_hints(kind, include_extras=True)
    given = _words_by_flag(kind, hints, words[1:])
    values = {name: _from_words(hints[name], texts) for name, texts in given.items()}
    for name, value in values.items():
        if told := validation_error(value, hints[name]):
            raise InputError(f"{_label(kind, name)} {told}")
    for name in _positional(kind):
        if name not in values:
            raise InputError(f"{words[0]} expects {name.upper()}; see hector {words[0]} --help")
    if "config" in values:
        return replace(from_file(kind, values["config"]), **values)
    return kind(**values)


def command(word: str) -> type[Any]:
    """The flags of a command.

    Raises:
        InputError: there is no such command.
    """
    kinds = {command_name(kind): kind for kind in get_args(Command)}
    if word not in kinds:
        hint = did_you_mean(word, kinds) or f"; the commands are {', '.join(kinds)}"
        raise InputError(
            f"unknown command {short_repr(word)}{hint}" if word else f"no command{hint}"
        )
    return kinds[word]


def _words_by_flag(kind: type, hints: dict[str, Any], words: Sequence[str]) -> dict[str, list[str]]:
    """The words of each flag; those of a switch are `yes` or none."""
    help_line = f"see hector {command_name(kind)} --help"
    positional = [*_positional(kind), None][0]
    switched_off = {f"no_{name}": name for name, hint in hints.items() if hint is bool}
    given: dict[str, list[str]] = {}
    taking = positional

    def is_full(name: str | None) -> bool:
        return name is None or len(given.get(name, ())) >= _words_of(hints[name])[1]

    for word in words:
        if word.startswith("--"):
            flag, equals, value = word[2:].partition("=")
            name = flag.replace("-", "_")
            taking = switched_off.get(name, name)
            if taking not in hints or taking == positional:
                names = [_spelt(x) for x in (*hints, *switched_off) if x != positional]
                hint = did_you_mean(_spelt(name), names).replace("mean '", "mean '--")
                hint = hint or f"; {help_line}"
                raise InputError(
                    f"{command_name(kind)} has no flag {short_repr(f'--{flag}')}{hint}"
                )
            if taking in given:
                raise InputError(f"--{_spelt(taking)} is given twice")
            if hints[taking] is bool and equals:
                raise InputError(f"--{flag} takes no value, got {short_repr(value)}")
            is_on = hints[taking] is bool and name == taking
            given[taking] = [value] if equals else ["yes"] * is_on
        else:
            taking = positional if is_full(taking) else taking
            if taking is None or is_full(taking):
                raise InputError(
                    f"{command_name(kind)} does not expect {short_repr(word)}; {help_line}"
                )
            given.setdefault(taking, []).append(word)
    for name, texts in given.items():
        least = _words_of(hints[name])[0]
        if len(texts) < least:
            expected = "a value" if least == 1 else plural(least, "value")
            raise InputError(
                f"--{_spelt(name)} expects {expected}, got {' '.join(texts) or 'none'}"
            )
    return given


def _words_of(hint: Any) -> tuple[int, int]:
    """Least and largest number of words after a flag."""
    if hint is bool:
        return 0, 0
    if get_origin(hint) is not tuple:
        return 1, 1
    several = get_args(hint)
    return (1, sys.maxsize) if several[-1] is Ellipsis else (len(several), len(several))


def _from_words(hint: Any, words: Sequence[str]) -> Any:
    """The value of a flag; a word that is no number stays a word."""
    kind = _plain(hint)
    if get_origin(kind) is tuple:
        return tuple(_from_words(get_args(kind)[0], [word]) for word in words)
    if kind is bool:
        return bool(words)
    (word,) = words
    if kind in (Path, Path | None):
        return Path(word)
    try:
        return kind(word) if kind in (int, float) else word
    except ValueError:
        return word


def _plain(hint: Any) -> Any:
    """The type of a flag without what is allowed of it."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def from_file(kind: type[Flags], path: Path) -> Flags:
    """Flags of a command as a file gives them, others at their default.

    Args:
        kind: the command, a dataclass of this module.
        path: TOML whose keys are flags (`first-seed` or `first_seed`), or the `config.json` that a
            run leaves, of which `flags` are read. Paths inside are relative to where the command
            is called, as on its line.

    Raises:
        InputError: one line naming file and key, for one that is unknown, with the nearest known
            name, of a wrong type or out of range; or the file, where it cannot be read.
    """
    hints, values = _hints(kind), {}
    for key, value in _table(path).items():
        name = key.replace("-", "_")
        if name not in hints:
            known = sorted(map(_spelt, hints))
            hint = did_you_mean(_spelt(name), known) or f"; known: {', '.join(known)}"
            raise InputError(f"{path}: unknown key {short_repr(key)}{hint}")
        if name in values:
            raise InputError(f"{path}: {key} is given twice")
        values[name] = _value(hints[name], value)
        if told := validation_error(values[name], hints[name]):
            told = told.replace("a tuple", "a list")
            raise InputError(f"{path}: {key} {told}")
    return kind(**values)


def _table(path: Path) -> dict[str, Any]:
    if path.suffix != ".json":
        return read_toml(path, "flags as TOML", 1_000_000)
    found = read_json(path, "flags as JSON", 1_000_000)
    found = found.get("flags") if isinstance(found, dict) else None
    if not isinstance(found, dict):
        raise InputError(f"{path}: no `flags` in it; expected the config.json of a run")
    return found


def _hints(kind: type) -> dict[str, Any]:
    """Types of the flags that a file may set."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind) if field.name != "config"}


def _value(hint: Any, value: Any) -> Any:
    """A value of a file as the type of its flag, where there is no doubt; else as it is."""
    kind = _plain(hint)
    if kind in (Path, Path | None) and isinstance(value, str):
        return Path(value)
    if kind is float and type(value) is int and abs(value) < 2**53:
        return float(value)
    if get_origin(kind) is tuple and isinstance(value, list):
        return tuple(value)
    return value


def settings(flags: Any) -> dict[str, Any]:
    """The flags as JSON values, those that came from a file among them; `from_file` reads them."""
    plain = lambda x: str(x) if isinstance(x, Path) else x  # noqa: E731
    return {name: plain(value) for name, value in asdict(flags).items() if name != "config"}


def as_command(name: str, flags: Any) -> str:
    """The line that asks for these flags, those at their default left out."""
    words = ["hector", name]
    for field in fields(flags):
        value, flag = getattr(flags, field.name), _spelt(field.name)
        if value == field.default or field.name == "config":  # what the file said is told
            continue
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
    return shlex.join(words)
