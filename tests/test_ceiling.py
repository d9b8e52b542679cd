"""The search over many plants, on a bowl in place of a simulator."""

import json
import sys
from concurrent.futures import Executor
from contextlib import nullcontext
from types import SimpleNamespace

import ceiling
import jax
import numpy as np
import pytest
from ceiling import Flags, Walked, changes, search, walk_sets
from model import AHEAD, BRIEF

from hector_jax.control.weights import nominal, scale_weights, weights_to_vector
from hector_jax.core.inputs import InputError
from hector_jax.core.tree_file import save_tree
from hector_jax.robot.model import load_robot
from hector_jax.runs.walks import Campaign
from hector_jax.sim.world import named_world
from hector_jax.tuning.difftune import TuneConfig

GOAL = scale_weights(nominal(), np.linspace(-0.5, 0.5, 18))


def bowl(pool, campaign, engine, sets):
    del pool, engine
    target = np.log(weights_to_vector(GOAL))
    for weights in sets:
        distance = np.sum((np.log(weights_to_vector(weights)) - target) ** 2)
        gain = sum((weights.others[name] - 0.3) ** 2 for name in weights.others)
        losses = np.full(len(campaign.cases), 1.0 + distance + 10.0 * gain)
        yield Walked(losses, losses < 0.0)


ENGINE = SimpleNamespace(name="bowl", modules=())


@pytest.fixture
def campaign(tmp_path):
    robot = jax.tree.map(np.asarray, load_robot(None))
    config = TuneConfig(rollout=BRIEF, others=("turn_lead",))
    plants = [named_world("hfs-varied", seed) for seed in (3, 4)]
    made = Campaign(tmp_path, config, robot, nominal(), {"short": AHEAD}, plants)
    save_tree(tmp_path / "metric.npz", {"matrix": np.eye(18)}, kind="metric", robot=robot)
    return made


def test_the_search_finds_the_bottom_and_continues_after_its_generations(campaign, monkeypatch):
    monkeypatch.setattr(ceiling, "walk_sets", bowl)
    start, flags = campaign.start, Flags(generations=60, population=12)
    found = search(Executor(), campaign, ENGINE, flags)
    losses = [next(bowl(None, campaign, None, [w])).losses[0] for w in (start, found)]
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


def test_each_set_walks_all_plants_and_an_unsolved_walk_counts_as_the_worst(campaign, monkeypatch):
    monkeypatch.setattr(ceiling, "loss_of", lambda loss, walk: walk.loss)

    def walk(pool, config, robot, jobs, *, exact):
        del pool, config, robot, exact
        for number, job in enumerate(jobs):
            assert job.seed == number % 2
            residual, fallen = np.array([0.0, 1.0 * (number == 3)]), np.array([number == 1])
            yield SimpleNamespace(loss=number, residual=residual, fallen=fallen)

    sets = [nominal(), GOAL]
    rows = list(walk_sets(None, campaign, SimpleNamespace(walk=walk), sets))
    np.testing.assert_array_equal([row.losses for row in rows], [[0.0, 1.0], [2.0, np.inf]])
    np.testing.assert_array_equal([row.fallen for row in rows], [[False, True], [False, False]])


def test_a_start_with_an_unsolved_qp_is_refused(campaign, monkeypatch):
    unsolved = Walked(np.array([1.0, np.inf]), np.array([False, False]))
    monkeypatch.setattr(ceiling, "walk_sets", lambda *_: iter([unsolved]))
    with pytest.raises(InputError, match="--start: a QP of these weights is not solved"):
        search(Executor(), campaign, ENGINE, Flags(population=12))


def test_changes_are_medians_over_plants_of_each_command():
    baseline = np.full((5, 2), 2.0)
    losses = np.array([[1.0, 2.0]] * 5)
    assert changes(baseline, losses) == ["-50 [-50, -50]", "+0 [+0, +0]"]


def test_the_report_compares_the_sets_on_both_groups_of_plants(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ceiling, "walk_sets", bowl)
    monkeypatch.setattr(ceiling, "search", lambda pool, campaign, *_: campaign.start)
    monkeypatch.setattr(ceiling, "workers", lambda count: nullcontext())
    monkeypatch.setattr(sys, "argv", ["ceiling.py", "--plants", "4", "--out", str(tmp_path)])
    ceiling.main()
    path = tmp_path / "weights" / "report.md"
    assert str(path) in capsys.readouterr().out
    text = path.read_text()
    assert "on plants 100 to 103 of hfs-varied; `others` are 104 to 107." in text
    assert text.count("| nominal | +0 [+0, +0] |") == 2
    numbers = json.loads((tmp_path / "weights" / "ceiling.json").read_text())
    assert np.shape(numbers["losses"]["others found"]) == (4, 3)
    assert (tmp_path / "weights" / "weights.json").exists()


@pytest.mark.parametrize("name", ["plants", "generations", "population"])
def test_a_flag_that_is_too_small_is_named(name):
    with pytest.raises(InputError, match=f"Flags.{name} must be"):
        Flags(**{name: 0})
