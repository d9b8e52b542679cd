"""The flags of each command; a field's comment is its help text."""

import shlex
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Collect:
    """Walk on the high-fidelity simulator and keep what the ground returned."""

    out: Path = Path("data/walks")  # folder of the walks; what is there already is kept
    walks: int = 64  # how many
    seconds: float = 4.0  # length of each
    seed: int = 0  # of everything drawn: commands, weights, plants, pushes
    engine: str = "auto"  # c (MuJoCo, on the processes), mjx (all at once), auto: mjx on a GPU
    processes: int = 2  # one core each
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Train:
    """Train GRFM-Net on collected walks."""

    data: Path = Path("data/walks")  # folder of the walks
    out: Path | None = None  # the net; by default beside the walks, grfm.npz or grfm-paper.npz
    variant: str = "residual"  # or paper
    epochs: int = 200
    seed: int = 0
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Grfm:
    """Report how well the nets tell what the ground returns, on walks that they never saw."""

    data: Path = Path("data")  # walks and nets; made where missing
    out: Path = Path("runs/grfm")  # folder of the report
    seeds: int = 2  # stand-in plants, told for information only; 0 leaves them out
    processes: int = 2  # one core each


@dataclass(frozen=True)
class Tune:
    """Tune the MPC weights for a trajectory, with and without the net, and judge them."""

    traj: str = "straight"  # straight, c, s, or all: one after the other
    seeds: int = 8  # stand-in plants in the verdict
    iterations: int = 100  # of the tuning, at most
    variant: str = "residual"  # of the net, or paper
    alpha: str = "paper"  # loss weights: the paper's, or auto (gradient norms aligned)
    refresh: int = 0  # times to collect again at the tuned weights, train anew and tune again
    data: Path = Path("data")  # walks and net; made where missing
    runs: Path = Path("runs")  # results go to RUNS/TRAJ/TIME
    run: Path | None = None  # or to this folder, which must not exist (all: to RUN/TRAJ)
    video: bool = True  # film nominal beside tuned
    processes: int = 2  # one core each
    robot: Path | None = None  # TOML of another biped, whose data go to DATA/NAME; or HECTOR


@dataclass(frozen=True)
class Search:
    """Search weights on the high-fidelity simulator without derivatives (CMA-ES)."""

    traj: str = "straight"  # straight, c, s or all
    budget: int = 200  # walks for each trajectory, at most; whole generations are walked
    population: int = 10  # walks in a generation
    seed: int = 0
    spread: float = 1.0  # first standard deviation of each log-weight
    start: str = "nominal"  # nominal, expert or a weights file
    engine: str = "auto"  # c (MuJoCo, on the processes), mjx (all at once), auto: mjx on a GPU
    out: Path = Path("runs/search")  # folder of the weights found, with a card of each
    record: Path | None = None  # folder of what was walked, taken up again; OUT by default
    processes: int = 2  # one core each
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Table:
    """Make the paper's table: search, tune and judge all sets, take up what is there already."""

    trajectories: tuple[str, ...] = ("straight", "c", "s")
    seeds: int = 32  # stand-in plants
    first_seed: int = 0  # 0 in development, 1000 for the final verdict
    rollouts: int = 200  # walks of the search on the high-fidelity simulator
    iterations: int = 100  # of the tuning, at most
    steps: int = 30  # of `with` further, along walks on the simulator; 0: no such row
    step_plants: int = 2  # that each of these steps walks on, hfs and drawn around it
    extra: tuple[str, ...] = ()  # NAME=FOLDER of straight.json, c.json, s.json: one more row each
    ceiling: Path = Path("docs/results/ceiling")  # such a folder too; row `ceiling` where it exists
    earlier: Path | None = None  # table.json of other plants: do the sets keep their order?
    data: Path = Path("data")  # walks and net; made where missing
    out: Path = Path("runs/table")  # folder of the report
    kept: Path | None = None  # folder of what is taken up again; OUT/kept by default
    quick: bool = False  # 4 plants, a short search and tuning, into OUT/quick: does it all work?
    processes: int = 2  # one core each


@dataclass(frozen=True)
class Evaluate:
    """Judge weight sets on plants of a world and print one table."""

    weights: tuple[str, ...] = ("nominal", "expert")  # names or files
    traj: str = "straight"  # straight, c, s, sideways, turn, eight or stop-and-go
    world: str = "standin"  # ideal, hfs, hfs-varied or standin
    seconds: float = 4.0  # of each walk; an eight takes 8
    seeds: int = 8  # plants
    first_seed: int = 0
    processes: int = 2  # one core each
    json: bool = False  # print JSON instead of the table
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Walk:
    """Walk once and say how it went."""

    traj: str = "straight"  # straight, c, s, sideways, turn, eight or stop-and-go
    world: str = "hfs"  # srbm, ideal, hfs, hfs-varied or standin
    seed: int = 0  # of the plant and of the estimator's noise
    weights: str = "nominal"  # nominal, expert or a weights file
    seconds: float = 4.0
    out: Path | None = None  # keep the trajectory (.npz)
    video: Path | None = None  # film it (.mp4), nominal weights beside it
    json: bool = False  # print JSON instead of words
    robot: Path | None = None  # TOML of another biped; HECTOR by default


@dataclass(frozen=True)
class Doctor:
    """Say what this machine offers: versions, device, precision, cache, video; and test it."""


Command = Collect | Train | Grfm | Tune | Search | Table | Evaluate | Walk | Doctor


def settings(flags: Any) -> dict[str, Any]:
    """The flags as JSON values."""
    plain = lambda x: x if isinstance(x, bool | int | float | tuple) else str(x)  # noqa: E731
    return {name: plain(value) for name, value in asdict(flags).items()}


def as_command(name: str, flags: Any) -> str:
    """The line that asks for these flags, those at their default left out."""
    words = ["hector", name]
    for field in fields(flags):
        value, flag = getattr(flags, field.name), field.name.replace("_", "-")
        if value == field.default:
            continue
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, tuple) else (value,))]
    return shlex.join(words)
