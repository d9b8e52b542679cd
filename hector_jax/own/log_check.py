"""Is it the weights? What the log of a walk shows that no weight can fix.

The log may be of any controller on any robot or simulator (`walk_file`). Each question has a line
with a figure where the answer is bad. Questions whose entries the log does not have are not asked.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import Command
from hector_jax.core.geometry import euler_rates, rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import SOLVED, State, Trajectory
from hector_jax.own.timing import STAMPS, Stamps, read_stamps, timing_faults
from hector_jax.own.walk_file import check_legs, leg_order, read_entries, read_walk, reference_of
from hector_jax.robot.model import Robot
from hector_jax.sim.diagnosis import FALLING, MOST_AT_LIMIT, STEADY, lasting, motors, steady_height
from hector_jax.sim.leg_check import BETTER, legs_found, samples_of, slope

SETTLED, SHORTEST = 0.5, 1.0  # [s] after t = 0; of a walk from then on
LOADED = 0.2  # share of the weight on a foot that stands
ASTRAY = 0.25  # share of samples whose planned contact is not that of the commanded load
MASS, COMMANDED_MASS = 0.05, 0.15  # share of the weight, by the ground and by the commands
LONGEST, LATE = 0.06, 0.015  # [s] delays of the ground's force that are tried; largest usual one
GAIN = 0.15  # of the ground's force by the commanded one, from 1
IN_AIR = 0.02  # share of the weight
UNLIKE = 0.3  # of a velocity, from the derivative of what it is the velocity of
UNITS = {"kN": 1000.0, "kgf": 9.81}  # [N]
FOLLOWS = 0.3  # of the robot's distance from the path, that is left to a reference that follows it


class CheckedLog(NamedTuple):
    """A log with its robot; rows of all arrays are the settled samples before a fall."""

    robot: Robot
    walk: Trajectory  # with the reference of the command
    own: State | None  # reference in the log
    torque: Float[np.ndarray, "n joints"] | None  # as a share of the limits
    stamps: Stamps  # of the samples, and of all plans
    commanded: bool  # the log has the commanded forces
    has_effect: bool
    # planned contact if it can be trusted, else the commanded load, else that of the ground
    stance: Bool[np.ndarray, "n feet"] | None
    # share of samples and feet whose planned contact is not that of the load; None without either
    astray: float | None
    units: dict[str, str]  # of `command` and `effect` where it is not N, in which `walk` has them

    @property
    def weight(self) -> float:
        """Of the robot's file [N]."""
        return float(self.robot.mass * self.robot.gravity[2])


def read_check(
    path: Path, robot: Robot, command: Command, seconds: float, tick: float
) -> tuple[CheckedLog, str]:
    """Read a log for `check_log`; return also how the walk ended, as `read_walk` does.

    Args:
        path: file of the log, which may have `torque` (T, joints) [N m] and stamps (`timing`) too,
            and may lack the commanded forces.
        robot, command: that walked, and what was asked of it.
        seconds: expected length.
        tick: that of the gait [s].

    Raises:
        InputError: see `read_walk`; or less than SHORTEST is left of the walk, its joints never
            move, or `torque` or stamps are not numbers of that shape.
    """
    whole, end = read_walk(path, robot, seconds, tick, commanded=False)
    check_legs(whole)
    names = "joints", "torque", "contact", "command.force", "effect.force", "reference.position"
    rest = read_entries(path, (*names, *STAMPS, "card", "by_name"))
    stamps = read_stamps(path, rest, len(rest["joints"]))
    torque, shape = rest.get("torque"), rest["joints"].shape
    if torque is not None and (torque.shape != shape or torque.dtype.kind not in "iuf"):
        text = f"torque must be numbers of shape {shape}"
        raise InputError(f"{path}: {text}, got {torque.dtype} of shape {torque.shape}")
    if torque is not None and not {"card", "by_name"} & rest.keys():
        legs = leg_order(robot, walk_config(robot).twin.joint_legs)
        torque = torque.reshape(len(torque), len(legs), -1)[:, legs].reshape(shape)
    period, count = float(whole.period), int(np.sum(~whole.fallen))
    rows = slice(round(SETTLED / period), count - round(FALLING / period) * bool(end))
    if rows.stop - rows.start < SHORTEST / period:
        ended = end or f"lasts {count * period:.2f} s"
        needed = SETTLED + SHORTEST + FALLING * bool(end)
        raise InputError(f"{path}: {ended}: too early to tell anything, it takes {needed:g} s")
    reference = jax.tree.map(np.asarray, reference_of(tick, robot, command, whole))
    cut = partial(jax.tree.map, lambda x: np.asarray(x)[rows])
    own = cut(whole.reference) if "reference.position" in rest else None
    walk = cut(whole._replace(period=None, initial=None, reference=reference))
    walk = walk._replace(period=whole.period, initial=whole.initial)
    share = None if torque is None else torque[rows] / np.asarray(robot.torque_limit)
    weight, units = float(robot.mass * robot.gravity[2]), {}
    for name in ("command", "effect"):
        wrench = getattr(walk, name)
        carried = wrench.force[..., 2].sum(axis=1).mean() / weight
        for unit, newtons in UNITS.items():
            if abs(carried * newtons - 1.0) < UNLIKE:
                units[name] = unit
                walk = walk._replace(**{name: wrench._replace(force=newtons * wrench.force)})
    commanded, has_effect = ("command.force" in rest), ("effect.force" in rest)
    force = (walk.command if commanded else walk.effect).force[..., 2]
    loaded = force > LOADED * weight if commanded or has_effect else None
    contact = walk.contact if "contact" in rest else None
    astray = None if contact is None or loaded is None else float(np.mean(contact != loaded))
    stance = loaded if contact is None or (astray or 0.0) > ASTRAY else contact
    stamps = stamps._replace(time=None if stamps.time is None else stamps.time[rows])
    log = CheckedLog(robot, walk, own, share, stamps, commanded, has_effect, stance, astray, units)
    return log, end


def check_log(log: CheckedLog, tick: float) -> list[str]:
    """Return a line for each fault that no weight can fix, what to look at first in front.

    Args:
        log: of `read_check`.
        tick: interval of the plans [s].
    """
    if (force := log.walk.command.force[..., 2].sum(axis=1).mean()) < 0.0:
        return [
            f"the commanded forces are {force:.0f} N upwards in the mean: expected are those of "
            "the ground on the robot, not those of the robot on the ground"
        ]
    questions = (
        _timing,
        _units,
        _contacts,
        _velocities,
        _legs,
        _loads,
        _ground,
        _air,
        _torques,
        _reference,
        _plans,
    )
    return [line for ask in questions for line in ask(log, tick)]


def unasked(log: CheckedLog) -> str:
    """Return what of a log without commanded forces is not judged; empty if it has them."""
    if log.commanded:
        return ""
    legs = "" if log.stance is not None else ", nor, as contact is absent too, joints and feet"
    return f"without command.force gain and delay of the ground and plans are not judged{legs}"


def _timing(log: CheckedLog, tick: float) -> Iterator[str]:
    """Did clock and plans run as they should?"""
    yield from timing_faults(log.stamps, log.walk, tick)


def _middle(x: Float[np.ndarray, "n ..."], period: float) -> Float[np.ndarray, "m ..."]:
    """Return the means over the spans of `slope`."""
    span, sums = samples_of(period), np.cumsum(x, axis=0)
    return (sums[span:] - sums[:-span]) / span


def _units(log: CheckedLog, tick: float) -> Iterator[str]:
    """Are forces in N?"""
    for name, unit in log.units.items():
        if name == "command" or log.has_effect:
            yield f"{name}.force bears the robot's weight if it is in {unit}: expected is N"


def _contacts(log: CheckedLog, tick: float) -> Iterator[str]:
    """Are forces commanded where feet are planned to stand?"""
    if log.astray is not None and log.astray > ASTRAY:
        yield (
            f"contact is not that of the feet with a {'commanded ' * log.commanded}load in "
            f"{100 * log.astray:.0f} % of the samples: its order of feet, or its meaning"
        )


def _velocities(log: CheckedLog, tick: float) -> Iterator[str]:
    """Is each velocity the derivative of what it is the velocity of, in the world?"""
    state, period = log.walk.state, float(log.walk.period)
    R = np.asarray(jax.vmap(rotation_from_euler)(state.euler))
    to_world = partial(np.einsum, "tij,tj->ti", R)
    E = np.asarray(jax.vmap(euler_rates)(state.euler))
    rates, body_rates = (
        np.einsum("tij,tj->ti", E, x) for x in (state.ang_velocity, to_world(state.ang_velocity))
    )
    for name, found, true, turned in (
        ("velocity", state.velocity, state.position, to_world(state.velocity)),
        ("ang_velocity", rates, state.euler, body_rates),
    ):
        rate = slope(true, period)

        def error(x: np.ndarray, rate: np.ndarray = rate) -> float:
            away = np.sqrt(np.mean((_middle(x, period) - rate) ** 2))
            return float(away / max(np.sqrt(np.mean(rate**2)), 0.05))

        if (as_is := error(found)) <= UNLIKE:
            continue
        guesses = {"it is in the frame of the trunk": error(turned)}
        unit, scale = ("mm/s", 1e-3) if name == "velocity" else ("degrees", np.pi / 180.0)
        guesses[f"it is in {unit}"] = error(scale * found)
        guesses["its sign is the other one"] = error(-found)
        if name == "ang_velocity":
            euler, back = state.euler[:, ::-1], state.ang_velocity[:, ::-1]
            E_back = np.asarray(jax.vmap(euler_rates)(euler))
            rates = np.einsum("tij,tj->ti", E_back, state.ang_velocity)
            guesses["the angles are yaw, pitch, roll"] = error(rates, slope(euler, period))
            guesses["its order is z, y, x"] = error(np.einsum("tij,tj->ti", E, back))
        guess = min(guesses, key=lambda words: guesses[words])
        cause = f": {guess}" if guesses[guess] < BETTER * as_is else ""
        yield f"{name} is {100 * as_is:.0f} % off the derivative of the pose{cause}"


def _legs(log: CheckedLog, tick: float) -> Iterator[str]:
    """Do feet that stand stay where the joints say that they are?"""
    if log.stance is not None:
        yield from legs_found(log.robot, log.walk, log.stance)


def _loads(log: CheckedLog, tick: float) -> Iterator[str]:
    """Is the mass that of the file, and does the robot stand at its height?"""
    force = (log.walk.effect if log.has_effect else log.walk.command).force[..., 2].sum(axis=1)
    share = float(np.mean(force)) / log.weight if log.has_effect or log.commanded else 1.0
    if abs(share - 1.0) > (MASS if log.has_effect else COMMANDED_MASS):
        bears = "the ground bears" if log.has_effect else "commanded are"
        yield (
            f"{bears} {share * log.weight:.0f} N in the mean, the robot's file weighs "
            f"{log.weight:.0f} N: its mass is {100 * abs(share - 1):.0f} % "
            f"{'more' if share > 1 else 'less'} than that of the file"
        )
    yield from steady_height(log.walk, np.ones(len(force), bool))


def _ground(log: CheckedLog, tick: float) -> Iterator[str]:
    """Does the ground return what was commanded, and when?"""
    if not log.has_effect or not np.diff(log.walk.command.force, axis=0).any():
        return
    period, command = float(log.walk.period), log.walk.command.force[..., 2]
    effect, fits = log.walk.effect.force[..., 2], {}
    for lag in range(round(LONGEST / period) + 1):
        x, y = command[: len(command) - lag].ravel(), effect[lag:].ravel()
        gain = float(x @ y / max(x @ x, 1e-9))
        fits[lag] = float(np.mean((y - gain * x) ** 2)), gain
    lag = min(fits, key=lambda n: fits[n][0])
    gain = fits[lag][1]
    if lag * period > LATE:
        yield (
            f"the ground's force comes {1e3 * lag * period:.0f} ms after the commanded one: "
            "motors, bus or filters are late"
        )
    if abs(gain - 1.0) > GAIN:
        yield f"the ground's force is {gain:.2f} times the commanded one: torques or their units"


def _air(log: CheckedLog, tick: float) -> Iterator[str]:
    """Are feet in the air free of commanded forces?"""
    if log.stance is None or log.astray is None or log.astray > ASTRAY:
        return
    force = np.linalg.norm(log.walk.command.force, axis=-1)[~log.stance]
    if len(force) and force.mean() > IN_AIR * log.weight:
        yield (
            f"feet in the air are commanded {force.mean():.0f} N in the mean: the plan's contacts "
            "are not those that are walked"
        )


def _torques(log: CheckedLog, tick: float) -> Iterator[str]:
    """Are motors at their limits?"""
    if log.torque is not None:
        rows = np.ones(len(log.torque), bool)
        yield from lasting(motors(log.robot, log.torque), rows, MOST_AT_LIMIT, "the time")


def _reference(log: CheckedLog, tick: float) -> Iterator[str]:
    """Does the controller know where it should be?"""
    if log.own is None:
        return
    state, path, own = (x.position[:, :2] for x in (log.walk.state, log.walk.reference, log.own))
    away, to_own = (float(np.sqrt(2.0 * np.mean((state - x) ** 2))) for x in (path, own))
    if away > STEADY and to_own < FOLLOWS * away:
        yield (
            f"the robot is {100 * away:.0f} cm off the commanded path, {100 * to_own:.0f} cm off "
            "its own reference, which follows it: weights change that by the speed alone"
        )


def _plans(log: CheckedLog, tick: float) -> Iterator[str]:
    """How often does it plan, and are plans solved?"""
    period, count = float(log.walk.period), len(log.walk.joints)
    force = log.walk.command.force.reshape(count, -1)
    changes = np.flatnonzero(np.any(np.diff(force, axis=0) != 0.0, axis=1))
    interval = period * float(np.median(np.diff(changes))) if len(changes) > 2 else 0.0
    if interval > 1.5 * tick:
        yield f"the command changes every {1e3 * interval:.0f} ms: plan more often than that"
    unsolved = float(np.mean(~(log.walk.residual <= SOLVED)))
    if unsolved:
        yield f"{100 * unsolved:.0f} % of the plans are not solved"
