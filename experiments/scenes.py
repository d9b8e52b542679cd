"""Walks with disturbances, and the robustness of a weight set in them.

Scenes have a kind and a level: a push of 50 N, a floor of friction 0.4. The scenes of one level
differ in direction and gait phase; every set walks all of them on every plant. Two numbers describe
a level: the share of its walks without a fall, and the median of the paired ratios of L to the
baseline's. Their intervals redraw the plants, each with all of its scenes. Whether a set falls more
often than the baseline is an exact one-sided sign test on the scenes in which one of them falls.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from changes import TRUNK_TOP, Change, ChangingJob
from lib import bootstrap
from scipy.stats import binom

from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import Command, named_command
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, check
from hector_jax.report.report import markdown_table
from hector_jax.robot.description import HECTOR, PlantSizes
from hector_jax.sim.loop import Job
from hector_jax.sim.world import NO_PUSH, Imperfections, Push, noisy
from hector_jax.verdict.metrics import Interval, Score, falls_comparable

DIRECTIONS = 45 * np.arange(8)  # [deg] of the pushes, from ahead to the left
PUSH_START, PUSH_TIME, PUSH_WALK = 0.8, 0.1, 2.5  # [s] the walk includes the recovery
SLIPPERY = 1.0, 3.0  # [s] start and end of a slippery floor
PAYLOAD, PAYLOAD_LATE = 2.0, 2.0  # [kg]; [s] when it is put on in a walk
SLOPE = np.deg2rad(3.0)
DELAYS, LAG = (0.006, 0.008), 0.006  # [s] of slow motors, with a noisy estimate
_GAIT = GaitConfig()
SLOPES = {"up": (SLOPE, 0.0), "down": (-SLOPE, 0.0), "left": (0.0, SLOPE), "right": (0.0, -SLOPE)}
"""Slopes by the side to which the floor rises, seen from the walk's start."""


class Scene(NamedTuple):
    """Circumstances of a walk, for any weights on any plant."""

    command: Command
    seconds: float = 4.0
    push: Push = NO_PUSH
    changes: tuple[Change, ...] = ()
    delay: float | None = None  # [s] of the motors, in place of the plant's

    def job(self, weights: Weights, plant: Imperfections, seed: int) -> ChangingJob:
        """Return the walk of a weight set on a plant."""
        if self.delay is not None:
            slow = {"delay": np.asarray(self.delay), "lag": np.asarray(LAG)}
            plant = plant._replace(**slow, estimator=noisy())
        job = Job(weights, self.command, plant, self.seconds, seed, push=self.push)
        return ChangingJob(job, self.changes)


class Level(NamedTuple):
    """Kind and size of the disturbance of a group of scenes."""

    kind: str  # calm, push, friction, slope, payload or delay
    size: float | str  # [N] of a push, friction of a floor, [ms] of a delay; else a name

    @property
    def name(self) -> str:
        """Name of the row in a table."""
        size = self.size if isinstance(self.size, str) else f"{self.size:g}"
        return f"{self.kind} {size}" + {"push": " N", "delay": " ms"}.get(self.kind, "")


class Cell(NamedTuple):
    """Results of a weight set in the scenes of a level."""

    survived: Interval  # share of the walks without a fall
    ratio: Interval  # median of L / L of the baseline
    falls: int
    falls_by_plant: tuple[int, ...]
    walks: int
    counts: bool  # the falls of both sets allow a comparison, see metrics
    more: int  # scenes in which it falls and the baseline does not
    fewer: int  # the other way round
    p: float  # of so many more or more, if both fell alike


@dataclass(frozen=True)
class SceneConfig:
    """Which scenes."""

    # of the pushes [N], of another robot times its size
    forces: tuple[float, ...] = (50.0, 75.0, 100.0, 125.0)
    frictions: tuple[float, ...] = (0.55, 0.5, 0.45, 0.4, 0.35, 0.3)  # that the floor steps to
    phases: int = 3  # of the gait, at which a push or a slippery floor begins

    def __post_init__(self) -> None:
        check(self, forces=POSITIVE, frictions=POSITIVE, phases=AT_LEAST_ONE)
        for name in ("forces", "frictions"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InputError(
                    f"SceneConfig.{name} must differ, at least one, got {short_repr(values)}"
                )


def make_scenes(
    config: SceneConfig,
    traj: str,
    gait: GaitConfig = _GAIT,
    sizes: PlantSizes = HECTOR.plants,
) -> dict[Level, list[Scene]]:
    """Return all scenes by level; those of a push are ordered by direction, then by phase.

    Args:
        config: the scenes.
        traj: name of the command that is walked.
        gait: of the robot.
        sizes: of the robot's pushes, payloads and lengths.
    """
    command = named_command(traj)
    # t = 0 begins a cycle
    delays = gait.tick * gait.cycle * np.arange(config.phases) / config.phases
    start, end = SLIPPERY

    def pushed(force: float, side: float, t: float) -> Scene:
        vector = force * np.array([np.cos(side), np.sin(side), 0.0])
        times = np.array([PUSH_START + t]), np.array([PUSH_TIME])
        return Scene(command, PUSH_WALK, Push(vector[None], *times))

    def changed(change: Change) -> Scene:
        return Scene(command, changes=(change,))

    scenes = {Level("calm", "floor"): [Scene(command)]}
    for force in sizes.push * np.array(config.forces):
        scenes[Level("push", float(force))] = [
            pushed(force, side, t) for side in np.deg2rad(DIRECTIONS) for t in delays
        ]
    for friction in config.frictions:
        scenes[Level("friction", friction)] = [
            changed(Change(start + t, end + t, floor_friction=friction)) for t in delays
        ]
    for side, rise in SLOPES.items():
        scenes[Level("slope", side)] = [changed(Change(slope=rise))]
    payload, (x, y, z) = sizes.payload * PAYLOAD, sizes.trunk_com * np.array(TRUNK_TOP)
    early = Change(payload=payload, payload_at=(float(x), float(y), float(z)))
    late = early._replace(start=PAYLOAD_LATE)
    scenes[Level("payload", f"{payload:g} kg from the start")] = [changed(early)]
    scenes[Level("payload", f"{payload:g} kg put on at 2 s")] = [changed(late)]
    for delay in DELAYS:
        scenes[Level("delay", 1e3 * delay)] = [Scene(command, delay=delay)]
    return scenes


def evaluate_level(scores: Score, baseline: Score) -> Cell:
    """Compare a weight set with a baseline in the scenes of one level.

    Args:
        scores: (plants, scenes) each.
        baseline: (plants, scenes) on the same plants and scenes; may be the same set.
    """
    more, fewer = (int(np.sum(a & ~b)) for a, b in permutations((scores.fallen, baseline.fallen)))
    return Cell(
        survived=bootstrap(partial(np.mean, axis=(-2, -1)), ~scores.fallen),
        ratio=bootstrap(partial(np.median, axis=(-2, -1)), scores.L / baseline.L),
        falls=int(scores.fallen.sum()),
        falls_by_plant=tuple(scores.fallen.sum(axis=1).tolist()),
        walks=scores.fallen.size,
        counts=falls_comparable(scores.fallen, baseline.fallen),
        more=more,
        fewer=fewer,
        p=float(binom.sf(more - 1, more + fewer, 0.5)),
    )


def significant(p: Sequence[float], level: float = 0.05) -> list[int]:
    """Return the indices of the p values that Holm's step-down method rejects together."""
    found: list[int] = []
    for index in np.argsort(p):
        if p[index] > level / (len(p) - len(found)):
            break
        found.append(int(index))
    return found


def table(cells: Mapping[Level, Mapping[str, Cell]], losses: Mapping[Level, float]) -> str:
    """Return a table of levels: the baseline's falls and L, the others' falls and ratios to it.

    Args:
        cells: by level and set, the baseline first.
        losses: median L of the baseline, by level.
    """
    baseline, *others = next(iter(cells.values()))
    head = ["", f"{baseline}: falls", "L [1e6]"]
    head += [text for name in others for text in (f"{name}: falls", f"L / {baseline}")]
    rows = []
    for level, by_set in cells.items():
        falls = {name: f"{cell.falls} of {cell.walks}" for name, cell in by_set.items()}
        row = [level.name, falls[baseline], f"{losses[level] / 1e6:.2f}"]
        for name in others:
            cell = by_set[name]
            row += [falls[name], cell.ratio.text("{:.2f}".format) + " *" * (not cell.counts)]
        rows.append(row)
    return markdown_table(head, rows)


def as_result(cell: Cell) -> dict[str, Any]:
    """Return a cell as JSON values."""
    return cell._asdict() | {"survived": cell.survived._asdict(), "ratio": cell.ratio._asdict()}
