import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax.control import GaitConfig, gait


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
