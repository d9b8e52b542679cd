r"""The walking MPC as the smallest QP: cost and constraints of Eq. 3-4 -> stance inputs -> wrench.

    minimise    sum_{k=1}^{N} |x_k - x_ref,k|^2_Q + sum_{k=0}^{N-1} |u_k|^2_R
    subject to  x_{k+1} = A_k x_k + B_k u_k                                  dynamics
                |F_x| + |F_y| <= mu F_z,   0 <= F_z <= F_max                 each stance foot
                M_x = 0,   -l_t F_z <= M_y <= l_h F_z                       line foot, its yaw frame
                |F_y| <= mu' F_z at toe and heel each                       line foot, its yaw frame
                F = M = 0                                                    each foot in the air

States are condensed away, a foot in the air has no variables and M_x is eliminated, so that a
stance foot has the five inputs (F_x, F_y, F_z, M_y, M_z): F in the world, M in the foot's yaw
frame. `slots` is the number of feet that may stand at once; an empty slot has zero columns and a
unit Hessian, so that shapes stay static.

Where this leaves the paper: x_1..x_N are priced instead of x_0..x_{N-1}, because x_0 is given; toe
and heel of the line foot are in their physical places (pressure at the toe gives M_y = -l_t F_z;
the paper prints them swapped); a foot in the air has no M_z; toe and heel hold by friction each, or
the foot would turn on the spot when the pressure is all at one end. Friction is the pyramid of the
plants, MuJoCo's, whose base is a square on its corner in world axes: the paper's |F_x|, |F_y| <= mu
F_z would ask for sqrt 2 times as much along a diagonal, more than some floors hold. mu' =
mu max(|cos yaw|, |sin yaw|) is the most that it holds across a foot, whatever toe and heel push
against each other along it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hector_jax.control.weights import Weights
from hector_jax.core.geometry import rot_z
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, check
from hector_jax.core.trajectory import State, Wrench, pack_wrench, unpack_wrench
from hector_jax.qp import QP, QpConfig, Solution, block_diagonal, solve_qp
from hector_jax.robot import srbm
from hector_jax.robot.model import Robot


@dataclass(frozen=True)
class MpcConfig:
    """What the MPC is compiled for."""

    horizon: int = 10  # steps N
    step_ticks: int = 3  # ticks per step: dt = 0.03 s
    friction: float = 0.6  # mu; at most the floor's own, or the feet slip
    max_force: float = 500.0  # [N] per foot
    line_friction: bool = True  # toe and heel each hold by friction, or the foot turns on the spot
    effort_about: str = (
        "zero"  # R prices u ("zero", the paper) or u less the weight's share ("weight")
    )
    qp: QpConfig = QpConfig()

    def __post_init__(self) -> None:
        check(
            self,
            horizon=AT_LEAST_ONE,
            step_ticks=AT_LEAST_ONE,
            friction=POSITIVE,
            max_force=POSITIVE,
            effort_about=("zero", "weight"),
        )


class Horizon(NamedTuple):
    """What the MPC plans about: nominal motion, footholds and contact of each step."""

    reference: State  # (N, 3) each, at the end of each step
    euler: Float[Array, "N 3"]  # to linearise about [rad]
    lever: Float[Array, "N 2 3"]  # centre of mass to foot points [m]
    foot_yaw: Float[Array, "N 2"]  # [rad]
    contact: Bool[Array, "N 2"]


def _slot_feet(contact: Float[Array, "2"], slots: int) -> Float[Array, "slots 2"]:
    """Which foot each slot serves, as rows of a selection matrix; all zero for an empty slot."""
    if slots == 2:
        return jnp.diag(contact)
    return jnp.stack([contact[0], contact[1] * (1.0 - contact[0])])[None]


def _double_integrator(N: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and travel after step k by a unit of velocity gained in step j, (N, N) each."""
    steps = np.arange(N)[:, None] - np.arange(N)
    return np.where(steps >= 0, 1.0, 0.0), dt * np.maximum(steps, 0)


def _input_map(feet: Float[Array, "slots 2"], foot_yaw: Float[Array, "2"]) -> Float[Array, "12 b"]:
    """G with u = G v: the slots' inputs (F_x, F_y, F_z, M_y, M_z) to the paper's u."""
    axes = jax.vmap(lambda yaw: rot_z(yaw)[:, 1:])(foot_yaw)  # (2, 3, 2), of the moments
    force = jnp.einsum("sf,xi->fxsi", feet, jnp.eye(3, dtype=feet.dtype))
    moment = jnp.einsum("sf,fxi->fxsi", feet, axes)
    upper = jnp.pad(force, ((0, 0), (0, 0), (0, 0), (0, 2)))
    lower = jnp.pad(moment, ((0, 0), (0, 0), (0, 0), (3, 0)))
    return jnp.stack([upper, lower]).reshape(12, -1)


def _rows(config: MpcConfig, robot: Robot, yaw: Float[Array, ""]) -> Float[Array, "rows 5"]:
    """Constraint rows of a stance foot that points along `yaw`; their bounds are `_bounds`."""
    mu, toe, heel = config.friction, robot.toe, robot.heel
    zero, sin, cos = jnp.zeros_like(yaw), jnp.sin(yaw), jnp.cos(yaw)
    fx, fy, fz, my, mz = jnp.eye(5, dtype=yaw.dtype)
    rows = [
        fx + fy - mu * fz,
        fx + fy + mu * fz,
        fx - fy - mu * fz,
        fx - fy + mu * fz,
        fz,
        my + toe * fz,
        my - heel * fz,
    ]
    if config.line_friction:
        side = jnp.stack([-sin, cos, zero, zero, zero])  # force across the foot
        grip = mu * jnp.maximum(jnp.abs(cos), jnp.abs(sin))
        at_toe, at_heel = mz + heel * side, toe * side - mz
        toe_load, heel_load = grip * (heel * fz - my), grip * (toe * fz + my)
        rows += [at_toe - toe_load, at_toe + toe_load, at_heel - heel_load, at_heel + heel_load]
    return jnp.stack(rows)


def _bounds(config: MpcConfig) -> np.ndarray:
    """Lower and upper bounds of `_rows`, (2, rows)."""
    below, above = (-np.inf, 0.0), (0.0, np.inf)
    sides = [below, above, below, above, (0.0, config.max_force), above, below]
    if config.line_friction:
        sides += [below, above, below, above]
    return np.array(sides).T


def write_qp(
    config: MpcConfig,
    robot: Robot,
    weights: Weights,
    state: State,
    horizon: Horizon,
    dt: float,
    slots: int,
) -> tuple[QP, Float[Array, "12 b"]]:
    """The MPC as a condensed QP, and the map from the first step's inputs to u_0.

    Args:
        config: shape of the problem.
        robot: nominal body.
        weights: Q and R.
        state: base now, x_0.
        horizon: what to plan about.
        dt: MPC step [s].
        slots: feet that may stand at once (static).

    Returns:
        QP in the inputs of all steps, n = N * 5 * slots, constraint rows block-diagonal by step (N,
        rows * slots, 5 * slots); and G_0 with u_0 = G_0 v_0.

    Source: Eq. 3, 4.
    """
    N, b = config.horizon, 5 * slots
    dtype = jnp.result_type(*jax.tree.leaves((weights, state, horizon.lever)), jnp.float32)
    A, B = jax.vmap(lambda e, r: srbm.linearise(robot, e, r, dt))(horizon.euler, horizon.lever)
    feet = jax.vmap(lambda c: _slot_feet(c.astype(dtype), slots))(horizon.contact)
    G = jax.vmap(_input_map)(feet, horizon.foot_yaw)
    # inputs turn the body and push it; rates and velocities are kept, angles and places add them up
    turn, push = B[:, 6:9] @ G, B[:, 9:12] @ G  # (N, 3, b)
    turned = jnp.cumsum(A[:, 0:3, 6:9], axis=0)  # of angles by a rate kept from the start on
    later, travel = (jnp.asarray(table, dtype) for table in _double_integrator(N, dt))
    # angles after step k by a rate that is there from the end of step j on
    angles = later[:, :, None, None] * (turned[:, None] - turned)

    Q, R = weights.Q, pack_wrench(Wrench(*weights.R))
    count = jnp.arange(1, N + 1, dtype=dtype)[:, None]
    rate, speed = state.ang_velocity, state.velocity
    fall = dt * count * jnp.asarray(robot.gravity, dtype)
    free = State(
        state.euler + turned @ rate,
        state.position + dt * count * speed - dt * (count - 1) / 2 * fall,
        jnp.broadcast_to(rate, (N, 3)),
        speed - fall,
    )
    error = jax.tree.map(lambda x, wanted, price: price * (x - wanted), free, horizon.reference, Q)
    effort = jnp.einsum("kui,u,kuj->kij", G, R, G)
    empty = jnp.repeat(1.0 - feet.sum(-1), 5, axis=-1)
    effort = effort + jax.vmap(jnp.diag)(empty)

    wide = jnp.swapaxes(angles, 1, 2).reshape(3 * N, 3 * N)  # rows: step and angle
    both = later.T @ later  # steps that feel both inputs
    turning = wide.T @ (jnp.tile(Q.euler, N)[:, None] * wide)
    turning += jnp.kron(both, jnp.diag(Q.ang_velocity))
    spin = block_diagonal(turn)
    pushing = both[..., None] * Q.velocity + (travel.T @ travel)[..., None] * Q.position
    pushed = jnp.einsum("ixa,ixjb->iajb", push, jnp.einsum("ijx,jxb->ixjb", pushing, push))
    P = spin.T @ (turning @ spin) + pushed.reshape(N * b, N * b) + block_diagonal(effort)
    torque = jnp.einsum("kjxy,kx->jy", angles, error.euler) + later.T @ error.ang_velocity
    force = travel.T @ error.position + later.T @ error.velocity
    q = jnp.einsum("jxb,jx->jb", turn, torque) + jnp.einsum("jxb,jx->jb", push, force)
    if config.effort_about == "weight":
        share = robot.mass * robot.gravity[2] / jnp.maximum(horizon.contact.sum(-1), 1)
        weight = jnp.zeros((N, 12), dtype).at[:, 2].set(share).at[:, 5].set(share)
        q = q - jnp.einsum("kui,u,ku->ki", G, R, weight)

    yaw = jnp.einsum("ksf,kf->ks", feet, horizon.foot_yaw)
    rows = jax.vmap(jax.vmap(lambda yaw: _rows(config, robot, yaw)))(yaw)
    C = jnp.einsum("st,ksri->ksrti", jnp.eye(slots, dtype=dtype), rows).reshape(N, -1, b)
    lower, upper = (jnp.asarray(np.tile(bound, N * slots), dtype) for bound in _bounds(config))
    return QP(2.0 * P, 2.0 * q.reshape(-1), C, lower, upper), G[0]


def solve_mpc(
    config: MpcConfig,
    robot: Robot,
    weights: Weights,
    state: State,
    horizon: Horizon,
    dt: float,
    slots: int,
) -> tuple[Wrench, Solution]:
    """Wrench of the first step [N, N m], world frame, with the solution it was read from."""
    qp, first = write_qp(config, robot, weights, state, horizon, dt, slots)
    solution = solve_qp(qp, config.qp)
    return unpack_wrench(first @ solution.x[: 5 * slots]), solution
