"""Finished runs side by side."""

import json
import sys

import pytest
from pretend import pretend_history

from hector_jax.cli import main as cli
from hector_jax.cli.flags import Tune
from hector_jax.cli.parse import as_table
from hector_jax.report.compare import compare_runs
from hector_jax.store.folder import as_line, load_run


def change(median, counts=True):
    found = {"median": median, "low": median - 3.0, "high": median + 3.0}
    return found | {"wins": 1.0, "counts": counts, "parts": {}}


def verdict(L, falls=0, **changes):
    part = {"mean": L, "low": 0.9 * L, "high": 1.1 * L}
    found = {"L": part, "L_ctrl": part, "falls": falls, "seeds": [0, 1], "scenes": ["c", "s"]}
    return found | {"change": changes}


def run_folder(folder, flags=None, versions=None):
    folder.mkdir(parents=True)
    result = {
        "alpha": {},
        "sets": {
            "nominal": {"standin": verdict(2e6)},
            "expert": {"standin": verdict(1.5e6, nominal=change(-25.0))},
            "with": {
                "standin": verdict(
                    1e6, 1, nominal=change(-50.0), expert=change(-33.3, counts=False)
                )
            },
        },
    }
    config = {"flags": as_table(flags or Tune()), "tune": {"loss": {"euler": 1e5}}}
    (folder / "result.json").write_text(json.dumps(result))
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "versions.json").write_text(json.dumps({"jax": "1"} | (versions or {})))
    lines = [as_line("with", iteration) for iteration in pretend_history(2, refused=(1,))]
    (folder / "metrics.jsonl").write_text("".join(lines))
    return folder


@pytest.fixture
def runs(tmp_path):
    return [
        run_folder(tmp_path / "c" / "one", versions={"seconds": "150", "commit": "aaa"}),
        run_folder(tmp_path / "c" / "two", Tune(traj=("c",), seeds=32)),
    ]


def test_a_comparison_tells_losses_falls_iterations_and_what_differs(runs):
    told = compare_runs([load_run(folder) for folder in runs])
    one, two = told["runs"]
    assert (one["run"], one["seconds"], two["seconds"]) == (str(runs[0]), 150.0, None)
    assert one["sets"]["with"]["change"]["expert"]["median"] == -33.3
    assert [one["sets"]["with"][key] for key in ("falls", "seeds", "walks")] == [1, 2, 4]
    assert one["tuning"] == {"with": {"iterations": 2, "refused": 1}}
    assert told["differ"] == {
        "settings": {"flags.traj": [["straight"], ["c"]], "flags.seeds": [8, 32]},
        "versions": {"commit": ["aaa", None]},
    }
    same = compare_runs([load_run(runs[0])] * 2)
    assert same["differ"] == {"settings": {}, "versions": {}}


def test_the_command_prints_json_and_nothing_else(monkeypatch, capsys, runs):
    monkeypatch.setattr(sys, "argv", ["hector", "compare", *map(str, runs), "--json"])
    assert cli.main() == 0
    out, err = capsys.readouterr()
    assert [one["run"] for one in json.loads(out)["runs"]] == [str(run) for run in runs]
    assert err in ("", "loading JAX and MuJoCo\n")


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        (
            "result.json",
            None,
            "result.json: cannot read a file of a run of `hector tune`: No such file",
        ),
        ("result.json", "{", "result.json: not valid JSON"),
        ("result.json", '{"sets": {"with": {"hfs": {}}}}', "set with has no verdict"),
        ("metrics.jsonl", "{}\n", "metrics.jsonl, line 1: an iteration"),
    ],
)
def test_what_is_no_finished_run_is_told_by_its_file(runs, name, text, fault):
    if text is None:
        (runs[0] / name).unlink()
    else:
        (runs[0] / name).write_text(text)
    with pytest.raises(ValueError, match=fault) as told:
        compare_runs([load_run(folder) for folder in runs])
    assert "\n" not in str(told.value)
