"""A rollout of all its ticks at once, by Newton's method, for a GPU with few rollouts.

A GPU waits in each small step of a tick, and a rollout has its ticks one after the other,
x_j+1 = f_j(x_j, theta). Here the carries x_j are the unknowns. Each iteration steps and linearises
all ticks in parallel, A_j = df_j/dx, and solves the linear recurrence of the changes d_j,

    d_0 = 0,    d_j+1 = A_j d_j + f_j(x_j, theta) - x_j+1,

as prefix products. The closed loop forgets a disturbance within a few steps of the gait, so that
from the reference motion six to ten iterations are enough, and each makes one more tick exact at
least. The derivative follows the same recurrence: dx_j+1/dtheta = A_j dx_j/dtheta + df_j/dtheta
(Eq. 10).

Source: Lim et al., Parallelizing non-linear sequential models over the sequence length, ICLR 2024.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from hector_jax.control.footstep import Feet
from hector_jax.control.reference import Anchor, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import State, Trajectory, has_fallen
from hector_jax.core.tree import pack
from hector_jax.tuning.rollout import (
    Carry,
    RolloutConfig,
    Scenario,
    init_carry,
    step_carry,
    varied,
    walked_ticks,
    with_constants,
    with_variation,
    without_lead,
)


class _Step(NamedTuple):
    """A tick of the rollout with its derivative."""

    inputs: Float[Array, "*batch inputs"]  # the carry before it, then the weights
    outputs: Float[Array, "*batch outputs"]  # the carry after it, then the effect
    jacobian: Float[Array, "*batch outputs inputs"]
    sample: Trajectory


def _linearised(
    config: RolloutConfig, scenario: Scenario, weights: Weights, start: Carry
) -> Callable[[jax.Array, Array], _Step]:
    """Return a function that linearises a tick from the carry before it and its number."""
    packed, to_parts = ravel_pytree(varied(start))
    theta, to_weights = ravel_pytree(weights)
    config = replace(config, forward=True)

    def step(tick: Array, inputs: jax.Array) -> tuple[jax.Array, Trajectory]:
        before, weights = jnp.split(inputs, (len(packed),))
        carry = with_constants(to_parts(before), start)
        after, sample = step_carry(config, scenario, to_weights(weights), carry, tick)
        return jnp.asarray(pack((varied(after), sample.effect))), sample

    def linearise(before: jax.Array, tick: Array) -> _Step:
        inputs = jnp.concatenate([before, theta])
        outputs, push_forward, sample = jax.linearize(partial(step, tick), inputs, has_aux=True)
        jacobian = jax.vmap(push_forward, out_axes=1)(jnp.eye(len(inputs), dtype=inputs.dtype))
        return _Step(inputs, outputs, jacobian, sample)

    return linearise


def _solve_recurrence(steps: _Step, weights: Float[Array, " p"]) -> Float[jax.Array, "T outputs"]:
    """Return the outputs of the linearised steps, each from the outputs of the last one."""
    size = steps.inputs.shape[1] - len(weights)
    by_carry, by_weights = steps.jacobian[..., :size], steps.jacobian[..., size:]
    outputs = steps.outputs + by_weights @ (weights - steps.inputs[0, size:])
    gaps = outputs[:-1, :size] - steps.inputs[1:, :size]

    def compose(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        (A, a), (B, b) = first, second
        return B @ A, jnp.einsum("...xy,...y->...x", B, a) + b

    _, changes = jax.lax.associative_scan(compose, (by_carry[:-1, :size], gaps))
    return outputs.at[1:].add(jnp.einsum("txy,ty->tx", by_carry[1:], changes))


def _newton(
    linearise: Callable[[jax.Array, Array], _Step],
    standing: Callable[[Array], Array],
    guesses: Float[Array, "T n"],
    ticks: Int[Array, " T"],
) -> tuple[_Step, Bool[Array, ""]]:
    """Solve for the carries before all ticks; what comes after a fall is not solved.

    Args:
        linearise: see `_linearised`.
        standing: returns from the carries after ticks whether the robot has not fallen by then.
        guesses: the carries to begin with; the first one is exact.
        ticks: gait ticks.

    Returns:
        The linearised steps at the solution, and whether it has converged.
    """
    size = guesses.shape[1]
    # another change squares what is left, except where a row of a QP becomes active
    tolerance = jnp.sqrt(jnp.finfo(guesses.dtype).eps)

    def improve(state: tuple) -> tuple:
        steps, count, _ = state
        after = _solve_recurrence(steps, steps.inputs[0, size:])[:-1, :size]
        # what is predicted beyond a fall means nothing: begin there from the guess again
        stands = (count > 0) & standing(after)
        before = guesses.at[1:].set(jnp.where(stands[:, None], after, guesses[1:]))
        steps = jax.vmap(linearise)(before, ticks)
        after, before = steps.outputs[:-1, :size], before[1:]
        close = jnp.all(jnp.abs(after - before) <= tolerance * (1.0 + jnp.abs(before)), axis=1)
        return steps, count + 1, jnp.all(close | ~standing(after))

    shapes = jax.eval_shape(jax.vmap(linearise), guesses, ticks)
    steps = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    begin = steps, jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    going = lambda state: ~state[2] & (state[1] < len(ticks))  # noqa: E731
    steps, _, converged = jax.lax.while_loop(going, improve, begin)
    return steps, converged


def parallel_rollout(config: RolloutConfig, scenario: Scenario, weights: Weights) -> Trajectory:
    """Walk on the single rigid body, all ticks at once.

    Takes what `rollout` takes and returns the same up to a fall, but for rounding. It can be
    differentiated once and by `weights` only; other derivatives are zero. A rollout that has not
    converged after as many iterations as it has ticks has an infinite residual.

    Source: Eq. 12, 13; the method in the module's docstring.
    """
    fixed, scenario = jax.lax.stop_gradient((weights, with_variation(config, scenario)))
    robot, command, anchor, *_ = scenario
    start, ticks = init_carry(scenario), walked_ticks(config, anchor)
    packed, to_parts = ravel_pytree(varied(start))
    dt, size = config.walk.gait.tick, len(packed)

    def guess(tick: Int[Array, ""]) -> Float[Array, " n"]:
        """Return the carry of a robot that follows the reference, with its feet under it."""
        state = reference_at(dt, command, anchor, tick)
        moved = start.feet.position + (state.position - start.state.position)
        feet = Feet(moved, start.feet.yaw + state.euler[2])
        return pack(varied(start._replace(state=state, feet=feet)))

    def standing(carries: Float[Array, "T n"]) -> Bool[Array, " T"]:
        state = jax.vmap(to_parts)(jnp.asarray(carries)).state
        fallen = has_fallen(state, *robot.description.limits)
        return jnp.cumsum(fallen | ~jnp.isfinite(carries).all(axis=1)) == 0

    def reference(anchor: Anchor, tick: Int[Array, ""]) -> State:
        anchor = anchor._replace(tick=start.anchor.tick)
        return reference_at(dt, command, anchor, tick + 1.0)

    linearise = _linearised(config, scenario, fixed, start)
    guesses = jax.vmap(guess)(ticks).at[0].set(packed)
    steps, converged = _newton(linearise, standing, guesses, ticks)
    outputs = _solve_recurrence(steps, pack(weights))  # has the derivative by the weights
    carries = jax.vmap(to_parts)(jnp.concatenate([packed[None], outputs[:, :size]]))
    after = jax.tree.map(lambda x: x[1:], carries)
    _, to_effect = ravel_pytree(jax.tree.map(lambda w: w[0], start.commands))
    samples = steps.sample._replace(
        initial=jax.tree.map(lambda x: x[:-1], carries.state),
        state=after.state,
        reference=jax.vmap(reference)(after.anchor, ticks),
        command=jax.tree.map(lambda w: w[:, 0], after.commands),
        effect=jax.vmap(to_effect)(outputs[:, size:]),
        feet=after.feet.position,
        fallen=~standing(steps.outputs[:, :size]),  # as in `_newton`
        residual=jnp.where(converged, steps.sample.residual, jnp.inf),
    )
    return without_lead(config, samples)
