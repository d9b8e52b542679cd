"""Rules that step a tuning, as optax transformations of its coordinates.

The coordinates z of a tuning are log-steps of the weights from the start, and steps of the other
numbers as shares of their box (`parameters.stepped`). A rule takes the gradient of the loss by z at
the point that was evaluated last, with the loss itself, and returns the update to the next point:

    updates, state = rule.update(gradient, state, z, value=loss, matrix=hessian, box=bounds)
    z = optax.apply_updates(z, updates)

An infinite value says that the point is refused, for example because the robot fell. A point that
the rule does not accept is left again: the update leads to a shorter step from the last accepted
point, and gradient and matrix at the refused one are not used.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Bool, Float, Int

from hector_jax.core.arrays import Array

LEAST, POOR, GOOD = 0.01, 0.25, 0.6
"""Ratios of true to predicted gain: a step of less than the least is refused; below the poor one
the trust region shrinks, above the good one it grows."""
LARGEST = 4.0
"""Largest radius of the trust region [e-folds]."""
_ROUNDS = 8  # of a step in the box, in which walls are held and released


class StepState(NamedTuple):
    """State of a rule; all but `size` and `first` belong to the last accepted point."""

    size: Float[Array, ""]  # radius of the trust region, or share of the full step
    steps: Float[Array, " n"]  # z
    value: Float[Array, ""]  # the loss; infinite before the first
    first: Float[Array, ""]  # the loss at the start
    gradient: Float[Array, " n"]
    matrix: Float[Array, "n n"]  # Gauss-Newton matrix


def _init(steps: Float[Array, " n"]) -> StepState:
    # of the later type, or `update` is compiled again
    one, infinite = (jnp.asarray(x, steps.dtype) for x in (1.0, jnp.inf))
    zeros, matrix = jnp.zeros_like(steps), jnp.zeros((len(steps), len(steps)), steps.dtype)
    return StepState(one, steps, infinite, infinite, zeros, matrix)


def _model(ridge: float, state: StepState) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Return slope and curvature of the objective at the last accepted point."""
    slope = state.gradient / state.first + ridge * state.steps
    return slope, state.matrix / state.first + ridge * jnp.eye(len(slope))


def objective(
    ridge: float, state: StepState, steps: Float[Array, " n"], value: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the loss as a share of that at the start, plus half the ridge times |z|^2."""
    return value / state.first + 0.5 * ridge * steps @ steps


def predicted_gain(ridge: float, state: StepState, steps: Float[Array, " n"]) -> Float[Array, ""]:
    """Return how much the objective falls from the last accepted point to z, to second order."""
    slope, curvature = _model(ridge, state)
    step = steps - state.steps
    return -(slope @ step + 0.5 * step @ curvature @ step)


def gain_ratio(
    ridge: float, state: StepState, steps: Float[Array, " n"], value: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the true gain at z by the predicted one; minus infinity for an infinite value."""
    before = objective(ridge, state, state.steps, state.value)
    gain = before - objective(ridge, state, steps, value)
    return gain / jnp.maximum(predicted_gain(ridge, state, steps), jnp.finfo(gain.dtype).tiny)


Box = tuple[Any, Any]
"""Lower and upper bounds (n,) of z."""


def boxed_step(ridge: float, state: StepState, box: Box, size: Any = None) -> Float[Array, " n"]:
    """Return the step of least objective, by its model, within the trust region and the box.

    Walls that the step would go beyond are held at their distance, and the other coordinates
    solved again with them, until none need be held or released: a step that is clipped need not go
    down if coordinates are coupled.

    Args:
        ridge, state: of the rule.
        box: of z.
        size: radius; that of the state by default.
    """
    slope, curvature = _model(ridge, state)
    low, high = box[0] - state.steps, box[1] - state.steps
    size = state.size if size is None else size

    def again(_: Any, found: tuple[Array, Array]) -> tuple[Array, Array]:
        held, step = found
        at = jnp.where(held, step, 0.0)
        free = jnp.where(held, 0.0, slope + curvature @ at)
        coupled = jnp.where(held[:, None] | held, 0.0, curvature) + jnp.diag(1.0 * held)
        step = jnp.where(held, at, _trusted_step(free, coupled, size))
        beyond, step = (step < low) | (step > high), jnp.clip(step, low, high)
        uphill = slope + curvature @ step
        outward = ((step <= low) & (uphill > 0.0)) | ((step >= high) & (uphill < 0.0))
        return beyond | (held & outward), step

    nothing = jnp.zeros(len(slope), bool), jnp.zeros_like(slope)
    return jax.lax.fori_loop(0, _ROUNDS, again, nothing)[1]


def _trusted_step(
    slope: Float[Array, " n"], curvature: Float[Array, "n n"], size: Float[Array, ""] | float
) -> Float[Array, " n"]:
    """Return the step that minimises a quadratic model within a ball."""
    values, vectors = jnp.linalg.eigh(curvature)
    values = jnp.maximum(values, 1e-9 * values[-1] + jnp.finfo(values.dtype).tiny)
    along = vectors.T @ slope

    def improve(_: Any, damping: Float[Array, ""]) -> Float[Array, ""]:
        """Newton's method on 1 / |s| - 1 / radius, which is nearly linear in the damping."""
        scaled = along / (values + damping)
        square = scaled @ scaled
        descent = jnp.where(square > 0.0, scaled @ (scaled / (values + damping)), 1.0)
        excess = jnp.sqrt(square) / size - 1.0
        return jnp.maximum(damping + excess * square / descent, 0.0)

    least = jnp.maximum(jnp.linalg.norm(along) / size - values[-1], 0.0)
    damping = jax.lax.fori_loop(0, 40, improve, least)
    return -vectors @ (along / (values + damping))


def trust_region(ridge: float) -> optax.GradientTransformationExtraArgs:
    """Return Gauss-Newton steps in a trust region, with a ridge toward the start.

    Minimises `objective`. The ridge is a Gaussian prior of the log-steps: matrix / loss at the
    start + ridge I is the precision of what is then known about them.

    Source: Nocedal and Wright, Numerical Optimization, 2006, chapters 4 and 10.
    """

    def update(
        updates: Float[Array, " n"],
        state: StepState,
        params: Float[Array, " n"],
        *,
        value: Float[Array, ""],
        matrix: Float[Array | np.ndarray, "n n"],
        box: Box = (-jnp.inf, jnp.inf),
    ) -> tuple[Float[Array, " n"], StepState]:
        begun, finite = jnp.isfinite(state.value), jnp.isfinite(value)
        ratio = gain_ratio(ridge, state, params, value)
        accepted = jnp.where(begun, ratio > LEAST, finite)
        length = jnp.linalg.norm(params - state.steps)
        larger = jnp.minimum(2.0 * state.size, LARGEST)
        size = jnp.where((ratio > GOOD) & (length > 0.9 * state.size), larger, state.size)
        size = jnp.where(ratio < POOR, length / 4.0, size)
        size = jnp.where(accepted, size, length / 8.0)
        kept = _keep(state, accepted, steps=params, value=value, gradient=updates, matrix=matrix)
        kept = kept._replace(size=jnp.where(begun, size, state.size))
        return kept.steps + boxed_step(ridge, kept, box) - params, kept

    return optax.GradientTransformationExtraArgs(_init, update)  # pyright: ignore


def _keep(
    state: StepState,
    accepted: Array,
    *,
    steps: Float[Array, " n"],
    value: Float[Array, ""],
    gradient: Float[Array, " n"],
    matrix: Float[Array | np.ndarray, "n n"],
) -> StepState:
    """Return the state with a new point, if it was accepted."""
    first = jnp.where(jnp.isfinite(state.first), state.first, value)
    new = state._replace(steps=steps, value=value, gradient=gradient, matrix=matrix)
    return jax.tree.map(lambda x, y: jnp.where(accepted, x, y), new, state)._replace(first=first)


def relative(
    betas: Float[np.ndarray, " n"], blocks: Int[np.ndarray, " n"]
) -> optax.GradientTransformationExtraArgs:
    """Return steps down the gradient; the largest relative step within a block is its beta.

    Args:
        betas: of each coordinate.
        blocks: number of the block of each coordinate; the last block, of the numbers beside Q and
            R, is 2 and steps in shares of the box.
    """

    def change(gradient: Float[Array, " n"], steps: Float[Array, " n"]) -> Float[Array, " n"]:
        same = blocks[:, None] == blocks
        largest = jnp.max(jnp.where(same, jnp.abs(gradient), 0.0), axis=1)
        return betas * gradient / jnp.where(largest > 0.0, largest, 1.0)

    return _first_order(change, blocks < 2)


def literal(
    betas: Float[np.ndarray, " n"], sizes: Float[Array, " n"]
) -> optax.GradientTransformationExtraArgs:
    """Return the paper's steps theta - beta dL / dtheta.

    Args:
        betas: of each coordinate.
        sizes: of each coordinate, the square of its weight at the start times the number of weights
            that share it, whose mean gradient is taken.

    Source: Eq. 9.
    """

    def change(gradient: Float[Array, " n"], steps: Float[Array, " n"]) -> Float[Array, " n"]:
        return betas * gradient / (sizes * jnp.exp(2.0 * steps))

    return _first_order(change, np.ones(len(betas), bool))


def _first_order(
    change: Callable[[Float[Array, " n"], Float[Array, " n"]], Float[Array, " n"]],
    logs: Bool[np.ndarray, " n"],
) -> optax.GradientTransformationExtraArgs:
    """Return steps by a share of a relative change, which a refusal halves.

    Args:
        change: takes gradient and z; a full step multiplies a weight by 1 - change.
        logs: True for the coordinates that are log-steps.
    """

    def update(
        updates: Float[Array, " n"],
        state: StepState,
        params: Float[Array, " n"],
        *,
        value: Float[Array, ""],
        **_: Any,
    ) -> tuple[Float[Array, " n"], StepState]:
        accepted = jnp.isfinite(value)
        size = jnp.where(accepted, jnp.minimum(1.0, 2.0 * state.size), state.size / 2.0)
        matrix = state.matrix
        kept = _keep(
            state, accepted, steps=params, value=value, gradient=updates, matrix=matrix
        )._replace(size=size)
        down = size * change(kept.gradient, kept.steps)
        left = jnp.maximum(1.0 - down, jnp.finfo(down.dtype).tiny)  # the box takes it from there
        return kept.steps + jnp.where(logs, jnp.log(left), -down) - params, kept

    return optax.GradientTransformationExtraArgs(_init, update)  # pyright: ignore
