"""Weight sets, walks and runs judged."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from hector_jax import pipeline, study
from hector_jax.commands import asked
from hector_jax.console import say
from hector_jax.control.weights import expert, nominal
from hector_jax.evaluation import metrics, pictures, runs
from hector_jax.evaluation.metrics import Score, Verdict
from hector_jax.evaluation.report import print_table
from hector_jax.flags import Compare, Evaluate, Table, Walk, settings
from hector_jax.grfm.dataset import SOLVED
from hector_jax.robot import load_robot
from hector_jax.runtime import workers
from hector_jax.storage import as_json, save_tree
from hector_jax.tuning.loss import LossConfig


def evaluate(args: Evaluate) -> None:
    """Judge weight sets on the plants of a world."""
    robot = load_robot(args.robot)
    wanted = asked.course(args.traj, robot)
    seconds = asked.seconds(args.seconds, wanted)
    # ideal and hfs are one plant each, without chance
    count = args.seeds if args.world in ("standin", "hfs-varied") else 1
    seeds = range(args.first_seed, args.first_seed + count)
    sets = {text: asked.weights(text, robot) for text in args.weights}
    plants = asked.plants(args.world, seeds)
    with workers(args.processes) as pool:
        title = f"judging on {args.world}, {count} plants"
        known = (pool, asked.tune_config(robot), robot)
        walks = pipeline.judge(*known, sets, wanted.command, plants, seeds, title, seconds)
    scores = {n: [metrics.score(LossConfig(), walk) for walk in each] for n, each in walks.items()}
    verdict = verdict_of(LossConfig(), seeds, scores)
    if args.json:
        print(as_json(metrics.as_result(verdict, args.world)))
    else:
        print_table(verdict, f"{wanted.name}, {count} plants", args.world)


def verdict_of(
    loss: LossConfig, seeds: Sequence[int], scores: Mapping[str, Sequence[Score]]
) -> Verdict:
    """`metrics.judge`; says where a QP of the walks was not solved."""
    verdict = metrics.judge(loss, seeds, scores)
    for name, score in verdict.scores.items():
        if score.residual.max() > SOLVED:
            say(f"{name}: a QP of its walks was not solved (residual {score.residual.max():.0e})")
    return verdict


def walk(args: Walk) -> None:
    """Walk once, and tell how it went."""
    robot = load_robot(args.robot)
    weights, wanted = asked.weights(args.weights, robot), asked.course(args.traj, robot)
    say("compiling (only the first time on a machine) and walking")
    trajectory = asked.walked(args, robot, wanted, weights)
    found = metrics.score(LossConfig(), trajectory)
    upright = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen)))
    if args.out is not None:
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=settings(args))
    if args.json:
        losses = {part: float(getattr(found, part)) for part in metrics.PARTS}
        errors = {name: getattr(found, name).tolist() for name in ("rms_position", "rms_euler")}
        told = {"seconds": upright, "fell": bool(found.fallen), **losses, **errors}
        print(as_json(told))  # a walk that falls at once has no errors
    else:
        print(
            f"{wanted.name} in {args.world}, {args.weights} weights: "
            + (f"fell after {upright:.2f} s" if found.fallen else f"walked {upright:.2f} s")
            + f"; L {found.L / 1e6:.3f}e6 (L_Eul {found.L_Eul:.2f} rad^2, "
            f"L_pos {found.L_pos:.2f} m^2, L_ctrl {found.L_ctrl / 1e6:.3f}e6)"
        )
        cm, degrees = 100 * found.rms_position, np.degrees(found.rms_euler)
        print("RMS error: x {:.1f}, y {:.1f}, z {:.1f} cm; ".format(*cm), end="")
        print("roll {:.1f}, pitch {:.1f}, yaw {:.1f} degrees".format(*degrees))
    if args.video is not None:
        beside, other = ("nominal", nominal) if args.weights != "nominal" else ("expert", expert)
        pictures.film(
            args.video,
            robot,
            {
                beside: asked.walked(args, robot, wanted, other(robot)),
                Path(args.weights).stem: trajectory,
            },
        )


def table(args: Table) -> None:
    """Make the table of all sets on all trajectories."""
    told, verdicts = study.make_table(args, partial(asked.plants, "standin"))
    if args.json:
        results = {name: metrics.as_result(verdict) for name, verdict in verdicts.items()}
        print(as_json({"report": str(told), "trajectories": results}))
    else:
        for name, verdict in verdicts.items():
            print_table(verdict, f"{name}, {len(verdict.seeds)} plants")
    say(f"the whole story, with pictures: {told}")


def compare(args: Compare) -> None:
    """Put finished runs side by side."""
    finished = [folder for folder in args.runs if (folder / runs.RESULT).exists()]
    for folder in args.runs:
        if finished and folder not in finished:
            say(f"{folder}: left out, no finished run")
    told = runs.compare_runs([runs.load_run(folder) for folder in finished or args.runs])
    if args.json:
        print(as_json(told))
    else:
        runs.print_comparison(told)
