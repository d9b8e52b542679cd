"""What is told of a walk that goes wrong: why it fell, and what no weights mend."""

import json
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from pretend import instead, pretend_walk

from hector_jax.cli import arguments, evaluate
from hector_jax.cli import tune as tuning
from hector_jax.cli.main import main
from hector_jax.control.controller import WalkConfig
from hector_jax.control.reference import named_command
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import load_robot
from hector_jax.sim import diagnosis
from hector_jax.sim.diagnosis import Fall, Record, likeliest_cause, not_the_weights
from hector_jax.sim.loop import Job
from hector_jax.sim.mujoco_plant import MujocoPlant
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.store import tunings
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.verdict import judging, metrics

ROBOT, STRAIGHT = load_robot(), named_command("straight")
JOB = Job(nominal(), STRAIGHT, hfs(), 1.0)
STANDING = float(ROBOT.standing_height)
FALL = Fall(-0.42, 0.21, 0.93, "it tips over forwards (standing pose, joint gains, gait)")
TEXT = (
    "fell at -0.42 s, in the start-up: centre of mass 0.21 m high, tilt 0.93 rad; likeliest cause: "
    "it tips over forwards (standing pose, joint gains, gait)"
)


def fallen_at_once(seed=0, seconds=1.0):
    walked = pretend_walk(seed, seconds=seconds)
    return walked._replace(fallen=np.ones_like(walked.fallen))


def recorded(
    height=0.0, angles=(0.0, 0.0), knee=0.0, *, fallen=True, touching="", walked=None, **feet
):
    """A second that ends with these, and began standing; torque and feet are so all along."""
    rise = np.linspace(0.0, 1.0, 1000)
    torque = np.zeros((1000, 10))
    torque[:, 3] = knee
    feet = {"load": (0.0, 1.0), "friction": (0.0, 0.5), "sole": (0.0, 0.0)} | feet
    rows = {name: np.tile(value, (1000, 1)) for name, value in feet.items() if name != "legs"}
    return Record(
        time=0.001 * (1 + np.arange(1000)) - 1.0,
        height=STANDING + height * rise,
        angles=np.outer(rise, angles),
        torque=torque,
        **rows,
        legs_touch=rise >= 1.0 - feet.get("legs", 0.0),
        touching=touching,
        fallen=fallen,
        trajectory=fallen_at_once() if walked is None else walked,
    )


def unsolved():
    walked = fallen_at_once()
    return walked._replace(residual=np.full_like(walked.residual, np.inf))


@pytest.mark.parametrize(
    ("record", "cause"),
    [
        (recorded(height=np.nan), "the physics diverges"),
        (recorded(-0.2, walked=unsolved()), "a QP of the MPC is not solved"),
        (recorded(-0.2, knee=1.0), "the torque of left_knee is at its limit of 67 N m for 100 %"),
        (recorded(-0.2, sole=(0.0, 0.3)), "the right foot stands on an edge of its sole"),
        (recorded(-0.2, friction=(0.0, 0.99)), "the right foot slips, at the limit of the floor's"),
        (recorded(0.06, (0.0, 0.9), legs=0.9), "the legs touch each other for 78 % of the 0.45 s"),
        # a foot in the air
        (recorded(0.06, (0.0, 0.9), friction=(0.99, 0.0), sole=(0.3, 0.0)), "it tips over"),
        (recorded(-0.2), "the centre of mass sinks steadily, by 9 cm while still upright"),
        (recorded(0.2, (0.0, 0.3)), "the centre of mass rises steadily, by 20 cm"),
        (recorded(0.06, (0.0, 0.9)), "it tips over forwards"),
        (recorded(0.0, (0.9, 0.1)), "it tips over to the right"),
        (recorded(0.0, (0.0, 0.3), touching="left_shin"), "left_shin touches the floor"),
    ],
)
def test_the_likeliest_cause_follows_from_what_came_before_the_fall(record, cause):
    assert likeliest_cause(ROBOT, record).startswith(cause)


def test_a_fall_in_the_start_up_is_that_of_the_walk():
    heavy = JOB._replace(imperfections=hfs()._replace(mass=np.array(6.0)), seconds=0.05)
    config, rows = WalkConfig(), []
    walked = walk(
        config,
        ROBOT,
        heavy,
        build=partial(MujocoPlant, on_step=lambda world, data: rows.append(data.qpos[2])),
    )
    assert walked.fallen.all()
    fall = diagnosis.fall_of(config, ROBOT, heavy)
    assert fall is not None
    assert -1.1 < fall.time < -0.5
    # the walk goes on to the end of the ten ticks in which it falls
    assert 0.0 <= len(rows) - 1000 * (fall.time + 1.1) < 100
    assert fall.height == pytest.approx(float(walked.initial.position[2]), abs=5e-3)
    assert fall.height < ROBOT.description.min_height
    assert "sinks steadily" in fall.cause
    assert diagnosis.fall_of(config, ROBOT, JOB._replace(seconds=0.05)) is None


def test_a_fall_of_a_walk_has_the_cause_of_its_plant():
    icy, config = hfs()._replace(floor_friction=np.array(0.22)), WalkConfig()
    job = JOB._replace(command=named_command("s"), imperfections=icy, seconds=2.0)
    walked = walk(config, ROBOT, job)
    fall = diagnosis.fall_of(config, ROBOT, job)
    assert fall is not None
    assert fall.time > 0.0
    assert fall.time == pytest.approx(0.001 * np.sum(~walked.fallen))
    assert "foot slips" in fall.cause
    assert str(fall).startswith(f"fell after {fall.time:.2f} s: ")


# What no weights mend


def settled(height):
    """Two seconds upright, this far above the reference [m]."""
    walked = pretend_walk(error=0.0, seconds=2.0)
    position = walked.reference.position + [0.0, 0.0, height]
    return walked._replace(state=walked.state._replace(position=position))


def lines(monkeypatch, record):
    monkeypatch.setattr(
        diagnosis, "record_walk", lambda *args: record._replace(time=record.time + 2.0)
    )
    return not_the_weights(WalkConfig(), ROBOT, JOB)


def test_a_sound_walk_has_nothing_to_be_told(monkeypatch):
    assert lines(monkeypatch, recorded(fallen=False, walked=settled(0.015))) == []


def test_a_height_that_is_off_and_motors_at_their_limits_are_told(monkeypatch):
    record = recorded(fallen=False, walked=settled(-0.04))
    record.torque[:100, 2], record.torque[:30, 5] = -0.99, 1.0
    height, torque = lines(monkeypatch, record)
    assert height.startswith("the centre of mass is 4.0 cm below its reference all along")
    text = "the torque of left_hip_pitch is at its limit of 33.5 N m for 10 % of the time"
    assert torque.startswith(f"{text} (try a slower trajectory")


def test_a_start_that_falls_is_refused_before_anything_is_collected(monkeypatch, tmp_path):
    made = []

    def walks_of(setup, jobs, title, engine):
        made.extend(jobs)
        yield from (pretend_walk(fall_at=0.5 if job.command is S else None) for job in jobs)

    instead(monkeypatch, judging, "walk_jobs", walks_of)
    instead(monkeypatch, tuning, "fall_of", lambda *args: FALL)
    both = [NamedCommand(name, named_command(name)) for name in ("straight", "s")]
    S = both[1].command
    with ThreadPoolExecutor(1) as pool:
        setup = Setup(pool, TuneConfig(), ROBOT)
        line = re.escape(
            f"--start nominal cannot be tuned from: s on the high-fidelity simulator {TEXT}"
        )
        with pytest.raises(InputError, match=line):
            tuning._check_start(setup, "nominal", nominal(), both, tmp_path)
        assert len(made) == 2
        # a run walks its sets there later, and reads the walk of the start
        inputs = setup, {"nominal": nominal()}, both[0].command, [hfs()], [0]
        judging.judge(*inputs, title="", folder=tmp_path)
    assert len(made) == 2


# How a fall in the start-up is told


def test_hector_walk_tells_the_fall_and_prints_no_nan(monkeypatch, capsys):
    instead(monkeypatch, arguments, "walk_once", lambda *args, **kwargs: fallen_at_once())
    instead(monkeypatch, evaluate, "fall_of", lambda *args: FALL)
    monkeypatch.setattr(sys, "argv", ["hector", "walk"])
    assert main() == 0
    out = capsys.readouterr().out
    assert out.startswith(f"straight in hfs, nominal weights: {TEXT}; L ")
    assert "nan" not in out
    monkeypatch.setattr(sys, "argv", ["hector", "walk", "--json"])
    assert main() == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["seconds"], told["fell"]) == (-0.42, True)
    assert told["fall"] == FALL._asdict()
    assert told["rms_position"] == [None] * 3


def test_torques_of_a_robot_that_is_half_over_are_nobodys_fault():
    record = recorded(0.0, (0.0, 0.9))
    record.torque[record.tilt > 0.5] = 1.0
    assert "tips over" in likeliest_cause(ROBOT, record)


def test_a_start_that_falls_on_the_model_is_refused_before_anything_is_collected(monkeypatch):
    zero = np.zeros(())
    fell = Evaluation(zero, {}, nominal(), fallen=np.ones(()), residual=zero)
    monkeypatch.setattr(tunings.difftune, "tune_step", lambda *args, **model: fell)
    problem = tunings.Problem((named_command("straight"),), None)
    with pytest.raises(InputError, match="the robot fell .try a slower or shorter trajectory"):
        tunings._prepare_tuning(TuneConfig(), ROBOT, nominal(), problem)


def test_a_tuned_set_that_walks_worse_than_nominal_is_told(capsys):
    def scored(L):
        score = metrics.score_like()
        score = score._replace(losses=score.losses | {"L": np.array(L)})
        last = pretend_walk().initial
        return [judging.ScoredWalk(score, np.array(4.0), last, "", "")]

    walks = {"nominal": scored(2e6), "without": scored(3e6), "with": scored(1e6)}
    tuning._say_worse("straight", judging.ScoredWalks(walks, {}))
    said = capsys.readouterr().err
    assert "straight: on the high-fidelity simulator `without` walks with L 3e6, nominal" in said
    assert "`with`" not in said
