"""What weight sets are worth on walks, and nets on the ground forces of walks they never saw."""

from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Evaluate, Grfm, Walk
from hector_jax.cli.parse import as_table
from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import Weights, expert, nominal
from hector_jax.core.console import Broken, bar, say, say_if_slow
from hector_jax.core.files import make_folder, write_json
from hector_jax.core.inputs import InputError, plural, printable
from hector_jax.core.runtime import workers
from hector_jax.core.trajectory import SOLVED, Trajectory
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import save_tree
from hector_jax.grfm import training
from hector_jax.grfm.collection import Walks
from hector_jax.grfm.dataset import at_interval, make_dataset
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect
from hector_jax.report import fidelity, pictures
from hector_jax.report.report import print_table
from hector_jax.report.video import check_film
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import metrics, nets, tunings, verdicts
from hector_jax.sim.diagnosis import StartupFall, startup_fall
from hector_jax.sim.engine import MUJOCO_C, choose_engine
from hector_jax.sim.loop import Job
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import Loss, loss_of_robot


def evaluate(args: Evaluate) -> None:
    """Evaluate weight sets on the plants of a world."""
    robot = arguments.with_gait(load_robot(args.robot), args.gait)
    plant, course = arguments.plant_of(args.plant, robot), arguments.course(args.traj, robot)
    seconds = arguments.seconds(args.seconds, course)
    # ideal and hfs are one plant each, without chance
    count = args.seeds if args.world not in ("ideal", "hfs") else 1
    seeds = range(args.first_seed, args.first_seed + count)
    sets = {text: arguments.weights(text, robot) for text in args.weights}
    plants = arguments.plants(args.world, seeds, (plant or robot).description)
    config, engine = tunings.tune_config(robot), choose_engine(args.engine)
    with workers(args.processes) as pool:
        title = f"evaluating on {plural(count, 'plant')} of {args.world}"
        inputs = pool, config, robot, sets, course.command, plants, seeds
        walks = verdicts.judge(*inputs, title=title, seconds=seconds, plant=plant, engine=engine)
    verdict = metrics.make_verdict(config.loss, seeds, walks.scores)
    result, what = (
        metrics.as_result(verdict, args.world),
        f"{course.name}, {plural(count, 'plant')}",
    )
    result["engine"] = engine.name
    if plant is not None:
        result["plant"] = plant.description.name
        what += f" of {plant.description.name}"
    if args.out is not None:
        write_json(args.out, result)
    names = arguments.short_names(args.weights)
    named = verdict._replace(scores={names[n]: s for n, s in verdict.scores.items()})
    print_result(args.json, result, partial(print_table, named, what, args.world))


def walk(args: Walk) -> None:
    """Walk once and report on it.

    Raises:
        Broken: QPs of the walk were not solved.
    """
    if args.video is not None:
        check_film(args.video)
    robot = arguments.with_gait(load_robot(args.robot), args.gait)
    plant = arguments.plant_of(args.plant, robot)
    if args.world == "srbm" and plant is not None:
        raise InputError("--plant needs a world of MuJoCo, got --world srbm")
    if args.world == "srbm" and args.engine != "c":
        raise InputError(f"--engine {args.engine} needs a world with a plant, got --world srbm")
    engine = choose_engine(args.engine)
    weights, course = arguments.weights(args.weights, robot), arguments.course(args.traj, robot)
    loss, config = loss_of_robot(robot.description), walk_config(robot)
    say("compiling (only the first time on a machine) and walking")
    once = partial(arguments.walk_once, args, robot, course, plant=plant, engine=engine)
    trajectory = once(weights)
    score = metrics.score(loss, trajectory)
    upright, startup = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen))), None
    # a fall in the start-up is walked once more, in MuJoCo C
    if upright == 0.0 and args.world != "srbm" and not engine.differs:
        startup = startup_fall(config, robot, arguments.job_of(args, robot, course, weights, plant))
    samples = round(config.gait.tick / float(trajectory.period))  # of each plan
    plans = np.asarray(trajectory.residual)[::samples]
    unsolved = int(np.sum(~(plans <= SOLVED)))
    if args.out is not None:
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=as_table(args))
    what = f"{course.name} in {args.world}"
    if engine is not MUJOCO_C:
        what += f" in engine {engine.name}"
    result: dict[str, Any] = {
        "engine": engine.name,
        "seconds": upright if startup is None else startup.time,
        "fell": bool(score.fallen)
        and not unsolved,  # without a plan it is no fall of these weights
    }
    if startup is not None:
        result["startup"] = startup._asdict()
    if plant is not None:
        result["plant"] = plant.description.name
        what += f" on {plant.description.name}"
    result |= {part: float(value) for part, value in score.losses.items()}
    # a walk that falls at once has no errors
    result |= {name: getattr(score, name).tolist() for name in ("rms_position", "rms_euler")}
    result |= {"plans": len(plans), "unsolved": unsolved, "residual": float(score.residual)}
    what += f", {printable(args.weights)} weights"
    in_words = partial(_print_walk, what, result, score, loss, startup)
    print_result(args.json, result, in_words)
    if unsolved:
        raise Broken(
            f"{unsolved} of {plural(len(plans), 'QP')} were not solved (largest relative residual "
            f"{float(score.residual):.0e}, expected at most {SOLVED:.0e}): this walk is no result"
        )
    if args.video is not None:
        _film(args.video, Path(args.weights).stem, trajectory, robot, once)


def _film(
    path: Path,
    name: str,
    trajectory: Trajectory,
    robot: Robot,
    once: Callable[[Weights], Trajectory],
) -> None:
    """Film a walk beside that with nominal weights, or with the expert's if it has those itself.

    `once` walks again with given weights.
    """
    beside, other = ("expert", expert) if name == "nominal" else ("nominal", nominal)
    say(f"walking with {beside} weights for the other half of the film")
    pictures.film(path, robot, {beside: once(other(robot)), name: trajectory})


def _print_walk(
    what: str, result: dict[str, Any], score: metrics.Score, loss: Loss, startup: StartupFall | None
) -> None:
    end = "fell after" if result["fell"] else "ended after" if score.fallen else "walked"
    end = f"{end} {result['seconds']:.2f} s" if startup is None else str(startup)
    terms = ", ".join(f"{t.name} {score.losses[t.name]:.4g} {t.unit}" for t in loss)
    print(f"{what}: {end}; L {score.L / 1e6:.3f}e6 ({terms})")
    if result["seconds"] > 0.0:
        x, y, z = 100 * score.rms_position
        roll, pitch, yaw = np.degrees(score.rms_euler)
        print(f"RMS error: x {x:.1f}, y {y:.1f}, z {z:.1f} cm; ", end="")
        print(f"roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f} degrees")


def grfm(args: Grfm) -> None:
    """Report on the predictions of each net, with pictures."""
    robot, config = load_robot(), TuneConfig()
    make_folder(args.out)
    with workers(args.processes) as pool:
        net = nets.load_or_train(pool, robot, args.data)
        paper = nets.load_or_train(pool, robot, args.data, "paper")
        with say_if_slow("reading the walks that no training saw"):
            worlds = {"hfs": nets.held_out_walks(robot, net)}
        if args.seeds:
            worlds["standin"] = _on_stand_in(pool, config, robot, args.seeds)
    effects = {
        "raw": last_command,
        "linear": as_effect(net.linear),
        "paper": as_effect(paper.params),
        "residual": as_effect(net.params),
        "gated": as_effect(net.params.linear),
    }
    result, drifts = {}, {}
    with bar("predicting the ground forces of the walks") as tell:
        for done, (world, walks) in enumerate(worlds.items()):
            tell(3 * done, 3 * len(worlds), f"{world}: errors")
            start, push = walks.job.start_tick, walks.job.push
            samples, _ = make_dataset(robot, walks.trajectory, start, push=push)
            errors = training.report(effects, samples)
            tell(3 * done + 1, 3 * len(worlds), f"{world}: errors by phase")
            phases = fidelity.by_phase(effects, samples)
            tell(3 * done + 2, 3 * len(worlds), f"{world}: open loop")
            calm = ~np.any(push.force, axis=(1, 2))  # a push from outside is in no model
            quiet = jax.tree.map(lambda x, calm=calm: x[calm], walks)
            drifts[world] = fidelity.drifts(robot, effects, quiet.trajectory, quiet.job.start_tick)
            result[world] = fidelity.as_result(errors, phases, drifts[world])
    curves = fidelity.curves(robot, worlds["hfs"].trajectory, effects)
    trainings = {"training": net.course, "training_paper": paper.course}
    tick = config.rollout.walk.gait.tick
    drawn = pictures.of_nets(args.out, tick, curves, drifts, trainings)
    report = fidelity.write_report(args.out, result, drawn)
    in_words = partial(arguments.print_errors, result["hfs"]["errors"])
    print_result(args.json, {"report": str(report), "worlds": result}, in_words)
    say(f"the report is {report}")


def _on_stand_in(pool: Executor, config: TuneConfig, robot: Robot, count: int) -> Walks:
    """Walks of the three trajectories with nominal and expert weights, for information only."""
    jobs = [
        Job(weights, named_command(name), plant, seed=seed)
        for weights in (nominal(robot), expert(robot))
        for name in COMMANDS
        for seed, plant in enumerate(arguments.plants("standin", range(count), robot.description))
    ]
    title = f"walking on {plural(count, 'stand-in plant')}, for information"
    walks = verdicts.walk_jobs(pool, config, robot, jobs, title)
    tick = config.rollout.walk.gait.tick
    return Walks(stack(jobs), stack([at_interval(walk, tick) for walk in walks]))
