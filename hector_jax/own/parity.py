"""How far the plans of a twin are from those of the controller that it stands for (`control.twin`).

Every plan of a log is solved again, from the state and the joints at its start.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from hector_jax.control.controller import WalkConfig, contacts_needed, measured_feet, plan
from hector_jax.control.disturbance import NO_DISTURBANCE
from hector_jax.control.legs import Measurement
from hector_jax.control.parameters import without_numbers
from hector_jax.control.reference import Command, anchor_at
from hector_jax.control.weights import Weights
from hector_jax.core.arrays import Array
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import SOLVED, Disturbance, Trajectory, Wrench
from hector_jax.own.walk_file import check_legs
from hector_jax.robot.model import Robot

COMPONENTS = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")


class Parity(NamedTuple):
    """Plans of a log and of the twin; world frame."""

    time: Float[np.ndarray, " rows"]  # [s] of each plan and foot that stands
    foot: Int[np.ndarray, " rows"]
    logged: Float[np.ndarray, "rows 6"]  # wrenches [N, N m]
    twin: Float[np.ndarray, "rows 6"]
    plans: int
    by_log: float | None  # largest difference if plans start at the reference in the log, if any
    other_contact: float  # share of the plans in which other feet stand
    unsolved: int  # plans of the twin

    @property
    def distance(self) -> Float[np.ndarray, "rows 6"]:
        """Absolute differences [N, N m]."""
        return np.abs(self.logged - self.twin)

    @property
    def worst(self) -> tuple[int, int]:
        """Row and component of the largest difference."""
        row, component = divmod(int(np.argmax(self.distance)), len(COMPONENTS))
        return row, component


def compare_plans(
    config: WalkConfig, robot: Robot, weights: Weights, command: Command, walk: Trajectory
) -> Parity:
    """Solve the plans of a walk again.

    Args:
        config, robot: of the twin.
        weights, command: with which the controller walked.
        walk: as `read_walk` returns it. A plan is at t = 0 and each `plan_interval` after it; the
            first is left out, because the log has no joints before it. Integral action and slips
            before t = 0 are not in the plans.

    Raises:
        InputError: the walk is shorter than two plans, or its joints never move.
    """
    rows, (wrench, contact, residual) = plans_again(config, robot, weights, command, walk)
    own = jax.tree.map(lambda x: x[rows - 1], walk.reference)
    plan, foot = np.nonzero(contact)
    command_at = jax.tree.map(lambda x: x[rows], walk.command)
    logged, twin = (np.concatenate(x, axis=-1)[plan, foot] for x in (command_at, wrench))
    by_log = None
    if own.position.any():
        again = plans_again(config, robot, weights, command, walk, by_log=True)[1]
        from_own = np.concatenate(again[0], axis=-1)[plan, foot]
        by_log = float(np.abs(logged - from_own).max())
    stands = walk.contact[rows]
    other = np.mean(np.any(stands != contact, axis=1)) if walk.contact.any() else 0.0
    unsolved = int(np.sum(~(residual <= SOLVED)))
    time = rows[plan] * float(walk.period)
    return Parity(time, foot, logged, twin, len(rows), by_log, float(other), unsolved=unsolved)


def plans_again(
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    walk: Trajectory,
    *,
    by_log: bool = False,
) -> tuple[Int[np.ndarray, " n"], tuple[Wrench, np.ndarray, np.ndarray]]:
    """Return the samples of the plans of a walk, and their wrenches, stance feet and residuals.

    Args, Raises: see `compare_plans`; `by_log`: from the reference in the log on.
    """
    check_legs(walk)
    per_tick = round(config.gait.tick / float(walk.period))
    every = per_tick * config.twin.plan_ticks
    rows = np.arange(every, int(np.sum(~walk.fallen)), every)
    if not len(rows):
        raise InputError(f"a walk of at least two plans of {config.plan_interval:g} s is needed")
    state, joints, own = jax.tree.map(
        lambda x: x[rows - 1], (walk.state, walk.joints, walk.reference)
    )
    inputs = walk.initial, own if by_log else None, state, joints, rows // per_tick
    return rows, jax.tree.map(np.asarray, _plans(config, robot, weights, command, inputs))


@partial(jax.jit, static_argnums=0)
def _plans(
    config: WalkConfig, robot: Robot, weights: Weights, command: Command, walk: tuple
) -> tuple[Wrench, Array, Array]:
    """Return wrenches, stance feet and residuals of the plans."""
    initial, own, *plans = walk
    anchor, parameters = anchor_at(robot, initial, 0), config.parameters(without_numbers(weights))

    def one(disturbance: Disturbance, inputs: tuple) -> tuple[Disturbance, tuple]:
        desired, state, joints, tick = inputs
        feet = measured_feet(robot, Measurement(state, joints, jnp.zeros_like(joints)))
        planned = plan(
            config,
            robot,
            parameters,
            command=command,
            anchor=anchor,
            tick=tick,
            state=state,
            feet=feet,
            disturbance=disturbance,
            desired=desired,
            max_contacts=contacts_needed(config, 0),
        )
        return planned.disturbance, (planned.wrench, planned.contact, planned.residual)

    _, planned = jax.lax.scan(one, NO_DISTURBANCE, (own, *plans))
    return planned
