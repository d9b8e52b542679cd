"""Find trunk, legs and knees of the robot in an MJCF or URDF without further information.

The model is examined with the trunk at the origin and all joints at zero. A leg is a chain of three
to seven hinges from the last common body of the two legs down to the last hinge. The legs are the
two such chains that mirror each other and end lowest; the left leg is the one whose first joint has
the larger y or, if both are equal, the one whose name says so. A second such pair that ends as low
makes the robot a quadruped. A hinge is a line: where on it the file has its anchor does not matter.
Joints about y swing a leg forwards: the knee is the one of these joints, except the first, that is
farthest from hip and sole. It bends to the side of its larger range, seen from the straight leg.
"""

import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import expect, require
from hector_jax.importing.elements import File, check_couplings
from hector_jax.importing.links import subtree
from hector_jax.robot.description import FEWEST_JOINTS, MOST_JOINTS
from hector_jax.robot.poses import data_at

_HINGE, _FREE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
_MIRROR_TOLERANCE = 0.03  # [m] between a joint and the mirror image of the other leg's
_HEIGHT_TOLERANCE = 0.25  # of a leg's height, between the ends of two pairs of legs
MIN_Y = 0.7  # of the axis of a joint that swings the leg forwards
_DIRECTIONS = ("roll", "pitch", "yaw")
_PLACES = {  # words for them in names
    "front": {"front", "fore", "fl", "fr", "lf", "rf"},
    "hind": {"hind", "rear", "back", *"hl hr lh rh rl rr lr bl br lb rb".split()},
    "left": {"left", "l", *"fl lf hl lh rl lr bl lb".split()},
    "right": {"right", "r", *"fr rf hr rh rr br rb".split()},
}


class Survey(NamedTuple):
    """The robot found in a file."""

    file: File
    trunk: int  # body
    legs: tuple[tuple[int, ...], ...]  # joints, in the order of `FEET`, from the trunk down
    weld: tuple[str, ...]  # joints outside the legs
    knee: int  # index in a leg, counted from 0
    straight: tuple[float, ...]  # [rad] of each leg's knee, where hip, knee and end are in line
    forwards: tuple[bool, ...]  # knees point ahead, for each pair of legs

    @property
    def model(self) -> mujoco.MjModel:
        """The file as MuJoCo compiles it."""
        return self.file.model


def survey_file(
    file: File, named: Sequence[Sequence[str]] = (), welded: Sequence[str] = ()
) -> Survey:
    """Find the robot in a file by the rules of the module's docstring.

    Args:
        file: with the robot.
        named: joints of each leg in the order of `FEET`, if they are known.
        welded: joints that are fixed, and of no leg.

    Raises:
        InputError: one line with the missing part and the remedy.
    """
    path, model, names = file.path, file.model, file.joints
    free = [j for j in range(model.njnt) if model.jnt_type[j] == _FREE]
    text = f"free joints {', '.join(names[j] for j in free)}, expected one at most, the trunk's"
    expect(path, len(free) < 2, text)
    data = data_at(model)
    for joint in (*sum(map(tuple, named), ()), *welded):
        require(path, "joint", joint, names)
    legs = tuple(tuple(names.index(joint) for joint in leg) for leg in named)
    legs = legs or _legs(path, data, [*free, *(names.index(joint) for joint in welded)])
    check_couplings(file, [names[j] for j in sum(legs, ())], welded)
    trunk = int(model.jnt_bodyid[free[0]] if free else model.body_rootid[_body(model, legs[0][0])])
    others = [j for j in range(model.njnt) if j not in sum(legs, (*free,))]
    knee = _knee(path, data, legs[0])
    knees = [_knee_bend(data, leg, knee) for leg in legs]
    return Survey(
        file=file,
        trunk=trunk,
        legs=legs,
        weld=tuple(names[j] for j in others),
        knee=knee,
        straight=tuple(straight for straight, _ in knees),
        forwards=tuple(ahead for _, ahead in knees[::2]),
    )


def places_of(names: Sequence[str]) -> set[str]:
    """Return which of front, hind, left and right the names of a leg's joints say.

    >>> sorted(places_of(["FL_hip", "FL_hip_r"])), places_of(["upright_knee"])
    (['front', 'left'], set())
    """
    said: set[str] = set()
    for name in names:
        parts = " ".join(re.findall("[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)).lower()
        words = {*re.findall("front|fore|hind|rear|back|left|right|[a-z]+", parts)}
        places = {place for place, own in _PLACES.items() if words & own}
        # an "r" may stand for roll, beside a word for the place
        said |= places - {"left", "right"} if {"left", "right"} <= places else places
    return said


def hip(data: mujoco.MjData, leg: Sequence[int]) -> int:
    """Return the first joint of a leg that swings it forwards; its first joint if none does."""
    return next((j for j in leg if abs(data.xaxis[j][1]) >= MIN_Y), leg[0])


def axis_words(axis: Float[np.ndarray, "3"]) -> str:
    """Return an axis in the trunk frame in words.

    >>> axis_words(np.array([0.0, -1.0, 0.0])), axis_words(np.array([0.0, 0.82, -0.57]))
    ('-y pitch', '+y pitch, turned by 35 deg')
    """
    main = int(np.argmax(np.abs(axis)))
    sign = "-" if axis[main] < 0.0 else "+"
    words = f"{sign}{'xyz'[main]} {_DIRECTIONS[main]}"
    tilt = np.degrees(np.arccos(min(abs(axis[main]), 1.0)))
    return words if tilt < 1.0 else f"{words}, turned by {tilt:.0f} deg"


def _body(model: mujoco.MjModel, joint: int) -> int:
    return int(model.jnt_bodyid[joint])


def _chains(model: mujoco.MjModel, left_out: Sequence[int]) -> list[tuple[int, ...]]:
    """Return the joints from the world down to each last joint, without those left out."""
    chains: dict[int, tuple[int, ...]] = {0: ()}  # by body
    inner: set[int] = set()
    for body in range(1, model.nbody):
        first = int(model.body_jntadr[body])
        own = tuple(first + i for i in range(model.body_jntnum[body]) if first + i not in left_out)
        chains[body] = chains[int(model.body_parentid[body])] + own
        if own:
            inner |= set(chains[body][:-1])
    return sorted({chain for chain in chains.values() if chain and chain[-1] not in inner})


def _legs(path: Path, data: mujoco.MjData, left_out: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Return the joints of the legs, pair by pair from the front, the left leg first."""
    model = data.model
    chains, pairs, apart = _chains(model, left_out), [], []
    for first, second in combinations(chains, 2):
        common = sum(i == j for i, j in zip(first, second, strict=False))
        a, b = first[common:], second[common:]
        hinges = all(model.jnt_type[j] == _HINGE for j in (*a, *b))
        if hinges and len(a) == len(b) and FEWEST_JOINTS <= len(a) <= MOST_JOINTS:
            offset = _offsets(data, a, b)
            lowest = min(data.xipos[subtree(model, _body(model, a[-1])), 2])
            if offset.max() <= _MIRROR_TOLERANCE:
                pairs.append((round(lowest, 3), -len(a), a, b))  # to the millimetre
            turned = _offsets(data, a, b, ahead=1).max() <= _MIRROR_TOLERANCE
            worst = int(np.argmax(offset))
            names = tuple(model.joint(leg[worst]).name for leg in (a, b))
            apart.append((not turned, offset[worst], names))
    ends = ", ".join(f"{model.joint(chain[-1]).name} ({len(chain)})" for chain in chains)
    text = f"no two legs found, expected two chains of {FEWEST_JOINTS} to {MOST_JOINTS} hinges "
    text += f"that mirror each other; chains by their last joint: {ends or 'none'}"
    many = any(len(chain) > MOST_JOINTS for chain in chains)
    text += "; joints that no motor turns can be fixed: hector robot --weld NAME" * many
    odd = np.flatnonzero((model.jnt_type != _HINGE) & (model.jnt_type != _FREE))
    text += f"; no hinges: {', '.join(model.joint(j).name for j in odd)}" * bool(len(odd))
    if apart:
        not_turned, offset, (one, other) = min(apart, key=lambda pair: pair[:2])
        text += f"; the lines of {one} and {other} are {100 * offset:.1f} cm from mirrored"
        if not not_turned:
            text = "the legs mirror each other in x, so the robot looks along y, expected along x: "
            text += "put its trunk into a body of its own, which has the free joint, turned in it "
            text += "by -90 degrees about z (by 90 if it looks along -y)"
    expect(path, pairs, text)
    low, _, lowest_leg, _ = min(pairs)
    tolerance, legs = _HEIGHT_TOLERANCE * (data.xanchor[hip(data, lowest_leg)][2] - low), []
    for lowest, _, *pair in sorted(pairs):
        if lowest - low <= tolerance and not set(sum(pair, ())) & set(sum(sum(legs, []), ())):
            legs.append(pair)
    counts = [len(left) for left, _ in legs]
    ends = ", ".join(model.joint(leg[-1]).name for pair in legs for leg in pair)
    text = f"{len(legs)} pairs of chains of {counts} hinges end as low as legs: {ends}; expected "
    text += "one pair, or two of as many hinges"
    expect(path, len(legs) <= 2 and len(set(counts)) == 1, text)
    legs.sort(key=lambda pair: -data.xanchor[hip(data, pair[0])][0])
    for pair in legs:
        if _is_right(data, pair):
            pair.reverse()
    return tuple(sum(legs, []))


def _offsets(
    data: mujoco.MjData, leg: Sequence[int], other: Sequence[int], ahead: int = 0
) -> Float[np.ndarray, " j"]:
    """Return how far each line of a leg is from the mirror image of the other leg's [m]."""
    mirror = np.where(np.arange(3) == 1 - ahead, -1.0, 1.0)
    offset = data.xanchor[list(leg)] - data.xanchor[list(other)] * mirror
    axes = data.xaxis[list(leg)]
    along = np.einsum("ji,ji->j", offset, axes)
    return np.linalg.norm(offset - along[:, None] * axes, axis=1)


def _is_right(data: mujoco.MjData, pair: Sequence[Sequence[int]]) -> bool:
    """Return whether the first leg of a pair is the right one."""
    of_leg, of_other = (data.subtree_com[_body(data.model, leg[0])] for leg in pair)
    y = of_leg[1] - of_other[1]
    if abs(y) > 1e-3:
        return bool(y < 0.0)
    return "right" in places_of([data.model.joint(pair[0][0]).name])


def _knee(path: Path, data: mujoco.MjData, leg: Sequence[int]) -> int:
    """Return the index of the knee in a leg."""
    axes, anchors = data.xaxis[list(leg)], data.xanchor[list(leg)]
    pitch = np.flatnonzero(np.abs(axes[:, 1]) >= MIN_Y).tolist()
    words = ", ".join(f"{data.model.joint(j).name} {axis_words(data.xaxis[j])}" for j in leg)
    text = f"{len(pitch)} joints of the left leg turn about y, expected hip and knee at least: "
    text += f"turn the model so that x is ahead; joints: {words}"
    expect(path, len(pitch) >= 2, text)
    ends = anchors[pitch[0]], data.xipos[_body(data.model, leg[-1])]

    def distance(i: int) -> float:
        return float(min(np.linalg.norm((anchors[i] - end)[::2]) for end in ends))

    return max(pitch[1:], key=distance)


def _knee_bend(data: mujoco.MjData, leg: Sequence[int], knee: int) -> tuple[float, bool]:
    """Return the straight knee's angle [rad] and whether a bent one points ahead.

    Hip, knee and ankle, or the end of a leg without one, are in line when the leg is straight.
    """
    joint = leg[knee]
    ankle = [j for j in leg[knee + 1 :] if abs(data.xaxis[j][1]) >= MIN_Y]
    lowest = min(data.xipos[subtree(data.model, _body(data.model, leg[-1]))], key=lambda p: p[2])
    anchor, end = data.xanchor[joint], data.xanchor[ankle[0]] if ankle else lowest
    (x, z), (u, w) = (anchor - data.xanchor[hip(data, leg)])[::2], (end - anchor)[::2]
    sign = float(np.sign(data.xaxis[joint][1]))
    straight = sign * float(np.arctan2(x * w - z * u, x * u + z * w))
    return straight, bool(sign * (data.model.jnt_range[joint].sum() - 2.0 * straight) > 1e-6)
