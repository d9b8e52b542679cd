"""Plan as asked: `python planner.py inputs.npz plans.npz`."""

import sys
from collections.abc import Mapping

import numpy as np
from controller import NUMBERS, PARTS, Controller


def plans(asked: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the plan of each row of inputs: wrenches and next footholds, world frame."""
    names = ("duration", "velocity", "yaw_rate")
    Q = {name: asked[f"weights.Q.{name}"] for name in PARTS[13]}
    R = {name: asked[f"weights.R.{name}"] for name in PARTS[6]}
    others = {n: asked[x] for n in NUMBERS if (x := f"weights.others.{n}") in asked}
    robot = Controller(
        {"Q": {n: x[0] for n, x in Q.items()}, "R": {n: x[0] for n, x in R.items()}},
        {name: asked[f"command.{name}"] for name in names},
    )
    states = np.column_stack([*(asked[f"state.{name}"] for name in PARTS[13])])
    times, feet, yaws = asked["time"], asked["feet.position"], asked["feet.yaw"]
    wrenches, footholds = np.zeros((len(times), 2, 6)), np.zeros((len(times), 2, 3))
    for row, time in enumerate(times):
        robot.Q[:12] = np.concatenate([x[row] for x in Q.values()])
        robot.R = np.concatenate([x[row].ravel() for x in R.values()])
        robot.numbers |= {name: x[row] for name, x in others.items()}
        x = np.append(states[row], 1.0)
        robot.wrench[:] = np.nan  # what it would keep if it did not solve the plan
        wrenches[row] = robot.plan(time, x, feet[row], yaws[row])
        footholds[row] = [[*robot.foothold(time, x, foot)[0][:2], 0.0] for foot in range(2)]
    force, moment = np.split(wrenches, 2, axis=2)
    return {"force": force, "moment": moment, "touchdown": footholds}


if __name__ == "__main__":
    np.savez(sys.argv[2], **plans(np.load(sys.argv[1])))
