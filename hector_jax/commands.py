"""What each command of `hector` does with its flags (flags.py)."""

import dataclasses
import json
import time
from collections.abc import Mapping
from functools import singledispatch
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hector_jax import pipeline
from hector_jax.console import say
from hector_jax.control import weights as named_sets
from hector_jax.control.reference import named_command
from hector_jax.control.walking import WalkConfig
from hector_jax.control.weights import Weights, nominal
from hector_jax.evaluation import metrics
from hector_jax.evaluation.video import VideoUnavailable, write_video
from hector_jax.flags import Collect, Doctor, Train, Walk
from hector_jax.grfm.training import TrainConfig
from hector_jax.model.effect import last_command
from hector_jax.robot import Robot, load_robot
from hector_jax.runtime import cache_folder, workers
from hector_jax.sim.standin import standin
from hector_jax.sim.walk import walk
from hector_jax.sim.world import Imperfections, named_world
from hector_jax.storage import load_weights, save_tree, versions
from hector_jax.trajectory import Trajectory
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import LossConfig
from hector_jax.tuning.rollout import RolloutConfig, rollout, standing_anchor


@singledispatch
def run(args: Any) -> None:
    """Do what the flags of a command ask for.

    Raises:
        ValueError, OSError: one line that says what is wrong with the input.
    """
    raise NotImplementedError(type(args))


def _weights(text: str) -> Weights:
    """A weight set by its name, or from a file."""
    named = {"nominal": named_sets.nominal, "expert": named_sets.expert}
    return named[text]() if text in named else load_weights(Path(text))


def _plants(world: str, seeds: range) -> list[Imperfections]:
    if world == "standin":
        return [standin(seed) for seed in seeds]
    return [named_world(world, seed) for seed in seeds]


def _as_json(flags: Any) -> dict[str, Any]:
    plain = lambda x: x if isinstance(x, bool | int | float | tuple) else str(x)  # noqa: E731
    return {name: plain(value) for name, value in dataclasses.asdict(flags).items()}


@run.register
def _collect(args: Collect) -> None:
    config = pipeline.CollectConfig(args.walks, args.seconds, args.seed)
    with workers(args.processes) as pool:
        pipeline.collect(pool, config, TuneConfig(), load_robot(), args.out)
    say(f"walks are in {args.out}")


@run.register
def _train(args: Train) -> None:
    config = TrainConfig(epochs=args.epochs, seed=args.seed)
    found = pipeline.train(config, load_robot(), args.data, args.out)
    for name, errors in found.errors.items():
        print(
            f"{name:7s} force {errors['force']:8.2f} N^2   moment {errors['moment']:7.4f} (N m)^2"
            "   (held-out walks)"
        )
    say(f"the net is in {args.out}")


@run.register
def _walk(args: Walk) -> None:
    command, weights, robot = named_command(args.traj), _weights(args.weights), load_robot()
    if not args.seconds > 0.0:
        raise ValueError(f"--seconds must be positive, got {args.seconds}")

    def walked(weights: Weights) -> Trajectory:
        if args.world == "srbm":
            return _rigid_body(robot, weights, command, args.seconds)
        plant = _plants(args.world, range(args.seed, args.seed + 1))[0]
        return walk(WalkConfig(), robot, weights, command, plant, args.seconds, args.seed)

    say("compiling (only the first time on a machine) and walking")
    trajectory = walked(weights)
    found = metrics.score(LossConfig(), trajectory)
    upright = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen)))
    if args.out is not None:
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=_as_json(args))
    if args.json:
        losses = {part: float(getattr(found, part)) for part in metrics.PARTS}
        errors = {"rms_position": found.rms_position, "rms_euler": found.rms_euler}
        errors = {name: values.tolist() for name, values in errors.items()}
        print(json.dumps({"seconds": upright, "fell": bool(found.fallen), **losses, **errors}))
    else:
        print(
            f"{args.traj} in {args.world}, {args.weights} weights: "
            + (f"fell after {upright:.2f} s" if found.fallen else f"walked {upright:.2f} s")
            + f"; L {found.L / 1e6:.3f}e6 (L_Eul {found.L_Eul:.2f} rad^2, "
            f"L_pos {found.L_pos:.2f} m^2, L_ctrl {found.L_ctrl / 1e6:.3f}e6)"
        )
        cm, degrees = 100 * found.rms_position, np.degrees(found.rms_euler)
        print("RMS error: x {:.1f}, y {:.1f}, z {:.1f} cm; ".format(*cm), end="")
        print("roll {:.1f}, pitch {:.1f}, yaw {:.1f} degrees".format(*degrees))
    if args.video is not None:
        _film(args.video, robot, {"nominal": walked(nominal()), args.weights: trajectory})


def _rigid_body(robot: Robot, weights: Weights, command: Any, seconds: float) -> Trajectory:
    config = RolloutConfig(ticks=round(seconds / RolloutConfig().walk.gait.tick))
    walked = jax.jit(rollout, static_argnums=0)
    anchor = standing_anchor(robot)
    return jax.device_get(walked(config, robot, weights, command, anchor, last_command))


def _film(
    path: Path, robot: Robot, walks: Mapping[str, Trajectory], strip: Path | None = None
) -> bool:
    """Film two walks; a missing back end costs one line, not the run."""
    try:
        write_video(path, robot, walks, strip)
    except VideoUnavailable as error:
        say(str(error))
        return False
    return True


@run.register
def _doctor(args: Doctor) -> None:
    rows = {
        **versions(),
        "device": ", ".join(str(device) for device in jax.devices()),
        "precision": f"{64 if jax.config.read('jax_enable_x64') else 32} bits",
        "cache": str(cache_folder()),
    }
    for name, text in rows.items():
        print(f"{name:12s} {text}")
    start = time.monotonic()
    run(Walk(world="srbm", weights="expert", seconds=1.0))
    print(f"{'self-test':12s} passed in {time.monotonic() - start:.1f} s")
