"""What is told of a walk that goes wrong: why it fell, and what no weights fix."""

import json
import re
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import ROBOT
from pretend import call, instead, pretend_score, pretend_walk

from hector_jax import Job, WalkConfig, hfs, named_command, nominal, walk
from hector_jax.cli import tune
from hector_jax.cli.flags import Tune
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights_file import save_weights
from hector_jax.core.inputs import InputError
from hector_jax.sim import diagnosis
from hector_jax.sim.diagnosis import Fall, Record, fall_of, likeliest_cause, not_the_weights
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging
from hector_jax.verdict.judging import ScoredWalk

CONFIG = WalkConfig()
JOB = Job(nominal(), named_command("straight"), hfs(), 1.0)
STANDING = float(ROBOT.standing_height)


def fallen_at_once():
    walked = pretend_walk(seconds=1.0)
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


UNSOLVED = fallen_at_once()._replace(residual=np.full(100, np.inf))


@pytest.mark.parametrize(
    ("record", "cause"),
    [
        (recorded(height=np.nan), "the physics diverges"),
        (recorded(-0.2, walked=UNSOLVED), "a QP of the MPC is not solved"),
        (recorded(-0.2, knee=1.0), "the torque of left_knee is at its limit of 67 N m for 100 %"),
        (recorded(-0.2, sole=(0.0, 0.3)), "the right foot stands on an edge of its sole"),
        (recorded(-0.2, friction=(0.0, 0.99)), "the right foot slips, at the limit of the floor's"),
        (recorded(0.06, (0.0, 0.9), legs=0.9), "the legs touch each other for 78 % of the 0.45 s"),
        # a foot in the air
        (recorded(0.06, (0.0, 0.9), friction=(0.99, 0.0), sole=(0.3, 0.0)), "it tips over"),
        (recorded(-0.2), "the centre of mass sinks steadily, by 9 cm while still upright"),
        (recorded(0.2, (0.0, 0.3)), "the centre of mass rises steadily, by 20 cm"),
        (recorded(0.06, (0.0, 0.9)), "it tips over forwards"),
        (recorded(0.0, (0.0, 0.9), np.linspace(0.0, 0.9, 1000) > 0.5), "it tips over"),
        (recorded(0.0, (0.9, 0.1)), "it tips over to the right"),
        (recorded(0.0, (0.0, 0.3), touching="left_shin"), "left_shin touches the floor"),
    ],
)
def test_the_likeliest_cause_follows_from_what_came_before_the_fall(record, cause):
    assert likeliest_cause(ROBOT, record).startswith(cause)


def test_a_fall_in_the_start_up_or_later_is_that_of_the_walk_with_the_cause_of_its_plant():
    heavy = JOB._replace(imperfections=hfs()._replace(mass=np.array(6.0)), seconds=0.05)
    walked, fall = walk(CONFIG, ROBOT, heavy), fall_of(CONFIG, ROBOT, heavy)
    assert walked.fallen.all()
    assert -1.1 < fall.time < -0.5
    assert fall.height == pytest.approx(float(walked.initial.position[2]), abs=5e-3)
    assert fall.height < ROBOT.description.min_height
    assert "sinks steadily" in fall.cause
    assert fall_of(CONFIG, ROBOT, JOB._replace(seconds=0.05)) is None
    icy = hfs()._replace(floor_friction=np.array(0.22))
    job = JOB._replace(command=named_command("s"), imperfections=icy, seconds=2.0)
    fall = fall_of(CONFIG, ROBOT, job)
    assert fall.time > 0.0
    assert fall.time == pytest.approx(0.001 * np.sum(~walk(CONFIG, ROBOT, job).fallen))
    assert "foot slips" in fall.cause
    assert str(fall).startswith(f"fell after {fall.time:.2f} s: ")


def test_a_height_that_is_off_and_motors_at_their_limits_are_told(monkeypatch):
    def lines(height, **shares):
        walked = pretend_walk(error=0.0, seconds=2.0)
        walked.state.position[:, 2] = walked.reference.position[:, 2] + height
        record = recorded(fallen=False, walked=walked)
        record.torque[:100, 2], record.torque[:30, 5] = shares.get("at_limit", 0.0), 1.0
        record = record._replace(time=record.time + 2.0)
        instead(monkeypatch, diagnosis, "record_walk", lambda *args: record)
        return not_the_weights(CONFIG, ROBOT, JOB)

    assert lines(0.015) == []
    height, torque = lines(-0.04, at_limit=-0.99)
    assert height.startswith("the centre of mass is 4.0 cm below its reference all along")
    text = "the torque of left_hip_pitch is at its limit of 33.5 N m for 10 % of the time"
    assert torque.startswith(f"{text} (try a slower trajectory")


@pytest.fixture
def weak(tmp_path, monkeypatch):
    """A file of weights that are too shy of forces to stand."""
    monkeypatch.chdir(tmp_path)
    shy = nominal()._replace(R=jax.tree.map(np.ones_like, nominal().R))  # the most of a tuning
    save_weights(tmp_path / "weak.json", shy)
    return tmp_path


@pytest.mark.slow
def test_a_start_that_falls_is_refused_before_anything_is_collected(monkeypatch, weak, capsys):
    flags = ["--start", "weak.json", "--seeds", "1", "--no-video", "--processes", "1"]
    assert call(monkeypatch, "tune", "--traj", "straight", *flags) == 2
    line = "--start weak.json cannot be tuned from: straight on the high-fidelity simulator fell at"
    assert line in capsys.readouterr().err
    assert not list(weak.glob("data/**/*.npz"))


def test_a_start_out_of_the_box_of_a_tuning_is_refused_before_it_walks(monkeypatch, weak, capsys):
    high = nominal()
    high.Q.position[1] = 1e5
    save_weights(weak / "high.json", high)
    for command in (("tune", "--traj", "straight"), ("propose", "runs", "--traj", "straight")):
        assert call(monkeypatch, *command, "--start", "high.json") == 2
        told = capsys.readouterr().err
        line = "--start high.json: Q_y is 100000; a tuning starts from weights of 0.01 to 10000"
        assert line in told
        assert "walking" not in told
        assert not (weak / "runs").exists()


def test_a_start_that_falls_late_is_told_and_tuned_from(monkeypatch, tmp_path, capsys):
    """A start that falls in the first half of each walk is refused."""
    uprights = {"straight": 4.0, "s": 3.7}
    trajectories = tuple(NamedCommand(name, named_command(name)) for name in uprights)

    def score_jobs(setup, jobs, **options):
        ((case, _),) = jobs.items()
        upright = uprights[case[0]]
        return {case: (ScoredWalk(pretend_score(1e6, upright < 4.0), upright, ""), None)}

    def submit(function, *inputs):
        return SimpleNamespace(result=lambda: Fall(3.7, 0.3, 0.8, "it slips"))

    instead(monkeypatch, judging, "score_jobs", score_jobs)
    setup = Setup(SimpleNamespace(submit=submit), TuneConfig(), ROBOT)
    run = tune._Run(setup, tmp_path, Tune(), nominal(), trajectories)
    tune._check_start(run)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("--start nominal falls late and is tuned from nevertheless: s on the")
    assert "fell after 3.70 s" in line
    uprights |= {"straight": 1.9, "s": 0.4}
    with pytest.raises(InputError, match="nominal cannot be tuned from: straight on the high"):
        tune._check_start(run)


def test_hector_walk_tells_the_fall_and_prints_no_nan(monkeypatch, weak, capsys):
    words = ["walk", "--weights", "weak.json", "--seconds", "0.1"]
    assert call(monkeypatch, *words) == 0
    out = capsys.readouterr().out
    said = r": fell at -\d.\d+ s, in the start-up: centre of mass .*likeliest cause: "
    assert re.search(said, out)
    assert "nan" not in out
    assert call(monkeypatch, *words, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["fell"]
    assert told["seconds"] == told["fall"]["time"] < 0.0
    assert told["rms_position"] == [None] * 3
