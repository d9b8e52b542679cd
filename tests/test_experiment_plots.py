"""Pictures of the experiments: what is drawn is what was measured, with names and units."""

from typing import NamedTuple

import numpy as np
import plots
import pytest

from hector_jax.control.weights import direction_names

RNG = np.random.default_rng(1)
TRUTH = RNG.normal(size=18) + 0.1 * RNG.normal(size=(4, 18))


class Result(NamedTuple):
    """Value, low and high end, as `survival` draws them."""

    ratio: np.ndarray
    survived: np.ndarray


def lines(axes):
    """Data of an axes' lines by their label."""
    return {line.get_label(): np.asarray(line.get_xydata()) for line in axes.lines}


def test_sets_of_batches_stand_at_their_ratio_and_in_the_order_of_their_losses(tmp_path, drawn):
    ratios = {"expert": np.array([0.8, 0.7]), "straight alone": np.array([0.3, 0.5])}
    plots.ratios(tmp_path / "a.png", ("straight", "c"), ratios)
    found = lines(drawn[0].axes[0])
    assert found["straight alone"][:, 1].tolist() == [0.3, 0.5]
    assert found["straight alone"][0, 0] != found["expert"][0, 0]
    plots.by_plant(tmp_path / "b.png", {"nominal": np.array([4e7, 1e6, 2e6, 3e6])})
    assert lines(drawn[1].axes[0])["nominal"].tolist() == [
        [12.5, 1.0],
        [37.5, 2.0],
        [62.5, 3.0],
        [87.5, 40.0],
    ]


def test_a_front_leaves_out_what_failed_and_labels_the_ends_and_the_papers_price(tmp_path, drawn):
    prices = np.geomspace(0.01, 100, 9)
    falling = 1e6 * np.stack([3 * prices**-0.4, 0.4 + 0.05 * prices**0.3], axis=1)
    worlds = {"rigid body": falling.copy(), "hfs": 1.3 * falling}
    worlds["rigid body"][0] = np.nan
    plots.front(tmp_path / "c.png", prices, worlds, {"expert": (2e6, 6e5)})
    model, hfs = drawn[0].axes
    np.testing.assert_allclose(lines(model)["tuned"], falling[1:] / 1e6)
    assert [text.get_text() for text in model.texts] == ["x0.032", "x1", "x100"]
    assert [text.get_text() for text in hfs.texts] == ["x0.01", "x1", "x100"]
    assert lines(hfs)["expert"].tolist() == [[2.0, 0.6]]


def test_starts_end_where_their_last_accepted_step_is(tmp_path, drawn):
    curves = 1e6 * np.array([[4.0, 3.0, 2.0], [9.0, np.nan, 5.0], [8.0, 1.0, np.nan]])
    plots.starts(tmp_path / "d.png", curves)
    way, end = drawn[0].axes
    assert lines(way)["from elsewhere"].tolist() == [[0.0, 9.0], [2.0, 5.0]]
    assert end.lines[0].get_ydata().tolist() == [1.0, 2.0, 5.0]


def test_a_race_shows_median_and_range_by_walks(tmp_path, drawn):
    curves = {"random": {0: [3e6, 5e6, 9e6], 10: [2e6, 4e6, 8e6]}, "walks": {0: [3e6], 10: [1e6]}}
    plots.race(tmp_path / "a.png", curves)
    middle = {line.get_label(): line.get_ydata() for line in drawn[0].axes[0].lines}
    np.testing.assert_allclose(middle["random"], [5.0, 4.0])
    np.testing.assert_allclose(middle["walks"], [3.0, 1.0])


def test_pictures_show_survival_and_ratio_of_sets_of_any_name(tmp_path, drawn):
    names, rng = ("nominal", "expert", "with", "mine", "yours"), np.random.default_rng(0)
    row = {name: Result(*np.sort(rng.random((2, 3)))[:, [1, 0, 2]]) for name in names}
    plots.survival(tmp_path / "a.png", {"push 25 N": row, "push 50 N": row})
    ratio, stood = drawn[0].axes
    for axes, field, scale in ((ratio, "ratio", 1.0), (stood, "survived", 100.0)):
        values = [line.get_xdata() for line in axes.lines][: len(names)]
        expected = [2 * [scale * getattr(row[name], field)[0]] for name in names]
        np.testing.assert_allclose(values, expected)
    assert [label.get_text() for label in ratio.get_yticklabels()] == ["push 25 N", "push 50 N"]


def test_pictures_show_gradients_of_unit_length_and_the_losses_of_both(tmp_path, drawn):
    truth = 1e4 * TRUTH
    plots.gradients(tmp_path / "a.png", direction_names(), truth, {"command": -truth, "net": truth})
    bars = {bars.get_label().split(",")[0]: bars for bars in drawn[0].axes[0].containers}
    unit = TRUTH.mean(axis=0) / np.linalg.norm(TRUTH.mean(axis=0))
    for name, sign in (("hfs", 1), ("command", -1), ("net", 1)):
        np.testing.assert_allclose([bar.get_height() for bar in bars[name]], sign * unit)
        length = float(bars[name].get_label().split(", ")[1])  # in the legend
        assert length == pytest.approx(np.linalg.norm(truth.mean(axis=0)), rel=0.05)
    losses = np.exp(RNG.normal(size=8)) * 1e6
    key = ("straight", "1.5")
    models, told = {key: {"net": 2 * losses}}, {key: {"net": 0.9}}
    plots.ranks(tmp_path / "b.png", {key: losses}, models, told)
    dots = drawn[1].axes[0].lines[0]
    assert dots.get_label() == "net: 0.90"
    np.testing.assert_allclose(dots.get_xydata(), np.c_[losses, 2 * losses] / 1e6)
