"""Cut anywhere, taken up again: the same bytes; and who may write, and how a program is stopped."""

import errno
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
from killed import toy

from hector_jax.cli import flags, run_folder
from hector_jax.cli import tune as command
from hector_jax.cli.parse import from_line
from hector_jax.control.trajectories import command_of
from hector_jax.control.weights import nominal
from hector_jax.core import files as core_files
from hector_jax.core.console import exit_code
from hector_jax.core.files import WriteError, locked, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.runtime import workers
from hector_jax.core.tree_file import load_tree, save_tree
from hector_jax.robot.model import load_robot
from hector_jax.store.cache import load_or_make
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import TuneConfig, descend

ROBOT, CONFIG, HERE = load_robot(), TuneConfig(iterations=14), Path(__file__).parent
STATE = {"x": np.arange(3.0)}


class Cut(BaseException):
    """In the place of SIGKILL."""


def tune(folder):
    """A toy tuning that is kept; made anew where it was cut."""

    def make(missing, found):
        yield "toy", descend(CONFIG, nominal(), toy(folder)).weights

    paths = {"toy": folder / "tuning.npz"}
    return load_or_make(paths, make, like=lambda _: nominal(), kind="weights", robot=ROBOT)["toy"]


def files(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def looks(folder):
    return (folder.parent / f"{folder.name}.done").read_text().splitlines()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "run"
    tune(folder)
    return folder


@pytest.mark.parametrize(("step", "number"), [("fsync", 0), ("replace", 0), ("fsync", 1)])
def test_a_tuning_cut_at_any_step_of_a_save_ends_in_the_same_bytes(
    tmp_path, whole, monkeypatch, step, number
):
    """Cut before and after a file is brought to the disk and before it gets its name."""
    folder, left = tmp_path / "run", iter(range(number, -1, -1))

    def cut(*args):
        if next(left) == 0:
            raise Cut
        return getattr(os, step)(*args)

    with monkeypatch.context() as patch:
        patch.setattr(core_files, "os", SimpleNamespace(**{**vars(os), step: cut}))
        patch.setattr(Path, "unlink", lambda *args, **kwargs: None)  # nor does SIGKILL clean up
        with pytest.raises(Cut):
            tune(folder)
    tune(folder)
    assert files(folder) == files(whole)
    assert len(looks(folder)) <= 2 * len(looks(whole))  # a cut costs one tuning, at most


def spoil(path, how):
    data = bytearray(path.read_bytes())
    if how == "truncated":
        data = data[: len(data) // 2]
    elif how == "bit-flipped":
        data[len(data) // 3] ^= 4
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("how", ["truncated", "bit-flipped", "shape", "robot"])
def test_a_spoilt_artefact_is_named_and_made_anew(tmp_path, capsys, how):
    path, made = tmp_path / "state.npz", []

    def state():
        def make(missing, found):
            made.append(missing)
            yield "a", STATE

        return load_or_make({"a": path}, make, like=lambda _: STATE, kind="thing", robot=ROBOT)["a"]

    assert state()["x"].tolist() == state()["x"].tolist() == [0.0, 1.0, 2.0]
    assert len(made) == 1
    if how == "shape":
        save_tree(path, {"x": np.zeros(4)}, kind="thing", robot=ROBOT)
    elif how == "robot":
        heavier = ROBOT._replace(mass=np.asarray(ROBOT.mass) + 1.0)
        save_tree(path, STATE, kind="thing", robot=heavier)
    else:
        spoil(path, how)
    assert state()["x"].tolist() == [0.0, 1.0, 2.0]
    assert len(made) == 2
    told = "".join(capsys.readouterr().err.split())
    assert "madeanew:" in told
    assert "state.npz:" in told
    assert load_tree(path, STATE, kind="thing", robot=ROBOT)[0]["x"].tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_disk_that_refuses_is_one_line_and_loses_nothing(tmp_path, monkeypatch, code):
    path = tmp_path / "state.npz"
    save_tree(path, STATE, kind="thing")
    before = files(tmp_path)

    def full(handle):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(WriteError, match=f"cannot write {path}: {os.strerror(code)}"):
        save_tree(path, STATE, kind="thing")
    assert files(tmp_path) == before


def test_a_folder_that_cannot_be_written_is_told_before_anything_is_computed():
    with pytest.raises(InputError, match="cannot write to /proc"), locked(Path("/proc")):
        pass


def test_a_half_written_file_of_ours_is_swept_and_nobody_else_s(tmp_path):
    ours = tmp_path / ".state.npz.abc.hector_jax-part"
    theirs = tmp_path / ".film.part"
    for file in (ours, theirs):
        file.write_bytes(b"half")
    with locked(tmp_path):
        assert not ours.exists()
        assert theirs.exists()


def test_a_second_writer_waits_for_the_first_and_says_so(tmp_path, capsys):
    order = []

    def second():
        with locked(tmp_path):
            order.append("second")

    other = threading.Thread(target=second)
    with locked(tmp_path):
        other.start()
        time.sleep(0.2)
        order.append("first")
    other.join()
    assert order == ["first", "second"]
    assert "another process is writing there; waiting" in " ".join(capsys.readouterr().err.split())


# Signals: a program with a worker that would sleep for an hour.

PROGRAM = """
import signal, sys, time
from hector_jax.core.console import exit_code
from hector_jax.core.runtime import workers

def work():
    with workers(1) as pool:
        print(*pool.map(sys.getrefcount, [0]), flush=True)  # the worker is there
        pool.submit(time.sleep, 3600).result()

if __name__ == "__main__":
    signal.signal(signal.SIGALRM, lambda *inputs: None)  # a handler of the user
    sys.exit(exit_code("toy", work))
"""


def children(process):
    told = Path(f"/proc/{process}/task/{process}/children")
    return [int(one) for one in told.read_text().split()]


def is_gone(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().split()[2] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.skipif(not Path("/proc").exists(), reason="asks /proc for the workers")
@pytest.mark.parametrize(
    ("signals", "codes", "line"),
    [
        # the second one can come when Python has put its own handlers away: -2 is 130 to a shell
        ([signal.SIGINT, signal.SIGINT], [130, -2], "toy: interrupted"),
        ([signal.SIGTERM], [143], "toy: terminated"),
        ([signal.SIGKILL], [-9], ""),
        ([signal.SIGALRM, signal.SIGINT], [130], "toy: interrupted"),
    ],
    ids=["twice", "SIGTERM", "SIGKILL", "another"],
)
def test_a_signal_ends_a_program_and_its_workers_in_one_line(tmp_path, signals, codes, line):
    (tmp_path / "program.py").write_text(PROGRAM)
    program = subprocess.Popen(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(HERE.parent)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert program.stdout is not None
    program.stdout.readline()
    helpers = children(program.pid)
    for number in signals:
        # an interrupt of the terminal reaches the workers too
        (os.killpg if number == signal.SIGINT else os.kill)(program.pid, number)
    _, err = program.communicate(timeout=60)
    assert program.returncode in codes
    assert "Traceback" not in err
    assert err.startswith(line)
    for _ in range(100):
        if all(map(is_gone, helpers)):
            break
        time.sleep(0.1)
    assert helpers
    assert all(map(is_gone, helpers))


def test_a_worker_that_is_killed_is_told_in_one_line(capsys):
    def work():
        with workers(1) as pool:
            pool.submit(signal.raise_signal, signal.SIGKILL).result()

    assert exit_code("toy", work) == 1
    line = "toy: a worker process was killed, perhaps for want of memory\n"
    assert capsys.readouterr().err == line


# hector tune --resume


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """Folder and flags of each run, of which nothing is computed."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    runs = []
    fake = mock.create_autospec(command._tune_in, side_effect=lambda *run: runs.append(run))
    monkeypatch.setattr(command, "_tune_in", fake)
    return runs


def line(*words):
    return from_line(["tune", *map(str, words)])


def test_what_changes_no_number_stays_as_it_was_unless_another_is_given(asked):
    own = {"traj": ("c",), "seeds": 3, "video": False, "json": True, "processes": 1}
    command.run_tune(flags.Tune(out=Path("run"), **own))
    command.run_tune(flags.Tune(resume=Path("run")))
    assert {name: getattr(asked[-1][1], name) for name in own} == own
    command.run_tune(flags.Tune(resume=Path("run"), processes=3))
    assert asked[-1][1].processes == 3


def test_a_run_whose_data_are_elsewhere_is_refused_at_once(asked, tmp_path, monkeypatch):
    command.run_tune(flags.Tune(traj=("c",), out=tmp_path / "run"))
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    with pytest.raises(InputError, match=f"^data: no data here; the run was begun in {tmp_path}: "):
        command.run_tune(flags.Tune(resume=tmp_path / "run"))
    assert not Path("data").exists()
    command.run_tune(flags.Tune(resume=tmp_path / "run", data=tmp_path / "data"))
    assert len(asked) == 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("--seeds", 8), "run: begun with --seeds 3, got 8"),  # the default
        (("--traj", "straight"), "run: begun with --traj c, got straight"),
        (("--smooth", 3), "run: begun with --smooth 2.0, got 3"),
        (("--start", "nominal"), "run: begun with --start expert, got nominal"),
        (("--out", "other"), "only one can be given"),
    ],
)
def test_another_configuration_is_not_taken_up(asked, given, message):
    own = {"seeds": 3, "smooth": 2.0, "start": "expert", "traj": ("c",)}
    command.run_tune(flags.Tune(out=Path("run"), **own))
    before = files(Path("run"))
    with pytest.raises(ValueError, match=message):
        command.run_tune(line("--resume", "run", *given))
    assert len(asked) == 1
    assert files(Path("run")) == before


def test_a_run_of_other_code_another_robot_or_none_is_not_taken_up(asked, monkeypatch):
    command.run_tune(flags.Tune(traj=("c",), out=Path("run")))
    again = flags.Tune(resume=Path("run"))
    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "code_hash", lambda *modules: "another")
        with pytest.raises(InputError, match="run: begun with other code or other versions"):
            command.run_tune(again)
    with monkeypatch.context() as patch:
        other = ROBOT._replace(mass=np.asarray(13.0))
        patch.setattr(run_folder, "load_robot", lambda path=None: other)
        with pytest.raises(ValueError, match="run: begun with robot"):
            command.run_tune(again)
    with pytest.raises(ValueError, match="none/config.json: cannot read a file of a run of"):
        command.run_tune(flags.Tune(resume=Path("run/none")))


def test_a_run_of_another_trajectory_is_not_taken_up(tmp_path):
    begun, here = ({"command": {"velocity": [[v, 0.0]]}, "seconds": 2.0} for v in (0.3, 0.5))
    with pytest.raises(ValueError, match="begun with command.velocity .*0.3.*, here is .*0.5"):
        run_folder.check_agreement(tmp_path, begun, here)


def test_runs_of_the_same_second_have_folders_of_their_own(asked, tmp_path, monkeypatch):
    """Also those that look at the same moment and find nothing there."""

    class Clock(run_folder.datetime):
        @classmethod
        def now(cls):
            return cls(2026, 11, 21, 9, 34, 59)

    monkeypatch.setattr(run_folder, "datetime", Clock)
    for _ in range(3):
        command.run_tune(flags.Tune(traj=("s",), runs=tmp_path))
    names = [folder.name for folder, _ in asked]
    assert names == ["20261121-093459", "20261121-093500", "20261121-093501"]


def test_several_trajectories_are_one_run(asked):
    command.run_tune(flags.Tune(traj=("all",), runs=Path("runs")))
    command.run_tune(flags.Tune(traj=("c", "all"), out=Path("out")))
    command.run_tune(flags.Tune(resume=Path("out")))
    (auto, first), (named, second), again = asked
    assert auto.parent == Path("runs/straight-c-s")
    assert first.traj == ("straight", "c", "s")
    assert named == Path("out")
    assert again[1].traj == second.traj == ("c", "straight", "s")


SHORT = 'name = "short"\n[[segment]]\nseconds = 2.0\nv_x = 0.2\n'


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"traj": ("c", "short.toml")}, "of one length, got c 4 s, short 2 s; add --each"),
        ({"traj": ("short.toml", "./short.toml")}, "short.toml and ./short.toml are both named s"),
    ],
)
def test_what_one_set_cannot_be_tuned_for_is_one_line(asked, changes, message):
    Path("short.toml").write_text(SHORT)
    with pytest.raises(InputError, match=message):
        command.run_tune(flags.Tune(**changes))
    assert {path.name for path in Path().iterdir()} == {"data", "short.toml"}


def test_each_trajectory_of_a_file_has_a_folder_of_its_name(asked):
    Path("mine.toml").write_text(SHORT)
    several = flags.Tune(traj=("c", "mine.toml"), each=True)
    command.run_tune(replace(several, out=Path("out")))
    command.run_tune(replace(several, resume=Path("out")))
    assert [folder for folder, _ in asked] == 2 * [Path("out/c"), Path("out/short")]
    with pytest.raises(InputError, match="out: its trajectories were tuned one by one; add --each"):
        command.run_tune(flags.Tune(traj=("mine.toml",), resume=Path("out")))


@pytest.mark.slow
@pytest.mark.parametrize("job", ["tuning", "collection", "training", "table"])
def test_killed_25_times_on_all_cores_it_ends_in_the_bytes_of_an_unbroken_run_on_one(tmp_path, job):
    cores = os.sched_getaffinity(0)

    def run(name, kills, cores):
        (tmp_path / name).mkdir()
        ran = subprocess.run(
            [sys.executable, "killed.py", job, tmp_path / name / job, str(kills)],
            cwd=HERE,
            env={**os.environ, "PYTHONPATH": str(HERE.parent)},
            preexec_fn=lambda: os.sched_setaffinity(0, cores),
            capture_output=True,
            text=True,
        )
        assert ran.returncode == 0, ran.stderr
        return int(ran.stdout.split()[1])

    run("whole", 0, {min(cores)})
    hits = run("cut", 25, cores)
    # the last ones may find the job done, as does one in a few of a job that is one artefact
    assert hits >= (20 if job in ("collection", "table") else 8)
    assert files(tmp_path / "cut" / job) == files(tmp_path / "whole" / job)
    if job == "collection":
        more = len(looks(tmp_path / "cut" / job)) - len(looks(tmp_path / "whole" / job))
        assert more <= hits  # each kill costs one walk, at most


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """A run that was cut at once."""
    monkeypatch.setattr(command, "_tune_in", lambda folder, args: told.append(args))
    told = []
    command.tune(flags.Tune(traj=("c",), seeds=3, out=tmp_path / "run"))
    return tmp_path / "run", told


def test_a_run_is_not_resumed_from_another_start(tmp_path):
    def run(**others):
        return command._Run(
            setup=Setup(Executor(), TuneConfig(), load_robot()),
            folder=tmp_path,
            args=flags.Tune(traj=("straight",)),
            start=nominal()._replace(others={name: np.array(x) for name, x in others.items()}),
            trajectories=(command_of("straight"),),
            net=SimpleNamespace(params=None),
        )

    for begun, here in ((run(), run(turn_lead=0.8)), (run(turn_lead=0.8), run())):
        write_json(tmp_path / "config.json", {})
        noted = command._note_settings(begun)
        assert command._note_settings(begun) == noted
        with pytest.raises(InputError, match="start of other numbers beside Q and R"):
            command._note_settings(here)
    write_json(tmp_path / "config.json", {})
    command._note_settings(run(turn_lead=0.8))
    with pytest.raises(InputError, match=r"begun with start.others.turn_lead 0.8, here is 0.9"):
        command._note_settings(run(turn_lead=0.9))
