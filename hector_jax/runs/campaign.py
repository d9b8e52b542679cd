"""The settings of a tuning on walks, and the coordinates of its weight sets.

A point stands for a weight set: steps of log-weights and of other numbers, in the metric of the
model (`search.few_walks.Space`).
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import TUNABLES, out_of_box
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, direction_names, directions, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import Robot
from hector_jax.search.cmaes import log_bounds, project
from hector_jax.search.few_walks import METHODS, Space
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
    methods: tuple[str, ...] = METHODS  # that propose
    grounded: bool = True  # the model is corrected by the residuals of the best walk

    def __post_init__(self) -> None:
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
    parts = d.standing, d.joints, d.linkage, d.weld, d.armature, feet, d.control
    return hashlib.sha256(repr(parts).encode() + d.model.read_bytes()).hexdigest()[:16]


def with_leg_numbers(walk: WalkConfig, start: Weights, names: Sequence[str]) -> Weights:
    """Return the weights from which numbers of the legs are tuned, with these numbers.

    Raises:
        InputError: a number is out of its box.
    """
    start = walk.with_others(start, names)
    for name in names:
        if reason := out_of_box(name, start.others[name]):
            raise InputError(f"--tune: {reason}")
    return start


def box_of(campaign: Campaign) -> Float[np.ndarray, "n 2"]:
    """Return bounds of the steps: of log-weights, and of other numbers in units of `_unit`."""
    bounds = [log_bounds(campaign.start)]
    for name in campaign.numbers:
        limits = np.array([TUNABLES[name].lower, TUNABLES[name].upper])
        start = np.reshape(campaign.start.others[name], (-1, 1))
        bounds.append((limits - start) / np.reshape(_unit(campaign, name), (-1, 1)))
    return np.concatenate(bounds)


def _unit(campaign: Campaign, name: str) -> Any:
    """Return the unit steps of a number: a tenth of its range, of joint gains half of the start."""
    if TUNABLES[name].each_joint:
        return 0.5 * campaign.start.others[name]
    return 0.1 * (TUNABLES[name].upper - TUNABLES[name].lower)


def weights_at(campaign: Campaign, space: Space, point: Float[np.ndarray, " n"]) -> Weights:
    """Return the weights of a point."""
    others = dict(campaign.start.others)
    sizes = [len(direction_names(campaign.start)), *(np.size(others[n]) for n in campaign.numbers)]
    of_weights, *steps = np.split(space.to_steps @ point, np.cumsum(sizes)[:-1])
    for name, step in zip(campaign.numbers, steps, strict=True):
        tunable, start = TUNABLES[name], others[name]
        value = start + step.reshape(np.shape(start)) * _unit(campaign, name)
        others[name] = np.clip(value, tunable.lower, tunable.upper)
    return project(campaign.start, of_weights)._replace(others=others)


def point_of(campaign: Campaign, space: Space, weights: Weights) -> Float[np.ndarray, " n"]:
    """Return the point of weights: the inverse of `weights_at` in the box."""
    before, after = (np.asarray(weights_to_vector(w)) for w in (campaign.start, weights))
    first_foot = directions(campaign.start).argmax(axis=1)  # index of each direction's first weight
    steps = [np.log(after / before)[first_foot]]
    for name in campaign.numbers:
        change = weights.others[name] - campaign.start.others[name]
        steps.append(np.ravel(change / _unit(campaign, name)))
    return space.to_point @ np.concatenate(steps)


def slope_of(
    campaign: Campaign, space: Space, weights: Weights, gradient: Weights
) -> Float[np.ndarray, " n"]:
    """Return the gradient with respect to the point from that with respect to the weights."""
    by_log = np.asarray(weights_to_vector(gradient)) * np.asarray(weights_to_vector(weights))
    others = [
        float(gradient.others[name]) * _unit(campaign, name) for name in campaign.config.others
    ]
    of_model = np.append(directions(weights) @ by_log, others)
    # the model's loss does not depend on the numbers of the legs, which come last
    return space.to_steps.T @ np.pad(of_model, (0, len(space.box) - len(of_model)))


def matrix_of(
    campaign: Campaign, space: Space, matrix: Float[np.ndarray, "m m"]
) -> Float[np.ndarray, "n n"]:
    """Return a matrix by the point from that by the steps of a tuning, `parameters.stepped`."""
    others = campaign.config.others
    widths = [_unit(campaign, n) / (TUNABLES[n].upper - TUNABLES[n].lower) for n in others]
    units = np.append(np.ones(len(matrix) - len(others)), widths)
    # the model's loss does not depend on the numbers of the legs, which come last
    steps = units[:, None] * space.to_steps[: len(matrix)]
    return steps.T @ matrix @ steps
