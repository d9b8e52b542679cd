"""`hector propose` and `hector report`: tune on walks of a real robot or another simulator."""

from dataclasses import replace

import jax
import numpy as np

from hector_jax.cli import arguments, run_folder
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Propose, Report
from hector_jax.cli.parse import as_table, from_file
from hector_jax.control.parameters import leg_numbers, model_numbers
from hector_jax.core.files import locked, make_folder, write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.robot.model import load_robot
from hector_jax.runs import tunings, walk_log, walks
from hector_jax.runs.campaign import Campaign
from hector_jax.runs.folder import CONFIG


def propose(args: Propose) -> None:
    """Propose the next weights to walk with, the same ones until their walk is reported."""
    path = args.folder / CONFIG
    if path.exists():
        call_flags = ("folder", "json", "processes")
        args = run_folder.merge_flags(args.folder, from_file(Propose, path), args, call_flags)
    campaign = _campaign(args)
    make_folder(args.folder)
    with locked(args.folder), workers(args.processes) as pool:
        rows, space = walks.read_history(campaign), walks.space_of(pool, campaign)
        proposal, _ = walks.next_proposal(pool, campaign, space, rows)
        if not path.exists():  # last, so that rejected flags can be corrected
            write_json(path, {"flags": as_table(args)})
    number = len(rows)
    weights = walks.weights_path(campaign, number)
    result = {"walk": number, "weights": str(weights), "proposed_by": proposal.method}

    def print_text() -> None:
        names = ", ".join(campaign.commands)
        print(f"walk {number}, proposed by {proposal.method}: {weights}")
        print(f"to be walked on {names} for {campaign.seconds:g} s each; then:")
        logs = " ".join(f"{name}.npz" for name in campaign.commands)
        print(f"hector report {args.folder} {logs}")

    print_result(args.json, result, print_text)


def report(args: Report) -> None:
    """Read the logs of the walks with the proposed weights, and evaluate them."""
    path = args.folder / CONFIG
    if not path.exists():
        raise InputError(f"{args.folder}: nothing was proposed here; begin with hector propose")
    campaign = _campaign(replace(from_file(Propose, path), folder=args.folder))
    if len(args.logs) != len(campaign.commands):
        expected = f"a log of each of {', '.join(campaign.commands)}"
        raise InputError(f"LOGS must be {expected}, got {plural(len(args.logs), 'file')}")
    with locked(args.folder), workers(args.processes) as pool:
        rows, space = walks.read_history(campaign), walks.space_of(pool, campaign)
        proposal = walks.pending(campaign, rows)
        if proposal is None:
            raise InputError(f"{args.folder}: no walk is waited for; begin with hector propose")
        logs = [walk_log.read_log(path, campaign.robot, campaign.seconds) for path in args.logs]
        rows = walks.add_walk(campaign, rows, proposal, walks.evaluate_logs(pool, campaign, logs))
        _, best_number = walks.answer(campaign, space, rows)
    number, changes = len(rows) - 1, walks.changes(rows)
    last, best = _text(changes[-1]), _text(changes[best_number])
    weights = walks.weights_path(campaign, best_number)
    result = {"walk": number, **changes[-1]._asdict(), "best": best_number, "weights": str(weights)}

    def print_text() -> None:
        print(f"walk {number}: {last}; best is walk {best_number}, {best}")
        print(f"its weights: {weights}; the next ones: hector propose {args.folder}")

    print_result(args.json, result, print_text)


def _text(change: walks.Change) -> str:
    return "fell" if change.change is None else f"L {change.change:+.1f} % against the start"


def _campaign(args: Propose) -> Campaign:
    """Make the campaign of a folder from its flags.

    Raises:
        InputError: one line with the flag that is wrong.
    """
    robot = jax.tree.map(np.asarray, load_robot(args.robot))
    trajectories = arguments.load_trajectories(args.traj, robot)
    config = tunings.tune_config(robot, others=model_numbers(args.tune))
    config = arguments.with_length(config, trajectories[0])
    start = arguments.weights(args.start, robot)
    commands = {trajectory.name: trajectory.command for trajectory in trajectories}
    inputs = args.folder, config, robot, start, commands
    return Campaign(*inputs, seed=args.seed, leg_numbers=leg_numbers(args.tune))
