"""The plants of a batch as one MJX model, and contacts read from MJX's data.

Fields that differ between the plants' MuJoCo models become batched leaves. A walk ends when parts
other than the feet touch the floor, so MJX detects contacts of the feet and between the legs only,
and the floor's contact with other parts is computed from the geoms' poses.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

from hector_jax.core.headless import mujoco  # before MJX loads it with OpenGL

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool
from mujoco import mjx

from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.sim import sensing
from hector_jax.sim.sensing import Contacts
from hector_jax.sim.world import World

# Newton steps and steps of their line search: under vmap every walk takes all of them. MJX's own
# search needs fewer than the C engine's. In 32 bits the smaller numbers change contact forces by
# 2 mN in the median of 4096 walks; four and six steps change them by 2 N.
STEPS, SINGLE_STEPS = (10, 10), (6, 6)

# Fields of a model that depend on a plant's numbers.
_VARIED = (
    "body_inertia body_invweight0 body_ipos body_mass body_subtreemass dof_armature dof_damping "
    "dof_frictionloss dof_invweight0 dof_M0 geom_friction geom_solref jnt_range"
).split()


@dataclass(frozen=True)
class Places:
    """Indices of the robot's parts in the model, hashable for the compiler."""

    coordinates: tuple[int, ...]
    foot_of_geom: tuple[int, ...]
    boxes: tuple[int, ...]  # geoms that end the walk when they touch the floor
    capsules: tuple[int, ...]
    floor: int
    trunk: int


def batched_model(
    worlds: Sequence[World], single: bool = False
) -> tuple[mjx.Model, dict[str, np.ndarray]]:
    """Return one MJX model, to be stepped in 32 or 64 bits, and the leaves that vary, stacked.

    Raises:
        ValueError: the models do not have the same joints.
    """
    if len({world.model.nq for world in worlds}) != 1:
        raise ValueError("plants of one batch must all have backlash or none")
    first = copy(worlds[0].model)
    first.opt.iterations, first.opt.ls_iterations = SINGLE_STEPS if single else STEPS
    for geom in _fall_geoms(worlds[0]):
        first.geom_contype[geom] &= ~first.geom_conaffinity[worlds[0].floor]
        first.geom_conaffinity[geom] &= ~first.geom_contype[worlds[0].floor]
    varied = {name: np.stack([getattr(w.model, name) for w in worlds]) for name in _VARIED}
    return mjx.put_model(first), varied


def _fall_geoms(world: World) -> list[int]:
    """Return the geoms that collide with the floor and are of no foot."""
    types, affinities, floor = world.model.geom_contype, world.model.geom_conaffinity, world.floor
    meets = types[floor] & affinities | affinities[floor] & types
    return [g for g in np.flatnonzero(meets).tolist() if g != floor and world.foot_of_geom[g] < 0]


def find_places(world: World) -> Places:
    """Find the robot's parts in a world.

    Raises:
        InputError: a geom that may touch the floor is neither box nor capsule.
    """
    kinds = {mujoco.mjtGeom.mjGEOM_BOX: [], mujoco.mjtGeom.mjGEOM_CAPSULE: []}
    for geom in _fall_geoms(world):
        kind = mujoco.mjtGeom(world.model.geom_type[geom])
        if kind not in kinds:
            name = world.model.geom(geom).name or f"number {geom}"
            raise InputError(
                f"geom {name} may touch the floor and is a {kind.name.removeprefix('mjGEOM_')}; "
                "in MJX all but feet are expected to be BOX or CAPSULE"
            )
        kinds[kind].append(geom)
    boxes, capsules = (tuple(geoms) for geoms in kinds.values())
    return Places(
        coordinates=tuple(sensing.coordinates(world).tolist()),
        foot_of_geom=tuple(world.foot_of_geom.tolist()),
        boxes=boxes,
        capsules=capsules,
        floor=world.floor,
        trunk=world.trunk,
    )


def mjx_contacts(data: mjx.Data) -> Contacts:
    """Return the contacts of the last MJX step; slots whose bodies are apart have geoms -1."""
    contact = data._impl.contact
    rows = np.maximum(contact.efc_address, 0)[:, None] + np.arange(4)
    edges = data._impl.efc_force[np.minimum(rows, data._impl.efc_force.shape[0] - 1)]
    return Contacts(
        geoms=jnp.where((contact.dist < contact.includemargin)[:, None], contact.geom, -1),
        position=contact.pos,
        frame=contact.frame,
        pyramid=edges,
        friction=contact.friction[:, :2],
    )


def in_floor(places: Places, model: mjx.Model, data: mjx.Data) -> Bool[Array, ""]:
    """Return whether a part that may not touch the floor does, at the poses of the step's start."""
    boxes, capsules = np.array(places.boxes, int), np.array(places.capsules, int)
    up = data.geom_xmat[:, 2]  # z of each geom's axes in the world
    box_extent = jnp.abs(up[boxes] * model.geom_size[boxes]).sum(axis=1)
    radius, half_length = model.geom_size[capsules, 0], model.geom_size[capsules, 1]
    capsule_extent = radius + half_length * jnp.abs(up[capsules, 2])
    centre = data.geom_xpos[np.concatenate([boxes, capsules]), 2]
    lowest = centre - jnp.concatenate([box_extent, capsule_extent])
    return (lowest < data.geom_xpos[places.floor, 2]).any()


def to_single(tree: Any) -> Any:
    """Return the same tree in 32 bits."""
    narrow = {np.dtype(np.float64): np.float32, np.dtype(np.int64): np.int32}
    cast = lambda x: x.astype(narrow[x.dtype]) if x.dtype in narrow else x  # noqa: E731
    return jax.tree.map(cast, tree)
