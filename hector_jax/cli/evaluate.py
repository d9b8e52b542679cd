"""Evaluation of weight sets, walks and runs."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.flags import Compare, Evaluate, Walk
from hector_jax.cli.parse import as_table
from hector_jax.control.controller import walk_config
from hector_jax.control.weights import expert, nominal
from hector_jax.core.console import Broken, say
from hector_jax.core.files import as_json, write_json
from hector_jax.core.inputs import InputError, plural, printable
from hector_jax.core.runtime import workers
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree_file import save_tree
from hector_jax.report import pictures
from hector_jax.report.compare import compare_runs, print_comparison
from hector_jax.report.report import print_table
from hector_jax.report.video import check_film
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import metrics, tunings, verdicts
from hector_jax.runs.folder import RESULT, load_run
from hector_jax.sim.diagnosis import StartupFall, startup_fall
from hector_jax.tuning.loss import Loss, loss_of_robot


def evaluate(args: Evaluate) -> None:
    """Evaluate weight sets on the plants of a world."""
    robot = load_robot(args.robot)
    plant, course = arguments.plant_of(args.plant, robot), arguments.course(args.traj, robot)
    seconds = arguments.seconds(args.seconds, course)
    # ideal and hfs are one plant each, without chance
    count = args.seeds if args.world in ("standin", "hfs-varied") else 1
    seeds = range(args.first_seed, args.first_seed + count)
    sets = {text: arguments.weights(text, robot) for text in args.weights}
    body = robot if plant is None else plant
    plants = arguments.plants(args.world, seeds, body.description)
    config = tunings.tune_config(robot)
    with workers(args.processes) as pool:
        title = f"evaluating on {plural(count, 'plant')} of {args.world}"
        inputs = pool, config, robot, sets, course.command, plants, seeds
        walks = verdicts.judge(*inputs, title=title, seconds=seconds, plant=plant)
    verdict = metrics.make_verdict(config.loss, seeds, walks.scores)
    result = metrics.as_result(verdict, args.world)
    if plant is not None:
        result["plant"] = plant.description.name
    if args.out is not None:
        write_json(args.out, result)
    if args.json:
        print(as_json(result))
    else:
        names = arguments.short_names(args.weights)
        named = verdict._replace(scores={names[n]: s for n, s in verdict.scores.items()})
        of = "" if plant is None else f" of {plant.description.name}"
        print_table(named, f"{course.name}, {plural(count, 'plant')}{of}", args.world)


def walk(args: Walk) -> None:
    """Walk once and report on it.

    Raises:
        Broken: QPs of the walk were not solved.
    """
    if args.video is not None:
        check_film(args.video)
    robot = load_robot(args.robot)
    plant = arguments.plant_of(args.plant, robot)
    if args.world == "srbm" and plant is not None:
        raise InputError("--plant needs a world of MuJoCo, got --world srbm")
    weights, course = arguments.weights(args.weights, robot), arguments.course(args.traj, robot)
    loss, config = loss_of_robot(robot.description), walk_config(robot)
    say("compiling (only the first time on a machine) and walking")
    trajectory = arguments.walk_once(args, robot, course, weights, plant)
    score = metrics.score(loss, trajectory)
    upright, startup = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen))), None
    if upright == 0.0 and args.world != "srbm":
        startup = startup_fall(config, robot, arguments.job_of(args, robot, course, weights, plant))
    samples = round(config.gait.tick / float(trajectory.period))  # of each plan
    plans = np.asarray(trajectory.residual)[::samples]
    unsolved = int(np.sum(~(plans <= SOLVED)))
    if args.out is not None:
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=as_table(args))
    # without a plan it is no fall of these weights
    result = _Walked(score, upright, startup, bool(score.fallen) and not unsolved)
    if args.json:
        print(as_json(_as_table(result, plans, unsolved, plant)))
    else:
        on = "" if plant is None else f" on {plant.description.name}"
        what = f"{course.name} in {args.world}{on}, {printable(args.weights)} weights"
        _print_walk(result, loss, what)
    if unsolved:
        raise Broken(
            f"{unsolved} of {plural(len(plans), 'QP')} were not solved (largest relative residual "
            f"{float(score.residual):.0e}, expected at most {SOLVED:.0e}): this walk is no result"
        )
    if args.video is not None:
        name = Path(args.weights).stem
        beside, other = ("expert", expert) if name == "nominal" else ("nominal", nominal)
        say(f"walking with {beside} weights for the other half of the film")
        walks = {
            beside: arguments.walk_once(args, robot, course, other(robot), plant),
            name: trajectory,
        }
        pictures.film(args.video, robot, walks)


class _Walked(NamedTuple):
    """What is told of a walk."""

    score: metrics.Score
    upright: float  # [s]
    startup: StartupFall | None
    fell: bool


def _as_table(
    result: _Walked, plans: np.ndarray, unsolved: int, plant: Robot | None
) -> dict[str, Any]:
    score, startup = result.score, result.startup
    losses = {part: float(value) for part, value in score.losses.items()}
    errors = {name: getattr(score, name).tolist() for name in ("rms_position", "rms_euler")}
    solved = {"plans": len(plans), "unsolved": unsolved, "residual": float(score.residual)}
    summary = {"seconds": result.upright if startup is None else startup.time, "fell": result.fell}
    summary |= {} if startup is None else {"startup": startup._asdict()}
    summary |= {} if plant is None else {"plant": plant.description.name}
    # a walk that falls at once has no errors
    return {**summary, **losses, **errors, **solved}


def _print_walk(result: _Walked, loss: Loss, what: str) -> None:
    score, upright, startup, fell = result
    end = "fell after" if fell else "ended after" if score.fallen else "walked"
    end = f"{end} {upright:.2f} s" if startup is None else str(startup)
    terms = ", ".join(f"{t.name} {score.losses[t.name]:.4g} {t.unit}" for t in loss)
    print(f"{what}: {end}; L {score.L / 1e6:.3f}e6 ({terms})")
    cm, degrees = 100 * score.rms_position, np.degrees(score.rms_euler)
    if upright > 0.0:
        print("RMS error: x {:.1f}, y {:.1f}, z {:.1f} cm; ".format(*cm), end="")
        print("roll {:.1f}, pitch {:.1f}, yaw {:.1f} degrees".format(*degrees))


def compare(args: Compare) -> None:
    """Put finished runs side by side."""
    finished = [folder for folder in args.runs if (folder / RESULT).exists()]
    for folder in args.runs:
        if finished and folder not in finished:
            say(f"{folder} is left out: it is not a finished run")
    comparison = compare_runs([load_run(folder) for folder in finished or args.runs])
    if args.out is not None:
        write_json(args.out, comparison)
    if args.json:
        print(as_json(comparison))
    else:
        print_comparison(comparison)
