"""The settings of a tuning on walks, and the coordinates of its weight sets.

A point stands for a weight set: steps of log-weights and of other numbers, in the metric of the
model (`search.few_walks.Space`).
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control import parameters
from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, direction_names
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import choose
from hector_jax.robot.model import Robot
from hector_jax.search.few_walks import Space
from hector_jax.sim.engine import MUJOCO_C, Engine
from hector_jax.sim.world import Imperfections
from hector_jax.tuning.difftune import TuneConfig, init


@dataclass(frozen=True, eq=False)
class Campaign:
    """Settings of a tuning on walks."""

    folder: Path
    config: TuneConfig  # its rollout as long as the walks
    robot: Robot
    start: Weights  # completed by all numbers that are tuned; the feet share one R
    commands: Mapping[str, Command]
    plants: Sequence[Imperfections | None] = (None,)  # None: the walks are made elsewhere
    seed: int = 0
    leg_numbers: tuple[str, ...] = ()  # of the legs, which the model does not have
    engine: Engine = MUJOCO_C
    # that proposes: "grounded", corrected by the residuals of the best walk, "every_walk", by those
    # of all, "plain", or "none"
    model: str = "grounded"

    def __post_init__(self) -> None:
        choose("Campaign.model", self.model, ("grounded", "every_walk", "plain", "none"))
        start = jax.tree.map(np.asarray, init(self.config, self.start).start)
        start = with_leg_numbers(self.config.rollout.walk, start, self.leg_numbers)
        object.__setattr__(self, "start", start)

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers beside Q and R that are tuned."""
        return *self.config.others, *self.leg_numbers

    @property
    def cases(self) -> list[tuple[Imperfections | None, Command]]:
        """Plant and command of each walk of a weight set."""
        return list(product(self.plants, self.commands.values()))

    @property
    def reported(self) -> bool:
        """True if the walks are made elsewhere and their logs reported."""
        return all(plant is None for plant in self.plants)

    @property
    def seconds(self) -> float:
        """Length of a walk."""
        return self.config.rollout.ticks * self.config.rollout.walk.gait.tick


def walker_hash(robot: Robot) -> str:
    """Return a hash (16 hexadecimal digits) of what of a robot's files makes a walk.

    What only begins or judges one may change: weights, loss, limits of a fall, plants.
    """
    d = robot.description
    feet = tuple(map(tuple, d.feet))
    control = [section for section in d.control if section[0] != "twin"]
    parts = d.standing, d.joints, d.linkage, d.weld, d.armature, feet, tuple(control)
    return hashlib.sha256(repr(parts).encode() + d.model.read_bytes()).hexdigest()[:16]


def with_leg_numbers(walk: WalkConfig, start: Weights, names: Sequence[str]) -> Weights:
    """Return the weights from which numbers of the legs are tuned, with these numbers.

    Raises:
        InputError: a number is out of its box.
    """
    start = walk.with_others(start, names)
    for name in names:
        if reason := parameters.out_of_box(name, start.others[name]):
            raise InputError(f"--tune: {reason}")
    return start


def box_of(campaign: Campaign) -> Float[np.ndarray, "n 2"]:
    """Return bounds of the steps: of log-weights, and of other numbers in their units."""
    return parameters.checked_bounds(campaign.start, campaign.numbers) / _units(campaign)[:, None]


def _units(campaign: Campaign) -> Float[np.ndarray, " n"]:
    """Return the units of all steps, in those of `parameters.stepped`.

    That of a number is a tenth of its range, of joint gains half of the start.
    """
    units = [np.ones(len(direction_names(campaign.start)))]
    for name in campaign.numbers:
        tunable, start = parameters.TUNABLES[name], campaign.start.others[name]
        unit = (0.5 * start if tunable.each_joint else 0.1 * tunable.width) / tunable.width
        units.append(np.broadcast_to(unit, np.shape(start)).ravel())
    return np.concatenate(units)


def weights_at(campaign: Campaign, space: Space, point: Float[np.ndarray, " n"]) -> Weights:
    """Return the weights of a point."""
    steps = _units(campaign) * (space.to_steps @ point)
    return jax.device_get(parameters.weights_after(campaign.start, steps, campaign.numbers))


def point_of(campaign: Campaign, space: Space, weights: Weights) -> Float[np.ndarray, " n"]:
    """Return the point of weights: the inverse of `weights_at` in the box."""
    steps = np.asarray(parameters.steps_between(campaign.start, weights, campaign.numbers))
    return space.to_point @ (steps / _units(campaign))


def slope_of(
    campaign: Campaign, space: Space, weights: Weights, gradient: Weights
) -> Float[np.ndarray, " n"]:
    """Return the gradient with respect to the point from that with respect to the weights."""
    by_steps = np.asarray(parameters.gradient_by_steps(weights, gradient, campaign.config.others))
    return _model_steps(campaign, space, len(by_steps)).T @ by_steps


def matrix_of(
    campaign: Campaign, space: Space, matrix: Float[np.ndarray, "m m"]
) -> Float[np.ndarray, "n n"]:
    """Return a matrix by the point from that by the steps of a tuning, `parameters.stepped`."""
    steps = _model_steps(campaign, space, len(matrix))
    return steps.T @ matrix @ steps


def _model_steps(campaign: Campaign, space: Space, count: int) -> Float[np.ndarray, "m n"]:
    """Return the derivative by the point of the steps that the model's loss depends on.

    These are the first ones: it does not depend on the numbers of the legs, which come last.
    """
    return (_units(campaign)[:, None] * space.to_steps)[:count]
