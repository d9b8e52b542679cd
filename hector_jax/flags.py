"""The flags of each command; a field's comment is its help text."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Collect:
    """Walk on the high-fidelity simulator and keep what the ground returned."""

    out: Path = Path("data/walks")  # folder of the walks; what is there already is kept
    walks: int = 64  # how many
    seconds: float = 4.0  # length of each
    seed: int = 0  # of everything drawn: commands, weights, plants, pushes
    engine: str = "auto"  # c (MuJoCo, on the processes), mjx (all at once), auto: mjx on a GPU
    processes: int = 2  # one core each


@dataclass(frozen=True)
class Train:
    """Train GRFM-Net on collected walks."""

    data: Path = Path("data/walks")  # folder of the walks
    out: Path = Path("data/grfm.npz")  # the net
    variant: str = "residual"  # or paper
    epochs: int = 200
    seed: int = 0


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

    traj: str = "straight"  # straight, c or s
    seeds: int = 8  # stand-in plants in the verdict
    iterations: int = 100  # of the tuning, at most
    alpha: str = "paper"  # loss weights: the paper's, or auto (gradient norms aligned)
    refresh: int = 0  # times to collect again at the tuned weights, train anew and tune again
    data: Path = Path("data")  # walks and net; made where missing
    runs: Path = Path("runs")  # results go to RUNS/TRAJ/TIME
    run: Path | None = None  # or to this folder, which must not exist
    video: bool = True  # film nominal beside tuned
    processes: int = 2  # one core each


@dataclass(frozen=True)
class Evaluate:
    """Judge weight sets on plants of a world and print one table."""

    weights: tuple[str, ...] = ("nominal", "expert")  # names or files
    traj: str = "straight"  # straight, c or s
    world: str = "standin"  # ideal, hfs, hfs-varied or standin
    seeds: int = 8  # plants
    first_seed: int = 0
    processes: int = 2  # one core each
    json: bool = False  # print JSON instead of the table


@dataclass(frozen=True)
class Walk:
    """Walk once and say how it went."""

    traj: str = "straight"  # straight, c or s
    world: str = "hfs"  # srbm, ideal, hfs, hfs-varied or standin
    seed: int = 0  # of the plant and of the estimator's noise
    weights: str = "nominal"  # nominal, expert or a weights file
    seconds: float = 4.0
    out: Path | None = None  # keep the trajectory (.npz)
    video: Path | None = None  # film it (.mp4), nominal weights beside it
    json: bool = False  # print JSON instead of words


@dataclass(frozen=True)
class Doctor:
    """Say what this machine offers: versions, device, precision, cache, video; and test it."""


Command = Collect | Train | Grfm | Tune | Evaluate | Walk | Doctor
