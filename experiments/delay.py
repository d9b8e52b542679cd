"""From which delay of the motors on do trunk and legs cycle, and what keeps them from it?

    python experiments/delay.py --robots quadruped=examples/quadruped/robot.toml

The nominal weights of each robot walk on the hfs with motors of several delays and lags and the
white noise of the stand-in's estimate, with one change of the controller at a time. The root locus
is that of the linear loops (`sim.margin`): as proposed, and by the gains of the rule before.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import lib
import numpy as np
import plots

from hector_jax.control.controller import WalkConfig, walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import nominal
from hector_jax.core.console import say
from hector_jax.core.inputs import InputError, plural
from hector_jax.core.pool import workers
from hector_jax.core.settings import AT_LEAST_ONE, POSITIVE, Range, check
from hector_jax.core.trajectory import Trajectory
from hector_jax.report.report import markdown_table
from hector_jax.robot.model import Robot, load_robot
from hector_jax.robot.response import response
from hector_jax.sim.loop import Job
from hector_jax.sim.margin import loops, modes, step_response
from hector_jax.sim.walk import walk_many
from hector_jax.sim.world import MAX_DELAY, Imperfections, hfs, truth
from hector_jax.tuning.loss import loss_of_robot
from hector_jax.verdict import metrics

NOISE = {"position": 0.003, "velocity": 0.03, "angle": 0.005, "ang_velocity": 0.03, "joint": 0.001}
"""White noise of the stand-in's estimate, by field of `Estimator`."""
AS_PROPOSED, BEFORE = "as proposed", "w = 30 rad/s, whole inertia"
LOCUS = np.linspace(0.0, MAX_DELAY, 9)  # [s]


def _gains(config: WalkConfig, kp: float = 1.0, kd: float = 1.0) -> WalkConfig:
    """Scale the gains of the legs."""
    legs = config.legs
    scaled = {"kp": tuple(kp * k for k in legs.kp), "kd": tuple(kd * k for k in legs.kd)}
    return replace(config, legs=replace(legs, **scaled))


def _whole(config: WalkConfig) -> WalkConfig:
    """Plan with the inertia of the whole robot."""
    return replace(config, mpc=replace(config.mpc, inertia_share=(1.0, 1.0, 1.0)))


def _before(robot: Robot, config: WalkConfig) -> WalkConfig:
    """Return the controller as it was proposed before: w = 30 rad/s, the whole inertia."""
    legs = len(robot.foot_point)
    inertia = response(robot).inertia.reshape(legs, -1).mean(axis=0)
    most = 2.0 * robot.torque_limit.reshape(legs, -1).min(axis=0)
    kp = np.minimum(900.0 * inertia, most)
    gains = {"kp": tuple(kp.tolist()), "kd": tuple(np.sqrt(kp * inertia).tolist())}
    return replace(_whole(config), legs=replace(config.legs, **gains))


CHANGES: dict[str, Callable[[Robot, WalkConfig], WalkConfig]] = {
    AS_PROPOSED: lambda robot, c: c,
    BEFORE: _before,
    "whole inertia": lambda robot, c: _whole(c),
    "kp x 0.5": lambda robot, c: _gains(c, kp=0.5),
    "kd x 0.5": lambda robot, c: _gains(c, kd=0.5),
    "kd x 2": lambda robot, c: _gains(c, kd=2.0),
    "no step feedback": lambda robot, c: replace(c, footstep=replace(c.footstep, feedback=0.0)),
    "MPC step of 5 ticks": lambda robot, c: replace(c, mpc=replace(c.mpc, step_ticks=5)),
    "no gravity compensation": lambda robot, c: replace(
        c, legs=replace(c.legs, gravity_compensation=False)
    ),
}
"""Changes of a controller by their names."""


@dataclass(frozen=True, kw_only=True)
class Flags(lib.Flags):
    """What walks where."""

    robots: tuple[str, ...] = ("quadruped=examples/quadruped/robot.toml",)  # NAME=TOML
    traj: tuple[str, ...] = ("straight",)  # of straight, c and s
    changes: tuple[str, ...] = tuple(CHANGES)  # of the controller, one at a time
    delays: tuple[Annotated[float, Range(0.0, 1e3 * MAX_DELAY)], ...] = (2.0, 4.0, 5.0, 8.0)  # [ms]
    lags: tuple[Annotated[float, POSITIVE], ...] = (4.0, 6.0, 6.0, 6.0)  # [ms], one for each delay
    seeds: Annotated[int, AT_LEAST_ONE] = 1  # of the noise, from 1 on
    out: Path = Path("runs/delay")  # folder of the report

    def __post_init__(self) -> None:
        check(self, traj=COMMANDS, changes=tuple(CHANGES))
        lib.named_files("robots", self.robots)
        if len(self.delays) != len(self.lags):
            count = f"{len(self.delays)} delays and {len(self.lags)} lags"
            raise InputError(f"--lags must be one for each of --delays, got {count}")


def plant(robot: Robot, delay: float, lag: float) -> Imperfections:
    """Return the hfs with motors of a delay and a lag [ms] and a noisy estimate."""
    noise = {name: np.asarray(sigma) for name, sigma in NOISE.items()}
    motors = {"delay": np.asarray(1e-3 * delay), "lag": np.asarray(1e-3 * lag)}
    return hfs(robot.description)._replace(**motors, estimator=truth()._replace(**noise))


def walk_robot(
    flags: Flags, pool: Executor, robot: Robot, command: str
) -> dict[str, list[list[dict[str, float]]]]:
    """Walk a command with each change; returns L, L_ctrl and falls by change, motors and seed."""
    loss, weights = loss_of_robot(robot.description), nominal(robot)
    plants = [plant(robot, *numbers) for numbers in zip(flags.delays, flags.lags, strict=True)]
    seeds = range(1, flags.seeds + 1)
    jobs = [Job(weights, named_command(command), p, seed=seed) for p in plants for seed in seeds]

    def numbers_of(walk: Trajectory) -> dict[str, float]:
        score = metrics.score(loss, walk)
        losses = {name: float(score.losses[name]) for name in ("L", "L_ctrl")}
        return {**losses, "fell": bool(score.fallen)}

    results = {}
    for change in flags.changes:
        walks = walk_many(pool, CHANGES[change](robot, walk_config(robot)), robot, jobs)
        results[change] = [[numbers_of(next(walks)) for _ in seeds] for _ in plants]
        say(f"{command}, {change}: {', '.join(map(_cell, results[change]))}")
    return results


def _cell(walks: list[dict[str, float]]) -> str:
    """Return the median of L and L_ctrl in 1e6, and the falls."""
    L, L_ctrl = (np.median([walk[name] for walk in walks]) / 1e6 for name in ("L", "L_ctrl"))
    falls = sum(walk["fell"] for walk in walks)
    return f"{L:.2f} ({L_ctrl:.2f}){f', {falls} fell' if falls else ''}"


def root_locus(robot: Robot, change: str) -> list[list[tuple[float, float]]]:
    """Return growth [1/s] and frequency [Hz] of the modes with each delay of LOCUS."""
    config = CHANGES[change](robot, walk_config(robot))
    parts = loops(robot, config, nominal(robot), step_response(robot, config))
    found = [modes(parts, delay) for delay in LOCUS]
    return [[(float(m.real), float(m.imag) / (2 * np.pi)) for m in each] for each in found]


def main(flags: Flags) -> Path:
    """Write report.md, delay.json and a root locus of each robot."""
    walks, loci, tables, pictures = {}, {}, [], {}
    motors = zip(flags.delays, flags.lags, strict=True)
    head = ["change", *(f"{delay:g}, {lag:g} ms" for delay, lag in motors)]
    with workers(flags.processes) as pool:
        for name, file in lib.named_files("robots", flags.robots).items():
            robot = load_robot(Path(file))
            loci[name] = {change: root_locus(robot, change) for change in (BEFORE, AS_PROPOSED)}
            picture = f"root-locus-{name}.png"
            pictures[picture] = plots.root_locus(flags.out / picture, 1e3 * LOCUS, loci[name])
            walks[name] = {}
            for command in flags.traj:
                found = walks[name][command] = walk_robot(flags, pool, robot, command)
                rows = [[change, *map(_cell, cells)] for change, cells in found.items()]
                tables += [f"## {name}, {command}", markdown_table(head, rows)]
    about = (
        f"L (L_ctrl) in 1e6 of the nominal weights on the hfs, by delay and lag of the motors, "
        f"with the white noise of the stand-in's estimate; the median of "
        f"{plural(flags.seeds, 'seed')}."
    )
    numbers = {"walks": walks, "delays": list(flags.delays), "lags": list(flags.lags)}
    numbers |= {"root_locus": loci, "root_locus_delays": (1e3 * LOCUS).tolist()}
    title = f"Delay of the motors: {', '.join([*walks, *flags.traj])}"
    return lib.write_report(flags.out / "delay.json", title, [about, *tables], numbers, pictures)


if __name__ == "__main__":
    lib.run(main, Flags)
