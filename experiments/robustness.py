"""How much disturbance do weight sets survive that they were not tuned for?

Pushes from eight sides in three gait phases with growing force, a floor that turns slippery, slopes
of 3 degrees, a payload of 2 kg, and commands that no tuning saw; nominal, expert and the sets that
are named. The controller is told of none of it.

    python experiments/robustness.py --set with=runs/straight/TIME/weights/with.json

`hfs-varied` is the world to choose by; `--world standin` is for verdicts on what was chosen. The
scores of finished walks are stored under OUT/scores, and a later call uses them.
"""

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import numpy as np
import plots
import tyro
from changes import walk_all, walk_with_changes
from lib import walk_groups, write_report
from scenes import (
    PAYLOAD,
    Cell,
    Level,
    SceneConfig,
    as_result,
    evaluate_level,
    largest_pushes,
    make_scenes,
    table,
)

from hector_jax.control.controller import walk_config
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import exit_code
from hector_jax.core.files import make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import tree_hash
from hector_jax.report.report import WORLDS
from hector_jax.robot.description import HECTOR, Description
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import metrics
from hector_jax.runs.metrics import Score
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import named_world
from hector_jax.tuning.loss import loss_of_robot

BASELINE = "nominal"


@dataclass(frozen=True)
class Flags:
    """What to compare."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()  # NAME=FILE, beside the two
    world: str = "hfs-varied"  # to choose by; standin or standin-even for verdicts
    seeds: int = 2  # plants
    first_seed: int = 0
    scenes: Annotated[SceneConfig, tyro.conf.arg(name="")] = SceneConfig()
    quick: bool = False  # two forces, two floors, one gait phase
    robot: Path | None = None  # TOML file of another biped; HECTOR by default
    out: Path = Path("runs/robustness")  # folder of the report
    processes: int = 2  # one core each

    def __post_init__(self) -> None:
        for name in ("seeds", "processes"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name} must be at least 1, got {getattr(self, name)}")


class Result(NamedTuple):
    """All numbers of the report."""

    cells: dict[Level, dict[str, Cell]]  # by level and set, the baseline first
    losses: dict[Level, float]  # median of the baseline's L
    pushes: dict[str, np.ndarray]  # [N] largest survived, by direction
    residual: float  # largest of a plan


def weight_sets(named: Sequence[str], robot: Robot | None = None) -> dict[str, Weights]:
    """Return nominal, expert and the weights of the files of NAME=FILE.

    Raises:
        InputError: no NAME=FILE, a name in use, or a file without weights.
    """
    sets = {BASELINE: nominal(robot), "expert": expert(robot)}
    for text in named:
        name, _, file = text.partition("=")
        # names are part of file names, where other characters might make two of them equal
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or not file or name in sets:
            raise InputError(
                f"--set must be NAME=FILE, a new NAME of letters, digits and _, got {text!r}"
            )
        sets[name] = load_weights(Path(file), robot)
    return sets


def compare(
    levels: Sequence[Level], sets: Sequence[str], scores: Mapping[tuple[Level, str], Score]
) -> Result:
    """Compare all sets with the baseline at all levels.

    Args:
        levels: in the order of the report.
        sets: the baseline first.
        scores: (plants, scenes) each.
    """
    base = {level: scores[level, BASELINE] for level in levels}
    pushes = [level for level in levels if level.kind == "push"]
    return Result(
        {level: {n: evaluate_level(scores[level, n], base[level]) for n in sets} for level in base},
        {level: float(np.median(score.L)) for level, score in base.items()},
        {
            name: largest_pushes({float(p.size): scores[p, name].fallen for p in pushes})
            for name in sets
        },
        max(float(score.residual.max()) for score in scores.values()),
    )


def main() -> None:
    """Write report.md, robustness.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    if flags.quick:
        short = replace(flags.scenes, forces=(50.0, 100.0), frictions=(0.4, 0.25), phases=1)
        flags = replace(flags, scenes=short)
    robot = jax.tree.map(np.asarray, load_robot(flags.robot))
    sets, body, config = weight_sets(flags.set, robot), robot.description, walk_config(robot)
    seeds = range(flags.first_seed, flags.first_seed + flags.seeds)
    family = metrics.family_of(flags.world)
    plant = FAMILIES.get(family or "", partial(named_world, flags.world))
    plants = {seed: plant(seed, body) for seed in seeds}
    scenes = make_scenes(flags.scenes, config.gait, body.plants)

    def group(level: Level, name: str, seed: int) -> str:
        return f"{level.name}-{name}-{seed}".replace(" ", "-").replace("/", "-")

    groups = {
        group(level, name, seed): [
            (scene.job(sets[name], plants[seed], seed), scene.changes) for scene in at_level
        ]
        for seed in seeds
        for level, at_level in scenes.items()
        for name in sets
    }
    loss = loss_of_robot(body)
    with workers(flags.processes) as pool:
        by_group = walk_groups(
            groups,
            partial(walk_all, pool, config, robot),
            partial(metrics.score, loss),
            like=metrics.score_like(0),
            kind="robustness",
            robot=robot,
            folder=flags.out / "scores",
            settings=(config, repr(loss), function_id(walk_with_changes)),
        )
    scores = {
        (level, name): stack([by_group[group(level, name, seed)] for seed in seeds])
        for level in scenes
        for name in sets
    }
    result = compare(list(scenes), list(sets), scores)
    print(report(flags, sets, result, flags.out, body))


def report(
    flags: Flags,
    sets: Mapping[str, Weights],
    result: Result,
    folder: Path,
    body: Description = HECTOR,
) -> Path:
    """Write the report with its pictures and its numbers as JSON; returns its path."""
    make_folder(folder)
    world, count = WORLDS.get(flags.world, flags.world), flags.scenes.phases
    rows = {level.name: row for level, row in result.cells.items()}
    last = flags.first_seed + flags.seeds - 1
    phases = "one phase of the gait" if count == 1 else f"{count} phases of the gait"
    payload = PAYLOAD * body.plants.payload
    solved = "." if result.residual <= SOLVED else ": **not solved**."
    paragraphs = [
        f"Trajectory {flags.scenes.traj}, world {world}, plants {flags.first_seed} to {last}. "
        f"Pushes of 0.1 s on the trunk from eight sides, floors that turn slippery for 2 s, both "
        f"begun at {phases}; slopes of 3 degrees that rise towards the named side; {payload:g} kg "
        "on top of the trunk; commands that no tuning saw. The controller is told of none of it. "
        f"Largest relative KKT residual of a plan {result.residual:.0e}{solved}",
        table(result.cells, result.losses),
        f"L / {BASELINE} is the median of the ratio in the same scene on the same plant, falls "
        "charged as the loss charges them; in brackets its 95 % interval from redrawing the "
        f"plants, rough where they are few ({flags.seeds} here). A star marks a ratio that is no "
        "comparison, because one of the two falls more often by 2 of 32 walks or the same share.",
    ]
    named = ("world", "seeds", "first_seed", "scenes")
    numbers = {
        "flags": {name: value for name, value in asdict(flags).items() if name in named},
        "weights": {name: tree_hash(w) for name, w in sets.items()},
        "family": metrics.family_of(flags.world),
        "residual": result.residual,
        "levels": {
            level.name: {
                f"L_{BASELINE}": result.losses[level],
                "sets": {name: as_result(cell) for name, cell in row.items()},
            }
            for level, row in result.cells.items()
        },
        "endured": {name: force.tolist() for name, force in result.pushes.items()},
    }
    return write_report(
        folder / "report.md",
        f"How much the weight sets survive on {flags.scenes.traj}, {world}",
        paragraphs,
        numbers=numbers,
        json_name="robustness.json",
        pictures={
            "levels.png": plots.survival(folder / "levels.png", rows),
            "directions.png": plots.push_directions(folder / "directions.png", result.pushes),
        },
    )


if __name__ == "__main__":
    sys.exit(exit_code("robustness", main))
