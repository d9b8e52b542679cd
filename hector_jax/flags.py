"""The flags of each command; a field's comment is its help text.

A range stands beside the type. Flags also come from a file (`from_file`), and go out again as JSON
(`settings`) or as a command line (`as_command`).
"""

import json
import shlex
import tomllib
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from hector_jax.inputs import (
    SEED,
    InputError,
    Interval,
    did_you_mean,
    one_line,
    problem,
    read_text,
    shown,
)

Count = Annotated[int, Interval(1)]
Natural = Annotated[int, Interval(0)]
Seed = Annotated[int, SEED]
Iterations = Annotated[int, Interval(10)]  # the paper's: its rows are told from the first ten
Seconds = Annotated[float, Interval(0, 600, above=True)]
Variant = Literal["residual", "paper"]
Engine = Literal["auto", "c", "mjx"]


@dataclass(frozen=True, kw_only=True)
class Configured:
    """A command whose flags may come from a file."""

    config: Path | None = None  # flags from a TOML file or a run's config.json; the line wins


@dataclass(frozen=True)
class Collect(Configured):
    """Walk on the high-fidelity simulator and keep what the ground returned.

    Example: hector collect --walks 128 --out data/more
    """

    out: Path = Path("data/walks")  # folder of the walks; what is there already is kept
    walks: int = 64  # how many
    seconds: float = 4.0  # length of each [s]
    seed: Seed = 0  # of everything drawn: commands, weights, plants, pushes
    engine: Engine = "auto"  # MuJoCo on the processes, MJX all at once; auto: mjx on a GPU
    processes: Count = 2  # one core each
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Train(Configured):
    """Train GRFM-Net on collected walks.

    Example: hector train --data data/more --out data/more.npz
    """

    data: Path = Path("data/walks")  # folder of the walks
    out: Path | None = None  # the net; by default beside the walks, grfm.npz or grfm-paper.npz
    variant: Variant = "residual"  # of the net
    epochs: Count = 200  # over all samples
    seed: Seed = 0  # of the net's first weights and of the order of the samples
    json: bool = False  # print JSON instead of lines
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Grfm(Configured):
    """Report how well the nets tell what the ground returns, on walks that they never saw.

    Example: hector grfm --seeds 0
    """

    data: Path = Path("data")  # walks and nets; made where missing
    out: Path = Path("runs/grfm")  # folder of the report
    seeds: Natural = 2  # stand-in plants, told for information only; 0 leaves them out
    processes: Count = 2  # one core each
    json: bool = False  # print JSON instead of lines


@dataclass(frozen=True)
class Tune(Configured):
    """Tune the MPC weights for a trajectory, with and without the net, and judge them.

    Example: hector tune --traj c --seeds 32
    """

    traj: str = "straight"  # straight, c, s, all (one after the other) or a TOML file
    seeds: Count = 8  # stand-in plants in the verdict
    iterations: Iterations = 100  # of the tuning, at most
    variant: Variant = "residual"  # of the net
    alpha: Literal["paper", "auto"] = "paper"  # loss weights; auto aligns the gradient norms
    refresh: Natural = 0  # times to collect again at the tuned weights, train anew and tune again
    data: Path = Path("data")  # walks and net; made where missing
    net: Path | None = None  # a net of `hector train` to tune through, instead of that of DATA
    runs: Path = Path("runs")  # results go to RUNS/TRAJ/TIME
    run: Path | None = None  # or to this folder, which must not exist (all: to RUN/TRAJ)
    resume: Path | None = None  # take up the run in this folder where it was cut
    video: bool = True  # film nominal beside tuned
    processes: Count = 2  # one core each
    json: bool = False  # print JSON instead of the table; `run` names the folder
    robot: Path | None = None  # TOML of another biped, whose data go to DATA/NAME; or HECTOR


@dataclass(frozen=True)
class Search(Configured):
    """Search weights on the high-fidelity simulator without derivatives (CMA-ES).

    Example: hector search --traj s --budget 400
    """

    traj: str = "straight"  # straight, c, s, all or a TOML file
    budget: int = 200  # walks for each trajectory, at most; whole generations are walked
    population: int = 10  # walks in a generation
    seed: Seed = 0  # of what is drawn
    spread: float = 1.0  # first standard deviation of each log-weight
    start: str = "nominal"  # nominal, expert or a weights file
    engine: Engine = "auto"  # MuJoCo on the processes, MJX all at once; auto: mjx on a GPU
    out: Path = Path("runs/search")  # folder of the weights found, with a card of each
    record: Path | None = None  # folder of what was walked, taken up again; OUT by default
    processes: Count = 2  # one core each
    json: bool = False  # print JSON instead of lines
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Table(Configured):
    """Make the paper's table: search, tune and judge all sets, take up what is there already.

    Example: hector table --quick
    """

    trajectories: tuple[str, ...] = ("straight", "c", "s")  # which of them
    seeds: Count = 32  # stand-in plants
    first_seed: Seed = 0  # 0 in development, 1000 for the final verdict
    rollouts: int = 200  # walks of the search on the high-fidelity simulator
    iterations: Iterations = 100  # of the tuning, at most
    steps: Natural = 30  # of `with` further, along walks on the simulator; 0: no such row
    step_plants: Count = 8  # that each of these steps walks on, hfs and drawn around it
    extra: tuple[str, ...] = ()  # NAME=FOLDER of straight.json, c.json, s.json: one more row each
    ceiling: Path = Path("docs/results/ceiling")  # such a folder too; row `ceiling` where it exists
    earlier: Path | None = None  # table.json of other plants: do the sets keep their order?
    data: Path = Path("data")  # walks and net; made where missing
    out: Path = Path("runs/table")  # folder of the report
    kept: Path | None = None  # folder of what is taken up again; OUT/kept by default
    quick: bool = False  # 4 plants, a short search and tuning, into OUT/quick: does it all work?
    processes: Count = 2  # one core each
    json: bool = False  # print JSON instead of the tables


@dataclass(frozen=True)
class Evaluate(Configured):
    """Judge weight sets on plants of a world and print one table.

    Example: hector evaluate --traj c --weights nominal expert mine.json
    """

    weights: tuple[str, ...] = ("nominal", "expert")  # names or files
    traj: str = "straight"  # straight, c, s, sideways, turn, eight, stop-and-go or a file
    world: Literal["ideal", "hfs", "hfs-varied", "standin"] = "standin"  # of the plants
    seconds: Seconds = 4.0  # of each walk [s]; an eight takes 8
    seeds: Count = 8  # plants, where the world has a family of them
    first_seed: Seed = 0  # of the plants
    processes: Count = 2  # one core each
    json: bool = False  # print JSON instead of the table
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Walk(Configured):
    """Walk once and say how it went.

    Example: hector walk --traj s --world standin --seed 3 --weights expert --video walk.mp4
    """

    traj: str = "straight"  # straight, c, s, sideways, turn, eight, stop-and-go or a file
    world: Literal["srbm", "ideal", "hfs", "hfs-varied", "standin"] = "hfs"  # where to walk
    seed: Seed = 0  # of the plant and of the estimator's noise
    weights: str = "nominal"  # nominal, expert or a weights file
    seconds: Seconds = 4.0  # of the walk [s]
    out: Path | None = None  # keep the trajectory (.npz)
    video: Path | None = None  # film it beside the nominal weights (.mp4; .webp for a page)
    json: bool = False  # print JSON instead of words
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Doctor:
    """Say what this machine offers: versions, devices, precision, cache, video; and test it.

    Leaves with exit code 1 where something is broken. Example: hector doctor --json
    """

    json: bool = False  # print JSON instead of lines


@dataclass(frozen=True)
class Export:
    """Write what goes to a robot: weights, lines for the C++ controller, the controller.

    Example: hector export runs/straight/20261121-093229
    """

    run: Path  # folder of a run, or a weights file
    set: str = "with"  # weight set of the run
    out: Path | None = None  # folder; `export` in the run or beside the file by default
    traj: str | None = None  # to check by, in the ideal world; the run's own, straight for a file
    seconds: Seconds = 1.0  # of that walk, after the start-up
    robot: Path | None = None  # TOML of the biped that a weights file is for; HECTOR by default
    json: bool = False  # print JSON instead of words


@dataclass(frozen=True)
class View:
    """Show a run on a local web page: before and after, the ground's forces, tuning as it goes.

    Example: hector view runs/s/20261121-093442 --world standin
    """

    run: Path  # folder of a run of `hector tune`, finished or going on
    sets: tuple[str, str] = ("nominal", "with")  # before and after: of the run's weights
    world: Literal["srbm", "ideal", "hfs", "hfs-varied", "standin"] = "hfs"  # both walk anew there
    seed: Seed = 0  # of the plant and of the estimator's noise
    seconds: Seconds = 4.0  # of each walk
    data: Path | None = None  # folder of the net that predicts the ground; by default the run's
    host: str = "127.0.0.1"  # to listen on; as it is, no other machine sees the page
    port: int = 8080  # where it is taken, another
    headless: bool = False  # write a film and pictures instead of opening a page
    out: Path | None = None  # to this folder, which implies --headless; else to RUN-view


@dataclass(frozen=True)
class Compare:
    """Put finished tunings side by side: losses, falls, iterations, versions, settings.

    Example: hector compare runs/straight/*
    """

    runs: tuple[Path, ...]  # run folders of `hector tune`
    json: bool = False  # print JSON instead of the table


@dataclass(frozen=True)
class Tensorboard:
    """Write TensorBoard's event files of a run, from its metrics.jsonl.

    Example: hector tensorboard runs/c/20261121-093442
    """

    run: Path  # run folder of `hector tune`
    out: Path | None = None  # folder of the event files; RUN/tensorboard by default


@dataclass(frozen=True)
class Completion:
    """Print the script that completes `hector` in a shell.

    Example: hector completion bash > ~/.local/share/bash-completion/completions/hector
    """

    shell: Literal["bash", "zsh", "fish"]  # to write the script for


@dataclass(frozen=True)
class Replay:
    """Do an evaluation again that a tuning refused: 0 where the same bytes come out, else 1.

    Example: hector replay runs/s/20261121-093442/dumps/with-007-fell.npz
    """

    dump: Path  # a file of RUN/dumps
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


def check(flags: Any) -> None:
    """Hold flags to their types and ranges.

    Raises:
        InputError: one line with the flag, what was expected and what came.
    """
    for name, hint in _hints(type(flags)).items():
        if told := problem(getattr(flags, name), *_rule(hint)):
            raise InputError(f"--{name.replace('_', '-')} {told}")


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
            known = sorted(flag.replace("_", "-") for flag in hints)
            hint = did_you_mean(name.replace("_", "-"), known)
            hint = hint or f"; known: {', '.join(known)}"
            raise InputError(f"{path}: unknown key {shown(key)}{hint}")
        if name in values:
            raise InputError(f"{path}: {key} is given twice")
        values[name] = _value(hints[name], value)
        if told := problem(values[name], *_rule(hints[name])):
            told = told.replace("a tuple", "a list")
            raise InputError(f"{path}: {key} {told}")
    return kind(**values)


def _table(path: Path) -> dict[str, Any]:
    kind, read = ("JSON", json.loads) if path.suffix == ".json" else ("TOML", tomllib.loads)
    text = read_text(path, f"flags as {kind}", 1_000_000)
    try:
        found = read(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: no valid {kind}: {one_line(error)}") from None
    if kind == "JSON":
        found = found.get("flags") if isinstance(found, dict) else None
    if not isinstance(found, dict):
        raise InputError(f"{path}: no `flags` inside; expected the config.json of a run")
    return found


def _hints(kind: type) -> dict[str, Any]:
    """Types of the flags that a file may set."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind) if field.name != "config"}


def _rule(hint: Any) -> tuple[Any, Interval | tuple[str, ...] | None]:
    """The plain type behind that of a flag, and what is allowed of it."""
    if get_origin(hint) is Annotated:
        return get_args(hint)
    return (str, get_args(hint)) if get_origin(hint) is Literal else (hint, None)


def _value(hint: Any, value: Any) -> Any:
    """A value of a file as the type of its flag, where there is no doubt; else as it is."""
    kind, _ = _rule(hint)
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
        value, flag = getattr(flags, field.name), field.name.replace("_", "-")
        if value == field.default or field.name == "config":  # what the file said is told
            continue
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
    return shlex.join(words)
