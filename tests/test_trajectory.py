import numpy as np

from hector_jax.core.trajectory import State, has_fallen


def test_a_fall_is_a_fall():
    zero = np.zeros(3)
    upright = State(zero, np.array([0.0, 0.0, 0.41]), zero, zero)
    for fell, change in (
        (False, {}),
        (False, {"euler": [0.7, -0.7, 3.0]}),
        (True, {"position": [0.0, 0.0, 0.24]}),
        (True, {"euler": [0.0, -0.81, 0.0]}),
        (True, {"euler": [0.81, 0.0, 0.0]}),
        (True, {"velocity": [0.0, np.nan, 0.0]}),
    ):
        changed = {name: np.array(value) for name, value in change.items()}
        assert has_fallen(upright._replace(**changed)) == fell
