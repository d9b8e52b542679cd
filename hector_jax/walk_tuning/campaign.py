"""The settings of a tuning on walks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Self

import jax
import numpy as np

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.own.program import Program
from hector_jax.robot.model import Robot
from hector_jax.sim.engine import MUJOCO_C, Engine
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import TuneConfig, init
from hector_jax.walk_tuning.moved import Along, along_of


@dataclass(frozen=True, eq=False)
class Campaign:
    """Settings of a tuning on walks: a case is a command, on a plant."""

    folder: Path
    config: TuneConfig  # its rollout as long as the walks
    robot: Robot
    start: Weights  # completed by all numbers that are tuned; the feet share one R
    commands: Mapping[str, Command]
    plants: Sequence[Imperfections | None] = (None,)  # None: the walks are made elsewhere
    engine: Engine = MUJOCO_C
    planner: Program | None = None  # that slopes are by; None: the controller of the robot's file
    groups: bool = False  # slopes of Q and R by walks in their groups, in place of any plans
    kept: Mapping[str, Command] = field(default_factory=dict)  # commands to keep, see `kept`

    def __post_init__(self) -> None:
        start = jax.tree.map(np.asarray, init(self.config, self.start).start)
        object.__setattr__(self, "start", start)

    @property
    def cases(self) -> list[tuple[Imperfections | None, Command]]:
        """Plant and command of each walk of a weight set."""
        return list(product(self.plants, self.commands.values()))

    @property
    def along(self) -> list[Along]:
        """Directions whose slopes are by walks."""
        return along_of(self.start, self.config.others, self.groups)

    @property
    def of_kept(self) -> Self:
        """The commands to keep as a campaign, whose logs are in a folder of their own."""
        return replace(self, folder=self.folder / "kept", commands=self.kept, kept={})

    @property
    def set_walks(self) -> int:
        """Number of walks of a weight set that is better."""
        return len(self.plants) * (len(self.commands) + len(self.kept))

    @property
    def by_logs(self) -> bool:
        """True if the walks are made elsewhere and their logs added."""
        return all(plant is None for plant in self.plants)

    @property
    def seconds(self) -> float:
        """Length of a walk."""
        return self.config.rollout.ticks * self.config.rollout.walk.gait.tick
