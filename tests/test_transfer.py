"""Gradients of model and simulator compared: the pure part of experiments/transfer.py."""

import numpy as np
import pytest
import transfer

from hector_jax.control.weights import (
    direction_names,
    nominal,
    scale_weights,
    vector_to_weights,
    weights_to_vector,
)

RNG = np.random.default_rng(1)
TRUTH = RNG.normal(size=18) + 0.1 * RNG.normal(size=(4, 18))


def test_central_differences_are_the_gradient_in_the_directions():
    slope, start = RNG.normal(size=24), np.asarray(weights_to_vector(nominal()))

    def loss(logs):
        return slope @ np.log(np.asarray(weights_to_vector(scale_weights(nominal(), logs))) / start)

    step = transfer.STEP * np.eye(18)
    losses = np.array([[[loss(row), loss(-row)] for row in step]])
    gradient = vector_to_weights(slope / start)
    expected = transfer.as_directions(nominal(), gradient)
    np.testing.assert_allclose(transfer.slopes(losses)[0], expected, rtol=1e-9)


def test_gradients_are_compared_by_direction_where_both_are_numbers():
    assert transfer.compare(3.0 * TRUTH, TRUTH).cosine == pytest.approx((1.0, 1.0, 1.0))
    wrong, fell = TRUTH.copy(), TRUTH.copy()
    wrong[:, direction_names().index("Q_z")] += 20.0
    row = transfer.compare(wrong, TRUTH)
    assert (row.wrong, row.share > 0.4) == ("Q_z", True)
    fell[1] = np.nan
    row = transfer.compare(TRUTH, fell)
    assert (row.phases, row.cosine.value) == (3, pytest.approx(1.0))
    assert transfer.compare(TRUTH, np.full_like(TRUTH, np.nan)) is None
