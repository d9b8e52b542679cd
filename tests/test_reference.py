"""Commands, the clocks of gaits, and where the feet come down: by hand and by symmetry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ROBOT

from hector_jax.control import GaitConfig, gait, named_command, reference_at
from hector_jax.control.footstep import FootstepConfig, touchdown_points
from hector_jax.control.reference import COMMANDS, PIECES, UNSEEN, Anchor, Command, with_pieces
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import State

ANCHOR = Anchor(jnp.array([0.3, -0.2, 0.42]), jnp.array(0.7), jnp.array(10))


def path(command, times, anchor=ANCHOR):
    ticks = jnp.asarray(times) / 0.01 + anchor.tick
    return jax.vmap(lambda t: reference_at(0.01, command, anchor, t))(ticks)


def test_before_the_start_it_stands_at_the_anchor():
    state = path(named_command("s"), [-1.0, -0.01])
    np.testing.assert_allclose(state.position, jnp.stack([ANCHOR.position] * 2))
    assert not np.asarray(state.velocity).any()


TURNS = Command(np.full(2, 2.0), np.array([[0.5, 0.0], [0.2, 0.0]]), np.full(2, np.pi / 2))


@pytest.mark.parametrize(
    "command",
    [*map(named_command, COMMANDS + UNSEEN), TURNS, TURNS._replace(yaw_rate=np.full(2, np.pi))],
    ids=[*COMMANDS, *UNSEEN, "a turn a lap", "two turns a lap"],
)
def test_the_path_is_the_integral_of_its_velocity(command):
    times = np.arange(0, 13.0, 1e-3)
    state, middle = path(command, times), path(command, times[:-1] + 5e-4)
    moved, turned = np.diff(state.position, axis=0), np.diff(state.euler[:, 2])
    np.testing.assert_allclose(moved, 1e-3 * middle.velocity, atol=2e-8)
    np.testing.assert_allclose(turned, 1e-3 * middle.ang_velocity[:, 2], atol=1e-12)


# seconds, then where the command has led: ahead, to the left, and turned; in c half a circle, whose
# ends are a diameter apart, in eight two circles through one point
LEADS = [("straight", 4.0, 2.0, 0.0, 0.0), ("c", 4.0, 0.0, 2.0 / np.pi, np.pi)]
LEADS += [("s", 2.0, 0.0, 2.0 / np.pi, np.pi), ("s", 4.0, 0.0, 4.0 / np.pi, 0.0)]
LEADS += [("sideways", 4.0, 0.0, 0.8, 0.0), ("turn", 4.0, 0.0, 0.0, np.pi)]
LEADS += [("eight", 2.0, 0.0, 1.2 / np.pi, np.pi), ("eight", 4.0, 0.0, 0.0, 2.0 * np.pi)]
LEADS += [("eight", 8.0, 0.0, 0.0, 0.0)]
LEADS += [("stop-and-go", 1.0, 0.5, 0.0, 0.0), ("stop-and-go", 4.0, 1.0, 0.0, 0.0)]


@pytest.mark.parametrize(("name", "seconds", "ahead", "left", "turned"), LEADS)
def test_commands_lead_where_their_names_say(name, seconds, ahead, left, turned):
    level = Anchor(jnp.array([0.0, 0.0, 0.42]), jnp.array(0.0), jnp.array(0))
    state = path(named_command(name), [seconds], level)
    np.testing.assert_allclose(state.position[0], [ahead, left, 0.42], atol=1e-12)
    np.testing.assert_allclose(state.euler[0, 2], turned, atol=1e-12)


def test_pieces_without_duration_change_nothing():
    three = Command(np.array([0.7, 1.1, 0.4]), 0.1 * np.ones((3, 2)), np.arange(3.0))
    for command in (named_command("s"), three):
        padded = with_pieces(command)
        assert len(padded.duration) == len(with_pieces(padded).duration) == PIECES
        one, other = (path(c, np.arange(0, 13.0, 0.07)) for c in (command, padded))
        jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("config", [GaitConfig(), GaitConfig(stance=22, swing=18)])
def test_every_clock_of_a_gait_is_that_of_when_its_feet_stand(config):
    """Both until tick -80, then in turn and half a cycle apart."""
    ticks = np.arange(-110, 140)
    clock = ticks[:, None] + [0, 20]
    stands = (clock % 40 < config.stance) | (ticks < -80)[:, None]
    lands = np.zeros_like(stands)
    lands[1:] = stands[1:] & ~stands[:-1]
    np.testing.assert_array_equal(gait.contact(config, jnp.asarray(ticks)), stands)
    assert stands[100:140].all(axis=1).sum() == 2 * (config.stance - 20)  # both, in a cycle

    swung, since = np.zeros(2, int), 0
    for i in range(1, 170):  # up to tick 60; later landings are still to be seen
        tick = jnp.asarray(ticks[i])
        swung = np.where(stands[i] | stands[i - 1], 0, swung + 1)
        assert gait.swing_ticks(config, tick).tolist() == swung.tolist()
        wait = lands[i + 1 :].argmax(axis=0) + 1
        assert gait.ticks_to_touchdown(config, tick).tolist() == wait.tolist()
        since = 0 if (stands[i] != stands[i - 1]).any() else since + 1
        if ticks[i] >= 0:
            assert gait.since_switch(config, tick) == pytest.approx(0.01 * since)
    later = jnp.asarray(ticks[115:])
    count = gait.touchdowns(config, jnp.asarray(ticks[115]), later)
    np.testing.assert_array_equal(count, lands[115:].cumsum(axis=0) - lands[115])


RAIBERT, PAPER = FootstepConfig(), FootstepConfig(rule="paper")
STANCE = SWING = 0.2
WAIT = jnp.array([0.3, 0.1])  # the left foot stands for another 0.1 s and then swings
touchdown = jax.jit(touchdown_points, static_argnames=("config", "stance", "swing"))


def state(position=(0.0, 0.0, 0.5), velocity=(0.0, 0.0, 0.0), yaw=0.0, yaw_rate=0.0):
    rows = (0.0, 0.0, yaw), position, (0.0, 0.0, yaw_rate), velocity
    return State(*(jnp.array(row, float) for row in rows))


def feet(now, reference, config=RAIBERT, wait=WAIT):
    times = {"remaining": wait, "stance": STANCE, "swing": SWING}
    return touchdown(config, ROBOT, config.parameters, state=now, reference=reference, **times)


def test_the_papers_rule_is_half_a_swing_ahead_of_the_centre_of_mass():
    now = state((1.0, -2.0, 0.5), (0.4, 0.1, 0.3), yaw=0.6)
    points, yaw = feet(now, state(), PAPER)
    np.testing.assert_allclose(points, [[1.04, -1.99, 0.0]] * 2)
    np.testing.assert_allclose(yaw, 0.6)


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_a_robot_that_stands_still_puts_its_feet_under_its_hips(yaw):
    now = state((0.3, 0.2, 0.5), yaw=yaw)
    points, heading = feet(now, now)
    side = 0.08 * np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    np.testing.assert_allclose(points, np.array([0.3, 0.2, 0.0]) + [side, -side], atol=1e-12)
    np.testing.assert_allclose(heading, yaw)


def test_a_foot_lands_half_a_stance_ahead_further_if_too_fast_and_sways_one_swing_at_most():
    now = state(velocity=(0.5, 0.2, 0.0))
    points, _ = feet(now, now)
    ahead = 0.5 * (WAIT + STANCE / 2)
    np.testing.assert_allclose(points[:, 0], ahead)
    np.testing.assert_allclose(points[:, 1], 0.4 * ahead + np.array([0.08, -0.08]))
    wanted, more = state(velocity=(0.3, 0.2, 0.0)), FootstepConfig(feedback=0.2)
    further = feet(now, wanted, more)[0] - feet(now, wanted)[0]
    np.testing.assert_allclose(further, [[0.08 * 0.2, 0.0, 0.0]] * 2, atol=1e-12)
    swaying = state(velocity=(0.0, 0.3, 0.0))
    waits = (0.39, 0.21, 0.15, 0.05)
    left = [feet(swaying, state(), wait=jnp.array([wait, 0.1]))[0][0, 1] for wait in waits]
    assert left[0] == pytest.approx(left[1])
    assert left[2] - left[3] == pytest.approx(0.03)


def test_in_a_turn_feet_land_on_the_outside_and_point_to_the_heading_of_the_middle_of_stance():
    now = state(velocity=(0.5, 0.0, 0.0), yaw_rate=1.0)
    points, straight = feet(now, now)[0], feet(now, now, FootstepConfig(turn=0.0))[0]
    lean = 0.5 * 0.5 * 0.5 / ROBOT.gravity[2]
    np.testing.assert_allclose(points - straight, [[0.0, -lean, 0.0]] * 2, atol=1e-12)
    _, yaw = feet(state(yaw=0.2), state(yaw_rate=2.0))
    np.testing.assert_allclose(yaw, 0.2 + 2.0 * (np.asarray(WAIT) + STANCE / 2))


@pytest.mark.parametrize("config", [RAIBERT, PAPER])
def test_a_mirrored_robot_steps_to_the_mirrored_points_and_a_yawed_one_to_the_yawed(config):
    flip, turn, R = jnp.array([1.0, -1.0, 1.0]), jnp.array([-1.0, 1.0, -1.0]), rot_z(jnp.array(1.1))

    def mirrored(s):
        return State(s.euler * turn, s.position * flip, s.ang_velocity * turn, s.velocity * flip)

    def turned(s):
        return State(s.euler.at[2].add(1.1), R @ s.position, s.ang_velocity, R @ s.velocity)

    now = state((0.3, 0.1, 0.5), (0.4, 0.2, 0.1), yaw=0.4)
    wanted = state((0.2, 0.0, 0.5), (0.5, 0.1, 0.0), yaw=0.3, yaw_rate=1.2)
    points, yaw = feet(now, wanted, config)
    other, other_yaw = feet(mirrored(now), mirrored(wanted), config, WAIT[::-1])
    np.testing.assert_allclose(other, points[::-1] * flip, atol=1e-12)
    np.testing.assert_allclose(other_yaw, -yaw[::-1])
    other, other_yaw = feet(turned(now), turned(wanted), config)
    np.testing.assert_allclose(other, points @ R.T, atol=1e-12)
    np.testing.assert_allclose(other_yaw, yaw + 1.1)
