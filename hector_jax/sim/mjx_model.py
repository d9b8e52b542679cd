"""The plants of a batch as one MJX model, and what is read off MJX's data.

What differs between the plants' MuJoCo models becomes batched leaves. Nothing but the feet may
touch the floor without ending the walk, so MJX looks for contacts of the feet and between the legs
alone, and whether anything else is in the floor is read off the geoms' poses.
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

# Newton steps and steps of their line search: under vmap every walk takes each of them. MJX's own
# search needs fewer than the C engine's. In 32 bits the fewer move contact forces by 2 mN in the
# median of 4096 walks; with four and six it is 2 N.
STEPS, SINGLE_STEPS = (10, 10), (6, 6)

# Fields of a model that a plant's numbers change.
_VARIED = (
    "body_inertia body_invweight0 body_ipos body_mass body_subtreemass dof_armature dof_damping "
    "dof_frictionloss dof_invweight0 dof_M0 geom_friction geom_solref jnt_range"
).split()


@dataclass(frozen=True)
class Places:
    """Where the robot's parts are, for the compiler."""

    coordinates: tuple[int, ...]
    actuator: tuple[int, ...]
    foot_of_geom: tuple[int, ...]
    boxes: tuple[int, ...]  # geoms that end the walk when they touch the floor
    capsules: tuple[int, ...]
    floor: int
    trunk: int


def batched_model(
    worlds: Sequence[World], single: bool = False
) -> tuple[mjx.Model, dict[str, np.ndarray]]:
    """One MJX model, to be stepped in 32 bits or 64, and the leaves that may differ, stacked.

    Raises:
        ValueError: the models do not have the same joints.
    """
    if len({world.model.nq for world in worlds}) != 1:
        raise ValueError("plants of one batch must all have backlash or none")
    first = copy(worlds[0].model)
    first.opt.iterations, first.opt.ls_iterations = SINGLE_STEPS if single else STEPS
    for geom in _falling(worlds[0]):
        first.geom_contype[geom] &= ~first.geom_conaffinity[worlds[0].floor]
        first.geom_conaffinity[geom] &= ~first.geom_contype[worlds[0].floor]
    varied = {name: np.stack([getattr(w.model, name) for w in worlds]) for name in _VARIED}
    return mjx.put_model(first), varied


def _falling(world: World) -> list[int]:
    """Geoms that collide with the floor and are of no foot."""
    model, floor = world.model, world.floor
    meets = (model.geom_contype[floor] & model.geom_conaffinity) | (
        model.geom_conaffinity[floor] & model.geom_contype
    )
    return [g for g in np.flatnonzero(meets).tolist() if g != floor and world.foot_of_geom[g] < 0]


def find_places(world: World) -> Places:
    """Where the robot's parts are in a world.

    Raises:
        InputError: a geom that may touch the floor is neither box nor capsule.
    """
    kinds = {mujoco.mjtGeom.mjGEOM_BOX: [], mujoco.mjtGeom.mjGEOM_CAPSULE: []}
    for geom in _falling(world):
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
        actuator=tuple(world.actuator.tolist()),
        foot_of_geom=tuple(world.foot_of_geom.tolist()),
        boxes=boxes,
        capsules=capsules,
        floor=world.floor,
        trunk=world.trunk,
    )


def mjx_contacts(data: mjx.Data) -> Contacts:
    """Contacts of the last MJX step; slots whose bodies are apart have geoms -1."""
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
    """Whether a part that may not touch the floor does; poses are those of the step's start."""
    boxes, capsules = np.array(places.boxes, int), np.array(places.capsules, int)
    up = data.geom_xmat[:, 2]  # of each geom's axes, their z in the world
    of_box = jnp.abs(up[boxes] * model.geom_size[boxes]).sum(axis=1)
    radius, half = model.geom_size[capsules, 0], model.geom_size[capsules, 1]
    of_capsule = radius + half * jnp.abs(up[capsules, 2])
    both = np.concatenate([boxes, capsules])
    lowest = data.geom_xpos[both, 2] - jnp.concatenate([of_box, of_capsule])
    return (lowest < data.geom_xpos[places.floor, 2]).any()


def to_single(tree: Any) -> Any:
    """The same in 32 bits."""
    narrow = {np.dtype(np.float64): np.float32, np.dtype(np.int64): np.int32}
    cast = lambda x: x.astype(narrow[x.dtype]) if x.dtype in narrow else x  # noqa: E731
    return jax.tree.map(cast, tree)
