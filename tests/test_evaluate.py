"""Weight sets in engines and models, and finished runs side by side: counts, claims, commands."""

import json
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import ROBOT
from pretend import call, instead, pretend_history, pretend_score, pretend_walk, refused

from hector_jax import PAPER_LOSS, InputError, expert, nominal
from hector_jax.cli import evaluate as command
from hector_jax.cli.flags import Evaluate, Tune
from hector_jax.cli.parse import as_table
from hector_jax.control.weights_file import save_weights
from hector_jax.core.files import write_json
from hector_jax.core.journal import write_rows
from hector_jax.report import matrix as report
from hector_jax.report.compare import compare_runs
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.sim.standin import even, standin
from hector_jax.store.run import Run, as_row
from hector_jax.verdict import judging, matrix
from hector_jax.verdict.matrix import Column
from hector_jax.verdict.metrics import make_verdict
from hector_jax.verdict.stopping import StoppingRule

C, DRAKE, HEAVY = Column("c", "own"), Column("drake", "own"), Column("c", "heavy")
SETS = ("nominal", "expert", "with")


def scaled(factor):
    return nominal()._replace(Q=jax.tree.map(lambda x: factor * x, nominal().Q))


def cell(seeds=8, fallen=(), nominal=4e6, tuned=1e6):
    """Walks of sets on plants of which the losses differ alike; `fallen` pairs of set and seed."""
    plant = 1.0 + 0.1 * np.arange(seeds)
    scores = {
        name: [pretend_score(L * p, (name, i) in fallen) for i, p in enumerate(plant)]
        for name, L in zip(SETS, (nominal, 3e6, tuned), strict=True)
    }
    return make_verdict(PAPER_LOSS, range(seeds), {"s": scores})


def test_a_run_is_its_set_best_and_another_folder_has_a_file_for_each_trajectory(tmp_path):
    run, each, levels = tmp_path / "run", tmp_path / "each", {"c": 2.0, "s": 3.0}
    for folder in (run / "weights", each):
        folder.mkdir(parents=True)
    save_weights(run / "weights" / "best.json", scaled(1.5))
    for trajectory, level in levels.items():
        save_weights(each / f"{trajectory}.json", scaled(level))
    args = Evaluate(weights=("nominal", str(run), f"mine={each}"))
    sets = command._sets(args, ROBOT, levels, paired=True)
    for trajectory, level in levels.items():
        assert [*sets[trajectory]] == ["nominal", "run", "mine"]
        for name, factor in (("run", 1.5), ("mine", level)):
            jax.tree.map(np.testing.assert_allclose, sets[trajectory][name].Q, scaled(factor).Q)


def test_cells_below_and_clear_and_void_are_counted():
    mixed = cell()
    mixed.scores["with"].losses["L"][:3] *= 8.0  # the median stays below, the interval does not
    cells = {(C, "s"): cell(), (C, "c"): mixed, (HEAVY, "s"): cell(fallen=[("with", 1)])}
    cells[HEAVY, "c"] = cell(tuned=5e6)
    assert matrix.against(cells, "with", "nominal").tally == (4, 2, 1, 1, 1)


def test_plants_are_the_sample_of_falls_over_engines_and_trajectories_and_intervals_are_exact():
    none, one = matrix.fall_share(0, 32), matrix.fall_share(1, 8)
    assert (none.low, none.high) == (0.0, pytest.approx(1.0 - 0.025 ** (1 / 32)))
    # P(X >= 1 | low) = P(X <= 1 | high) = 2.5 %
    assert 1.0 - (1.0 - one.low) ** 8 == pytest.approx(0.025)
    assert (1 - one.high) ** 8 + 8 * one.high * (1 - one.high) ** 7 == pytest.approx(0.025)
    cells = {(C, trajectory): cell(8, [("with", 0)]) for trajectory in ("straight", "s")}
    cells |= {(DRAKE, trajectory): cell(4, [("with", 0)]) for trajectory in ("straight", "s")}
    assert matrix.falls(cells, "with") == (4, 24, 1, 8, matrix.fall_share(1, 8))
    cells[HEAVY, "s"] = cell(8, [("with", 0), ("with", 5)])
    assert matrix.falls(cells, "with") == (6, 32, 2, 8, matrix.fall_share(2, 8))
    assert matrix.falls(cells, "nominal") == (0, 32, 0, 8, matrix.fall_share(0, 8))


def test_kendalls_tau_tells_the_order_of_the_sets():
    turned = cell(4, nominal=1e6, tuned=4e6)
    cells = {(C, "s"): cell(8), (DRAKE, "s"): cell(4), (HEAVY, "s"): turned}
    found = {(one.one, one.other): one.tau for one in matrix.agreements(cells)}
    assert found == pytest.approx({(C, DRAKE): 1.0, (C, HEAVY): -1.0, (DRAKE, HEAVY): -1.0})


def test_the_spread_is_between_engines_on_the_plants_that_both_have():
    first = cell(8)
    first.scores["with"].losses["L"][4:] *= 3.0  # on plants that the other engine has not
    cells = {(C, "s"): first, (DRAKE, "s"): cell(4, tuned=2e6), (HEAVY, "s"): cell(4)}
    (found,) = matrix.spreads(cells, "with", "nominal")
    assert (found.trajectory, found.model) == ("s", "own")
    assert (found.gain, found.spread) == pytest.approx((50.0, 25.0))
    assert found.is_small
    assert not found._replace(gain=49.0).is_small
    assert matrix.spreads({(C, "s"): cell()}, "with", "nominal") == []


def test_what_holds_everywhere_is_claimed_and_what_does_not_is_not():
    def claims(tuned):
        cells = {(C, "s"): cell(), (DRAKE, "s"): cell(tuned=tuned)}
        told = report.claims(cells, matrix.judge_cells(cells), {}, "standin")
        return " ".join(sum(told.values(), []))

    everywhere, in_one_engine = claims(1e6), claims(5e6)
    assert "below nominal in 2 of 2 cells, the interval clear of zero in 2." in everywhere
    assert "lower than that of nominal in every engine and model that has walked" in everywhere
    assert "in 1 of 1 case: the gain does not rest on one engine." in everywhere
    assert "All columns order the sets by their median L in the same way" in everywhere
    assert "It may not be said that its loss is lower everywhere." in in_one_engine
    assert "The whole interval is above zero in s in Drake." in in_one_engine
    assert "between MuJoCo C and Drake: Kendall's tau is -0.33" in in_one_engine


def test_the_report_has_a_page_its_numbers_and_a_picture(tmp_path, drawn):
    fell = cell(4, [("with", 0), ("with", 1)])
    fell.scores["with"].losses["L"][:2] *= 20.0
    cells = {(c, t): cell(4) for c in (C, HEAVY, DRAKE) for t in ("straight", "s")}
    cells[HEAVY, "s"] = fell
    facts = {"config": {}, "environment": {"python": "3"}}
    result = report.matrix_report(cells, {}, "standin-even") | facts
    report.write_matrix_report(tmp_path, cells, result, "hector evaluate")
    page = (tmp_path / "report.md").read_text()
    assert "72 walks: `nominal`, `expert`, `with`, on 2 trajectories in 3 columns." in page
    for line in [*result["claims"], *result["limits"]]:
        assert f"- {line}\n" in page
    told = json.loads((tmp_path / "verdict.json").read_text())
    there, total = told["columns"][1]["trajectories"]["s"]["with"], told["sets"]["with"]
    assert there["fallen_by_seed"] == [True, True, False, False]
    assert there["change"]["nominal"]["counts"] is False
    falls = ("falls", "walks", "fallen_plants", "plants")
    assert [total[key] for key in falls] == [2, 24, 2, 4]
    assert total["against"]["nominal"]["void"] == 1
    assert total["against"]["nominal"]["worst"]["column"]["model"] == "heavy"
    assert [text.get_text() for text in drawn[0].axes[1].texts] == ["2 fell"]


@pytest.fixture
def walked(monkeypatch):
    """Engine and job of each walk; no process is started."""
    state = SimpleNamespace(jobs=[], cut=None)
    engines = {"c": MUJOCO_C, "drake": MUJOCO_C._replace(name="drake", title="Drake")}

    def walks_of(setup, asked, title, engine):
        for job in asked:
            if len(state.jobs) == state.cut:
                raise KeyboardInterrupt
            state.jobs.append((engine.name, job))
            yield pretend_walk(job.seed, float(job.weights.Q.euler[0]) / 1e4, 1.0)

    def choose(name):
        if name not in engines:
            raise InputError("Pinocchio is not installed: pip install pretend")
        return engines[name]

    instead(monkeypatch, judging, "walk_jobs", walks_of)
    instead(monkeypatch, command, "choose_engine", choose)
    return state


def test_all_engines_and_models_walk_and_a_cut_one_goes_on(monkeypatch, tmp_path, capsys, walked):
    words = ("evaluate", "--out", tmp_path, "--traj", "s", "--seeds", 2, "--other-seeds", 1)
    words += ("--engine", "all", "--plant", "light", "heavy", "--json")
    walked.cut = 9
    assert call(monkeypatch, *words) == 130
    walked.cut = None
    capsys.readouterr()
    assert call(monkeypatch, *words) == 0
    assert len(walked.jobs) == 14  # two sets; 2 + 1 + 1 plants in C, 1 + 1 + 1 in the other engine
    told, err = capsys.readouterr()
    assert "14 walks: 2 on each plant; plants: MuJoCo C (2), MuJoCo C, light (1), " in err
    assert "left out: Pinocchio is not installed" in err
    mass = sorted({float(j.imperfections.mass) for name, j in walked.jobs if name == "drake"})
    np.testing.assert_allclose(mass, np.array([0.9, 1.0, 1.1]) * standin(0).mass)
    assert [one["seeds"] for one in json.loads(told)["columns"]] == [[0, 1], *([0],) * 5]
    assert call(monkeypatch, *words) == 0
    assert capsys.readouterr().out == told
    assert len(walked.jobs) == 14


def test_a_folder_has_a_file_for_each_trajectory(monkeypatch, tmp_path, capsys, walked):
    for name, weights in (("s", expert()), ("c", nominal())):
        save_weights(tmp_path / "sets" / f"{name}.json", weights)
    words = "--weights", "nominal", f"mine={tmp_path / 'sets'}", "--world", "standin-even", "--json"
    words = "evaluate", "--out", tmp_path / "out", "--traj", "s", "c", "--seeds", 1, *words
    assert call(monkeypatch, *words) == 0
    told = json.loads(capsys.readouterr().out)
    s, c = (told["columns"][0]["trajectories"][name]["mine"] for name in ("s", "c"))
    assert s["change"]["nominal"]["median"] != 0.0
    assert c["change"]["nominal"]["median"] == 0.0
    assert told["world"] == "standin-even"
    assert {float(job.imperfections.mass) for _, job in walked.jobs} == {float(even(0).mass)}


def test_a_named_set_is_not_a_folder_of_that_name(monkeypatch, tmp_path, capsys, walked):
    monkeypatch.chdir(tmp_path)
    save_weights(tmp_path / "nominal" / "s.json", expert())
    assert call(monkeypatch, "evaluate", "--traj", "s", "--seeds", 1, "--weights", "nominal") == 0
    assert [float(job.weights.Q.euler[0]) for _, job in walked.jobs] == [nominal().Q.euler[0]]
    assert capsys.readouterr().out.startswith("s, 1 plant on the hardware stand-in\n")


def verdict(L, falls=0, **changes):
    part = {"mean": L, "low": 0.9 * L, "high": 1.1 * L}
    each = {
        name: {"median": x, "low": x - 3, "high": x + 3, "wins": 1.0, "counts": True, "parts": {}}
        for name, x in changes.items()
    }
    found = {"L": part, "L_ctrl": part, "falls": falls, "seeds": [0, 1], "scenes": ["c", "s"]}
    return {"standin": found | {"change": each}}


def run_folder(folder, flags, versions, weight=1e5):
    sets = {"nominal": verdict(2e6), "expert": verdict(1.5e6, nominal=-25.0)}
    sets["with"] = verdict(1e6, falls=1, nominal=-50.0, expert=-33.3)
    config = {"flags": as_table(flags), "tune": {"loss": {"euler": weight}}}
    write_json(folder / "result.json", {"alpha": {}, "sets": sets})
    write_json(folder / "config.json", config)
    write_json(folder / "versions.json", {"jax": "1"} | versions)
    rows = [as_row("with", iteration) for iteration in pretend_history(2, refused=(1,))]
    write_rows(folder / "metrics.jsonl", rows)
    return folder


@pytest.fixture
def runs(tmp_path):
    one = run_folder(tmp_path / "one", Tune(), {"seconds": "150", "commit": "aaa"})
    return [one, run_folder(tmp_path / "two", Tune(traj=("c",), seeds=32), {})]


def test_a_comparison_tells_losses_falls_iterations_and_what_differs(monkeypatch, capsys, runs):
    assert call(monkeypatch, "evaluate", "--runs", *runs, "--json") == 0
    out, err = capsys.readouterr()
    assert err == ""
    told = json.loads(out)  # and nothing else
    one, two = told["runs"]
    assert (one["run"], one["seconds"], two["seconds"]) == (str(runs[0]), 150.0, None)
    assert one["sets"]["with"]["change"]["expert"]["median"] == -33.3
    assert [one["sets"]["with"][key] for key in ("falls", "seeds", "walks")] == [1, 2, 4]
    assert one["tuning"] == {"with": {"iterations": 2, "refused": 1}}
    settings = {"flags.traj": [["straight"], ["c"]], "flags.seeds": [8, 32]}
    assert told["differ"] == {"settings": settings, "versions": {"commit": ["aaa", None]}}


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("result.json", None, "cannot read a file of a run of `hector tune`: No such file"),
        ("result.json", '{"sets": {"with": {"hfs": {}}}}', "set with has no verdict"),
        ("metrics.jsonl", "{}\n", "metrics.jsonl, line 1: a row"),
    ],
)
def test_what_is_no_finished_run_is_told_by_its_file(runs, name, text, fault):
    (runs[0] / name).unlink()
    if text is not None:
        (runs[0] / name).write_text(text)
    with pytest.raises(ValueError, match=fault) as told:
        compare_runs([Run(folder) for folder in runs])
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(("weight", "said"), [(1e5, 0), (2e5, 1)])
def test_runs_of_different_losses_are_said_to_be_so(monkeypatch, capsys, tmp_path, weight, said):
    two = run_folder(tmp_path / "two", Tune(alpha="auto", seeds=32), {}, weight)
    runs = run_folder(tmp_path / "one", Tune(), {}), two
    assert call(monkeypatch, "evaluate", "--runs", *runs) == 0
    assert capsys.readouterr().out.count("losses differ") == said


def test_plants_stop_to_walk_when_every_set_is_clear_and_go_on_later(
    monkeypatch, tmp_path, capsys, walked
):
    words = "evaluate", "--traj", "s", "--seeds", 32, "--processes", 5, "--out", tmp_path
    assert call(monkeypatch, *words, "--until-clear") == 0
    assert [job.seed for _, job in walked.jobs] == [seed for seed in range(8) for _ in range(2)]
    told, err = capsys.readouterr()
    line = "MuJoCo C, after 8 of at most 32 plants, against nominal: expert worse. "
    line += "Saved 48 of 64 walks."
    assert told.splitlines()[-1] == line
    assert "at most 64 walks: 2 on each plant" in err
    page = (tmp_path / "report.md").read_text()
    assert f"- {line}\n" in page
    assert "The walks decided how many plants walked" in page
    (stop,) = json.loads((tmp_path / "verdict.json").read_text())["stopping"]
    assert stop == {
        **C._asdict(),
        "plants": 8,
        "most_plants": 32,
        "walks": 16,
        "walks_saved": 48,
        "baseline": "nominal",
        "claims": {"s": {"expert": "worse"}},
    }
    assert call(monkeypatch, *words) == 0
    assert len(walked.jobs) == 64
    assert "of at most" not in capsys.readouterr().out
    assert call(monkeypatch, *words, "--until-clear") == 0  # whatever walked before
    assert capsys.readouterr().out == told
    assert len(walked.jobs) == 64


def test_without_nominal_claims_are_against_the_start(monkeypatch, capsys, walked):
    words = "evaluate", "--traj", "s", "--seeds", 32, "--weights", "start=nominal", "mine=expert"
    assert call(monkeypatch, *words, "--until-clear") == 0
    assert ", against start: mine worse. Saved " in capsys.readouterr().out


def test_each_engine_and_model_stops_where_it_is_clear(monkeypatch, capsys, walked):
    words = "evaluate", "--traj", "s", "c", "--plant", "heavy", "--other-seeds", 20, "--json"
    assert call(monkeypatch, *words, "--seeds", 16, "--until-clear") == 0
    result = json.loads(capsys.readouterr().out)
    (first, *_) = StoppingRule(claims=4, batch=4).batches(16)
    assert [len(one["seeds"]) for one in result["columns"]] == [first.stop, first.stop] == [12, 12]
    saved = [one["walks_saved"] for one in result["stopping"]]
    assert saved == [4 * (16 - 12), 4 * (20 - 12)]
    assert len(result["claims"][1].split("; on c expert ")) == 2


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--seeds", 5), "needs 6 plants or more for 1 claim, got 5 in MuJoCo C"),
        (("--world", "hfs"), "needs 6 plants or more for 1 claim, got 1 in MuJoCo C"),
        (
            ("--plant", "heavy", "--other-seeds", 6),
            "8 plants or more for 2 claims, got 6 in MuJoCo",
        ),
        (
            ("--weights", "yours=expert", "mine=shipped"),
            "nominal, expert or start=FILE, which changes are",
        ),
    ],
)
def test_what_can_never_be_clear_is_refused_before_a_walk(
    monkeypatch, capsys, walked, words, expected
):
    assert expected in refused(monkeypatch, capsys, "evaluate", "--until-clear", *words)
    assert not walked.jobs


@pytest.mark.slow
def test_two_evaluations_at_once_in_one_folder_walk_each_case_once(tmp_path):
    line = "evaluate --traj straight --seeds 3 --seconds 0.1 --json --out both".split()
    words = [sys.executable, "-m", "hector_jax", *line]
    options = {"cwd": tmp_path, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    running = [subprocess.Popen(words, text=True, **options) for _ in range(2)]
    one, other = (json.loads(program.communicate()[0]) for program in running)
    assert one["columns"] == other["columns"]
    rows = [json.loads(line) for line in (tmp_path / "both/walks.jsonl").read_text().splitlines()]
    assert len({(row["set"], row["seed"]) for row in rows}) == len(rows) == 6
    assert {(row["engine"], row["world"], row["model"]) for row in rows} == {
        ("c", "standin", "own")
    }
