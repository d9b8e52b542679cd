"""CMA-ES as the experiments use it, on a bowl in the place of walks."""

from dataclasses import replace
from functools import partial

import many_plants
import numpy as np
import pytest
import race
from rivals import RIVALS, Task, search

from hector_jax import InputError, TuneConfig, hfs, load_robot, named_command, nominal
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.walk_tuning.campaign import Campaign

BOX = np.array([[-3.0, 1.0]] * 6)
GOAL = np.linspace(-2.0, 2.0, 6)  # partly beyond the box


def bowl(point):
    return np.sum((point - GOAL) ** 2) - np.sum(GOAL**2)


def test_cma_es_goes_downhill_inside_the_box():
    seen, losses = search(RIVALS["cma-es"], Task(bowl, bowl, BOX, 1.0, 3), 600)
    assert len(seen) == len(losses) == 600
    assert ((BOX[:, 0] <= seen) & (seen <= BOX[:, 1])).all()
    np.testing.assert_allclose(seen[-1], np.clip(GOAL, *BOX.T), atol=0.1)


def test_a_fall_is_worse_than_all_before_it_and_the_best_so_far_passes_over_falls_and_an_end():
    falling = lambda point: np.inf if point[0] < 0.0 else bowl(point)  # noqa: E731
    seen, losses = search(RIVALS["random"], Task(falling, bowl, BOX, 1.0, 3), 20)
    falls = np.flatnonzero(seen[:, 0] < 0.0)
    assert len(falls) > 5
    assert [losses[fall] for fall in falls] == [losses[:fall].max() + 1.0 for fall in falls]
    losses = np.array([[6.0, np.inf, 5.0, 7.0, 4.0], [6.0, 5.0, 3.0, np.nan, np.nan]])
    own = {1: [6.0, 6.0], 2: [6.0, 5.0], 5: [4.0, 3.0]}
    assert race.entry(losses) == {"own": own, "falls": [1, 0]}


def test_a_search_over_plants_that_was_cut_ends_as_if_it_had_not_been(monkeypatch, tmp_path):
    robot, walked = load_robot(), []
    inputs = tmp_path, TuneConfig(), robot, nominal(robot), {"s": named_command("s")}, [hfs()]
    campaign = Campaign(*inputs)

    def losses_of(pool, campaign, engine, sets, batch):
        walked.append(len(sets))
        for weights in sets:
            loss = 1.0 + np.log(weights.Q.euler[0] / campaign.start.Q.euler[0] / 2.0) ** 2
            yield np.array([loss if loss < 1.6 else np.inf])  # a QP that was not solved

    monkeypatch.setattr(many_plants, "losses_of", losses_of)
    flags = many_plants.Flags(generations=12, population=8)
    search = partial(many_plants.search, None, campaign, MUJOCO_C)
    whole, path = search(flags), tmp_path / "generations.jsonl"
    assert walked == [1, *[8] * 12]  # the start, then the generations
    assert whole.Q.euler[0] > 1.2 * campaign.start.Q.euler[0]
    lines = path.read_bytes().splitlines(keepends=True)
    assert b"null" in b"".join(lines)
    path.write_bytes(b"".join(lines[:9]) + lines[9][:50])
    walked.clear()
    np.testing.assert_array_equal(search(flags).Q.euler, whole.Q.euler)
    assert (walked, path.read_bytes()) == ([1, *[8] * 4], b"".join(lines))
    path.write_bytes(b"".join([*lines[:2], b'{"steps": [[0]], "losses": [1]}\n']))
    for other, told in ((flags, "line 3"), (replace(flags, seed=5), "made with seed 0")):
        walked.clear()  # the record knows its functions with all that they hold
        with pytest.raises(InputError, match=told):
            search(other)
