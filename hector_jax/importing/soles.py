"""Find the contact points of a surveyed robot's feet.

The contact points of a foot are those points of its primitive geoms that collide with the floor and
lie within 5 mm of the lowest one when all joints are zero. If the lowest box of a foot is tilted in
this pose, its lower face is the sole; otherwise the sole is level. A sole wider than 2 cm at its
front and at its back, under a leg of six joints or more, is flat with four corners. Any other sole
longer than 2 cm is a line from heel to toe, unless the leg has three joints; the rest are points.
Both feet of a pair get the same lengths. A foot without such a geom has the sole of its meshes, the
facets of their hull that look down, or, if their files are not there, that of a box with its
inertia, which is a guess. Wrenches act in the middle of the contacts: under an ankle with a short
heel the plan would have no room behind the foot point.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from hector_jax.core.headless import mujoco
from hector_jax.core.inputs import expect
from hector_jax.core.trajectory import FEET
from hector_jax.importing.links import subtree
from hector_jax.importing.meshes import foot_meshes
from hector_jax.importing.survey import MIN_Y, Survey
from hector_jax.robot.checks import SHAPES
from hector_jax.robot.description import FEWEST_JOINTS
from hector_jax.robot.poses import data_at

_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX = SHAPES
_SAME_SOLE = 5e-3  # [m] above the lowest point
_WIDE = 0.02  # [m]
_TOLERANCE, _GUESS_TOLERANCE = 0.01, 0.03  # [m] between the feet of a pair
_LEVEL, _UPRIGHT = np.cos(np.radians((0.5, 45.0)))  # range of tilts of a box that is a sole
_ONE_PLANE = np.cos(np.radians(3.0))  # of the facets of a hull that are one sole
_PLANE_SHARE = 0.4  # of all facets that look down, from which on a sole is a plane
_TIP = 1e-3  # [m] above the lowest point of a round foot
_FLAT_FROM = 6  # joints of a leg that can keep a flat sole level
_DOWN = np.array([0.0, 0.0, -1.0])
_RIM = 16  # points on a cylinder's edge


class Sole(NamedTuple):
    """The sole of a foot."""

    section: dict[str, Any]  # of the TOML
    contacts: Float[np.ndarray, "c 3"]  # in the axes of the sole, from the last joint [m]
    under: Float[np.ndarray, "3"]  # point of the sole that stands under the centre of mass [m]
    axes: Float[np.ndarray, "3 3"]  # of the sole in the trunk frame, in the pose of `find_soles`
    guessed: str = ""  # why it is guessed from the foot's inertia; empty if it is not
    files: tuple[str, ...] = ()  # of meshes that it was measured on


def find_soles(survey: Survey, angles: Mapping[str, float] | None = None) -> tuple[Sole, ...]:
    """Find the soles of all feet.

    Args:
        survey: of the robot.
        angles: pose [rad] by joint in which the contacts are determined; other joints are at zero.
            All of a `Sole` except its section refers to this pose.

    Raises:
        InputError: one line: the feet differ.
    """
    data = data_at(survey.model, angles)
    axes, origins = [_axes(data, leg) for leg in survey.legs], _origins(data, survey.legs)
    feet = list(zip(survey.legs, origins, axes, strict=True))
    points = [_floor_points(data, leg, origin, axis) for leg, origin, axis in feet]
    guessed, files = "", ()
    if not all(map(len, points)):
        meshes = foot_meshes(survey, data)
        if all(map(len, meshes.points)):
            facets = [_lowest_facets(x, len(survey.legs[0])) for x in meshes.points]
            axes = _mirrored_axes([axis for axis, _ in facets])
            points = [(x - o) @ a for (_, x), o, a in zip(facets, origins, axes, strict=True)]
            files = meshes.files
        else:
            guessed = "no shape of it collides, and " + (
                f"its meshes are not there: {', '.join(meshes.missing)}"
                if meshes.missing
                else "it has no mesh"
            )
            points = [_inertia_box(data, leg) - origin for leg, origin, _ in feet]
    outlines = [_outline(of_foot, len(survey.legs[0])) for of_foot in points]
    tolerance, soles = _GUESS_TOLERANCE if guessed or files else _TOLERANCE, []
    names = FEET[len(survey.legs)]
    for first in range(0, len(outlines), 2):
        left, right = outlines[first], _mirrored(outlines[first + 1])
        text = f"the {names[first]} foot touches at {np.round(left, 4).tolist()} from its last "
        text += f"joint and the mirrored {names[first + 1]} one at {np.round(right, 4).tolist()}"
        same = len(left) == len(right) and np.abs(left - right).max() <= tolerance
        expect(survey.file.path, same, f"{text}, expected the same")
        mean = np.round(0.5 * (left + right), 4)
        for i, contacts in ((first, mean), (first + 1, _mirrored(mean))):
            joint = survey.legs[i][-1]
            from_joint = contacts + (origins[i] - data.xanchor[joint]) @ axes[i]
            sole = _sole(data, survey.legs[i], from_joint, axes[i])
            soles.append(sole._replace(guessed=guessed, files=files))
    return tuple(soles)


def _origins(data: mujoco.MjData, legs: Sequence[Sequence[int]]) -> list[Float[np.ndarray, "3"]]:
    """Return a point on each leg's last joint, that of a right leg as mirrored as it can be [m]."""
    origins = []
    for left, right in zip(legs[::2], legs[1::2], strict=True):
        point, axis = data.xanchor[right[-1]], data.xaxis[right[-1]]
        mirrored = data.xanchor[left[-1]] * [1.0, -1.0, 1.0]
        origins += [data.xanchor[left[-1]], point + axis @ (mirrored - point) * axis]
    return origins


def _mirrored(contacts: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "c 3"]:
    """Return the contacts of the mirrored foot in the order of `_outline`."""
    order = [1, 0, 3, 2] if len(contacts) == 4 else list(range(len(contacts)))
    return contacts[order] * [1.0, -1.0, 1.0]


def _foot_geoms(model: mujoco.MjModel, leg: Sequence[int]) -> list[int]:
    """Return the colliding primitives of a foot; with the floor, if the file has one."""
    bodies = subtree(model, int(model.jnt_bodyid[leg[-1]]))
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    collide = (contype | conaffinity) > 0
    chosen = collide & np.isin(model.geom_bodyid, bodies) & np.isin(model.geom_type, SHAPES)
    floor = collide & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if floor.any():
        floor_contype = np.bitwise_or.reduce(contype[floor])
        floor_conaffinity = np.bitwise_or.reduce(conaffinity[floor])
        chosen &= ((contype & floor_conaffinity) | (conaffinity & floor_contype)) > 0
    return np.flatnonzero(chosen).tolist()


def _axes(data: mujoco.MjData, leg: Sequence[int]) -> Float[np.ndarray, "3 3"]:
    """Return the axes of the sole in the trunk frame, as columns."""
    boxes = [g for g in _foot_geoms(data.model, leg) if data.model.geom_type[g] == _BOX]
    if not boxes:
        return np.eye(3)
    R = data.geom_xmat[min(boxes, key=lambda g: data.geom_xpos[g][2])].reshape(3, 3)
    face = int(np.argmax(np.abs(R[2])))
    return _axes_of(R[:, face] * np.sign(R[2, face]))


def _axes_of(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the axes of a sole, as columns, with a normal in the trunk frame."""
    if not _UPRIGHT < up[2] < _LEVEL:
        return np.eye(3)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    return np.column_stack([ahead, np.cross(up, ahead), up])


def _lowest_facets(
    points: Float[np.ndarray, "n 3"], joints: int
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "m 3"]]:
    """Return the axes of the sole of a foot's meshes, and its points.

    The last body of three joints is a shank, whose foot is round: its lowest points.
    """
    low = points[points[:, 2] <= points[:, 2].min() + _TIP]
    if joints == FEWEST_JOINTS:
        return np.eye(3), low
    try:
        hull = ConvexHull(points)
    except QhullError:  # a plane
        return np.eye(3), low
    normals, facets = hull.equations[:, :3], points[hull.simplices]
    looks_down = normals[:, 2] < -_UPRIGHT
    if not looks_down.any():
        return np.eye(3), low
    normals, facets = normals[looks_down], facets[looks_down]
    sides = facets[:, 1:] - facets[:, :1]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    in_plane = normals @ normals.T > _ONE_PLANE
    best = int(np.argmax(in_plane @ area))
    share = float(in_plane[best] @ area / area.sum())
    up = -(in_plane[best] * area) @ normals
    axes = _axes_of(up / np.linalg.norm(up)) if share > _PLANE_SHARE else np.eye(3)
    corners = facets.reshape(-1, 3)
    heights = corners @ axes[:, 2]
    return axes, corners[heights <= heights.min() + _SAME_SOLE]


def _mirrored_axes(axes: Sequence[Float[np.ndarray, "3 3"]]) -> list[Float[np.ndarray, "3 3"]]:
    """Return the axes of the soles with those of a right foot as the mirror image of the left."""
    mirror = np.diag([1.0, -1.0, 1.0])
    return [mirror @ axes[i - 1] @ mirror if i % 2 else one for i, one in enumerate(axes)]


def _floor_points(
    data: mujoco.MjData,
    leg: Sequence[int],
    origin: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "n 3"]:
    """Return the points of the sole in its axes, from an origin."""
    geoms = _foot_geoms(data.model, leg)
    if not geoms:
        return np.zeros((0, 3))
    down = -axes[:, 2]
    points = np.concatenate([_support(data, g, down) for g in geoms])
    points = (points - origin) @ axes
    return points[points[:, 2] <= points[:, 2].min() + _SAME_SOLE]


def _support(
    data: mujoco.MjData, g: int, down: Float[np.ndarray, "3"] = _DOWN
) -> Float[np.ndarray, "n 3"]:
    """Return the corners of a box or the lowest points of a round geom."""
    shape, size = int(data.model.geom_type[g]), data.model.geom_size[g]
    center, R = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3)
    if shape == _BOX:
        return center + (list(product((-1, 1), repeat=3)) * size) @ R.T
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
    slope = np.linalg.norm(across)
    if slope > 1e-6:
        rim = np.concatenate([rim, size[0] * across[None] / slope])
    return (ends[:, None] + rim).reshape(-1, 3)


def _outline(points: Float[np.ndarray, "n 3"], joints: int) -> Float[np.ndarray, "c 3"]:
    """Return the corners front left, front right, back left, back right; toe, heel; or a point."""
    if joints == FEWEST_JOINTS:  # they level no line
        points = points[points[:, 2] <= points[:, 2].min() + _TIP]
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, _ = 0.5 * (low + high)
    z = low[2]
    front, back = points[points[:, 0] >= x, 1], points[points[:, 0] <= x, 1]
    if high[0] - low[0] <= _WIDE or joints == FEWEST_JOINTS:
        return np.array([[x, y, z]])
    if min(np.ptp(front), np.ptp(back)) <= _WIDE or joints < _FLAT_FROM:
        return np.array([[high[0], y, z], [low[0], y, z]])
    ends = (high[0], front), (low[0], back)
    return np.array([[x, y, z] for x, across in ends for y in (across.max(), across.min())])


def _inertia_box(data: mujoco.MjData, leg: Sequence[int]) -> Float[np.ndarray, "n 3"]:
    """Return the lower corners of the box with the mass and inertia of the foot's last body.

    A tilted box is as large about the trunk's axes as its moments are. The last body of three
    joints is a shank, whose foot is a point: the lower end of its box.
    """
    model, body = data.model, int(data.model.jnt_bodyid[leg[-1]])
    mass, moments = model.body_mass[body], model.body_inertia[body]
    square = 1.5 * (moments.sum() - 2.0 * moments) / max(mass, 1e-9)
    R, half = data.ximat[body].reshape(3, 3), np.sqrt(np.maximum(square, 1e-6))
    if len(leg) == FEWEST_JOINTS:
        end = R[:, half.argmax()] * half.max()
        return (data.xipos[body] - end * np.sign(end[2]))[None]
    return data.xipos[body] + list(product((-1, 1), (-1, 1), (-1.0,))) * np.sqrt(R**2 @ half**2)


def _sole(
    data: mujoco.MjData,
    leg: Sequence[int],
    contacts: Float[np.ndarray, "c 3"],
    axes: Float[np.ndarray, "3 3"],
) -> Sole:
    """Return a sole by points in the frame of the body that the leg's last joint moves."""
    joint, pitch = leg[-1], [j for j in leg if abs(data.xaxis[j][1]) >= MIN_Y]
    body = int(data.model.jnt_bodyid[joint])
    R, origin = data.xmat[body].reshape(3, 3), data.xpos[body] - data.xanchor[joint]
    aligned = np.allclose(np.abs(axes.T @ R).max(axis=0), 1.0, rtol=0.0, atol=1e-9)
    aligned = aligned and np.abs(origin - np.round(origin, 4)).max() <= 1e-9
    digits = 4 if aligned or len(contacts) == 1 else 8  # rounding cannot tilt a single point

    def rounded(point: Float[np.ndarray, "3"]) -> list[float]:
        return [round(float(x), digits) + 0.0 for x in point]  # no -0.0

    section: dict[str, Any] = {"body": data.model.body(body).name}
    section["contacts"] = [*map(rounded, (contacts @ axes.T - origin) @ R)]
    under = contacts.mean(axis=0)
    ankle = (data.xanchor[pitch[-1]] - data.xanchor[joint]) @ axes[:, 0]
    if contacts[:, 0].min() < ankle - 1e-3 < ankle + 1e-3 < contacts[:, 0].max():
        under[0] = ankle  # whose motor then has least to bear
    return Sole(section, contacts, under, axes)
