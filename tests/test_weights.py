"""The 24 weights: their order, their box and the sets with a name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hector_jax import nominal
from hector_jax.control import MpcConfig, WalkConfig, Weights, expert
from hector_jax.control import weights as control_weights
from hector_jax.control.parameters import TUNABLES, bounds
from hector_jax.control.weights import vector_to_weights, weight_names, weights_to_vector


@pytest.mark.parametrize("shape", [(24,), (3, 24), (2, 5, 24)])
def test_vector_and_weights_are_the_same_numbers(shape):
    vector = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    weights = vector_to_weights(jnp.asarray(vector))
    assert weights.R.force.shape == (*shape[:-1], 2, 3)
    back = weights_to_vector(weights)
    np.testing.assert_array_equal(back, vector)
    assert back.dtype == np.float32


@pytest.mark.parametrize("weights", [nominal, expert])
def test_named_weights_lie_inside_the_box_and_treat_both_feet_alike(weights):
    lower, upper = bounds()
    for w, low, high in zip(*map(jax.tree.leaves, (weights(), lower, upper)), strict=True):
        assert ((low < w) & (w < high)).all()
    for kind in weights().R:
        np.testing.assert_array_equal(kind[0], kind[1])


def test_each_name_stands_where_its_weight_is_and_feet_share_theirs_in_every_direction():
    numbers = dict(zip(weight_names(), range(24), strict=True))
    weights = vector_to_weights(jnp.arange(24.0))
    assert weights.Q.euler[2] == numbers["Q_yaw"]
    assert weights.Q.position[0] == numbers["Q_x"]
    assert weights.Q.ang_velocity[1] == numbers["Q_wy"]
    assert weights.Q.velocity[2] == numbers["Q_vz"]
    assert weights.R.force[0, 2] == numbers["R_Fz_left"]
    assert weights.R.force[1, 0] == numbers["R_Fx_right"]
    assert weights.R.moment[1, 1] == numbers["R_My_right"]
    assert len(set(weight_names())) == 24
    steps = control_weights.directions()
    assert len(control_weights.direction_names()) == len(steps) == 18
    assert (steps.sum(axis=0) == 1).all()
    step = np.zeros(18)
    step[control_weights.direction_names().index("R_Fz")] = np.log(2.0)
    weights = control_weights.scale_weights(nominal(), step)
    np.testing.assert_allclose(weights.R.force[:, 2], 2.0 * nominal().R.force[:, 2])
    np.testing.assert_allclose(weights.R.force[:, :2], nominal().R.force[:, :2])


def test_between_two_sets_weights_are_geometric_means_and_other_numbers_lie_on_a_line():
    one, other = (w._replace(others={"turn_lead": x}) for w, x in ((nominal(), 0), (expert(), 1)))
    for share, end in ((0.0, one), (1.0, other)):
        jax.tree.map(np.testing.assert_allclose, control_weights.between(one, other, share), end)
    third = control_weights.between(one, other, 1 / 3)
    assert third.others == {"turn_lead": pytest.approx(1 / 3)}
    cubes = weights_to_vector(nominal()) ** 2 * weights_to_vector(expert())
    np.testing.assert_allclose(weights_to_vector(third) ** 3, cubes, rtol=1e-12)
    points = Weights(nominal().Q, nominal().R._replace(moment=np.zeros((2, 0))))
    assert control_weights.between(points, points).R.moment.shape == (2, 0)


def test_each_number_beside_the_weights_has_its_box_and_its_default_inside():
    parameters = WalkConfig(mpc=MpcConfig(position_limit=0.1)).parameters(nominal())
    for name, one in TUNABLES.items():
        default = np.asarray(one.read(parameters))
        assert ((one.lower <= default) & (default <= one.upper)).all(), name
