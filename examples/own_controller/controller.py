"""A walking controller of one's own for HECTOR: convex MPC of a rigid body, in numpy and MuJoCo.

Every 10 ms the MPC plans the wrenches of the feet that stand; every millisecond the joints get the
torques of these wrenches, and those that move the other foot to its next foothold. The state of the
rigid body is x = (roll, pitch, yaw; position; angular velocity; velocity; 1), its input is
u = (force left, force right; moment left, moment right), all in the world frame.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import daqp
import mujoco
import numpy as np

MODEL = Path(__file__).parents[2] / "assets" / "hector.xml"
SIDES = ("left", "right")
PARTS = {13: ("euler", "position", "ang_velocity", "velocity"), 6: ("force", "moment")}

HORIZON, MPC_STEP = 10, 0.025  # [s]
PERIOD, PLAN_STEPS = 0.001, 10  # [s] of torques; number of them from plan to plan
FRICTION, TWIST, MOST_FORCE = 0.5, 0.03, 500.0  # M_z / F_z [m]; [N]
TOE, HEEL = 0.09, 0.06  # [m] from the foot point

STAND, IN_PLACE = 0.1, 0.4  # [s] before t = 0: on both feet, then steps without a command
WIDTH, LANDING = 0.08, -0.005  # [m] of a foot from the middle; of the foot point at touchdown
SOFTER = np.array([1.0, 1.0, 1.0, 1.0, 3.0])  # gains of a leg's joints, hip yaw to ankle, over this
STANCE_DAMPING = 0.1  # [N m s/rad]
NUMBERS = {  # that a tuning may change too
    "STEP": 0.2,  # [s] of a stance, and of a swing
    "FEEDBACK": 0.12,  # [s] of a foothold on the error of the velocity
    "APEX": 0.08,  # [m] height of the foot point in mid-swing
    "KP": 60.0,  # [N m/rad]
    "KD": 1.5,  # [N m s/rad]
}


def skew(x: np.ndarray) -> np.ndarray:
    """Return the matrix of the cross product with x (3,)."""
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])


def rot_z(yaw: float) -> np.ndarray:
    """Return the rotation about the vertical by an angle [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation(euler: np.ndarray) -> np.ndarray:
    """Return the rotation of roll, pitch and yaw [rad]."""
    (cr, cp, _), (sr, sp, _) = np.cos(euler), np.sin(euler)
    tilt = np.array([[cp, sp * sr, sp * cr], [0.0, cr, -sr], [-sp, cp * sr, cp * cr]])
    return rot_z(euler[2]) @ tilt


def wrap(angle: float) -> float:
    """Return the angle [rad] within half a turn."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def smooth(s: float) -> tuple[float, float]:
    """Return a share that grows from 0 to 1 with s, at rest at both ends, and its slope."""
    return s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s)


def named(name: str, x: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parts of a state (13,), or of the wrenches of the feet (2, 6), by their names."""
    return {f"{name}.{p}": x[..., 3 * i : 3 * i + 3] for i, p in enumerate(PARTS[x.shape[-1]])}


class Controller:
    """The controller, with a model of the robot of its own; t = 0 comes STAND + IN_PLACE later."""

    def __init__(self, weights: Mapping[str, Mapping], command: Mapping[str, Sequence]) -> None:
        """Take weights {"Q": .., "R": .., "others": ..} and a command, whose pieces repeat."""
        self.model = model = mujoco.MjModel.from_xml_path(str(MODEL))
        self.data = data = mujoco.MjData(model)
        self.sites = [model.site(f"{side}_foot_point").id for side in SIDES]
        Q, R = weights["Q"], weights["R"]
        self.Q = np.array([*np.ravel([Q[name] for name in PARTS[13]]), 0.0])
        self.R = np.concatenate([np.ravel(R[name]) for name in PARTS[6]])
        self.numbers = NUMBERS | weights.get("others", {})
        self.command = {name: np.array(values) for name, values in command.items()}
        # the rigid body: the robot as it stands
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        self.mass, self.height = M[0, 0], data.subtree_com[1, 2]
        self.offset = data.subtree_com[1] - data.qpos[:3]  # of the centre of mass, trunk's axes
        self.inertia = M[3:6, 3:6] + self.mass * skew(self.offset) @ skew(self.offset)
        # memory
        self.yaw, self.contact = 0.0, np.ones(2, bool)
        self.wrench = np.zeros((2, 6))  # planned: force and moment of the ground on each foot
        self.lift = np.zeros((2, 4))  # position and yaw of each foot when it left the floor

    def stands(self, time: float) -> np.ndarray:
        """Return which feet are planned to stand (2,); t = 0 is the start of the command."""
        left = (time + IN_PLACE + 1e-9) // self.numbers["STEP"] % 2 == 0
        return np.array([left, not left]) | (time < -IN_PLACE - 1e-9)

    def wanted(self, time: float) -> tuple[np.ndarray, float]:
        """Return the commanded velocity (3,) in the robot's frame and yaw rate."""
        if time < 0.0:
            return np.zeros(3), 0.0
        ends = np.cumsum(self.command["duration"])
        piece = min(np.searchsorted(ends, time % ends[-1], side="right"), len(ends) - 1)
        return np.append(self.command["velocity"][piece], 0.0), self.command["yaw_rate"][piece]

    def state(self, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Return x; its yaw goes on from that of the last call."""
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, qpos[3:7])
        R = R.reshape(3, 3)
        self.yaw += wrap(np.arctan2(R[1, 0], R[0, 0]) - self.yaw)
        euler = np.arctan2(R[2, 1], R[2, 2]), -np.arcsin(np.clip(R[2, 0], -1.0, 1.0)), self.yaw
        offset, rate = R @ self.offset, R @ qvel[3:6]
        velocity = qvel[:3] + np.cross(rate, offset)
        return np.concatenate([euler, qpos[:3] + offset, rate, velocity, [1.0]])

    def reference(self, time: float, x: np.ndarray) -> np.ndarray:
        """Return HORIZON + 1 states (n, 13): from x, y and yaw of now on with the command."""
        velocity, rate = self.wanted(time)
        states = np.zeros((HORIZON + 1, 13))
        states[:, 2], states[:, 8] = x[2] + rate * MPC_STEP * np.arange(HORIZON + 1), rate
        states[:, 9:12] = [rot_z(yaw) @ velocity for yaw in states[:, 2]]
        states[:, 3:6] = *x[3:5], self.height
        states[1:, 3:6] += MPC_STEP * np.cumsum(states[:-1, 9:12], axis=0)
        return states

    def torques(self, time: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        """Return the torques of the joints [N m]; to be called each millisecond."""
        model, data = self.model, self.data
        data.qpos[:], data.qvel[:] = qpos, qvel
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            update(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        x, now = self.state(qpos, qvel), self.stands(time)
        feet = data.site_xpos[self.sites]
        toes = data.site_xmat[self.sites][:, [0, 3, 6]]  # where they point
        yaws = np.arctan2(toes[:, 1], toes[:, 0])
        lifts = self.contact & ~now
        self.lift[lifts], self.contact = np.column_stack([feet, yaws])[lifts], now
        if round((time + STAND + IN_PLACE) / PERIOD) % PLAN_STEPS == 0:
            self.wrench = self.plan(time, x, feet, yaws)
        torque, J = np.zeros(10), np.zeros((6, model.nv))
        for foot, site in enumerate(self.sites):
            mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
            leg = slice(5 * foot, 5 * foot + 5)
            own = J[:, 6:][:, leg]
            if now[foot]:
                torque[leg] = -own.T @ self.wrench[foot] - STANCE_DAMPING * qvel[6:][leg]
                continue
            pose = np.array([*feet[foot], -np.arcsin(np.clip(toes[foot, 2], -1, 1)), yaws[foot]])
            target, speed = self.swing(time, x, foot)
            error = target - pose
            error[4] = wrap(error[4])
            rows = np.eye(6)[[0, 1, 2, 4, 5]]  # of position, pitch and yaw
            rows[3, 3:] = rot_z(yaws[foot])[:, 1]
            A = rows @ own
            change = np.column_stack([error, speed - rows @ J @ qvel])
            change = A.T @ np.linalg.solve(A @ A.T + 1e-4 * np.eye(5), change)  # of the joints
            kp, kd = (self.numbers[name] / SOFTER for name in ("KP", "KD"))
            torque[leg] = kp * change[:, 0] + kd * change[:, 1] + data.qfrc_bias[6:][leg]
        limit = model.actuator_ctrlrange[:, 1]
        return np.clip(torque, -limit, limit)

    def swing(self, time: float, x: np.ndarray, foot: int) -> tuple[np.ndarray, np.ndarray]:
        """Return where a foot in the air should be, and its speed: x, y, z, pitch, yaw."""
        step, apex = self.numbers["STEP"], self.numbers["APEX"]
        s, start = (time + IN_PLACE + 1e-9) % step / step, self.lift[foot]
        end, yaw = self.foothold(time, x, foot)
        way = np.array([*(end - start[:3]), 0.0, wrap(yaw - start[3])])
        share, slope = smooth(s)
        target = np.array([*start[:3], 0.0, start[3]]) + share * way
        speed = slope / step * way
        rise, climb = smooth(1.0 - abs(1.0 - 2.0 * s))
        floor = start[2] if s < 0.5 else LANDING
        target[2] = floor + rise * (apex - floor)
        speed[2] = np.sign(0.5 - s) * 2.0 * climb / step * (apex - floor)
        return target, speed

    def foothold(self, time: float, x: np.ndarray, foot: int) -> tuple[np.ndarray, float]:
        """Return the next foothold of a foot (3,), and its yaw; its height does not count."""
        step = self.numbers["STEP"]
        travel = step - (time + IN_PLACE + 1e-9) % step + 0.5 * step
        velocity, rate = self.wanted(time)
        yaw = x[2] + rate * travel
        end = x[3:6] + rot_z(yaw) @ [0.0, WIDTH * (1 - 2 * foot), 0.0] + x[9:12] * travel
        return end + self.numbers["FEEDBACK"] * (x[9:12] - rot_z(x[2]) @ velocity), yaw

    def plan(self, time: float, x: np.ndarray, feet: np.ndarray, yaws: np.ndarray) -> np.ndarray:
        """Solve the MPC; return force and moment of the ground on each foot now (2, 6)."""
        pitch, yaw = x[1:3]
        axes = rotation(x[:3])
        A, B = np.eye(13), np.zeros((13, 12))
        A[:3, 6:9] = MPC_STEP * rot_z(yaw).T
        A[:3, 6:9] = np.diag([1 / np.cos(pitch), 1, 1]) @ A[:3, 6:9]
        A[2, 6:9] += np.sin(pitch) * A[0, 6:9]
        A[3:6, 9:12], A[11, 12] = MPC_STEP * np.eye(3), -9.81 * MPC_STEP
        turn = MPC_STEP * np.linalg.inv(axes @ self.inertia @ axes.T)
        for force, foot in ((slice(0, 3), feet[0]), (slice(3, 6), feet[1])):
            B[6:9, force], B[6:9, 6:][:, force] = turn @ skew(foot - x[3:6]), turn
            B[9:12, force] = MPC_STEP / self.mass * np.eye(3)
        # the variables: (F_x, F_y, F_z, M_y, M_z) in the frame of each foot that stands in a step
        contacts = [self.stands(time + MPC_STEP * k) for k in range(HORIZON)]
        pairs = [(k, foot) for k in range(HORIZON) for foot in np.flatnonzero(contacts[k])]
        n = 5 * len(pairs)
        inputs = np.zeros((HORIZON, 2, 2, 3, n))  # u of each step by the variables
        for i, (k, foot) in enumerate(pairs):
            frame = rot_z(yaws[foot])
            inputs[k, 0, foot, :, 5 * i : 5 * i + 3] = frame
            inputs[k, 1, foot, :, 5 * i + 3 : 5 * i + 5] = frame[:, 1:]
        u = inputs.reshape(HORIZON, 12, n)
        free, effect = [x], [np.zeros((13, n))]
        for k in range(HORIZON):
            free.append(A @ free[k])
            effect.append(A @ effect[k] + B @ u[k])
        G, away = np.array(effect[1:]), np.array(free[1:]) - self.reference(time, x)[1:]
        QG, Ru = (self.Q[:, None] * G).reshape(-1, n), (self.R[:, None] * u).reshape(-1, n)
        P = G.reshape(-1, n).T @ QG + u.reshape(-1, n).T @ Ru
        side, load = np.eye(5)[[0, 1, 4]], np.outer([FRICTION, FRICTION, TWIST], np.eye(5)[2])
        # the pressure is between toe, where M_y is below zero, and heel
        sole = np.array([[0.0, 0.0, -TOE, -1.0, 0.0], [0.0, 0.0, -HEEL, 1.0, 0.0]])
        rows = np.kron(np.eye(len(pairs)), np.concatenate([side - load, -side - load, sole]))
        low, high = np.full(n + len(rows), -1e30), np.append(np.full(n, 1e30), np.zeros(len(rows)))
        low[2:n:5], high[2:n:5] = 0.0, MOST_FORCE
        v, _, flag, _ = daqp.solve(P, QG.T @ away.ravel(), rows, high, low)
        if flag < 1:  # not solved: what was planned before
            return self.wrench * contacts[0][:, None]
        return np.concatenate(inputs[0] @ v, axis=1)
