"""How much disturbance do weight sets survive that they were not tuned for?

Pushes from eight sides in three gait phases with growing force, a floor that turns slippery, slopes
of 3 degrees, a payload of 2 kg and slow motors; nominal, expert and the sets that are named. The
controller is told of none of it.

    python experiments/robustness.py --set tuned=runs/straight/TIME/weights/best.json

`hfs-varied` is the world to choose by; `--plants standin=6364-6371` is for verdicts on what was
chosen. The scores of finished walks are rows of OUT/walks.jsonl, and a later call uses them.
"""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import lib
import numpy as np
import plots
import scenes
import tyro
from changes import CHANGING
from scenes import Cell, Level, SceneConfig

from hector_jax.control.reference import COMMANDS, UNSEEN
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.control.weights_file import load_weights
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.pool import workers
from hector_jax.core.settings import check
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree_file import tree_hash
from hector_jax.report.report import WORLDS
from hector_jax.robot.description import Description
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.standin import FAMILIES
from hector_jax.sim.world import named_world
from hector_jax.store import tunings
from hector_jax.store.setup import Setup
from hector_jax.verdict import judging, metrics
from hector_jax.verdict.metrics import Score

BASELINE = "nominal"


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What to compare."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()  # NAME=FILE, beside the two
    traj: tuple[str, ...] = COMMANDS  # names of trajectories
    # WORLD=FIRST-LAST, seeds; hfs-varied to choose by, standin or standin-even for verdicts
    plants: tuple[str, ...] = ("hfs-varied=0-1",)
    scenes: Annotated[SceneConfig, tyro.conf.arg(name="")] = SceneConfig()
    robot: Path | None = None  # TOML file of another biped; HECTOR by default
    out: Path = Path("runs/robustness")  # folder of the report

    def __post_init__(self) -> None:
        check(self, traj=(*COMMANDS, *UNSEEN))
        for text in self.plants:
            if not re.fullmatch(r"[a-z-]+=\d+-\d+", text):
                raise InputError(f"--plants must be WORLD=FIRST-LAST, got {text!r}")

    @property
    def seeds(self) -> dict[str, range]:
        """Seeds of the plants of each world."""
        parts = (re.split(r"=|-(?=\d)", text) for text in self.plants)
        return {world: range(int(first), int(last) + 1) for world, first, last in parts}


class Case(NamedTuple):
    """A trajectory on the plants of a world."""

    traj: str
    world: str


Scores = dict[tuple[Case, Level, str], Score]  # by set, the baseline first: (plants, scenes)
Cells = dict[Case, dict[Level, dict[str, Cell]]]  # by set, the baseline first


def weight_sets(flags: Flags, robot: Robot) -> dict[str, Weights]:
    """Return nominal, expert and the weights of the files of --set.

    Raises:
        InputError: no NAME=FILE, a name in use, or a file without weights.
    """
    sets = {BASELINE: nominal(robot), "expert": expert(robot)}
    for name, file in lib.named_files("set", flags.set).items():
        if name in sets:
            raise InputError(f"--set {name}={file}: there is a set {name!r} already")
        sets[name] = load_weights(Path(file), robot)
    return sets


def compare(scores: Scores) -> Cells:
    """Compare all sets with the baseline in all cases and at all levels."""
    cells: Cells = {}
    for (case, level, name), score in scores.items():
        cell = scenes.evaluate_level(score, scores[case, level, BASELINE])
        cells.setdefault(case, {}).setdefault(level, {})[name] = cell
    return cells


def walk_world(flags: Flags, setup: Setup, sets: Mapping[str, Weights], world: str) -> Scores:
    """Walk all sets in all scenes on the plants of a world."""
    body, seeds = setup.robot.description, flags.seeds[world]
    draw = FAMILIES.get(metrics.family_of(world) or "", partial(named_world, world))
    plants, gait = [draw(seed, body) for seed in seeds], setup.config.rollout.walk.gait
    levels = {
        (Case(traj, world), level): {f"{traj} {level.name} {i}": x for i, x in enumerate(found)}
        for traj in flags.traj
        for level, found in scenes.make_scenes(flags.scenes, traj, gait, body.plants).items()
    }
    jobs: dict[judging.Case, Any] = {
        (label, name, seed): scene.job(weights, plant, seed)
        for labelled in levels.values()
        for label, scene in labelled.items()
        for seed, plant in zip(seeds, plants, strict=True)
        for name, weights in sets.items()
    }
    title, folder = f"{plural(len(jobs), 'walk')} on {world}", flags.out
    options = {"folder": folder, "engine": CHANGING, "about": {"world": world}}
    judged = judging.judge_jobs(setup, jobs, title=title, **options)
    return {
        (*at, name): score
        for at, labelled in levels.items()
        for name, score in judged.verdict.of_scene(*labelled).scores.items()
    }


def main(flags: Flags) -> Path:
    """Write report.md, robustness.json and the pictures."""
    robot = load_robot(flags.robot)
    sets, scores = weight_sets(flags, robot), {}
    with workers(flags.processes) as pool:
        setup = Setup(pool, tunings.tune_config(robot), robot)
        for world in flags.seeds:
            scores |= walk_world(flags, setup, sets, world)
    return report(flags, sets, scores, robot.description)


def report(flags: Flags, sets: Mapping[str, Weights], scores: Scores, body: Description) -> Path:
    """Write the report with its pictures and its numbers as JSON; returns its path.

    Args:
        flags, scores, body: of the walks.
        sets: weights by name, the baseline first.
    """
    count, payload = flags.scenes.phases, scenes.PAYLOAD * body.plants.payload
    cells = compare(scores)
    residual = max(float(score.residual.max()) for score in scores.values())
    each = [(case, level, row) for case, rows in cells.items() for level, row in rows.items()]
    totals = {
        name: {
            "walks": sum(row[name].walks for *_, row in each),
            "falls": sum(row[name].falls for *_, row in each),
            "falls_more": [
                f"{' '.join(each[i][0])} {each[i][1].name}"
                for i in scenes.significant([row[name].p for *_, row in each])
            ],
        }
        for name in sets
    }
    phases = "one phase of the gait" if count == 1 else f"{count} phases of the gait"
    paragraphs = [
        f"Pushes of 0.1 s on the trunk from eight sides, floors that turn slippery for 2 s, both "
        f"begun at {phases}; slopes of 3 degrees that rise towards the named side; {payload:g} kg "
        f"on top of the trunk; motors with so much delay and {1e3 * scenes.LAG:g} ms of lag, with "
        "a noisy estimate. The controller is told of none of it. Largest relative KKT residual of "
        f"a plan {residual:.0e}{'.' if residual <= SOLVED else ': **not solved**.'}",
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
        paragraphs += [head, scenes.table(rows, losses)]
        file = f"{case.traj}-{case.world}.png"
        pictures[file] = plots.survival(flags.out / file, {x.name: row for x, row in rows.items()})
    numbers = {
        "flags": {n: value for n, value in asdict(flags).items() if n in ("plants", "scenes")},
        "weights": {name: tree_hash(w) for name, w in sets.items()},
        "residual": residual,
        "totals": totals,
        "cells": [
            {**case._asdict(), "level": level.name}
            | {"sets": {name: scenes.as_result(cell) for name, cell in row.items()}}
            for case, level, row in each
        ],
    }
    return lib.write_report(
        flags.out / "robustness.json",
        "How much the weight sets survive",
        paragraphs,
        numbers,
        pictures,
    )


if __name__ == "__main__":
    lib.run(main, Flags)
