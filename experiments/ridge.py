"""Which ridge toward the start makes tunings that hold on plants with a noisy estimate?

    python experiments/ridge.py --robots hector=- quadruped=examples/quadruped/robot.toml

Through the net of each robot, from nominal, one set for each trajectory and one for all of them is
tuned with each ridge. The sets walk on plants drawn around the hfs, as a run's own choices do, but
with other seeds. The last column is the mean log-ratio to nominal over all of these walks.
"""

from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import lib
import numpy as np

from hector_jax.cli.arguments import data_folder
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import nominal
from hector_jax.core.pool import workers
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import load_robot
from hector_jax.store import nets, tunings
from hector_jax.store.setup import Setup
from hector_jax.verdict import judging
from hector_jax.walk_tuning import best_set

FIRST_SEED = 7100
PROBLEMS = {**{name: (name,) for name in COMMANDS}, "all": COMMANDS}
Losses = dict[str, dict[str, list[float]]]  # L on each plant, by trajectory and set


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to tune and where to walk."""

    robots: tuple[str, ...] = ("hector=-",)  # NAME=TOML; - is HECTOR
    ridges: tuple[Annotated[float, NOT_NEGATIVE], ...] = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1)
    plants: Annotated[int, AT_LEAST_ONE] = 16  # seeds from 7100 on
    data: Path = Path("data")  # folder of the walks and nets, which are made if missing
    out: Path = Path("runs/ridge")  # folder of the report

    def __post_init__(self) -> None:
        super().__post_init__()
        lib.named_files("robots", self.robots)


def walk_robot(flags: Flags, pool: Executor, name: str, file: Path | None) -> Losses:
    """Tune and walk the sets of one robot."""
    robot = load_robot(file)
    net = nets.load_or_train(pool, robot, data_folder(flags.data, file, robot))
    problems = {
        key: tunings.Problem(tuple(map(named_command, names)), net.params)
        for key, names in PROBLEMS.items()
    }
    sets = {}
    for ridge in flags.ridges:
        setup = Setup(pool, tunings.tune_config(robot, ridge=ridge), robot)
        folder, title = flags.out / "kept" / name, f"{name}: tuning with ridge {ridge:g}"
        tuned = tunings.tune_all(setup, problems, folder, title=title)
        sets |= {f"{key}-{ridge:g}": found.weights for key, found in tuned.items()}
    setup = Setup(pool, tunings.tune_config(robot), robot)
    plants = best_set.drawn_plants(robot, flags.plants, FIRST_SEED)
    seeds = range(FIRST_SEED, FIRST_SEED + flags.plants)
    losses = {}
    for command in COMMANDS:
        own = {name: w for name, w in sets.items() if name.split("-")[0] in (command, "all")}
        compared = {"nominal": nominal(robot), **own}
        inputs = setup, compared, {command: named_command(command)}, plants, seeds
        options = {"title": f"{name}: walking {command}", "folder": flags.out / name}
        scores = judging.judge(*inputs, **options).verdict.scores
        losses[command] = {key: score.L[:, 0].tolist() for key, score in scores.items()}
    return losses


def _row(ridge: float, losses: dict[str, Losses]) -> list[str]:
    """Return the row of a ridge: of each robot the change and the worst ratio, then the mean."""
    cells, logs = [f"{ridge:g}"], []
    for by_trajectory in losses.values():
        ratios = np.array(
            [
                np.divide(sets[f"{key}-{ridge:g}"], sets["nominal"])
                for command, sets in by_trajectory.items()
                for key in (command, "all")
            ]
        )
        logs.append(np.log(ratios).mean())
        cells.append(f"{100 * np.expm1(logs[-1]):+.1f} (worst {100 * (ratios.max() - 1):+.0f})")
    return [*cells, f"{np.mean(logs):.3f}"]


def main(flags: Flags) -> Path:
    """Write report.md and ridge.json."""
    losses = {}
    with workers(flags.processes) as pool:
        for name, file in lib.named_files("robots", flags.robots).items():
            losses[name] = walk_robot(flags, pool, name, None if file == "-" else Path(file))
    head = ["ridge", *(f"{name}: L [%]" for name in losses), "mean log-ratio"]
    table = markdown_table(head, [_row(ridge, losses) for ridge in flags.ridges])
    about = (
        f"Geometric mean of L against nominal, over straight, c and s, each with its own set and "
        f"with that of all three, on {flags.plants} plants drawn around the hfs (seeds from "
        f"{FIRST_SEED} on, noisy estimate); in brackets the worst walk."
    )
    numbers = {"losses": losses, "ridges": list(flags.ridges)}
    title = "The ridge of a tuning"
    return lib.write_report(flags.out / "ridge.json", title, [about, table], numbers)


if __name__ == "__main__":
    lib.run(main, Flags)
