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


def turned(model: mujoco.MjModel, body: Pose, joint: int, angle: float) -> Pose:
    """The pose of a body when a joint of it is at an angle [rad], or a slide at a place [m]."""
    address, axis = model.jnt_qposadr[joint], model.jnt_axis[joint]
    angle -= model.qpos0[address]
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
        return body @ Pose(p=axis * angle)
    quat, anchor = np.zeros(4), model.jnt_pos[joint]
    mujoco.mju_axisAngle2Quat(quat, axis, angle)
    turn = pose_of(np.zeros(3), quat)
    return body @ Pose(turn.R, anchor - turn.R @ anchor)


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
    link_of: dict[int, int] = {}  # joint's or -1, by body
    frames: dict[int, Pose] = {}  # of a link in its parent link, by joint
    parents: dict[int, int] = {-1: -1}
    poses: dict[int, dict[int, Pose]] = {-1: {}}
    for body in subtree(model, root):
        first = model.body_jntadr[body]
        own = [int(first + i) for i in range(model.body_jntnum[body])]
        if body == root:
            link, pose = -1, Pose()
        else:
            parent = int(model.body_parentid[body])
            link = link_of[parent]
            pose = poses[link][parent] @ pose_of(model.body_pos[body], model.body_quat[body])
        for joint in own:
            if joint in joints:
                # at zero of the joint, whatever its reference is
                anchor, frame = Pose(p=model.jnt_pos[joint]), turned(model, pose, joint, 0.0)
                frames[joint], parents[joint] = frame @ anchor, link
                link, pose = joint, Pose(p=-anchor.p)
                poses[joint] = {}
            elif joint in fixed:
                pose = turned(model, pose, joint, fixed[joint])
        link_of[body] = link
        poses[link][body] = pose
    order = [-1, *joints]
    return [
        Link(
            name=model.body(root if joint < 0 else model.jnt_bodyid[joint]).name,
            parent=-1 if joint < 0 else order.index(parents[joint]),
            joint=joint,
            pose=frames.get(joint, Pose()),
            bodies=poses[joint],
            **_composite(model, poses[joint]),
        )
        for joint in order
    ]


def subtree(model: mujoco.MjModel, root: int) -> list[int]:
    """A body and all below it, parents first."""
    inside = [root]
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in inside:
            inside.append(body)
    return inside


def _composite(model: mujoco.MjModel, bodies: Mapping[int, Pose]) -> dict:
    """Mass, centre of mass and inertia of bodies that are one."""
    parts = []
    for body, pose in bodies.items():
        if model.body_mass[body] > MASSLESS:
            own = pose @ pose_of(model.body_ipos[body], model.body_iquat[body])
            spread = own.R @ np.diag(model.body_inertia[body]) @ own.R.T
            parts.append((model.body_mass[body], own.p, spread))
    mass = sum(part[0] for part in parts)
    if not parts:
        return {"mass": 0.0, "com": np.zeros(3), "inertia": np.zeros((3, 3))}
    com = sum(m * p for m, p, _ in parts) / mass
    arms = [p - com for _, p, _ in parts]
    steiner = (
        m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        for (m, _, _), arm in zip(parts, arms, strict=True)
    )
    inertia = sum(spread for _, _, spread in parts) + sum(steiner)
    return {"mass": float(mass), "com": com, "inertia": inertia}
