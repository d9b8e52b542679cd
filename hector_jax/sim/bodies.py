"""The bodies of a world as plain numbers, for engines that do not read a MuJoCo model.

A world's model already holds every number of its plant (masses, friction, armature, backlash as
second hinges), so that an engine that takes its bodies from here has the same plant.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.poses import rotation_of
from hector_jax.sim.world import World


class Hinge(NamedTuple):
    """A joint that turns its body about an axis through the body's origin."""

    name: str
    axis: Float[np.ndarray, "3"]  # body frame
    dof: int  # its index in MuJoCo's velocities
    damping: float  # [N m s/rad]
    armature: float  # [kg m2]
    friction: float  # [N m] dry
    limits: tuple[float, float]  # [rad], infinite for a joint without limits


class Body(NamedTuple):
    """A rigid body; at zero angles its frame is fixed in that of its parent."""

    id: int  # of MuJoCo
    name: str
    parent: int  # 0: the world, of which the trunk is free
    position: Float[np.ndarray, "3"]  # [m] in the parent's frame
    rotation: Float[np.ndarray, "3 3"]
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # [m] body frame
    inertia: Float[np.ndarray, "3 3"]  # [kg m2] about the centre of mass, body frame
    hinges: tuple[Hinge, ...]  # for a leg's link: the motor's, then with backlash the gear's


class Shape(NamedTuple):
    """A geom that may touch something."""

    id: int  # of MuJoCo
    body: int  # 0: the floor, which is the plane z = 0
    kind: str  # plane, sphere, capsule along z, box
    size: Float[np.ndarray, "3"]  # [m] as MuJoCo's: radius, half length; half edges
    position: Float[np.ndarray, "3"]  # [m] body frame
    rotation: Float[np.ndarray, "3 3"]


def bodies(world: World) -> list[Body]:
    """Return the robot's bodies, parents before their children."""
    return [_body(world.model, i) for i in range(1, world.model.nbody)]


def _body(model: mujoco.MjModel, i: int) -> Body:
    R = rotation_of(model.body_iquat[i])
    first, count = model.body_jntadr[i], model.body_jntnum[i]
    joints = range(first, first + count)
    return Body(
        id=i,
        name=model.body(i).name,
        parent=int(model.body_parentid[i]),
        position=model.body_pos[i],
        rotation=rotation_of(model.body_quat[i]),
        mass=float(model.body_mass[i]),
        com=model.body_ipos[i],
        inertia=R @ np.diag(model.body_inertia[i]) @ R.T,
        hinges=tuple(_hinge(model, j) for j in joints if model.jnt_type[j]),  # 0: the free joint
    )


def _hinge(model: mujoco.MjModel, j: int) -> Hinge:
    dof = model.jnt_dofadr[j]
    limits = model.jnt_range[j] if model.jnt_limited[j] else (-np.inf, np.inf)
    return Hinge(
        name=model.joint(j).name,
        axis=model.jnt_axis[j],
        dof=int(dof),
        damping=float(model.dof_damping[dof]),
        armature=float(model.dof_armature[dof]),
        friction=float(model.dof_frictionloss[dof]),
        limits=(float(limits[0]), float(limits[1])),
    )


def shapes(world: World) -> list[Shape]:
    """Return the geoms that may touch something, including the floor."""
    model = world.model
    return [
        Shape(
            id=i,
            body=int(model.geom_bodyid[i]),
            kind=mujoco.mjtGeom(model.geom_type[i]).name.removeprefix("mjGEOM_").lower(),
            size=model.geom_size[i],
            position=model.geom_pos[i],
            rotation=rotation_of(model.geom_quat[i]),
        )
        for i in sorted({geom for pair in touching_pairs(world) for geom in pair})
    ]


def soles(world: World) -> list[Shape]:
    """Return the spheres on which the feet stand, the only shapes with friction."""
    feet = world.foot_of_geom
    return [shape for shape in shapes(world) if shape.kind == "sphere" and feet[shape.id] >= 0]


def touching_pairs(world: World) -> set[tuple[int, int]]:
    """Return the pairs of geoms (the smaller id first) that may touch, by MuJoCo's rules.

    The geoms' contact bits match, and their bodies are not the same, parent and child or excluded.
    """
    model = world.model
    bits, mask, body = model.geom_contype, model.geom_conaffinity, model.geom_bodyid.tolist()
    excluded = {(signature >> 16, signature & 0xFFFF) for signature in model.exclude_signature}

    def filtered(first: int, second: int) -> bool:
        is_parent = first > 0 and model.body_parentid[second] == first
        return first == second or is_parent or (first, second) in excluded

    return {
        (a, b)
        for a, b in combinations(range(model.ngeom), 2)
        if (bits[a] & mask[b] or bits[b] & mask[a])
        and not (filtered(body[a], body[b]) or filtered(body[b], body[a]))
    }


def contact_spring(world: World, points: int) -> tuple[float, float]:
    """Return stiffness and damping under each of the `points` that carry the standing robot.

    The stiffness is in N/m at each contact point, the damping in s/m as of Hunt and Crossley:
    force = stiffness * depth * (1 + damping * speed).

    A contact of time constant T yields under the robot's weight by g T^2 / 3, as MuJoCo's does
    (measured: 0.31 to 0.47 mm at 10 ms), and its damping is 2 / (g T).
    """
    time, mass = world.model.geom_solref[world.floor, 0], world.model.body_subtreemass[0]
    gravity = np.linalg.norm(world.model.opt.gravity)
    return float(3.0 * mass / time**2 / points), float(2.0 / (gravity * time))


STICTION = 0.05  # [rad/s] above which dry friction has its full size


def dry_friction(
    hinges: list[Hinge],
) -> tuple[Float[np.ndarray, " hinges"], Float[np.ndarray, " hinges"]]:
    """Return size [N m] and speed [rad/s] of dry friction as a torque -size tanh(rate / speed).

    The speed is `STICTION`, or larger if that would not be stable over a step.
    """
    size = np.array([hinge.friction for hinge in hinges])
    inertia = np.array([hinge.armature for hinge in hinges])
    return size, np.maximum(STICTION, size * TIME_STEP / np.maximum(inertia, 1e-9))
