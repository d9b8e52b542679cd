"""A program of the user that plans, with his own controller: what a tuning asks of it.

For the plans of a walk it is called (`program`) as

    FILE inputs.npz plans.npz

The inputs are those of `PlanInputs`, by entries named like its leaves, such as `state.euler` (N, 3)
and `weights.Q.position` (N, 3); its plans are `force`, `moment` and `touchdown` (N, feet, 3).
"""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import jax
import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.control.parameters import step_names
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree_file import named_leaves
from hector_jax.own.parity import Parity
from hector_jax.own.program import Program, call_program
from hector_jax.own.walk_file import read_entries
from hector_jax.robot.model import Robot
from hector_jax.tuning.called import CalledPlans, PlanInputs, Planned, call_along, move_sizes
from hector_jax.tuning.grounded import begins_of_ticks

_JUMP = 0.02  # share of the weight by which a plan may change with the smallest moves


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
        found = read_entries(plans, Planned._fields)
    for name in Planned._fields:
        got = np.shape(found.get(name, "none"))
        if got != (rows, feet, 3) or not np.isfinite(found[name]).all():
            text = f"{name} must hold finite numbers of shape {(rows, feet, 3)}"
            raise InputError(f"{planner.path}: its plans: {text}, got shape {got}")
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
    if (stood := int(np.sum(~walk.fallen))) < 3:
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


def called_plans(planner: Program, config: WalkConfig, inputs: PlanInputs) -> CalledPlans:
    """Call a program along a walk, for `grounded.fit_grounding`.

    Args:
        planner: the program.
        config: ticks between plans.
        inputs: from `plan_inputs`; all numbers beside Q and R are tuned.

    Raises:
        InputError: see `call_planner`.
    """
    made = np.arange(1, 1 + len(inputs.time)) % config.twin.plan_ticks == 0
    return call_along(partial(call_planner, planner), inputs, made, tuple(inputs.weights.others))


class Calls(NamedTuple):
    """What calling a planner along a log shows."""

    parity: Parity  # of the plans by call, in place of those of a twin
    again: float  # [N, N m] largest difference between two calls at the same inputs
    jumps: float  # share of the plans that jump when a state or a foot is moved a little
    idle: tuple[str, ...]  # names of the weights that change no plan
    steps: bool  # whether the touchdowns follow the velocity


def compare_calls(
    planner: Program, config: WalkConfig, robot: Robot, inputs: PlanInputs, walk: Trajectory
) -> Calls:
    """Call a planner along a log, and compare its plans with the commands of the log.

    Args:
        planner: the program.
        config, robot: of `plan_inputs`.
        inputs: of the walk.
        walk: the log.

    Raises:
        InputError: see `call_planner`.
    """
    first, second = (called_plans(planner, config, inputs) for _ in range(2))
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
    names = step_names(inputs.weights, tuple(inputs.weights.others))
    idle = np.abs(by_weights).max(axis=(0, 1, 2)) == 0.0
    return Calls(
        parity,
        again=float(np.abs(second.values - first.values).max()),
        jumps=float(np.mean(changes.max(axis=1) > _JUMP * weight)),
        idle=tuple(name for name, none in zip(names, idle, strict=True) if none),
        steps=bool(np.any(by_body[..., 6:8, 9:11])),
    )
