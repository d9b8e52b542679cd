"""Scripts of experiments/ refuse what they cannot use, before anything is computed."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from lib import made_at

from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import exit_code
from hector_jax.core.files import WriteError
from hector_jax.core.inputs import InputError
from hector_jax.robot.model import load_robot
from hector_jax.tuning.status import Stop

FOLDER = Path(__file__).parents[1] / "experiments"


def script(name):
    spec = importlib.util.spec_from_file_location(f"experiments_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def failing(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code"),
    [(InputError("no\nsuch thing"), 2), (WriteError("full"), 1), (KeyboardInterrupt(), 130)],
)
def test_a_script_ends_in_one_line_and_a_code(capsys, error, code):
    assert exit_code("race", failing(error)) == code
    told = capsys.readouterr().err
    assert told.startswith("race: ")
    assert told.count("\n") == 1


@pytest.mark.parametrize("error", [ValueError("zip() argument 2 is shorter"), OSError("odd")])
def test_a_fault_of_the_program_keeps_its_traceback(error):
    with pytest.raises(type(error), match=str(error)[:5]):
        exit_code("race", failing(error))


def test_a_report_tells_commit_and_command(monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(FOLDER / "race.py"), "--traj", "s"])
    told = made_at({"commit": "abc"})
    assert told == "Made at abc by `python experiments/race.py --traj s`."


@pytest.mark.parametrize("name", ["online", "transfer"])
def test_start_weights_of_no_known_name_are_refused(name):
    with pytest.raises(ValueError, match="Flags.sets must be of nominal, expert, tuned, got 'foo'"):
        script(name).Flags(sets=("foo",))


def test_transfer_without_weight_sets_is_refused():
    with pytest.raises(ValueError, match="Flags.sets must name one at least of nominal"):
        script("transfer").Flags(sets=())


def test_online_asks_for_no_file_by_itself_and_for_whole_windows():
    online = script("online")
    flags = online.Flags()
    for trajectory in flags.trajectories:
        for which in flags.sets:
            online.start_weights(flags, trajectory, which)
    with pytest.raises(ValueError, match="multiple of 0.4 s"):
        online.Flags(seconds=5.0)


@pytest.mark.parametrize("flag", [["--tuned", "straight"], ["--about"]])
def test_a_missing_file_of_weights_is_refused_and_not_written(monkeypatch, tmp_path, capsys, flag):
    path = tmp_path / "mistyped.json"
    transfer = script("transfer")
    out = tmp_path / "out"
    arguments = ["transfer.py", *flag, str(path), "--out", str(out)]
    monkeypatch.setattr(sys, "argv", arguments)
    assert exit_code("transfer", transfer.main) == 2
    assert str(path) in capsys.readouterr().err
    assert not path.exists()
    assert not out.exists()


@pytest.mark.parametrize("name", ["a b", "a-b", "a/b", "1"])
def test_names_that_files_could_not_tell_apart_are_refused(tmp_path, name):
    save_weights(tmp_path / "w.json", nominal())
    robustness = script("robustness")
    assert "a_b" in robustness.weight_sets([f"a_b={tmp_path / 'w.json'}"])
    with pytest.raises(ValueError, match="NAME=FILE"):
        robustness.weight_sets([f"{name}={tmp_path / 'w.json'}"])


def test_batch_sets_up_its_devices_and_refuses_a_missing_net(tmp_path):
    arguments = [FOLDER / "batch.py", "robust", "--net", tmp_path / "none.npz"]
    environment = os.environ | {"PYTHONPATH": str(FOLDER.parent)}
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("batch: cannot read")


def test_the_table_refuses_a_wrong_number_as_a_script_in_one_line(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(FOLDER.parent)}
    words = [sys.executable, FOLDER / "table.py", "--seeds", "0", "--out", tmp_path / "out"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    expected = "table: --seeds must be a whole number from 1 to 10000, got 0\n"
    assert done.stderr == expected
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "fault"),
    [
        ({"trajectories": ("strait",)}, "did you mean 'straight'"),
        ({"late": 40}, "OnlineConfig.late must be below window, got 40"),
        ({"payload": -1.0}, "Flags.payload must be a number of at least 0, got -1"),
        ({"varied": (-1,)}, "Flags.varied must be .* from 0 to 4294967295, got"),
        ({"processes": 0}, "Flags.processes must be a whole number of at least 1, got 0"),
    ],
)
def test_online_checks_its_flags_before_the_ground_is_made(flags, fault):
    with pytest.raises(InputError, match=fault):
        script("online").Flags(**flags)


def test_online_reports_the_worst_plan_of_any_walk(tmp_path):
    online = script("online")
    arms = ("fixed", "carried")
    short = {"trajectories": ("s",), "sets": ("nominal",), "seconds": 0.8, "change": 0.4}
    flags = online.Flags(out=tmp_path, arms=arms, **short)
    walks = {}
    for arm, residual in (("fixed", 1e-9), ("carried", 3e-4)):
        steps = 2 * (arm == "carried")
        walks[online.Case("hfs", "s", "nominal", arm)] = online.Walked(
            halves=np.ones(2),
            parts=np.ones((2, 3)),
            loss=np.ones(2),
            height=np.zeros(2),
            fallen=np.array(False),
            residual=np.array(residual),
            weights=np.ones((steps, 24)),
            refused=np.zeros(steps, bool),
            seconds=np.full(steps, 0.1),
        )
    path = online.report(flags, walks)
    assert "Worst relative KKT residual of a plan: 3e-04." in path.read_text()
    assert "![weights-nominal.png](weights-nominal.png)" in path.read_text()
    numbers = json.loads((tmp_path / "online.json").read_text())
    assert numbers["residual"] == 3e-4
    assert numbers["walks"]["hfs / s / nominal / fixed"]["residual"] == 1e-9


def test_transfer_prices_effort_about_zero_or_the_weight(monkeypatch, tmp_path, capsys):
    arguments = ["transfer.py", "--effort-about", "weigth", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(SystemExit) as ended:
        script("transfer").main()
    assert ended.value.code == 2
    assert "zero" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        ("Shared", {"iterations": 0}),
        ("Robust", {"variations": 0}),
        ("Robust", {"plants": -1}),
        ("Front", {"points": 1}),
        ("Front", {"decades": float("nan")}),
        ("Starts", {"factor": 1.0}),
        ("Starts", {"starts": 0}),
        ("Verdict", {"out": Path(), "seeds": 0}),
        ("Verdict", {"out": Path(), "first_seed": -1}),
    ],
)
def test_batch_refuses_numbers_that_it_cannot_use(kind, wrong):
    name = list(wrong)[-1]
    with pytest.raises(InputError, match=rf"{kind}.{name} must be a (whole )?number .*, got"):
        getattr(script("batch"), kind)(**wrong)


def test_batch_has_nothing_to_compare_with_where_nominal_is_refused(monkeypatch):
    batch = script("batch")
    stops = np.array([Stop.SMALL_STEP, Stop.BAD_START])
    tunings = SimpleNamespace(stop=stops)
    monkeypatch.setattr(batch, "tune_batch", lambda *_, **__: tunings)
    problems = [batch.problem(nominal(), [batch.scenario(load_robot(), batch.HELD_BACK)])] * 2
    arguments = batch.Starts(), None, None, problems, "starts"
    with pytest.raises(InputError, match="starts: the nominal weights are refused at their first"):
        batch.tune(*arguments)
    assert batch.tune(*arguments, slice(1)) is tunings  # the others do not start at nominal
