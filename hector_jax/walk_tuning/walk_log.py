"""Logs of walks of this simulator or of a robot: their entries, loading, card and loss."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.reference import Command, anchor_at, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.settings import convert
from hector_jax.core.trajectory import SOLVED, State, Trajectory, Wrench, has_fallen, no_samples
from hector_jax.core.tree_file import named_leaves, read_card, tree_hash
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import loss_of
from hector_jax.walk_tuning.campaign import walker_hash


class Log(NamedTuple):
    """Measurements of a walk: the entries of these names in the file of `hector walk --out`."""

    initial: State  # at t = 0, when the command begins
    state: State  # (T, 3) each, at the end of each sample
    joints: Float[Any, "T joints"]  # [rad] leg by leg
    command: Wrench  # (T, feet, 3) each, held over the sample [N, N m]
    fallen: Bool[Any, " T"]
    residual: Float[Any, " T"]  # of the plans


class LogScore(NamedTuple):
    """Score of the log of one case."""

    loss: float  # L; infinite if the robot fell or a QP was not solved
    margin: float  # share of the way to a fall, of tilt and height; 1 where the loss is infinite


ScoredLog = tuple[LogScore, Log]
"""The score of a log of 1 ms, and the log at the plan interval."""


def log_of(trajectory: Trajectory) -> Log:
    """Return the log of a walk."""
    return Log(*(getattr(trajectory, name) for name in Log._fields))


def read_log(path: Path, robot: Robot, seconds: float) -> Log:
    """Read the log of a walk: an .npz with the entries of `Log`, as `hector walk --out` writes it.

    `period`, `fallen` and `residual` may be left out. A log that ends early counts as a fall from
    its end on.

    Args:
        path: the file.
        robot: the robot that walked.
        seconds: expected length of the walk; samples are of 1 ms.

    Raises:
        InputError: one line naming the file and the entry that is missing, of another shape, or not
            of finite numbers; or it is not a log of 1 ms.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if name != "card"}
    except Exception as error:  # a foreign archive can fail in any way
        raise InputError(f"{path}: not a log (.npz): {one_line(error)}") from None
    wanted, joints, feet = round(seconds / TIME_STEP), len(robot.joint_lower), len(robot.foot_point)
    count = next(iter(arrays.get("joints", np.zeros(())).shape), 0)
    if not 1 <= count <= wanted:
        raise InputError(f"{path}: expected {wanted} samples of joints, got {count}")
    empty = log_of(no_samples(joints, feet))
    log_shapes = {n: np.shape(leaf) for n, leaf in named_leaves(empty).items()}
    # where the empty log has no samples, this one has `count`
    shapes = {"period": (), **{n: tuple(x or count for x in s) for n, s in log_shapes.items()}}
    defaults = {"fallen": np.zeros(count, bool), "residual": np.zeros(count)}
    arrays = {"period": np.array(TIME_STEP), **defaults, **arrays}
    for name, shape in shapes.items():
        if name not in arrays:
            raise InputError(f"{path}: {name} is missing; expected {', '.join(shapes)}")
        if (got := arrays[name].shape) != shape:
            raise InputError(f"{path}: {name} must have shape {shape}, got {got}")
        if arrays[name].dtype.kind not in "biuf" or not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}: {name} must hold finite numbers")
    if not np.isclose(arrays["period"], TIME_STEP, rtol=1e-6):
        raise InputError(f"{path}: samples must be of {TIME_STEP} s, got {arrays['period']}")
    numbers = [arrays[name].astype(float) for name in log_shapes]
    log = jax.tree.unflatten(jax.tree.structure(empty), numbers)
    log = _on_samples(log, np.minimum(np.arange(wanted), count - 1))
    down = np.asarray(has_fallen(log.state, *robot.description.limits))
    fallen = np.maximum.accumulate(down | log.fallen.astype(bool))
    return log._replace(fallen=fallen | (np.arange(wanted) >= count))


def _on_samples(log: Log, rows: Any) -> Log:
    """Return the log on some of its samples."""
    samples = jax.tree.map(lambda x: x[rows], log._replace(initial=None))
    return samples._replace(initial=log.initial)


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


def trajectory_of(log: Log, period: float) -> Trajectory:
    """Return the trajectory of a log sampled every `period` [s]; entries not in a log are empty."""
    empty = no_samples(log.joints.shape[1], log.command.force.shape[1])
    return empty._replace(period=np.asarray(period), **log._asdict())


@partial(jax.jit, static_argnums=0)
def _reference_of(tick: float, robot: Robot, command: Command, log: Log) -> State:
    """Return the reference of a log of 1 ms; `tick` is that of the gait [s]."""
    ticks = (np.arange(len(log.fallen)) + 1.0) / round(tick / TIME_STEP)
    anchor = anchor_at(robot, log.initial, 0)
    return jax.vmap(lambda t: reference_at(tick, command, anchor, t))(ticks)


def tracking_errors(config: TuneConfig, robot: Robot, command: Command, log: Log) -> dict[str, Any]:
    """Return how a log of 1 ms tracks a command, as JSON values in SI units.

    RMS errors and `seconds` are up to a fall, of one sample at least.
    """
    count, tick = max(np.sum(~log.fallen), 1), config.rollout.walk.gait.tick
    reference = _reference_of(tick, robot, command, log)
    euler, position = (
        np.sqrt(np.mean((np.asarray(x) - y)[:count] ** 2, axis=0)).tolist()
        for x, y in zip(log.state[:2], reference[:2], strict=True)
    )
    return {
        "rms_position": position,  # x, y, z
        "rms_euler": euler,  # roll, pitch, yaw
        "initial_position": log.initial.position.tolist(),
        "initial_yaw": float(log.initial.euler[2]),
        "seconds": float(count * TIME_STEP),
        "fell": bool(log.fallen.any()),
    }


def evaluate_log(config: TuneConfig, robot: Robot, command: Command, log: Log) -> ScoredLog:
    """Return the score of a log of 1 ms against its command, and the log at the plan interval.

    Source: Eq. 11.
    """
    tick = config.rollout.walk.gait.tick
    stride, reference = round(tick / TIME_STEP), _reference_of(tick, robot, command, log)
    loss = float(loss_of(config.loss, trajectory_of(log, TIME_STEP)._replace(reference=reference)))
    min_height, max_tilt = robot.description.limits
    upright = ~log.fallen
    tilt = np.abs(log.state.euler[upright, :2]).max(initial=0.0) / max_tilt
    height = float(robot.standing_height)
    sunk = (height - log.state.position[upright, 2].min(initial=height)) / (height - min_height)
    failed = log.fallen.any() or not log.residual.max() <= SOLVED
    score = LogScore(np.inf, 1.0) if failed else LogScore(loss, float(max(tilt, sunk)))
    return score, _on_samples(log, slice(stride - 1, None, stride))
