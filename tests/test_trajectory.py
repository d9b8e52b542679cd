import jax.numpy as jnp
import numpy as np

from hector_jax.trajectory import State, has_fallen


def upright(**change):
    zero = jnp.zeros(3)
    state = State(zero, jnp.array([0.0, 0.0, 0.41]), zero, zero)
    return state._replace(**{k: jnp.asarray(v) for k, v in change.items()})


def test_a_fall_is_a_fall():
    assert not has_fallen(upright())
    assert not has_fallen(upright(euler=[0.7, -0.7, 3.0]))
    assert has_fallen(upright(position=[0.0, 0.0, 0.24]))
    assert has_fallen(upright(euler=[0.0, -0.81, 0.0]))
    assert has_fallen(upright(euler=[0.81, 0.0, 0.0]))
    assert has_fallen(upright(velocity=[0.0, np.nan, 0.0]))
