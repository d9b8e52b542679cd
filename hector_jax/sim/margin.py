"""The largest delay of the motors with which a robot's loops are stable, from their linear form.

The robot stands as in the middle of a step (`robot.response`), with the joint damping of the hfs.
Every tick the MPC plans stance wrench and touchdowns from the state of the base; every millisecond
the swing legs follow their targets; the torques pass the motors' delay and lag. Of the modes of
the closed loop those count that are faster than the gait: a slower one is for the next step to
catch. The plan is that of the QP without constraints, with the present contacts throughout.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from hector_jax.control import gait
from hector_jax.control.controller import WalkConfig
from hector_jax.control.weights import Weights
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.robot.response import (
    LAG,
    Response,
    cross_matrix,
    planned_inertia,
    response,
    trunk_gain,
)
from hector_jax.sim.loop import substeps
from hector_jax.sim.world import MAX_DELAY, hfs

_DELAYS = [TIME_STEP * count for count in range(round(MAX_DELAY / TIME_STEP) + 1)]  # [s]


class Margin(NamedTuple):
    """Where the loops of a robot lose their stability."""

    # [s] the largest that they bear, in whole milliseconds, at most MAX_DELAY; None: not even zero
    delay: float | None
    frequency: float | None  # [Hz] of the mode that grows with a millisecond more; None: none does


class Loops(NamedTuple):
    """Linear loops about the standing pose, by the plant's x = (z, z') and the base's state."""

    step: Float[np.ndarray, "x x"]  # x after a millisecond without motor torques
    push: Float[np.ndarray, "x j"]  # change of x by the torques at the joints
    base: Float[np.ndarray, "12 x"]  # euler, position, angular velocity, velocity
    held: Float[np.ndarray, "j 12"]  # command by the base's state at the plan
    now: Float[np.ndarray, "j x"]  # command by the present x
    substeps: int  # milliseconds of a tick
    slowest: float  # [Hz] of the modes that count


def step_response(robot: Robot, config: WalkConfig) -> Response:
    """Return the mechanics of a robot in the middle of a step of its gait, on the fewest feet."""
    cycle = jnp.arange(config.gait.cycle)
    contact = min(np.asarray(gait.contact(config.gait, cycle)), key=np.sum)
    return response(robot, np.flatnonzero(contact).tolist())


def loops(robot: Robot, config: WalkConfig, weights: Weights, answer: Response) -> Loops:
    """Return the loops of a robot with a controller.

    Args:
        robot, config, weights: what walks.
        answer: of the robot in the middle of a step, `step_response`.
    """
    N, size = answer.motions, answer.motions.shape[1]
    free = N.T @ answer.mobility  # accelerations z'' by generalised forces, as N is orthonormal
    damped = -float(hfs(robot.description).joint_damping) * free[:, 6:] @ N[6:]
    push = TIME_STEP * np.vstack([TIME_STEP * free[:, 6:], free[:, 6:]])
    step = np.eye(2 * size)
    step[size:, size:] += TIME_STEP * damped
    step[:size, size:] = TIME_STEP * step[size:, size:]  # positions move with the new velocities
    turn_and_travel = np.zeros((6, len(N)))
    turn_and_travel[:3, 3:6] = turn_and_travel[3:, :3] = np.eye(3)
    turn_and_travel[3:, 3:6] = -cross_matrix(robot.com_offset)
    held, now = _swing(robot, config, answer)
    held -= answer.stance_forces[6:] @ _plan_gain(robot, config, weights, answer)
    return Loops(
        step=step,
        push=push,
        base=np.kron(np.eye(2), turn_and_travel @ N),
        held=held,
        now=now,
        substeps=substeps(config),
        slowest=1.0 / (config.gait.tick * config.gait.cycle),
    )


def _plan_gain(
    robot: Robot, config: WalkConfig, weights: Weights, answer: Response
) -> Float[np.ndarray, "u 12"]:
    """Return K of the planned loads -K x on the stance feet: the first of the horizon's steps."""
    dt, wrench, feet = config.mpc_step, answer.wrench, answer.stance
    inertia = config.mpc.planned_inertia(np.asarray(robot.inertia))
    A, B = np.eye(12), np.zeros((12, wrench.shape[1]))
    A[:6, 6:] = dt * np.eye(6)
    B[6:9] = dt * np.linalg.solve(inertia, wrench[3:])
    B[9:] = dt / float(robot.mass) * wrench[:3]
    force, moment = map(np.asarray, weights.R)
    R = np.hstack([force, moment if moment.size else np.zeros_like(force)])
    R, Q = np.diag(R[feet][:, answer.held].ravel()), np.diag(np.concatenate(weights.Q))
    P, K = Q, np.zeros(B.T.shape)
    for _ in range(config.mpc.horizon):
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        P = Q + A.T @ P @ (A - B @ K)
    return K


def _swing(
    robot: Robot, config: WalkConfig, answer: Response
) -> tuple[Float[np.ndarray, "j 12"], Float[np.ndarray, "j x"]]:
    """Return the swing legs' commands half-way by the base's state at the plan and by x.

    The foot's path ends at the touchdown, which moves with the base's state at the plan. The path
    is in the world: what the trunk moves, its foot moves back. The target's rate knows the velocity
    of the trunk, but not its rotation.
    """
    N, j, legs = answer.motions, answer.leg_joints, config.legs
    size, swing = N.shape[1], config.gait.tick * config.gait.swing
    held, now = np.zeros((len(answer.inertia), 12)), np.zeros((len(answer.inertia), 2 * size))
    ahead = (swing + config.gait.tick * config.gait.stance) / 2 + config.footstep.feedback
    touchdown = np.zeros((6, 12))  # moves with position and velocity, horizontally
    touchdown[:2, 3:5], touchdown[:2, 9:11] = np.eye(2), ahead * np.eye(2)
    kp, kd = (np.diag(gains) for gains in (legs.kp, legs.kd))
    rows = list(robot.structure.placed)
    for foot in np.setdiff1d(np.arange(len(answer.lever)), answer.stance):
        twist, dofs = answer.twists[foot], 6 + foot * j + np.arange(j)
        inverse = np.linalg.pinv(twist[rows][:, dofs])
        carried = twist.copy()
        carried[:, 6:] = 0.0  # the foot on the trunk
        stiff = -kp @ (inverse @ carried[rows] @ N + N[dofs])
        carried[:, 3:6] = 0.0
        carried[:3, 3:6] = -cross_matrix(robot.com_offset)  # velocity of the centre of mass
        damped = -kd @ (inverse @ carried[rows] @ N + N[dofs])
        now[dofs - 6] = np.hstack([stiff, damped])
        # s^2 (3 - 2 s) is 1/2 with slope 3/2 half-way
        held[dofs - 6] = (kp / 2 + kd * 1.5 / swing) @ inverse @ touchdown[rows]
    return held, now


def modes(parts: Loops, delay: float, lag: float = LAG) -> Complex[np.ndarray, " n"]:
    """Return the modes that are faster than the gait, the least stable first.

    Args:
        parts: the loops.
        delay, lag: of the motors [s]; see `sim.actuators`.

    Returns:
        Each mode's growth [1/s] and angular frequency [rad/s]: a + b i grows as e^(a t).
    """
    memory, joints = int(np.ceil(delay / TIME_STEP)), len(parts.now)
    size = len(parts.step)
    # state: x, torque after the lag, past commands from the newest on, base's state at the plan
    ends = np.cumsum([size, joints, memory * joints])
    total = ends[-1] + 12
    command = np.zeros((joints, total))
    command[:, :size], command[:, ends[-1] :] = parts.now, parts.held
    weight = np.maximum(1.0 - np.abs(np.arange(memory + 1) - delay / TIME_STEP), 0.0)
    share = 1.0 - np.exp(-TIME_STEP / max(lag, 1e-9))
    past = np.hstack([np.zeros((joints, size + joints)), np.kron(weight[1:], np.eye(joints))])
    torque = share * (weight[0] * command)
    torque[:, : ends[-1]] += share * past
    torque[:, size : size + joints] += (1.0 - share) * np.eye(joints)
    step = np.zeros((total, total))
    step[:size, :size] = parts.step
    step[:size] += parts.push @ torque
    step[size : ends[0] + joints] = torque
    if memory:
        step[ends[1] : ends[1] + joints] = command
        rest = (memory - 1) * joints
        step[ends[1] + joints : ends[2], ends[1] : ends[1] + rest] = np.eye(rest)
    step[ends[2] :, ends[2] :] = np.eye(12)
    plan = np.eye(total)
    plan[ends[2] :] = 0.0
    plan[ends[2] :, :size] = parts.base
    period = parts.substeps * TIME_STEP
    values = np.linalg.eigvals(np.linalg.matrix_power(step, parts.substeps) @ plan)
    rates = np.log(values[np.abs(values) > 1e-9].astype(complex)) / period
    rates = rates[rates.imag > 2 * np.pi * parts.slowest]
    return rates[np.argsort(-rates.real)]


def delay_margin(parts: Loops) -> Margin:
    """Return the largest delay with which the loops are stable, with the lag of slow motors."""
    bears = None
    for delay in _DELAYS:
        growing = [mode for mode in modes(parts, delay) if mode.real > 0.0]
        if growing:
            return Margin(bears, float(growing[0].imag) / (2 * np.pi))
        bears = delay
    return Margin(bears, None)


def softened(
    robot: Robot, config: WalkConfig, weights: Weights, answer: Response
) -> WalkConfig | None:
    """Return a controller whose loops are stable with MAX_DELAY; None if none was found.

    It plans with the inertia of `planned_inertia`, and its legs have no more than the gains needed.

    Args:
        robot, config, weights, answer: as for `loops`.
    """
    Q = weights.Q
    shares = planned_inertia(
        trunk_gain(robot, answer),
        angle=float(np.max(Q.euler)),
        rate=float(np.min(Q.ang_velocity)),
        step=config.mpc_step,
        tick=config.gait.tick,
    )
    inertia = tuple(np.minimum(config.mpc.inertia_share, shares.round(2)).tolist())
    for share in (1.0, 0.8, 0.6, 0.4):
        kp = tuple(_short(share**2 * gain) for gain in config.legs.kp)
        kd = tuple(_short(share * gain) for gain in config.legs.kd)
        mpc, legs = replace(config.mpc, inertia_share=inertia), replace(config.legs, kp=kp, kd=kd)
        softer = replace(config, mpc=mpc, legs=legs)
        if np.all(modes(loops(robot, softer, weights, answer), MAX_DELAY).real <= 0.0):
            return softer
    return None


def _short(x: float) -> float:
    return float(f"{x:.3g}")


def delay_lines(robot: Robot, config: WalkConfig, weights: Weights) -> list[str]:
    """Return the lines about the delay of the motors that the loops bear, and how to bear more."""
    answer = step_response(robot, config)
    bears, frequency = delay_margin(loops(robot, config, weights, answer))
    motors = f"of the motors, with a lag of {1e3 * LAG:g} ms"
    stable = f"not stable with any delay {motors}: it shakes"
    if bears is not None:
        stable = f"stable up to {1e3 * bears:g} ms {motors}"
        if frequency is None:
            return [stable]
        stable += "; later, it shakes"
    lines = [f"{stable} at {frequency:.0f} Hz"]
    softer = softened(robot, config, weights, answer)
    if softer is None:
        return [*lines, "lower mpc.inertia_share, legs.kp and legs.kd, or take faster motors"]
    keys = (("mpc", "inertia_share"), ("legs", "kp"), ("legs", "kd"))
    numbers = {f"{x}.{y}": [getattr(getattr(c, x), y) for c in (config, softer)] for x, y in keys}
    changed = (f"{key} = {list(new)}" for key, (old, new) in numbers.items() if old != new)
    return [*lines, f"for {1e3 * MAX_DELAY:g} ms set {', '.join(changed)}"]
