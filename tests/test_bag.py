"""Bags as logs: a walk that is written as one, in both formats, is the walk."""

import numpy as np
import pytest
from model import ROBOT
from pretend import call, refused
from scipy.spatial.transform import Rotation
from test_log_check import entries_of

from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.core.inputs import InputError
from hector_jax.own.bag import read_bag, read_mapping
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs

pytest.importorskip("rosbags")
from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

SECONDS, LEAD = 2.0, 0.3
STORE = get_typestore(Stores.ROS2_HUMBLE)
MAPPING = """
joints = "/joint_states"
trunk = "/odom"
start = 0.3
contact = "/contacts:data"
command_force = ["/left/wrench:wrench.force", "/right/wrench:wrench.force"]
command_moment = ["/left/wrench:wrench.torque", "/right/wrench:wrench.torque"]
period = 0.002
"""
BY_TOPIC = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/odom": "nav_msgs/msg/Odometry",
    "/contacts": "std_msgs/msg/Float64MultiArray",
    "/left/wrench": "geometry_msgs/msg/WrenchStamped",
    "/right/wrench": "geometry_msgs/msg/WrenchStamped",
}


@pytest.fixture(scope="module")
def walked():
    plant = hfs(ROBOT.description)
    return entries_of(ROBOT, Job(nominal(ROBOT), named_command("c"), plant, SECONDS))


def made(kind, *values):
    return STORE.types[kind](*values)


def vector(x):
    return made("geometry_msgs/msg/Vector3", *map(float, x))


def messages(log, row, stamp):
    """The messages of a sample: of the trunk's origin, its twist in its own axes."""
    seconds = int(stamp // 1_000_000_000)
    time = made("builtin_interfaces/msg/Time", seconds, int(stamp % 1_000_000_000))
    header = made("std_msgs/msg/Header", time, "map")
    euler, position, rate, velocity = (
        log[f"state.{x}"][row] for x in ("euler", "position", "ang_velocity", "velocity")
    )
    R = np.asarray(rotation_from_euler(euler))
    offset = R @ np.asarray(ROBOT.com_offset)
    point = made("geometry_msgs/msg/Point", *map(float, position - offset))
    turn = made("geometry_msgs/msg/Quaternion", *Rotation.from_matrix(R).as_quat().tolist())
    twist = vector(R.T @ (velocity - np.cross(rate, offset))), vector(R.T @ rate)
    none = np.zeros(36)
    pose = made(
        "geometry_msgs/msg/PoseWithCovariance", made("geometry_msgs/msg/Pose", point, turn), none
    )
    twist = made(
        "geometry_msgs/msg/TwistWithCovariance", made("geometry_msgs/msg/Twist", *twist), none
    )
    names, order = [*ROBOT.description.joints][::-1], slice(None, None, -1)
    joints = log["joints"][row][order].copy(), np.zeros(10), log["torque"][row][order].copy()
    yield "/joint_states", made(BY_TOPIC["/joint_states"], header, names, *joints)
    yield "/odom", made(BY_TOPIC["/odom"], header, "trunk", pose, twist)
    layout = made("std_msgs/msg/MultiArrayLayout", [], 0)
    contact = log["contact"][row].astype(float)
    yield "/contacts", made(BY_TOPIC["/contacts"], layout, contact)
    for foot, side in enumerate(("left", "right")):
        parts = (vector(log[f"command.{x}"][row, foot]) for x in ("force", "moment"))
        wrench = made("geometry_msgs/msg/Wrench", *parts)
        yield f"/{side}/wrench", made(BY_TOPIC[f"/{side}/wrench"], header, wrench)


def write(path, log, plugin=StoragePlugin.MCAP, *, without=(), stride=2, back=None):
    """Write a bag of 500 Hz; before the command the robot stands as at its start."""
    lead = round(LEAD / 0.001)
    rows = [*[0] * lead, *range(len(log["joints"]))][::stride]
    with Writer(path, version=9, storage_plugin=plugin) as bag:
        of = {x: bag.add_connection(x, kind, typestore=STORE) for x, kind in BY_TOPIC.items()}
        for number, row in enumerate(rows):
            # the state of a row is that at its end, what is commanded held from its begin on
            recorded = 10**18 + number * stride * 1_000_000
            stamp = recorded - (10**9 if back == number else 0)
            for topic, message in messages(log, row, stamp):
                if topic not in without:
                    bag.write(
                        of[topic], recorded, STORE.serialize_cdr(message, message.__msgtype__)
                    )
    return path


@pytest.fixture(scope="module")
def bag(walked, tmp_path_factory):
    return write(tmp_path_factory.mktemp("bag") / "walk", walked)


@pytest.fixture
def mapping(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(MAPPING)
    return path


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_a_bag_has_the_walk_that_was_written(walked, tmp_path, mapping, plugin):
    path = write(tmp_path / "walk", walked, plugin)
    log = read_bag(path, read_mapping(mapping), ROBOT, SECONDS, 0.01)
    rows = np.arange(2, 2000, 2)  # at the end of each sample of 2 ms
    count = len(rows)
    assert len(log["joints"]) == count
    for name in ("joints", "torque", "state.euler", "state.position", "state.ang_velocity"):
        np.testing.assert_allclose(log[name], walked[name][rows], atol=1e-6, err_msg=name)
    np.testing.assert_allclose(log["state.velocity"], walked["state.velocity"][rows], atol=1e-6)
    held = np.arange(0, 2 * count, 2)
    for name in ("contact", "command.force", "command.moment"):
        np.testing.assert_allclose(log[name], walked[name][held], atol=1e-9, err_msg=name)
    # the file of a bag is one too
    file = next(x for x in path.iterdir() if x.suffix in (".mcap", ".db3"))
    if plugin is StoragePlugin.MCAP:
        again = read_bag(file, read_mapping(mapping), ROBOT, SECONDS, 0.01)
        np.testing.assert_array_equal(again["joints"], log["joints"])


def test_logs_may_be_bags(bag, walked, mapping, tmp_path, monkeypatch, capsys):
    words = ("--mapping", mapping, "--traj", "c", "--seconds", 1.9)
    assert call(monkeypatch, "log", "check", bag, *words) == 0
    assert capsys.readouterr().out == "nothing is found that weights could not fix\n"
    weak = walked["torque"].copy()
    weak[:, 3] = 1000.0
    other = write(tmp_path / "weak", walked | {"torque": weak})
    assert call(monkeypatch, "log", "check", other, *words) == 0
    assert "the torque of left_knee is at its limit" in capsys.readouterr().out
    bare = tmp_path / "bare.toml"
    bare.write_text("\n".join(x for x in MAPPING.splitlines() if "command" not in x))
    assert call(monkeypatch, "log", "check", bag, "--mapping", bare, *words[2:]) == 0
    assert "without command.force gain and delay" in capsys.readouterr().err
    told = refused(monkeypatch, capsys, "log", "twin", bag, "--mapping", bare, *words[2:])
    assert f"{bag}: command.force is missing" in told


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (('"/odom"', '"/odometry"'), "unknown topic '/odometry'; did you mean '/odom'?"),
        (('joints = "/joint_states"', 'joints = "/odom"'), "/odom: unknown joint 'left_hip_yaw'"),
        (("start = 0.3", 'names = ["a"]'), "names must be those of the 10 joints, got 1"),
        (
            ("start = 0.3", f"names = {['left_hop', *ROBOT.description.joints[1:]]}"),
            "/joint_states: unknown joint 'left_hop'; did you mean 'left_hip_yaw'",
        ),
        (("contacts:data", "contacts:date"), "no numbers in field 'date'; fields of /contacts:"),
        (('"/contacts:data"', '"/odom:child_frame_id"'), "no numbers in field 'child_frame_id'"),
        ((', "/right/wrench:wrench.force"', ""), "command_force has 3 numbers, expected 6"),
        (("start = 0.3", "start = 9"), "s before start = 9 s"),
        (('trunk = "/odom"', ""), "map.toml: missing field 'trunk'"),
    ],
)
def test_what_a_bag_does_not_have_is_one_line(bag, mapping, monkeypatch, capsys, change, told):
    mapping.write_text(MAPPING.replace(*change))
    line = ("log", "check", bag, "--mapping", mapping, "--traj", "c", "--seconds", 1.9)
    assert told in refused(monkeypatch, capsys, *line)


def test_time_that_goes_back_gaps_and_other_files_are_one_line(
    walked, mapping, tmp_path, monkeypatch, capsys
):
    topics = read_mapping(mapping)
    back = write(tmp_path / "back", walked, back=500)
    with pytest.raises(InputError, match=r"/joint_states: the time goes back by .* at message 500"):
        read_bag(back, topics, ROBOT, SECONDS, 0.01)
    seldom = write(tmp_path / "seldom", walked, stride=150)
    with pytest.raises(InputError, match=r"has no message for 0.15 s"):
        read_bag(seldom, topics, ROBOT, SECONDS, 0.01)
    empty = write(tmp_path / "empty", walked, without=("/odom",), stride=50)
    with pytest.raises(InputError, match="/odom has no messages"):
        read_bag(empty, topics, ROBOT, SECONDS, 0.01)
    (tmp_path / "no.mcap").write_text("no bag")
    line = ("log", "check", "--traj", "c", "--seconds", 1.9)
    told = refused(monkeypatch, capsys, *line, tmp_path / "no.mcap", "--mapping", mapping)
    assert "no.mcap: not a bag" in told
    told = refused(monkeypatch, capsys, *line, back)
    assert "a bag needs a --mapping" in told


@pytest.mark.slow  # it solves the plans again, and again
def test_the_plans_of_a_bag_are_compared(bag, mapping, monkeypatch, capsys):
    words = ("--mapping", mapping, "--traj", "c", "--seconds", 1.0)
    assert call(monkeypatch, "log", "twin", bag, *words, "--json") == 0
    assert '"plans": 99' in capsys.readouterr().out
