"""Gradients of model and simulator compared: the pure part of experiments/transfer.py."""

import json

import numpy as np
import pytest
import transfer
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


def test_central_differences_are_the_gradient_in_the_directions():
    slope = RNG.normal(size=18)

    def loss(logs):
        weights = scale_weights(nominal(), logs)
        return slope @ directions() @ np.log(np.asarray(weights_to_vector(weights)))

    step = transfer.STEP * np.eye(18)
    losses = np.array([[[loss(row), loss(-row)] for row in step]])
    both = 1.0 + np.array([0.0] * 12 + [1.0] * 6)  # two feet move
    np.testing.assert_allclose(transfer.slopes(losses)[0], slope * both, rtol=1e-9)


def test_a_gradient_in_weights_becomes_one_in_log_weights_of_both_feet():
    ones = nominal()
    gradient = type(ones)(
        Q=type(ones.Q)(*(1.0 / q for q in ones.Q)), R=type(ones.R)(*(1.0 / r for r in ones.R))
    )
    np.testing.assert_allclose(
        transfer.as_directions(ones, gradient), [1.0] * 12 + [2.0] * 6, rtol=1e-12
    )


def test_sampled_weights_stay_within_their_factor():
    vectors = [np.asarray(weights_to_vector(w)) for w in sample_weights(nominal(), 1.5, 8)]
    ratios = np.array(vectors) / np.asarray(weights_to_vector(nominal()))
    assert ratios.max() < 1.5
    assert ratios.min() > 1 / 1.5
    assert len(np.unique(ratios[:, 0])) == 8
    np.testing.assert_allclose(ratios[:, 12:15], ratios[:, 15:18])


def test_a_gradient_is_aligned_with_itself_whatever_its_length():
    assert transfer.compare(3.0 * TRUTH, TRUTH).cosine == pytest.approx((1.0, 1.0, 1.0))


def test_the_weight_that_is_most_wrong_is_named():
    wrong = TRUTH.copy()
    wrong[:, direction_names().index("Q_z")] += 20.0
    row = transfer.compare(wrong, TRUTH)
    assert row.wrong == "Q_z"
    assert row.share > 0.4


def test_a_phase_with_a_fall_is_left_out():
    fell = TRUTH.copy()
    fell[1] = np.nan
    row = transfer.compare(TRUTH, fell)
    assert row.phases == 3
    assert row.cosine.value == pytest.approx(1.0)
    assert transfer.compare(TRUTH, np.full_like(TRUTH, np.nan)) is None


def test_the_report_holds_every_row(tmp_path):
    gradients = {
        "straight": {"hfs": TRUTH, "command": -TRUTH, "net": TRUTH},
        "c": {"hfs": TRUTH[:1], "command": TRUTH[:1] * np.nan, "net": TRUTH[:1]},
    }
    path = transfer.report(transfer.Flags(out=tmp_path, phases=(0, 10, 20, 30)), gradients)
    lines = [line for line in path.read_text().splitlines() if line.startswith("|")]
    assert len(lines) == 6
    assert len({line.count("|") for line in lines}) == 1
    assert "no phase to compare" in lines[4]
    assert "[" not in lines[5]  # one phase has no interval
    told = json.loads((tmp_path / "transfer.json").read_text())
    assert told["rows"]["straight"]["command"]["cosine"]["value"] == pytest.approx(-1.0)
    assert told["rows"]["c"]["command"] is None
    assert told["rows"]["c"]["net"]["cosine"]["low"] is None
    assert json.loads(as_json(told["gradients"]["straight"]["net"])) == TRUTH.tolist()
