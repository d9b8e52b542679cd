"""Scores, intervals and comparisons."""

import json

import numpy as np
import pytest
from pretend import SETS, pretend_score, pretend_verdict, pretend_walk

from hector_jax.core.files import as_json
from hector_jax.tuning.loss import PAPER_LOSS, with_alphas
from hector_jax.verdict import metrics


def mean_of(x):
    """Mean over the samples."""
    return x.mean(axis=-1)


def _judge(scenes=("s",), **losses):
    """A verdict of losses by plant, the same in each of the scenes."""
    scores = {name: [pretend_score(x) for x in row] for name, row in losses.items()}
    seeds = range(len(next(iter(losses.values()))))
    return metrics.make_verdict(PAPER_LOSS, seeds, dict.fromkeys(scenes, scores))


def test_the_total_is_the_weighted_sum_of_the_parts():
    one = metrics.score(with_alphas({"L_Eul": 2.0, "L_pos": 3.0}), pretend_walk())
    euler, position, control = (one.losses[term.name] for term in PAPER_LOSS)
    assert one.L == pytest.approx(2 * euler + 3 * position + control, rel=1e-12)
    assert 0 < one.switching < control


def test_rms_errors_are_those_of_the_walk_per_axis():
    walk = pretend_walk()
    offset = np.array([0.01, 0.02, 0.03])
    shifted = walk._replace(
        state=walk.reference._replace(position=walk.reference.position + offset)
    )
    one = metrics.score(PAPER_LOSS, shifted)
    np.testing.assert_allclose(one.rms_position, offset, rtol=1e-12)
    np.testing.assert_allclose(one.rms_euler, 0.0)


def test_a_fall_is_charged_and_told_and_its_missing_samples_stay_out_of_the_rms():
    upright, fell = (metrics.score(PAPER_LOSS, pretend_walk(fall_at=t)) for t in (None, 2.0))
    assert fell.fallen
    assert not upright.fallen
    assert fell.L > upright.L
    assert fell.losses["L_pos"] >= 2000 * 0.5**2
    assert np.isfinite(fell.rms_position).all()


def test_a_bootstrap_interval_holds_its_value_and_is_the_same_each_time():
    samples = np.random.default_rng(3).lognormal(size=32)
    first, second = (metrics.bootstrap(mean_of, samples) for _ in range(2))
    assert first == second
    assert first.low < first.value < first.high
    assert first.value == pytest.approx(samples.mean())


def test_bootstrap_intervals_cover_the_mean_about_as_often_as_they_say():
    draws = np.random.default_rng(5).normal(size=(100, 32))
    inside = [i.low < 0 < i.high for i in (metrics.bootstrap(mean_of, x) for x in draws)]
    assert 0.86 <= np.mean(inside) <= 1.0


def test_fewer_than_four_samples_have_no_interval():
    for count in (1, 2, 3):
        found = metrics.bootstrap(mean_of, np.arange(1.0, count + 1))
        assert found.value == (count + 1) / 2
        assert np.isnan([found.low, found.high]).all()
        assert found.text("{:.1f}".format) == f"{found.value:.1f}"
    four = metrics.bootstrap(mean_of, np.arange(4.0))
    assert four.text("{:.2f}".format) == f"1.50 [{four.low:.2f}, {four.high:.2f}]"
    verdict = _judge(nominal=[1.0], tuned=[0.5])
    found = json.loads(as_json(metrics.verdict_result(verdict)))["sets"]["tuned"]["standin"]
    assert found["L"] == {"mean": 0.5, "low": None, "high": None}
    change = found["change"]["nominal"]
    assert (change["median"], change["low"], change["high"]) == (pytest.approx(-50.0), None, None)


def test_the_change_is_the_median_of_paired_ratios_not_the_ratio_of_means():
    verdict = _judge(nominal=[1.0, 10.0, 10.0, 100.0], tuned=[0.5, 8.0, 8.0, 99.0])
    change = metrics.compare(verdict, "tuned", "nominal").change["L"]
    assert change.value == pytest.approx(-20.0)
    assert change.low == pytest.approx(-50.0)
    assert change.high == pytest.approx(-1.0)


@pytest.mark.parametrize("count", [8, 9])
def test_copies_of_a_trajectory_have_its_values_and_its_intervals(count):
    drawn = np.random.default_rng(count).lognormal(size=(2, count))
    losses = dict(zip(("nominal", "tuned"), drawn, strict=True))
    one, three = _judge(**losses), _judge(("a", "b", "c"), **losses)
    assert metrics.compare(three, "tuned", "nominal") == metrics.compare(one, "tuned", "nominal")
    mean = metrics.mean(one, "tuned")
    assert mean.low < mean.value < mean.high
    assert metrics.mean(three, "tuned") == pytest.approx(mean, rel=1e-12)


def test_an_interval_over_trajectories_covers_as_one_over_plants_does(monkeypatch):
    monkeypatch.setattr(metrics, "RESAMPLES", 1000)
    rng, covers = np.random.default_rng(11), []
    for _ in range(150):
        losses = 1.0 + 0.1 * rng.normal(size=(8, 1)) + 0.03 * rng.normal(size=(8, 3))
        walks = {
            s: {"tuned": [pretend_score(x) for x in losses[:, i]]} for i, s in enumerate("abc")
        }
        found = metrics.mean(metrics.make_verdict(PAPER_LOSS, range(8), walks), "tuned")
        pooled, plants = (metrics.bootstrap(mean_of, x) for x in (losses.ravel(), losses.mean(1)))
        assert found == pytest.approx(plants, rel=1e-9)
        covers.append([interval.low < 1.0 < interval.high for interval in (found, pooled)])
    found, pooled = np.mean(covers, axis=0)
    assert found >= 0.82
    assert found > pooled + 0.1


def test_the_seeds_of_a_result_are_its_plants_and_its_falls_and_wins_are_walks():
    verdict = pretend_verdict(4, {("with", 1)}, scenes=("straight", "c", "s"))
    assert verdict.walks == 12
    found = metrics.verdict_result(verdict)["sets"]["with"]["standin"]
    assert (found["seeds"], found["scenes"]) == ([0, 1, 2, 3], ["straight", "c", "s"])
    assert found["falls"] == 3
    losses = (verdict.scores[name].L for name in ("with", "without"))
    wins = metrics.compare(verdict, "with", "without").wins
    assert wins == np.mean(np.less(*losses))
    assert np.shape(verdict.scores["with"].L) == (4, 3)


@pytest.mark.parametrize(
    ("seeds", "fell", "counts"), [(32, 1, True), (32, 2, False), (8, 1, False), (64, 3, True)]
)
def test_a_comparison_counts_only_where_falls_differ_by_less_than_2_of_32(seeds, fell, counts):
    verdict = pretend_verdict(seeds, {("with", i) for i in range(fell)})
    assert metrics.compare(verdict, "with", "nominal").counts is counts
    assert metrics.compare(verdict, "nominal", "with").counts is counts


@pytest.mark.parametrize(("fell", "counts"), [(1, True), (2, False)])
def test_the_margin_of_falls_is_one_of_walks(fell, counts):
    fallen = np.arange(24).reshape(8, 3) < fell
    verdict = pretend_verdict(8, scenes=("straight", "c", "s"))
    scores = verdict.scores | {"with": verdict.scores["with"]._replace(fallen=fallen)}
    verdict = verdict._replace(scores=scores)
    assert metrics.compare(verdict, "with", "nominal").counts is counts


def test_the_result_has_the_promised_keys_and_is_json():
    result = json.loads(json.dumps(metrics.verdict_result(pretend_verdict()), allow_nan=False))
    assert tuple(result["sets"]) == SETS
    for name, worlds in result["sets"].items():
        found = worlds["standin"]
        for part in ("L_Eul", "L_pos", "L_ctrl", "L"):
            assert found[part]["low"] <= found[part]["mean"] <= found[part]["high"]
        assert found["falls"] == 0
        assert found["seeds"] == list(range(8))
        assert found["scenes"] == ["straight"]
        for baseline in {"nominal", "expert"} - {name}:
            assert {"median", "low", "high", "wins", "counts"} <= found["change"][baseline].keys()
    assert result["sets"]["with"]["standin"]["change"]["nominal"]["high"] < 0


def test_legs_that_touch_are_counted_up_to_a_fall():
    touching = np.arange(400) >= 150
    walk = pretend_walk(fall_at=2.0)._replace(legs_touch=touching)
    one = metrics.score(PAPER_LOSS, walk)
    assert one.legs_touch == pytest.approx(0.5)
    verdict = metrics.make_verdict(PAPER_LOSS, [0, 1], {"s": {"with": [one, one]}})
    assert metrics.verdict_result(verdict)["sets"]["with"]["standin"][
        "legs_touch"
    ] == pytest.approx(1.0)


def test_a_missing_walk_or_a_loss_that_is_not_a_number_is_refused():
    one = pretend_score(1.0)
    with pytest.raises(ValueError, match="zip.* shorter"):
        metrics.make_verdict(PAPER_LOSS, [0, 1], {"s": {"with": [one] * 2}, "c": {"with": [one]}})
    lost = one._replace(losses=one.losses | {"L": np.array(np.nan)})
    with pytest.raises(ValueError, match=r"set 'with': the loss on seeds \[7\]"):
        metrics.make_verdict(
            PAPER_LOSS, [3, 7], {"s": {"with": [one] * 2}, "c": {"with": [one, lost]}}
        )
    with pytest.raises(ValueError, match="at least one seed"):
        metrics.make_verdict(PAPER_LOSS, [], {})
