"""The moving links of a robot: a trunk and the legs, each with all that is fixed to it.

Links are read from a compiled model: joints of no leg are fixed at an angle, and a body that does
not move against its parent becomes part of it. A link's frame is that of the body which its joint
moves, shifted to the joint's anchor; the trunk's is that of the body with the free joint.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hector_jax.core.headless import mujoco

MASSLESS = 1e-9  # [kg]: what `links_of` takes for nothing


class Pose(NamedTuple):
    """A frame in another one."""

    R: Float[np.ndarray, "3 3"] = np.eye(3)
    p: Float[np.ndarray, "3"] = np.zeros(3)  # [m]

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.R @ other.R, self.p + self.R @ other.p)

    def to(self, other: "Pose") -> "Pose":
        """Another frame, given in the same one, in this one."""
        return Pose(self.R.T @ other.R, self.R.T @ (other.p - self.p))

    @property
    def quat(self) -> Float[np.ndarray, "4"]:
        """The turn as a quaternion."""
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, self.R.ravel())
        return quat


class Link(NamedTuple):
    """A moving body and what is fixed to it, in the link's own frame."""

    name: str
    parent: int  # link; -1 for the trunk
    joint: int  # in the model; -1 for the trunk
    pose: Pose  # in the parent's frame
    mass: float  # [kg]
    com: Float[np.ndarray, "3"]  # [m]
    inertia: Float[np.ndarray, "3 3"]  # about the centre of mass [kg m^2]
    bodies: dict[int, Pose]  # of the model


def pose_of(pos: Float[np.ndarray, "3"], quat: Float[np.ndarray, "4"]) -> Pose:
    """The pose of a place [m] and a quaternion."""
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, quat)
    return Pose(R.reshape(3, 3), np.array(pos))


def links_of(
    model: mujoco.MjModel, root: int, joints: Sequence[int], fixed: Mapping[int, float]
) -> list[Link]:
    """The trunk, then the links of the legs in the order of their joints.

    Args:
        model: compiled.
        root: body of the trunk.
        joints: of the legs, each the only one of its body.
        fixed: angle [rad] by joint, of all other hinges and slides.
    """
    # at zero of the legs' joints, whatever their references are
    data = at_zero(model, {int(model.jnt_qposadr[j]): angle for j, angle in fixed.items()})
    places = [Pose(R, p) for R, p in zip(data.xmat.reshape(-1, 3, 3), data.xpos, strict=True)]
    roots = {-1: root} | {j: int(model.jnt_bodyid[j]) for j in joints}
    frames = {
        j: Pose(places[b].R, data.xanchor[j] if j >= 0 else places[b].p) for j, b in roots.items()
    }
    link_of: dict[int, int] = {}  # joint or -1, by body
    joint_of = {body: joint for joint, body in roots.items()}
    for body in subtree(model, root):
        link_of[body] = joint_of.get(body, link_of.get(int(model.body_parentid[body]), -1))
    links = []
    for joint, body in roots.items():
        frame, above = frames[joint], link_of.get(int(model.body_parentid[body]), -1)
        bodies = {b: frame.to(places[b]) for b, link in link_of.items() if link == joint}
        pose, parent = Pose(), -1
        if joint >= 0:
            pose, parent = frames[above].to(frame), list(roots).index(above)
        own = _composite(model, bodies)
        links.append(Link(model.body(body).name, parent, joint, pose, *own, bodies))
    return links


def at_zero(model: mujoco.MjModel, places: Mapping[int, float] | None = None) -> mujoco.MjData:
    """Kinematics with all joints at zero, free bodies upright at the origin.

    Args:
        model: compiled.
        places: coordinates that are not zero, by their address.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    for kind, start in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            data.qpos[start + 3 * (kind == mujoco.mjtJoint.mjJNT_FREE)] = 1.0
    for address, place in (places or {}).items():
        data.qpos[address] = place
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def subtree(model: mujoco.MjModel, root: int) -> list[int]:
    """A body and all below it, parents first."""
    inside = [root]
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in inside:
            inside.append(body)
    return inside


def _composite(
    model: mujoco.MjModel, bodies: Mapping[int, Pose]
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Mass, centre of mass and inertia of bodies that are one."""
    heavy = [b for b in bodies if model.body_mass[b] > MASSLESS]
    if not heavy:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    poses = [bodies[b] @ pose_of(model.body_ipos[b], model.body_iquat[b]) for b in heavy]
    R, places = (np.array(part) for part in zip(*poses, strict=True))
    masses = model.body_mass[heavy]
    com = masses @ places / masses.sum()
    return (
        float(masses.sum()),
        com,
        inertia_about(com, masses, model.body_inertia[heavy], R, places),
    )


def inertia_about(
    point: Float[np.ndarray, "3"],
    masses: Float[np.ndarray, " b"],
    moments: Float[np.ndarray, "b 3"],
    R: Float[np.ndarray, "b 3 3"],
    places: Float[np.ndarray, "b 3"],
) -> Float[np.ndarray, "3 3"]:
    """Inertia [kg m^2] about a point of bodies that are one.

    Args:
        point: [m].
        masses: [kg].
        moments: principal moments of inertia [kg m^2].
        R: axes of these, as columns.
        places: centres of mass [m].
    """
    own = np.einsum("bij,bj,bkj->bik", R, moments, R)
    arm = places - point
    square = np.einsum("bi,bi->b", arm, arm)[:, None, None] * np.eye(3)
    return (own + masses[:, None, None] * (square - arm[:, :, None] * arm[:, None, :])).sum(axis=0)
