r"""The walking MPC as the smallest QP: cost and constraints of Eq. 3-4 -> stance inputs -> wrench.

    minimise    sum_{k=1}^{N} |x_k - x_ref,k|^2_Q + sum_{k=0}^{N-1} |u_k|^2_R + own costs
    subject to  x_{k+1} = A_k x_k + B_k u_k            dynamics
                lower <= C u_k <= upper                each stance foot: `contact`
                F = M = 0                              each foot in the air

States are eliminated. Feet in the air have no variables, nor do wrench components outside the
contact model. If fewer feet stand than `max_contacts`, the inputs of the others have zero columns
and a unit Hessian, so that shapes stay static.

Unlike the paper: the cost is on x_1..x_N, because x_0 is given; a foot in the air has no M_z; the
reference may be shifted, see `controller`; also `contact`, `twin`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.contact import (
    LINE_FOOT,
    LINE_FRICTION,
    Constraint,
    Contact,
    ContactModel,
    Cost,
    Rows,
    Squares,
    Step,
    rows,
)
from hector_jax.control.disturbance import NO_DISTURBANCE, IntegralGains
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import rot_z
from hector_jax.core.inputs import InputError, short_repr
from hector_jax.core.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, SHARE, Range, check
from hector_jax.core.trajectory import Disturbance, State, Wrench, pack_wrench, unpack_wrench
from hector_jax.qp import QP, QpConfig, Solution, block_diagonal, solve_qp
from hector_jax.robot import srbm
from hector_jax.robot.model import Robot


class MpcParameters(NamedTuple):
    """Traced numbers of the MPC."""

    weights: Weights  # Q and R
    friction: Any  # mu
    max_force: Any  # [N] per foot
    effort_reference: Any  # share of the robot's weight in the force reference of R
    position_limit: Any  # [m] see `controller.limit_errors`
    yaw_limit: Any  # [rad]
    integral: IntegralGains
    costs: Mapping[str, Any] = {}  # factors on the weights of the own costs, by name


class _Default(tuple):
    """Constraints that nobody has named: those of the contact model, also after `replace`."""


@dataclass(frozen=True)
class MpcConfig:
    """Static configuration of the MPC, and the defaults of its numbers."""

    horizon: Annotated[int, AT_LEAST_ONE] = 10  # steps N
    step_ticks: Annotated[int, AT_LEAST_ONE] = 3  # ticks per step: dt = 0.03 s
    friction: Annotated[float, POSITIVE] = 0.6  # mu; larger than the floor's, the feet slip
    max_force: Annotated[float, POSITIVE] = 500.0  # [N] per foot
    sole_width: Annotated[float, SHARE] = 1.0  # share of a flat sole's half width in the plan
    inertia_share: tuple[float, ...] = (1.0, 1.0, 1.0)  # of the robot's, x, y, z, in the plan
    twist: Annotated[float, NOT_NEGATIVE] = 0.03  # [m] M_z per F_z, of the constraint "twist"
    line_friction: bool = True  # False removes LINE_FRICTION from the constraints
    effort_reference: str = "zero"  # cost on u (paper); "gravity": on u minus the weight's share
    position_limit: float | None = None  # [m] largest horizontal error that counts; None: any
    yaw_limit: Annotated[float, POSITIVE] = 0.3  # [rad] largest heading error that counts
    horizontal_gain: Annotated[float, NOT_NEGATIVE] = 0.0  # [1/s^3] of `IntegralGains`, as below
    height_gain: Annotated[float, NOT_NEGATIVE] = 0.0
    tilt_gain: Annotated[float, NOT_NEGATIVE] = 0.0
    yaw_gain: Annotated[float, NOT_NEGATIVE] = 0.0
    integral_limit: Annotated[float, POSITIVE] = 4.9  # [m/s^2] half the weight; see `IntegralGains`
    qp: QpConfig = QpConfig()
    contact: ContactModel = LINE_FOOT
    constraints: tuple[Constraint, ...] = ()  # none: those of the contact model
    costs: tuple[Cost, ...] = ()  # beside Q and R

    def __post_init__(self) -> None:
        unnamed = not self.constraints or isinstance(self.constraints, _Default)
        share, words = Range(0.0, 1.0, above=True), ("zero", "gravity")
        check(self, position_limit=POSITIVE, effort_reference=words, inertia_share=share)
        if len(got := self.inertia_share) != 3:
            raise InputError(f"MpcConfig.inertia_share must be 3 numbers, got {short_repr(got)}")
        if unnamed:
            object.__setattr__(self, "constraints", _Default(self.contact.constraints))
        if not self.on("inputs"):
            text = "MpcConfig.constraints must have one on the inputs, or feet can pull"
            raise InputError(f"{text}, got {self.constraints}")

    def parameters(self, weights: Weights) -> MpcParameters:
        """Return the traced numbers."""
        names = ("horizontal_gain", "height_gain", "tilt_gain", "yaw_gain", "integral_limit")
        integral = IntegralGains(*(getattr(self, name) for name in names))
        limit = math.inf if self.position_limit is None else self.position_limit
        costs = {str(cost): 1.0 for cost in self.costs}
        bounds = self.friction, self.max_force
        share = float(self.effort_reference == "gravity")
        return MpcParameters(weights, *bounds, share, limit, self.yaw_limit, integral, costs)

    def planned_inertia(self, inertia: Float[Any, "3 3"]) -> Float[Any, "3 3"]:
        """Return the inertia [kg m^2] that the plan turns, from that of the whole robot."""
        root = np.sqrt(self.inertia_share)
        return inertia * np.outer(root, root).astype(inertia.dtype)

    def on(self, what: str) -> tuple[Constraint, ...]:
        """Return the constraints on "inputs" or on "states"."""
        excluded = () if self.line_friction else (LINE_FRICTION,)
        return tuple(c for c in self.constraints if c.on == what and c not in excluded)


class Horizon(NamedTuple):
    """Nominal motion, footholds and contact schedule over the steps of the MPC."""

    reference: State  # (N, 3) each, at the end of each step
    euler: Float[Array, "N 3"]  # linearisation point [rad]
    lever: Float[Array, "N feet 3"]  # centre of mass to foot points [m]
    foot_yaw: Float[Array, "N feet"]  # [rad]
    contact: Bool[Array, "N feet"]
    inputs: Bool[Array, "N feet"] | None = None  # feet that have inputs; None: those in contact
    frame: Float[Array, "3 3"] | None = None  # of all constraints and moments; None: yaw of feet


class MpcProblem(NamedTuple):
    """Data of the MPC in one tick."""

    robot: Robot  # nominal body
    parameters: MpcParameters
    state: State  # current base state x_0
    horizon: Horizon
    disturbance: Disturbance = NO_DISTURBANCE  # constant over the horizon


class Condensed(NamedTuple):
    """The states as functions of the inputs v: x = free + map v."""

    feet: Float[Array, "N contacts feet"]  # foot of each contact
    inputs: Float[Array, "N u b"]  # G_k with u_k = G_k v_k
    turn: Float[Array, "N 3 b"]  # change of angular velocity in a step by its inputs
    push: Float[Array, "N 3 b"]  # change of velocity in a step by its inputs
    angles: Float[Array, "N N 3 3"]  # angles after step k per angular velocity gained in step j
    later: Float[Array, "N N"]  # velocity after step k per velocity gained in step j
    travel: Float[Array, "N N"]  # distance after step k per velocity gained in step j
    free: State  # (N, 3) each, without inputs
    own: Squares | None = None  # costs beside Q and R, of all inputs


def feet_of_contacts(
    contact: Float[Array, " feet"], max_contacts: int
) -> Float[Array, "contacts feet"]:
    """Return the selection matrix from feet to contacts; rows without a foot are zero.

    Contact c belongs to the c-th foot in stance; if all feet may stand, each has its own contact.
    """
    if max_contacts == len(contact):
        return jnp.diag(contact)
    rank = jnp.cumsum(contact) - contact  # number of stance feet with a lower index
    return contact * (rank == jnp.arange(max_contacts)[:, None])


def _double_integrator(N: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity and travel after step k per unit of velocity gained in step j, (N, N)."""
    steps = np.arange(N)[:, None] - np.arange(N)
    return np.where(steps >= 0, 1.0, 0.0), dt * np.maximum(steps, 0)


def _input_map(
    model: ContactModel, horizon: Horizon, feet: Float[Array, "contacts feet"], foot_yaw: Array
) -> Float[Array, "u b"]:
    """Return G in u = G v, from the inputs of the contacts to the paper's u."""
    force, moment = jax.vmap(lambda yaw: model.wrench(yaw, horizon.frame))(foot_yaw)
    parts = [contract("sf,fxi->fxsi", feet, part) for part in (force, moment)]
    return jnp.stack(parts).reshape(6 * len(foot_yaw), -1)


def condense(config: MpcConfig, problem: MpcProblem, dt: float, max_contacts: int) -> Condensed:
    """Condense the dynamics: the states as functions of the inputs. Source: Eq. 4a."""
    N, (robot, parameters, state, horizon, disturbance) = config.horizon, problem
    data = parameters.weights, state, horizon.lever
    dtype = jnp.result_type(*jax.tree.leaves(data), jnp.float32)
    robot = robot._replace(inertia=config.planned_inertia(robot.inertia))
    A, B = jax.vmap(lambda e, r: srbm.linearise(robot, e, r, dt))(horizon.euler, horizon.lever)
    inputs = horizon.contact if horizon.inputs is None else horizon.inputs
    feet = jax.vmap(lambda c: feet_of_contacts(c.astype(dtype), max_contacts))(inputs)
    G = jax.vmap(partial(_input_map, config.contact, horizon))(feet, horizon.foot_yaw)
    # inputs change rates and velocities, which persist; angles and positions integrate them
    changes = B[:, 6:9], B[:, 9:12]
    turn, push = (contract("kxu,kub->kxb", change, G) for change in changes)
    angle_by_rate = jnp.cumsum(A[:, 0:3, 6:9], axis=0)  # for a rate that is constant from t_0 on
    later, travel = (jnp.asarray(table, dtype) for table in _double_integrator(N, dt))
    # angles after step k per rate that is constant from the end of step j on
    angles = later[:, :, None, None] * (angle_by_rate[:, None] - angle_by_rate)
    count = jnp.arange(1, N + 1, dtype=dtype)[:, None]
    from_yaw_frame = rot_z(jnp.asarray(state.euler[2]))
    gained = dt * contract("xy,y->x", from_yaw_frame, disturbance.angular)
    pull = contract("xy,y->x", from_yaw_frame, disturbance.linear)
    gravity = jnp.asarray(robot.gravity, dtype) - pull
    fall = dt * count * gravity
    free = State(
        state.euler
        + contract("kxy,y->kx", angle_by_rate, state.ang_velocity)
        + contract("kjxy,y->kx", angles, gained),
        state.position + dt * count * state.velocity - dt * (count - 1) / 2 * fall,
        state.ang_velocity + count * gained,
        state.velocity - fall,
    )
    condensed = Condensed(feet, G, turn, push, angles, later, travel, free)
    return condensed._replace(own=own_costs(config, problem, condensed) if config.costs else None)


def input_weights(weights: Weights) -> Float[Array, " u"]:
    """Return R for the paper's u, with zeros for the moments of point feet."""
    force, moment = weights.R
    return pack_wrench(Wrench(force, moment if moment.size else jnp.zeros_like(force)))


def half_slope(
    config: MpcConfig, problem: MpcProblem, condensed: Condensed, v: Float[Array, "N b"]
) -> Float[Array, "N b"]:
    """Return half of P v + q, without forming P. Source: Eq. 3."""
    robot, parameters, _, horizon, _ = problem
    _, G, turn, push, angles, later, travel, free, own = condensed
    Q, R = parameters.weights.Q, input_weights(parameters.weights)
    turned, pushed = (contract("kxb,kb->kx", change, v) for change in (turn, push))
    moved = State(
        contract("kjxy,jy->kx", angles, turned), travel @ pushed, later @ turned, later @ pushed
    )
    states = jax.tree.map(jnp.add, free, moved)
    error = jax.tree.map(lambda x, target, w: w * (x - target), states, horizon.reference, Q)
    torque = contract("kjxy,kx->jy", angles, error.euler)
    torque = torque + contract("kj,kx->jx", later, error.ang_velocity)
    force = contract("kj,kx->jx", travel, error.position)
    force = force + contract("kj,kx->jx", later, error.velocity)
    share = robot.mass * robot.gravity[2] / jnp.maximum(horizon.contact.sum(-1), 1)
    up = np.zeros((2, horizon.contact.shape[1], 3))  # forces and moments
    up[0, :, 2] = 1.0
    weight = share[:, None] * jnp.asarray(up.ravel(), later.dtype)
    effort = contract("kui,ki->ku", G, v) - parameters.effort_reference * weight
    slope = contract("jxb,jx->jb", turn, torque) + contract("jxb,jx->jb", push, force)
    slope = slope + contract("kui,u,ku->ki", G, R, effort) + _no_foot(config, condensed) * v
    if own is not None:
        A, target, weight = own
        slope += (A.T @ (weight * (A @ v.ravel() - target))).reshape(v.shape)
    return slope


def _no_foot(config: MpcConfig, condensed: Condensed) -> Float[Array, "N b"]:
    """Return 1 for the inputs of contacts without a foot, else 0."""
    return jnp.repeat(1.0 - condensed.feet.sum(-1), config.contact.inputs, axis=-1)


def half_hessian(
    config: MpcConfig, problem: MpcProblem, condensed: Condensed
) -> Float[Array, "n n"]:
    """Return half of P. Source: Eq. 3."""
    _, G, turn, push, angles, later, travel, _, own = condensed
    N, b, weights = config.horizon, G.shape[-1], problem.parameters.weights
    Q, R = weights.Q, input_weights(weights)
    effort = contract("kui,u,kuj->kij", G, R, G) + jax.vmap(jnp.diag)(_no_foot(config, condensed))
    wide = jnp.swapaxes(angles, 1, 2).reshape(3 * N, 3 * N)  # rows: step and angle
    overlap = later.T @ later  # number of steps that two inputs both affect
    turning = wide.T @ (jnp.tile(Q.euler, N)[:, None] * wide)
    turning += jnp.kron(overlap, jnp.diag(Q.ang_velocity))
    turned = contract("ixjy,jyb->ixjb", turning.reshape(N, 3, N, 3), turn)
    pushing = overlap[..., None] * Q.velocity + (travel.T @ travel)[..., None] * Q.position
    parts = (turn, push), (turned, contract("ijx,jxb->ixjb", pushing, push))
    change, changed = (jnp.concatenate(part, axis=1) for part in parts)
    P = contract("ixa,ixjb->iajb", change, changed).reshape(N * b, -1) + block_diagonal(effort)
    if own is not None:
        A, _, weight = own
        P += A.T @ (weight[:, None] * A)
    return P


def _on_contacts(
    config: MpcConfig, problem: MpcProblem, condensed: Condensed, parts: Sequence[Any]
) -> tuple[Array, ...]:
    """Return rows of parts on inputs, block-diagonal by step (N, rows, b), and their numbers."""
    feet, (robot, parameters, _, horizon, _) = condensed.feet, problem
    robot = robot._replace(half_width=config.sole_width * robot.half_width)

    def of_contact(yaw: Float[Array, ""], max_force: Float[Array, ""]) -> tuple[Array, ...]:
        force, moment, yaw = config.contact.in_frame(yaw, horizon.frame)
        contact = Contact(force, moment, yaw, robot, parameters.friction, max_force, config.twist)
        each = [rows(part, contact, feet) for part in parts]
        return tuple(map(jnp.concatenate, zip(*each, strict=True)))

    yaw, stands = contract("ksf,kf->ks", feet, horizon.foot_yaw), 1.0
    if horizon.inputs is not None:  # the force of a foot in the air is zero by its rows
        stands = contract("ksf,kf->ks", feet, horizon.contact.astype(feet.dtype))
    max_force = jnp.broadcast_to(stands * parameters.max_force, yaw.shape)
    A, *numbers = jax.vmap(jax.vmap(of_contact))(yaw, max_force)
    N, contacts = yaw.shape
    A = contract("st,ksri->ksrti", jnp.eye(contacts, dtype=feet.dtype), A)
    return A.reshape(N, -1, condensed.inputs.shape[-1]), *numbers


def _on_states(
    problem: MpcProblem, condensed: Condensed, parts: Sequence[Any]
) -> tuple[Array, ...]:
    """Return dense rows (rows, n) of parts on states, their constants, and their numbers."""
    _, _, turn, push, angles, later, travel, free, _ = condensed
    later, travel = later[:, None, :, None], travel[:, None, :, None]
    turn_, push_ = (jnp.swapaxes(part, 0, 1) for part in (turn, push))  # (3, N, b)
    poses = [jnp.einsum("kjxy,jyb->kxjb", angles, turn), travel * push_]
    states = jnp.concatenate([*poses, later * turn_, later * push_], axis=1)  # (N, 12, N, b)
    selection = State(*jnp.split(jnp.eye(12, dtype=turn.dtype), 4))

    def of_step(data: tuple) -> tuple[Array, ...]:
        number, reference, contact, lever, states, free = data
        step = Step(number, selection, reference, contact, lever)
        each = [rows(part, step, turn) for part in parts]
        C, *numbers = map(jnp.concatenate, zip(*each, strict=True))
        return C @ states, C @ jnp.concatenate(free), *numbers

    flat = states.reshape(*states.shape[:2], -1)
    horizon = problem.horizon
    steps = jnp.arange(len(flat)), horizon.reference, horizon.contact, horizon.lever, flat, free
    A, *others = jax.vmap(of_step)(steps)
    return A.reshape(-1, A.shape[-1]), *(x.ravel() for x in others)


def input_rows(config: MpcConfig, problem: MpcProblem, condensed: Condensed) -> Rows:
    """Return the rows of constraints on inputs, block-diagonal by step: A is (N, rows, b)."""
    A, lower, upper = _on_contacts(config, problem, condensed, config.on("inputs"))
    return Rows(A, lower.ravel(), upper.ravel())


def state_rows(config: MpcConfig, problem: MpcProblem, condensed: Condensed) -> Rows:
    """Return the rows of constraints on states, dense: A is (rows, n)."""
    A, constant, lower, upper = _on_states(problem, condensed, config.on("states"))
    return Rows(A, lower - constant, upper - constant)


def own_costs(config: MpcConfig, problem: MpcProblem, condensed: Condensed) -> Squares:
    """Return the costs beside Q and R as functions of the inputs, dense: A is (rows, n)."""
    factors = problem.parameters.costs
    costs, found = [cost.times(factors[str(cost)]) for cost in config.costs], []
    if parts := [cost for cost in costs if cost.on == "inputs"]:
        A, target, weight = _on_contacts(config, problem, condensed, parts)
        stands = condensed.feet.sum(axis=-1)[..., None]
        found.append((block_diagonal(A), target.ravel(), (stands * weight).ravel()))
    if parts := [cost for cost in costs if cost.on == "states"]:
        A, constant, target, weight = _on_states(problem, condensed, parts)
        found.append((A, target - constant, weight))
    return Squares(*map(jnp.concatenate, zip(*found, strict=True)))


def build_qp(
    config: MpcConfig, problem: MpcProblem, *, dt: float, max_contacts: int
) -> tuple[QP, Condensed]:
    """Build the MPC as a condensed QP, and the states as functions of its inputs.

    Args:
        config, problem: shape and data of the problem.
        dt: MPC step [s].
        max_contacts: largest number of feet in stance at once (static).

    Returns:
        QP in the inputs of all steps, n = N b with b inputs of `max_contacts` feet; its rows are
        block-diagonal by step (N, rows, b), or dense with constraints on states.

    Source: Eq. 3, 4.
    """
    condensed = condense(config, problem, dt, max_contacts)
    P = half_hessian(config, problem, condensed)
    q = half_slope(config, problem, condensed, jnp.zeros_like(condensed.push[:, 0]))
    A, lower, upper = input_rows(config, problem, condensed)
    if config.on("states"):
        of_u, of_x = Rows(block_diagonal(A), lower, upper), state_rows(config, problem, condensed)
        A, lower, upper = map(jnp.concatenate, zip(of_u, of_x, strict=True))
    return QP(2.0 * P, 2.0 * q.reshape(-1), A, lower, upper), condensed


def solve_mpc(
    config: MpcConfig, problem: MpcProblem, dt: float, max_contacts: int
) -> tuple[Wrench, Solution]:
    """Solve the MPC of `build_qp`; return its first wrench [N, N m], world frame, and solution."""
    qp, condensed = build_qp(config, problem, dt=dt, max_contacts=max_contacts)

    def slope(x: Float[Array, " n"]) -> Float[Array, " n"]:
        return 2.0 * half_slope(config, problem, condensed, x.reshape(config.horizon, -1)).ravel()

    first = condensed.inputs[0]
    solution = solve_qp(qp, config.qp, slope)
    return unpack_wrench(contract("ub,b->u", first, solution.x[: first.shape[1]])), solution
