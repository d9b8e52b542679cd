"""Golden results: what must not change when the code is rearranged, as named arrays of numbers.

    python -m benchmarks.golden make before.npz        at one commit
    python -m benchmarks.golden compare before.npz     at a later one, same machine and packages
    python -m benchmarks.golden compare before.npz --only qp tick

Every option that a flag or a robot's TOML can choose is in it, not the defaults alone. Two commits
have the names and the tolerances in common; how a commit computes a number is its own business.
"""

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import problems
from experiments import sensitivity
from hector_jax.control.controller import (
    WalkConfig,
    actuate,
    contacts_needed,
    init_memory,
    step_plan,
    walk_config,
)
from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.gait import GaitConfig
from hector_jax.control.legs import LegConfig, Measurement
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.reference import COMMANDS, named_command, standing_anchor
from hector_jax.control.weights import expert, nominal, weights_to_vector
from hector_jax.core.console import say
from hector_jax.core.runtime import setup_jax
from hector_jax.core.trajectory import State, Trajectory
from hector_jax.core.tree import stack
from hector_jax.grfm import dataset, training
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.jobs import draw_jobs
from hector_jax.grfm.network import as_effect, effect_of
from hector_jax.grfm.training import TrainConfig
from hector_jax.qp import INTERIOR_POINT, JAXOPT, QpConfig, solve_qp
from hector_jax.robot.model import Robot, load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.parallel import walk_batch
from hector_jax.sim.standin import standin
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs, ideal
from hector_jax.store.collection import Walks
from hector_jax.tuning.difftune import TuneConfig, tune, tune_step
from hector_jax.tuning.loss import PAPER_LOSS, losses, total
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout
from hector_jax.tuning.variation import no_variation

ROOT = Path(__file__).parents[1]
STRIDER = ROOT / "examples" / "strider" / "robot.toml"
PAPER_FOOTHOLDS = FootstepConfig(rule="paper")
DOUBLE_SUPPORT = GaitConfig(stance=24, swing=16)

Arrays = dict[str, Any]
Section = tuple[Callable[[], Arrays], float]  # what makes its numbers, and their tolerance


def _flat(tree: Any) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(x, float)) for x in jax.tree.leaves(tree)])


def _loss(walked: Trajectory) -> float:
    return float(total(PAPER_LOSS, losses(PAPER_LOSS, walked)))


def controllers() -> dict[str, WalkConfig]:
    """The controller with each of its options."""
    default = WalkConfig()
    return {
        "default": default,
        "no line friction": replace(default, mpc=MpcConfig(line_friction=False)),
        "effort about the weight": replace(default, mpc=MpcConfig(effort_reference="gravity")),
        "paper's footholds": replace(default, footstep=PAPER_FOOTHOLDS),
        "double support": replace(default, gait=DOUBLE_SUPPORT),
        "leg weight": replace(default, legs=LegConfig(gravity_compensation=True)),
        "jaxopt": replace(default, mpc=MpcConfig(qp=QpConfig(JAXOPT))),
    }


def qp() -> Arrays:
    """Solutions of walking QPs with both solvers."""
    robot = load_robot()
    write = jax.vmap(partial(problems.layer_qp, WalkConfig(), robot))
    qps = jax.jit(write)(problems.draw_problems(WalkConfig(), robot, 24))
    found = {}
    for solver in (INTERIOR_POINT, JAXOPT):
        config = QpConfig(solver=solver)
        solution = jax.jit(jax.vmap(partial(solve_qp, config=config)))(qps)
        found[f"{solver} x"] = solution.x
        found[f"{solver} status"] = solution.status
    return found


def _tick(config: WalkConfig, robot: Robot) -> Arrays:
    """Wrench, touchdowns and torques of a plan from a state off the reference."""
    rng, joints = np.random.default_rng(3), robot.standing_joints
    anchor, parameters = standing_anchor(robot), config.parameters(expert(robot))
    state = State(np.zeros(3), np.asarray(anchor.position), np.zeros(3), np.zeros(3))
    measured = Measurement(state, joints, np.zeros_like(joints))
    measured = jax.tree.map(lambda x: x + 0.01 * rng.normal(size=np.shape(x)), measured)
    memory, found = init_memory(robot, measured), {}
    for tick in (-config.gait.stand, 3, 17, 24):
        after, planned = step_plan(
            config,
            robot,
            parameters,
            command=named_command("s"),
            anchor=anchor,
            tick=np.int32(tick),
            memory=memory,
            measurement=measured,
            max_contacts=contacts_needed(config, tick),
        )
        now = {"plan": planned, "memory": after, "measurement": measured}
        torques = [
            actuate(config, robot, parameters.legs, substep=np.int32(ms), **now) for ms in (0, 4)
        ]
        found[f"tick {tick}"] = _flat([planned.wrench, planned.touchdown, torques])
    return found


def tick() -> Arrays:
    """One tick of the controller with each option, and of the other robot."""
    found = {
        f"{name}, {key}": value
        for name, config in controllers().items()
        for key, value in _tick(config, load_robot()).items()
    }
    other = load_robot(STRIDER)
    strider = _tick(walk_config(other), other)
    return found | {f"strider, {key}": value for key, value in strider.items()}


def _walks(robot: Robot) -> Walks:
    """Walks of a second on the hfs, for phi."""
    config = walk_config(robot)
    jobs = draw_jobs(0, 6, seconds=1.0, robot=robot)
    walked = [walk(config, robot, job) for job in jobs]
    walks = [dataset.at_interval(one, config.gait.tick) for one in walked]
    return Walks(stack(jobs), stack(walks))


def _nets(robot: Robot) -> dict[str, Any]:
    walks = _walks(robot)
    samples, _ = dataset.make_dataset(
        robot, walks.trajectory, walks.job.start_tick, push=walks.job.push
    )
    seen, unseen = dataset.split_by_walk(samples)
    return {
        variant: training.train(TrainConfig(variant, epochs=3), seen, unseen)[0]
        for variant in ("residual", "paper")
    }


def phi() -> Arrays:
    """Both variants of the net, trained on given walks, and what the walks were."""
    robot = load_robot()
    found = {f"net {name}": _flat(params) for name, params in _nets(robot).items()}
    return found | {"walks": _flat(_walks(robot).trajectory.state)}


def rollouts() -> Arrays:
    """Loss and gradient over 400 ticks, on each model, by each way."""
    robot, found = load_robot(), {}
    models = {name: as_effect(params) for name, params in _nets(robot).items()}
    models["plain"] = effect_of(None, WalkConfig())
    config = TuneConfig()
    for model, effect in models.items():
        for command in COMMANDS if model == "plain" else ("s",):
            scenario = Scenario(robot, named_command(command), standing_anchor(robot), effect)
            seen = tune_step(config, scenario, nominal())
            found[f"{model}, {command}"] = _flat(
                [seen.loss, [seen.terms[term.name] for term in config.loss], seen.gradient]
            )
    short = TuneConfig(rollout=RolloutConfig(ticks=50))
    scenario = Scenario(robot, named_command("s"), standing_anchor(robot), last_command)
    for name, walking in controllers().items():
        if name not in ("default", "leg weight"):
            optional = replace(short, rollout=RolloutConfig(walk=walking, ticks=50))
            seen = tune_step(optional, scenario, nominal())
            found[name] = _flat([seen.loss, seen.gradient])
    lead = replace(short, rollout=RolloutConfig(ticks=50, lead=20, block=40))
    found["lead"] = _flat(tune_step(lead, scenario, nominal()).gradient)
    walked, columns = jax.jit(sensitivity.propagate, static_argnums=0)(
        short.rollout, scenario, nominal()
    )
    found["forward recursion"] = _flat(sensitivity.gradient(PAPER_LOSS, walked, columns, nominal()))
    noise = State(*(np.full(3, 1e-3) for _ in range(4)))
    varied = no_variation()._replace(
        mass=np.asarray(1.1), friction=np.asarray(0.4), delay=np.asarray(0.004), noise=noise
    )
    varied = scenario._replace(variation=jax.tree.map(jnp.asarray, varied))
    found["variation"] = _flat(
        jax.jit(rollout, static_argnums=0)(short.rollout, varied, nominal()).state
    )
    other = load_robot(STRIDER)
    config = TuneConfig(rollout=RolloutConfig(walk=walk_config(other), ticks=50))
    scenario = Scenario(other, named_command("s"), standing_anchor(other), last_command)
    seen = tune_step(config, scenario, nominal(other))
    return found | {"strider": _flat([seen.loss, seen.gradient])}


def tunings() -> Arrays:
    """Ten iterations with each rule."""
    robot, found = load_robot(), {}
    effect = effect_of(None, WalkConfig())
    scenario = Scenario(robot, named_command("s"), standing_anchor(robot), effect)
    rules = {
        "gauss_newton": TuneConfig(),
        "relative": TuneConfig(rule="relative"),
        "literal": TuneConfig(rule="literal", beta_q=1e-5, beta_r=1e-17),
    }
    for name, config in rules.items():
        ended = tune(config, scenario, nominal())
        found[f"{name}, L"] = [float(one.evaluation.loss) for one in ended.iterations]
        found[f"{name}, weights"] = np.asarray(weights_to_vector(ended.weights))
    return found


def seconds() -> Arrays:
    """A second of walking in each world and engine."""
    robot, found = load_robot(), {}
    for name, plant in {"ideal": ideal(), "hfs": hfs(), "standin": standin(0)}.items():
        walked = walk(WalkConfig(), robot, Job(expert(), named_command("s"), plant, 1.0))
        found[name] = _flat([walked.state, walked.command, walked.effect])
    jobs = [Job(expert(), named_command("s"), plant, 1.0) for plant in (ideal(), ideal())]
    (batched, _) = walk_batch(WalkConfig(), robot, jobs, fine=True)
    found["mjx"] = _flat([batched.state, batched.command, batched.effect])
    other = load_robot(STRIDER)
    walked = walk(walk_config(other), other, Job(nominal(other), named_command("s"), ideal(), 1.0))
    return found | {"strider": _flat([walked.state, walked.command, walked.effect])}


def walks() -> Arrays:
    """L of four seconds in each world."""
    robot, found = load_robot(), {}
    for world, plant in {"ideal": ideal(), "hfs": hfs(), "standin": standin(0)}.items():
        for name, weights in {"nominal": nominal(), "expert": expert()}.items():
            for command in COMMANDS:
                walked = walk(WalkConfig(), robot, Job(weights, named_command(command), plant))
                found[f"{world}, {name}, {command}"] = _loss(walked)
    return found


SECTIONS: dict[str, Section] = {
    "qp": (qp, 1e-12),
    "tick": (tick, 1e-12),
    "phi": (phi, 1e-9),
    "rollouts": (rollouts, 1e-9),
    "tunings": (tunings, 1e-9),
    "seconds": (seconds, 1e-9),
    "walks": (walks, 1e-6),
}


def difference(before: np.ndarray, now: np.ndarray) -> float:
    """Largest difference over the largest entry; infinite for another shape, or NaN elsewhere."""
    if before.shape != now.shape or np.any(np.isnan(before) != np.isnan(now)):
        return np.inf
    before, now = np.nan_to_num(before), np.nan_to_num(now)
    largest = np.max(np.abs(before), initial=0.0)
    return float(np.max(np.abs(before - now), initial=0.0) / (largest or 1.0))


def main() -> int:
    """Make or compare; 1 where something differs."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.golden", description=__doc__)
    parser.add_argument("what", choices=("make", "compare"))
    parser.add_argument("file", type=Path, help="golden results (.npz)")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="sections; all by default")
    flags = parser.parse_args()
    names = flags.only or list(SECTIONS)
    setup_jax()
    found = {}
    for name in names:
        say(f"{name} ...")
        found |= {f"{name}: {key}": np.asarray(x, float) for key, x in SECTIONS[name][0]().items()}
    if flags.what == "make":
        np.savez(flags.file, **found)
        print(f"{len(found)} results in {flags.file}")
        return 0
    differ = False
    with np.load(flags.file) as before:
        for name in names:
            tolerance, worst = SECTIONS[name][1], {}
            keys = {key for key in (*before.files, *found) if key.startswith(f"{name}: ")}
            for key in keys:
                there = key in found and key in before.files
                worst[key] = difference(before[key], found[key]) if there else np.inf
            key = max(worst, key=lambda key: worst[key])
            told = "same" if worst[key] <= tolerance else "DIFFERS"
            differ |= worst[key] > tolerance
            print(f"{name:10s} {told:8s} {worst[key]:.1e} (at most {tolerance:.0e}), {key}")
            for other in sorted(worst, key=lambda key: -worst[key])[1:]:
                if worst[other] > tolerance:
                    print(f"{'':20s}{worst[other]:.1e}, {other}")
    return int(differ)


if __name__ == "__main__":
    sys.exit(main())
