"""Find the standing pose of a surveyed robot.

The knees are bent by 1 rad from the straight leg, or as far as their range allows, because a
stretched knee is a singularity and heavy legs lift the trunk by 2 to 3 cm. The trunk is upright,
the soles are level, the centre of mass is above the ankles, or the middle of soles that do not
reach under them (of four legs each pair of feet is under the axes that swing its legs forwards),
and all other angles are as small as possible: a least-squares problem in the angles of all legs,
solved with MuJoCo's kinematics, for any order and direction of the axes, wherever on them the
anchors are. If another joint reaches its limit, the knees are bent less.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hector_jax.core.headless import mujoco
from hector_jax.importing.soles import Sole
from hector_jax.importing.survey import Survey, hip
from hector_jax.robot.poses import data_at

KNEE = 1.0  # [rad] of the first trial
_NEARLY_STRAIGHT = 0.1  # [rad] of a knee at zero: offsets of a design, which are no bend
_NEXT_BEND = 0.85  # of that of the trial before
_TRIALS = 9
_MARGIN = 0.03  # [rad] from the limits
_ANGLE_WEIGHT = 1e-3  # in the least-squares problem
_MAX_ROTATION, _MAX_OFFSET = 2e-3, 5e-3  # [rad] of the soles, [m] of the centre of mass
_DIGITS, _ZERO = 4, 2e-4  # of the angles; largest angle that is left out [rad]


def standing_pose(
    survey: Survey, soles: Sequence[Sole], pose: Mapping[str, float] | None = None
) -> tuple[dict[str, float], bool]:
    """Return the angles [rad] that are not zero by joint, and whether soles and balance are right.

    Args:
        survey: of the robot.
        soles: of its feet.
        pose: angles [rad] by joint passed to `find_soles`; None for all joints at zero.
    """
    joints = sum(survey.legs, ())
    angles, solved = np.zeros(len(joints)), False
    for trial in range(_TRIALS):
        angles, solved = _solve(survey, soles, KNEE * _NEXT_BEND**trial, pose)
        if solved:
            break
    rounded = {
        survey.model.joint(j).name: round(float(q), _DIGITS)
        for j, q in zip(joints, angles, strict=True)
    }
    return {name: q for name, q in rounded.items() if abs(q) > _ZERO}, solved


def _solve(
    survey: Survey, soles: Sequence[Sole], bend: float, pose: Mapping[str, float] | None
) -> tuple[Float[np.ndarray, " joints"], bool]:
    """Return the angles of all legs for a knee angle [rad], and whether they are a solution."""
    model, data, joints = survey.model, data_at(survey.model, pose), list(sum(survey.legs, ()))
    feet = []  # body; axes and point of the sole in its frame; joint above it
    for leg, sole in zip(survey.legs, soles, strict=True):
        body = int(model.jnt_bodyid[leg[-1]])
        R, anchor = data.xmat[body].reshape(3, 3), data.xanchor[leg[-1]] - data.xpos[body]
        point = R.T @ (anchor + sole.axes @ sole.under)
        feet.append((body, R.T @ sole.axes, point, hip(data, leg)))
    address, flat = model.jnt_qposadr[joints], len(soles[0].contacts) > 1
    knees = list(range(survey.knee, len(joints), len(survey.legs[0])))
    low, high = _ranges(model, joints)
    start = np.zeros(len(joints))
    for knee, straight, ahead in zip(
        knees, survey.straight, np.repeat(survey.forwards, 2), strict=True
    ):
        sign = np.sign(data.xaxis[joints[knee]][1]) * (1.0 if ahead else -1.0)
        start[knee] = sign * bend + (straight if abs(straight) > _NEARLY_STRAIGHT else 0.0)
    wanted, start = start, np.clip(start, low, high)
    q, free = start.copy(), [i for i in range(len(joints)) if i not in knees]

    def errors(x: Float[np.ndarray, " free"]) -> tuple[np.ndarray, np.ndarray]:
        """Rotations of the soles from level [rad] and offsets of the feet in x [m]."""
        q[free] = x
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        rotations, foot_x, hip_x = [], [], []
        for body, axes, point, joint in feet:
            R, axis, anchor = data.xmat[body].reshape(3, 3), data.xaxis[joint], data.xanchor[joint]
            foot = data.xpos[body] + R @ point
            rotations.append(Rotation.from_matrix(R @ axes).as_rotvec())
            foot_x.append(foot[0])
            hip_x.append((anchor + axis @ (foot - anchor) * axis)[0])  # nearest on the axis
        if len(feet) == 2:
            hip_x = [data.subtree_com[survey.trunk][0]] * 2
        offsets = np.reshape(np.subtract(hip_x, foot_x), (-1, 2)).mean(axis=1)
        return np.concatenate(rotations) * flat, offsets

    def residuals(x: Float[np.ndarray, " free"]) -> np.ndarray:
        rotation, offset = errors(x)
        return np.concatenate([rotation, 5.0 * offset, _ANGLE_WEIGHT * x])

    tolerances = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-13)
    result = least_squares(residuals, start[free], bounds=(low[free], high[free]), **tolerances)
    rotation, offset = (np.abs(error).max() for error in errors(result.x))
    bent = np.allclose(start[knees], wanted[knees], rtol=0, atol=1e-9) or bend <= 0.5
    return q, bool(rotation <= _MAX_ROTATION and offset <= _MAX_OFFSET and bent)


def _ranges(model: mujoco.MjModel, joints: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper limits [rad] of the joints, with a margin."""
    limited = model.jnt_limited[joints].astype(bool)
    low, high = model.jnt_range[joints].T
    margin = np.minimum(_MARGIN, 0.1 * (high - low))
    # ranges of wheels, and those in degrees, go beyond a turn, or are there as a whole
    low, high = np.clip([low + margin, high - margin], -2.0 * np.pi, 2.0 * np.pi)
    limited &= low < high
    return np.where(limited, low, -np.pi), np.where(limited, high, np.pi)
