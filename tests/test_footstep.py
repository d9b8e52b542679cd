"""Where the feet come down: both rules, by hand and by symmetry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ROBOT

from hector_jax.control.footstep import FootstepConfig, touchdown_points
from hector_jax.core.geometry import rot_z
from hector_jax.core.trajectory import State

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
