"""Logs of walks of this simulator or of a robot: their entries, loading, card and loss."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.settings import convert
from hector_jax.core.trajectory import SOLVED, Belief, State, Trajectory, Wrench, no_samples
from hector_jax.core.tree_file import read_card, tree_hash
from hector_jax.own.walk_file import read_walk, reference_of
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import loss_of


class Log(NamedTuple):
    """Measurements of a walk: the entries of these names in the file of `hector walk --out`."""

    period: Float[Any, ""]  # [s] between samples
    initial: State  # at t = 0, when the command begins
    state: State  # (T, 3) each, at the end of each sample
    joints: Float[Any, "T joints"]  # [rad] leg by leg
    command: Wrench  # (T, feet, 3) each, held over the sample [N, N m]
    contact: Bool[Any, "T feet"]  # planned stance; none in a log without this entry
    fallen: Bool[Any, " T"]
    residual: Float[Any, " T"]  # of the plans
    belief: Belief  # zero in a log without it


class ScoredLog(NamedTuple):
    """A log with its loss."""

    loss: float  # L; infinite if the robot fell or a QP was not solved
    log: Log  # at the plan interval


def log_of(trajectory: Trajectory) -> Log:
    """Return the log of a walk."""
    return Log(*(getattr(trajectory, name) for name in Log._fields))


def read_log(path: Path, robot: Robot, seconds: float, tick: float) -> Log:
    """Read the log of a walk; see `read_walk`."""
    return log_of(read_walk(path, robot, seconds, tick)[0])


def at_ticks(log: Log, tick: float) -> Log:
    """Return the log at the end of each tick [s]."""
    stride = round(tick / float(log.period))
    samples = log._replace(period=None, initial=None)
    return jax.tree.map(lambda x: x[stride - 1 :: stride], samples)._replace(
        period=np.asarray(tick), initial=log.initial
    )


def walker_hash(robot: Robot) -> str:
    """Return a hash (16 hexadecimal digits) of what of a robot's files makes a walk.

    What only begins or judges one may change: weights, loss, limits of a fall, plants.
    """
    d = robot.description
    control = [section for section in d.control if section[0] != "twin"]
    text = repr((d.standing, d.joints, d.linkage, tuple(map(tuple, d.feet)), control)).encode()
    return hashlib.sha256(text + d.model.read_bytes()).hexdigest()[:16]


def walk_card(
    name: str, command: Command, weights: Weights, robot: Robot, seconds: float
) -> dict[str, Any]:
    """Return what identifies a walk, as JSON values: the entry `walk` in the card of its log."""
    hashes = {"command": tree_hash(command), "weights": tree_hash(weights)}
    return {"trajectory": name, **hashes, "robot": walker_hash(robot), "seconds": round(seconds, 3)}


def check_card(
    path: Path, name: str, proposed: Mapping[str, Mapping[str, Any]], weights: Path
) -> bool:
    """Return whether a log that `read_log` reads has a card, which must be as it was proposed.

    Args:
        path, name: the log and its trajectory.
        proposed, weights: the `walk_card` of each trajectory, and the file of the weights in it.

    Raises:
        InputError: one line naming the log: its card is damaged, or of another walk.
    """
    with np.load(path, allow_pickle=False) as archive:
        about = read_card(path, "trajectory")["about"] if "card" in archive.files else {}
    if (card := convert(about.get("walk"), dict | None, name=f"{path}: card.about.walk")) is None:
        return False
    other, own, order = card.get("trajectory"), proposed[name], ", ".join(proposed)
    walk = f"{name} with another command" if other == name else one_line(str(other))
    reasons = {
        "command": f"a walk of {walk}, expected {name}; logs in the order {order}, or NAME=FILE",
        "weights": f"a walk with other weights than the proposed ones, {weights}",
        "robot": "a walk of another robot, or with another gait or controller",
        "seconds": f"a walk of {card.get('seconds')} s, expected {own['seconds']} s",
    }
    if differs := [key for key in reasons if card.get(key) != own[key]]:
        raise InputError(f"{path}: {reasons[differs[0]]}")
    return True


def check_fit(path: Path, name: str, tracked: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise an InputError if a log tracks another trajectory twice as well as its own.

    `tracked` is the result of `tracking` for each trajectory. A walk that fell is not judged.
    """
    cm = {n: 100.0 * np.hypot(*errors["rms_position"][:2]) for n, errors in tracked.items()}
    best = min(cm, key=lambda n: cm[n])
    if not tracked[name]["fell"] and cm[best] < 0.5 * cm[name]:
        raise InputError(
            f"{path}: fits {best} (horizontal error {cm[best]:.1f} cm), expected {name} "
            f"({cm[name]:.1f} cm); logs in the order {', '.join(cm)}, or {name}={path} to insist"
        )


def trajectory_of(log: Log) -> Trajectory:
    """Return the trajectory of a log; entries not in a log are empty."""
    empty = no_samples(log.joints.shape[1], log.command.force.shape[1])
    return empty._replace(**log._asdict())


def tracking_errors(config: TuneConfig, robot: Robot, command: Command, log: Log) -> dict[str, Any]:
    """Return how a log tracks a command, as JSON values in SI units.

    RMS errors and `seconds` are up to a fall, of one sample at least.
    """
    count, tick = max(np.sum(~log.fallen), 1), config.rollout.walk.gait.tick
    reference = reference_of(tick, robot, command, log)
    euler, position = (
        np.sqrt(np.mean((np.asarray(x) - y)[:count] ** 2, axis=0)).tolist()
        for x, y in zip(log.state[:2], reference[:2], strict=True)
    )
    return {
        "rms_position": position,  # x, y, z
        "rms_euler": euler,  # roll, pitch, yaw
        "initial_position": log.initial.position.tolist(),
        "initial_yaw": float(log.initial.euler[2]),
        "seconds": float(count * log.period),
        "fell": bool(log.fallen.any()),
    }


def evaluate_log(config: TuneConfig, robot: Robot, command: Command, log: Log) -> ScoredLog:
    """Return a log at the plan interval, with its loss against its command.

    Source: Eq. 11.
    """
    tick = config.rollout.walk.gait.tick
    reference = reference_of(tick, robot, command, log)
    loss = float(loss_of(config.loss, trajectory_of(log)._replace(reference=reference)))
    failed = log.fallen.any() or not log.residual.max() <= SOLVED
    return ScoredLog(np.inf if failed else loss, at_ticks(log, tick))
