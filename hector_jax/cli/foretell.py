"""`hector log foretell`: what other weights would bring on the robot of a log, with intervals."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Foretell
from hector_jax.core.console import say
from hector_jax.own.planner import call_planner
from hector_jax.robot.model import load_robot
from hector_jax.store import tunings
from hector_jax.verdict import metrics
from hector_jax.verdict.foretell import (
    COVERAGE,
    HERE,
    Foretold,
    forecast,
    foretell,
    group_of,
    held_by_means,
    quantities,
    read_logged,
    widening,
)
from hector_jax.verdict.metrics import Interval

_SHOWN: dict[str, tuple[str, float]] = {
    "plane": ("plane [cm]", 100.0),
    "height": ("height [cm]", 100.0),
    "pitch": ("pitch [deg]", 180.0 / np.pi),
    "yaw": ("yaw [deg]", 180.0 / np.pi),
}
"""Errors by name: their column, and the factor of its unit."""


def run_foretell(args: Foretell) -> None:
    """Foretell the walks of weight sets on the robot of some logs."""
    robot = load_robot(args.robot)
    trajectory = arguments.load_trajectory(args.traj, robot)
    seconds = arguments.walk_seconds(args, trajectory)
    config = arguments.with_length(tunings.tune_config(robot), seconds)
    walked = arguments.weights_by_name(args.walked, robot)
    names = arguments.short_names(args.weights)
    sets = {names[text]: arguments.weights_by_name(text, robot) for text in args.weights}
    planner = arguments.planner_of(args)
    options: dict[str, Any] = {"call": planner and partial(call_planner, planner), "walked": walked}
    say("compiling (only the first time on a machine) and foretelling")
    logged, found = [], []
    tick = config.rollout.walk.gait.tick
    with arguments.logs_of(args, args.logs, robot, seconds, tick) as paths:
        for path in paths:
            walk, score = read_logged(path, config, robot, trajectory.command)
            logged.append(quantities(score))
            found.append(foretell(config, robot, trajectory.command, walk, sets, **options))
        group = group_of(robot, paths, called=planner is not None)
    result = {
        "walked": {"name": args.walked, **_mean(logged)},
        "sets": {name: _set_result(found, name, group, _mean(logged)) for name in sets},
        "calibration": group,
        "wider": max(widening(one, group) for one in found),
    }
    print_result(args.json, result, lambda: print(*_lines(result, len(found)), sep="\n"))


def _mean(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return geometric means of the quantities of some walks."""
    with np.errstate(divide="ignore"):  # a quantity may be zero
        return {n: float(np.exp(np.mean([np.log(row[n]) for row in rows]))) for n in rows[0]}


def _set_result(
    found: Sequence[Foretold], name: str, group: str, logged: Mapping[str, float]
) -> dict[str, Any]:
    """Return what logs foretell of a set as JSON values: each quantity, its change, its margins."""
    each = [forecast(one, name, group) for one in found]
    tilts, heights = zip(*(one.margins[name] for one in found), strict=True)
    falls = any(bool(one.scores[name].fallen) for one in found)
    result: dict[str, Any] = {
        "falls": falls,
        "tilt": max(tilts),
        "height_over_limit": min(heights),
    }
    for quantity in each[0]:
        ratio = np.mean([one[quantity] for one in each], axis=0)  # with the ends of its interval
        value, change = logged[quantity] * np.exp(ratio), 100.0 * np.expm1(ratio)
        keys = "value", "low", "high"
        result[quantity] = dict(zip(keys, value.tolist(), strict=True)) | {
            "change": dict(zip(keys, change.tolist(), strict=True)),
            "logs": [100.0 * float(np.expm1(one[quantity].value)) for one in each],
        }
    return result


def _lines(result: Mapping[str, Any], logs: int) -> Iterator[str]:
    """Return the lines of a forecast: a table, the falls, and what the intervals rest on."""
    head = ["set", *(title for title, _ in _SHOWN.values()), "L [%]"]
    errors = [f"{result['walked'][name] * factor:.1f}" for name, (_, factor) in _SHOWN.items()]
    rows = [head, [f"{result['walked']['name']} (walked)", *errors, ""]]
    for name, row in result["sets"].items():
        cells = [
            _text(row[x], lambda v, f=factor: f"{v * f:.1f}") for x, (_, factor) in _SHOWN.items()
        ]
        rows.append([name, *cells, _text(row["L"]["change"], metrics.percent)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for first, *others in rows:
        cells = [text.rjust(width) for text, width in zip(others, widths[1:], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *cells])
    of = "HECTOR in this simulator" if result["calibration"] == HERE else "other robots and engines"
    yield f"in brackets {100 * COVERAGE:.0f} % intervals, by forecasts that were walked: {of}"
    if (wider := result["wider"]) > 1.0:
        text = f"{wider:.1f} times as wide as measured: the rigid body explains less of this walk"
        yield f"they are {text} than of any that was measured"
    if logs > 1:
        held, cases = held_by_means(result["calibration"], logs) or (0, 0)
        told = f"held in {held} of {cases} cases" if cases else "that was not measured"
        yield f"means of {logs} logs, with intervals of one: {told}"
    for name, row in result["sets"].items():
        if row["falls"]:
            yield f"{name} falls in its foretold walk: the numbers of its row are no forecast"
            continue
        tilt, height = 100 * row["tilt"], row["height_over_limit"]
        text = f"its foretold walk tilts to {tilt:.0f} % of a fall's angle, the trunk stays at"
        yield f"falls of {name} are not foretold; {text} {height:.1f} times a fall's height"


def _text(values: Mapping[str, float], write: Callable[[float], str]) -> str:
    return Interval(*(values[key] for key in ("value", "low", "high"))).text(write)
