"""What the log of a walk shows that no weight can mend: planted faults, and sound logs."""

import re
from itertools import combinations
from pathlib import Path

import jax
import numpy as np
import pytest
from model import ROBOT

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import named_leaves
from hector_jax.robot.model import load_robot
from hector_jax.sim.diagnosis import record_walk
from hector_jax.sim.log_check import check_log, read_check
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs, named_world

SECONDS, TICK = 2.0, 0.01


def entries_of(robot, job):
    """The entries of the log of a walk, with torques."""
    record = record_walk(walk_config(robot), robot, job)
    count = len(record.trajectory.fallen)
    torque = record.torque[-count:] * np.asarray(robot.torque_limit)
    return {**named_leaves(record.trajectory), "torque": torque}


@pytest.fixture(scope="module")
def sound():
    plant = hfs(ROBOT.description)
    return entries_of(ROBOT, Job(nominal(ROBOT), named_command("c"), plant, SECONDS))


def found(folder, entries, robot=ROBOT, traj="c", seconds=SECONDS):
    np.savez(folder / "log.npz", **entries)
    inputs = folder / "log.npz", robot, named_command(traj), seconds, TICK
    return check_log(read_check(*inputs)[0], TICK)


# Each takes the entries of a log and returns those that it changes.


def scaled(factor, *names):
    return lambda log: {name: factor * log[name] for name in names}


def late(log):
    return {n: np.roll(log[n], 25, axis=0) for n in ("effect.force", "effect.moment")}


def in_air(log):
    force = log["command.force"].copy()
    force[~log["contact"]] = [0.0, 0.0, 20.0]
    return {"command.force": force}


def weak_motor(log):
    torque = log["torque"].copy()
    torque[::4, 3] = 1000.0
    return {"torque": torque}


def drifting(log):
    """The robot drifts away, and its controller's reference with it."""
    count = len(log["fallen"])
    drift = 0.1 * np.arange(count)[:, None] / 1000 * [-1.0, 0.4, 0.0]
    position = log["state.position"] + drift
    velocity = log["state.velocity"] + [-0.1, 0.04, 0.0]
    changed = {"state.position": position, "state.velocity": velocity}
    return changed | {"reference.position": position + 0.002}


def of_legs(change):
    return lambda log: {"joints": change(log["joints"].reshape(-1, 2, 5)).reshape(-1, 10)}


def high(log):
    up = np.array([0.0, 0.0, 0.03])
    return {name: log[name] + up for name in ("state.position", "initial.position")}


def seldom(log):
    rows = np.arange(len(log["fallen"])) // 25 * 25
    return {name: log[name][rows] for name in ("command.force", "command.moment")}


def in_trunk(log):
    R = jax.vmap(rotation_from_euler)(log["state.euler"])
    return {"state.velocity": np.einsum("tji,tj->ti", R, log["state.velocity"])}


def exchanged(log):
    return {"contact": log["contact"][:, ::-1]}


FAULTS = {
    "its mass is 12 % more than that of the file": scaled(1.12, "effect.force", "command.force"),
    "comes 3. ms after the commanded one": late,
    "is 0.7. times the commanded one": scaled(1.35, "command.force"),
    "feet in the air are commanded 20 N": in_air,
    "the torque of left_knee is at its limit": weak_motor,
    "its own reference, which follows it": drifting,
    "expected are those of the ground on the robot": scaled(-1.0, "command.force"),
    "the sign of left_hip_pitch and its likes": of_legs(lambda q: q * [1, 1, -1, 1, 1]),
    "left and right legs are exchanged": of_legs(lambda q: q[:, ::-1]),
    "feet that stand are 2.. cm above the floor": high,
    "the command changes every 25 ms": seldom,
    "velocity is .* it is in the frame of the trunk": in_trunk,
    "contact is not that of the feet with a commanded load": exchanged,
    "ang_velocity is .* it is in degrees": scaled(180 / np.pi, "state.ang_velocity"),
}
"""A fault by what must be told of it."""


def test_a_sound_log_has_nothing_to_tell(tmp_path, sound):
    assert found(tmp_path, sound) == []


@pytest.mark.parametrize("told", FAULTS)
def test_a_planted_fault_is_named(tmp_path, sound, told):
    lines = found(tmp_path, sound | FAULTS[told](sound))
    assert [line for line in lines if re.search(told, line)], lines
    assert len(lines) <= 1 + (FAULTS[told] is high), lines  # it is above its reference too


def test_of_two_faults_each_is_named(tmp_path, sound):
    names = ["comes 3. ms after", "feet in the air are", "left_knee is at its limit"]
    names += ["legs are exchanged", "in the frame of the trunk"]
    faults = {name: next(fault for told, fault in FAULTS.items() if name in told) for name in names}
    for one, other in combinations(names, 2):
        log = sound | faults[one](sound)
        lines = found(tmp_path, log | faults[other](log))
        assert len(lines) == 2, (one, other, lines)
        assert all(any(re.search(name, line) for line in lines) for name in (one, other)), lines


def test_what_tells_nothing_is_refused(tmp_path, sound):
    for change, told in (
        ({"torque": np.zeros((7, 3))}, r"torque must be numbers of shape \(2000, 10\), got float"),
        (
            {"state.euler": np.degrees(sound["state.euler"])},
            "roll or pitch reaches .* expected radians",
        ),
    ):
        with pytest.raises(InputError, match=told):
            found(tmp_path, sound | change)
    fallen = sound["state.position"].copy()
    fallen[1300:, 2] = 0.0
    with pytest.raises(InputError, match="fell after 1.30 s: too early to tell anything"):
        found(tmp_path, sound | {"state.position": fallen})


@pytest.mark.slow  # twenty walks
def test_of_twenty_sound_walks_at_most_one_is_blamed(tmp_path):
    quadruped = load_robot(Path(__file__).parents[1] / "examples" / "quadruped" / "robot.toml")
    blamed = []
    for number in range(20):
        robot = quadruped if number % 4 == 3 else ROBOT
        traj, weights = COMMANDS[number % 3], (nominal, expert)[number % 2](robot)
        plant = named_world("hfs-varied", 480 + number, robot.description)
        plant = plant._replace(mass=np.ones_like(plant.mass))  # another mass is a fault
        log = entries_of(robot, Job(weights, named_command(traj), plant, SECONDS, number))
        if lines := found(tmp_path, log, robot, traj):
            blamed.append((number, lines))
    assert len(blamed) <= 1, blamed
