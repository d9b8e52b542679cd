"""Gradients and orders compared: the pure part of the report on alignment."""

import json

import alignment
import numpy as np
import pytest
from alignment import BEYOND_SAG, SAG
from lib import sample_weights

from hector_jax.control.weights import (
    direction_names,
    directions,
    nominal,
    scale_weights,
    weights_to_vector,
)
from hector_jax.core.files import as_json

RNG = np.random.default_rng(1)
TRUTH = RNG.normal(size=18) + 0.1 * RNG.normal(size=(4, 18))


def test_the_directions_of_the_sag_are_left_out_beside_the_others():
    assert set(SAG) <= set(direction_names())
    assert BEYOND_SAG.sum() == 15


def test_central_differences_are_the_gradient_in_the_directions():
    slope = RNG.normal(size=18)

    def loss(logs):
        weights = scale_weights(nominal(), logs)
        return slope @ directions() @ np.log(np.asarray(weights_to_vector(weights)))

    step = alignment.STEP * np.eye(18)
    losses = np.array([[[loss(row), loss(-row)] for row in step]])
    both = 1.0 + np.array([0.0] * 12 + [1.0] * 6)  # two feet move
    np.testing.assert_allclose(alignment.slopes(losses)[0], slope * both, rtol=1e-9)


def test_a_gradient_in_weights_becomes_one_in_log_weights_of_both_feet():
    ones = nominal()
    gradient = type(ones)(
        Q=type(ones.Q)(*(1.0 / q for q in ones.Q)), R=type(ones.R)(*(1.0 / r for r in ones.R))
    )
    np.testing.assert_allclose(
        alignment.as_directions(ones, gradient), [1.0] * 12 + [2.0] * 6, rtol=1e-12
    )


def test_sampled_weights_stay_within_their_factor():
    vectors = [np.asarray(weights_to_vector(w)) for w in sample_weights(nominal(), 1.5, 8)]
    ratios = np.array(vectors) / np.asarray(weights_to_vector(nominal()))
    assert ratios.max() < 1.5
    assert ratios.min() > 1 / 1.5
    assert len(np.unique(ratios[:, 0])) == 8
    np.testing.assert_allclose(ratios[:, 12:15], ratios[:, 15:18])


def test_a_gradient_is_aligned_with_itself_whatever_its_length():
    row = alignment.compare(3.0 * TRUTH, None, TRUTH)
    assert row is not None
    assert row.cosine == pytest.approx((1.0, 1.0, 1.0))
    assert row.gain is None
    assert row.sizes[0] == pytest.approx(3.0 * row.sizes[1])


def test_the_weight_that_is_most_wrong_is_named():
    wrong = TRUTH.copy()
    wrong[:, direction_names().index("Q_z")] += 20.0
    row = alignment.compare(wrong, None, TRUTH)
    assert row is not None
    assert row.wrong == "Q_z"
    assert row.share > 0.4
    assert row.beyond_sag.value == pytest.approx(1.0)
    sentence = alignment.wrong_sentence("straight", "command", row)
    assert "most wrong is Q_z" in sentence


def test_the_gain_over_the_command_is_the_difference_of_cosines_on_the_same_phases():
    command = TRUTH + 2.0 * RNG.normal(size=TRUTH.shape)
    row = alignment.compare(TRUTH, command, TRUTH)
    alone = alignment.compare(command, None, TRUTH)
    assert row is not None
    assert alone is not None
    assert row.gain is not None
    assert row.gain.value == pytest.approx(1.0 - alone.cosine.value)
    assert row.gain.low <= row.gain.value <= row.gain.high
    assert row.gain.low == pytest.approx(1.0 - alone.cosine.high)


def test_a_phase_with_a_fall_is_left_out_for_all():
    fell = TRUTH.copy()
    fell[1] = np.nan
    row = alignment.compare(TRUTH, 2.0 * TRUTH, fell)
    assert row is not None
    assert row.phases == 3
    assert row.cosine.value == pytest.approx(1.0)
    assert alignment.compare(TRUTH, None, np.full_like(TRUTH, np.nan)) is None


def test_few_phases_have_no_interval():
    row = alignment.compare(TRUTH[:1], -TRUTH[:1], TRUTH[:1])
    assert row is not None
    assert row.gain is not None
    assert np.isnan(row.gain.low)
    assert "[" not in alignment.gradient_table({("c", "net"): row})
    assert "above zero on 0 of 1" in alignment.summary({("c", "net"): row}, "net")
    told = json.loads(as_json(alignment.as_result(row)))
    assert told["gain"]["low"] is None
    assert told["gain"]["value"] == pytest.approx(2.0)


def test_rank_correlation_sees_order_alone():
    x = np.arange(10.0)
    assert alignment.rank_correlation(np.exp(x), x) == pytest.approx(1.0)
    assert alignment.rank_correlation(-x, np.where(x == 3.0, np.nan, x)) == pytest.approx(-1.0)
    assert np.isnan(alignment.rank_correlation(x[:2], x[:2]))


def test_tables_hold_every_row_and_are_rectangular():
    rows = {
        ("straight", "command"): alignment.compare(TRUTH, None, TRUTH),
        ("straight", "net"): alignment.compare(TRUTH, -TRUTH, TRUTH),
        ("c", "net"): None,
    }
    text = alignment.gradient_table(rows)
    assert len(text.splitlines()) == 5
    assert "no phase to compare" in text
    ranks = {("c", "net"): {"1.5": 0.9, "3": 0.5}}
    for table in (text, alignment.rank_table(ranks)):
        assert len({line.count("|") for line in table.splitlines()}) == 1
    assert "above zero on 1 of 1" in alignment.summary(rows, "net")
    assert "could be made" in alignment.summary(rows, "paper")
