"""The search over many plants, on a bowl in place of a simulator."""

import json
import sys
from concurrent.futures import Executor
from contextlib import nullcontext
from types import SimpleNamespace
from typing import NamedTuple

import jax
import many_plants
import numpy as np
import pytest
from many_plants import Flags, losses_of, search
from model import AHEAD, BRIEF

from hector_jax.control.weights import nominal, scale_weights, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import save_tree
from hector_jax.robot.model import load_robot
from hector_jax.sim.world import named_world
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging, metrics
from hector_jax.walk_tuning.campaign import Campaign

GOAL = scale_weights(nominal(), np.linspace(-0.5, 0.5, 18))


class Walk(NamedTuple):
    """A walk whose loss is known."""

    loss: np.ndarray
    residual: np.ndarray


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
    robot = jax.tree.map(np.asarray, load_robot(None))
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
    with pytest.raises(InputError, match="line 2 is damaged: steps"):
        search(Executor(), campaign, ENGINE, flags)
    with pytest.raises(InputError, match="record of another search: its seed is 0, expected 5"):
        search(Executor(), campaign, ENGINE, Flags(seed=5, population=12))
    single = SimpleNamespace(**vars(ENGINE) | {"bits": lambda exact: 32})
    with pytest.raises(InputError, match="its physics_bits is 64, expected 32"):
        search(Executor(), campaign, single, flags)
    monkeypatch.setattr(many_plants, "losses_of", lambda *inputs, **named: bowl(*inputs, **named))
    with pytest.raises(InputError, match="record of another search: by other code"):
        search(Executor(), campaign, ENGINE, flags)


def test_each_set_walks_all_plants_and_an_unsolved_walk_counts_as_the_worst(campaign, monkeypatch):
    monkeypatch.setattr(many_plants, "_losses", lambda loss, walks: walks.loss)

    def walk(pool, config, robot, jobs, *, exact, batch):
        del pool, config, robot, exact
        assert batch == 7
        for number, job in enumerate(jobs):
            assert job.seed == number % 2
            yield Walk(np.array(float(number)), np.array([0.0, 1.0 * (number == 3)]))

    sets = [nominal(), GOAL]
    rows = list(losses_of(None, campaign, SimpleNamespace(walk=walk), sets, 7))
    np.testing.assert_array_equal(rows, [[0.0, 1.0], [2.0, np.inf]])


def test_a_start_with_an_unsolved_qp_is_refused(campaign, monkeypatch):
    monkeypatch.setattr(many_plants, "losses_of", lambda *_, batch: iter([np.array([1.0, np.inf])]))
    with pytest.raises(InputError, match="--start: a QP of these weights is not solved"):
        search(Executor(), campaign, ENGINE, Flags(population=12))


def test_the_report_compares_the_sets_on_both_groups_of_plants(tmp_path, monkeypatch, capsys):
    def judge(setup, sets, command, plants, seeds, **notes):
        del setup, command, notes
        assert list(seeds) == list(range(100, 108))
        assert len(plants) == 8
        like, scores = metrics.score_like(), {}
        for number, name in enumerate(sets):
            L = np.where(np.arange(8) < 4, 1.0 + number, 4.0 - number)
            rows = [like._replace(losses={**like.losses, "L": x}, fallen=x > 3.0) for x in L]
            scores[name] = rows
        return SimpleNamespace(scores=scores)

    monkeypatch.setattr(judging, "judge", judge)
    monkeypatch.setattr(many_plants, "search", lambda pool, campaign, *_: campaign.start)
    monkeypatch.setattr(many_plants, "workers", lambda count: nullcontext())
    monkeypatch.setattr(sys, "argv", ["many_plants.py", "--plants", "4", "--out", str(tmp_path)])
    many_plants.main()
    path = tmp_path / "weights" / "report.md"
    assert str(path) in capsys.readouterr().out
    text = path.read_text()
    assert "on plants 100 to 103 of hfs-varied (`own`); `others` are 104 to 107." in text
    assert "| own | search | +300 [+300, +300] | +300" in text
    assert "| others | search | -75 [-75, -75] | -75 [-75, -75] | -75 [-75, -75] | 0 |" in text
    assert "| others | nominal | +0.0 [+0.0, +0.0] |" in text
    assert "| 12 |" in text
    numbers = json.loads((tmp_path / "weights" / "many-plants.json").read_text())
    assert numbers["losses"]["others search"] == [[1.0] * 4] * 3
    assert (tmp_path / "weights" / "weights.json").exists()


@pytest.mark.parametrize("name", ["plants", "generations", "population"])
def test_a_flag_that_is_too_small_is_named(name):
    with pytest.raises(InputError, match=f"Flags.{name} must be"):
        Flags(**{name: 0})
