import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.control import gait
from hector_jax.control.gait import GaitConfig

CONFIG = GaitConfig()


def test_one_foot_stands_at_a_time_and_they_alternate_every_stance():
    contact = np.asarray(gait.contact(CONFIG, jnp.arange(-80, 400)))
    assert (contact.sum(axis=1) == 1).all()
    assert (np.flatnonzero(np.diff(contact[:, 0].astype(int))) % 20 == 19).all()


def test_a_switch_tick_belongs_to_the_new_stance():
    assert gait.contact(CONFIG, jnp.array(0)).tolist() == [True, False]
    assert gait.contact(CONFIG, jnp.array(20)).tolist() == [False, True]


def test_both_feet_stand_before_the_gait_starts():
    ticks = jnp.arange(-110, -80)
    assert np.asarray(gait.contact(CONFIG, ticks)).all()
    assert not np.asarray(gait.swing_ticks(CONFIG, ticks)).any()


def test_double_support_overlaps_the_stances():
    config = GaitConfig(stance=22, swing=18)
    contact = np.asarray(gait.contact(config, jnp.arange(40)))
    assert contact.sum() == 44
    assert contact.all(axis=1).sum() == 4


def test_touchdown_is_where_the_schedule_says():
    for tick in range(-110, 60):
        wait = np.asarray(gait.ticks_to_touchdown(CONFIG, jnp.array(tick)))
        for foot in (0, 1):
            stands = np.asarray(gait.contact(CONFIG, jnp.arange(tick - 1, tick + 80)))[:, foot]
            lands = np.flatnonzero(~stands[:-1] & stands[1:])
            lands = lands[lands >= 1]  # a touchdown now is the present stance
            if not (tick < -80 and foot == 0):
                assert wait[foot] == lands[0]


def test_touchdowns_are_counted_over_the_horizon():
    later = jnp.array([5, 19, 20, 25, 45, 60])
    count = np.asarray(gait.touchdowns(CONFIG, jnp.array(5), later))
    assert count.tolist() == [[0, 0], [0, 0], [0, 1], [0, 1], [1, 1], [1, 2]]


def test_swing_clock_runs_through_the_swing():
    assert np.asarray(gait.swing_ticks(CONFIG, jnp.arange(40)))[:, 0].tolist() == [0] * 20 + list(
        range(20)
    )


def test_time_since_switch_restarts_at_every_switch():
    since = np.asarray(gait.since_switch(CONFIG, jnp.arange(0, 60)))
    np.testing.assert_allclose(since, 0.01 * (np.arange(60) % 20))


@pytest.mark.parametrize("wrong", [{"tick": 0.0}, {"swing": -1}, {"stance": 10}, {"stance": 21}])
def test_impossible_gaits_are_refused(wrong):
    with pytest.raises(ValueError, match="GaitConfig"):
        GaitConfig(**wrong)
