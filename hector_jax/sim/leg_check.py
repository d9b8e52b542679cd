"""Do feet that stand stay where the joints of a log say that they are?

Kinematics alone answers, foot by foot: points of a sole that stands neither move nor leave the
floor. Where they do, changes of the log are tried, and one that makes the feet stand is told.
"""

from collections.abc import Iterator
from itertools import combinations, permutations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.core.arrays import Array
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.trajectory import Trajectory
from hector_jax.robot.kinematics import foot_poses
from hector_jax.robot.model import Robot
from hector_jax.sim.diagnosis import STEADY

SLIDING, BETTER = 0.25, 0.5  # [m/s] of a foot that stands; share of an error that names a cause
# [m/s] least error for which causes are tried. Of walks of the examples it is 0.01 to 0.05.
UNSTEADY = 0.03
VERTICAL, CLIMB = 10.0, 0.1  # weight of vertical speeds; [s] that make a height a speed
STILL, MOVES = 0.5, 0.005  # [s] without any motion of a joint; [rad] of its likes in that time
LATEST, SHIFT = 0.06, 0.005  # [s] between joints and state: the largest that is tried, and a step


class Stand(NamedTuple):
    """How feet stand; zero for one that never does."""

    slide: Float[np.ndarray, " feet"]  # [m/s] of the foot point, median: a landing foot slips
    height: Float[np.ndarray, " feet"]  # [m] of the foot point, mean
    error: Float[np.ndarray, " feet"]  # [m/s]: usual speed of the sole's points, and their height


class LogChange(NamedTuple):
    """A change of the log; `{}` in its words is for the joints of the feet that it fixes."""

    words: str
    feet: Bool[np.ndarray, " feet"]  # that it changes
    stand: Stand
    joints: tuple[int, ...] = ()  # of a leg that are changed, in each leg for itself; or none


def slope(x: Float[np.ndarray, "n ..."], period: float) -> Float[np.ndarray, "m ..."]:
    """Return derivatives, in the middle of each span of `samples_of`."""
    span = samples_of(period)
    return (x[span:] - x[:-span]) / (span * period)


def samples_of(period: float) -> int:
    """Return the number of samples in about 20 ms."""
    return max(round(0.02 / period), 2)


@jax.jit
def _soles(robot: Robot, joints: Float[Array, "n joints"]) -> Float[Array, "n feet points 3"]:
    """Return foot points and corners of the soles from the centre of mass, in trunk axes."""
    x, y = jnp.stack([robot.toe, -robot.heel]), jnp.stack([robot.half_width, -robot.half_width])
    corners = jnp.stack([jnp.repeat(x, 2), jnp.tile(y, 2), jnp.zeros(4)], axis=1)
    corners = jnp.concatenate([jnp.zeros((1, 3)), corners])

    def one(q: Array) -> Array:
        feet = foot_poses(robot, q)
        to_trunk = feet.rotation @ robot.sole
        return feet.position[:, None] + jnp.einsum("fij,pj->fpi", to_trunk, corners)

    return jax.vmap(one)(joints) - robot.com_offset


def _stand(
    soles: np.ndarray, R: np.ndarray, position: np.ndarray, stance: np.ndarray, period: float
) -> Stand:
    points = np.einsum("tij,tfpj->tfpi", R, soles) + position[:, None, None]
    span, found = samples_of(period), np.zeros((3, stance.shape[1]))
    windows = np.lib.stride_tricks.sliding_window_view(stance, 2 * span + 1, axis=0)
    standing = np.asarray(windows.all(axis=-1))
    velocity = slope(points, period)[span // 2 :][: len(standing)]
    for foot in np.flatnonzero(standing.any(axis=0)):
        v, height = velocity[standing[:, foot], foot], points[stance[:, foot], foot, :, 2]
        weighted = np.sqrt(np.sum((v * [1.0, 1.0, VERTICAL]) ** 2, axis=-1).mean(axis=-1))
        off = np.sqrt(np.mean(height.mean(axis=0) ** 2)) / CLIMB
        slide = np.median(np.linalg.norm(v[:, 0], axis=-1))
        found[:, foot] = slide, height[:, 0].mean(), np.hypot(np.median(weighted), off)
    return Stand(*found)


def _still(by_leg: Float[np.ndarray, "n feet j"], period: float) -> Bool[np.ndarray, "feet j"]:
    """Return which joints rest for half a second in which their likes move."""
    count = round(STILL / period)
    blocks = by_leg[: len(by_leg) // count * count].reshape(-1, count, *by_leg.shape[1:])
    moved = np.ptp(blocks, axis=1)
    return ((moved < 1e-9) & (moved.max(axis=1, keepdims=True) > MOVES)).any(axis=0)


class _Tried(NamedTuple):
    """A log whose joints, angles and order of feet can be changed."""

    robot: Robot
    walk: Trajectory
    stance: Bool[np.ndarray, "n feet"]
    by_leg: Float[np.ndarray, "n feet j"]
    R: Float[np.ndarray, "n 3 3"]

    def stand(self, by_leg: np.ndarray | None = None) -> Stand:
        """Return how the feet stand, with other joints if they are given."""
        by_leg = self.by_leg if by_leg is None else by_leg
        soles = np.asarray(_soles(self.robot, by_leg.reshape(len(self.R), -1)))
        return _stand(soles, self.R, self.walk.state.position, self.stance, float(self.walk.period))


def _in_a_leg(log: _Tried) -> Iterator[LogChange]:
    """Yield changes that each leg has for itself."""
    by_leg, every = log.by_leg, np.ones(log.by_leg.shape[1], bool)
    count = by_leg.shape[2]
    if np.abs(by_leg).max() > 2.0 * np.pi:
        joints = tuple(range(count))
        yield LogChange(
            "the joints {} are in degrees", every, log.stand(np.radians(by_leg)), joints
        )
        return
    for i in range(count):
        signs = np.where(np.arange(count) == i, -1.0, 1.0)
        words = "the sign of {} is the other one"
        yield LogChange(words, every, log.stand(by_leg * signs), (i,))
    for i, j in combinations(range(count), 2):
        order = np.arange(count)
        order[[i, j]] = j, i
        yield LogChange("{} are exchanged", every, log.stand(by_leg[:, :, order]), (i, j))
    words = "the joints {} are in the order from the foot up"
    yield LogChange(words, every, log.stand(by_leg[:, :, ::-1]), tuple(range(count)))


def _of_legs(log: _Tried) -> Iterator[LogChange]:
    """Yield other orders of the legs, and joints that two legs exchange."""
    legs, count = log.by_leg.shape[1:]
    names, joints = log.robot.description.legs, log.robot.description.joints
    foot = np.arange(legs)

    def by_source(columns: slice, *, forces: bool = False) -> np.ndarray:
        """Return what stands (3, foot, leg) if columns of a foot are in those of a leg."""
        table = np.zeros((3, legs, legs))
        for k in range(legs):
            by_leg, source = log.by_leg.copy(), (foot + k) % legs
            by_leg[:, :, columns] = log.by_leg[:, source, columns]
            stance = log.stance[:, source] if forces else log.stance
            table[:, foot, source] = log._replace(stance=stance).stand(by_leg)
        return table

    pairs = np.arange(legs).reshape(-1, 2)[:, ::-1].ravel()
    for forces, too in ((False, ""), (True, ", and so are their forces")):
        table = by_source(slice(None), forces=forces)
        for order in map(np.array, permutations(range(legs))):
            logged = ", ".join(names[i] for i in np.argsort(order))
            words = f"the legs are in the order {logged}"
            if (order == pairs).all():
                words = "left and right legs are exchanged"
            yield LogChange(words + too, order != foot, Stand(*table[:, foot, order]))
    for i in range(count):
        table = by_source(slice(i, i + 1))
        for a, b in combinations(range(legs), 2):
            order = np.where(foot == a, b, np.where(foot == b, a, foot))
            words = f"{joints[a * count + i]} and {joints[b * count + i]} are exchanged"
            yield LogChange(words, order != foot, Stand(*table[:, foot, order]))


def _of_time_and_angles(log: _Tried) -> Iterator[LogChange]:
    """Yield another order of the trunk's angles, and joints and states that are late."""
    state, period = log.walk.state, float(log.walk.period)
    every = np.ones(log.by_leg.shape[1], bool)
    R = np.asarray(jax.vmap(rotation_from_euler)(state.euler[:, ::-1]))
    yield LogChange("the angles are yaw, pitch, roll", every, log._replace(R=R).stand())
    soles = np.asarray(_soles(log.robot, log.by_leg.reshape(len(log.R), -1)))
    step = max(round(SHIFT / period), 1)
    for n in range(step, round(LATEST / period) + 1, step):
        early, late = slice(None, -n), slice(n, None)
        for words, at, of in (
            (f"joints are {1e3 * n * period:.0f} ms behind the state", late, early),
            (f"the state is {1e3 * n * period:.0f} ms behind the joints", early, late),
        ):
            # the plan's contacts are those of what is in time
            stand = _stand(soles[at], log.R[of], state.position[of], log.stance[:-n], period)
            yield LogChange(words, every, stand)


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _repaired(guess: LogChange, as_is: Stand, known: np.ndarray) -> np.ndarray:
    """Return the feet that a guess fixes; none if it is not much better."""
    feet = guess.feet & known
    if guess.joints:
        feet = feet & (guess.stand.error < BETTER * as_is.error)
    if not feet.any() or _rms(guess.stand.error[feet]) > BETTER * _rms(as_is.error[feet]):
        return np.zeros_like(feet)
    return feet & (_rms(guess.stand.slide[feet]) < 1.1 * _rms(as_is.slide[feet]))


def _told(guess: LogChange, robot: Robot, feet: np.ndarray) -> str:
    """Return the words of a guess for the feet that it fixes."""
    names, count = robot.description.joints, robot.description.leg_joints
    legs = [0] if feet.all() else np.flatnonzero(feet)
    if len(guess.joints) == count and count > 2:
        which = "" if feet.all() else f"of {', '.join(robot.description.legs[i] for i in legs)}"
    else:
        each = [" and ".join(names[i * count + j] for j in guess.joints) for i in legs]
        which = ", ".join(each) + " and its likes" * bool(feet.all())
    return " ".join(guess.words.format(which).split())


def soles_held(robot: Robot, walk: Trajectory) -> str:
    """Return one line that says whether the soles of the robot's file hold: slide, and height.

    Args:
        robot: that walked, with its plan.
        walk: of a world with a plant (numpy).
    """
    walk = jax.tree.map(lambda x: np.asarray(x), walk._replace(belief=None))
    good = ~walk.fallen
    stance = (walk.contact & (walk.effect.force[..., 2] > 0.0))[good]
    if not stance.any():
        return "soles: no foot stood"
    R = np.asarray(jax.vmap(rotation_from_euler)(walk.state.euler[good]))
    soles = np.asarray(_soles(robot, walk.joints[good]))
    found = _stand(soles, R, walk.state.position[good], stance, float(walk.period))
    slide, off = found.slide.max(), 100.0 * np.abs(found.height).max()
    text = (
        f"soles: feet that stand slide at {slide:.2f} m/s, foot points {off:.1f} cm off the floor"
    )
    held = slide <= SLIDING and off <= 100.0 * STEADY
    return text + ("" if held else ": they do not hold, measure feet in the robot's file")


def legs_found(robot: Robot, walk: Trajectory, stance: Bool[np.ndarray, "n feet"]) -> Iterator[str]:
    """Yield a line for each fault of joints, feet or angles; foot and joint are named.

    Args:
        robot: that walked.
        walk: the settled samples of a log (numpy).
        stance: feet that stand.
    """
    legs, period = robot.description.legs, float(walk.period)
    by_leg = walk.joints.reshape(*stance.shape, -1)
    joints = np.array(robot.description.joints).reshape(by_leg.shape[1:])
    still = _still(by_leg, period)
    for leg, names, rests in zip(legs, joints, still, strict=True):
        if rests.any():
            which = f"the joints of the {leg} leg" if rests.all() else ", ".join(names[rests])
            does = "does" if rests.sum() == 1 else "do"
            yield f"{which} {does} not move while the likes in other legs do: encoders, or the log"
    R = np.asarray(jax.vmap(rotation_from_euler)(walk.state.euler))
    log = _Tried(robot, walk, stance, by_leg, R)
    as_is, known = log.stand(), np.asarray(~still.any(axis=1))

    def where(feet: np.ndarray) -> str:
        named = "" if feet.all() else f" ({', '.join(x for x in np.array(legs)[feet])})"
        return f"by the joints, feet that stand{named}"

    guesses: list[LogChange] = []
    if (as_is.error[known] > UNSTEADY).any():
        guesses = [x for ask in (_in_a_leg, _of_legs, _of_time_and_angles) for x in ask(log)]
    while (as_is.error[known] > UNSTEADY).any():
        fixes = [_repaired(guess, as_is, known) for guess in guesses]
        costs = [
            _rms(np.where(feet, guess.stand.error, as_is.error)[known]) if feet.any() else np.inf
            for guess, feet in zip(guesses, fixes, strict=True)
        ]
        best = int(np.argmin(costs))
        if not np.isfinite(costs[best]):
            break
        feet = fixes[best]
        slide, off = as_is.slide[feet].max(), 100 * np.abs(as_is.height[feet]).max()
        yield (
            f"{where(feet)} slide at {slide:.2f} m/s, {off:.1f} cm off the floor: "
            f"{_told(guesses[best], robot, feet)}"
        )
        known = known & ~feet
    if (feet := known & (as_is.slide > SLIDING)).any():
        slide = as_is.slide[feet].max()
        yield f"{where(feet)} slide at {slide:.2f} m/s: they slip, or joints are wrong in the log"
    known = known & ~feet
    for side, sign in (("above", 1.0), ("below", -1.0)):
        if (feet := known & (sign * as_is.height > STEADY)).any():
            off = 100 * np.abs(as_is.height[feet]).mean()
            yield (
                f"{where(feet)} are {off:.1f} cm {side} the floor: foot point, leg length or "
                "height of the centre of mass in the robot's file"
            )
