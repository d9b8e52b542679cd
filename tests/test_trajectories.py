"""Trajectories of one's own: what a file may say, and what is told of one that asks too much."""

import re

import numpy as np
import pytest
from model import EXAMPLES, ROBOT
from pretend import call, instead

from hector_jax import InputError, Job, TuneConfig, hfs, named_command, walk
from hector_jax.cli import arguments
from hector_jax.control import GaitConfig, WalkConfig, expert, nominal
from hector_jax.control.reference import COMMANDS, UNSEEN, Command, reference_at, standing_anchor
from hector_jax.control.trajectories import beyond, command_of, limits
from hector_jax.sim import walk as sim_walk

SLALOM = EXAMPLES / "slalom.toml"
LIMITS = limits(ROBOT, GaitConfig())


def test_the_limits_are_those_that_the_robot_was_seen_to_have():
    np.testing.assert_allclose(LIMITS, [1.55, 1.04, 1.20, 3.5], atol=0.01)
    slower = limits(ROBOT, GaitConfig(stance=40, swing=40))
    np.testing.assert_allclose(slower, np.array(LIMITS) / 2)
    on_points = limits(ROBOT._replace(toe=np.zeros(()), heel=np.zeros(())), GaitConfig())
    assert on_points == LIMITS._replace(back=LIMITS.ahead)


@pytest.mark.parametrize("name", [*COMMANDS, *UNSEEN])
def test_built_in_trajectories_are_within_the_limits(name):
    assert beyond(LIMITS, named_command(name)) is None


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ([(2.0, 0.0, 0.0)], "segment 1: v_x is 2 m/s; .* walk -1 to 1.6 m/s"),
        ([(0.5, 0.0, 0.0), (0.0, -1.5, 0.0)], "segment 2: v_y is -1.5 m/s"),
        ([(0.0, 0.0, 5.0)], "segment 1: yaw_rate is 5 rad/s"),
        ([(1.2, 0.0, 0.0), (-0.8, 0.0, 0.0)], "segment 2: the change of v_x is -2 m/s"),
    ],
)
def test_what_is_beyond_the_limits_is_told_by_segment_value_and_range(rows, told):
    rows = np.array(rows)
    command = Command(np.ones(len(rows)), rows[:, :2], rows[:, 2])
    said = beyond(LIMITS, command)
    assert said is not None
    assert re.search(told, said)


def test_a_walk_is_as_long_as_its_file_says_and_limits_are_told(monkeypatch, capsys, tmp_path):
    walks = []

    def pretend(config, robot, job, **others):
        walks.append(job.seconds)
        raise InputError("walked")

    def told(trajectory):
        call(monkeypatch, "walk", "--traj", trajectory)
        out, err = capsys.readouterr()
        assert out == ""
        return err

    instead(monkeypatch, sim_walk, "walk", pretend)
    assert "warning" not in told(SLALOM) + told("eight")
    fast = tmp_path / "mine.toml"
    fast.write_text('name = "mine"\n[[segment]]\nseconds = 1.0\nv_x = 2.0')
    assert f"warning: {fast}: segment 1: v_x is 2 m/s" in told(fast)
    assert walks == [6.0, 4.0, 1.0]


def test_the_example_is_a_command_of_six_seconds_that_ends_as_it_began_and_rollouts_are_as_long():
    found = command_of(str(SLALOM))
    assert (found.name, found.seconds) == ("slalom", 6.0)
    np.testing.assert_array_equal(found.command.velocity[-1], [0.2, 0.1])
    end = reference_at(0.01, found.command, standing_anchor(ROBOT), 600.0)
    assert end.euler[2] == pytest.approx(0.0, abs=1e-9)
    config = TuneConfig()
    assert arguments.with_length(config, found.seconds).rollout.ticks == 600
    assert arguments.with_length(config, command_of("c").seconds) == config


@pytest.mark.slow
def test_the_example_is_walked_on_the_simulator_within_centimetres():
    found = command_of(str(SLALOM))
    for weights in (nominal(), expert()):
        job = Job(weights, found.command, hfs(), found.seconds)
        walked = walk(WalkConfig(), ROBOT, job)
        assert not walked.fallen.any()
        error = walked.state.position - walked.reference.position
        assert np.abs(error).max() < 0.10
