"""Scripts of experiments/ refuse what they cannot use, before anything is computed."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.console import exit_code, made_at
from hector_jax.core.files import WriteError
from hector_jax.core.inputs import InputError

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


def test_a_missing_file_of_tuned_weights_is_refused_and_not_written(monkeypatch, tmp_path, capsys):
    path = tmp_path / "mistyped.json"
    transfer = script("transfer")
    out = tmp_path / "out"
    arguments = ["transfer.py", "--tuned", "straight", str(path), "--out", str(out)]
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


def test_a_race_on_another_engine_collects_as_every_run_does(tmp_path, monkeypatch):
    race, made = script("race"), []
    monkeypatch.setattr(race.nets, "collect", lambda pool, config, *rest: made.append(config))
    monkeypatch.setattr(race.nets, "train", lambda *rest: (tmp_path / "data.part").mkdir())
    monkeypatch.setattr(
        race.nets, "load_or_train", lambda pool, robot, folder: race.nets.TrainedNet
    )
    monkeypatch.setattr(race.nets.TrainedNet, "params", None, raising=False)
    race.prepare(None, race.Flags(engine="c", out=tmp_path), None)
    assert made == [race.nets.CollectConfig()]  # what `ground` takes up
