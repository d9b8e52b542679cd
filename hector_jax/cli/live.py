"""`hector view --live`: a robot that walks on a page while its weights are turned."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing import Pipe
from typing import Any

import jax
import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.flags import NAMED_WEIGHTS, View
from hector_jax.cli.parse import as_command
from hector_jax.control.reference import named_command
from hector_jax.control.weights import Weights
from hector_jax.core.console import Broken, say
from hector_jax.core.inputs import InputError, require_package, unknown
from hector_jax.core.pool import start_process, workers
from hector_jax.core.settings import Range
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.live import simulate
from hector_jax.sim.loop import Job
from hector_jax.sim.world import WORLDS, named_world
from hector_jax.view.live_page import NUMBERS, serve_live
from hector_jax.view.live_weights import PageSetup
from hector_jax.view.page import opened_server


def run_live(args: View) -> None:
    """Walk on a page until interrupted.

    Raises:
        InputError: a flag is not of a live walk, or the robot's controller is a user's own.
        Broken: the process of the walk has ended.
    """
    for name in ("sets", "seconds", "out"):
        if args.is_given(name):
            raise InputError(f"--{name} is of a run, which does not walk --live")
    if args.world not in WORLDS:
        raise InputError(f"--live walks in {', '.join(WORLDS)}: it tunes; got {args.world}")
    if len(args.weights) > 2:
        raise InputError(f"--weights of a live walk are one or two, got {len(args.weights)}")
    require_package("viser", "view", "the page")
    robot = jax.tree.map(np.asarray, load_robot(args.robot))  # can be sent to a process
    if robot.description.numbers:
        text = "[numbers] are of a controller of your own, whose program is not walked live"
        raise InputError(f"{robot.description.path}: {text}")
    names = arguments.short_names(args.weights)
    sets = {names[text]: arguments.weights_by_name(text, robot) for text in args.weights}
    plant = named_world(args.world, args.seed, robot.description)
    command = named_command("straight")
    jobs = [Job(weights, command, plant, seed=args.seed) for weights in sets.values()]

    def line(**flags: Any) -> str:
        return as_command("hector view", replace(args, **flags))

    texts, named, at = list(args.weights), _named(robot), _numbers(args.at)
    setup = PageSetup(robot, sets, texts, named, args.world, args.seed, at, line)
    here, there = Pipe()
    with workers(1) as pool, opened_server(args.host, args.port) as (server, address):
        process = start_process(simulate, there, robot, jobs)
        there.close()
        say(f"open {address} in a browser; Ctrl-C ends it")
        try:
            serve_live(server, setup, here, pool)
        except (EOFError, ConnectionError):
            raise Broken("the process in which the robot walks has ended") from None
        finally:
            process.kill()


def _numbers(texts: Sequence[str]) -> dict[str, float]:
    """Read numbers of a live walk, NAME=VALUE each."""
    found = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign or name in found:
            raise InputError(f"--at takes NAME=VALUE, each name once, got {text}")
        if name not in NUMBERS:
            raise InputError(f"--at {text}: {unknown('number', name, NUMBERS)}")
        _, low, high, _ = NUMBERS[name]
        with suppress(ValueError):
            found[name] = float(value)
        if name not in found or found[name] not in Range(low, high):
            raise InputError(f"--at {name} must be a number {Range(low, high)}, got {value!r}")
    return found


def _named(robot: Robot) -> dict[str, Weights]:
    """Return the named sets that the robot has."""
    found = {}
    for name in NAMED_WEIGHTS:
        with suppress(InputError):  # a robot may ship no set
            found[name] = arguments.weights_by_name(name, robot)
    return found
