"""Which conventions of a log, and of its controller's cost and model, make a twin fit it.

The plans of the log are solved again under other readings of it: another order of legs and angles,
sign and axes of the wrenches. Then R in other units, and mass and height of the controller's model,
which are numbers, are fitted. What the fit does not need is as in this project.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import permutations, product
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import Command
from hector_jax.control.twin import TwinConfig
from hector_jax.control.weights import Weights
from hector_jax.core.console import say
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory, Wrench
from hector_jax.own.parity import plans_again
from hector_jax.own.walk_file import leg_order, to_world
from hector_jax.robot.model import Robot

LOG = ("legs", "joint_legs", "wrenches", "wrench_frame", "angles")
"""Fields of `TwinConfig` that say how a log is to be read."""

MODEL = ("input_cost", "mass", "height")
"""Fields that are numbers of the controller's cost and model."""

EXACT = 2e-3  # share of the weight: mean largest difference of plans, below which none is sought
CLOSER = 0.3  # share of an error that is left if a convention explains it
HELPS = 0.5  # of the error before it, that a step of the search has to reach
NEEDED = 1.1  # times the error without a convention, above which it is needed


class Fit(NamedTuple):
    """Conventions and how far the plans are off with them."""

    twin: TwinConfig
    error: float  # [N, N m] mean over the plans of the largest difference


class _Again(NamedTuple):
    """Plans of a log under one reading of its angles and joints."""

    logged: Wrench  # (n, feet, 3) as they are in the log
    euler: Float[np.ndarray, "n 3"]  # when they were planned
    twin: Float[np.ndarray, "n feet 6"]


class _Log(NamedTuple):
    """What is planned again."""

    read: Callable[[TwinConfig], Trajectory]
    config: WalkConfig  # of the twin, without conventions and numbers of the model
    robot: Robot
    weights: Weights
    command: Command

    def again(self, of: TwinConfig) -> _Again | None:
        """Return plans by a twin's numbers and its angles and joints; None: it cannot be read."""
        reading = TwinConfig(angles=of.angles, joint_legs=of.joint_legs)
        try:
            walk = self.read(reading)
        except InputError:
            return None
        mass = self.robot.mass if of.mass is None else of.mass
        height = self.robot.standing_height if of.height is None else of.height
        body = self.robot._replace(mass=np.asarray(mass), standing_height=np.asarray(height))
        rows, planned = plans_again(self.config, body, of.weights(self.weights), self.command, walk)
        logged = jax.tree.map(lambda x: x[rows], walk.command)
        return _Again(logged, walk.state.euler[rows - 1], np.concatenate(planned[0], axis=-1))

    def difference(self, again: _Again, of: TwinConfig) -> Float[np.ndarray, "n feet 6"]:
        """Return the plans of the log, read by a twin's conventions, less those of the twin."""
        feet = leg_order(self.robot, of.legs)
        wrench = jax.tree.map(lambda x: x[:, feet], again.logged)
        return np.concatenate(to_world(of, again.euler, wrench), axis=-1) - again.twin

    def error(self, of: TwinConfig) -> float:
        """Return the error of a fit; infinite if the log cannot be read so."""
        again = self.again(of)
        return np.inf if again is None else _mean(self.difference(again, of))


def find_conventions(
    read: Callable[[TwinConfig], Trajectory],
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
) -> tuple[Fit, Fit]:
    """Return how a log fits by the robot's file, and the conventions by which it fits best.

    Both are the same if it fits, or if no convention explains most of its distance.

    Args:
        read: the log, read by the conventions of a twin.
        config, robot: of the twin.
        weights, command: with which the controller walked.
    """
    twin = config.twin
    for names in (twin.legs, twin.joint_legs):
        leg_order(robot, names)  # of which no reading could tell that they are wrong
    given = {x.name: x.default for x in fields(twin) if x.name in (*LOG, *MODEL)}
    if twin.com is not None:  # whose height cannot be left out
        given["height"] = twin.height
    plain = replace(twin, **given)
    log = _Log(read, replace(config, twin=plain), robot, weights, command)
    fit = as_is = Fit(twin, log.error(twin))
    if not np.isfinite(as_is.error) and all(
        again is None for again, _ in _readings(log, twin, [1.0])
    ):
        read(twin)  # which tells why
    exact = EXACT * float(robot.mass * np.linalg.norm(robot.gravity))
    if fit.error > exact:
        say("its plans are not those of the log: trying other conventions, a minute or some")
    # with R of 1/40 no reading stands out: then all are tried with all
    for stage in (
        lambda of: _readings(log, of, [of.input_cost]),
        lambda of: _costs(log, of),
        lambda of: _fitted(log, of),
        lambda of: _readings(log, twin, usual_costs(config.mpc_step)),
        lambda of: _fitted(log, of),
    ):
        if fit.error > exact and (found := _best(log, stage(fit.twin))).error < HELPS * fit.error:
            fit = found
    if fit == as_is:
        return as_is, as_is
    fit = _simplest(log, fit)
    return as_is, fit if fit.error < CLOSER * as_is.error else as_is


def settings_of(fit: Fit, as_is: Fit, robot: Robot) -> dict[str, Any]:
    """Return the fields of [twin] that a fit changes, as values of a TOML or JSON file."""
    own = {"mass": float(robot.mass), "height": float(robot.standing_height)}
    own |= dict.fromkeys(("legs", "joint_legs"), robot.description.legs)
    changed = {x: getattr(fit.twin, x) for x in (*LOG, *MODEL)}
    changed = {x: y for x, y in changed.items() if y != getattr(as_is.twin, x)}
    values = {x: y or own[x] if x in own else y for x, y in changed.items()}
    return {x: [*y] if isinstance(y, tuple) else y for x, y in values.items()}


def lines_of(settings: Mapping[str, Any]) -> Iterator[str]:
    """Yield settings as lines of a TOML file."""
    for name, value in settings.items():
        yield f"{name} = {f'{value:.4g}' if isinstance(value, float) else json.dumps(value)}"


def _mean(difference: Float[np.ndarray, "n feet 6"]) -> float:
    return float(np.abs(difference).max(axis=(1, 2)).mean())


def _best(log: _Log, tried: Iterable[tuple[_Again | None, list[TwinConfig]]]) -> Fit:
    """Return the best fit of some twins, that come with what they plan."""
    read = [(again, twins) for again, twins in tried if again is not None]
    fits = [Fit(of, _mean(log.difference(again, of))) for again, twins in read for of in twins]
    return min(fits, key=lambda fit: fit.error, default=Fit(TwinConfig(), np.inf))


def _readings(
    log: _Log, twin: TwinConfig, costs: Sequence[float]
) -> Iterator[tuple[_Again | None, list[TwinConfig]]]:
    """Yield other readings of a log, with the plans of those that share angles, joints and cost."""
    legs = log.robot.description.legs
    orders = [() if order == legs else order for order in permutations(legs)]
    pairs = np.array(legs).reshape(-1, 2)[:, ::-1].ravel()  # left and right exchanged
    signs, frames = ("on_robot", "on_ground"), ("world", "heading", "trunk")
    names = "legs", "wrenches", "wrench_frame"
    for cost, angles, joint_legs in product(costs, ("rpy", "ypr"), ((), tuple(map(str, pairs)))):
        of = replace(twin, input_cost=cost, angles=angles, joint_legs=joint_legs)
        others = product(orders, signs, frames)
        yield log.again(of), [replace(of, **dict(zip(names, x, strict=True))) for x in others]


def _costs(log: _Log, twin: TwinConfig) -> Iterator[tuple[_Again | None, list[TwinConfig]]]:
    """Yield R in other units."""
    for factor in usual_costs(log.config.mpc_step):
        of = replace(twin, input_cost=factor)
        yield log.again(of), [of]


def usual_costs(step: float) -> list[float]:
    """Return by what R is multiplied in other usual costs, for an MPC of steps [s]."""
    return [half * by for half, by in product((1.0, 0.5, 2.0), (1.0, step, 1.0 / step))]


def _fitted(log: _Log, twin: TwinConfig) -> Iterator[tuple[_Again | None, list[TwinConfig]]]:
    """Yield the twin with its numbers fitted; jumps of single plans count little."""
    names = [name for name in MODEL if name != "height" or twin.com is None]
    own = {"input_cost": 1.0, "mass": log.robot.mass, "height": log.robot.standing_height}
    given = {name: getattr(twin, name) for name in names}
    start = {n: float(own[n]) if x is None else x for n, x in given.items()}

    def changed(logs: np.ndarray) -> TwinConfig:
        values = [x * float(np.exp(y)) for x, y in zip(start.values(), logs, strict=True)]
        return replace(twin, **dict(zip(names, values, strict=True)))

    def residuals(logs: np.ndarray) -> np.ndarray:
        again = log.again(changed(logs))
        assert again is not None  # its reading is that of the start
        return log.difference(again, twin).ravel()

    options: dict[str, Any] = {"loss": "soft_l1", "diff_step": 1e-4, "max_nfev": 30}
    options["x_scale"] = [{"input_cost": 1.0, "mass": 0.1, "height": 0.03}[name] for name in names]
    found = changed(least_squares(residuals, np.zeros(len(names)), bounds=(-1.0, 1.0), **options).x)
    yield log.again(found), [found]


def _simplest(log: _Log, fit: Fit) -> Fit:
    """Return a fit without what it does not need, and with R at a usual factor if that is near."""
    exact = EXACT * float(log.robot.mass * np.linalg.norm(log.robot.gravity))
    usual = usual_costs(log.config.mpc_step)
    nearest = min(usual, key=lambda x: abs(np.log(x / fit.twin.input_cost)))
    for name in (*MODEL, *LOG):
        tried = [getattr(log.config.twin, name), *([nearest] if name == "input_cost" else [])]
        for value in tried:
            of = replace(fit.twin, **{name: value})
            if (error := log.error(of)) < max(NEEDED * fit.error, exact):
                fit = Fit(of, error)
                break
    return fit
