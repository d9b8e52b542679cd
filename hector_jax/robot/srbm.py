"""Single rigid body dynamics: motion of the base under foot wrenches (Eq. 2), exact and linearised.

The body has the constant composite inertia of the standing robot. The linearisation uses forward
Euler and drops the gyroscopic term, as the public controllers of this robot do; the simulated body
keeps it.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from hector_jax.core.arrays import Array, contract
from hector_jax.core.geometry import euler_rates, inverse, rotation_from_euler, skew
from hector_jax.core.trajectory import Load, State, Wrench
from hector_jax.robot.model import Robot


def centroidal_rates(
    robot: Robot, wrench: Wrench, lever: Float[Array, "feet 3"]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return linear acceleration [m/s^2] and rate of angular momentum [N m], world frame.

    Args:
        robot: mass [kg] and gravity [m/s^2], the latter pointing up as in the paper.
        wrench: force [N] and moment [N m] of the ground on each foot.
        lever: centre of mass to foot point [m].

    Source: Eq. 2.
    """
    torque = jnp.cross(lever, wrench.force) + wrench.moment
    return wrench.force.sum(axis=0) / robot.mass - robot.gravity, torque.sum(axis=0)


def _in_world(R_wb: Float[Array, "3 3"], matrix: ArrayLike) -> Float[Array, "3 3"]:
    """Turn a matrix (3, 3) from the trunk's axes to the world's."""
    return contract("xa,ab,yb->xy", R_wb, matrix, R_wb)


def _momentum(
    robot: Robot, R_wb: Float[Array, "3 3"], ang_velocity: Float[Array, "3"]
) -> Float[Array, "3"]:
    return contract("xy,y->x", _in_world(R_wb, robot.inertia), ang_velocity)


@jax.jit  # traced once for the four stages of a step
def rates(
    robot: Robot,
    state: State,
    wrench: Wrench,
    feet: Float[Array, "feet 3"],
    load: Load | None = None,
) -> State:
    """Return the state's time derivative for foot points in the world [m]. Source: Eq. 2."""
    acceleration, torque = centroidal_rates(robot, wrench, feet - state.position)
    if load is not None:
        acceleration, torque = acceleration + load.force / robot.mass, torque + load.torque
    R_wb, rate = rotation_from_euler(state.euler), state.ang_velocity
    torque = torque - jnp.cross(rate, _momentum(robot, R_wb, rate))
    ang_acceleration = contract("xy,y->x", _in_world(R_wb, inverse(robot.inertia)), torque)
    return State(
        euler=contract("xy,y->x", euler_rates(state.euler), rate),
        position=state.velocity,
        ang_velocity=ang_acceleration,
        velocity=acceleration,
    )


def step(
    robot: Robot,
    state: State,
    wrench: Wrench,
    feet: Float[Array, "feet 3"],
    dt: float,
    *,
    load: Load | None = None,
) -> State:
    """Return the state after `dt` [s] of constant wrench and load, world frame (Runge-Kutta 4)."""

    def euler_step(slope: State, h: float) -> State:
        return jax.tree.map(lambda x, dx: x + h * dx, state, slope)

    k1 = rates(robot, state, wrench, feet, load)
    k2 = rates(robot, euler_step(k1, dt / 2), wrench, feet, load)
    k3 = rates(robot, euler_step(k2, dt / 2), wrench, feet, load)
    k4 = rates(robot, euler_step(k3, dt), wrench, feet, load)
    return jax.tree.map(
        lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4
    )


def unexplained(
    robot: Robot,
    before: State,
    after: State,
    wrench: Wrench,
    feet: Float[Array, "feet 3"],
    *,
    dt: float,
) -> Load:
    """Return the load that explains the motion between two states in addition to the wrench.

    Args:
        robot: mass, gravity and inertia.
        before: state at the start.
        after: state `dt` [s] later.
        wrench: mean wrench of the ground between the states.
        feet: foot points halfway [m].
        dt: time between the states [s].

    Source: Eq. 2, solved for the forces; the inverse of `step` up to terms of second order.
    """
    lever = feet - 0.5 * (before.position + after.position)
    acceleration, torque = centroidal_rates(robot, wrench, lever)
    earlier, later = (
        _momentum(robot, rotation_from_euler(state.euler), state.ang_velocity)
        for state in (before, after)
    )
    return Load(
        force=robot.mass * ((after.velocity - before.velocity) / dt - acceleration),
        torque=(later - earlier) / dt - torque,
    )


@partial(jax.jit, static_argnums=3)  # traced once for all callers
def linearise(
    robot: Robot, euler: Float[Array, "3"], lever: Float[Array, "feet 3"], dt: float
) -> tuple[Float[Array, "15 15"], Float[Array, "15 u"]]:
    """Return A and B of x' = A x + B u, x = [e; p; omega; v; g] and u = [F_0; F_1; M_0; M_1].

    Args:
        robot: mass and inertia.
        euler: attitude to linearise about [rad].
        lever: centre of mass to each foot point [m].
        dt: step [s], forward Euler.

    Source: Eq. 4a.
    """
    R_wb = rotation_from_euler(euler)
    inverse_inertia = _in_world(R_wb, inverse(robot.inertia))
    eye, zero = jnp.eye(3, dtype=R_wb.dtype), jnp.zeros((3, 3), R_wb.dtype)
    A = jnp.block(
        [
            [eye, zero, dt * euler_rates(euler), zero, zero],
            [zero, eye, zero, dt * eye, zero],
            [zero, zero, eye, zero, zero],
            [zero, zero, zero, eye, -dt * eye],
            [zero, zero, zero, zero, eye],
        ]
    )
    moment_gain, force_gain = dt * inverse_inertia, dt / robot.mass * eye
    feet = len(lever)
    arms = jax.vmap(skew)(lever)
    B = jnp.block(
        [
            [zero] * (2 * feet),
            [zero] * (2 * feet),
            list(contract("xy,fyz->fxz", moment_gain, arms)) + [moment_gain] * feet,
            [force_gain] * feet + [zero] * feet,
            [zero] * (2 * feet),
        ]
    )
    return A, B
