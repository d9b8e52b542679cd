"""The standing pose of a surveyed robot.

The knees are bent by 1 rad, or as far as their range allows, because a stretched knee is a
singularity and heavy legs lift the trunk by 2 to 3 cm. Trunk upright, soles level, centre of mass
above the foot points, of four legs each pair of feet under its hips instead, all other angles as
small as they can be: a least-squares problem in the angles of all legs, solved on MuJoCo's
kinematics, whatever the order and the turns of the axes.
Where another joint then reaches its limit, the knees are bent less.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hector_jax.core.headless import mujoco
from hector_jax.robot.links import at_zero
from hector_jax.robot.soles import Sole
from hector_jax.robot.survey import Survey

KNEE = 1.0  # [rad]
_LESS = 0.85  # of the bend, per trial
_TRIALS = 9
_MARGIN = 0.03  # [rad] from the limits
_SMALL = 1e-3  # weight of the angles themselves
_SOLVED = (2e-3, 5e-3)  # [rad] of the soles, [m] of the centre of mass
_ROUND, _NOTHING = 4, 2e-4  # digits, [rad]


def standing_pose(
    survey: Survey, soles: Sequence[Sole], seen: Mapping[str, float] | None = None
) -> tuple[dict[str, float], bool]:
    """Angle [rad] by joint, those at zero left out, and whether soles and balance are right.

    Args:
        survey: the robot.
        soles: its feet.
        seen: pose [rad] by joint in which `find_soles` looked at them; all joints at zero if None.
    """
    model, legs = survey.model, [list(leg) for leg in survey.legs]
    bend, angles, right = KNEE, np.zeros(len(legs) * len(legs[0])), False
    for _ in range(_TRIALS):
        angles, right = _solve(survey, soles, bend, seen or {})
        if right:
            break
        bend *= _LESS
    names = [model.joint(j).name for j in sum(legs, [])]
    rounded = {name: round(float(q), _ROUND) for name, q in zip(names, angles, strict=True)}
    return {name: q for name, q in rounded.items() if abs(q) > _NOTHING}, right


def _solve(
    survey: Survey, soles: Sequence[Sole], bend: float, seen: Mapping[str, float]
) -> tuple[Float[np.ndarray, " joints"], bool]:
    """Angles of all legs with the knees at a bend [rad]."""
    model = survey.model
    data = at_zero(model, {int(model.joint(name).qposadr[0]): q for name, q in seen.items()})
    joints = list(sum(survey.legs, ()))
    address, count = model.jnt_qposadr[joints], len(survey.legs[0])
    bodies = [int(model.jnt_bodyid[leg[-1]]) for leg in survey.legs]
    then = [data.xmat[b].reshape(3, 3).copy() for b in bodies]
    local = [R.T @ sole.axes for R, sole in zip(then, soles, strict=True)]  # sole in the body
    anchors = [
        data.xanchor[leg[-1]] - data.xpos[b] for leg, b in zip(survey.legs, bodies, strict=True)
    ]
    points = [
        R.T @ (anchor + sole.axes @ sole.point)
        for R, anchor, sole in zip(then, anchors, soles, strict=True)
    ]
    flat = len(soles[0].contacts) > 1
    knees = list(range(survey.knee, len(joints), count))
    low, high = _ranges(model, joints)
    start = np.clip(np.zeros(len(joints)), low, high)
    for knee, ahead in zip(knees, np.repeat(survey.forwards, 2), strict=True):
        sign = np.sign(data.xaxis[joints[knee]][1]) * (1.0 if ahead else -1.0)
        start[knee] = np.clip(sign * bend, low[knee], high[knee])
    free = [i for i in range(len(joints)) if i not in knees]

    def errors(x: Float[np.ndarray, " free"]) -> tuple[np.ndarray, np.ndarray]:
        q = start.copy()
        q[free] = x
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        turns, ahead = [], []
        for body, own, point in zip(bodies, local, points, strict=True):
            R = data.xmat[body].reshape(3, 3)
            turns.append(Rotation.from_matrix(R @ own).as_rotvec())
            ahead.append((data.xpos[body] + R @ point)[0])
        pairs = np.reshape(ahead, (-1, 2)).mean(axis=1)
        hips = data.xanchor[[leg[0] for leg in survey.legs[::2]], 0]
        above = data.subtree_com[survey.trunk][:1] if len(pairs) == 1 else hips
        return np.concatenate(turns) * flat, above - pairs

    def residuals(x: Float[np.ndarray, " free"]) -> np.ndarray:
        turn, ahead = errors(x)
        return np.concatenate([turn, 5.0 * ahead, _SMALL * x])

    fine = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-13)
    solved = least_squares(residuals, start[free], bounds=(low[free], high[free]), **fine)
    turn, ahead = errors(solved.x)
    q = start.copy()
    q[free] = solved.x
    bent = all(abs(abs(q[k]) - bend) < 1e-9 for k in knees) or bend <= 0.5
    return q, bool(np.abs(turn).max() <= _SOLVED[0] and np.abs(ahead).max() <= _SOLVED[1] and bent)


def _ranges(model: mujoco.MjModel, joints: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Limits [rad] with a margin."""
    limited = model.jnt_limited[joints].astype(bool)
    low, high = model.jnt_range[joints].T
    margin = np.minimum(_MARGIN, 0.1 * (high - low))
    return np.where(limited, low + margin, -np.pi), np.where(limited, high - margin, np.pi)
