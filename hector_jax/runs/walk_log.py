"""Logs of walks, of this simulator or of a robot: what is read of them, and what they say."""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.reference import Command, anchor_at, reference_at
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.trajectory import SOLVED, State, Trajectory, Wrench, has_fallen, no_samples
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import loss_of


class Log(NamedTuple):
    """What is measured on a walk: the entries of this name in the file of `hector walk --out`."""

    initial: State  # at t = 0, when the command begins
    state: State  # (T, 3) each, at the end of each sample
    joints: Float[Any, "T joints"]  # [rad] leg by leg
    command: Wrench  # (T, feet, 3) each, held over the sample [N, N m]
    fallen: Bool[Any, " T"]
    residual: Float[Any, " T"]  # of the plans


class Seen(NamedTuple):
    """What the log of a case says."""

    loss: float  # L; infinite where it fell or a QP was not solved
    margin: float  # share of the way to a fall, of tilt and height; 1 likewise


def log_of(walked: Trajectory) -> Log:
    """What is read of a walk."""
    return Log(*(getattr(walked, name) for name in Log._fields))


def read_log(path: Path, robot: Robot, seconds: float) -> Log:
    """The log of a walk: an .npz with the entries of `Log`, such as `hector walk --out` writes.

    `period`, `fallen` and `residual` may be left out. A log that ends early is that of a fall.

    Args:
        path: of the file.
        robot: that walked.
        seconds: that it should have walked; samples are of 1 ms.

    Raises:
        InputError: one line naming the file and the entry that is missing, of another shape, or not
            of finite numbers; or it is not a log of 1 ms.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files if name != "card"}
    except Exception as error:  # whoever made the archive chose what goes wrong
        raise InputError(f"{path}: not a log (.npz): {one_line(error)}") from None
    wanted, joints, feet = round(seconds / TIME_STEP), len(robot.joint_lower), len(robot.foot_point)
    count = next(iter(arrays.get("joints", np.zeros(())).shape), 0)
    if not 1 <= count <= wanted:
        raise InputError(f"{path}: expected {wanted} samples of joints, got {count}")
    shapes = {
        "period": (),
        **{f"initial.{name}": (3,) for name in State._fields},
        **{f"state.{name}": (count, 3) for name in State._fields},
        **{f"command.{name}": (count, feet, 3) for name in Wrench._fields},
        "joints": (count, joints),
        "fallen": (count,),
        "residual": (count,),
    }
    none = {"fallen": np.zeros(count, bool), "residual": np.zeros(count)}
    arrays = {"period": np.array(TIME_STEP), **none, **arrays}
    for name, shape in shapes.items():
        if name not in arrays:
            raise InputError(f"{path}: {name} is missing; expected {', '.join(shapes)}")
        if (got := arrays[name].shape) != shape:
            raise InputError(f"{path}: {name} must have shape {shape}, got {got}")
        if arrays[name].dtype.kind not in "biuf" or not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}: {name} must hold finite numbers")
    if not np.isclose(arrays["period"], TIME_STEP, rtol=1e-6):
        raise InputError(f"{path}: samples must be of {TIME_STEP} s, got {arrays['period']}")
    rows = np.minimum(np.arange(wanted), count - 1)
    state = State(*(arrays[f"state.{name}"][rows].astype(float) for name in State._fields))
    command = Wrench(*(arrays[f"command.{name}"][rows].astype(float) for name in Wrench._fields))
    down = np.asarray(has_fallen(state, *robot.description.limits))
    fell = np.maximum.accumulate(down | arrays["fallen"][rows].astype(bool))
    return Log(
        State(*(arrays[f"initial.{name}"].astype(float) for name in State._fields)),
        state,
        arrays["joints"][rows].astype(float),
        command,
        fell | (np.arange(wanted) >= count),
        arrays["residual"][rows].astype(float),
    )


@partial(jax.jit, static_argnums=0)
def _references(tick: float, robot: Robot, command: Command, initial: State, ticks: Any) -> State:
    anchor = anchor_at(robot, initial, 0)
    return jax.vmap(lambda t: reference_at(tick, command, anchor, t))(ticks)


def bare(log: Log, period: float) -> Trajectory:
    """A trajectory of what a log holds, sampled every `period` [s]; all else is empty."""
    empty = no_samples(log.joints.shape[1], log.command.force.shape[1])
    return empty._replace(period=np.asarray(period), **log._asdict())


def read_loss(config: TuneConfig, robot: Robot, command: Command, log: Log) -> tuple[Seen, Log]:
    """What a log of 1 ms says of its command, and the log at the plan interval.

    Source: Eq. 11.
    """
    tick, count = config.rollout.walk.gait.tick, len(log.fallen)
    each = round(tick / TIME_STEP)
    ticks = (np.arange(count) + 1.0) / each
    reference = _references(tick, robot, command, log.initial, ticks)
    loss = float(loss_of(config.loss, bare(log, TIME_STEP)._replace(reference=reference)))
    least, most = robot.description.limits
    stood = ~log.fallen
    tilt = np.abs(log.state.euler[stood, :2]).max(initial=0.0) / most
    standing = float(robot.standing_height)
    sunk = (standing - log.state.position[stood, 2].min(initial=standing)) / (standing - least)
    bad = log.fallen.any() or not log.residual.max() <= SOLVED
    seen = Seen(np.inf, 1.0) if bad else Seen(loss, float(max(tilt, sunk)))
    thin = jax.tree.map(lambda x: x[each - 1 :: each], log._replace(initial=None))
    return seen, thin._replace(initial=log.initial)
