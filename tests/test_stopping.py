"""When enough plants have walked: the guarantee of the rule, and how many plants it saves."""

import functools
import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from pretend import pretend_score, pretend_verdict

from hector_jax.tuning.loss import PAPER_LOSS
from hector_jax.verdict import metrics
from hector_jax.verdict.stopping import StoppingRule, claim_of, claims_of, is_clear, log_wealth

VERDICT = Path(__file__).parents[1] / "experiments" / "reports" / "verdict" / "verdict.json"
ONE = StoppingRule()
RANK = functools.cache(StoppingRule.rank)
BATCHES = functools.cache(lambda rule, plants: list(rule.batches(plants)))


def stop(ratios, rule=ONE):
    """The last claim on a set by its paired ratios of L, without falls; and after how many plants.

    One looks after each batch, until the claim is clear.
    """
    rank, claim, plants = functools.partial(RANK, rule), "unclear", 0
    for batch in BATCHES(rule, len(ratios)):
        if claim != "unclear":
            break
        plants = batch.stop
        interval = metrics.interval_of_median(np.asarray(ratios[:plants]), rank)
        change = metrics.Interval(*(100 * (x - 1) for x in interval))
        claim = claim_of(metrics.Comparison({"L": change}, 0.0, counts=True))
    return claim, plants


def test_the_wealth_is_a_martingale_by_enumeration():
    for signs in product((0, 1), repeat=7):
        below, above = sum(signs), 7 - sum(signs)
        after = [log_wealth(below + 1, above), log_wealth(below, above + 1)]
        assert np.mean(np.exp(after)) == pytest.approx(np.exp(log_wealth(below, above)))
    for plants in range(11):
        wealth = [
            np.exp(log_wealth(sum(x), plants - sum(x))) for x in product((0, 1), repeat=plants)
        ]
        assert np.mean(wealth) == pytest.approx(1.0)


@pytest.mark.parametrize("rule", [ONE, StoppingRule(claims=9)])
def test_an_end_of_the_interval_ever_misses_the_median_in_at_most_its_share(rule):
    """Exact, by the distribution of the signs of 400 plants that have not left the interval."""
    inside, missed = np.ones(1), 0.0
    for plants in range(1, 401):
        inside = (np.append(inside, 0.0) + np.append(0.0, inside)) / 2
        missed += inside[: rule.rank(plants)].sum()
        inside[: rule.rank(plants)] = 0.0
    level = 0.025 / rule.claims
    assert 0.6 * level < missed <= level


def test_one_claim_needs_as_many_plants_as_an_interval_and_more_claims_need_more():
    fewest = [StoppingRule(claims).fewest for claims in (1, 2, 9, 100)]
    assert fewest[0] == metrics.FEWEST
    assert fewest == sorted(set(fewest))
    for plants in range(1, 100):  # what may be looked at all the time is wider
        assert ONE.rank(plants) <= metrics.fixed_rank(plants)


def test_a_batch_decides_when_one_looks_and_nothing_else():
    for batch in (1, 2, 5, 40):
        batches = list(StoppingRule(batch=batch).batches(32))
        assert [plant for plants in batches for plant in plants] == list(range(32))
        assert all(plants.stop >= ONE.fewest for plants in batches)
        assert all(len(plants) % batch == 0 for plants in batches[:-1])
        assert StoppingRule(batch=batch).rank(32) == ONE.rank(32)


@pytest.mark.parametrize("noise", ["cauchy", "skewed"])
def test_of_equal_sets_it_says_better_in_at_most_one_run_of_twenty(noise):
    rng = np.random.default_rng(74)
    shape = (1000, 2, 48)
    draw = {
        "cauchy": lambda: np.exp(np.clip(0.1 * rng.standard_cauchy(shape), -50, 50)),
        "skewed": lambda: 1.0 + rng.pareto(0.8, size=shape),
    }[noise]()
    plant = rng.lognormal(sigma=1.0, size=(1000, 1, 48))  # the same for both sets
    first, second = np.swapaxes(plant * draw, 0, 1)
    ends = [stop(ratios)[0] for ratios in first / second]
    assert ends.count("better") <= 0.05 * len(ends)
    assert ends.count("better") + ends.count("worse") <= 0.05 * len(ends)
    peeked = [
        any(metrics.interval_of_median(x[:n]).high < 1.0 for n in range(6, 49))
        for x in (first / second)[:200]
    ]
    assert np.mean(peeked) > 0.05  # what the rule is for


def test_a_set_that_differs_by_the_margin_is_seldom_said_not_to():
    rng = np.random.default_rng(5)
    ratios = 1.05 * rng.lognormal(sigma=0.03, size=(1000, 64))
    ends = [stop(x)[0] for x in ratios]
    assert ends.count("no difference") + ends.count("better") <= 0.05 * len(ends)
    assert stop(np.full(32, 1.0)) == ("no difference", ONE.fewest)  # the very same set


def test_at_the_gains_of_best_at_least_30_percent_of_32_plants_are_saved():
    """In every engine, model and trajectory of the verdict, from real walks."""
    saved = []
    for column in json.loads(VERDICT.read_text())["columns"]:
        for sets in column["trajectories"].values():
            best, nominal = (
                np.array(sets[name]["L"]["by_seed"]) for name in ("shipped", "nominal")
            )
            found, plants = stop((best / nominal)[:32], StoppingRule(claims=6, batch=2))
            assert found == "better"
            saved.append(1 - plants / 32)
    assert min(saved) >= 0.30
    rng = np.random.default_rng(0)
    simulated = [stop(np.exp(rng.normal(-1.4, 0.2, 32))) for _ in range(100)]
    assert all(found == "better" for found, _ in simulated)
    assert np.mean([1 - plants / 32 for _, plants in simulated]) >= 0.30


def test_no_claim_is_made_where_falls_are_no_comparison():
    verdict = pretend_verdict(8)._replace(rank=ONE.rank)
    assert claims_of(verdict)["straight"]["with"] == "better"
    fell = pretend_verdict(8, {("with", 1)})._replace(rank=ONE.rank)
    assert claims_of(fell)["straight"]["with"] == "unclear"
    assert not is_clear(fell)


def test_every_set_has_to_be_clear_in_every_scene():
    def verdict(*losses):
        scores = {
            scene: {
                "nominal": [pretend_score(1.0)] * 8,
                "mine": [pretend_score(loss) for loss in np.linspace(loss, loss + 0.1, 8)],
            }
            for scene, loss in zip("sc", losses, strict=True)
        }
        return metrics.make_verdict(PAPER_LOSS, range(8), scores, ONE.rank)

    assert claims_of(verdict(0.5, 2.0)) == {"s": {"mine": "better"}, "c": {"mine": "worse"}}
    assert is_clear(verdict(0.5, 2.0))
    assert claims_of(verdict(0.5, 0.93))["c"] == {"mine": "unclear"}
    assert not is_clear(verdict(0.5, 0.93))
