"""Walk as asked: `python walker.py request.json log.npz`."""

import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from controller import IN_PLACE, MODEL, PERIOD, SIDES, STAND, Controller, named


def simulator(plant: dict) -> mujoco.MjModel:
    """Return the robot that is walked, with those numbers of a plant that this simulator has."""
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    model.body_mass *= plant["mass"]
    model.body_inertia *= plant["mass"]
    model.body_ipos[1] += plant["trunk_com"]
    model.geom("floor").friction[0] = plant["floor_friction"]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def ground(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the floor's force on each foot and its moment about the foot point (2, 6)."""
    wrench, local, feet = np.zeros((2, 6)), np.zeros(6), [f"{side}_foot" for side in SIDES]
    for i, contact in enumerate(data.contact):
        floor, part = (model.body(body).name for body in model.geom_bodyid[contact.geom])
        if floor == "world" and part in feet:
            mujoco.mj_contactForce(model, data, i, local)
            force = contact.frame.reshape(3, 3).T @ local[:3]
            moment = np.cross(contact.pos - data.site(f"{part}_point").xpos, force)
            wrench[feet.index(part)] += [*force, *moment]
    return wrench


def walk(request: dict) -> dict[str, Any]:
    """Walk, until a fall if there is one, and return the entries of the log."""
    robot, model = Controller(request["weights"], request["command"]), simulator(request["plant"])
    data, log = mujoco.MjData(model), {}
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for step in range(-round((STAND + IN_PLACE) / PERIOD), round(request["seconds"] / PERIOD)):
        log |= named("initial", robot.state(data.qpos, data.qvel)) if step <= 0 else {}
        data.ctrl[:] = robot.torques(step * PERIOD, data.qpos, data.qvel)
        mujoco.mj_step(model, data)
        x = robot.state(data.qpos, data.qvel)
        upright = x[5] >= 0.25 and np.abs(x[:2]).max() <= 0.8
        if step >= 0 or not upright:
            row = named("state", x) | named("reference", robot.reference((step + 1) * PERIOD, x)[0])
            row |= named("command", robot.wrench) | named("effect", ground(model, data))
            row |= {"joints": data.qpos[7:], "torque": data.ctrl, "contact": robot.contact}
            for name, value in row.items():
                log.setdefault(name, []).append(value.copy())
        if not upright:
            break
    return log


if __name__ == "__main__":
    np.savez(sys.argv[2], period=PERIOD, **walk(json.loads(Path(sys.argv[1]).read_text())))
