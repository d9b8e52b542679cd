"""The command `hector doctor`: list versions and devices of this machine, and test it."""

import os
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp

from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Doctor
from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert
from hector_jax.core.console import Broken, say
from hector_jax.core.environment import environment
from hector_jax.core.inputs import InputError, one_line
from hector_jax.core.numerics import not_used, without_our_flags
from hector_jax.core.runtime import cache_folder
from hector_jax.core.trajectory import SOLVED, Trajectory
from hector_jax.robot.description import MODEL_PATH
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.engine import ENGINES, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import named_world
from hector_jax.verdict.judging import walk_rigid_body
from hector_jax.view.motion import motions
from hector_jax.view.video import VideoConfig, VideoUnavailable, write_film

_EXTRAS = {  # name: (packages that it needs, what needs it)
    "cluster": (("distributed",), "--cluster"),
    "race": (("botorch", "cma", "cmaes"), "experiments/race.py"),
    "view": (("viser",), "hector view"),
}


def run_doctor(args: Doctor) -> None:
    """Report what is installed on this machine and test it.

    Raises:
        Broken: a test failed.
    """
    say("testing this machine: two short walks and a film")
    facts, faults = examine()
    lines = "\n".join(f"{name:12s} {text}" for name, text in facts.items())
    print_result(args.json, {**facts, "faults": faults}, lambda: print(lines))
    if faults:
        raise Broken("; ".join(faults))


def examine() -> tuple[dict[str, str], list[str]]:
    """Examine the machine and run two short walks.

    Returns:
        Facts, one line by name, and faults, empty on a working machine. A missing extra or video
        back end is a fact, not a fault, because runs work without it.
    """
    faults: list[str] = []
    facts = {name: text for name, text in environment().items() if name != "device"}
    if facts.get("mujoco") != facts.get("mujoco-mjx"):
        faults.append("mujoco and mujoco-mjx are of different releases")
    facts["devices"] = ", ".join(f"{device} ({device.device_kind})" for device in jax.devices())
    if jnp.asarray(0.0).dtype != jnp.float64:
        faults.append("JAX computes in 32 bits")
    facts["cache"] = str(cache_folder())
    facts |= _variables()
    facts["engines"] = ", ".join(
        f"{name}: {engine.version or 'no'}" for name, engine in ENGINES.items()
    )
    for name in [name for name, engine in ENGINES.items() if engine.version]:
        try:
            choose_engine(name)
        except InputError as error:
            faults.append(str(error))
    facts["extras"] = ", ".join(
        f"{name}: {'yes' if all(map(find_spec, packages)) else 'no'} (for {use})"
        for name, (packages, use) in _EXTRAS.items()
    )
    try:
        robot = load_robot()
        facts["robot"] = f"{MODEL_PATH}, {float(robot.mass):.2f} kg"
        start = time.monotonic()
        walks = _walks(robot)
        facts["self-test"] = f"walks in {' and '.join(walks)}: {time.monotonic() - start:.1f} s"
    except (ValueError, OSError, RuntimeError) as error:
        faults.append(f"self-test: {one_line(error)}")
        return facts, faults
    faults += [
        f"self-test: the robot does not walk in {world}"
        for world, trajectory in walks.items()
        if trajectory.fallen.any() or not trajectory.residual.max() <= SOLVED
    ]
    try:
        with tempfile.TemporaryDirectory() as folder:  # of a film of two frames per second
            pair = motions(robot, {"one": walks["ideal"], "other": walks["ideal"]})
            back_end = write_film(Path(folder) / "film.mp4", robot, pair, VideoConfig(rate=2))
        facts["video"] = f"works ({back_end})"
    except VideoUnavailable as error:
        facts["video"] = str(error)
        if "MUJOCO_GL" in os.environ:  # the user chose a back end
            faults.append(f"MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}")
    return facts, faults


def _variables() -> dict[str, str]:
    """Return what the environment sets of JAX and XLA, and what was done with it."""
    names = ("XLA_FLAGS", *(name.upper() for name in sorted(jax.config.values)))
    used = {name: os.environ[name] for name in names if os.environ.get(name)}
    used["XLA_FLAGS"] = without_our_flags(used.get("XLA_FLAGS", ""))
    return {name: f"{text} (used)" for name, text in used.items() if text} | {
        name: f"{text} (not used: {name.lower()} is {jax.config.values[name.lower()]})"
        for name, text in not_used().items()
    }


def _walks(robot: Robot) -> dict[str, Trajectory]:
    """Walk two seconds on the rigid body, and 0.2 s after the start-up in MuJoCo."""
    command = named_command("straight")
    job = Job(expert(), command, named_world("ideal"), 0.2)
    return {
        "srbm": walk_rigid_body(robot, expert(), command, 2.0),
        "ideal": walk(WalkConfig(), robot, job),
    }
