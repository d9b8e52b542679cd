"""What the log of a walk shows that no weight can fix: planted faults, and sound logs."""

import re
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import QUADRUPED, ROBOT

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import COMMANDS, named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.geometry import euler_rates, rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import named_leaves
from hector_jax.own.log_check import check_log, read_check
from hector_jax.own.parity import compare_plans
from hector_jax.own.walk_file import read_walk
from hector_jax.robot.kinematics import foot_poses, inverse_legs
from hector_jax.sim.diagnosis import record_walk
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


def kinematic_log(robot, turn):
    """A trot of planted feet, 2 s, from kinematics alone, with what a log needs."""
    period, half = 0.005, 0.2
    t = period * np.arange(1, 401)
    legs = len(robot.foot_point)
    standing = np.asarray(robot.standing_joints)
    reach = foot_poses(robot, jnp.asarray(standing)).position
    feet = np.asarray(reach) - np.asarray(robot.com_offset)
    pose = lambda t: (  # noqa: E731
        np.stack([0.02 * np.sin(9 * t), 0.01 * np.sin(7 * t), turn * t + 0.01 * np.sin(5 * t)], -1),
        np.stack([0.4 * t, 0.01 * np.sin(8 * t), 0 * t + float(robot.standing_height)], -1),
    )

    def plant(k, foot):  # under its hip in the middle of the k-th half
        (_, _, yaw), place = pose(np.asarray((k + 0.5) * half))
        x, y = feet[foot, :2]
        there = place[:2] + [x * np.cos(yaw) - y * np.sin(yaw), x * np.sin(yaw) + y * np.cos(yaw)]
        return np.append(there, 0.0)

    euler, position = pose(t)
    k, share = np.floor(t / half - 1e-9).astype(int), (t / half - 1e-9) % 1.0
    target, stance = np.zeros((len(t), legs, 3)), np.zeros((len(t), legs), bool)
    for foot in range(legs):
        stance[:, foot] = (k + foot % 2 + foot // 2) % 2 == 0
        for n in range(len(t)):
            if stance[n, foot]:
                target[n, foot] = plant(k[n], foot)
            else:
                before, after = plant(k[n] - 1, foot), plant(k[n] + 1, foot)
                lift = [0.0, 0.0, 0.03 * np.sin(np.pi * share[n])]
                target[n, foot] = before + share[n] * (after - before) + lift
    R = np.asarray(jax.vmap(rotation_from_euler)(euler))
    local = np.einsum("tij,tfi->tfj", R, target - position[:, None]) + np.asarray(robot.com_offset)

    def follow(start, inputs):
        place, R, yaw = inputs
        up = jax.numpy.tile(R[2], (legs, 1))
        joints = inverse_legs(robot, place, jax.numpy.zeros(legs), up, start, steps=8)
        return joints, joints

    _, joints = jax.jit(lambda *x: jax.lax.scan(follow, standing, x))(local, R, euler[:, 2])
    rates = np.gradient(euler, t, axis=0)
    E = np.asarray(jax.vmap(euler_rates)(euler))
    force = np.zeros((len(t), legs, 3))
    weight = float(robot.mass * robot.gravity[2])
    force[..., 2] = stance * weight / stance.sum(axis=1, keepdims=True)
    force[1::2, :, 0] = 1.0
    state = {
        "euler": euler,
        "position": position,
        "ang_velocity": np.linalg.solve(E, rates[..., None])[..., 0],
        "velocity": np.gradient(position, t, axis=0),
    }
    log = {f"state.{name}": x for name, x in state.items()}
    log |= {f"initial.{name}": x[0] for name, x in state.items()}
    walk = {"command.force": force, "command.moment": 0 * force, "joints": np.asarray(joints)}
    return {"period": np.array(period), **log, **walk, "contact": stance}


BODIES = {2: ROBOT, 4: QUADRUPED}


@pytest.fixture(scope="module", params=[(2, 0.0), (4, 0.0), (4, 0.8)], ids=str)
def planted(request):
    feet, turn = request.param
    return BODIES[feet], kinematic_log(BODIES[feet], turn)


def legs_told(folder, robot, entries):
    """What is found of joints, feet, angles and units; the path is another one than the command."""
    path = r"reference all along|off the commanded path|the command changes"
    lines = found(folder, entries, robot, "straight")
    return [line for line in lines if not re.search(path, line)]


def legs_of(robot, log, name="joints"):
    return log[name].reshape(len(log["joints"]), len(robot.foot_point), -1)


def test_planted_feet_and_foreign_entries_have_nothing_to_tell(tmp_path, planted):
    robot, log = planted
    assert legs_told(tmp_path, robot, log) == []
    foreign = {"info": np.array({"robot": "mine"}, dtype=object)}
    assert legs_told(tmp_path, robot, log | foreign) == []


def test_each_joint_of_the_other_sign_or_dead_is_named_with_its_foot(tmp_path, planted):
    robot, log = planted
    names, count = robot.description.joints, robot.description.leg_joints
    for i, name in enumerate(names):
        dead, joints = log["joints"].copy(), log["joints"]
        dead[150:, i] = dead[150, i]
        if np.ptp(joints[:, i]) > 0.05:
            lines = legs_told(tmp_path, robot, log | {"joints": dead})
            assert lines[0].startswith(f"{name} does not move"), (name, lines)
        if np.abs(joints[:, i]).max() < 0.2:
            continue  # its sign hardly matters
        sign = np.where(np.arange(len(names)) == i, -1, 1)
        (line,) = legs_told(tmp_path, robot, log | {"joints": joints * sign})
        assert f"({robot.description.legs[i // count]}) slide at" in line
        assert f"the sign of {name} is the other one" in line


def test_a_leg_at_zero_is_named(tmp_path, planted):
    robot, log = planted
    legs = legs_of(robot, log).copy()
    legs[:, 1] = 0.0
    (line,) = legs_told(tmp_path, robot, log | {"joints": legs.reshape(log["joints"].shape)})
    leg, count = robot.description.legs[1], robot.description.leg_joints
    knee = robot.description.joints[2 * count - 1]
    assert f"of the {leg} leg do not move" in line or f"{knee} do not move" in line


def test_orders_of_four_legs_are_named_with_and_without_their_forces(tmp_path):
    log = kinematic_log(QUADRUPED, 0.8)
    for order in ([0, 2, 1, 3], [1, 0, 3, 2], [3, 1, 0, 2]):
        told = f"in the order {', '.join(QUADRUPED.description.legs[i] for i in order)}"
        told = "left and right legs are exchanged" if order == [1, 0, 3, 2] else told
        for names in (("joints",), ("joints", "command.force", "command.moment", "contact")):
            moved = {n: legs_of(QUADRUPED, log, n)[:, order].reshape(log[n].shape) for n in names}
            (line,) = legs_told(tmp_path, QUADRUPED, log | moved)
            assert told in line, line


def test_what_is_late_is_named_by_the_shift_that_makes_feet_stand(tmp_path, planted):
    robot, log = planted
    late = lambda x, n: np.concatenate([np.repeat(x[:1], n, axis=0), x[:-n]])  # noqa: E731
    for ms in (20, 40):
        joints = {"joints": late(log["joints"], ms // 5)}
        (line,) = legs_told(tmp_path, robot, log | joints)
        assert f"joints are {ms} ms behind the state" in line
        state = {n: late(x, ms // 5) for n, x in log.items() if n.startswith("state")}
        (line,) = legs_told(tmp_path, robot, log | state)
        assert f"the state is {ms} ms behind the joints" in line


def test_angles_and_rates_in_the_other_order_are_guessed(tmp_path, planted):
    robot, log = planted
    turned = {n: x[..., ::-1] for n, x in log.items() if n.endswith(".euler")}
    rates = {n: x[..., ::-1] for n, x in log.items() if n.endswith("ang_velocity")}
    for changed in (turned, turned | rates):
        try:
            lines = legs_told(tmp_path, robot, log | changed)
        except InputError as error:
            lines = [str(error)]
        assert "yaw, pitch, roll" in lines[-1], lines


def test_forces_in_other_units_are_named(tmp_path, planted):
    robot, log = planted
    for unit, newtons in (("kN", 1e3), ("kgf", 9.81)):
        force = {"command.force": log["command.force"] / newtons}
        (line,) = legs_told(tmp_path, robot, log | force)
        assert line == f"command.force bears the robot's weight if it is in {unit}: expected is N"


def test_joints_that_never_move_and_entries_of_objects_are_refused(tmp_path, planted):
    robot, log = planted
    still = {"joints": np.tile(log["joints"][0], (400, 1))}
    with pytest.raises(InputError, match="its joints never move: the log has no legs"):
        found(tmp_path, log | still, robot)
    walk = read_walk(tmp_path / "log.npz", robot, SECONDS, TICK)[0]
    inputs = walk_config(robot), robot, nominal(robot), named_command("straight"), walk
    with pytest.raises(InputError, match="its joints never move: the log has no legs"):
        compare_plans(*inputs)
    for name in ("joints", "torque"):
        objects = np.full(log["joints"].shape, None, dtype=object)
        with pytest.raises(InputError, match=f"{name} cannot be read: Object arrays"):
            found(tmp_path, log | {name: objects}, robot)
    half = {n: x[:200] for n, x in log.items() if np.ndim(x) and len(x) == 400}
    with pytest.raises(InputError, match=r"too early to tell anything, it takes 1.5 s"):
        found(tmp_path, log | half, robot, seconds=1.0)


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
    told = "fell after 1.30 s: too early to tell anything, it takes 2 s"
    with pytest.raises(InputError, match=told):
        found(tmp_path, sound | {"state.position": fallen})


@pytest.mark.slow  # twenty walks
def test_of_twenty_sound_walks_at_most_one_is_blamed(tmp_path):
    blamed = []
    for number in range(20):
        robot = QUADRUPED if number % 4 == 3 else ROBOT
        traj, weights = COMMANDS[number % 3], (nominal, expert)[number % 2](robot)
        plant = named_world("hfs-varied", 480 + number, robot.description)
        plant = plant._replace(mass=np.ones_like(plant.mass))  # another mass is a fault
        log = entries_of(robot, Job(weights, named_command(traj), plant, SECONDS, number))
        if lines := found(tmp_path, log, robot, traj):
            blamed.append((number, lines))
    assert len(blamed) <= 1, blamed
