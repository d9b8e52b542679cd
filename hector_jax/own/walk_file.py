"""Read a walk from a file that any controller and simulator can write.

An .npz with entries named like those of a `Trajectory`, such as `state.euler` (T, 3). Needed are
`initial`, `state`, `command` and `joints`; of the others `period` is 1 ms by default, `effect` the
command, and all else zero: no fall, solved plans. Logs of other conventions are read as the section
[twin] of the robot's file tells (`control.twin`), but not those that this project has written.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import Command, anchor_at, reference_at
from hector_jax.control.twin import TwinConfig
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.trajectory import State, Trajectory, Wrench, has_fallen, no_samples
from hector_jax.core.tree_file import named_leaves
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot

_NEEDED = ("initial.", "state.", "command.", "joints")
_LEANS = 0.05  # share of a walk with a large roll that is no fall
UPRIGHT = 0.9  # share of the standing height above which no robot lies or falls
YPR = '[twin] angles = "ypr"'
FLAGS = ("contact", "fallen", "legs_touch")
"""Entries of zeros and ones."""


def read_walk(
    path: Path,
    robot: Robot,
    seconds: float,
    tick: float,
    *,
    commanded: bool = True,
    twin: TwinConfig | None = None,
) -> tuple[Trajectory, str]:
    """Read a walk. One that ends early, or whose state is no number from some time on, fell then.

    Args:
        path: the file.
        robot: the robot that walked.
        seconds: expected length.
        tick: that of the gait [s], a whole number of periods.
        commanded: refuse a file without `command`, which is zero else.
        twin: conventions of the log; None: those of the robot's file.

    Returns:
        The walk (numpy), with the reference of the file, if any; from its end on, samples repeat
        the last one and are marked `fallen`. And how it ended, "fell after 1.20 s", or nothing.

    Raises:
        InputError: one line naming the file and the entry that is missing, of another shape, or not
            of finite numbers; or its period is no part of a tick.
    """
    needed = _NEEDED if commanded else tuple(name for name in _NEEDED if name != "command.")
    twin = walk_config(robot).twin if twin is None else twin
    walk, valid, wanted = _entries(path, robot, seconds, tick, needed=needed, twin=twin)
    min_height, max_tilt = robot.description.limits
    _check_angles(path, robot, jax.tree.map(lambda x: x[:valid], walk.state))
    count, period, rows = len(walk.joints), float(walk.period), np.arange(wanted)
    cut = walk._replace(period=None, initial=None)
    samples = jax.tree.map(lambda x: x[np.minimum(rows, valid - 1)], cut)
    down = np.asarray(has_fallen(samples.state, min_height, max_tilt))
    fallen = np.maximum.accumulate(down | samples.fallen) | (rows >= valid)
    stood = int(np.argmax(fallen)) if fallen.any() else wanted
    end = "" if stood == wanted else f"fell after {period * stood:.2f} s"
    if end and stood == valid < count:
        end = f"its state is no number from {period * stood:.2f} s on, which counts as a fall"
    elif end and stood == count:
        end = f"its log has {count} of {wanted} samples of {period:g} s, which counts as a fall"
    yaw = np.unwrap(np.append(walk.initial.euler[2], samples.state.euler[:, 2]))[1:]
    euler = np.column_stack([samples.state.euler[:, :2], yaw])
    state = samples.state._replace(euler=euler)
    return samples._replace(
        period=walk.period, initial=walk.initial, state=state, fallen=fallen
    ), end


def _check_angles(path: Path, robot: Robot, state: State) -> None:
    """Raise InputError if the angles of an upright trunk are in another order, or in degrees."""
    min_height, max_tilt = robot.description.limits
    tilt = np.abs(state.euler[:, :2]).max(axis=1)
    tilt = np.where(state.position[:, 2] >= min_height, tilt, 0.0)  # of an upright trunk
    tall = state.position[:, 2] >= UPRIGHT * float(robot.standing_height)
    roll, pitch, yaw = np.abs(state.euler).max(axis=0, initial=0.0)
    leans = np.mean(np.abs(state.euler[:, 0]) > max_tilt)  # a fall passes it at the end
    if tall.all() and max(pitch, yaw) < max_tilt and leans > _LEANS:
        text = f"roll reaches {roll:.3g} at full height and yaw stays small"
        expected = f"expected roll, pitch, yaw: is it yaw, pitch, roll ({YPR})?"
        raise InputError(f"{path}: {text}, {expected}")
    if tilt.max(initial=0.0) > np.pi or (tilt[:1] > max_tilt).any():
        text = f"roll or pitch reaches {tilt.max():.3g} at full height"
        raise InputError(f"{path}: {text}, expected radians")


def read_entries(path: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return those of the named entries that a log has; others, of any kind, are not read.

    Raises:
        InputError: one line: the file is no archive, or an entry is broken or holds objects.
    """
    name = ""
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {}
            for name in [x for x in names if x in archive.files]:
                found[name] = archive[name]
            return found
    except Exception as error:  # a foreign archive can fail in any way
        text = f"{name} cannot be read" if name else "not a log (.npz)"
        raise InputError(f"{path}: {text}: {one_line(error)}") from None


def check_legs(walk: Trajectory) -> None:
    """Raise an InputError if no joint of a walk ever moves."""
    if not np.ptp(walk.joints, axis=0).any():
        text = "the log has no legs, as that of a rigid body (--world srbm)"
        raise InputError(f"its joints never move: {text}")


def _entries(
    path: Path,
    robot: Robot,
    seconds: float,
    tick: float,
    *,
    needed: tuple[str, ...],
    twin: TwinConfig,
) -> tuple[Trajectory, int, int]:
    """Return the entries of a file; see `read_walk`.

    Returns:
        The samples of the file, the number of those before the state is no number, and the number
        of samples that were expected.
    """
    empty = no_samples(len(robot.joint_lower), len(robot.foot_point))
    arrays = read_entries(path, (*named_leaves(empty), "card", "by_name"))
    ours = arrays.pop("card", None) is not None
    if arrays.pop("by_name", None) is not None:
        twin = by_name(twin)
    asked = "" if "period" in arrays else "; is period missing?"
    arrays = {"period": np.array(TIME_STEP)} | arrays
    if not _divides(period := arrays["period"], tick):
        text = f"must be {tick} s, the gait's tick, divided by a whole number"
        raise InputError(f"{path}: period {text}, got {period}")
    period = tick / round(tick / float(period))
    wanted = round(seconds / period)
    count = next(iter(arrays.get("joints", np.zeros(())).shape), 0)
    if not 1 <= count <= wanted:
        expected = f"{wanted} samples of joints in {seconds:g} s of {period:g} s"
        raise InputError(f"{path}: expected {expected}, got {count}{asked}")
    needed = _NEEDED if any(name.startswith("command.") for name in arrays) else needed
    walk = _checked(path, arrays, empty, count, needed)
    if not ours:
        walk = _converted(twin, robot, walk, measured="effect.force" in arrays)
    finite = np.all([np.isfinite(x).all(axis=1) for x in walk.state], axis=0)
    valid = count if finite.all() else int(np.argmin(finite))
    for name, x in named_leaves(walk).items():
        if not np.isfinite(x[: max(valid, 1)] if np.ndim(x) and len(x) == count else x).all():
            raise InputError(f"{path}: {name} must hold finite numbers")
    return walk._replace(period=np.asarray(period)), valid, wanted


def _divides(period: np.ndarray, tick: float) -> bool:
    if period.shape != () or period.dtype.kind not in "iuf" or not 0.0 < period <= 1.001 * tick:
        return False
    return abs(tick / float(period) - round(tick / float(period))) < 1e-3


def _checked(
    path: Path, arrays: dict[str, Any], empty: Trajectory, count: int, needed: tuple[str, ...]
) -> Trajectory:
    """Return the walk of the entries of a file, of which those that may be absent are filled in."""
    found = {}
    for name, like in named_leaves(empty).items():
        shape = tuple(x or count for x in np.shape(like))  # the empty walk has no samples
        default = found.get(name.replace("effect", "command"), np.zeros(shape))
        if name not in arrays and name.startswith(needed):
            names = ", ".join(n for n in named_leaves(empty) if n.startswith(needed))
            raise InputError(f"{path}: {name} is missing; expected {names}")
        found[name] = arrays.get(name, default)
        if (got := found[name].shape) != shape:
            raise InputError(f"{path}: {name} must have shape {shape}, got {got}")
        if found[name].dtype.kind not in "biuf":
            raise InputError(f"{path}: {name} must hold finite numbers")
        if name in FLAGS and not np.isin(found[name], (0, 1)).all():
            raise InputError(f"{path}: {name} must hold zeros and ones")
        found[name] = found[name].astype(bool if name in FLAGS else float)
    return jax.tree.unflatten(jax.tree.structure(empty), list(found.values()))


def by_name(twin: TwinConfig) -> TwinConfig:
    """Return the conventions of a log whose angles and joints have their names, as in a bag."""
    return replace(twin, angles=TwinConfig.angles, joint_legs=())


def leg_order(robot: Robot, names: tuple[str, ...]) -> list[int]:
    """Return where the legs of the robot are in an order of their names; empty: as they are.

    Raises:
        InputError: the names are not those of the robot's legs.
    """
    legs = robot.description.legs
    if names and sorted(names) != sorted(legs):
        text = f"[twin] legs and joint_legs must be {', '.join(legs)} in their order"
        raise InputError(f"{robot.description.path}: {text}, got {', '.join(names)}")
    return [names.index(leg) for leg in legs] if names else list(range(len(legs)))


def to_world(twin: TwinConfig, euler: np.ndarray, wrench: Wrench) -> Wrench:
    """Return wrenches (n, feet, 3) of the ground on the robot, world frame, by a twin's convention.

    Args:
        twin: what `wrenches` and their frame are.
        euler: (n, 3) when they were planned [rad].
        wrench: of a log, or by call.
    """
    sign = -1.0 if twin.wrenches == "on_ground" else 1.0
    if twin.wrench_frame == "world":
        return jax.tree.map(lambda x: sign * x, wrench)
    angles = euler if twin.wrench_frame == "trunk" else euler * [0.0, 0.0, 1.0]
    R = sign * np.asarray(jax.vmap(rotation_from_euler)(angles))
    return jax.tree.map(lambda x: np.einsum("nij,nfj->nfi", R, x), wrench)


def _converted(twin: TwinConfig, robot: Robot, walk: Trajectory, *, measured: bool) -> Trajectory:
    """Return the walk of a log of other conventions; `measured`: it has an `effect` of its own."""
    feet, legs = leg_order(robot, twin.legs), leg_order(robot, twin.joint_legs)
    walk = walk._replace(
        joints=walk.joints.reshape(len(walk.joints), len(legs), -1)[:, legs].reshape(
            walk.joints.shape
        ),
        contact=walk.contact[:, feet],
        **{
            name: jax.tree.map(lambda x: x[:, feet], getattr(walk, name))
            for name in ("command", "effect")
        },
    )
    if twin.angles == "ypr":
        initial, state, own = (
            x._replace(euler=x.euler[..., ::-1]) for x in (walk.initial, walk.state, walk.reference)
        )
        walk = walk._replace(initial=initial, state=state, reference=own)
    begins = np.concatenate([walk.initial.euler[None], walk.state.euler[:-1]])
    command = to_world(twin, np.nan_to_num(begins), walk.command)
    return walk._replace(command=command, effect=walk.effect if measured else command)


@partial(jax.jit, static_argnums=0)
def reference_of(tick: float, robot: Robot, command: Command, walk: Any) -> State:
    """Return the reference of a walk.

    Args:
        tick: that of the gait [s].
        robot, command: of the walk.
        walk: a `Trajectory`, or what else has `period`, `initial` and `fallen`.
    """
    ticks = (jnp.arange(len(walk.fallen)) + 1.0) / jnp.round(tick / walk.period)
    anchor = anchor_at(robot, walk.initial, 0)
    return jax.vmap(lambda t: reference_at(tick, command, anchor, t))(ticks)
