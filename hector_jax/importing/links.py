"""Merge the bodies of a compiled model into the moving links of a robot: the trunk and the legs.

Joints outside the legs are fixed at an angle, and a body that does not move relative to its parent
is merged with it. A link's frame is that of the body which its joint moves, shifted to the joint's
anchor; the trunk's is that of the body with the free joint.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco
from hector_jax.robot.poses import data_at, inertia_about, rotation_of

MASSLESS = 1e-6  # [kg]: largest mass that `links_of` neglects


class Pose(NamedTuple):
    """Orientation and position of a frame in another frame."""

    R: Float[np.ndarray, "3 3"] = np.eye(3)
    p: Float[np.ndarray, "3"] = np.zeros(3)  # [m]

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.R @ other.R, self.p + self.R @ other.p)

    def to(self, other: "Pose") -> "Pose":
        """Return the pose of another frame relative to this frame; both in the same parent."""
        return Pose(self.R.T @ other.R, self.R.T @ (other.p - self.p))

    @property
    def quat(self) -> Float[np.ndarray, "4"]:
        """The orientation as a quaternion."""
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, self.R.ravel())
        return quat


class Link(NamedTuple):
    """A moving body and all bodies fixed to it, in the link's own frame."""

    name: str
    parent: int  # index of the link; -1 for the trunk
    joint: int  # index in the model; -1 for the trunk
    pose: Pose  # in the parent's frame
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # [m]
    inertia: Float[np.ndarray, "3 3"]  # about the centre of mass [kg m^2]
    bodies: dict[int, Pose]  # by index in the model


def pose_of(pos: Float[np.ndarray, "3"], quat: Float[np.ndarray, "4"]) -> Pose:
    """Return the pose of a position [m] and a quaternion."""
    return Pose(rotation_of(quat), np.array(pos))


def links_of(
    model: mujoco.MjModel, root: int, joints: Sequence[int], fixed: Mapping[int, float]
) -> list[Link]:
    """Return the trunk, then the links of the legs in the order of their joints.

    Args:
        model: compiled.
        root: body of the trunk.
        joints: of the legs, each the only one of its body.
        fixed: angles [rad] of all other hinges and slides, by joint.
    """
    data = data_at(model, fixed)  # the leg joints at zero, not at their reference angles
    poses = [Pose(R, p) for R, p in zip(data.xmat.reshape(-1, 3, 3), data.xpos, strict=True)]
    roots = [root, *model.jnt_bodyid[joints].tolist()]  # body that moves each link
    anchors = [data.xpos[root], *data.xanchor[joints]]
    frames = [Pose(poses[b].R, anchor) for b, anchor in zip(roots, anchors, strict=True)]
    link_of: dict[int, int] = {}  # index of the link by body
    for b in subtree(model, root):
        link_of[b] = roots.index(b) if b in roots else link_of[int(model.body_parentid[b])]
    links = []
    for index, (body, joint) in enumerate(zip(roots, (-1, *joints), strict=True)):
        parent = link_of.get(int(model.body_parentid[body]), -1)
        pose = frames[parent].to(frames[index]) if index else Pose()
        bodies = {b: frames[index].to(poses[b]) for b, link in link_of.items() if link == index}
        mass, com, inertia = _composite(model, bodies)
        links.append(Link(model.body(body).name, parent, joint, pose, mass, com, inertia, bodies))
    return links


def subtree(model: mujoco.MjModel, root: int) -> list[int]:
    """Return a body and all its descendants, parents first."""
    bodies = [root]
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in bodies:
            bodies.append(body)
    return bodies


def _composite(
    model: mujoco.MjModel, bodies: Mapping[int, Pose]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Return the mass, centre of mass and inertia of bodies fixed to each other."""
    heavy = [b for b in bodies if model.body_mass[b] > MASSLESS]
    if not heavy:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    poses = [bodies[b] @ pose_of(model.body_ipos[b], model.body_iquat[b]) for b in heavy]
    R, centers = (np.array(part) for part in zip(*poses, strict=True))
    masses = model.body_mass[heavy]
    com = masses @ centers / masses.sum()
    inertia = inertia_about(com, masses, model.body_inertia[heavy], R, centers)
    return float(masses.sum()), com, inertia
