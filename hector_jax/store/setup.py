"""What all steps of a run share."""

from concurrent.futures import Executor
from typing import NamedTuple

from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import TuneConfig


class Setup(NamedTuple):
    """Inputs of every step; `config` and `robot` are part of the keys of its artefacts."""

    pool: Executor  # worker processes
    config: TuneConfig  # controller, rollouts and loss
    robot: Robot  # nominal body
