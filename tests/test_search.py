"""CMA-ES in log-weights: tied feet, inside the box, the same by seed and after a cut."""

import json

import jax
import numpy as np
import pytest

from hector_jax.control.parameters import bounds
from hector_jax.control.weights import (
    direction_names,
    expert,
    nominal,
    scale_weights,
    weights_to_vector,
)
from hector_jax.core.inputs import InputError
from hector_jax.search.cmaes import SearchConfig, search

GOAL = np.linspace(-2.0, 2.0, 24)
CONFIG = SearchConfig(budget=60, population=10, seed=3)


def bowl(sets):
    """A stand-in for a walk: squared distance in log-weights from a goal."""
    at = np.asarray(weights_to_vector(nominal()))
    distance = lambda w: np.sum((np.log(np.asarray(weights_to_vector(w)) / at) - GOAL) ** 2)  # noqa: E731
    return {name: np.array([distance(w) for w in each]) for name, each in sets.items()}


def noted(seen):
    """The stand-in, which also notes what it is asked."""

    def walk(sets):
        seen.append(sets)
        return bowl(sets)

    return walk


def unasked(sets):
    raise AssertionError(f"walked {sets}")


def run(folder, config=CONFIG, walk=bowl, start=None, names=("s",), world="bowl"):
    starts = dict.fromkeys(names, start or nominal())
    return search(config, starts, walk, folder=folder, about={"world": world})


def same(one, other):
    assert one[1:3] == other[1:3]
    jax.tree.map(np.testing.assert_array_equal, one.weights, other.weights)
    for a, b in zip(one.history, other.history, strict=True):
        np.testing.assert_array_equal(a.steps, b.steps)
        np.testing.assert_array_equal(a.losses, b.losses)


def test_a_search_goes_downhill_and_counts_its_walks(tmp_path):
    seen = []
    found = run(tmp_path, SearchConfig(budget=1209, population=12), noted(seen))["s"]
    assert [len(sets["s"]) for sets in seen] == [12] * 100
    assert found.loss == pytest.approx(bowl({"": [found.weights]})[""][0])
    # what tied feet and directions leave: the goal's differences between the feet
    apart = np.reshape(GOAL[12:], (2, 2, 3))
    rest = np.sum((apart[:, 0] - apart[:, 1]) ** 2) / 2
    assert found.loss - rest < 0.02 * (np.sum(GOAL**2) - rest)
    assert found.stop == "the budget is spent"
    losses = np.concatenate([generation.losses for generation in found.history])
    assert losses[found.walk - 1] == found.loss == losses.min()


@pytest.mark.parametrize("cut", [0, 50])
def test_a_search_that_was_cut_ends_as_if_it_had_not_been(tmp_path, cut):
    whole, walked = run(tmp_path / "whole")["s"], []
    path = tmp_path / "cut" / "s.jsonl"
    path.parent.mkdir()
    lines = (tmp_path / "whole/s.jsonl").read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:3]) + lines[3][:cut])  # between two lines, or in one
    same(run(tmp_path / "cut", walk=noted(walked))["s"], whole)
    assert len(walked) == 4
    assert path.read_bytes() == b"".join(lines)
    same(run(tmp_path / "cut", walk=unasked)["s"], whole)  # nothing is left to walk
    small = run(tmp_path / "cut", SearchConfig(30, 10, seed=3), unasked)["s"]
    same(small, run(tmp_path / "small", SearchConfig(30, 10, seed=3))["s"])


def test_searches_in_lock_step_are_those_that_go_alone(tmp_path):
    together, walked = run(tmp_path / "both", names=("c", "s")), []
    same(together["s"], run(tmp_path / "one")["s"])
    # one record a generation behind the other
    path = tmp_path / "both/c.jsonl"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-1]))
    same(run(tmp_path / "both", walk=noted(walked), names=("c", "s"))["c"], together["c"])
    assert [list(sets) for sets in walked] == [["c"]]


def test_numbers_beside_the_weights_stay_and_belong_to_the_record(tmp_path):
    start, seen = nominal()._replace(others={"turn_lead": np.array(0.8)}), []
    found = run(tmp_path, SearchConfig(20, 10), noted(seen), start)["s"]
    asked = (*(weights for sets in seen for weights in sets["s"]), found.weights)
    assert {float(weights.others["turn_lead"]) for weights in asked} == {0.8}
    with pytest.raises(InputError, match="others"):
        run(tmp_path, SearchConfig(20, 10))


def test_what_is_asked_lies_in_the_box_and_treats_both_feet_alike(tmp_path):
    step, asked = np.zeros(18), []
    step[direction_names().index("Q_x")] = np.log(1e4 / 50.0)  # at the upper edge
    start = jax.tree.map(np.clip, scale_weights(nominal(), step), *bounds())
    low, high = (np.asarray(weights_to_vector(w)) for w in bounds())
    run(tmp_path, SearchConfig(200, 10, spread=3.0), noted(asked), start)
    seen = np.array([weights_to_vector(w) for sets in asked for w in sets["s"]])
    assert ((low <= seen) & (seen <= high)).all()
    np.testing.assert_array_equal(seen[:, 12:15], seen[:, 15:18])
    np.testing.assert_array_equal(seen[:, 18:21], seen[:, 21:24])
    assert (np.ptp(np.log(seen), axis=0) > 1.0).all()


def test_a_loss_without_a_number_is_the_worst_and_leaves_valid_json(tmp_path):
    def walk(sets):
        losses = bowl(sets)["s"]
        return {"s": np.where(losses > np.median(losses), np.nan, losses)}

    found = run(tmp_path, walk=walk)["s"]
    assert np.isfinite(found.loss)
    assert np.isinf(found.history[0].losses).sum() == 5
    lines = (tmp_path / "s.jsonl").read_text().splitlines()
    assert json.loads(lines[1])["losses"].count(None) == 5
    same(run(tmp_path, walk=unasked)["s"], found)


def test_a_record_of_another_search_or_a_damaged_one_is_refused(tmp_path):
    run(tmp_path)
    path = tmp_path / "s.jsonl"
    kept = path.read_bytes()
    for other, says in (
        (
            {"config": SearchConfig(60, 10, seed=5)},
            r"s\.jsonl: made with seed 3, this command expects 5",
        ),
        ({"start": expert()}, "made with start"),
        ({"world": "hfs"}, "made with world .bowl"),
    ):
        with pytest.raises(InputError, match=says):
            run(tmp_path, **other)
    assert path.read_bytes() == kept
    lines = kept.splitlines(keepends=True)
    damaged = {
        b"{}\n": "line 3: a row of a search was exp",
        b'{"steps": [[0]], "losses": [1]}\n': "expected",
    }
    for row, says in damaged.items():
        path.write_bytes(b"".join([*lines[:2], row, *lines[3:]]))
        with pytest.raises(InputError, match=says):
            run(tmp_path)


def test_a_start_outside_the_box_or_with_unlike_feet_is_refused(tmp_path):
    outside = nominal()
    outside.Q.euler[0] = 1e5
    with pytest.raises(ValueError, match="outside the box"):
        run(tmp_path, start=outside)
    limping = nominal()
    limping.R.force[0, 0] *= 2.0
    with pytest.raises(ValueError, match="feet share one R"):
        run(tmp_path, start=limping)
    assert list(tmp_path.iterdir()) == []
