"""The search over many plants, on a bowl in place of a simulator."""

from concurrent.futures import Executor
from types import SimpleNamespace

import jax
import many_plants
import numpy as np
import pytest
from many_plants import Flags, search
from model import AHEAD, BRIEF, ROBOT

from hector_jax.control.weights import nominal, scale_weights, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import save_tree
from hector_jax.sim.world import named_world
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.walk_tuning.campaign import Campaign

GOAL = scale_weights(nominal(), np.linspace(-0.5, 0.5, 18))


def bowl(pool, campaign, engine, sets, batch=0):
    del pool, engine, batch
    target = np.log(weights_to_vector(GOAL))
    for weights in sets:
        distance = np.sum((np.log(weights_to_vector(weights)) - target) ** 2)
        gain = sum((weights.others[name] - 0.3) ** 2 for name in weights.others)
        yield np.full(len(campaign.cases), 1.0 + distance + 10.0 * gain)


ENGINE = SimpleNamespace(name="bowl", key="bowl", modules=(), bits=lambda exact: 64)


@pytest.fixture
def campaign(tmp_path):
    robot = jax.tree.map(np.asarray, ROBOT)
    config = TuneConfig(rollout=BRIEF, others=("turn_lead",))
    plants = [named_world("hfs-varied", seed) for seed in (3, 4)]
    made = Campaign(tmp_path, config, robot, nominal(), {"short": AHEAD}, plants)
    save_tree(tmp_path / "metric.npz", {"matrix": np.eye(18)}, kind="metric", robot=robot)
    return made


def test_the_search_finds_the_bottom_and_continues_after_its_generations(campaign, monkeypatch):
    monkeypatch.setattr(many_plants, "losses_of", bowl)
    start, flags = campaign.start, Flags(generations=60, population=12)
    found = search(Executor(), campaign, ENGINE, flags)
    losses = [next(bowl(None, campaign, None, [w]))[0] for w in (start, found)]
    assert losses[1] - 1.0 < 0.05 * (losses[0] - 1.0)
    record = campaign.folder / "generations.jsonl"
    lines = record.read_bytes().splitlines(keepends=True)
    record.write_bytes(b"".join(lines[:25]))
    again = search(Executor(), campaign, ENGINE, flags)
    jax.tree.map(np.testing.assert_array_equal, again, found)
    assert record.read_bytes() == b"".join(lines)
    record.write_bytes(lines[0] + b'{"steps": [[0.0]], "losses": [1.0]}\n')
    with pytest.raises(InputError, match="line 2: a row of a search was expected .*steps"):
        search(Executor(), campaign, ENGINE, flags)
    record.unlink()
    monkeypatch.setattr(many_plants, "losses_of", lambda *_, batch: iter([np.array([1.0, np.inf])]))
    with pytest.raises(InputError, match="--start: a QP of these weights is not solved"):
        search(Executor(), campaign, ENGINE, flags)
