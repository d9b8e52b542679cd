"""A program of the user that plans, with his own controller: what a tuning asks of it.

For the plans of a walk it is called (`program`) as

    FILE inputs.npz plans.npz

The inputs are those of `PlanInputs`, by entries named like its leaves, such as `state.euler` (N, 3)
and `weights.Q.position` (N, 3); its plans are `force`, `moment` and `touchdown` (N, feet, 3).
"""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import Command
from hector_jax.control.weights import Weights
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import Trajectory
from hector_jax.core.tree_file import named_leaves
from hector_jax.own.program import Program, run
from hector_jax.own.walk_file import read_entries
from hector_jax.robot.model import Robot
from hector_jax.tuning.called import CalledPlans, PlanInputs, Planned, call_along
from hector_jax.tuning.grounded import begins_of_ticks


def call_planner(planner: Program, asked: PlanInputs) -> Planned:
    """Let a program plan.

    Raises:
        InputError: see `program.run`; or an entry of its plans is missing or of another shape.
    """
    rows, feet = asked.contact.shape
    with TemporaryDirectory(prefix="hector-plan-") as folder:
        inputs, plans = Path(folder) / "inputs.npz", Path(folder) / "plans.npz"
        np.savez(inputs, **named_leaves(asked))
        run(planner, inputs, plans)
        found = read_entries(plans, Planned._fields)
    for name in Planned._fields:
        got = np.shape(found.get(name, "none"))
        if got != (rows, feet, 3) or not np.isfinite(found[name]).all():
            text = f"{name} must hold finite numbers of shape {(rows, feet, 3)}"
            raise InputError(f"{planner.path}: its plans: {text}, got shape {got}")
    return Planned(**found)


def called_plans(
    planner: Program,
    config: WalkConfig,
    robot: Robot,
    weights: Weights,
    command: Command,
    walk: Trajectory,
) -> CalledPlans:
    """Call a program along a walk, for `grounded.fit_grounding`.

    Args:
        planner: the program.
        config, robot: tick of the gait and ticks between plans; the nominal body.
        weights, command: of the walk; all numbers beside Q and R are tuned.
        walk: at the plan interval, without a fall.

    Raises:
        InputError: see `call_planner`.
    """
    _, begins = begins_of_ticks(robot, walk)
    stands = walk.contact if walk.contact.any() else np.any(walk.command.force != 0.0, axis=-1)
    ticks = np.arange(1, len(stands))
    inputs = PlanInputs(
        time=config.gait.tick * ticks,
        state=begins.state,
        feet=begins.feet,
        contact=stands[1:],
        weights=weights,
        command=command,
        initial=walk.initial,
    )
    made = ticks % config.twin.plan_ticks == 0
    call = partial(call_planner, planner)
    return call_along(call, inputs, made, tuple(weights.others))
