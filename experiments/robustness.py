"""How much disturbance do weight sets survive that they were not tuned for?

Pushes from eight sides in three gait phases with growing force, a floor that turns slippery, slopes
of 3 degrees, a payload of 2 kg and slow motors; nominal, expert and the sets that are named. The
controller is told of none of it.

    python experiments/robustness.py --set tuned=runs/straight/TIME/weights/best.json

`hfs-varied` is the world to choose by; `--plants standin=6364-6371` is for verdicts on what was
chosen. The scores of finished walks are stored under OUT/scores, and a later call uses them.
"""

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
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
    LAG,
    PAYLOAD,
    Cell,
    Level,
    SceneConfig,
    as_result,
    evaluate_level,
    make_scenes,
    significant,
    table,
)

from hector_jax.cli.flags import named_file
from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, UNSEEN
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import exit_code
from hector_jax.core.files import make_folder
from hector_jax.core.identity import function_id
from hector_jax.core.inputs import InputError, unknown
from hector_jax.core.runtime import setup_jax, workers
from hector_jax.core.settings import AT_LEAST_ONE, check
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import tree_hash
from hector_jax.report.report import WORLDS
from hector_jax.robot.description import HECTOR, Description
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import Score

BASELINE = "nominal"


@dataclass(frozen=True)
class Flags:
    """What to compare."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()  # NAME=FILE, beside the two
    traj: tuple[str, ...] = COMMANDS  # names of trajectories
    # WORLD=FIRST-LAST, seeds; hfs-varied to choose by, standin or standin-even for verdicts
    plants: tuple[str, ...] = ("hfs-varied=0-1",)
    scenes: Annotated[SceneConfig, tyro.conf.arg(name="")] = SceneConfig()
    robot: Path | None = None  # TOML file of another biped; HECTOR by default
    out: Path = Path("runs/robustness")  # folder of the report
    processes: Annotated[int, AT_LEAST_ONE] = 2  # one core each

    def __post_init__(self) -> None:
        check(self)
        for name in self.traj:
            if name not in (*COMMANDS, *UNSEEN):
                raise InputError(unknown("trajectory", name, (*COMMANDS, *UNSEEN)))
        for text in self.plants:
            if not re.fullmatch(r"[a-z-]+=\d+-\d+", text):
                raise InputError(f"--plants must be WORLD=FIRST-LAST, got {text!r}")

    @property
    def seeds(self) -> dict[str, range]:
        """Seeds of the plants of each world."""
        found = {}
        for text in self.plants:
            world, _, seeds = text.partition("=")
            first, last = map(int, seeds.split("-"))
            found[world] = range(first, last + 1)
        return found


class Case(NamedTuple):
    """A trajectory on the plants of a world."""

    traj: str
    world: str


Cells = dict[Case, dict[Level, dict[str, Cell]]]  # by set, the baseline first


def weight_sets(named: Sequence[str], robot: Robot | None = None) -> dict[str, Weights]:
    """Return nominal, expert and the weights of the files of NAME=FILE.

    Raises:
        InputError: no NAME=FILE, a name in use, or a file without weights.
    """
    sets = {BASELINE: nominal(robot), "expert": expert(robot)}
    for text in named:
        name, file = named_file(text)
        # names are part of file names, where other characters might make two of them equal
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or name in sets:
            raise InputError(
                f"--set must be NAME=FILE, a new NAME of letters, digits and _, got {text!r}"
            )
        sets[name] = load_weights(Path(file), robot)
    return sets


def compare(scores: Mapping[tuple[Case, Level, str], Score]) -> Cells:
    """Compare all sets with the baseline in all cases and at all levels.

    Args:
        scores: (plants, scenes) each, the baseline's first.
    """
    cells: Cells = {}
    for (case, level, name), score in scores.items():
        cell = evaluate_level(score, scores[case, level, BASELINE])
        cells.setdefault(case, {}).setdefault(level, {})[name] = cell
    return cells


def main() -> None:
    """Write report.md, robustness.json and the pictures."""
    flags = tyro.cli(Flags)
    setup_jax()
    robot = jax.tree.map(np.asarray, load_robot(flags.robot))
    sets, body, config = weight_sets(flags.set, robot), robot.description, walk_config(robot)

    def plant(world: str, seed: int) -> Imperfections:
        draw = FAMILIES.get(metrics.family_of(world) or "", partial(named_world, world))
        return draw(seed, body)

    walks = {
        (Case(traj, world), level, name, seed): [
            (scene.job(sets[name], plant(world, seed), seed), scene.changes) for scene in at_level
        ]
        for world, seeds in flags.seeds.items()
        for traj in flags.traj
        for level, at_level in make_scenes(flags.scenes, traj, config.gait, body.plants).items()
        for name in sets
        for seed in seeds
    }

    def group(case: Case, level: Level, name: str, seed: int) -> str:
        return "-".join([*case, level.name, name, str(seed)]).replace(" ", "-").replace("/", "-")

    loss = loss_of_robot(body)
    with workers(flags.processes) as pool:
        by_group = walk_groups(
            {group(*key): jobs for key, jobs in walks.items()},
            partial(walk_all, pool, config, robot),
            partial(metrics.score, loss),
            like=metrics.score_like(0),
            kind="robustness",
            robot=robot,
            folder=flags.out / "scores",
            settings=(config, repr(loss), function_id(walk_with_changes)),
        )
    scores = {
        (case, level, name): stack(
            [by_group[group(case, level, name, seed)] for seed in flags.seeds[case.world]]
        )
        for case, level, name, _ in walks
    }
    print(report(flags, sets, scores, flags.out, body))


def report(
    flags: Flags,
    sets: Mapping[str, Weights],
    scores: Mapping[tuple[Case, Level, str], Score],
    folder: Path,
    body: Description = HECTOR,
) -> Path:
    """Write the report with its pictures and its numbers as JSON; returns its path.

    Args:
        flags, body: of the walks.
        sets: weights by name, the baseline first.
        scores: (plants, scenes) each, the baseline's first.
    """
    make_folder(folder)
    count, payload = flags.scenes.phases, PAYLOAD * body.plants.payload
    cells, sets = compare(scores), {n: sets[n] for n in dict.fromkeys(key[2] for key in scores)}
    residual = max(float(score.residual.max()) for score in scores.values())
    each = [(case, level, row) for case, rows in cells.items() for level, row in rows.items()]
    totals = {
        name: {
            "walks": sum(row[name].walks for *_, row in each),
            "falls": sum(row[name].falls for *_, row in each),
            "falls_more": [
                f"{' '.join(each[i][0])} {each[i][1].name}"
                for i in significant([row[name].p for *_, row in each])
            ],
        }
        for name in sets
    }
    phases = "one phase of the gait" if count == 1 else f"{count} phases of the gait"
    paragraphs = [
        f"Pushes of 0.1 s on the trunk from eight sides, floors that turn slippery for 2 s, both "
        f"begun at {phases}; slopes of 3 degrees that rise towards the named side; {payload:g} kg "
        f"on top of the trunk; motors with so much delay and {1e3 * LAG:g} ms of lag, with a noisy "
        "estimate. The controller is told of none of it. Largest relative KKT residual of a plan "
        f"{residual:.0e}{'.' if residual <= SOLVED else ': **not solved**.'}",
        *(
            f"{one['falls']} of {one['walks']} walks fall with `{name}`"
            + f"; rows with more falls than `{BASELINE}`, by the test below: "
            f"{', '.join(one['falls_more']) or 'none'}" * (name != BASELINE) + "."
            for name, one in totals.items()
        ),
        f"L / {BASELINE} is the median of the ratio in the same scene on the same plant, falls "
        "charged as the loss charges them; in brackets its 95 % interval from redrawing the "
        "plants. A star marks a ratio that is no comparison, because one of the two falls more "
        "often by 2 of 32 walks or the same share. A set falls more often in a row if an exact "
        "one-sided sign test on the scenes in which one of both falls says so, with Holm's "
        "correction for all rows at 5 %.",
    ]
    pictures = {}
    for case, rows in cells.items():
        seeds, world = flags.seeds[case.world], WORLDS.get(case.world, case.world)
        losses = {level: float(np.median(scores[case, level, BASELINE].L)) for level in rows}
        head = f"## {case.traj}, {world}, plants {seeds[0]} to {seeds[-1]}"
        paragraphs += [head, table(rows, losses)]
        file = f"{case.traj}-{case.world}.png"
        pictures[file] = plots.survival(folder / file, {x.name: row for x, row in rows.items()})
    numbers = {
        "flags": {n: value for n, value in asdict(flags).items() if n in ("plants", "scenes")},
        "weights": {name: tree_hash(w) for name, w in sets.items()},
        "residual": residual,
        "totals": totals,
        "cells": [
            {**case._asdict(), "level": level.name}
            | {"sets": {name: as_result(cell) for name, cell in row.items()}}
            for case, level, row in each
        ],
    }
    return write_report(
        folder / "report.md",
        "How much the weight sets survive",
        paragraphs,
        numbers=numbers,
        json_name="robustness.json",
        pictures=pictures,
    )


if __name__ == "__main__":
    sys.exit(exit_code("robustness", main))
