"""A rollout of all its ticks at once, by Newton's method, for a GPU with few rollouts.

A GPU waits in each small step of a tick, and a rollout has its ticks one after the other. Here the
carries before all ticks are the unknowns: each iteration steps and linearises every tick in
parallel and then solves the linear recurrence of the errors between them. The closed loop forgets
a disturbance within a few steps of the gait, so that five to ten iterations are enough from the
reference motion as a guess. Each makes at least one more tick exact, so that it always ends.

Source: Lim et al., Parallelizing non-linear sequential models over the sequence length, ICLR 2024.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from hector_jax.control import gait
from hector_jax.control.controller import contacts_needed
from hector_jax.control.footstep import Feet
from hector_jax.control.mpc import feet_of_contacts
from hector_jax.control.reference import Anchor, Command, reference_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Trajectory, Wrench, has_fallen
from hector_jax.robot.model import Robot
from hector_jax.tuning.rollout import (
    Carry,
    RolloutConfig,
    Variation,
    from_start,
    init_carry,
    step_carry,
    varied,
    walked_ticks,
    with_constants,
)


class _Tick(NamedTuple):
    """A tick and its derivative."""

    inputs: Float[Array, "*batch inputs"]  # the carry before it, then the weights
    outputs: Float[Array, "*batch outputs"]  # the carry after it, then `_numbers` of its sample
    jacobian: Float[Array, "*batch outputs inputs"]
    sample: Trajectory


def _flat(tree: Any) -> jax.Array:
    return ravel_pytree(tree)[0]


def _numbers(sample: Trajectory) -> dict[str, Any]:
    """Return what depends on the inputs in a tick's sample and is not in a carry."""
    return {"reference": sample.reference, "effect": sample.effect}


def _linearised(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    effect: jax.tree_util.Partial,
    variation: Variation | None,
    start: Carry,
) -> Callable[[jax.Array, Array], _Tick]:
    """Return a function that steps and linearises a tick from the carry before it and its number.

    The QP is differentiated in reverse, because the wrenches of the feet that stand have fewer
    numbers than the inputs, the rest of the tick forwards.
    """
    first, to_parts = ravel_pytree(varied(start))
    fixed, to_weights = ravel_pytree(jax.lax.stop_gradient(weights))

    def step(inputs: jax.Array, number: Array, wrench: Wrench | None = None) -> tuple:
        before, weights = jnp.split(inputs, (len(first),))
        carry = with_constants(to_parts(before), start)
        rest = to_weights(weights), command, effect, carry, number, variation, wrench
        return step_carry(config, robot, *rest)

    def linearise(before: jax.Array, number: Array) -> _Tick:
        inputs = jnp.concatenate([before, fixed])
        contact = gait.contact(config.walk.gait, number).astype(first.dtype)
        selection = feet_of_contacts(contact, contacts_needed(config.walk, 0))

        def plan(now: jax.Array) -> tuple[jax.Array, Trajectory]:
            _, sample = step(now, number)
            return jnp.ravel(selection @ jnp.concatenate(sample.command, axis=1)), sample

        wrench, pull_back, sample = jax.vjp(plan, inputs, has_aux=True)
        (by_inputs,) = jax.vmap(pull_back)(jnp.eye(len(wrench), dtype=wrench.dtype))

        def move(now: jax.Array) -> jax.Array:
            planned = selection.T @ (wrench + by_inputs @ (now - inputs)).reshape(-1, 6)
            after, sample = step(now, number, Wrench(planned[:, :3], planned[:, 3:]))
            return _flat((varied(after), _numbers(sample)))

        outputs, push_forward = jax.linearize(move, inputs)
        jacobian = jax.vmap(push_forward, out_axes=1)(jnp.eye(len(inputs), dtype=inputs.dtype))
        return _Tick(inputs, outputs, jacobian, sample)

    return linearise


def _follow(ticks: _Tick, weights: Float[Array, " p"]) -> Float[jax.Array, "T outputs"]:
    """Follow the linearised ticks from the start, each from the outputs of the last one."""
    size = ticks.inputs.shape[1] - len(weights)
    by_carry, by_weights = ticks.jacobian[..., :size], ticks.jacobian[..., size:]
    outputs = ticks.outputs + by_weights @ (weights - ticks.inputs[0, size:])
    gaps = outputs[:-1, :size] - ticks.inputs[1:, :size]

    def in_turn(first: tuple[Array, Array], second: tuple[Array, Array]) -> tuple[Array, Array]:
        (A, a), (B, b) = first, second
        return B @ A, jnp.einsum("...xy,...y->...x", B, a) + b

    _, changes = jax.lax.associative_scan(in_turn, (by_carry[:-1, :size], gaps))
    return outputs.at[1:].add(jnp.einsum("txy,ty->tx", by_carry[1:], changes))


def _newton(
    linearise: Callable[[jax.Array, Array], _Tick],
    standing: Callable[[Array], Array],
    guesses: Float[Array, "T n"],
    numbers: Int[Array, " T"],
) -> tuple[_Tick, Bool[Array, ""]]:
    """Return the ticks, each from the carry after the last one up to a fall, and if some are not.

    Args:
        linearise: see `_linearised`.
        standing: returns from the carries after ticks whether the robot has not fallen by then.
        guesses: the carries before all ticks to begin with.
        numbers: of the gait ticks.
    """
    size = guesses.shape[1]
    tolerance = jnp.sqrt(jnp.finfo(guesses.dtype).eps)  # a last step squares what is left

    def improve(state: tuple) -> tuple:
        ticks, count, _ = state
        after = _follow(ticks, ticks.inputs[0, size:])[:-1, :size]
        # what is predicted beyond a fall means nothing: begin there from the guess again
        usable = (count > 0) & standing(after)
        before = guesses.at[1:].set(jnp.where(usable[:, None], after, guesses[1:]))
        ticks = jax.vmap(linearise)(before, numbers)
        after, before = ticks.outputs[:-1, :size], before[1:]
        wrong = jnp.any(jnp.abs(after - before) > tolerance * (1.0 + jnp.abs(before)), axis=1)
        return ticks, count + 1, jnp.any(wrong & standing(after))

    shapes = jax.eval_shape(jax.vmap(linearise), guesses, numbers)
    ticks = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    begin = ticks, jnp.zeros((), jnp.int32), jnp.ones((), bool)
    going = lambda state: state[2] & (state[1] <= len(numbers))  # noqa: E731
    ticks, _, wrong = jax.lax.while_loop(going, improve, begin)
    return ticks, wrong


def parallel_rollout(
    config: RolloutConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    anchor: Anchor,
    effect: jax.tree_util.Partial,
    variation: Variation | None = None,
) -> Trajectory:
    """Walk on the single rigid body, all ticks at once.

    Takes what `rollout` takes and returns the same up to a fall, but for rounding. Only the first
    derivative by `weights` is right. A rollout that does not converge has an infinite residual.
    """
    start, numbers = init_carry(robot, anchor, variation), walked_ticks(config, anchor)
    first, to_parts = ravel_pytree(varied(start))

    def guess(number: Int[Array, ""]) -> Float[Array, " n"]:
        """Return the carry of a robot that follows the reference, with its feet under it."""
        state = reference_at(config.walk.gait.tick, command, anchor, number)
        moved = start.feet.position + (state.position - start.state.position)
        feet = Feet(moved, start.feet.yaw + state.euler[2])
        return _flat(varied(start._replace(state=state, feet=feet)))

    def standing(carries: Float[Array, "T n"]) -> Bool[Array, " T"]:
        state = jax.vmap(to_parts)(jnp.asarray(carries)).state
        fallen = has_fallen(state, *robot.description.limits)
        return jnp.cumsum(fallen | ~jnp.isfinite(carries).all(axis=1)) == 0

    linearise = _linearised(config, robot, weights, command, effect, variation, start)
    guesses = jax.vmap(guess)(numbers).at[0].set(first)
    ticks, wrong = jax.lax.stop_gradient(_newton(linearise, standing, guesses, numbers))
    outputs = _follow(ticks, _flat(weights))  # has the derivative by the weights
    _, to_numbers = ravel_pytree(jax.tree.map(lambda x: x[0], _numbers(ticks.sample)))
    carries = outputs[:, : len(first)]
    before = jax.vmap(to_parts)(jnp.concatenate([first[None], carries[:-1]]))
    after = jax.vmap(to_parts)(carries)
    samples = ticks.sample._replace(
        initial=before.state,
        state=after.state,
        command=jax.tree.map(lambda w: w[:, 0], after.commands),
        feet=after.feet.position,
        fallen=~standing(carries),
        residual=jnp.where(wrong, jnp.inf, ticks.sample.residual),
        **jax.vmap(to_numbers)(outputs[:, len(first) :]),
    )
    return from_start(config, samples)
