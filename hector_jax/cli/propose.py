"""`hector propose` and `hector report`: tuning on walks that somebody else walks."""

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from hector_jax.cli import arguments, run_folder
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Propose, Report
from hector_jax.cli.parse import as_table, from_file
from hector_jax.control.parameters import tunables
from hector_jax.core.files import locked, make_folder, write_json
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.runtime import workers
from hector_jax.robot.model import load_robot
from hector_jax.runs import tunings, walk_log, walks
from hector_jax.runs.folder import CONFIG
from hector_jax.runs.walks import Campaign


def propose(args: Propose) -> None:
    """Name the weights to walk next, the same ones until their walk was reported."""
    path = args.folder / CONFIG
    if path.exists():
        of_a_call = ("folder", "json", "processes")
        args = run_folder.agreed(args.folder, from_file(Propose, path), args, of_a_call)
    one = _campaign(args)
    make_folder(args.folder)
    with locked(args.folder), workers(args.processes) as pool:
        rows, space = walks.read_history(one), walks.space_of(pool, one)
        proposal, _ = walks.next_proposal(pool, one, space, rows)
        if not path.exists():  # last: flags that were refused can be mended
            write_json(path, {"flags": as_table(args)})
    number = len(rows)
    weights = walks.weights_path(one, number)
    result = {"walk": number, "weights": str(weights), "proposed_by": proposal.method}

    def in_words() -> None:
        print(f"walk {number}, proposed by {proposal.method}: {weights}")
        print(f"to be walked on {', '.join(one.commands)} for {one.seconds:g} s each; then:")
        logs = " ".join(f"{name}.npz" for name in one.commands)
        print(f"hector report {args.folder} {logs}")

    print_result(args.json, result, in_words)


def report(args: Report) -> None:
    """Take in the logs of the walks with the weights that were proposed."""
    path = args.folder / CONFIG
    if not path.exists():
        raise InputError(f"{args.folder}: nothing was proposed here; begin with hector propose")
    one = _campaign(replace(from_file(Propose, path), folder=args.folder))
    if len(args.logs) != len(one.commands):
        expected = f"a log of each of {', '.join(one.commands)}"
        raise InputError(f"LOGS must be {expected}, got {plural(len(args.logs), 'file')}")
    with locked(args.folder), workers(args.processes) as pool:
        rows, space = walks.read_history(one), walks.space_of(pool, one)
        rows = _take(pool, one, rows, args.logs)
        _, which = walks.answer(one, space, rows)
    last, best = (walks.changes(rows)[i] for i in (-1, which))
    result = {"walk": len(rows) - 1, **last._asdict(), "best": which}
    best_file = walks.weights_path(one, which)

    def in_words() -> None:
        print(f"walk {len(rows) - 1}: {_text(last)}; best is walk {which}, {_text(best)}")
        print(f"its weights: {best_file}; the next ones: hector propose {args.folder}")

    print_result(args.json, result | {"weights": str(best_file)}, in_words)


def _text(change: walks.Change) -> str:
    return "fell" if change.change is None else f"L {change.change:+.1f} % against the start"


def _take(pool: Executor, one: Campaign, rows: list[walks.Row], paths: tuple[Path, ...]) -> list:
    proposal = walks.pending(one, rows)
    if proposal is None:
        raise InputError(f"{one.folder}: no walk is waited for; begin with hector propose")
    logs = [walk_log.read_log(path, one.robot, one.seconds) for path in paths]
    return walks.add_walk(one, rows, proposal, walks.see(pool, one, logs))


def _campaign(args: Propose) -> Campaign:
    """The settings of a folder.

    Raises:
        InputError: one line with the flag that is wrong.
    """
    robot = jax.tree.map(np.asarray, load_robot(args.robot))
    courses = arguments.courses(args.traj, robot)
    config = tunings.tune_config(robot, others=tunables(args.tune))
    config = arguments.with_length(config, courses[0])
    start = arguments.weights(args.start, robot)
    commands = {one.name: one.command for one in courses}
    return walks.campaign(args.folder, config, robot, start, commands, seed=args.seed)
