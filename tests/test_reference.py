import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.control.reference import (
    COMMANDS,
    PIECES,
    UNSEEN,
    Anchor,
    Command,
    named_command,
    reference_at,
    with_pieces,
)

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
    state = path(command, times)
    middle = path(command, times[:-1] + 5e-4)
    np.testing.assert_allclose(
        np.diff(state.position, axis=0), 1e-3 * np.asarray(middle.velocity), atol=2e-8
    )
    np.testing.assert_allclose(
        np.diff(np.asarray(state.euler)[:, 2]),
        1e-3 * np.asarray(middle.ang_velocity)[:, 2],
        atol=1e-12,
    )


def test_the_c_curve_turns_by_pi_in_four_seconds():
    state = path(named_command("c"), [0.0, 4.0])
    np.testing.assert_allclose(state.euler[1, 2] - state.euler[0, 2], np.pi)
    # Half a circle of radius v / omega: its ends are a diameter apart.
    span = np.linalg.norm(state.position[1] - state.position[0])
    np.testing.assert_allclose(span, 2 * 0.25 / (0.25 * np.pi))


def test_the_s_curve_repeats_after_four_seconds():
    state = path(named_command("s"), [0.0, 4.0, 8.0, 1.3, 5.3])
    step = state.position[1] - state.position[0]
    np.testing.assert_allclose(state.position[2] - state.position[1], step, atol=1e-12)
    np.testing.assert_allclose(state.position[4] - state.position[3], step, atol=1e-12)
    np.testing.assert_allclose(state.euler[4], state.euler[3], atol=1e-12)


def test_laps_of_a_turning_command_join():
    state = path(named_command("c"), [3.999999, 4.000001, 15.999999, 16.000001])
    np.testing.assert_allclose(state.position[0], state.position[1], atol=1e-6)
    np.testing.assert_allclose(state.position[2], state.position[3], atol=1e-6)


def test_a_figure_of_eight_is_two_circles_through_one_point():
    state = path(named_command("eight"), [0.0, 2.0, 4.0, 6.0, 8.0])
    np.testing.assert_allclose(state.position[2::2] - state.position[0], 0.0, atol=1e-12)
    left, right = (state.position[i, :2] - state.position[0, :2] for i in (1, 3))
    np.testing.assert_allclose(left, -right, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(left), 2 * 0.3 / (0.5 * np.pi))
    np.testing.assert_allclose(
        np.asarray(state.euler)[[0, 2, 4], 2], 0.7 + np.array([0, 2, 0]) * np.pi
    )


@pytest.mark.parametrize(
    ("name", "ahead", "left", "turned"),
    [("sideways", 0.0, 0.8, 0.0), ("turn", 0.0, 0.0, np.pi), ("stop-and-go", 1.0, 0.0, 0.0)],
)
def test_unseen_commands_lead_where_their_names_say(name, ahead, left, turned):
    level = Anchor(jnp.array([0.0, 0.0, 0.42]), jnp.array(0.0), jnp.array(0))
    state = path(named_command(name), [4.0], level)
    np.testing.assert_allclose(state.position[0], [ahead, left, 0.42], atol=1e-12)
    np.testing.assert_allclose(state.euler[0, 2], turned)


def test_stop_and_go_stands_in_every_other_second():
    speed = np.asarray(path(named_command("stop-and-go"), [0.5, 1.5, 2.5, 3.5]).velocity)
    np.testing.assert_allclose(np.linalg.norm(speed, axis=1), [0.5, 0.0, 0.5, 0.0])


def test_unknown_trajectory_is_named():
    with pytest.raises(ValueError, match="unknown trajectory 'circle'; known: straight, c, s, "):
        named_command("circle")


def test_pieces_without_duration_change_nothing():
    three = Command(np.array([0.7, 1.1, 0.4]), 0.1 * np.ones((3, 2)), np.arange(3.0))
    for command in (named_command("s"), three):
        padded = with_pieces(command)
        assert len(padded.duration) == len(with_pieces(padded).duration) == PIECES
        one, other = (path(c, np.arange(0, 13.0, 0.07)) for c in (command, padded))
        jax.tree.map(np.testing.assert_array_equal, one, other)
