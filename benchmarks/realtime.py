"""One controller tick (plan and actuate), jitted and called from Python, along a walk in `ideal`.

A walk in MuJoCo is recorded once; the tick is then fed with what the robot measured, tick by tick,
and timed from the call to the torques in numpy. Wall time counts what else the machine does, CPU
time does not.
"""

import sys
import time
from functools import partial
from pathlib import Path

from benchmarks.measuring import Check, Report, pin_one_core, show

if __name__ == "__main__":
    pin_one_core()

import jax
import numpy as np

from hector_jax.control.controller import actuate, init_memory, step_plan, walk_config
from hector_jax.control.reference import anchor_at, named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.runtime import setup_jax
from hector_jax.robot.model import load_robot
from hector_jax.sim import sensing
from hector_jax.sim.loop import Job, substeps
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import ideal

SECONDS = 10.0


def measure(seconds: float = SECONDS, robot_file: Path | None = None) -> Report:
    """Walk straight, then time every tick of it; of HECTOR, or of another robot's file."""
    setup_jax()
    robot = load_robot(robot_file)
    config, weights = walk_config(robot), nominal(robot) if robot_file else expert()
    command = named_command("straight")
    rows: list[np.ndarray] = []

    def record(world, data) -> None:
        known = np.concatenate([data.qpos, data.qvel, np.zeros(1)])
        rows.append(known[sensing.coordinates(world)])

    job = Job(weights, command, ideal(robot.description), seconds)
    walked = walk(config, robot, job, build=partial(MujocoPlant, on_step=record))
    count, no_error = substeps(config), sensing.no_error(robot)
    readings = rows[-round(seconds * 1000) - 1 :: count][: round(seconds / config.gait.tick)]

    @jax.jit
    def begin(row):
        measurement, yaw = sensing.measure(robot, row, np.zeros(()), no_error)
        return init_memory(robot, measurement), measurement.state, yaw

    @jax.jit
    def tick(robot, weights, command, anchor, number, memory, yaw, row):
        measurement, yaw = sensing.measure(robot, row, yaw, no_error)
        parameters = config.parameters(weights)
        memory, plan = step_plan(
            config,
            robot,
            parameters,
            command=command,
            anchor=anchor,
            tick=number,
            memory=memory,
            measurement=measurement,
        )
        now = {"substep": np.array(0, np.int32), "measurement": measurement}
        torque = actuate(config, robot, parameters.legs, plan=plan, memory=memory, **now)
        return memory, yaw, torque, plan.status

    memory, state, yaw = begin(readings[0])
    fixed = jax.device_put((robot, weights, command, anchor_at(robot, state, 0)))
    np.asarray(tick(*fixed, np.array(0, np.int32), memory, yaw, readings[0])[2])
    spent, solved = [], 0
    for number, row in enumerate(readings):
        wall, cpu = time.perf_counter(), time.process_time()
        memory, yaw, torque, status = tick(*fixed, np.array(number, np.int32), memory, yaw, row)
        np.asarray(torque)
        spent.append((time.perf_counter() - wall, time.process_time() - cpu))
        solved += int(status) == 0
    wall, cpu = 1e3 * np.array(spent).T
    table = [
        [name, f"{np.median(t):.2f}", f"{np.quantile(t, 0.99):.2f}", f"{t.max():.2f}"]
        for name, t in (("wall", wall), ("CPU", cpu))
    ]
    fell = " and fell" if np.asarray(walked.fallen).any() else ""
    notes = [
        f"{len(readings)} ticks, {solved} of them solved; the robot walked {seconds:g} s{fell}"
    ]
    checks = [
        Check("controller tick, median", float(np.median(wall)), "ms", 1.0),
        Check("controller tick, p99", float(np.quantile(wall, 0.99)), "ms", 2.0),
    ]
    columns = ("one controller tick", "median ms", "p99 ms", "max ms")
    return Report("Real time, one CPU core", columns, table, checks, notes)


if __name__ == "__main__":
    seconds, *file = sys.argv[1:] or [SECONDS]
    show(measure(float(seconds), *map(Path, file)))
