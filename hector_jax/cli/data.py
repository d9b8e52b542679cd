"""Walks on the simulator, nets trained on them, and what the nets are worth."""

from collections.abc import Mapping
from concurrent.futures import Executor
from typing import Any

import jax
import numpy as np

from hector_jax.cli import arguments
from hector_jax.cli.flags import Collect, Grfm, Train
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.console import bar, say, say_if_slow
from hector_jax.core.files import as_json, make_folder
from hector_jax.core.inputs import plural
from hector_jax.core.runtime import workers
from hector_jax.grfm import training
from hector_jax.grfm.collection import Walks
from hector_jax.grfm.dataset import make_dataset
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.network import as_effect
from hector_jax.grfm.training import TrainConfig
from hector_jax.report import fidelity, pictures
from hector_jax.robot.model import Robot, load_robot
from hector_jax.runs import nets, verdicts
from hector_jax.sim.loop import Job
from hector_jax.tuning.difftune import TuneConfig


def collect(args: Collect) -> None:
    """Walk on the simulator with chance, and keep the walks."""
    config = nets.CollectConfig(args.walks, args.seconds, args.seed, args.engine)
    robot = load_robot(args.robot)
    with workers(args.processes) as pool:
        out = arguments.default_of(args.out, Collect.out, args.robot, robot)
        nets.collect(pool, config, robot, out)
    say(f"the walks are in {out}")


def train(args: Train) -> None:
    """Train a net on walks."""
    config = TrainConfig(args.variant, epochs=args.epochs, seed=args.seed)
    robot = load_robot(args.robot)
    data = arguments.default_of(args.data, Train.data, args.robot, robot)
    path = args.out or nets.net_path(data.parent, args.variant)
    net = nets.train(config, robot, data, path)
    if args.json:
        print(as_json({"net": str(path), "errors": net.errors}))
    else:
        _print_errors(net.errors)
    say(f"the net is in {path}")


def _print_errors(errors: Mapping[str, Mapping[str, Any]]) -> None:
    print("mean square errors on held-out walks")
    for name, of in errors.items():
        print(f"{name:9s} force {of['force']:8.2f} N^2   moment {of['moment']:7.4f} (N m)^2")


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
    effects = {"raw": last_command, "linear": as_effect(net.linear)}
    effects["paper"] = as_effect(paper.params)
    effects["residual"] = as_effect(net.params)
    effects["gated"] = as_effect(net.params.linear)
    result, drifts = {}, {}
    with bar("predicting the ground forces of the walks") as tell:
        for done, (world, walks) in enumerate(worlds.items()):
            tell(3 * done, 3 * len(worlds), f"{world}: errors")
            samples, _ = make_dataset(
                robot, walks.trajectory, walks.job.start_tick, push=walks.job.push
            )
            errors = training.report(effects, samples)
            tell(3 * done + 1, 3 * len(worlds), f"{world}: errors by phase")
            phases = fidelity.by_phase(effects, samples)
            tell(3 * done + 2, 3 * len(worlds), f"{world}: open loop")
            # a push from outside is in no model
            calm = ~np.any(walks.job.push.force, axis=(1, 2))
            quiet = jax.tree.map(lambda x, calm=calm: x[calm], walks)
            drifts[world] = fidelity.drifts(robot, effects, quiet.trajectory, quiet.job.start_tick)
            result[world] = fidelity.as_result(errors, phases, drifts[world])
    curves = fidelity.curves(robot, worlds["hfs"].trajectory, effects)
    trainings = {"training": net.course, "training_paper": paper.course}
    tick = config.rollout.walk.gait.tick
    drawn = pictures.of_nets(args.out, tick, curves, drifts, trainings)
    report = fidelity.write_report(args.out, result, drawn)
    if args.json:
        print(as_json({"report": str(report), "worlds": result}))
    else:
        _print_errors(result["hfs"]["errors"])
    say(f"the report is {report}")


def _on_stand_in(pool: Executor, config: TuneConfig, robot: Robot, count: int) -> Walks:
    """Walks of the three trajectories with nominal and expert weights, for information only."""
    jobs = [
        Job(weights, named_command(name), plant, seed=seed)
        for weights in (nominal(robot), expert(robot))
        for name in COMMANDS
        for seed, plant in enumerate(arguments.plants("standin", range(count), robot.description))
    ]
    return verdicts.walk_all(
        pool, config, robot, jobs, f"walking on {plural(count, 'stand-in plant')}, for information"
    )
