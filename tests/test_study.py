"""The table from flags to files, on walks that no simulator made."""

import json
from pathlib import Path

import numpy as np
import pytest
from pretend import pretend_history, pretend_walk

from hector_jax.cli import flags, study, tuning
from hector_jax.cli.flags import Table
from hector_jax.cli.parse import as_command
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.report.video import VideoUnavailable
from hector_jax.runs import pipeline
from hector_jax.runs.pipeline import Tuned
from hector_jax.search.cmaes import Found, Generation
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import Tuning


def plants(seeds):
    return [hfs()] * len(seeds)


@pytest.fixture
def asked(monkeypatch):
    """What the steps that take long were asked for; nothing is walked, tuned or drawn in 3D."""
    told = {"walks": 0, "tunings": []}

    def search(pool, config, tune, robot, starts, engine, folder):
        told["search"] = config
        generation = Generation(np.zeros((10, 18)), np.full(10, 2e6))
        one = Found(expert(), 2e6, 7, [generation] * 2, "2 generations")
        return dict.fromkeys(starts, one)

    def tunings(pool, config, robot, problems, title, on_iteration):
        told["tunings"].append((config.iterations, *problems))
        for name in problems:
            yield name, Tuning(pretend_history(12), nominal(), expert(), "done")

    def walks_of(pool, config, robot, jobs, title):
        for job in jobs:
            told["walks"] += 1
            yield pretend_walk(job.seed, 0.02, 1.0, fall_at=0.5 if job.seed == 3 else None)

    def write_strip(*args):
        raise VideoUnavailable("no film: none here")

    def tune_measured(pool, config, robot, weights, command, params, plants, folder, **notes):
        told["steps"] = config.iterations - 10, len(plants)
        return Tuned(Tuning(pretend_history(3), nominal(), expert(), "done"), "")

    class Net:
        params = None

    monkeypatch.setattr(pipeline, "ground", lambda *args: Net)
    monkeypatch.setattr(pipeline, "search", search)
    monkeypatch.setattr(pipeline, "_tunings", tunings)
    monkeypatch.setattr(pipeline, "tune_measured", tune_measured)
    monkeypatch.setattr(pipeline, "walks_of", walks_of)
    monkeypatch.setattr(study, "write_strip", write_strip)
    return told


def test_the_plants_of_the_verdict_are_asked_for_once_and_after_all_that_tunes(tmp_path, asked):
    seen = []

    def late(seeds):
        seen.append([names for _, *names in asked["tunings"]])
        assert "search" in asked
        assert asked["walks"] == 0
        return plants(seeds)

    names = ("straight", "c", "s")
    study.make_table(table(tmp_path, quick=True, trajectories=names), late)
    assert seen == [[["without", "with"]] * 3]


def table(tmp_path, **changes):
    return Table(**{"out": tmp_path / "out", "ceiling": tmp_path / "ceiling", **changes})


def test_a_quick_table_leaves_what_it_promises_beside_the_whole_one(tmp_path, asked):
    names = ("straight", "s")
    told, verdicts = study.make_table(table(tmp_path, quick=True, trajectories=names), plants)
    out = tmp_path / "out" / "quick"
    assert told == out / "report.md"
    assert tuple(verdicts) == names
    assert asked["walks"] == 2 * 8 * 4
    assert asked["search"].budget < 200
    assert [rest for _, *rest in asked["tunings"]] == [["without", "with"]] * 2
    text = told.read_text()
    assert "hector table --" in text
    assert "--quick" in text
    assert '"seeds": 4' in text  # those that were walked, not those of the whole table
    assert "16 of 64 walks ended in a fall" in text
    for name in ("changes", *names):
        assert f"(pictures/{name}.png)" in text
        assert (out / "pictures" / f"{name}.png").stat().st_size > 10_000
    result = json.loads((out / "table.json").read_text())
    assert list(result["trajectories"]["s"]["sets"]) == list(study.SETS)
    for name in ("table.csv", "table.tex"):
        assert (out / name).exists()


def test_a_ceiling_and_extra_sets_are_rows_and_cost_only_their_own_walks(
    tmp_path, asked, monkeypatch
):
    monkeypatch.setattr(study, "_draw", lambda *args: [])
    small = {"trajectories": ("s",), "seeds": 2}
    study.make_table(table(tmp_path, **small), plants)
    assert asked["walks"] == 16
    for folder in ("ceiling", "other"):
        save_weights(tmp_path / folder / "s.json", nominal())
    with pytest.raises(ValueError, match=r"s-card.json: cannot read the card of a search"):
        study.make_table(table(tmp_path, **small), plants)
    card = {"walks": 2000, "best_at": 1234, "L": {"best": 1e6}, "stop": "50 generations"}
    (tmp_path / "ceiling" / "s-card.json").write_text(json.dumps(card))
    found = table(tmp_path, **small, extra=(f"mine={tmp_path / 'other'}",))
    told, verdicts = study.make_table(found, plants)
    assert list(verdicts["s"].scores) == [*study.SETS, "ceiling", "mine"]
    assert asked["walks"] == 16 + 4
    text = told.read_text()
    assert "`with` against `ceiling`" in text
    assert "| s: `ceiling` | 2000 | 1234 | 1.000 | 50 generations |" in text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seeds": 0}, "--seeds must be a whole number from 1 to 10000, got 0"),
        ({"first_seed": -1}, "--first-seed must be a whole number from 0 to 4294967295, got -1"),
        ({"steps": -1}, "--steps must be a whole number from 0 to 10000, got -1"),
        ({"trajectories": ("turn",)}, "--trajectories must be of straight, c, s, got turn"),
        ({"iterations": 3}, "--iterations must be a whole number from 10 to 10000, got 3"),
        ({"rollouts": 3}, "budget must be at least the population"),
        ({"trajectories": ("moon",)}, "--trajectories must be of straight, c, s, got moon"),
        ({"trajectories": ("s", "s")}, "--trajectories names 's' twice"),
        ({"trajectories": ()}, "--trajectories expects a value, got none"),
        ({"extra": ("mine",)}, "--extra must be NAME=FOLDER.*got mine"),
        ({"extra": ("my set=x",)}, "--extra must be NAME=FOLDER.*got my set=x"),
        ({"extra": ("with=x",)}, "--extra with=x: there is a set 'with' already"),
        ({"extra": ("a=x", "a=y")}, "--extra a=y: there is a set 'a' already"),
        ({"extra": ("a=nowhere",)}, "nowhere/straight.json: cannot read weights"),
        ({"earlier": Path("nowhere.json")}, "nowhere.json: cannot read a table.json"),
        ({"processes": 0}, "--processes must be a whole number from 1 to 1024, got 0"),
    ],
)
def test_wrong_flags_are_told_before_anything_is_computed(tmp_path, changes, words):
    with pytest.raises(ValueError, match=words):
        study.make_table(table(tmp_path, **changes), plants)


def test_the_line_that_asks_again_names_what_is_not_default():
    assert as_command("table", Table()) == "hector table"
    asked = Table(seeds=4, extra=("a=x", "b=y"), quick=True)
    assert as_command("table", asked) == "hector table --seeds 4 --extra a=x b=y --quick"
    assert as_command("tune", flags.Tune(video=False)) == "hector tune --no-video"


def test_runs_of_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    """Also those that look at the same moment and find nothing there."""

    class Clock(tuning.datetime):
        @classmethod
        def now(cls):
            return cls(2026, 11, 21, 9, 34, 59)

    begun = []
    monkeypatch.setattr(tuning, "datetime", Clock)
    monkeypatch.setattr(tuning, "_tune_in", lambda folder, args: begun.append(folder))
    for _ in range(3):
        tuning.tune(flags.Tune(traj="s", runs=tmp_path))
    assert [folder.name for folder in begun] == [
        "20261121-093459",
        "20261121-093500",
        "20261121-093501",
    ]


def test_all_trajectories_are_tuned_one_after_the_other(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(tuning, "_tune_in", lambda folder, args: asked.append((folder, args)))
    tuning.tune(flags.Tune(traj="all", run=tmp_path / "run", seeds=2))
    assert [one.traj for _, one in asked] == ["straight", "c", "s"]
    assert [folder.name for folder, _ in asked] == ["straight", "c", "s"]
    assert {one.seeds for _, one in asked} == {2}
    tuning.tune(flags.Tune(traj="all", resume=tmp_path / "run"))
    assert [one.seeds for _, one in asked[3:]] == [2, 2, 2]
    tuning.tune(flags.Tune(traj="all", runs=tmp_path / "runs"))
    assert [folder.parent.name for folder, _ in asked[6:]] == ["straight", "c", "s"]
