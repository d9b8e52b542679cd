"""What is kept is taken up, and only where the same is asked."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from pretend import instead, pretend_history, pretend_walk, tuning_of

from hector_jax.control.parameters import bounds
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert, nominal
from hector_jax.robot.model import load_robot
from hector_jax.sim.world import hfs, ideal
from hector_jax.store import tunings
from hector_jax.store.folder import as_line
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Problem, Tuned
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging

ROBOT, CONFIG, S = load_robot(), TuneConfig(), named_command("s")
POOL = ThreadPoolExecutor(1)  # never asked
TUNING = tuning_of(pretend_history(12, refused=(3, 5)), expert())


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
            yield name, Tuned(TUNING, setup.commit)

    instead(monkeypatch, tunings, "_tunings", side_by_side)
    return names


@pytest.fixture
def walked(monkeypatch):
    """Seeds of the walks that are really walked; `cut` many walks at most."""
    seeds = []

    def walks_of(setup, jobs, title, engine):
        for job in jobs:
            if len(seeds) == walks_of.cut:
                raise KeyboardInterrupt
            seeds.append(job.seed)
            fall_at = 0.5 if job.seed == 2 else None
            yield pretend_walk(job.seed, float(job.weights.Q.euler[0]) / 1e4, 1.0, fall_at=fall_at)

    walks_of.cut = None
    instead(monkeypatch, judging, "walk_jobs", walks_of)
    return seeds, walks_of


def tune(folder, config=CONFIG, command=S, start=None):
    problems = {"without": Problem((command,), None)}
    setup = Setup(POOL, config, ROBOT, "abc")
    return tunings.tune_all(setup, problems, folder, title="", start=start)["without"]


def judge(folder, sets, seeds=(0, 1, 2), plant=None, commit="abc"):
    plants = [plant or hfs()] * len(seeds)
    setup = Setup(POOL, CONFIG, ROBOT, commit)
    return judging.judge(setup, sets, S, plants, seeds, title="", folder=folder)


def test_a_tuning_comes_back_as_it_was(tmp_path, tuned):
    for _ in range(2):  # as tuned, and as kept
        back, commit = tune(tmp_path)
        assert commit == "abc"
        same(back, TUNING)
        lines, expected = ([as_line("a", i) for i in t.iterations] for t in (back, TUNING))
        assert lines == expected
        refused = [int(i.iteration) for i in back.iterations if i.reason]
        assert refused == [int(i.iteration) for i in back.iterations if not i.accepted] == [3, 5]
    assert tuned == ["without"]


def test_metrics_of_a_run_that_was_cut_are_those_of_an_uncut_one(tmp_path, tuned):
    """Of two tunings one had ended; the lines that the other had written come once."""
    problems = {"without": Problem((S,), None), "with": Problem((named_command("c"),), None)}

    def lines(folder, problems):
        folder.mkdir(exist_ok=True)
        setup = Setup(POOL, CONFIG, ROBOT)
        tunings.tune_all(setup, problems, folder, title="", metrics=folder / "metrics.jsonl")
        return (folder / "metrics.jsonl").read_text()

    whole = lines(tmp_path / "whole", problems)
    half = lines(tmp_path / "cut", {"with": problems["with"]})
    with (tmp_path / "cut" / "metrics.jsonl").open("a") as file:
        file.write(as_line("without", TUNING.iterations[0]))
    assert lines(tmp_path / "cut", problems) == whole
    assert whole.endswith(half)
    assert tuned == ["without", "with", "with", "without"]


def test_a_tuning_is_made_once_and_again_for_other_settings(tmp_path, tuned):
    first, second = tune(tmp_path), tune(tmp_path)
    assert tuned == ["without"]
    same(first.tuning.weights, second.tuning.weights)
    tune(tmp_path, TuneConfig(iterations=20))
    tune(tmp_path, command=named_command("c"))
    tune(tmp_path, start=expert())
    assert len(tuned) == 4


def test_walks_that_are_kept_are_not_walked_again(tmp_path, walked):
    seeds, _ = walked
    sets = {"nominal": nominal(), "expert": expert()}
    first, second = judge(tmp_path, sets), judge(tmp_path, sets, commit="def")
    assert len(seeds) == 6
    same([w[:3] for w in first.walks["expert"]], [w[:3] for w in second.walks["expert"]])
    same(first.first, second.first)
    assert {w.commit for w in second.walks["nominal"]} == {"abc"}
    more = judge(tmp_path, sets | {"mine": bounds()[1]}, seeds=(0, 1, 2, 3), commit="def")
    assert sorted(seeds[6:]) == [0, 1, 2, 3, 3, 3]
    assert [w.commit for w in more.walks["nominal"]] == ["abc"] * 3 + ["def"]


def test_a_cut_judging_goes_on_where_it_was(tmp_path, walked):
    seeds, walks_of = walked
    sets = {"nominal": nominal(), "expert": expert()}
    walks_of.cut = 4
    with pytest.raises(KeyboardInterrupt):
        judge(tmp_path / "cut", sets)
    walks_of.cut = None
    resumed = judge(tmp_path / "cut", sets)
    assert len(seeds) == 6
    at_once = judge(tmp_path / "whole", sets)
    same([w[:3] for w in resumed.walks["expert"]], [w[:3] for w in at_once.walks["expert"]])


def test_another_plant_or_other_weights_are_walked(tmp_path, walked):
    seeds, _ = walked
    judge(tmp_path, {"mine": nominal()})
    judge(tmp_path, {"mine": expert()})
    judge(tmp_path, {"mine": nominal()}, plant=ideal())
    assert len(seeds) == 9


def test_a_fall_is_kept_with_its_time_and_last_state(tmp_path, walked):
    for _ in range(2):  # as walked, and as kept
        walk = judge(tmp_path, {"mine": nominal()}).walks["mine"][2]
        assert walk.score.fallen
        assert float(walk.upright) == pytest.approx(0.5)
        assert np.isfinite(np.concatenate(walk.last)).all()


@pytest.mark.parametrize("residual", [1.0, np.nan])
def test_a_walk_with_an_unsolved_qp_is_said(tmp_path, monkeypatch, capsys, residual):
    def walks_of(setup, jobs, title, engine):
        for job in jobs:
            walk = pretend_walk(job.seed, 0.03, 1.0)
            yield walk._replace(residual=np.where(job.seed == 1, residual, walk.residual))

    instead(monkeypatch, judging, "walk_jobs", walks_of)
    for _ in range(2):  # as walked, and as kept
        judge(tmp_path, {"mine": nominal()})
        said = " ".join(capsys.readouterr().err.split())
        assert (
            f"mine: at least one QP of its walks was not solved (residual {residual:.0e})" in said
        )
    judge(tmp_path, {"mine": nominal()}, seeds=(0,))
    assert capsys.readouterr().err == ""
