import jax
import jax.numpy as jnp
import numpy as np
from pretend import elsewhere, pretend_walk

from hector_jax.core.trajectory import State, from_start, has_fallen


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


def test_from_its_start_a_walk_looks_the_same_wherever_it_began():
    walk = pretend_walk(seconds=0.5, turn=1.0)
    found = from_start(elsewhere(walk, (0.4, -1.0), 2.0))
    for name, value in walk._asdict().items():
        for part, same in zip(
            jax.tree.leaves(getattr(found, name)), jax.tree.leaves(value), strict=True
        ):
            np.testing.assert_allclose(part, same, atol=1e-9, err_msg=name)
