"""A program of the user that plans, with his own controller: what a tuning asks of it.

For the plans of a walk it is called (`program`) as

    FILE inputs.npz plans.npz

The inputs are those of `PlanInputs`, by entries named like its leaves, such as `state.euler` (N, 3)
and `weights.Q.position` (N, 3); its plans are `force`, `moment` and `touchdown` (N, feet, 3).
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import Tunable, name_of, numbers_of, own_names
from hector_jax.control.reference import Command
from hector_jax.control.twin import TwinConfig
from hector_jax.control.weights import Weights, direction_names
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree_file import named_leaves
from hector_jax.own.conventions import EXACT, usual_costs
from hector_jax.own.parity import Parity
from hector_jax.own.program import Program, call_program
from hector_jax.own.walk_file import read_entries
from hector_jax.robot.model import Robot
from hector_jax.tuning.called import (
    CalledPlans,
    CallPlans,
    PlanInputs,
    Planned,
    call_along,
    call_rows,
    move_sizes,
)
from hector_jax.tuning.grounded import begins_of_ticks

JUMP = 0.02  # share of the weight by which a plan may change with the smallest moves
_CLOSER = 0.3  # share of the distance to a log that is left if another convention explains it


def call_planner(planner: Program, asked: PlanInputs) -> Planned:
    """Let a program plan.

    Raises:
        InputError: see `program.call_program`; or an entry of its plans is missing or wrong.
    """
    rows, feet = asked.contact.shape
    with TemporaryDirectory(prefix="hector-plan-") as folder:
        inputs, plans = Path(folder) / "inputs.npz", Path(folder) / "plans.npz"
        np.savez(inputs, **named_leaves(asked))
        call_program(planner, inputs, plans)
        try:
            found = read_entries(plans, Planned._fields)
        except InputError as error:
            raise InputError(str(error).replace(str(plans), f"{planner.path}: its plans")) from None
    for name in Planned._fields:
        if name not in found:
            raise InputError(f"{planner.path}: its plans: {name} is missing")
        x, shape = found[name], (rows, feet, 3)
        if x.shape != shape or x.dtype.kind not in "iuf" or np.isinf(x).any():
            text = f"{name} must hold numbers of shape {shape}, NaN where a plan is not solved"
            raise InputError(f"{planner.path}: its plans: {text}; got {x.dtype} of {x.shape}")
    return Planned(**found)


def plan_inputs(
    config: WalkConfig, robot: Robot, weights: Weights, command: Command, walk: Trajectory
) -> PlanInputs:
    """Return what a controller planned from in all ticks of a walk but the first.

    Args:
        config, robot: tick of the gait; the nominal body.
        weights, command: of the walk.
        walk: at the plan interval; up to a fall.

    Raises:
        InputError: the walk is shorter than two plans.
    """
    if (stood := int(np.sum(~walk.fallen))) <= 2 * config.twin.plan_ticks:
        raise InputError(f"a walk of at least two plans of {config.plan_interval:g} s is needed")
    samples = walk._replace(period=None, initial=None)
    walk = jax.tree.map(lambda x: x[:stood], samples)._replace(
        period=walk.period, initial=walk.initial
    )
    _, begins = begins_of_ticks(robot, walk)
    stands = walk.contact if walk.contact.any() else np.any(walk.command.force != 0.0, axis=-1)
    return PlanInputs(
        time=config.gait.tick * np.arange(1, len(stands)),
        state=begins.state,
        feet=begins.feet,
        contact=stands[1:],
        weights=weights,
        command=command,
        initial=walk.initial,
    )


def called_plans(
    call: CallPlans, config: WalkConfig, inputs: PlanInputs, numbers: Sequence[Tunable] = ()
) -> CalledPlans:
    """Call a controller along a walk, for `grounded.fit_grounding`.

    Args:
        call: the controller, such as `call_planner` of a program.
        config: ticks between plans.
        inputs: from `plan_inputs`.
        numbers: of the controller, that its plans use.

    Raises:
        InputError: see `call_planner`; or no plan is solved.
    """
    called = call_along(call, inputs, plans_at(config, inputs), numbers)
    if not called.made.any():
        raise InputError("the planner solves no plan of a walk: all its rows have NaN")
    return called


def plans_at(config: WalkConfig, inputs: PlanInputs) -> Bool[np.ndarray, " T"]:
    """Return at which ticks of a walk the controller plans."""
    return np.arange(1, 1 + len(inputs.time)) % config.twin.plan_ticks == 0


def distance_to_log(
    call: CallPlans, config: WalkConfig, inputs: PlanInputs, walk: Trajectory
) -> float:
    """Return the largest difference of plans by call from the commands of a walk [N, N m].

    Args, Raises: see `compare_calls`.
    """
    rows = np.flatnonzero(plans_at(config, inputs))
    logged = np.concatenate(walk.command, axis=-1)[1:][rows]
    away = np.abs(call_rows(call, inputs, rows)[..., :6] - logged)[inputs.contact[rows]]
    return float(np.nanmax(away, initial=0.0))


class CallCheck(NamedTuple):
    """What calling a planner along a log shows."""

    parity: Parity  # of the plans by call, in place of those of a twin
    memory: float  # [N, N m] largest difference between two calls, the other one in reverse order
    jumps: float  # share of the plans that jump when a state or a foot is moved a little
    unused_weights: tuple[str, ...]  # names of the weights, and of its numbers, that change no plan
    touchdowns_follow: bool  # whether the touchdowns follow the velocity
    convention: tuple[str, ...]  # that makes them those of the log, see `_closest`
    distance: float  # [N, N m] largest difference then


def _closest(
    logged: Float[np.ndarray, "N feet 6"],
    called: Float[np.ndarray, "N feet 6"],
    euler: Float[np.ndarray, "N 3"],
    contact: Bool[np.ndarray, "N feet"],
) -> tuple[tuple[str, ...], float]:
    """Return under which other conventions plans are closest to a log, and their distance then.

    Tried are left and right exchanged, the sign of the wrenches and the axes that they are in.
    """
    heading, trunk = (
        np.asarray(jax.vmap(rotation_from_euler)(angles))
        for angles in (euler * np.array([0.0, 0.0, 1.0]), euler)
    )
    world = np.broadcast_to(np.eye(3), trunk.shape)
    axes = {
        "": world,
        "turned out of the heading's axes": heading,
        "turned out of the trunk's axes": trunk,
        "turned into the heading's axes": np.swapaxes(heading, 1, 2),
        "turned into the trunk's axes": np.swapaxes(trunk, 1, 2),
    }
    left_right = np.arange(called.shape[1]).reshape(-1, 2)[:, ::-1].ravel()
    found = {}
    for (turned, R), feet, sign in product(axes.items(), ("", "left and right exchanged"), (1, -1)):
        ordered = called[:, left_right] if feet else called
        parts = sign * ordered.reshape(*ordered.shape[:2], 2, 3)
        there = np.einsum("nij,nfpj->nfpi", R, parts).reshape(called.shape)
        words = turned, feet, "reversed" if sign < 0 else ""
        found[tuple(filter(None, words))] = float(np.abs(there - logged)[contact].max())
    closest = min(found, key=lambda words: found[words])
    return closest, found[closest]


def _convention(
    call: CallPlans,
    config: WalkConfig,
    asked: PlanInputs,
    rows: np.ndarray,
    *,
    logged: Float[np.ndarray, "N feet 6"],
    called: Float[np.ndarray, "N feet 6"],
    least: float,
) -> tuple[tuple[str, ...], float]:
    """Return the convention that explains most of the distance of plans to a log, and the rest.

    Tried are those of `_closest`, angles in the other order and other units of R. Below `least` no
    other one is sought.
    """
    state, stands = asked.state, np.asarray(asked.contact)[rows]
    as_is = float(np.abs(called - logged)[stands].max(initial=0.0))
    if as_is <= least:
        return (), as_is
    turned = asked._replace(state=state._replace(euler=state.euler[:, ::-1]))
    tried = {"if it is asked with the angles yaw, pitch, roll": turned}
    for factor in usual_costs(config.mpc_step)[1:]:
        weights = replace(TwinConfig(), input_cost=factor).weights(asked.weights)
        tried[f"if it is asked with {factor:g} times R"] = asked._replace(weights=weights)
    euler = state.euler[rows]
    words, distance = _closest(logged, called, euler, stands)
    for text, other in tried.items():
        if distance <= least:
            break
        try:
            plans = call_rows(call, other, rows)[..., :6]
        except InputError:  # a program may refuse what it is never asked in a walk
            continue
        if np.isfinite(plans).all():
            more, left = _closest(logged, plans, euler, stands)
            if left < _CLOSER * distance:
                words, distance = (*more, text), left
    return (words if distance < _CLOSER * as_is else ()), distance


def compare_calls(
    call: CallPlans, config: WalkConfig, robot: Robot, inputs: PlanInputs, walk: Trajectory
) -> CallCheck:
    """Call a controller along a log, and compare its plans with the commands of the log.

    Args:
        call: the controller, such as `call_planner` of a program.
        config, robot: of `plan_inputs`.
        inputs: of the walk.
        walk: the log.

    Raises:
        InputError: see `called_plans`.
    """
    numbers = [of for of in numbers_of(robot.description) if not of.of_legs]
    first = called_plans(call, config, inputs, numbers)
    # another order, in which a plan that rests on the one before it is another
    rows = np.flatnonzero(first.made)
    again = call_rows(call, inputs, rows[::-1])[::-1] - first.values[rows]
    row, foot = np.nonzero(first.made[:, None] & first.contact)
    logged = np.concatenate(walk.command, axis=-1)[1:]
    called = np.asarray(first.values)[..., :6]
    parity = Parity(
        time=inputs.time[row],
        foot=foot,
        logged=logged[row, foot],
        twin=called[row, foot],
        plans=int(first.made.sum()),
        by_log=None,
        other_contact=0.0,
        unsolved=0,
    )
    body = first.body.shape[1]
    by_body, by_weights = np.split(first.slopes[first.made], [body], axis=-1)
    changes = np.abs(by_body[..., :6, :]).max(axis=(1, 2)) * move_sizes(body)
    weight = float(robot.mass * np.linalg.norm(robot.gravity))
    names = *direction_names(inputs.weights), *own_names(inputs.weights)
    asked = {*direction_names(inputs.weights), *map(name_of, numbers)}
    plans = {"logged": logged[rows], "called": called[rows], "least": EXACT * weight}
    convention, distance = _convention(call, config, inputs, rows, **plans)
    unused = np.abs(by_weights).max(axis=(0, 1, 2)) == 0.0
    return CallCheck(
        parity,
        memory=float(np.nanmax(np.abs(again))),
        jumps=float(np.mean(changes.max(axis=1) > JUMP * weight)),
        unused_weights=tuple(
            name for name, none in zip(names, unused, strict=True) if none and name in asked
        ),
        touchdowns_follow=bool(np.any(by_body[..., 6:8, 9:11])),
        convention=convention,
        distance=distance,
    )
