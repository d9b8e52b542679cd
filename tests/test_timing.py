"""What the stamps of a log show: planted faults of timing, sound logs, logs without commands."""

import re

import numpy as np
import pytest
from model import ROBOT
from test_log_check import TICK, entries_of, found

from hector_jax.cli.main import main
from hector_jax.control.controller import walk_config
from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.own.log_check import read_check, unasked
from hector_jax.own.timing import timing_faults
from hector_jax.own.walk_file import read_walk
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs

SECONDS = 4.0


@pytest.fixture(scope="module")
def walked():
    job = Job(nominal(ROBOT), named_command("c"), hfs(ROBOT.description), SECONDS)
    return entries_of(ROBOT, job)


def every(log, stride):
    """The log with one of `stride` samples."""
    rows = {n: x[stride - 1 :: stride] for n, x in log.items() if np.ndim(x) and len(x) == 4000}
    return log | rows | {"period": np.array(0.001 * stride)}


def ordinary(rng, count, period, *, jitter=5e-5):
    """Stamps of a loaded computer: jitter, late ones that are made up for, a clock 5e-5 off."""
    time = period * np.arange(1, count + 1) * (1.0 + 5e-5 * rng.standard_normal())
    time = time + np.abs(jitter * rng.standard_normal(count))
    for row in rng.integers(0, count, max(count // 200, 1)):
        late = slice(row, row + round(0.004 / period) + 1)
        time[late] = np.maximum(time[late], time[row] + rng.uniform(0.0, 0.004))
    return np.maximum.accumulate(time + 1e-9 * np.arange(count))


def plans_of(rng, count=400, period=0.01):
    """Stamps of plans: 3 ms, now and then late or left out; of the same clock."""
    began = period * np.arange(count) + np.abs(1e-4 * rng.standard_normal(count))
    took = rng.gamma(9.0, 3e-3 / 9.0, count)
    took[rng.integers(0, count, 3)] = 0.013
    rows = np.delete(np.arange(count), rng.integers(1, count - 1, 2))
    return {"plan.time": began[rows], "plan.ready": (began + took)[rows]}


@pytest.fixture(scope="module")
def stamped(walked):
    rng = np.random.default_rng(0)
    return walked | {"time": ordinary(rng, 4000, 0.001)} | plans_of(rng)


def checked(folder, log):
    np.savez(folder / "log.npz", **log)
    inputs = folder / "log.npz", ROBOT, named_command("c"), SECONDS, TICK
    return read_check(*inputs)[0]


# Each takes the entries of a log and a generator, and returns the entries that it changes.


def jitter(log, rng):
    return {"time": np.sort(log["time"] + rng.uniform(-0.005, 0.005, 4000))}


def missing(log, rng):
    rows = np.delete(np.arange(4000), np.r_[900:930, 1500:1512, 2000:2001])
    return {n: x[rows] for n, x in log.items() if np.ndim(x) and len(x) == 4000}


def held_up(log, rng):
    """The logger stops once for 60 ms, and numbers its samples as if it had not."""
    return {"time": log["time"] + 0.06 * (np.arange(4000) > 1700)}


def repeated(log, rng):
    rows = np.arange(4000)
    rows[1::20] -= 1
    return {"time": log["time"][rows]}


def set_back(log, rng):
    """The computer's clock is set, by 30 ms."""
    return {"time": log["time"] - 0.03 * (np.arange(4000) > 1700)}


def faster(factor, *names):
    names = names or ("time", "plan.time", "plan.ready")
    return lambda log, rng: {name: factor * log[name] for name in names}


def slower_there(log, rng):
    """The simulator takes twice as long for half a second."""
    extra = np.cumsum(0.001 * ((np.arange(4000) > 1500) & (np.arange(4000) < 2000)))
    return {"time": log["time"] + extra}


def other_period(log, rng):
    """Each second sample, with the period of all."""
    rows = {n: x[1::2] for n, x in log.items() if np.ndim(x) and len(x) == 4000}
    return rows | {"effect.force": log["command.force"][1::2]}


def seldom(log, rng):
    return {name: log[name][::2] for name in ("plan.time", "plan.ready")}


def left_out(log, rng):
    rows = np.delete(np.arange(len(log["plan.time"])), np.s_[5::12])
    return {name: log[name][rows] for name in ("plan.time", "plan.ready")}


def late(log, rng):
    took = 0.014 * (rng.uniform(size=len(log["plan.time"])) < 0.1)
    return {"plan.ready": log["plan.ready"] + took}


FAULTS = {
    r"^\d\d % of the stamps of time jitter, \d\.\d ms off an even clock$": jitter,
    "^4[123] ms of samples are missing, by time, the longest of 3[01] ms$": missing,
    "^60 ms of samples are missing, by time, the longest of 60 ms$": held_up,
    "^5 % of the stamps of time are that of the sample before$": repeated,
    "^1 stamp of time is before that of the sample before$": set_back,
    "^time advances 2.00 s in a second of the walk: the real-time factor .* 0.50$": faster(2.0),
    "^time advances 0.77 s in a second of the walk: the real-time factor .* 1.30$": faster(1 / 1.3),
    "^in .* % of the samples time runs faster than else: the simulator is slower": slower_there,
    "^the clock of time gains 5.. ms in a second of the samples$": faster(1.005),
    "^the clock of time loses [67].. ms in a second of the samples$": faster(0.993),
    "^the samples are 2 ms apart by time and velocity, period says 1 ms$": other_period,
    "^time is in ns: expected is s$": faster(1e9, "time"),
    "^a plan begins every 20 ms, expected are 10 ms$": seldom,
    "^after (9|10) % of the plans the next one is left out, by plan.time$": left_out,
    r"^1\d % of the plans are late: .* ready [67].. ms after the 10 ms that it has$": late,
    "^stamps of plan.ready are before those of plan.time$": faster(0.99, "plan.ready"),
    "^plan.time is of another clock than time, (999|1e.03) s away$": lambda log, rng: {
        name: log[name] + 1000.0 for name in ("plan.time", "plan.ready")
    },
}
"""A fault of timing by what must be told of it."""


@pytest.mark.parametrize("told", FAULTS)
def test_a_planted_fault_of_timing_is_named(tmp_path, stamped, told):
    log = checked(tmp_path, stamped | FAULTS[told](stamped, np.random.default_rng(1)))
    (line,) = timing_faults(log.stamps, log.walk, TICK)
    assert re.search(told, line), line


def test_the_check_of_a_log_tells_its_timing_too(tmp_path, stamped):
    assert found(tmp_path, stamped, seconds=SECONDS) == []
    (line,) = found(tmp_path, stamped | held_up(stamped, None), seconds=SECONDS)
    assert line == "60 ms of samples are missing, by time, the longest of 60 ms"


@pytest.mark.parametrize("stride", [1, 2, 5, 10])
@pytest.mark.parametrize("kind", ["even", "jitter", "whole ms", "since 1970, in ns", "one lost"])
def test_sound_stamps_have_nothing_to_tell(tmp_path, walked, stride, kind):
    rng = np.random.default_rng(stride)
    log, period = every(walked, stride), 0.001 * stride
    if kind == "one lost" and stride < 10:
        rows = np.delete(np.arange(4000 // stride), [1700 // stride])
        log |= {n: x[rows] for n, x in log.items() if np.ndim(x) and len(x) == 4000 // stride}
    time = ordinary(rng, 4000 // stride, period, jitter=3e-4 if kind == "jitter" else 5e-5)
    if kind == "one lost" and stride < 10:
        time = time[rows]
    stamps = {"time": time, **plans_of(rng)}
    if kind == "even":
        stamps |= {"time": 7.0 + period * np.arange(4000 // stride)}
        stamps |= {name: 7.0 + stamps[name] for name in ("plan.time", "plan.ready")}
    if kind == "whole ms" and stride > 1:
        stamps = {name: np.round(x, 3) for name, x in stamps.items()}
    if kind.startswith("since"):
        stamps = {n: 1_700_000_000_000_000_000 + (1e9 * x).astype(int) for n, x in stamps.items()}
        stamps = {n: x / 1e9 for n, x in stamps.items()}
    sound = checked(tmp_path, log | stamps)
    assert [*timing_faults(sound.stamps, sound.walk, TICK)] == []


def test_wrong_stamps_are_one_line(tmp_path, stamped):
    for change, told in (
        ({"time": np.zeros(7)}, r"time must be 4000 finite numbers, got float64 of shape \(7,\)"),
        ({"time": np.full(4000, np.nan)}, "time must be 4000 finite numbers"),
        ({"plan.ready": np.zeros(3)}, r"plan.ready must be 398 finite numbers, got float64"),
        ({"plan.time": np.zeros((5, 1))}, "plan.time must be 5 finite numbers"),
    ):
        with pytest.raises(InputError, match=told):
            checked(tmp_path, stamped | change)


def without(log, *names):
    return {n: x for n, x in log.items() if not n.startswith(names)}


def swapped(log):
    joints = log["joints"].reshape(-1, 2, 5)[:, ::-1].reshape(-1, 10)
    return {"joints": joints}


def test_a_log_without_commands_is_judged_by_what_it_has(tmp_path, stamped):
    weak = stamped["torque"].copy()
    weak[::4, 3] = 1000.0
    for absent in (("command", "effect"), ("command",), ("command", "contact")):
        log = without(stamped, *absent)
        assert found(tmp_path, log, seconds=SECONDS) == []
        for change, told in (
            ({"torque": weak}, "the torque of left_knee is at its limit"),
            (swapped(log), "left and right legs are exchanged"),
            ({"joints": np.roll(log["joints"], 40, axis=0)}, "joints are 40 ms behind the state"),
            (faster(2.0)(log, None), "the real-time factor"),
        ):
            (line,) = found(tmp_path, log | change, seconds=SECONDS)
            assert told in line
    bare = without(stamped, "command", "effect", "contact")
    assert found(tmp_path, bare | swapped(bare), seconds=SECONDS) == []
    assert unasked(checked(tmp_path, bare)).endswith("contact is absent too, joints and feet")
    assert unasked(checked(tmp_path, without(stamped, "command"))).endswith("are not judged")
    assert unasked(checked(tmp_path, stamped)) == ""


def test_a_log_without_commands_cannot_be_planned_again(tmp_path, stamped, monkeypatch, capsys):
    path = tmp_path / "log.npz"
    np.savez(path, **without(stamped, "command"))
    with pytest.raises(InputError, match="command.force is missing"):
        read_walk(path, ROBOT, SECONDS, walk_config(ROBOT).gait.tick)
    for command, code, told in (
        ("check", 0, "without command.force gain and delay of the ground and plans are not"),
        ("twin", 2, "command.force is missing"),
    ):
        line = ["log", command, str(path), "--traj", "c", "--seconds", str(SECONDS)]
        monkeypatch.setattr("sys.argv", ["hector", *line])
        assert main() == code
        assert told in capsys.readouterr().err
    np.savez(path, **without(stamped, "command.moment"))
    with pytest.raises(InputError, match="command.moment is missing"):
        checked(tmp_path, without(stamped, "command.moment"))
