"""The robot in an MJCF or URDF of which nothing else is known: trunk, legs, knees.

All is read in the pose in which the trunk is at the origin and all joints are zero. A leg is a
chain of three to seven hinges from where the two legs part down to the last hinge. The legs are the
two such chains that mirror each other and end lowest; the left one is that whose first joint has
the larger y or, where both have the same, whose name says so. A second such pair that ends as low
makes it a robot with four legs. What turns about y swings a leg forwards: the knee is the one of
these joints, but the first, that is farthest from hip and sole. It bends to the side to which its
range is larger; where both are the same, to that to which it is bent at zero.
"""

import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.robot.description import FEWEST_JOINTS, MOST_JOINTS
from hector_jax.robot.elements import spec_of
from hector_jax.robot.links import at_zero, subtree
from hector_jax.robot.mjcf import read_mjcf
from hector_jax.robot.source import compile_bare

_HINGE, _FREE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
_MIRRORED = 0.03  # [m] between a joint and the mirror image of the other leg's
_AS_LOW = 0.25  # of a leg's height, between the ends of two pairs of legs
_BENDS = 0.7  # least share of y in the axis of a joint that swings the leg forwards
_DIRECTIONS = ("roll", "pitch", "yaw")


class Survey(NamedTuple):
    """What a file holds."""

    path: Path
    model: mujoco.MjModel  # without motors, keyframes and meshes
    trunk: int  # body
    legs: tuple[tuple[int, ...], ...]  # joints, in the order of `FEET`, from the trunk down
    weld: tuple[str, ...]  # joints of no leg
    knee: int  # of a leg, counted from 0
    forwards: tuple[bool, ...]  # whether the knees of each pair of legs point ahead


def survey_file(path: Path) -> Survey:
    """Find the robot in a file, see the module.

    Raises:
        InputError: one line saying what is missing and how to mend it.
    """
    path = Path(path)
    root = read_mjcf(path)
    spec, _ = spec_of(path, root, (), None)
    model = compile_bare(path, root, spec)
    free = [j for j in range(model.njnt) if model.jnt_type[j] == _FREE]
    if len(free) > 1:
        names = ", ".join(model.joint(j).name for j in free)
        raise InputError(f"{path}: free joints {names}, expected one at most, the trunk's")
    legs = _legs(path, model, free)
    trunk = int(model.jnt_bodyid[free[0]] if free else model.body_rootid[_body(model, legs[0][0])])
    data = at_zero(model)
    others = [j for j in range(model.njnt) if j not in sum(legs, (*free,))]
    if unnamed := [model.body(_body(model, j)).name for j in others if not model.joint(j).name]:
        raise InputError(
            f"{path}: a joint of body {unnamed[0]!r} has no name, expected one: it is to be welded"
        )
    knee = _knee(path, model, data, legs[0])
    return Survey(
        path=path,
        model=model,
        trunk=trunk,
        legs=legs,
        weld=tuple(model.joint(j).name for j in others),
        knee=knee,
        forwards=tuple(_bends_forwards(model, data, leg, knee) for leg in legs[::2]),
    )


def axis_words(axis: Float[np.ndarray, "3"]) -> str:
    """An axis in the trunk's frame in words.

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


def _chains(model: mujoco.MjModel, free: Sequence[int]) -> list[tuple[int, ...]]:
    """Joints on the way to each last joint, from the world down."""
    ways: dict[int, tuple[int, ...]] = {0: ()}
    inner: set[int] = set()
    for body in range(1, model.nbody):
        above = ways[int(model.body_parentid[body])]
        first = int(model.body_jntadr[body])
        own = tuple(first + i for i in range(model.body_jntnum[body]) if first + i not in free)
        ways[body] = above + own
        if own:
            inner |= set(ways[body][:-1])
    return sorted({way for way in ways.values() if way and way[-1] not in inner})


def _legs(path: Path, model: mujoco.MjModel, free: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """Joints of the legs, pair by pair from the front, the left one first."""
    data, pairs = at_zero(model), []
    for one, other in combinations(_chains(model, free), 2):
        common = sum(a == b for a, b in zip(one, other, strict=False))
        a, b = one[common:], other[common:]
        hinges = all(model.jnt_type[j] == _HINGE for j in (*a, *b))
        right_length = FEWEST_JOINTS <= len(a) <= MOST_JOINTS and len(a) == len(b)
        if hinges and right_length:
            apart = data.xanchor[list(a)] - data.xanchor[list(b)] * [1.0, -1.0, 1.0]
            below = subtree(model, _body(model, a[-1]))
            lowest = round(min(data.xipos[below, 2]), 3)  # [m], to the millimetre
            if np.abs(apart).max() <= _MIRRORED:
                pairs.append((lowest, -len(a), a, b))
    if not pairs:
        ends = (f"{model.joint(way[-1]).name} ({len(way)})" for way in _chains(model, free))
        raise InputError(
            f"{path}: no two legs found, expected two chains of {FEWEST_JOINTS} to {MOST_JOINTS} "
            "hinges that mirror each other; chains by their last joint: "
            f"{', '.join(ends) or 'none'}"
        )
    low, _, lowest_leg, _ = min(pairs)
    near, found = _AS_LOW * (data.xanchor[lowest_leg[0]][2] - low), []
    for lowest, _, *pair in sorted(pairs):
        new = not {*pair[0], *pair[1]} & set(sum((*sum(found, []),), ()))
        if new and lowest - low <= near:
            found.append(pair)
    counts = [len(pair[0]) for pair in found]
    if len(found) > 2 or len(set(counts)) > 1:
        ends = ", ".join(model.joint(leg[-1]).name for pair in found for leg in pair)
        raise InputError(
            f"{path}: {len(found)} pairs of chains of {counts} hinges end as low as legs: {ends}; "
            "expected one pair, or two of as many hinges"
        )
    found.sort(key=lambda pair: -data.xanchor[pair[0][0]][0])
    for pair in found:
        if _is_right(model, data, *pair):
            pair.reverse()
    return tuple(leg for pair in found for leg in pair)


def _is_right(
    model: mujoco.MjModel, data: mujoco.MjData, one: Sequence[int], other: Sequence[int]
) -> bool:
    """Whether the first of two legs is the right one."""
    y = data.xanchor[one[0]][1] - data.xanchor[other[0]][1]
    if abs(y) > 1e-3:
        return bool(y < 0.0)
    name = model.joint(one[0]).name.lower()
    return re.search(r"right|(^|_)r(_|$)", name) is not None


def _knee(path: Path, model: mujoco.MjModel, data: mujoco.MjData, leg: Sequence[int]) -> int:
    """Which joint of a leg is the knee."""
    axes, anchors = data.xaxis[list(leg)], data.xanchor[list(leg)]
    bend = [i for i in range(len(leg)) if abs(axes[i][1]) >= _BENDS]
    if len(bend) < 2:
        words = ", ".join(f"{model.joint(j).name} {axis_words(data.xaxis[j])}" for j in leg)
        raise InputError(
            f"{path}: {len(bend)} joints of the left leg turn about y, expected hip and knee at "
            f"least: turn the model so that x is ahead; joints: {words}"
        )
    end = data.xipos[_body(model, leg[-1])]
    hip = anchors[bend[0]]

    def apart(i: int) -> float:
        return float(min(np.linalg.norm(anchors[i] - place) for place in (hip, end)))

    return max(bend[1:], key=apart)


def _bends_forwards(
    model: mujoco.MjModel, data: mujoco.MjData, leg: Sequence[int], knee: int
) -> bool:
    """Whether a knee points ahead when it is bent."""
    joint = leg[knee]
    side = model.jnt_range[joint].sum() * np.sign(data.xaxis[joint][1])
    end = data.xipos[_body(model, leg[-1])]
    return bool(side > 0.0 if abs(side) > 1e-6 else end[0] < data.xanchor[joint][0])
