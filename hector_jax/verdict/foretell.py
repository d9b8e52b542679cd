"""What weights that never walked on a robot would bring there, foretold from a log of one that did.

The rigid body grounded on the log walks with the other weights (tuning/grounded.py). How far such a
forecast is off was measured: `foretold.json`, written by experiments/foretell.py, has pairs of what
was foretold and what was walked, as logarithms of the ratio to the walk of the log. Their quantiles
make the interval (split conformal prediction, Vovk et al. 2005): of plants that are drawn as those
of the pairs it holds the given share, whatever the distribution. Falls are not foretold.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import (
    is_ours,
    numbers_of,
    steps_between,
    tunable,
    without_numbers,
)
from hector_jax.control.reference import Command, standing_anchor
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import read_json
from hector_jax.core.trajectory import SOLVED
from hector_jax.grfm import network
from hector_jax.own.log_check import check_log, read_check
from hector_jax.own.planner import called_plans, plan_inputs
from hector_jax.own.walk_file import read_walk, reference_of
from hector_jax.own.walk_log import Log, at_ticks, log_of, trajectory_of
from hector_jax.robot.model import Robot, describe
from hector_jax.tuning.called import CallPlans
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.grounded import Grounding, fit_grounding, grounded_rollout
from hector_jax.tuning.rollout import Scenario
from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import BASELINES, Interval, Score, Verdict

COVERAGE = 0.9  # of an interval
FEWEST = 40  # pairs of a group: below that it has no interval
_FLOOR = 0.3  # of a log ratio: errors of a forecast grow with what it foretells beyond this
_PAIRS = Path(__file__).with_name("foretold.json")

HERE, ELSEWHERE = "here", "elsewhere"
"""Groups of pairs: HECTOR in MuJoCo; other robots and engines, for logs made elsewhere."""
_CARRIED = "carried"
"""Pairs of another kind, of sets without a log: the median change of L over plants of HECTOR in
MuJoCo, and the change on a plant in another engine, or with other masses."""


class Foretold(NamedTuple):
    """Walks that a log foretells."""

    scores: dict[str, Score]  # by set; of a walk that falls it says no more than that
    margins: dict[str, tuple[float, float]]  # by set: largest tilt and lowest height, see `margin`
    walked: Score  # of the log, as the grounded rollout repeats it
    distances: dict[str, float]  # of the weights from those of the log, see `distance`
    unexplained: float  # see `unexplained_acceleration`


def read_logged(
    path: Path, config: TuneConfig, robot: Robot, command: Command
) -> tuple[Log, Score]:
    """Return a log at the plan interval, and the score of its walk.

    Args:
        path: file of the log, see `walk_file`.
        config: loss, controller, and a rollout as long as the log.
        robot, command: that walked, and what was asked of it.

    Raises:
        InputError: it has faults that no weight can fix, so that it foretells nothing; or it fell.
    """
    controller = config.rollout.walk
    tick, seconds = controller.gait.tick, config.rollout.ticks * controller.gait.tick
    checked, _ = read_check(path, robot, command, seconds, tick)
    if faults := check_log(checked, controller.plan_interval):
        raise InputError(f"{path} foretells nothing: {faults[0]}")
    walk, end = read_walk(path, robot, seconds, tick)
    if end:
        raise InputError(f"{path} foretells nothing: {end}")
    reference = jax.tree.map(np.asarray, reference_of(tick, robot, command, walk))
    score = metrics.score(config.loss, walk._replace(reference=reference))
    return at_ticks(log_of(walk), tick), score


def group_of(robot: Robot, paths: Iterable[Path], *, called: bool = False) -> str:
    """Return the group of pairs that a forecast from some logs is one of.

    Args:
        robot: that walked.
        paths: files of the logs.
        called: whether the controller is one that is known by calling it.
    """
    ours = robot.description == describe() and not called
    return HERE if ours and all(map(_is_of_mujoco, paths)) else ELSEWHERE


def _is_of_mujoco(path: Path) -> bool:
    """Tell whether `hector walk` wrote a log, in MuJoCo."""
    with np.load(path, allow_pickle=False) as archive:
        card = str(archive["card"]) if "card" in archive.files else ""
    return '"engine": "c"' in card and '"kind": "trajectory"' in card


def quantities(score: Score) -> dict[str, float]:
    """Return what is foretold of a walk: L, errors [m], [rad], and L_ctrl if the loss has it."""
    euler, position = np.asarray(score.rms_euler), np.asarray(score.rms_position)
    found = {"L": float(score.L), "plane": float(np.hypot(*position[:2])), "height": position[2]}
    found |= {"pitch": euler[1], "yaw": euler[2]}
    smooth = {"L_ctrl": score.losses["L_ctrl"]} if "L_ctrl" in score.losses else {}
    return {name: float(x) for name, x in {**found, **smooth}.items()}


def distance(walked: Weights, weights: Weights) -> float:
    """Return the root mean square of the logarithms of the ratios of the directions of Q and R."""
    return float(np.sqrt(np.mean(np.square(steps_between(walked, weights)))))


def foretell(
    config: TuneConfig,
    robot: Robot,
    command: Command,
    log: Log,
    sets: Mapping[str, Weights],
    *,
    walked: Weights,
    call: CallPlans | None = None,
) -> Foretold:
    """Foretell the walks of weight sets on the robot of a log.

    Args:
        config: controller, loss, and a rollout as long as the log.
        robot, command: that walked, and what was asked of it.
        log: at the plan interval, without a fall.
        sets: weights by name.
        walked: weights of the log.
        call: plans of a controller that is known by calling it.

    Raises:
        InputError: the robot fell in the log; a plan of a foretold walk is not solved; or a set has
            another value of a number that the rigid body does not have.
    """
    controller = config.rollout.walk
    if log.fallen.any():
        raise InputError("the robot fell in the log: it foretells nothing")
    whole = _completed(controller, {"": walked, **sets})
    planned = {x.name for x in numbers_of(robot.description) if not x.of_legs and call is not None}
    for name, weights in whole.items():
        if unknown := [x for x in _differing(whole[""], weights) if not _is_felt(x, planned)]:
            text = f"{', '.join(unknown)} differs from that of the log, but no plan depends on it"
            raise InputError(f"{name}: {text}: only a walk can tell what it brings")
    effect = network.effect_of(None, controller)
    scenario = Scenario(robot, command, standing_anchor(robot), effect)
    walk, called = trajectory_of(log), None
    if call is not None:
        inputs = plan_inputs(controller, robot, walked, command, walk)
        numbers = [x for x in numbers_of(robot.description) if x.name in planned]
        called = called_plans(call, controller, inputs, numbers)
    grounding = fit_grounding(config.rollout, scenario, whole[""], walk, called=called)
    scores, margins, limits = {}, {}, robot.description.limits
    for name, weights in whole.items():
        found = jax.device_get(_rollout(config.rollout, grounding, weights))
        if not np.max(found.residual) <= SOLVED:
            raise InputError(f"{name or 'the log'}: a plan of the foretold walk is not solved")
        scores[name] = metrics.score(config.loss, found)
        margins[name] = margin(limits, found.state.euler, found.state.position)
    away = {name: distance(walked, weights) for name, weights in sets.items()}
    return Foretold(
        scores,
        margins,
        scores.pop(""),
        away,
        unexplained_acceleration(controller.gait.tick, grounding),
    )


def unexplained_acceleration(tick: float, grounding: Grounding) -> float:
    """Return the acceleration of a walk that the rigid body does not explain, by gravity (RMS).

    Args:
        tick: of the gait [s], from one to the next of which the residuals are.
        grounding: of the walk.
    """
    change = np.asarray(grounding.residuals.state.velocity)
    weight = np.linalg.norm(grounding.scenario.robot.gravity)
    return float(np.sqrt(np.mean(np.sum(change**2, axis=1))) / tick / weight)


def _completed(controller: WalkConfig, sets: Mapping[str, Weights]) -> dict[str, Weights]:
    """Return sets with the same numbers: ours that one lacks are those of the controller."""
    ours = {name for x in sets.values() for name in without_numbers(x).others}
    return {name: controller.with_others(x, sorted(ours)) for name, x in sets.items()}


def _differing(walked: Weights, weights: Weights) -> list[str]:
    """Return the names of the numbers of a set that are not those of the log."""
    names = {*walked.others, *weights.others}
    values = {x: [w.others.get(x, np.nan) for w in (walked, weights)] for x in sorted(names)}
    return [name for name, (one, other) in values.items() if not np.array_equal(one, other)]


def _is_felt(name: str, planned: set[str]) -> bool:
    """Tell whether a foretold walk depends on a number."""
    return not tunable(name).of_legs if is_ours(name) else name in planned


_rollout = partial(jax.jit, static_argnums=0)(grounded_rollout)


def margin(
    limits: tuple[float, float],
    euler: Float[np.ndarray, "T 3"],
    position: Float[np.ndarray, "T 3"],
) -> tuple[float, float]:
    """Return the largest tilt as a share of the limit of a fall, and the lowest height over its.

    Args:
        limits: lowest height [m] and largest tilt [rad] of a robot that has not fallen.
        euler, position: of a walk.
    """
    tilt, height = np.abs(euler[:, :2]).max() / limits[1], position[:, 2].min() / limits[0]
    return float(tilt), float(height)


def calibrated(group: str) -> dict[str, Sequence[Sequence[float]]]:
    """Return the measured pairs of a group by quantity: (foretold, walked) log ratios."""
    return _calibration()["pairs"][group]["pairs"]


def held_by_means(group: str, logs: int) -> tuple[int, int] | None:
    """Return how many means of so many logs' forecasts held, and of how many; None: not counted."""
    counted = _calibration()["pairs"][group].get("several", {}).get(str(logs))
    return counted and tuple(counted)


@cache
def _calibration() -> dict[str, Any]:
    return read_json(_PAIRS, "the measured errors of forecasts")


def interval(foretold: float, pairs: Sequence[Sequence[float]], *, wider: float = 1.0) -> Interval:
    """Return the interval of a walked log ratio around a foretold one; NaN with few pairs.

    Args:
        foretold: log ratio.
        pairs: (foretold, walked) log ratios.
        wider: factor of the distances of both ends, see `widening`.

    >>> pairs = [(-1.0, -1.0 + 0.011 * k) for k in range(-50, 51)]
    >>> [round(x, 2) for x in interval(-0.9, pairs)]
    [-0.9, -1.37, -0.43]
    """
    if len(pairs) < FEWEST:
        return Interval(foretold, np.nan, np.nan)
    of_pairs, truth = np.asarray(pairs, float).T
    ordered = np.sort((truth - of_pairs) / (_FLOOR + np.abs(of_pairs)))
    outside = int(np.floor((len(ordered) + 1) * (1.0 - COVERAGE) / 2.0))  # on each side
    ends = ordered[[max(outside - 1, 0), min(len(ordered) - outside, len(ordered) - 1)]]
    low, high = foretold + wider * ends * (_FLOOR + abs(foretold))
    return Interval(foretold, float(low), float(high))


def widening(foretold: Foretold, group: str) -> float:
    """Return the factor by which intervals are wider than the pairs say; 1 for a usual log.

    It is by how much more of a walk's acceleration the rigid body leaves unexplained than in any
    log of the pairs. Nobody measured how far off forecasts of such a log are.
    """
    return max(foretold.unexplained / _calibration()["pairs"][group]["largest"], 1.0)


def forecast(foretold: Foretold, name: str, group: str) -> dict[str, Interval]:
    """Return the change of each quantity of a set against the walk of the log, as log ratios.

    Args:
        foretold: of one log.
        name: of the set.
        group: HERE or ELSEWHERE.

    Returns:
        By quantity, wider if the log is unlike those that were measured (`widening`); NaN in place
        of the ends if the foretold walk falls, and for all of one that is zero in a walk.

    Raises:
        InputError: the weights are farther from those of the log than any that was measured.
    """
    far, farthest = foretold.distances[name], _calibration()["pairs"][group]["farthest"]
    if far > farthest:
        text = f"forecasts were measured up to {np.exp(farthest):.1f} times"
        raise InputError(f"{name}: {np.exp(far):.1f} times the weights of the log (RMS); {text}")
    before, after = quantities(foretold.walked), quantities(foretold.scores[name])
    pairs = {} if foretold.scores[name].fallen else calibrated(group)
    ratios, wider = {x: log_ratio(after[x], before[x]) for x in after}, widening(foretold, group)
    return {x: interval(r, pairs.get(x, []), wider=wider) for x, r in ratios.items()}


class Carried(NamedTuple):
    """What a change of L in this simulator tells of robots that are not this simulator."""

    change: dict[str, Interval]  # [%] by scene
    held: int  # walks whose interval held, by another set in all other engines and masses
    walks: int


def carry(verdict: Verdict, name: str) -> Carried:
    """Return what change of L, against nominal, a set may bring on a robot without a log.

    Args:
        verdict: of HECTOR's plants in MuJoCo.
        name: of the set; scenes in which falls make its comparison void are left out.
    """
    group, change = _calibration()["pairs"][_CARRIED], {}
    for scene in verdict.scenes:
        compared = metrics.compare(verdict.of_scene(scene), name, BASELINES[0])
        if compared.counts:
            here = np.log1p(compared.change["L"].value / 100.0)
            ends = interval(float(here), group["pairs"]["L"])
            change[scene] = Interval(*(100.0 * float(np.expm1(x)) for x in ends))
    return Carried(change, *group["held"])


def log_ratio(after: float, before: float) -> float:
    """Return the logarithm of a ratio; NaN if one of both is zero."""
    return float(np.log(after / before)) if after > 0.0 and before > 0.0 else float("nan")
