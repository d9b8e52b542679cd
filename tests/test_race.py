"""Optimizers on a bowl in place of a simulator, and the journal of their benchmark."""

import json

import jax
import numpy as np
import pytest
from lockstep import benchmark, lowest, walks
from optimizers import Bayes, CmaEs, Differences, Given, Random, steps_to

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import nominal, weights_to_vector
from hector_jax.search.cmaes import Generation, SearchConfig, log_bounds, project
from hector_jax.tuning.difftune import TuneConfig

GOAL = np.linspace(-1.0, 1.0, 18)
OPTIMIZERS = {
    "cma-es": CmaEs(SearchConfig(60, 10, seed=1, spread=0.3)),
    "bayes": Bayes(1, spread=0.3),
    "bayes near": Bayes(1, reach=1.5, spread=0.3),
    "random": Random(1, spread=0.3),
    "differences": Differences(TuneConfig()),
    "given": Given(tuple(tuple(share * GOAL) for share in np.linspace(0.1, 0.9, 12))),
}
ABOUT = {"world": "bowl"}


def loss(weights):
    return 1.0 + np.sum((steps_to(nominal(), weights) - GOAL) ** 2)


def bowl(sets):
    return {name: np.array([loss(w) for w in each]) for name, each in sets.items()}


def unasked(*_):
    raise AssertionError("asked")


def think(asked):
    return {name: (optimizer.ask(*known), 0.5) for name, (optimizer, *known) in asked.items()}


def run(folder, optimizers=OPTIMIZERS, rollouts=60, think=think, walk=bowl):
    path = folder / "race.jsonl"
    return benchmark(
        optimizers, nominal(), rollouts, propose=think, walk=walk, path=path, about=ABOUT
    )


def same(one, other):
    assert one.start == other.start
    assert one.rounds.keys() == other.rounds.keys()
    for name, rounds in one.rounds.items():
        jax.tree.map(np.testing.assert_array_equal, rounds, other.rounds[name])


@pytest.fixture(scope="module")
def raced(tmp_path_factory):
    return run(tmp_path_factory.mktemp("race"))


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_every_optimizer_goes_downhill_within_its_budget(raced, name):
    rounds = raced.rounds[name]
    assert walks(rounds) == (12 if name == "given" else 60)
    course = lowest(raced.start, rounds)
    assert len(course) == walks(rounds) + 1
    assert raced.start == course[0] == loss(nominal())
    assert course[-1] < 0.95 * course[0]


def test_a_model_of_the_losses_is_worth_more_than_chance(raced):
    best = {name: lowest(raced.start, rounds)[-1] for name, rounds in raced.rounds.items()}
    assert max(best["bayes near"], best["cma-es"]) < 0.95 * best["random"]


def test_the_same_seed_gives_the_same_race_and_another_one_another(raced, tmp_path):
    same(run(tmp_path), raced)
    start = Generation(np.zeros((1, 18)), np.ones(1))
    for make in (Random, Bayes, lambda seed: CmaEs(SearchConfig(seed=seed))):
        one, other = (make(seed).ask(nominal(), [start]) for seed in (1, 2))
        assert np.abs(one - other).max() > 0.1


def test_all_stay_in_the_box_and_treat_both_feet_alike():
    # near one corner, with a loss that falls away from it
    low, high = (np.asarray(weights_to_vector(w)) for w in bounds())
    start = project(nominal(), np.where(np.arange(18) % 2, *log_bounds(nominal()).T[::-1]) * 0.98)
    for optimizer in OPTIMIZERS.values():
        if isinstance(optimizer, Given):
            continue
        past = [Generation(np.zeros((1, 18)), np.array([50.0]))]
        for _ in range(3):
            steps = optimizer.ask(start, past)
            assert 1 <= len(steps) <= optimizer.most
            flat = np.array([weights_to_vector(project(start, step)) for step in steps])
            assert (flat >= low).all()
            assert (flat <= high).all()
            np.testing.assert_array_equal(flat[:, 12:15], flat[:, 15:18])
            assert (steps >= log_bounds(start)[:, 0] - 1e-9).all()
            assert (steps <= log_bounds(start)[:, 1] + 1e-9).all()
            past.append(Generation(steps, 50.0 - np.abs(steps).sum(axis=1) / 18))


@pytest.mark.parametrize("cut", [0, 50])
def test_a_race_that_was_cut_ends_as_if_it_had_not_been(raced, tmp_path, cut):
    optimizers = {name: OPTIMIZERS[name] for name in ("cma-es", "random", "differences", "given")}
    whole = run(tmp_path, optimizers)
    path = tmp_path / "race.jsonl"
    kept = path.read_bytes()
    lines = kept.splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:4]) + lines[4][:cut])
    same(run(tmp_path, optimizers), whole)
    assert path.read_bytes() == kept
    done = run(tmp_path, optimizers, walk=unasked)  # nothing is left to walk
    same(done, whole)
    for name, rounds in whole.rounds.items():  # nobody looks at the others
        jax.tree.map(np.testing.assert_array_equal, rounds, raced.rounds[name])


def test_a_record_of_another_race_is_refused(tmp_path):
    optimizers = {"random": Random(1)}
    run(tmp_path, optimizers, 10)
    with pytest.raises(ValueError, match="its rollouts is 10, expected 20"):
        run(tmp_path, optimizers, 20)
    (tmp_path / "race.jsonl").write_text("mine\n")
    with pytest.raises(ValueError, match="not the record of a race"):
        run(tmp_path, optimizers, 10)


def test_a_loss_without_a_number_is_the_worst_and_leaves_valid_json(tmp_path):
    def walk(sets):
        found = bowl(sets)
        return {n: np.where(x > 1.1 * loss(nominal()), np.inf, x) for n, x in found.items()}

    optimizers = {name: OPTIMIZERS[name] for name in ("bayes near", "cma-es", "differences")}
    found = run(tmp_path, optimizers, 30, walk=walk)
    lines = [json.loads(line) for line in (tmp_path / "race.jsonl").read_text().splitlines()]
    assert None in lines[2]["cma-es"]["losses"]
    same(run(tmp_path, optimizers, 30, walk=unasked), found)
    for name, rounds in found.rounds.items():
        assert lowest(found.start, rounds)[-1] < found.start, name


def test_a_start_without_a_loss_and_no_rollouts_are_refused(tmp_path):
    with pytest.raises(ValueError, match="start cannot be raced from"):
        run(tmp_path, walk=lambda sets: {name: np.array([np.nan]) for name in sets})
    with pytest.raises(ValueError, match="at least one rollout"):
        run(tmp_path, rollouts=0)


def test_differences_step_by_beta_at_most_and_halve_while_the_loss_rises():
    config = TuneConfig()
    optimizer, start = Differences(config), nominal()
    past = [Generation(np.zeros((1, 18)), np.array([5.0]))]
    around = optimizer.ask(start, past)
    np.testing.assert_allclose(around, np.log(1.05) * np.eye(18))
    past.append(Generation(around, 5.0 + np.linspace(0.1, 1.0, 18)))
    full = optimizer.ask(start, past)[0]
    np.testing.assert_allclose(full[11], np.log(1 - config.beta_q))
    np.testing.assert_allclose(full[17], np.log(1 - config.beta_r))
    assert (full < 0).all()
    past.append(Generation(full[None], np.array([6.0])))
    half = optimizer.ask(start, past)[0]
    np.testing.assert_allclose(np.exp(half) - 1, 0.5 * (np.exp(full) - 1))
    past.append(Generation(half[None], np.array([4.0])))
    np.testing.assert_allclose(optimizer.ask(start, past) - half, np.log(1.05) * np.eye(18))


def test_bayes_without_its_package_says_what_to_install(monkeypatch):
    monkeypatch.setattr("optimizers.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"hector-jax\[race\]"):
        Bayes().ask(nominal(), [Generation(np.zeros((1, 18)), np.ones(1))])
