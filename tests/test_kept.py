"""What is kept is taken up, and only where the same is asked."""

import json
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from model import ROBOT
from pretend import instead, pretend_history, pretend_walk, tuning_of

from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.core.inputs import InputError
from hector_jax.core.journal import add_row
from hector_jax.sim.world import hfs, ideal
from hector_jax.store import tunings
from hector_jax.store.run import as_row
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging

CONFIG, S = TuneConfig(), named_command("s")
SETUP = Setup(ThreadPoolExecutor(1), CONFIG, ROBOT)  # which is never asked
TUNING = tuning_of(pretend_history(12, refused=(3, 5)), expert())
SETS = {"nominal": nominal(), "expert": expert()}


def same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.fixture
def tuned(monkeypatch):
    """Names of the problems that are really tuned."""
    names = []

    def side_by_side(setup, start, problems, title, on_iteration):
        for name in problems:
            names.append(name)
            for iteration in TUNING.iterations:
                on_iteration(name, iteration)
            yield name, TUNING

    instead(monkeypatch, tunings, "_tunings", side_by_side)
    return names


@pytest.fixture
def walked(monkeypatch):
    """Seeds of the walks that are really walked; 2 falls, and a QP of 4 is not solved."""
    seeds = []

    def walks_of(setup, jobs, title, engine):
        for job in jobs:
            seeds.append(job.seed)
            error, fall_at = float(job.weights.Q.euler[0]) / 1e4, 0.5 if job.seed == 2 else None
            walk = pretend_walk(job.seed, error, 1.0, fall_at=fall_at)
            yield walk._replace(residual=walk.residual + (np.nan if job.seed == 4 else 0.0))

    instead(monkeypatch, judging, "walk_jobs", walks_of)
    return seeds


def judge(folder, sets, seeds=(0, 1, 2), plant=hfs):
    plants = [plant()] * len(seeds)
    return judging.judge(SETUP, sets, {"s": S}, plants, seeds, title="", folder=folder)


def test_a_tuning_comes_back_as_it_was_and_is_made_again_for_another_problem(tmp_path, tuned):
    def tune(config=CONFIG, command=S, start=None):
        problems = {"without": Problem((command,), None)}
        setup = SETUP._replace(config=config)
        return tunings.tune_all(setup, problems, tmp_path, title="", start=start)["without"]

    for _ in range(2):  # as tuned, and as kept
        same(tune(), TUNING)
    assert tuned == ["without"]
    tune(TuneConfig(iterations=20))
    tune(command=named_command("c"))
    tune(start=expert())
    assert len(tuned) == 4


def test_metrics_of_a_run_that_was_cut_are_those_of_an_uncut_one(tmp_path, tuned):
    """Of two tunings one had ended; the lines that the other had written come once."""
    problems = {"without": Problem((S,), None), "with": Problem((named_command("c"),), None)}

    def lines(folder, problems):
        folder.mkdir(exist_ok=True)
        tunings.tune_all(SETUP, problems, folder, title="", metrics=folder / "metrics.jsonl")
        return (folder / "metrics.jsonl").read_text()

    whole = lines(tmp_path / "whole", problems)
    half = lines(tmp_path / "cut", {"with": problems["with"]})
    add_row(tmp_path / "cut" / "metrics.jsonl", as_row("without", TUNING.iterations[0]))
    assert lines(tmp_path / "cut", problems) == whole
    assert whole.endswith(half)
    assert tuned == ["without", "with", "with", "without"]


def test_walks_that_are_kept_are_not_walked_again(tmp_path, walked):
    first, second = judge(tmp_path, SETS), judge(tmp_path, SETS)
    assert len(walked) == 6
    same(*([w[:2] for w in one.walks.values()] for one in (first, second)))
    same(first.first("s"), second.first("s"))
    judge(tmp_path, SETS | {"mine": nominal()}, seeds=(0, 1, 2, 3))
    assert sorted(walked[6:]) == [0, 1, 2, 3, 3, 3]
    judge(tmp_path, {"nominal": expert()})
    judge(tmp_path, {"nominal": nominal()}, plant=ideal)
    assert len(walked) == 18


def test_a_fall_is_kept_and_a_walk_with_an_unsolved_qp_is_said(tmp_path, walked, capsys):
    for _ in range(2):  # as walked, and as kept
        walk = judge(tmp_path, {"mine": nominal()}, seeds=(0, 2, 4)).walks["s", "mine", 2]
        assert walk.score.fallen
        assert walk.upright == pytest.approx(0.5)
        said = " ".join(capsys.readouterr().err.split())
        assert "mine: at least one QP of its walks was not solved (residual nan)" in said
    judge(tmp_path, {"mine": nominal()}, seeds=(0,))
    assert capsys.readouterr().err == ""


def test_a_torn_row_of_the_table_is_walked_again_and_a_damaged_one_is_named(tmp_path, walked):
    judge(tmp_path, SETS)
    table, rows = tmp_path / judging.TABLE, len(SETS) * 3
    whole = table.read_bytes()
    table.write_bytes(whole[:-20])
    judge(tmp_path, SETS)
    assert len(walked) == rows + 1
    assert [json.loads(line) for line in table.read_text().splitlines()][-1]["seed"] == 2
    assert sorted(table.read_bytes().splitlines()) == sorted(whole.splitlines())
    table.write_bytes(whole.replace(b'"fallen"', b'"fell"', 1))
    with pytest.raises(InputError, match=r"walks.jsonl, line 1: a row of the table of walks was"):
        judge(tmp_path, SETS)
