"""`hector propose` and `hector log add`: tune on walks of a real robot or another simulator."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hector_jax.cli import arguments, run_folder
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import PROCESSES, Add, Propose, named_file
from hector_jax.cli.parse import as_table, from_file
from hector_jax.control.parameters import tunables
from hector_jax.control.weights_file import load_weights
from hector_jax.core.console import say
from hector_jax.core.files import locked, make_folder, write_json
from hector_jax.core.inputs import InputError, plural, unknown
from hector_jax.core.pool import workers
from hector_jax.own import walk_log
from hector_jax.robot.model import load_robot
from hector_jax.store import tunings
from hector_jax.store.run import CONFIG
from hector_jax.verdict import metrics
from hector_jax.verdict.metrics import Interval
from hector_jax.walk_tuning import added_logs, best_set, walks
from hector_jax.walk_tuning.campaign import Campaign
from hector_jax.walk_tuning.forecasts import foretell_next, walked_next
from hector_jax.walk_tuning.moved import numbers_by_walks


def run_propose(args: Propose) -> None:
    """Propose the next weights to walk with, the same ones until their logs are added."""
    path = args.folder / CONFIG
    if path.exists():
        call_flags = ("folder", "json")
        args = run_folder.merge_flags(args.folder, from_file(Propose, path), args, call_flags)
    campaign = _campaign(args)
    make_folder(args.folder)
    with locked(args.folder), workers(PROCESSES) as pool:
        found = added_logs.read_campaign(pool, campaign)
        write_json(path, {"flags": as_table(args)})  # last, so that rejected flags can be corrected
        told = foretell_next(pool, campaign, found)
    number, ended = found.number, found.tuning.reason
    weights = walks.weights_path(args.folder, number)
    result = {"walk": number, "weights": str(weights), "ended": ended}
    result["foretold"] = {name: _told(one) for name, one in told.items()}

    def print_text() -> None:
        names = ", ".join(campaign.commands)
        again = f", the best set again ({ended})" if ended else ""
        print(f"walk {number}{again}: {weights}")
        for name, one in result["foretold"].items():
            print(f"{name}: {_told_text(one, found.tuning.best)}")
        print(f"to be walked on {names} for {campaign.seconds:g} s each; then:")
        logs = " ".join(f"{name}.npz" for name in campaign.commands)
        print(f"hector log add {args.folder} {logs}")

    print_result(args.json, result, print_text)


def run_add(args: Add) -> None:
    """Read the logs of the walks with the proposed weights and evaluate them, or undo that."""
    path = args.folder / CONFIG
    if not path.exists():
        raise InputError(f"{args.folder}: nothing was proposed here; begin with hector propose")
    campaign = _campaign(replace(from_file(Propose, path), folder=args.folder))
    if args.undo:
        _undo(args, campaign)
        return
    texts = list(map(str, args.logs))
    given = _files(texts, list(campaign.commands))
    tick = campaign.config.rollout.walk.gait.tick
    bags = arguments.logs_of(args, [*given.values()], campaign.robot, campaign.seconds, tick)
    with locked(args.folder), workers(PROCESSES) as pool, bags as paths:
        files = dict(zip(given, paths, strict=True))
        before = added_logs.read_campaign(pool, campaign)
        number, told = before.number, foretell_next(pool, campaign, before)
        named = [name for name, _ in map(named_file, texts)]
        tracked = _check_logs(campaign, number, files, named)
        added_logs.add_logs(campaign, number, list(files.values()))
        found = added_logs.read_campaign(pool, campaign)
    sets, best, again = found.tuning.sets, found.tuning.best, found.again
    changes = walks.changes(sets)
    change = changes[number] if number < len(sets) else again and again.change
    weights = walks.weights_path(args.folder, best)
    result = {"walk": number, "change": change, "best": best, "weights": str(weights)}
    result |= {"again": again and again._asdict(), "ended": found.tuning.reason}
    walked = walked_next(before, found, campaign.commands)
    result["foretold"] = {name: _told(one, walked.get(name)) for name, one in told.items()}

    def print_text() -> None:
        chosen = f"{_text(changes[best])}, in the walk that chose it"
        if again:
            chosen = f"{_text(again.change)}, in walks that did not choose it"
        if again and not again.clear:
            chosen += ": not distinguishable from the start"
        for name, one in result["foretold"].items():
            print(f"{name}: {_told_text(one, before.tuning.best)}")
        print(f"walk {number}: {_text(change)}; best is walk {best}, {chosen}")
        print(f"its weights: {weights}; the next ones: hector propose {args.folder}")

    print_result(args.json, result | {"logs": tracked}, print_text)


def _undo(args: Add, campaign: Campaign) -> None:
    with locked(args.folder):
        number, paths = added_logs.undo_logs(campaign)
    weights, logs = str(walks.weights_path(args.folder, number)), [str(path) for path in paths]
    text = f"walk {number} is to be walked again, with {weights}; its logs: {' '.join(logs)}"
    result = {"walk": number, "weights": weights, "logs": logs}
    print_result(args.json, result, lambda: print(text))


def _files(texts: Sequence[str], names: Sequence[str]) -> dict[str, Path]:
    """Return the log of each trajectory, one by one, from LOGS; else raise an InputError."""
    named: dict[str, Path] = {}
    for name, file in map(named_file, texts):
        if name and name not in names:
            raise InputError(f"LOGS: {unknown('trajectory', name, names)}")
        if name in named:
            raise InputError(f"LOGS has two files for {name}: {named[name]} and {file}")
        if name:
            named[name] = Path(file)
    others = [name for name in names if name not in named]
    plain = [Path(file) for name, file in map(named_file, texts) if not name]
    if len(plain) != len(others):
        expected = f"a log of each of {', '.join(names)}"
        raise InputError(f"LOGS must be {expected}, got {plural(len(texts), 'file')}")
    files = named | dict(zip(others, plain, strict=True))
    return {name: files[name] for name in names}


def _check_logs(
    campaign: Campaign, number: int, files: Mapping[str, Path], named: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Show how the logs track, and refuse those of other walks; returns `walk_log.tracking_errors`.

    The user said of which trajectory the `named` ones are.
    """
    robot, path = campaign.robot, walks.weights_path(campaign.folder, number)
    weights, seconds = load_weights(path, robot), campaign.seconds
    proposed = {
        n: walk_log.walk_card(n, x, weights, robot, seconds) for n, x in campaign.commands.items()
    }
    result, before = {}, [p for n in range(number) for p in walks.log_paths(campaign, n)]
    for name, file in files.items():
        tick = campaign.config.rollout.walk.gait.tick
        log = walk_log.read_log(file, robot, campaign.seconds, tick)
        tracked = {
            n: walk_log.tracking_errors(campaign.config, robot, x, log)
            for n, x in campaign.commands.items()
        }
        result[name] = tracked[name]
        say(f"{file}: {name}; {_tracking_text(result[name])}")
        if not walk_log.check_card(file, name, proposed, path) and name not in named:
            walk_log.check_fit(file, name, tracked)
        if again := [p for p in before if p.read_bytes() == file.read_bytes()]:
            raise InputError(f"{file}: was added before, it is {again[0]}")
    return result


def _tracking_text(tracked: Mapping[str, Any]) -> str:
    x, y, z = 100.0 * np.array(tracked["rms_position"])
    errors = "roll {:.1f}, pitch {:.1f}, yaw {:.1f}".format(*np.degrees(tracked["rms_euler"]))
    start = "x {:.2f}, y {:.2f}, height {:.2f} m".format(*tracked["initial_position"])
    end = f"{'fell after' if tracked['fell'] else 'walked'} {tracked['seconds']:g} s"
    return (
        f"RMS error {np.hypot(x, y):.1f} cm horizontally, {z:.1f} cm in height, {errors} degrees; "
        f"from {start}, yaw {np.degrees(tracked['initial_yaw']):.0f} degrees; {end}"
    )


def _text(change: float | None) -> str:
    return "fell" if change is None else f"L {change:+.1f} % against the start"


def _told(told: Interval | str, walked: float | None = None) -> dict[str, Any]:
    """Return a forecast as JSON values: changes of L [%], and what was walked of it."""
    if isinstance(told, str):
        return {"not foretold": told}
    low, high = (None if np.isnan(x) else 100.0 * float(np.expm1(x)) for x in told[1:])
    found = {"change": 100.0 * float(np.expm1(told.value)), "low": low, "high": high}
    if walked is None or not np.isfinite(walked):
        return found
    held = None if low is None else bool(told.low <= walked <= told.high)
    return found | {"walked": 100.0 * float(np.expm1(walked)), "held": held}


def _told_text(told: Mapping[str, Any], best: int) -> str:
    """Return the line of a forecast against the best set before it, walked or not."""
    if "not foretold" in told:
        return f"not foretold: {told['not foretold']}"
    low, high = (np.nan if told[x] is None else told[x] for x in ("low", "high"))
    text = f"L {Interval(told['change'], low, high).text()} % against walk {best} is foretold"
    if "walked" not in told:
        return text
    held = {True: "as foretold", False: "not as foretold", None: "foretold without an interval"}
    return f"{text}; walked {metrics.percent(told['walked'])} %, {held[told['held']]}"


def _campaign(args: Propose) -> Campaign:
    """Make the campaign of a folder from its flags.

    Raises:
        InputError: one line with the flag that is wrong.
    """
    robot = jax.tree.map(np.asarray, load_robot(args.robot))
    trajectories = arguments.load_trajectories(args.traj, robot)
    config = best_set.on_walks(tunings.tune_config(robot, others=tunables(args.tune)))
    config = arguments.with_length(config, trajectories[0].seconds)
    if (args.folder / CONFIG).exists():  # begun with weights that --start may no longer name
        start = arguments.weights_by_name(str(walks.weights_path(args.folder, 0)), robot)
    else:
        start = arguments.weights_to_tune(args.start, robot, config)
    commands = {trajectory.name: trajectory.command for trajectory in trajectories}
    planner = arguments.planner_of(args)
    if planner and config.others:
        text = "--tune must be weights beside --planner, which plans by Q and R"
        raise InputError(f"{text}, got {' '.join(args.tune)}")
    if legs := numbers_by_walks(numbers := arguments.own_numbers(args, robot)):
        path, names = robot.description.path, ", ".join(of.name for of in legs)
        text = "slopes by walks, which hector tune --walker makes: leave them out here"
        raise InputError(f"{path}: numbers: {names} need {text}")
    config = replace(config, others=(*config.others, *numbers))
    return Campaign(args.folder, config, robot, start, commands, planner=planner)
