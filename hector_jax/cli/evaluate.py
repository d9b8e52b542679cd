"""Evaluation of weight sets, walks and runs."""

from pathlib import Path

import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.flags import Compare, Evaluate, Walk
from hector_jax.cli.parse import as_table
from hector_jax.control.controller import walk_config
from hector_jax.control.weights import expert, nominal
from hector_jax.core.console import Broken, say
from hector_jax.core.files import as_json, write_json
from hector_jax.core.inputs import plural, printable
from hector_jax.core.runtime import workers
from hector_jax.core.tree_file import save_tree
from hector_jax.grfm.dataset import SOLVED
from hector_jax.report import pictures
from hector_jax.report.compare import compare_runs, print_comparison
from hector_jax.report.report import print_table
from hector_jax.report.video import check_film
from hector_jax.robot.model import load_robot
from hector_jax.runs import metrics, tunings, verdicts
from hector_jax.runs.folder import RESULT, load_run
from hector_jax.tuning.loss import PAPER_LOSS


def evaluate(args: Evaluate) -> None:
    """Evaluate weight sets on the plants of a world."""
    robot = load_robot(args.robot)
    course = arguments.course(args.traj, robot)
    seconds = arguments.seconds(args.seconds, course)
    # ideal and hfs are one plant each, without chance
    count = args.seeds if args.world in ("standin", "hfs-varied") else 1
    seeds = range(args.first_seed, args.first_seed + count)
    sets = {text: arguments.weights(text, robot) for text in args.weights}
    plants = arguments.plants(args.world, seeds)
    with workers(args.processes) as pool:
        title = f"evaluating on {plural(count, 'plant')} of {args.world}"
        config = tunings.tune_config(robot)
        walks = verdicts.judge(
            pool, config, robot, sets, course.command, plants, seeds, title=title, seconds=seconds
        )
    verdict = metrics.make_verdict(config.loss, seeds, walks.scores)
    result = metrics.as_result(verdict, args.world)
    if args.out is not None:
        write_json(args.out, result)
    if args.json:
        print(as_json(result))
    else:
        names = arguments.short_names(args.weights)
        named = verdict._replace(scores={names[n]: s for n, s in verdict.scores.items()})
        print_table(named, f"{course.name}, {plural(count, 'plant')}", args.world)


def walk(args: Walk) -> None:
    """Walk once and report on it.

    Raises:
        Broken: QPs of the walk were not solved.
    """
    if args.video is not None:
        check_film(args.video)
    robot = load_robot(args.robot)
    weights, course = arguments.weights(args.weights, robot), arguments.course(args.traj, robot)
    say("compiling (only the first time on a machine) and walking")
    trajectory = arguments.walk_once(args, robot, course, weights)
    score = metrics.score(PAPER_LOSS, trajectory)
    upright = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen)))
    samples = round(walk_config(robot).gait.tick / float(trajectory.period))  # of each plan
    plans = np.asarray(trajectory.residual)[::samples]
    unsolved = int(np.sum(~(plans <= SOLVED)))
    fell = bool(score.fallen) and not unsolved  # without a plan it is no fall of these weights
    if args.out is not None:
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=as_table(args))
    if args.json:
        losses = {part: float(loss) for part, loss in score.losses.items()}
        errors = {name: getattr(score, name).tolist() for name in ("rms_position", "rms_euler")}
        solved = {"plans": len(plans), "unsolved": unsolved, "residual": float(score.residual)}
        # a walk that falls at once has no errors
        print(as_json({"seconds": upright, "fell": fell, **losses, **errors, **solved}))
    else:
        terms = ", ".join(f"{t.name} {score.losses[t.name]:.4g} {t.unit}" for t in PAPER_LOSS)
        end = "fell after" if fell else "ended after" if score.fallen else "walked"
        print(
            f"{course.name} in {args.world}, {printable(args.weights)} weights: {end} "
            f"{upright:.2f} s; L {score.L / 1e6:.3f}e6 ({terms})"
        )
        cm, degrees = 100 * score.rms_position, np.degrees(score.rms_euler)
        print("RMS error: x {:.1f}, y {:.1f}, z {:.1f} cm; ".format(*cm), end="")
        print("roll {:.1f}, pitch {:.1f}, yaw {:.1f} degrees".format(*degrees))
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
            beside: arguments.walk_once(args, robot, course, other(robot)),
            name: trajectory,
        }
        pictures.film(args.video, robot, walks)


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
