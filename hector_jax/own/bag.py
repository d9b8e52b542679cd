"""Read a walk from a ROS 2 bag (sqlite3 or MCAP), by a table of its topics (the extra `bags`).

A bag has messages of many clocks and rates; a log has even samples. The stamps are those of the
headers, else the times at which messages were recorded. States and joints are interpolated, what is
commanded or planned is that of the last message.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from hector_jax.core.geometry import (
    euler_from_rotation,
    rotation_from_euler,
    rotation_from_quaternion,
)
from hector_jax.core.inputs import InputError, one_line, require_package, unknown
from hector_jax.core.settings import check, from_table, read_toml
from hector_jax.robot.model import Robot

LONGEST_GAP = 0.1  # [s] between two messages of joints or trunk
_HELD = ("command.force", "command.moment", "effect.force", "effect.moment", "contact", "residual")


@dataclass(frozen=True)
class BagMapping:
    """Topics of a bag; one that is written TOPIC:FIELD has a field in each of its messages."""

    joints: str  # sensor_msgs/JointState; its efforts are the torques
    trunk: str  # nav_msgs/Odometry of the trunk's origin
    start: float = 0.0  # [s] after the first samples, when the command begins
    twist: str = "trunk"  # axes of the trunk's velocities; or "world"
    names: tuple[str, ...] = ()  # of the joints in the bag, in the robot's order; empty: its own
    period: float | None = None  # [s] of the log; None: a tick
    # TOPIC:FIELD of all legs, or one for each leg
    command_force: tuple[str, ...] = ()
    command_moment: tuple[str, ...] = ()
    effect_force: tuple[str, ...] = ()
    effect_moment: tuple[str, ...] = ()
    contact: tuple[str, ...] = ()
    residual: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check(self, twist=("trunk", "world"))


class _Series(NamedTuple):
    """Numbers of the messages of a topic, in their order."""

    topic: str
    time: Float[np.ndarray, " n"]  # [s] after the start of the bag
    values: Float[np.ndarray, "n m"]

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return values between messages, on straight lines."""
        return np.stack([np.interp(times, self.time, x) for x in self.values.T], axis=1)

    def last(self, times: np.ndarray) -> np.ndarray:
        """Return the values of the last messages before some times."""
        rows = np.searchsorted(self.time, times + 1e-6, side="right") - 1  # at a time is before it
        return self.values[np.maximum(rows, 0)]


class _Bag(NamedTuple):
    """An open bag."""

    path: Path
    reader: Any

    def messages(self, topic: str) -> tuple[Float[np.ndarray, " n"], list[Any]]:
        """Return stamps and messages of a topic."""
        connections = [x for x in self.reader.connections if x.topic == topic]
        if not connections:
            topics = sorted({x.topic for x in self.reader.connections})
            raise InputError(f"{self.path}: {unknown('topic', topic, topics)}")
        times, found = [], []
        for connection, recorded, data in self.reader.messages(connections=connections):
            try:
                message = self.reader.deserialize(data, connection.msgtype)
            except KeyError:
                text = f"its type {connection.msgtype} is not in the bag"
                raise InputError(f"{self.path}: {topic}: {text}") from None
            stamp = getattr(getattr(message, "header", None), "stamp", None)
            own = 0 if stamp is None else 1_000_000_000 * stamp.sec + stamp.nanosec
            times.append(own or recorded)
            found.append(message)
        time = 1e-9 * (np.array(times) - self.reader.start_time)  # of 1e18 ns 1 ns would be lost
        if len(back := np.flatnonzero(np.diff(time) < 0.0)):
            text = f"the time goes back by {-np.diff(time)[back[0]]:.3g} s"
            raise InputError(f"{self.path}: {topic}: {text} at message {back[0] + 1}")
        if not found:
            raise InputError(f"{self.path}: {topic} has no messages")
        return time, found

    def field(self, source: str) -> _Series:
        """Return the numbers of TOPIC:FIELD."""
        topic, _, field = source.partition(":")
        time, messages = self.messages(topic)
        try:
            rows = [_numbers(_inner(message, field)) for message in messages]
        except (AttributeError, TypeError, ValueError):
            fields = ", ".join(x for x in messages[0].__dataclass_fields__ if x[:2] != "__")
            text = f"no numbers in field {field!r}; fields of {topic}: {fields}"
            raise InputError(f"{self.path}: {text}") from None
        if len({len(row) for row in rows}) > 1:
            raise InputError(f"{self.path}: {source} has another length in some messages")
        return _Series(topic, time, np.array(rows, float))


def _inner(message: Any, field: str) -> Any:
    for name in filter(None, field.split(".")):
        message = getattr(message, name)
    return message


def _numbers(value: Any) -> np.ndarray:
    """Return an array, or a vector message with x, y and z, as a row of numbers."""
    if hasattr(value, "z"):
        value = [value.x, value.y, value.z]
    return np.atleast_1d(np.asarray(value, float)).ravel()


def read_mapping(path: Path) -> BagMapping:
    """Read the table of a bag's topics.

    Raises:
        InputError: one line naming the file and the field that is unknown, missing or invalid.
    """
    table = read_toml(path, "a table of a bag's topics")
    lists = {
        name: [x] if name in _TOPICS and isinstance(x, str) else x for name, x in table.items()
    }
    return from_table(str(path), BagMapping, lists)


_TOPICS = {name.replace(".", "_") for name in _HELD}


def read_bag(
    path: Path, mapping: BagMapping, robot: Robot, seconds: float, tick: float
) -> dict[str, np.ndarray]:
    """Return the entries of a log (`own.walk_file`) from a bag.

    Args:
        path: folder of a bag, or its file.
        mapping: topics.
        robot: that walked.
        seconds: longest length after the start.
        tick: period, if the mapping has none [s].

    Raises:
        InputError: one line: the package is missing, or the bag cannot be read; a topic, a field or
            a joint is not there; or the time goes back, or has a gap.
    """
    require_package("rosbags", "bags", f"{path}, a bag,")
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import Stores, get_typestore

    try:
        store = get_typestore(Stores.LATEST)
        with AnyReader([path], default_typestore=store) as reader:
            return _entries(_Bag(path, reader), mapping, robot, (seconds, mapping.period or tick))
    except (AnyReaderError, OSError) as error:
        raise InputError(f"{path}: not a bag: {one_line(error)}") from None


def _entries(
    bag: _Bag, mapping: BagMapping, robot: Robot, length: tuple[float, float]
) -> dict[str, np.ndarray]:
    """Return the entries of an open bag; `length`: seconds and period."""
    seconds, period = length
    joints, torque = _joints(bag, mapping, robot)
    trunk = _trunk(bag, mapping)
    begin = max(joints.time[0], trunk.time[0]) + mapping.start
    end = min(joints.time[-1], trunk.time[-1])
    count = min(round(seconds / period), int((end - begin) / period + 1e-6))
    if count < 1:
        raise InputError(f"{bag.path}: ends {begin - end:.3g} s before start = {mapping.start:g} s")
    times = begin + period * np.arange(count + 1)
    for series in (joints, trunk):
        inside = (series.time[1:] > begin) & (series.time[:-1] < times[-1])
        if (gap := np.max(np.diff(series.time), where=inside, initial=0.0)) > LONGEST_GAP:
            raise InputError(f"{bag.path}: {series.topic} has no message for {gap:.3g} s")
    states = _states(robot, mapping, trunk.at(times))
    found = {f"initial.{name}": x[0] for name, x in states.items()}
    found |= {f"state.{name}": x[1:] for name, x in states.items()}
    found |= {"period": np.array(period), "joints": joints.at(times[1:])}
    if torque is not None:
        found["torque"] = torque.at(times[1:])
    for name in _HELD:
        if sources := getattr(mapping, name.replace(".", "_")):
            found[name] = _held(bag, name, sources, robot, times[:-1])
    return found


def _joints(bag: _Bag, mapping: BagMapping, robot: Robot) -> tuple[_Series, _Series | None]:
    """Return positions and efforts of the joints, in the robot's order."""
    time, messages = bag.messages(mapping.joints)
    wanted = mapping.names or robot.description.joints
    if len(wanted) != len(robot.description.joints):
        number = len(robot.description.joints)
        raise InputError(f"names must be those of the {number} joints, got {len(wanted)}")
    order, known = [], list(getattr(messages[0], "name", ()))
    for name in wanted:
        if name not in known:
            raise InputError(f"{bag.path}: {mapping.joints}: {unknown('joint', name, known)}")
        order.append(known.index(name))
    if any(list(message.name) != known for message in messages):
        raise InputError(f"{bag.path}: {mapping.joints} has other joints in some messages")
    if any(len(message.position) != len(known) for message in messages):
        raise InputError(f"{bag.path}: {mapping.joints} has no position of some joints")
    position = np.array([message.position for message in messages])[:, order]
    efforts = [message.effort for message in messages]
    has_effort = all(len(x) == len(known) for x in efforts)
    torque = np.array(efforts)[:, order] if has_effort else None
    return (
        _Series(mapping.joints, time, position),
        None if torque is None else _Series(mapping.joints, time, torque),
    )


def _trunk(bag: _Bag, mapping: BagMapping) -> _Series:
    """Return roll, pitch, yaw; position; angular velocity; velocity, as they are in the bag."""
    time, messages = bag.messages(mapping.trunk)
    try:
        poses, twists = zip(*((x.pose.pose, x.twist.twist) for x in messages), strict=True)
    except AttributeError:
        text = f"{mapping.trunk} has no pose.pose and twist.twist, as nav_msgs/Odometry has"
        raise InputError(f"{bag.path}: {text}") from None
    turns = np.array([[q.w, q.x, q.y, q.z] for q in (x.orientation for x in poses)])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    euler = np.array(jax.vmap(lambda q: euler_from_rotation(rotation_from_quaternion(q)))(turns))
    euler[:, 2] = np.unwrap(euler[:, 2])
    vectors = [x.position for x in poses], [x.angular for x in twists], [x.linear for x in twists]
    parts = [np.array([_numbers(x) for x in rows]) for rows in vectors]
    return _Series(mapping.trunk, time, np.concatenate([euler, *parts], axis=1))


def _states(
    robot: Robot, mapping: BagMapping, rows: Float[np.ndarray, "n 12"]
) -> dict[str, np.ndarray]:
    """Return the states of the centre of mass from those of the trunk's origin, world frame."""
    euler, position, rate, velocity = np.split(rows, 4, axis=1)
    R = np.asarray(jax.vmap(rotation_from_euler)(euler))
    if mapping.twist == "trunk":
        rate, velocity = (np.einsum("nij,nj->ni", R, x) for x in (rate, velocity))
    offset = R @ np.asarray(robot.com_offset)
    moved = velocity + np.cross(rate, offset)
    return {
        "euler": euler,
        "position": position + offset,
        "ang_velocity": rate,
        "velocity": moved,
    }


def _held(
    bag: _Bag, name: str, sources: tuple[str, ...], robot: Robot, times: np.ndarray
) -> np.ndarray:
    """Return what was commanded or planned last, of all legs."""
    legs = len(robot.foot_point)
    each = () if name == "residual" else (legs,) if name == "contact" else (legs, 3)
    fields = [bag.field(source) for source in sources]
    for field in fields:
        if field.time[0] > times[-1] or field.time[-1] < times[0]:
            text = "has no message during the walk: is its clock another?"
            raise InputError(f"{bag.path}: {field.topic} {text}")
    rows = np.concatenate([field.last(times) for field in fields], axis=1)
    if rows.shape[1] != (count := int(np.prod(each))):
        text = f"{name.replace('.', '_')} has {rows.shape[1]} numbers, expected {count}"
        raise InputError(f"{bag.path}: {text}")
    return rows.reshape(len(times), *each)
