"""Scores, intervals and comparisons."""

import json

import numpy as np
import pytest
from pretend import SETS, pretend_score, pretend_verdict, pretend_walk

from hector_jax.core.files import as_json
from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.verdict import metrics


def _judge(scenes=("s",), **losses):
    scores = {name: [pretend_score(x) for x in row] for name, row in losses.items()}
    seeds = range(len(next(iter(losses.values()))))
    return metrics.make_verdict(PAPER_LOSS, seeds, dict.fromkeys(scenes, scores))


def test_rms_errors_are_per_axis_and_a_fall_is_charged_but_not_in_them():
    walk, offset = pretend_walk(), np.array([0.01, 0.02, 0.03])
    beside = walk.reference._replace(position=walk.reference.position + offset)
    one = metrics.score(PAPER_LOSS, walk._replace(state=beside))
    np.testing.assert_allclose(one.rms_position, offset, rtol=1e-12)
    np.testing.assert_allclose(one.rms_euler, 0.0)
    upright, fell = (metrics.score(PAPER_LOSS, pretend_walk(fall_at=t)) for t in (None, 2.0))
    assert (upright.fallen, fell.fallen) == (False, True)
    assert fell.L > upright.L
    assert fell.losses["L_pos"] >= 2000 * 0.5**2
    assert np.isfinite(fell.rms_position).all()


@pytest.mark.parametrize("plants", [6, 8, 16])
def test_intervals_of_few_plants_cover_what_they_say_and_seldom_claim_what_is_not(plants):
    draws = np.random.default_rng(5).lognormal(sigma=0.2, size=(4000, plants))
    error = 3 * np.sqrt(0.95 * 0.05 / len(draws))  # of the shares below
    medians, means = (
        [interval_of(row) for row in draws]
        for interval_of in (metrics.interval_of_median, metrics.interval_of_mean)
    )
    for found, true in ((medians, 1.0), (means, np.exp(0.2**2 / 2))):
        assert np.mean([x.low <= true <= x.high for x in found]) >= 0.95 - error
    assert np.mean([x.high < 1.0 for x in medians]) <= 0.025 + error  # a gain where there is none
    ordered = np.sort(draws[0])
    rank = {6: 0, 8: 0, 16: 3}[plants]
    assert medians[0][1:] == (ordered[rank], ordered[-1 - rank])
    assert means[0].value == pytest.approx(draws[0].mean())


def test_fewer_than_six_plants_have_no_interval():
    for count in range(1, 6):
        for interval_of in (metrics.interval_of_median, metrics.interval_of_mean):
            found = interval_of(np.arange(1.0, count + 1))
            assert found.value == (count + 1) / 2
            assert np.isnan([found.low, found.high]).all()
    verdict = _judge(nominal=[1.0], tuned=[0.5])
    told = json.loads(as_json(metrics.verdict_result({"standin": verdict})))
    found = told["sets"]["tuned"]["standin"]
    assert found["L"] == {"mean": 0.5, "low": None, "high": None}
    change = found["change"]["nominal"]
    assert (change["median"], change["low"], change["high"]) == (pytest.approx(-50.0), None, None)


def test_the_change_is_the_median_of_paired_ratios_not_the_ratio_of_means():
    verdict = _judge(nominal=[1.0, *[10.0] * 4, 100.0], tuned=[0.5, *[8.0] * 4, 99.0])
    change = metrics.compare(verdict, "tuned", "nominal").change["L"]
    assert (change.value, change.low, change.high) == pytest.approx((-20.0, -50.0, -1.0))


def test_an_interval_over_trajectories_is_one_over_plants():
    rng = np.random.default_rng(11)
    losses = 1.0 + 0.1 * rng.normal(size=(8, 1)) + 0.03 * rng.normal(size=(8, 3))
    walks = {s: {"tuned": [pretend_score(x) for x in losses[:, i]]} for i, s in enumerate("abc")}
    found = metrics.mean(metrics.make_verdict(PAPER_LOSS, range(8), walks), "tuned")
    assert found == pytest.approx(metrics.interval_of_mean(losses.mean(axis=1)), rel=1e-9)
    assert found.low < found.value < found.high
    base = {s: row | {"nominal": [pretend_score(1.0)] * 8} for s, row in walks.items()}
    change = metrics.compare(metrics.make_verdict(PAPER_LOSS, range(8), base), "tuned", "nominal")
    expected = metrics.interval_of_median(100 * (np.median(losses, axis=1) - 1))
    assert change.change["L"] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("seeds", "scenes", "fell", "counts"),
    [(32, 1, 1, True), (32, 1, 2, False), (8, 1, 1, False), (64, 1, 3, True)]
    + [(8, 3, 1, True), (8, 3, 2, False)],
)
def test_a_comparison_counts_where_falls_differ_by_less_than_2_of_32(seeds, scenes, fell, counts):
    verdict = pretend_verdict(seeds, scenes=("straight", "c", "s")[:scenes])
    fallen = np.arange(seeds * scenes).reshape(seeds, scenes) < fell
    scores = verdict.scores | {"with": verdict.scores["with"]._replace(fallen=fallen)}
    verdict = verdict._replace(scores=scores)
    assert metrics.compare(verdict, "with", "nominal").counts is counts
    assert metrics.compare(verdict, "nominal", "with").counts is counts


def test_the_result_has_the_promised_keys_and_counts_plants_but_falls_and_wins_of_walks():
    scenes = ("straight", "c", "s")
    verdict = pretend_verdict(8, {("with", 1)}, scenes=scenes)
    result = json.loads(json.dumps(metrics.verdict_result({"standin": verdict}), allow_nan=False))
    assert tuple(result["sets"]) == SETS
    for name, worlds in result["sets"].items():
        found = worlds["standin"]
        for part in ("L_Eul", "L_pos", "L_ctrl", "L"):
            assert found[part]["low"] <= found[part]["mean"] <= found[part]["high"]
        assert found["falls"] == 3 * (name == "with")
        assert (found["seeds"], found["scenes"]) == (list(range(8)), list(scenes))
        for baseline in {"nominal", "expert"} - {name}:
            assert {"median", "low", "high", "wins", "counts"} <= found["change"][baseline].keys()
    assert verdict.walks == 24
    wins = np.mean(np.less(*(verdict.scores[name].L for name in ("with", "nominal"))))
    change = result["sets"]["with"]["standin"]["change"]["nominal"]
    assert change["wins"] == pytest.approx(wins)
    assert change["high"] < 0


def test_legs_that_touch_are_counted_up_to_a_fall():
    touching = np.arange(400) >= 150
    walk = pretend_walk(fall_at=2.0)._replace(legs_touch=touching)
    one = metrics.score(PAPER_LOSS, walk)
    assert one.legs_touch == pytest.approx(0.5)
    verdict = metrics.make_verdict(PAPER_LOSS, [0, 1], {"s": {"with": [one, one]}})
    found = metrics.verdict_result({"standin": verdict})["sets"]["with"]["standin"]
    assert found["legs_touch"] == pytest.approx(1.0)


def test_a_missing_walk_or_a_loss_that_is_not_a_number_is_refused():
    one = pretend_score(1.0)
    lost = one._replace(losses=one.losses | {"L": np.array(np.nan)})
    for seeds, rows, message in (
        ([0, 1], {"s": [one] * 2, "c": [one]}, "zip.* shorter"),
        ([3, 7], {"s": [one] * 2, "c": [one, lost]}, r"set 'with': the loss on seeds \[7\]"),
        ([], {}, "at least one seed"),
    ):
        with pytest.raises(ValueError, match=message):
            metrics.make_verdict(PAPER_LOSS, seeds, {s: {"with": row} for s, row in rows.items()})
