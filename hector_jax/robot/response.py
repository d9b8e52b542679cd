"""How fast trunk and legs answer the motors while the robot stands on some of its feet.

Linear, in the standing pose, the stance feet at rest: of the velocities v only those with J v = 0
are possible, J the rows of the stance feet's twists that their contacts hold. With a basis N of
them, generalised forces f accelerate the robot by

    v' = H f,  H = N (N^T M N)^-1 N^T

The plan of the MPC turns the whole robot as one rigid body. Its stance torques turn the trunk and
what the ground holds, and a swing leg follows later, by its own motors: the trunk turns faster than
planned, by `trunk_gain`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import null_space
from scipy.optimize import root_scalar

from hector_jax.core.headless import mujoco
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot, build_model
from hector_jax.robot.poses import standing_data

DELAY, LAG = 0.005, 0.006  # [s] of the slowest motors that the gains are made for
PHASE_MARGIN = np.deg2rad(20.0)  # of the loops with these motors
_HELD = {"point": (), "line": (1, 2), "flat": (0, 1, 2)}  # rotations of a foot that contacts hold


def cross_matrix(a: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix of the cross product a x."""
    return np.cross(np.eye(3), a)


class Response(NamedTuple):
    """The robot's mechanics about its standing pose; v is that of MuJoCo, joints leg by leg."""

    mobility: Float[np.ndarray, "nv nv"]  # H
    motions: Float[np.ndarray, "nv z"]  # N
    twists: Float[np.ndarray, "feet 6 nv"]  # of the feet by v: velocity, angular velocity
    lever: Float[np.ndarray, "feet 3"]  # centre of mass to foot points [m]
    stance: Int[np.ndarray, " s"]  # feet
    held: tuple[int, ...]  # rows of a twist that the contacts of a foot hold
    inertia: Float[np.ndarray, " joints"]  # at each joint, the others locked [kg m^2]
    armature: Float[np.ndarray, " joints"]  # its share that is of the motors

    @property
    def leg_joints(self) -> int:
        """Joints of a leg."""
        return len(self.inertia) // len(self.lever)

    @property
    def swing_dofs(self) -> Int[np.ndarray, " n"]:
        """Indices in v of the swing legs' joints."""
        feet = np.setdiff1d(np.arange(len(self.lever)), self.stance)
        return (6 + feet[:, None] * self.leg_joints + np.arange(self.leg_joints)).ravel()

    @property
    def stance_forces(self) -> Float[np.ndarray, "nv u"]:
        """Generalised forces of the stance legs' motors for ground loads on the held rows."""
        forces = -np.concatenate(self.twists[self.stance][:, self.held]).T
        forces[:6] = 0.0
        forces[self.swing_dofs] = 0.0
        return forces

    @property
    def wrench(self) -> Float[np.ndarray, "6 u"]:
        """Force and moment about the centre of mass for the same loads."""
        maps = []
        for lever in self.lever[self.stance]:
            whole = np.eye(6)
            whole[3:, :3] = cross_matrix(lever)
            maps.append(whole[:, self.held])
        return np.hstack(maps)


def response(robot: Robot, stance: Sequence[int] | None = None) -> Response:
    """Return the mechanics of a robot in its standing pose on the feet `stance`.

    By default it stands as in the middle of a step: on one foot of two, on a diagonal of four.
    """
    description, feet = robot.description, len(robot.foot_point)
    stands = np.array(stance or ((0,) if feet == 2 else (0, 3)))
    _, model = build_model(description, checked=False)
    data, nv = standing_data(description, model), model.nv
    M = np.zeros((nv, nv))
    mujoco.mj_fullM(model, data, M)
    twists, points = np.zeros((feet, 6, nv)), np.zeros((feet, 3))
    for foot, twist, point in zip(description.feet, twists, points, strict=True):
        site = model.site(foot.point).id
        mujoco.mj_jacSite(model, data, twist[:3], twist[3:], site)
        point[:] = data.site_xpos[site]
    held = (0, 1, 2, *(3 + row for row in _HELD[robot.structure.contact]))
    N = null_space(np.concatenate(twists[stands][:, held]))
    return Response(
        mobility=N @ np.linalg.solve(N.T @ M @ N, N.T),
        motions=N,
        twists=twists,
        lever=points - data.subtree_com[model.jnt_bodyid[0]],
        stance=stands,
        held=held,
        inertia=M.diagonal()[6:],
        armature=model.dof_armature[6:],
    )


def trunk_gain(robot: Robot, answer: Response) -> Float[np.ndarray, "3"]:
    """Return the trunk's acceleration about x, y and z as a multiple of that of the rigid body.

    Both under stance torques for a moment about the same axis, the swing legs limp.
    """
    planned = np.linalg.solve(robot.inertia, answer.wrench[3:])
    turned = (answer.mobility @ answer.stance_forces)[3:6]
    return np.diag(turned @ np.linalg.pinv(planned))


def largest_gain(corner: float, hold: float) -> float:
    """Return the largest gain g [1/s] with which a loop of two integrators has PHASE_MARGIN.

        g (s + corner) / s^2  e^(-s (DELAY + hold / 2)) / (1 + s LAG)

    Args:
        corner: ratio of stiffness to damping [rad/s].
        hold: how long a command lasts [s].
    """

    def excess(rate: float) -> float:
        late = (DELAY + hold / 2) * rate + np.arctan(LAG * rate)
        return float(np.arctan2(rate, corner) - late - PHASE_MARGIN)

    rates = np.geomspace(1e-3, 1.0) / DELAY
    best = max(rates, key=excess)  # from here on the phase falls
    if excess(best) <= 0.0:
        return 0.0
    rate = root_scalar(excess, bracket=(best, 1.0 / DELAY)).root
    return rate**2 * float(np.hypot(1.0, LAG * rate) / np.hypot(rate, corner))


def swing_frequency(answer: Response) -> float:
    """Return the largest w [rad/s] of kp = I w^2, kd = I w with which swing legs have PHASE_MARGIN.

    With gains in proportion to the inertia I at each joint, the joints of a swing leg, coupled by
    its masses, are loops of their own, one for each eigenvalue a of H diag(I):

        a w (s + w) / s^2  e^(-s delay) / (1 + s lag)

    The largest a is the fastest loop, which has the least margin.
    NaN: there is no such w, because a mass or an inertia is out of all proportion.
    """
    dofs = answer.swing_dofs
    coupled = answer.mobility[np.ix_(dofs, dofs)] * answer.inertia[dofs - 6]
    a = float(np.linalg.eigvals(coupled).real.max())

    def excess(w: float) -> float:
        return largest_gain(w, TIME_STEP) - a * w

    bracket = 1e-3, 0.5 / DELAY
    if not excess(bracket[0]) > 0.0 > excess(bracket[1]):
        return np.nan
    return root_scalar(excess, bracket=bracket).root


def planned_inertia(
    gain: Float[np.ndarray, "3"], *, angle: float, rate: float, step: float, tick: float
) -> Float[np.ndarray, "3"]:
    """Return the shares of the robot's inertia to plan with, so that its attitude has PHASE_MARGIN.

    With small R the plan takes in one step dt the rate from omega to -kappa (theta + dt omega),
    which minimises angle |theta|^2 + rate |omega|^2 over all steps: a regulator with the damping
    (1 + kappa dt) / dt, which the trunk answers times `gain`.

    Args:
        gain: of the trunk, `trunk_gain`.
        angle, rate: weights of the MPC.
        step, tick: of the MPC and of its plans [s].
    """
    ratio = rate / angle  # of p = angle (cost of theta^2): p^2 - p - ratio / dt^2 = 0
    p = (1.0 + np.sqrt(1.0 + 4.0 * ratio / step**2)) / 2.0
    kappa = p * step / (ratio + p * step**2)
    damping = (1.0 + kappa * step) / step
    largest = largest_gain(kappa / (1.0 + kappa * step), tick)
    # all of it about an axis that the legs cannot turn, where the gain is zero
    return largest / np.maximum(largest, damping * gain)
