"""What a weight set bears: scenes with something in the way, and what is left of their walks.

Scenes have a kind and a level: a push of 50 N, a floor of friction 0.4. The scenes of one level
differ in direction and gait phase and are walked by every set on every plant. Two numbers tell of a
level: the share of its walks without a fall, and the median of the paired ratios of L to the
baseline's. Their intervals redraw the plants, each with all of its scenes; fewer than four plants
have none.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import COMMANDS, UNSEEN, Command, named_command
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import AT_LEAST_ONE, POSITIVE, InputError, check, short_repr
from hector_jax.report.report import markdown_table
from hector_jax.runs.metrics import Interval, Score, bootstrap, falls_comparable
from hector_jax.sim.changes import Change
from hector_jax.sim.walk import Job
from hector_jax.sim.world import NO_PUSH, Imperfections, Push

DIRECTIONS = 45 * np.arange(8)  # [deg] of the pushes, from ahead to the left
PUSH_START, PUSH_TIME, PUSH_WALK = 0.8, 0.1, 2.5  # [s] the walk goes on until the robot has settled
STEP_START, STEP_END = 1.0, 3.0  # [s] of a slippery floor
PAYLOAD, PAYLOAD_LATE = 2.0, 2.0  # [kg], [s] when it is put on in the midst of a walk
SLOPE = np.deg2rad(3.0)
SLOPES = {"up": (SLOPE, 0.0), "down": (-SLOPE, 0.0), "left": (0.0, SLOPE), "right": (0.0, -SLOPE)}
"""Where the floor rises, seen from the walk's start."""


class Scene(NamedTuple):
    """A walk's circumstances, whoever walks and on whatever plant."""

    command: Command
    seconds: float = 4.0
    push: Push = NO_PUSH
    changes: tuple[Change, ...] = ()


class Level(NamedTuple):
    """What the scenes of a group have in common."""

    kind: str  # calm, push, friction, slope, payload or command
    size: float | str  # [N] of a push, friction of a floor; else which

    @property
    def name(self) -> str:
        """What a table calls it."""
        size = self.size if isinstance(self.size, str) else f"{self.size:g}"
        return f"{self.kind} {size}" + (" N" if self.kind == "push" else "")


class Cell(NamedTuple):
    """One weight set in the scenes of a level."""

    survived: Interval  # share of the walks without a fall
    ratio: Interval  # median of L / L of the baseline
    falls: int
    walks: int
    counts: bool  # neither set falls more often than the other allows, see metrics


@dataclass(frozen=True)
class SceneConfig:
    """Which scenes."""

    traj: str = "straight"  # walked in all scenes but those of kind command
    forces: tuple[float, ...] = (25.0, 50.0, 75.0, 100.0, 125.0, 150.0)  # [N] of the pushes
    frictions: tuple[float, ...] = (0.5, 0.4, 0.3, 0.25, 0.2)  # that the floor steps to
    phases: int = 3  # of the gait, at which a push or a slippery floor begins

    def __post_init__(self) -> None:
        trajectories = (*COMMANDS, *UNSEEN)
        check(self, traj=trajectories, forces=POSITIVE, frictions=POSITIVE, phases=AT_LEAST_ONE)
        for name in ("forces", "frictions"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise InputError(
                    f"SceneConfig.{name} must differ, at least one, got {short_repr(values)}"
                )


def scenes(config: SceneConfig) -> dict[Level, list[Scene]]:
    """All scenes by level; those of a push are ordered by direction, then by phase."""
    command = named_command(config.traj)
    cycle = GaitConfig().tick * GaitConfig().cycle
    later = cycle * np.arange(config.phases) / config.phases  # t = 0 is a beginning of a cycle
    angles = np.deg2rad(DIRECTIONS)
    ways = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    once = lambda x: np.array([x])  # noqa: E731
    pushes = {
        Level("push", force): [
            Scene(
                command, PUSH_WALK, Push(once(force * way), once(PUSH_START + t), once(PUSH_TIME))
            )
            for way in ways
            for t in later
        ]
        for force in config.forces
    }
    slippery = {
        Level("friction", friction): [
            Scene(command, changes=(Change(STEP_START + t, STEP_END + t, floor_friction=friction),))
            for t in later
        ]
        for friction in config.frictions
    }
    slopes = {
        Level("slope", side): [Scene(command, changes=(Change(slope=rise),))]
        for side, rise in SLOPES.items()
    }
    loads = {
        "2 kg from the start": Change(payload=PAYLOAD),
        "2 kg put on at 2 s": Change(start=PAYLOAD_LATE, payload=PAYLOAD),
    }
    unseen = {name: named_command(name) for name in UNSEEN}
    return {
        Level("calm", config.traj): [Scene(command)],
        **pushes,
        **slippery,
        **slopes,
        **{Level("payload", name): [Scene(command, changes=(c,))] for name, c in loads.items()},
        **{
            Level("command", name): [Scene(one, max(4.0, float(one.duration.sum())))]
            for name, one in unseen.items()
        },
    }


def as_job(scene: Scene, weights: Weights, plant: Imperfections, seed: int) -> Job:
    """The scene as somebody's walk."""
    return Job(
        weights,
        scene.command,
        plant,
        seconds=scene.seconds,
        seed=seed,
        push=scene.push,
        changes=scene.changes,
    )


def judge(scores: Score, baseline: Score) -> Cell:
    """A weight set against a baseline in the scenes of one level.

    Args:
        scores: (plants, scenes) each.
        baseline: likewise, of the same plants and scenes; may be the same.
    """
    stood, ratio = ~scores.fallen, scores.L / baseline.L

    return Cell(
        survived=bootstrap(partial(np.mean, axis=(-2, -1)), stood),
        ratio=bootstrap(partial(np.median, axis=(-2, -1)), ratio),
        falls=int(scores.fallen.sum()),
        walks=scores.fallen.size,
        counts=falls_comparable(scores.fallen, baseline.fallen),
    )


def endured(fallen: Mapping[float, Bool[np.ndarray, "plants scenes"]]) -> Float[np.ndarray, "8"]:
    """Largest force [N] survived by direction, all smaller ones too; mean over plants and phases.

    Args:
        fallen: by force, in the order of `scenes`.
    """
    forces = np.array(sorted(fallen))
    stood = np.stack([~fallen[force] for force in forces])
    held = np.logical_and.accumulate(stood, axis=0).sum(axis=0)  # how many of the forces
    each = np.append(0.0, forces)[held].reshape(held.shape[0], len(DIRECTIONS), -1)
    return each.mean(axis=(0, 2))


def table(cells: Mapping[Level, Mapping[str, Cell]], losses: Mapping[Level, float]) -> str:
    """A row per level: the baseline's falls and L, the other sets' falls and ratios to it.

    Args:
        cells: by level and set, the baseline first.
        losses: median L of the baseline, by level.
    """
    baseline, *others = next(iter(cells.values()))
    head = ["", f"{baseline}: falls", "L [1e6]"]
    head += [text for name in others for text in (f"{name}: falls", f"L / {baseline}")]
    rows = []
    for level, found in cells.items():
        row = [level.name, _falls(found[baseline]), f"{losses[level] / 1e6:.2f}"]
        for name in others:
            row += [_falls(found[name]), _ratio(found[name])]
        rows.append(row)
    return markdown_table(head, rows)


def _falls(cell: Cell) -> str:
    return f"{cell.falls} of {cell.walks}"


def _ratio(cell: Cell) -> str:
    return cell.ratio.text("{:.2f}".format) + ("" if cell.counts else " *")


def as_result(cell: Cell) -> dict[str, Any]:
    """A cell as JSON values."""
    return cell._asdict() | {"survived": cell.survived._asdict(), "ratio": cell.ratio._asdict()}
