"""What this machine offers, and whether the program works on it."""

import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp

from hector_jax.control.reference import named_command
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import expert
from hector_jax.evaluation.report import environment
from hector_jax.evaluation.video import VideoConfig, VideoUnavailable, write_film
from hector_jax.grfm.dataset import SOLVED
from hector_jax.pipeline import walk_rigid_body
from hector_jax.robot import MODEL_PATH, Robot, load_robot
from hector_jax.runtime import cache_folder
from hector_jax.sim.walk import walk
from hector_jax.sim.world import named_world
from hector_jax.storage import versions
from hector_jax.trajectory import Trajectory

_EXTRAS = {"search": "cmaes", "tensorboard": "tensorboardX", "view": "viser"}


def examine() -> tuple[dict[str, str], list[str]]:
    """Look over the machine and walk a little.

    Returns:
        What there is, a line by name, and what is broken, empty on a sound machine. A missing
        extra or video back end is told but breaks nothing: runs go on without.
    """
    faults: list[str] = []
    try:
        devices = jax.devices()
    except RuntimeError as error:
        return versions(), [f"JAX finds no device: {_one_line(error)}"]
    told = {name: text for name, text in environment().items() if name != "device"}
    if told.get("mujoco") != told.get("mujoco-mjx"):
        faults.append("mujoco and mujoco-mjx are of different releases")
    told["devices"] = ", ".join(f"{one} ({one.device_kind})" for one in devices)
    if jnp.asarray(0.0).dtype != jnp.float64:
        faults.append("JAX computes in 32 bits")
    told["cache"] = str(cache_folder())
    extras = [f"{x}: {'yes' if find_spec(p) else 'no'}" for x, p in _EXTRAS.items()]
    told["extras"] = ", ".join(extras)
    try:
        robot = load_robot()
        told["robot"] = f"{MODEL_PATH}, {float(robot.mass):.2f} kg"
        start = time.monotonic()
        walks = _walks(robot)
        told["self-test"] = f"walks in {' and '.join(walks)}: {time.monotonic() - start:.1f} s"
    except (ValueError, OSError, RuntimeError) as error:
        faults.append(f"self-test: {_one_line(error)}")
        return told, faults
    faults += [
        f"self-test: the robot does not walk in {world}"
        for world, found in walks.items()
        if found.fallen.any() or not found.residual.max() <= SOLVED
    ]
    told["video"] = _video(robot, walks["ideal"])
    return told, faults


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


def _walks(robot: Robot) -> dict[str, Trajectory]:
    """Two seconds on the rigid body; in MuJoCo the start and a little more."""
    command = named_command("straight")
    return {
        "srbm": walk_rigid_body(robot, expert(), command, 2.0),
        "ideal": walk(WalkConfig(), robot, expert(), command, named_world("ideal", 0), 0.2),
    }


def _video(robot: Robot, walked: Trajectory) -> str:
    with tempfile.TemporaryDirectory() as folder:
        pair = {"one": walked, "other": walked}
        try:
            film = Path(folder) / "film.mp4"
            return f"works ({write_film(film, robot, pair, VideoConfig(rate=2))})"
        except VideoUnavailable as error:
            return str(error)
