"""A controller that is known by calling it: its plans along a walk, and how they change.

At each plan of a walk the controller is called at the state and the feet that it had there, and
again with each of these numbers, and each tuned one, moved a little. To first order that is all
that a rollout near the walk asks of it, so a controller in any language has a gradient.

It must plan without memory: a call at the same inputs gives the same plan. The touchdowns are
part of the plan, since stepping is what keeps a robot upright: without them the derivatives of a
walk grow without bound. The yaws of feet are not moved; a foot in the air moves with its touchdown.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from hector_jax import qp
from hector_jax.control.controller import Plan
from hector_jax.control.footstep import Feet
from hector_jax.control.parameters import Tunable, nudged, own_names, stepped
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights, direction_names
from hector_jax.core.arrays import Array
from hector_jax.core.trajectory import Disturbance, State, Wrench

STATE_STEPS = (1e-4, 1e-4, 1e-3, 1e-3)  # [rad], [m], [rad/s], [m/s] of the parts of a state
FOOT_STEP, LOG_STEP = 1e-4, 0.02  # [m] of a foot; of a tuned number, see `parameters.stepped`


def move_sizes(body: int) -> Float[np.ndarray, " body"]:
    """Return by how much the numbers of state and feet are moved."""
    return np.array([*np.repeat(STATE_STEPS, 3), *[FOOT_STEP] * (body - 12)])


class PlanInputs(NamedTuple):
    """From what a controller plans: N plans of a walk."""

    time: Float[np.ndarray, " N"]  # [s] since the command began
    state: State  # (N, 3) each, as the controller estimates it
    feet: Feet  # (N, feet), likewise
    contact: Bool[np.ndarray, "N feet"]  # planned stance
    weights: Weights  # with a leading axis N
    command: Command
    initial: State  # when the command began


class Planned(NamedTuple):
    """What it answers; NaN in a row whose plan was not solved."""

    force: Float[np.ndarray, "N feet 3"]  # of the ground on each foot [N], world frame
    moment: Float[np.ndarray, "N feet 3"]  # about the foot points [N m]
    touchdown: Float[np.ndarray, "N feet 3"]  # next foot points [m]; those in stance do not count


CallPlans = Callable[[PlanInputs], Planned]


def _body(state: State, feet: Feet) -> Array:
    """Return state and foot points as one vector, of each row: 12 numbers and 3 a foot."""
    points = feet.position.reshape(*feet.position.shape[:-2], -1)
    return jnp.concatenate([*state, points], axis=-1)


class CalledPlans(NamedTuple):
    """Plans at the T ticks of a walk, linear about where they were called."""

    body: Float[Array, "T body"]  # state and foot points
    contact: Bool[Array, "T feet"]
    made: Bool[Array, " T"]  # whether there is a plan at this tick, else the last one is kept
    values: Float[Array, "T feet 9"]  # force, moment, touchdown
    # by `body`, by the steps of Q and R, and by the numbers of the controller (`own_names`)
    slopes: Float[Array, "T feet 9 moves"]

    def plan(
        self,
        *,
        state: State,
        feet: Feet,
        steps: Float[Array, " n"],
        last: Wrench,
        disturbance: Disturbance,
    ) -> Plan:
        """Return the plan at one tick, of which these fields have no leading axis.

        Args:
            state, feet: estimated.
            steps: from the weights with which the plans were called: of Q and R by
                `parameters.stepped`, and changes of the numbers.
            last: wrench of the tick before.
            disturbance: is kept.
        """
        moved = jnp.concatenate([_body(state, feet) - self.body, steps])
        force, moment, touchdown = jnp.split(self.values + self.slopes @ moved, 3, axis=-1)
        new = Wrench(force, moment), touchdown
        wrench, touchdown = jax.tree.map(partial(jnp.where, self.made), new, (last, feet.position))
        return Plan(
            wrench=jax.tree.map(lambda x: self.contact[:, None] * x, wrench),
            contact=self.contact,
            touchdown=Feet(touchdown, feet.yaw),
            swing_ticks=jnp.zeros(len(self.contact), int),
            residual=jnp.zeros(()),
            status=jnp.asarray(int(qp.Status.SOLVED)),
            disturbance=disturbance,
        )


def call_rows(
    call: CallPlans, inputs: PlanInputs, rows: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N feet 9"]:
    """Return the plans at some ticks of a walk, in this order; see `call_along`."""
    time, state, feet, contact = jax.tree.map(lambda x: np.asarray(x)[rows], inputs[:4])
    weights = jax.tree.map(lambda x: np.stack([x] * len(rows)), inputs.weights)
    asked = PlanInputs(time, state, feet, contact, weights, inputs.command, inputs.initial)
    return np.concatenate(call(asked), axis=-1)


def call_along(
    call: CallPlans,
    inputs: PlanInputs,
    made: Bool[np.ndarray, " T"],
    numbers: Sequence[Tunable] = (),
) -> CalledPlans:
    """Call a controller along a walk, at each plan once and once more for each number moved.

    Where it does not solve a plan the last one is kept, and a moved one counts as no change.

    Args:
        call: the controller.
        inputs: at the T ticks of the walk; its weights have no leading axis.
        made: ticks at which the controller plans.
        numbers: of the controller, that are moved too; by its other numbers the slopes are zero.

    Raises:
        InputError: from `call`.
    """
    body, rows = np.asarray(_body(inputs.state, inputs.feet)), np.flatnonzero(made)
    feet, start, count = inputs.contact.shape[1], inputs.weights, body.shape[1]
    by_logs = [stepped(start, x) for x in LOG_STEP * np.eye(len(direction_names(start)))]
    by_name = {of.name: nudged(start, [of], [-1], LOG_STEP)[0] for of in numbers}
    by_numbers = {name: by_name.get(name, start) for name in own_names(start)}
    changes = [float(x.others[name] - start.others[name]) for name, x in by_numbers.items()]
    sizes = np.concatenate([move_sizes(count), np.full(len(by_logs), LOG_STEP), changes])
    moved = np.flatnonzero(sizes)
    sets = [start, *(([start] * count + by_logs + [*by_numbers.values()])[i] for i in moved)]
    of_body = np.concatenate([np.zeros((1, count)), np.diag(sizes)[moved, :count]])

    def repeated(x: Any) -> np.ndarray:
        return np.tile(np.asarray(x)[rows], (len(sets), *[1] * (np.ndim(x) - 1)))

    parts = np.split(repeated(body) + np.repeat(of_body, len(rows), axis=0), [3, 6, 9, 12], axis=1)
    asked = inputs._replace(
        time=repeated(inputs.time),
        state=State(*parts[:4]),
        feet=Feet(parts[4].reshape(-1, feet, 3), repeated(inputs.feet.yaw)),
        contact=repeated(inputs.contact),
        weights=jax.tree.map(lambda *x: np.repeat(np.stack(x), len(rows), axis=0), *sets),
    )
    answers = np.concatenate(call(asked), axis=-1).reshape(len(sets), len(rows), feet, 9)
    slopes = np.zeros((len(sizes), *answers.shape[1:]))
    slopes[moved] = np.nan_to_num(answers[1:] - answers[0]) / sizes[moved].reshape(-1, 1, 1, 1)
    solved = np.isfinite(answers[0]).all(axis=(1, 2))
    at = np.maximum(np.cumsum(made) - 1, 0)  # of the last plan; between plans none is used
    made = made & solved[at]
    values, slopes = np.nan_to_num(answers[0])[at], np.moveaxis(slopes, 0, -1)[at]
    return CalledPlans(body, inputs.contact, made, values, slopes)
