"""Walk once; and predict the ground forces of walks that no net saw."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.arguments import print_result
from hector_jax.cli.flags import Grfm, Walk
from hector_jax.cli.parse import as_table
from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.console import Broken, bar, say, say_if_slow
from hector_jax.core.files import make_folder
from hector_jax.core.inputs import InputError, plural, printable
from hector_jax.core.pool import workers
from hector_jax.core.trajectory import SOLVED
from hector_jax.core.tree import stack
from hector_jax.core.tree_file import save_tree
from hector_jax.grfm import training
from hector_jax.grfm.dataset import at_interval, make_dataset
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect
from hector_jax.own.walk_log import walk_card
from hector_jax.report import fidelity
from hector_jax.robot.model import load_robot
from hector_jax.sim.diagnosis import Fall, fall_of
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.sim.leg_check import soles_held
from hector_jax.sim.loop import Job
from hector_jax.store import nets
from hector_jax.store.collection import Walks
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.loss import Loss, loss_of_robot
from hector_jax.verdict import judging, metrics
from hector_jax.view import pictures
from hector_jax.view.video import check_film


def _check_world(args: Walk) -> None:
    """Raise an InputError if a flag needs a world with a plant and there is none."""
    if args.world != "srbm":
        return
    if args.plant is not None:
        raise InputError("--plant needs a world of MuJoCo, got --world srbm")
    if args.engine != "c" or args.walker:
        flag = "--walker" if args.walker else f"--engine {args.engine}"
        raise InputError(f"{flag} needs a world with a plant, got --world srbm")


def run_walk(args: Walk) -> None:
    """Walk once and report losses and errors.

    Raises:
        Broken: the solver failed on QPs of the walk.
    """
    if args.video is not None:
        check_film(args.video)
    robot = arguments.with_gait(load_robot(args.robot), args.gait)
    plant = arguments.load_plant(args.plant, robot) if args.plant else None
    _check_world(args)
    arguments.require_walker(args, robot)
    engine, weights = arguments.engine_of(args), arguments.weights_by_name(args.weights, robot)
    command = arguments.load_trajectory(args.traj, robot)
    loss, config = loss_of_robot(robot.description), walk_config(robot)
    seconds = arguments.walk_seconds(args, command)
    say("compiling (only the first time on a machine) and walking")
    walk_with = partial(arguments.walk_once, args, robot, command, plant=plant, engine=engine)
    trajectory = walk_with(weights)
    score = metrics.score(loss, trajectory)
    upright, fall = float(trajectory.period * np.sum(~np.asarray(trajectory.fallen))), None
    samples = round(config.gait.tick / float(trajectory.period))  # per plan
    residuals = np.asarray(trajectory.residual)[::samples]
    unsolved = int(np.sum(~(residuals <= SOLVED)))
    fell = bool(score.fallen) and not unsolved  # without a plan, it is not due to the weights
    if fell and args.world != "srbm" and not engine.differs:
        fall = fall_of(config, robot, arguments.job_of(args, robot, command, weights, plant))
    if args.out is not None and not args.walker:  # a program's own log is kept as it is
        about = as_table(args) | {"walk": walk_card(*command[:2], weights, robot, seconds)}
        save_tree(args.out, trajectory, kind="trajectory", robot=robot, about=about)
    where = args.world + ("" if engine is MUJOCO_C else f" in {engine.title}")
    where += "" if plant is None else f" on {plant.description.name}"
    title = f"{command.name} in {where}, {printable(args.weights)} weights"
    result: dict[str, Any] = {
        "engine": engine.name,
        "seconds": upright if fall is None else fall.time,
        "fell": fell,
        **({} if fall is None else {"fall": fall._asdict()}),
        **({} if plant is None else {"plant": plant.description.name}),
    }
    result |= {part: float(value) for part, value in score.losses.items()}
    # the errors of a walk that falls at once are NaN
    result |= {name: getattr(score, name).tolist() for name in ("rms_position", "rms_euler")}
    result |= {"plans": len(residuals), "unsolved": unsolved, "residual": float(score.residual)}
    print_result(args.json, result, partial(_print_walk, title, result, score, loss, fall))
    if args.robot is not None and args.world != "srbm" and not (args.json or args.walker):
        print(soles_held(plant or robot, trajectory))
    if unsolved:
        raise Broken(
            f"{unsolved} of {plural(len(residuals), 'QP')} were not solved (largest relative "
            f"residual {score.residual:.0e}, expected at most {SOLVED:.0e}): this walk is no result"
        )
    if args.video is not None:
        name = Path(args.weights).stem
        baseline = "expert" if name == "nominal" else "nominal"
        say(f"walking with {baseline} weights for the other half of the film")
        other = arguments.engine_of(replace(args, out=None))  # the log is that of the asked walk
        before = walk_with(arguments.weights_by_name(baseline, robot), engine=other)
        walks = {baseline: before, name: trajectory}
        pictures.film(args.video, plant or robot, walks)


def _print_walk(
    text: str, result: dict[str, Any], score: metrics.Score, loss: Loss, fall: Fall | None
) -> None:
    end = "fell after" if result["fell"] else "ended after" if score.fallen else "walked"
    end = f"{end} {result['seconds']:.2f} s" if fall is None else str(fall)
    terms = ", ".join(f"{term.name} {score.losses[term.name]:.4g} {term.unit}" for term in loss)
    print(f"{text}: {end}; L {score.L / 1e6:.3f}e6 ({terms})")
    if result["seconds"] > 0.0:
        x, y, z = 100 * score.rms_position
        roll, pitch, yaw = np.degrees(score.rms_euler)
        print(f"RMS error: x {x:.1f}, y {y:.1f}, z {z:.1f} cm; ", end="")
        print(f"roll {roll:.1f}, pitch {pitch:.1f}, yaw {yaw:.1f} degrees")


def run_grfm(args: Grfm) -> None:
    """Report the prediction errors of each net, with pictures."""
    robot, config = load_robot(), TuneConfig()
    make_folder(args.out)
    with workers(args.processes, args.cluster) as pool:
        net = nets.load_or_train(pool, robot, args.data)
        paper = nets.load_or_train(pool, robot, args.data, "paper")
        with say_if_slow("reading the walks that no training saw"):
            worlds = {"hfs": nets.held_out_walks(robot, net)}
        if args.seeds:
            worlds["standin"] = _on_stand_in(Setup(pool, config, robot), args.seeds)
    effects = {
        "raw": last_command,
        "linear": as_effect(net.linear),
        "paper": as_effect(paper.params),
        "residual": as_effect(net.params),
        "gated": as_effect(net.params.linear),
    }
    result, drifts = {}, {}
    with bar("predicting the ground forces of the walks") as report_progress:
        for done, (world, walks) in enumerate(worlds.items()):
            report_progress(3 * done, 3 * len(worlds), f"{world}: errors")
            start, push = walks.job.start_tick, walks.job.push
            samples, _ = make_dataset(robot, walks.trajectory, start, push=push)
            errors = training.errors_by_phi(effects, samples)
            report_progress(3 * done + 1, 3 * len(worlds), f"{world}: errors by phase")
            phases = fidelity.by_phase(effects, samples)
            report_progress(3 * done + 2, 3 * len(worlds), f"{world}: open loop")
            unpushed = ~np.any(push.force, axis=(1, 2))  # no model contains external pushes
            calm = jax.tree.map(lambda x, unpushed=unpushed: x[unpushed], walks)
            drifts[world] = {
                name: fidelity.drift(robot, effect, calm.trajectory, calm.job.start_tick)
                for name, effect in {**effects, "measured": None}.items()
            }
            result[world] = fidelity.as_result(errors, phases, drifts[world])
    first = jax.tree.map(lambda x: x[0], worlds["hfs"].trajectory)
    curves = fidelity.curves(robot, first, effects)
    trainings = {"training": net.history, "training_paper": paper.history}
    tick = config.rollout.walk.gait.tick
    drawings = pictures.of_nets(args.out, tick, curves, drifts, trainings)
    report = fidelity.write_net_report(args.out, result, drawings)
    print_text = partial(arguments.print_errors, result["hfs"]["errors"])
    print_result(args.json, {"report": str(report), "worlds": result}, print_text)
    say(f"the report is {report}")


def _on_stand_in(setup: Setup, count: int) -> Walks:
    """Walk the three trajectories with nominal and expert weights, for information only."""
    robot = setup.robot
    jobs = [
        Job(weights, named_command(name), plant, seed=seed)
        for weights in (nominal(robot), expert(robot))
        for name in COMMANDS
        for seed, plant in enumerate(arguments.plants("standin", range(count), robot.description))
    ]
    title = f"walking on {plural(count, 'stand-in plant')}, for information"
    walks = judging.walk_jobs(setup, jobs, title)
    tick = setup.config.rollout.walk.gait.tick
    return Walks(stack(jobs), stack([at_interval(walk, tick) for walk in walks]))
