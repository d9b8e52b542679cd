"""A slip that the legs feel lowers the plan's friction for a while."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from changes import Change, walk_with_changes

from hector_jax.control import gait
from hector_jax.control.controller import walk_config
from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import named_command
from hector_jax.control.slip import SlipConfig, feel, first_grip
from hector_jax.control.weights_file import best
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs

CONFIG, GAIT = SlipConfig(distance=0.05, share=0.4, recovery=0.6), GaitConfig()
FEET = np.array([[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]])


def course(moves, config=CONFIG, start=0):
    """Shares of the friction at each tick, with the left foot (0) that much ahead of its place."""
    grip, shares = first_grip(FEET), []
    for tick, move in enumerate(moves, start):
        feet = jnp.asarray(FEET).at[0, 0].add(move)
        grip = feel(config, GAIT, 0.5, grip, feet=feet, tick=jnp.asarray(tick))
        shares.append(1.0 - float(grip.lost))
    return np.array(shares)


def test_a_foot_that_moves_far_in_its_stance_has_slipped():
    assert np.all(course([0.0] * 4 + [0.024] * 6) == 1.0)  # [m] 0.05 of the height are 0.025
    np.testing.assert_allclose(course([0.0] * 4 + [0.03] * 6), [1.0] * 4 + [0.88] * 6)
    np.testing.assert_allclose(course([0.0] * 4 + [0.2] * 6), [1.0] * 4 + [0.4] * 6)


def test_where_a_foot_lands_and_how_it_swings_is_no_slip():
    assert np.all(course([0.1, 0.1, 0.1, 0.1]) == 1.0)  # the first ticks of the stance
    assert np.all(course(np.linspace(0.0, 0.4, 20), start=GAIT.stance) == 1.0)  # it swings
    assert np.all(course([0.1] * 8, start=GAIT.first_tick - 8) == 1.0)  # it stands before the gait


def test_the_friction_grows_back_within_the_time_of_recovery():
    shares = course([0.0] * 4 + [0.05] + [0.0] * 75)
    assert shares[4] == 0.4
    np.testing.assert_allclose(np.diff(shares[4:64]), 0.6 * GAIT.tick / 0.6)
    assert np.all(shares[65:] == 1.0)


def test_a_stance_begins_at_the_touchdown_or_the_start_of_the_gait():
    since = gait.since_touchdown(GAIT, jnp.array([GAIT.first_tick - 5, GAIT.first_tick + 1, 0, 23]))
    np.testing.assert_array_equal(since[:, 0], [0, 1, 0, 23])
    np.testing.assert_array_equal(since[:, 1], [0, 1, 20, 3])


@pytest.mark.slow
def test_a_floor_that_turns_slippery_is_walked_with_less_friction():
    robot = load_robot()
    config, floor = walk_config(robot), (Change(1.0, 3.0, floor_friction=0.45),)
    careless = replace(config, slip=replace(config.slip, share=1.0))
    job = Job(best(), named_command("s"), hfs())
    felt, not_felt = (walk_with_changes(c, robot, job, floor) for c in (config, careless))
    assert not np.any(felt.fallen)

    def use(walk):
        force = np.sum(walk.command.force, axis=1)[1500:3000]  # while the floor is slippery
        return np.max(np.abs(force[:, :2]).sum(axis=1) / force[:, 2])

    assert use(felt) < use(not_felt)
    # two programs, which may round otherwise
    np.testing.assert_allclose(
        felt.command.force[:1000], not_felt.command.force[:1000], rtol=1e-9, atol=1e-9
    )
