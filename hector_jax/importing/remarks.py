"""Say what is likely wrong with a robot: odd numbers, legs that are no mirror images, overlaps."""

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from hector_jax.core.headless import mujoco
from hector_jax.importing.convert import UNITS, Standard
from hector_jax.importing.survey import places_of
from hector_jax.robot.description import Description
from hector_jax.robot.model import Robot, build_model, quiet_mujoco
from hector_jax.robot.poses import data_at, standing_data

_HEAVY_LEGS = 0.35  # share of the robot's mass
_UNLIKE = 0.05  # least relative difference of the legs of a pair that is told
_SHORTEST_SPAN, _FARTHEST = 0.1, 2.0 * np.pi  # [rad] of a range; others have probably another unit
_DENSITY = 5.0, 5000.0  # [kg/m^3] of a robot's mass and the cube of its height
_BACKWARDS = "if the robot looks along -x, turn the model so that x is ahead"
_OPPOSITES = (("front", "hind"), ("hind", "front"), ("left", "right"), ("right", "left"))
_SPRING = 0.01  # share of the torque limit of a spring that is told, also at 1 rad
_PLACEHOLDER = 10.0  # torque limit of no motor, times weight and height

Sides = tuple[Float[np.ndarray, "j n"], Float[np.ndarray, "j n"]]
"""A quantity of a leg by joint, and that of the other leg of the pair as its mirror image."""


@quiet_mujoco()
def remarks(robot: Robot, standard: Standard | None = None) -> list[str]:
    """Return one line per likely cause of trouble in walking, with its remedy.

    Args:
        robot: in the standard form.
        standard: what it was converted from, if it was.
    """
    description, model = robot.description, build_model(robot.description, checked=False)[1]
    share, weight = float(robot.link_mass.sum() / robot.mass), float(robot.mass * robot.gravity[2])
    control = {name: dict(section) for name, section in description.control}
    lines = [*_units(robot), *differences(robot)]
    lines += [*_overlaps(standard, model)] if standard else []
    lines += [*_places(description), *_springs(robot, model)]
    if share > _HEAVY_LEGS and not control.get("legs", {}).get("gravity_compensation"):
        lines.append(
            f"the legs are {100 * share:.0f} % of the mass and lift the trunk when they stretch: "
            "set legs.gravity_compensation = true and bend the knees"
        )
    names = description.joints
    if missing := [n for n in names if not model.dof_armature[model.joint(n).dofadr[0]]]:
        lines.append(
            f"joint {missing[0]!r} has no armature, without which backlash cannot be simulated: "
            "give it one in the model"
        )
    if len(description.feet) == 2 and np.abs(robot.joint_axis[..., 2]).max() < 0.5:
        lines.append("no joint of a leg turns about z: the robot may fall in curves, walk straight")
    ahead = (robot.sole[0].T @ robot.foot_point[0])[0]  # of the last joint
    if robot.structure.contact != "point" and robot.heel - ahead > 1.2 * (robot.toe + ahead):
        lines.append(f"the heel is longer than the toe: {_BACKWARDS}")
    force = control.get("mpc", {}).get("max_force", 500.0)
    if force < 1.5 * weight:
        lines.append(
            f"mpc.max_force is {force:.3g} N, {force / weight:.2g} times the weight: set "
            f"{2.5 * weight:.2g}"
        )
    return lines


def _units(robot: Robot) -> Iterator[str]:
    """Yield one line for each kind of numbers that no robot has."""
    names, mass, height = robot.description.joints, float(robot.mass), float(robot.standing_height)
    ranges, limits = np.column_stack([robot.joint_lower, robot.joint_upper]), robot.torque_limit
    span, end = np.ptp(ranges, axis=1), np.abs(ranges).max(axis=1)
    if odd := np.flatnonzero((span < _SHORTEST_SPAN) | (end > _FARTHEST)).tolist():
        found = ", ".join(f"{names[i]} {range_words(ranges[i])}" for i in odd)
        yield f"ranges of {found} have probably another unit: {UNITS}"
    most = _PLACEHOLDER * mass * float(robot.gravity[2]) * height
    if odd := np.flatnonzero(limits > most).tolist():
        yield (
            f"torque limits of {', '.join(f'{names[i]} {limits[i]:.4g}' for i in odd)} N m are "
            f"probably placeholders, for {mass:.3g} kg: write those of the motors"
        )
    if not _DENSITY[0] <= mass / height**3 <= _DENSITY[1]:
        yield f"{mass:.3g} kg with a centre of mass {height:.3g} m high is no robot: write kg and m"


def _places(description: Description) -> Iterator[str]:
    """Yield one line if the names of two opposite legs each say the place of the other one."""
    joints = np.reshape(description.joints, (len(description.legs), -1)).tolist()
    said = {leg: places_of(own) for leg, own in zip(description.legs, joints, strict=True)}
    if told := [
        f"{own[0]} is {place}"
        for place, other in _OPPOSITES
        for leg, own in zip(said, joints, strict=True)
        if place in leg and said[leg] & {place, other} == {other}
        if place in said[leg.replace(place, other)]
    ]:
        yield f"places differ from names, {', '.join(told)}: {_BACKWARDS}, or rename the joints"


def _springs(robot: Robot, model: mujoco.MjModel) -> Iterator[str]:
    """Yield one line if springs turn joints of the legs."""
    torque = np.abs(standing_data(robot.description, model).qfrc_passive[6:])
    values = zip(model.jnt_stiffness[1:], torque, robot.torque_limit, strict=True)
    if told := [
        f"{name} ({stiffness:.3g} N m/rad, standing {spring:.3g} of {limit:.3g} N m)"
        for name, (stiffness, spring, limit) in zip(robot.description.joints, values, strict=True)
        if max(stiffness, spring) > _SPRING * limit
    ]:
        yield f"springs turn {', '.join(told)}: the controller knows of none, remove them"


def differences(robot: Robot) -> list[str]:
    """Return one line for each two joints at which the legs of a pair are no mirror images."""
    lines = []
    for left, right, has in pairs_of(robot, build_model(robot.description, checked=False)[1]):
        for i, names in enumerate(zip(left, right, strict=True)):
            unlike = [x for x in has if x != "standing [rad]" and _unlike(has[x])[i]]
            if unlike:
                found = (f"{x} {words_of(has[x], i, numbers, ' and ')}" for x in unlike)
                lines.append(f"{' and '.join(names)} are no mirror images: {'; '.join(found)}")
    return lines


def _overlaps(source: Standard, model: mujoco.MjModel) -> Iterator[str]:
    """Yield one line for each two links that touch, standing, and do not in the file."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(data.model, data, 0)
    now = _touching(data, {data.model.body(link.name).id: link.name for link in source.links})
    then = _touching(source.file, {b: link.name for link in source.links for b in link.bodies})
    for pair in sorted(now - then):
        yield (
            f"bodies {' and '.join(pair)} overlap when standing, and not in the file: exclude them "
            "under <contact>, or make a shape smaller"
        )


def _touching(data: mujoco.MjData, links: Mapping[int, str]) -> set[tuple[str, ...]]:
    """Return the names of each two links that overlap."""
    mujoco.mj_kinematics(data.model, data)
    mujoco.mj_collision(data.model, data)
    bodies = [data.model.geom_bodyid[x.geom] for x in data.contact if x.dist < 0.0]
    pairs = [{links.get(int(b), "") for b in pair} for pair in bodies]
    return {tuple(sorted(pair)) for pair in pairs if len(pair) == 2 and "" not in pair}


def _unlike(sides: Sides) -> Bool[np.ndarray, " j"]:
    """Return the joints at which the legs differ."""
    size = np.max([np.linalg.norm(side, axis=1) for side in sides], axis=0)
    difference = np.linalg.norm(sides[0] - sides[1], axis=1)
    return difference > _UNLIKE * np.maximum(size, 0.1 * size.max())


def words_of(
    sides: Sides, joint: int, write: Callable[[np.ndarray], str], between: str = " / "
) -> str:
    """Return the value of a joint, and that of the other leg if it differs."""
    return between.join(write(x[joint]) for x in sides[: 1 + int(_unlike(sides)[joint])])


def pairs_of(
    robot: Robot, model: mujoco.MjModel
) -> Iterator[tuple[Sequence[str], Sequence[str], dict[str, Sides]]]:
    """Yield the joints of each pair of legs in the standard form, and what they have."""
    data, mirror, names = data_at(model), np.array([1.0, -1.0, 1.0]), robot.description.joints
    bodies, dofs = model.jnt_bodyid, model.jnt_dofadr
    scalars = {
        "motor [N m]": np.append(0.0, model.actuator_ctrlrange[:, 1]),
        "link [kg]": model.body_mass[bodies],
        "inertia [kg m^2]": np.sort(model.body_inertia[bodies]),
        "armature [kg m^2]": model.dof_armature[dofs],
        "damping [N m s]": model.dof_damping[dofs],
        "friction [N m]": model.dof_frictionloss[dofs],
        "spring [N m/rad]": model.jnt_stiffness,
    }
    for legs in np.arange(1, model.njnt).reshape(-1, 2, robot.joint_axis.shape[1]):
        one, two = legs
        axes = data.xaxis[one], -data.xaxis[two] * mirror
        sign = np.where((axes[0] * axes[1]).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
        places = [data.xanchor[one], data.xanchor[two] * mirror]
        along = ((places[1] - places[0]) * axes[1]).sum(axis=1)[:, None] * axes[1]
        places[1] = places[1] - along  # of the other line the point that is nearest
        coms = data.xipos[bodies[one]] - places[0], data.xipos[bodies[two]] * mirror - places[1]
        span, standing = model.jnt_range, model.key_qpos[0, 6:, None]
        left, right = ([names[j - 1] for j in leg] for leg in legs)
        mirrored = np.where(sign < 0.0, -span[two][:, ::-1], span[two])
        has: dict[str, Sides] = {
            "axis": (axes[0], sign * axes[1]),
            "range [rad]": (span[one], mirrored),
            "standing [rad]": (standing[one], sign * standing[two]),
            "place [m]": tuple(np.diff(x, axis=0, prepend=0.0) for x in places),
            "centre of mass [m]": coms,
        }
        for quantity, values in scalars.items():
            has[quantity] = tuple(values[leg].reshape(len(leg), -1) for leg in legs)
        yield left, right, has


def range_words(span: Float[np.ndarray, "2"]) -> str:
    """Return a joint's range in words."""
    return f"{span[0]:+.2f} to {span[1]:+.2f}"


def numbers(values: Float[np.ndarray, " n"]) -> str:
    """Return numbers with three digits."""
    return ", ".join(f"{x:.3g}" for x in values)
