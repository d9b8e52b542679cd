"""The table from flags to files, on walks that no simulator made."""

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import table as study
import table_plots
import table_steps
from pretend import pretend_tuning, pretend_walk
from table import Flags

from hector_jax.cli import flags, run_folder, tune
from hector_jax.cli.parse import as_command
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.inputs import InputError
from hector_jax.report.video import VideoUnavailable
from hector_jax.robot.model import load_robot
from hector_jax.search.cmaes import Generation, SearchResult
from hector_jax.sim.world import hfs
from hector_jax.store import nets, tunings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Tuned
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.verdict import judging
from hector_jax.walk_tuning import searches


def plants(seeds):
    return [hfs()] * len(seeds)


@pytest.fixture
def asked(monkeypatch):
    """What the steps that take long were asked for; nothing is walked, tuned or drawn in 3D."""
    told = {"walks": 0, "tunings": []}

    def search(setup, config, start, *, commands, engine, folder):
        told["search"] = config
        generation = Generation(np.zeros((10, 18)), np.full(10, 2e6))
        one = SearchResult(expert(), 2e6, 7, [generation] * 2, "2 generations")
        return dict.fromkeys(commands, one)

    def side_by_side(setup, start, problems, title, on_iteration):
        told["tunings"].append((setup.config.iterations, *problems))
        for name in problems:
            yield name, Tuned(pretend_tuning(12, expert()), "")

    def walks_of(setup, jobs, title, engine):
        for job in jobs:
            told["walks"] += 1
            yield pretend_walk(job.seed, 0.02, 1.0, fall_at=0.5 if job.seed == 3 else None)

    def write_strip(*args):
        raise VideoUnavailable("no film: none here")

    def tune_along_walks(bench, name, start, steps, plants):
        return Tuned(pretend_tuning(3, expert()), "")

    class Net:
        params = None

    monkeypatch.setattr(nets, "load_or_train", lambda *args: Net)
    monkeypatch.setattr(searches, "search_all", search)
    monkeypatch.setattr(tunings, "_tunings", side_by_side)
    monkeypatch.setattr(table_steps, "tune_along_walks", tune_along_walks)
    monkeypatch.setattr(judging, "walk_jobs", walks_of)
    monkeypatch.setattr(table_plots, "write_strip", write_strip)
    return told


def test_the_plants_of_the_verdict_are_asked_for_once_and_after_all_that_tunes(
    tmp_path, asked, monkeypatch
):
    seen = []
    monkeypatch.setattr(study, "draw", lambda *args: [])

    def late(seeds):
        seen.append([names for _, *names in asked["tunings"]])
        assert "search" in asked
        assert asked["walks"] == 0
        return plants(seeds)

    names = ("straight", "c", "s")
    study.make_table(table(tmp_path, quick=True, trajectories=names), late)
    assert seen == [[["without", "with"], ["paper"]] * 3]


def table(tmp_path, **changes):
    return Flags(**{"out": tmp_path / "out", "search_2000": tmp_path / "search_2000", **changes})


def test_a_quick_table_leaves_what_it_promises_beside_the_whole_one(tmp_path, asked):
    names = ("straight", "s")
    told, verdicts = study.make_table(table(tmp_path, quick=True, trajectories=names), plants)
    out = tmp_path / "out" / "quick"
    assert told == out / "report.md"
    assert tuple(verdicts) == names
    assert asked["walks"] == 2 * 7 * 4
    assert asked["search"].budget < 200
    assert asked["tunings"] == [(4, "without", "with"), (10, "paper")] * 2
    text = told.read_text()
    assert "python experiments/table.py --" in text
    assert "--quick" in text
    assert '"seeds": 4' in text  # those that were walked, not those of the whole table
    assert "14 of 56 walks ended in a fall" in text
    for name in ("changes", *names):
        assert f"(pictures/{name}.png)" in text
        assert (out / "pictures" / f"{name}.png").stat().st_size > 10_000
    result = json.loads((out / "table.json").read_text())
    assert list(result["trajectories"]["s"]["sets"]) == list(study.SETS)
    for name in ("table.csv", "table.tex"):
        assert (out / name).exists()
    assert {path.parent.name for path in out.glob("weights/*/s.json")} == set(study.SETS)


def test_a_long_search_and_extra_sets_are_rows_and_cost_only_their_own_walks(
    tmp_path, asked, monkeypatch
):
    monkeypatch.setattr(study, "draw", lambda *args: [])
    small = {"trajectories": ("s",), "seeds": 2}
    study.make_table(table(tmp_path, **small), plants)
    assert asked["walks"] == 14
    for folder in ("search_2000", "other"):
        save_weights(tmp_path / folder / "s.json", nominal())
    with pytest.raises(ValueError, match=r"s-card.json: cannot read the card of a search"):
        study.make_table(table(tmp_path, **small), plants)
    card = {"walks": 2000, "best_at": 1234, "L": {"best": 1e6}, "stop": "50 generations"}
    (tmp_path / "search_2000" / "s-card.json").write_text(json.dumps(card))
    found = table(tmp_path, **small, extra=(f"mine={tmp_path / 'other'}",))
    told, verdicts = study.make_table(found, plants)
    assert list(verdicts["s"].scores) == [*study.SETS, "search_2000", "mine"]
    assert asked["walks"] == 14 + 4
    text = told.read_text()
    assert "`with` against `search_2000`" in text
    assert "| s: `search_2000` | 2000 | 1234 | 1.000 | 50 generations |" in text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"seeds": 0}, "--seeds must be a whole number from 1 to 10000, got 0"),
        ({"first_seed": -1}, "--first-seed must be a whole number from 0 to 4294967295, got -1"),
        ({"steps": -1}, "--steps must be a whole number from 0 to 10000, got -1"),
        ({"trajectories": ("turn",)}, "--trajectories must be of straight, c, s, got turn"),
        ({"iterations": 0}, "--iterations must be a whole number from 1 to 10000, got 0"),
        ({"rollouts": 3}, "--rollouts must be a whole number from 10 to 1000000, got 3"),
        ({"step_plants": 0}, "--step-plants must be a whole number from 1 to 1000, got 0"),
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


def test_a_tuning_along_walks_is_stored_for_its_plants_and_steps(tmp_path, monkeypatch):
    made = []

    def tune_measured(config, start, evaluate, on_iteration):
        made.append(config.iterations)
        return pretend_tuning(3, expert())

    monkeypatch.setattr(table_steps, "tune_measured", tune_measured)
    monkeypatch.setattr(table_steps, "function_id", repr)  # `made` would be of the content
    bench = table_steps.Bench(Setup(None, TuneConfig(), load_robot(), "abc"), None, tmp_path)
    for steps, count in ((2, 3), (2, 3), (5, 3), (2, 4)):
        tuned = table_steps.tune_along_walks(bench, "s", nominal(), steps, count)
        assert tuned.commit == "abc"
        assert len(tuned.tuning.iterations) == 4
    assert made == [2, 5, 2]
    assert len(list((tmp_path / "s").glob("tuning-walks-*.npz"))) == 3


@pytest.mark.parametrize("field", [x for x in fields(Flags) if type(x.default) is int])
def test_every_number_has_an_upper_bound_that_is_told(tmp_path, field):
    rule = get_args(field.type)[1]
    with pytest.raises(InputError, match=f"from {rule.low} to {rule.high}, got 1000000000000"):
        study.make_table(table(tmp_path, **{field.name: 10**12}), plants)


def test_the_line_that_asks_again_names_what_is_not_default():
    assert as_command(study.PROGRAM, Flags()) == "python experiments/table.py"
    line = as_command(study.PROGRAM, Flags(seeds=4, extra=("a=x", "b=y"), quick=True))
    assert line == "python experiments/table.py --seeds 4 --extra a=x b=y --quick"
    assert as_command("hector tune", flags.Tune(video=False)) == "hector tune --no-video"


def test_runs_of_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    """Also those that look at the same moment and find nothing there."""

    class Clock(run_folder.datetime):
        @classmethod
        def now(cls):
            return cls(2026, 11, 21, 9, 34, 59)

    begun = []
    monkeypatch.setattr(run_folder, "datetime", Clock)
    monkeypatch.setattr(tune, "_tune_in", lambda folder, args: begun.append(folder))
    for _ in range(3):
        tune.tune(flags.Tune(traj=("s",), runs=tmp_path))
    assert [folder.name for folder in begun] == [
        "20261121-093459",
        "20261121-093500",
        "20261121-093501",
    ]


def test_all_trajectories_are_tuned_one_after_the_other(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(tune, "_tune_in", lambda folder, args: asked.append((folder, args)))
    every = flags.Tune(traj=("all",), each=True)
    tune.tune(replace(every, out=tmp_path / "run", seeds=2))
    assert [one.traj for _, one in asked] == [("straight",), ("c",), ("s",)]
    assert [folder.name for folder, _ in asked] == ["straight", "c", "s"]
    assert {one.seeds for _, one in asked} == {2}
    tune.tune(replace(every, resume=tmp_path / "run"))
    assert [one.seeds for _, one in asked[3:]] == [2, 2, 2]
    with pytest.raises(InputError, match="run: its trajectories were tuned one by one; add --each"):
        tune.tune(flags.Tune(traj=("all",), resume=tmp_path / "run"))
    tune.tune(replace(every, runs=tmp_path / "runs"))
    assert [folder.parent.name for folder, _ in asked[6:]] == ["straight", "c", "s"]


def test_several_trajectories_are_one_run(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(tune, "_tune_in", lambda folder, args: asked.append((folder, args)))
    tune.tune(flags.Tune(traj=("all",), runs=tmp_path, seeds=2))
    tune.tune(flags.Tune(traj=("c", "all"), out=tmp_path / "out"))
    tune.tune(flags.Tune(resume=tmp_path / "out"))
    (auto, first), (named, second), again = asked
    assert auto.parent == tmp_path / "straight-c-s"
    assert first.traj == ("straight", "c", "s")
    assert named == tmp_path / "out"
    assert second.traj == ("c", "straight", "s")
    assert again[1].traj == second.traj
    begun = json.loads((auto / "config.json").read_text())["flags"]
    assert begun["traj"] == ["straight", "c", "s"]
    assert begun["out"] is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"resume": Path("a"), "out": Path("b")}, "--out b and --resume a: only one can be given"),
        ({"traj": ("c", "short.toml")}, "of one length, got c 4 s, short 2 s; add --each"),
        ({"traj": ("short.toml", "./short.toml")}, "short.toml and ./short.toml are both named s"),
        ({"traj": ("short.toml", "./short.toml"), "each": True}, "are both named short"),
    ],
)
def test_what_one_set_cannot_be_tuned_for_is_one_line(tmp_path, monkeypatch, changes, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tune, "_tune_in", lambda folder, args: None)
    Path("short.toml").write_text('name = "short"\n[[segment]]\nseconds = 2.0\nv_x = 0.2\n')
    with pytest.raises(InputError, match=message):
        tune.tune(flags.Tune(**changes))
    assert [path.name for path in tmp_path.iterdir()] == ["short.toml"]


def test_each_trajectory_of_a_file_has_a_folder_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = []
    monkeypatch.setattr(tune, "_tune_in", lambda folder, args: asked.append((folder, args)))
    path = tmp_path / "files" / "mine.toml"
    path.parent.mkdir()
    path.write_text('name = "short"\n[[segment]]\nseconds = 2.0\nv_x = 0.2\n')
    several = flags.Tune(traj=("c", str(path)), each=True)
    tune.tune(replace(several, out=Path("out")))
    assert [folder for folder, _ in asked] == [Path("out/c"), Path("out/short")]
    tune.tune(replace(several, resume=Path("out")))
    assert [folder for folder, _ in asked[2:]] == [Path("out/c"), Path("out/short")]
    with pytest.raises(InputError, match="out: its trajectories were tuned one by one; add --each"):
        tune.tune(flags.Tune(traj=(str(path),), resume=Path("out")))
