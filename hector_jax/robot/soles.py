"""Where the feet of a surveyed robot touch the floor.

Of the primitive geoms of a foot that collide with the floor, those points count that lie within
5 mm of the lowest one when all joints are zero. Where the lowest box of a foot is tilted then, its
lower face is the sole, else what is level. A sole that is wider than 2 cm at its front and at
its back, under a leg of six joints or more, is flat: four corners. One that is longer than 2 cm is
a line from heel to toe, any other a point. Both feet of a pair get the same lengths.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import FEET
from hector_jax.robot.links import at_zero, subtree
from hector_jax.robot.rebuild import SHAPES
from hector_jax.robot.survey import Survey

_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX = SHAPES
_SAME_SOLE = 5e-3  # [m] above the lowest point
_WIDE = 0.02  # [m]
_ALIKE, _ALIKE_GUESSES = 0.01, 0.03  # [m] between the feet
_LEVEL, _UPRIGHT = np.cos(np.radians((0.5, 45.0)))  # tilts of a box that count
_FLAT_FROM = 6  # joints of a leg that can keep a flat sole level
_DOWN = np.array([0.0, 0.0, -1.0])
_RIM = 16  # points on a cylinder's edge


class Sole(NamedTuple):
    """One foot."""

    section: dict[str, Any]  # of the TOML
    contacts: Float[np.ndarray, "c 3"]  # in the axes of the sole, from the last joint [m]
    point: Float[np.ndarray, "3"]  # where wrenches act, likewise
    axes: Float[np.ndarray, "3 3"]  # of the sole in the trunk's, all joints at zero
    guessed: bool  # from the foot's inertia: the file has no geoms


def find_soles(survey: Survey, angles: Mapping[str, float] | None = None) -> tuple[Sole, ...]:
    """All feet of a robot.

    Args:
        survey: the robot.
        angles: pose [rad] by joint in which they are looked at; the others are zero, as is what a
            `Sole` says beside its section.

    Raises:
        InputError: one line: the feet differ.
    """
    model = survey.model
    pose = {int(model.joint(name).qposadr[0]): angle for name, angle in (angles or {}).items()}
    data = at_zero(model, pose)
    axes = [_axes(survey, data, leg) for leg in survey.legs]
    touch = [_floor_points(survey, data, leg, R) for leg, R in zip(survey.legs, axes, strict=True)]
    guessed = any(len(points) == 0 for points in touch)
    if guessed:
        touch = [_box_of_inertia(survey, data, leg) for leg in survey.legs]
    elif named := _named(survey, data):
        return named
    outlines = [_outline(points, len(survey.legs[0])) for points in touch]
    near, soles = _ALIKE_GUESSES if guessed else _ALIKE, []
    names = FEET[len(survey.legs)]
    for first in range(0, len(outlines), 2):
        left, right = outlines[first], _mirrored(outlines[first + 1])
        if len(left) != len(right) or np.abs(left - right).max() > near:
            raise InputError(
                f"{survey.path}: the {names[first]} foot touches at {np.round(left, 4).tolist()} "
                f"from its last joint and the mirrored {names[first + 1]} one at "
                f"{np.round(right, 4).tolist()}, expected the same"
            )
        mean = np.round(0.5 * (left + right), 4)
        for leg, contacts in ((first, mean), (first + 1, _mirrored(mean))):
            soles.append(_placed(survey, data, leg, contacts, axes[leg], guessed))
    return tuple(soles)


def _mirrored(contacts: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "c 3"]:
    """The other foot's, in the order of this one's."""
    order = [1, 0, 3, 2] if len(contacts) == 4 else list(range(len(contacts)))
    return contacts[order] * [1.0, -1.0, 1.0]


def _foot_geoms(survey: Survey, leg: Sequence[int]) -> list[int]:
    """Primitives of a foot that collide, with the floor where there is one."""
    model = survey.model
    bodies = subtree(model, int(model.jnt_bodyid[leg[-1]]))
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    collide = (contype | conaffinity) > 0
    chosen = collide & np.isin(model.geom_bodyid, bodies) & np.isin(model.geom_type, SHAPES)
    floor = collide & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if floor.any():
        own, theirs = (np.bitwise_or.reduce(bits[floor]) for bits in (contype, conaffinity))
        chosen &= ((contype & theirs) | (conaffinity & own)) > 0
    return np.flatnonzero(chosen).tolist()


def _axes(survey: Survey, data: mujoco.MjData, leg: Sequence[int]) -> Float[np.ndarray, "3 3"]:
    """Axes of the sole in those of the trunk, as columns."""
    boxes = [g for g in _foot_geoms(survey, leg) if survey.model.geom_type[g] == _BOX]
    if not boxes:
        return np.eye(3)
    R = data.geom_xmat[min(boxes, key=lambda g: data.geom_xpos[g][2])].reshape(3, 3)
    face = int(np.argmax(np.abs(R[2])))
    up = R[:, face] * np.sign(R[2, face])
    if not _UPRIGHT < up[2] < _LEVEL:
        return np.eye(3)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    return np.column_stack([ahead, np.cross(up, ahead), up])


def _floor_points(
    survey: Survey, data: mujoco.MjData, leg: Sequence[int], axes: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Points of the sole in its axes, from the last joint."""
    geoms = _foot_geoms(survey, leg)
    if not geoms:
        return np.zeros((0, 3))
    down = -axes[:, 2]
    points = np.concatenate([_support(survey.model, data, g, down) for g in geoms])
    points = (points - data.xanchor[leg[-1]]) @ axes
    return points[points[:, 2] <= points[:, 2].min() + _SAME_SOLE]


def _support(
    model: mujoco.MjModel, data: mujoco.MjData, g: int, down: Float[np.ndarray, "3"] = _DOWN
) -> Float[np.ndarray, "n 3"]:
    """Extreme points of a geom; for what is round the lowest ones."""
    shape, size = int(model.geom_type[g]), model.geom_size[g]
    center, R = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3)
    if shape == _BOX:
        signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
        return center + (signs * size) @ R.T
    if shape == _ELLIPSOID:
        local = R.T @ down
        return (center + R @ (size**2 * local / np.linalg.norm(size * local)))[None]
    if shape == _SPHERE:
        return (center + size[0] * down)[None]
    ends = center + np.outer([-size[1], size[1]], R[:, 2])
    if shape == _CAPSULE:
        return ends + size[0] * down
    angles = np.arange(_RIM) * 2.0 * np.pi / _RIM
    rim = size[0] * (np.outer(np.cos(angles), R[:, 0]) + np.outer(np.sin(angles), R[:, 1]))
    across = down - R[:, 2] * (R[:, 2] @ down)
    steep = np.linalg.norm(across)
    if steep > 1e-6:
        rim = np.concatenate([rim, size[0] * across[None] / steep])
    return (ends[:, None] + rim).reshape(-1, 3)


def _outline(points: Float[np.ndarray, "n 3"], joints: int) -> Float[np.ndarray, "c 3"]:
    """Corners front left, front right, back left, back right; or toe and heel; or a point."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    z = points[:, 2].min()
    front, back = (points[side] for side in (points[:, 0] >= middle[0], points[:, 0] <= middle[0]))
    width = min(np.ptp(front[:, 1]), np.ptp(back[:, 1]))
    if high[0] - low[0] <= _WIDE:
        return np.array([[middle[0], middle[1], z]])
    if width <= _WIDE or joints < _FLAT_FROM:
        return np.array([[high[0], middle[1], z], [low[0], middle[1], z]])
    ends = (high[0], front[:, 1]), (low[0], back[:, 1])
    return np.array([[x, y, z] for x, across in ends for y in (across.max(), across.min())])


def _box_of_inertia(
    survey: Survey, data: mujoco.MjData, leg: Sequence[int]
) -> Float[np.ndarray, "4 3"]:
    """Lower corners of the box that has the mass and inertia of the foot's last body."""
    model, body = survey.model, int(survey.model.jnt_bodyid[leg[-1]])
    mass, spread = model.body_mass[body], model.body_inertia[body]
    square = 1.5 * (spread.sum() - 2.0 * spread) / max(mass, 1e-9)
    size = np.sqrt(np.maximum(square, 1e-6))
    R = data.ximat[body].reshape(3, 3)
    half = np.abs(R) @ size
    center = data.xipos[body] - data.xanchor[leg[-1]]
    signs = np.array([[a, b, -1.0] for a in (-1, 1) for b in (-1, 1)])
    return center + signs * half


def _placed(
    survey: Survey,
    data: mujoco.MjData,
    side: int,
    contacts: Float[np.ndarray, "c 3"],
    axes: Float[np.ndarray, "3 3"],
    guessed: bool,
) -> Sole:
    """A foot by places in the frame of the body that its last joint moves."""
    model, last = survey.model, survey.legs[side][-1]
    body = int(model.jnt_bodyid[last])
    R, origin = data.xmat[body].reshape(3, 3), data.xpos[body] - data.xanchor[last]
    places = (contacts @ axes.T - origin) @ R
    ahead, middle = contacts[:, 0], 0.5 * (contacts.min(axis=0) + contacts.max(axis=0))
    section: dict[str, Any] = {"body": model.body(body).name}
    aligned = np.allclose(np.abs(axes.T @ R).max(axis=0), 1.0, rtol=0.0, atol=1e-9)
    aligned = aligned and np.abs(origin - np.round(origin, 4)).max() <= 1e-9
    digits = 4 if aligned or len(contacts) == 1 else 8  # a point has nothing to be level with
    section["contacts"] = [_numbers(place, digits) for place in places]
    point = np.array([0.0, middle[1], middle[2]])
    if not ahead.min() < -1e-3 < 1e-3 < ahead.max():  # the last joint is not above the sole
        point = middle
        if len(contacts) > 1:
            section["point"] = _numbers((axes @ point - origin) @ R, digits)
    return Sole(section, contacts, point, axes, guessed)


def _numbers(place: Float[np.ndarray, "3"], digits: int) -> list[float]:
    return [round(float(x), digits) + 0.0 for x in place]


def _named(survey: Survey, data: mujoco.MjData) -> tuple[Sole, ...] | None:
    """Feet of two named spheres and a named site each, as HECTOR's."""
    model, soles = survey.model, []
    for leg in survey.legs:
        geoms, body = _foot_geoms(survey, leg), int(model.jnt_bodyid[leg[-1]])
        sites = [s for s in range(model.nsite) if int(model.site_bodyid[s]) == body]
        right = len(geoms) == 2 and len(sites) == 1 and model.site(sites[0]).name
        if not right or any(
            model.geom_type[g] != _SPHERE
            or not model.geom(g).name
            or int(model.geom_bodyid[g]) != body
            for g in geoms
        ):
            return None
        anchor = data.xanchor[leg[-1]]
        heel, toe = sorted(geoms, key=lambda g: data.geom_xpos[g][0])
        contacts = np.concatenate([_support(model, data, g) for g in (toe, heel)]) - anchor
        point = data.site_xpos[sites[0]] - anchor
        if np.abs(contacts[:, 2] - point[2]).max() > 1e-3:
            return None
        names = {"point": model.site(sites[0]).name}
        names |= {"toe": model.geom(toe).name, "heel": model.geom(heel).name}
        soles.append(Sole(names, contacts, point, np.eye(3), guessed=False))
    return tuple(soles)
