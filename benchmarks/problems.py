"""Seeded walking QPs as our MPC writes them: what goes into the layer, and the ready dense QPs.

All gait phases, yaw up to 1 rad, every fourth state pushed 2.5 times harder, and every weight drawn
log-uniformly within a factor of ten of the expert's.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from hector_jax.control import gait
from hector_jax.control.controller import WalkConfig
from hector_jax.control.mpc import Horizon, MpcProblem, build_qp
from hector_jax.control.weights import Weights, expert, vector_to_weights, weights_to_vector
from hector_jax.core.trajectory import State
from hector_jax.core.tree import stack
from hector_jax.qp import QP
from hector_jax.robot.model import Robot

MAX_CONTACTS = 1  # one foot stands at a time
INPUTS = 5  # of a stance foot: F_x, F_y, F_z, M_y, M_z


class Problem(NamedTuple):
    """Input of the layer, or a batch of them."""

    weights: Weights
    state: State
    horizon: Horizon
    pull: np.ndarray  # (5,) direction in which the first input is looked at for its gradient


def _turned(yaw: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1)


def _problem(config: WalkConfig, robot: Robot, seed: int) -> Problem:
    rng = np.random.default_rng([0xBE, seed])
    N, dt, height = config.mpc.horizon, config.mpc_step, float(robot.standing_height)
    yaw, rate = rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0)
    times = dt * np.arange(N + 1)
    heading = yaw + rate * times
    velocity = _turned(
        heading,
        np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.1, 0.1), 0.0]) * np.ones((N + 1, 1)),
    )
    path = np.cumsum(dt * velocity, axis=0) + [0.0, 0.0, height]
    upright, level = np.zeros((N + 1, 2)), np.zeros((N + 1, 2))
    reference = State(
        np.column_stack([upright, heading]),
        path,
        np.column_stack([level, np.full(N + 1, rate)]),
        velocity,
    )
    push = 2.5 if seed % 4 == 0 else 1.0
    spread = push * np.array([[0.1], [0.03], [0.5], [0.3]])
    off = spread * rng.normal(size=(4, 3))
    state = State(*(value[0] + o for value, o in zip(reference, off, strict=True)))

    # Feet stand still while the body moves on above them, each beside its hip on the average.
    ticks = rng.integers(config.gait.cycle) + config.mpc.step_ticks * np.arange(N)
    side = np.array([[0.0, config.footstep.width, -height], [0.0, -config.footstep.width, -height]])
    lever = side + rng.uniform(-0.08, 0.08, (N, 2, 1)) * [1.0, 0.2, 0.0]
    horizon = Horizon(
        reference=State(*(value[1:] for value in reference)),
        euler=np.column_stack([upright, heading])[:-1],
        lever=_turned(heading[:-1, None], lever),
        foot_yaw=heading[:-1, None] + 0.1 * rng.normal(size=(N, 2)),
        contact=np.asarray(gait.contact(config.gait, jnp.asarray(ticks))),
    )
    factors = 10.0 ** rng.uniform(-1.0, 1.0, 24)
    weights = vector_to_weights(weights_to_vector(expert()) * factors)
    return Problem(jax.tree.map(np.asarray, weights), state, horizon, rng.normal(size=INPUTS))


def draw_problems(config: WalkConfig, robot: Robot, count: int) -> Problem:
    """The first `count` problems, stacked; numpy in 64 bits."""
    return stack([_problem(config, robot, seed) for seed in range(count)])


def pick(problems: Problem, index: int | slice) -> Problem:
    """One problem of a batch, or some."""
    return jax.tree.map(lambda leaf: leaf[index], problems)


def layer_qp(config: WalkConfig, robot: Robot, problem: Problem) -> QP:
    """The condensed QP of a problem, rows block-diagonal by step; pure JAX."""
    weights, state, horizon, _ = problem
    mpc = MpcProblem(robot, config.mpc.parameters(weights), state, horizon)
    return build_qp(config.mpc, mpc, dt=config.mpc_step, max_contacts=MAX_CONTACTS)[0]


def parameters(problem: Problem) -> jax.Array:
    """Log-weights and x_0 as one vector (36,): 12 of Q, 12 of R, 12 of the state."""
    return jnp.concatenate(
        [jnp.log(weights_to_vector(problem.weights)), *map(jnp.asarray, problem.state)]
    )


def with_parameters(problem: Problem, vector: jax.Array) -> Problem:
    """The problem with these `parameters`."""
    state = State(*jnp.split(vector[24:], 4))
    return problem._replace(weights=vector_to_weights(jnp.exp(vector[:24])), state=state)


class Ready(NamedTuple):
    """A condensed QP with dense rows, numpy; and how P and q change with the `parameters`."""

    qp: QP
    P_slopes: np.ndarray  # (36, n, n), symmetric
    q_slopes: np.ndarray  # (36, n)


def condense(config: WalkConfig, robot: Robot, problems: Problem, count: int) -> list[Ready]:
    """The first `count` problems as ready QPs."""

    @jax.jit
    def both(problem: Problem) -> tuple[QP, tuple]:
        def written(vector: jax.Array) -> tuple[jax.Array, jax.Array]:
            qp = layer_qp(config, robot, with_parameters(problem, vector))
            return 0.5 * (qp.P + qp.P.T), qp.q

        qp = layer_qp(config, robot, problem)
        return qp, jax.jacfwd(written)(parameters(problem))

    found = []
    for i in range(count):
        qp, (dP, dq) = jax.tree.map(np.array, both(pick(problems, i)))
        dense = qp._replace(P=0.5 * (qp.P + qp.P.T), A=scipy.linalg.block_diag(*qp.A))
        found.append(Ready(dense, np.moveaxis(dP, -1, 0), dq.T))
    return found
