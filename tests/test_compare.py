"""Finished runs side by side."""

import json

import pytest
from pretend import call, pretend_history

from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table
from hector_jax.core.files import write_json
from hector_jax.core.journal import write_rows
from hector_jax.report.compare import compare_runs
from hector_jax.store.folder import as_row, load_run


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
        compare_runs([load_run(folder) for folder in runs])
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(("weight", "said"), [(1e5, 0), (2e5, 1)])
def test_runs_of_different_losses_are_said_to_be_so(monkeypatch, capsys, tmp_path, weight, said):
    two = run_folder(tmp_path / "two", Tune(alpha="auto", seeds=32), {}, weight)
    runs = run_folder(tmp_path / "one", Tune(), {}), two
    assert call(monkeypatch, "evaluate", "--runs", *runs) == 0
    assert capsys.readouterr().out.count("losses differ") == said
