"""Cut anywhere, taken up again: the same bytes; and who may write, and how a program is stopped."""

import errno
import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from model import ROBOT, ROOT
from pretend import call, files, python

from hector_jax.cli import flags, run_folder
from hector_jax.cli import tune as command
from hector_jax.cli.parse import from_line
from hector_jax.core import files as core_files
from hector_jax.core.console import exit_code
from hector_jax.core.files import WriteError, locked, write_json
from hector_jax.core.inputs import InputError
from hector_jax.core.pool import workers
from hector_jax.core.runtime import cache_folder
from hector_jax.core.tree_file import save_tree
from hector_jax.store.cache import load_or_make

HERE, OURS = ROOT / "tests", {"PYTHONPATH": str(ROOT)}
STATE = {"x": np.arange(3.0)}


def state(folder, made=None):
    """A toy that is kept; notes in a list that it was made."""

    def make(missing, found):
        if made is not None:
            made.extend(missing)
        yield "a", STATE

    paths = {"a": folder / "state.npz"}
    found = load_or_make(paths, make, like=lambda _: STATE, kind="thing", robot=ROBOT)
    return found["a"]["x"].tolist()


@pytest.mark.parametrize(("step", "number"), [("fsync", 0), ("replace", 0), ("fsync", 1)])
def test_a_save_that_is_cut_at_any_step_ends_in_the_same_bytes(tmp_path, monkeypatch, step, number):
    """Cut before and after a file is brought to the disk and before it gets its name."""
    whole, folder, left = tmp_path / "whole", tmp_path / "run", iter(range(number, -1, -1))

    def cut(*args):
        if next(left) == 0:
            raise KeyboardInterrupt  # in the place of SIGKILL
        return getattr(os, step)(*args)

    for each in (whole, folder):
        each.mkdir()
        (each / ".film.part").write_bytes(b"of another program")
    state(whole)
    with monkeypatch.context() as patch:
        patch.setattr(core_files, "os", SimpleNamespace(**{**vars(os), step: cut}))
        patch.setattr(Path, "unlink", lambda *args, **kwargs: None)  # nor does SIGKILL clean up
        with pytest.raises(KeyboardInterrupt):
            state(folder)
    state(folder)
    assert files(folder) == files(whole)


@pytest.mark.parametrize("how", ["truncated", "bit-flipped", "shape", "robot"])
def test_a_spoilt_artefact_is_named_and_made_anew(tmp_path, capsys, how):
    path, made = tmp_path / "state.npz", []
    assert state(tmp_path, made) == state(tmp_path, made) == STATE["x"].tolist()
    data = path.read_bytes()
    if how == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif how == "bit-flipped":
        path.write_bytes(data[:100] + bytes([data[100] ^ 4]) + data[101:])
    else:
        other = ROBOT._replace(mass=np.asarray(13.0)) if how == "robot" else ROBOT
        size = 4 if how == "shape" else 3
        save_tree(path, {"x": np.zeros(size)}, kind="thing", robot=other)
    assert state(tmp_path, made) == state(tmp_path, made) == STATE["x"].tolist()
    assert made == ["a", "a"]
    told = "".join(capsys.readouterr().err.split())
    assert re.search("madeanew:.*state.npz:", told)


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


def test_a_link_a_mode_a_device_and_a_pipe_stay(tmp_path):
    """An atomic write renames a file, which would put a plain file into the place of these."""
    file, link, null = tmp_path / "file.json", tmp_path / "link.json", tmp_path / "null"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file.name)
    null.symlink_to(os.devnull)
    for path in (link, null):
        write_json(path, "new")
        assert path.is_symlink()
    assert (file.read_text(), file.stat().st_mode & 0o777) == ('"new"\n', 0o640)
    assert Path(os.devnull).is_char_device()
    assert {path.name for path in tmp_path.iterdir()} == {"file.json", "link.json", "null"}
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = ThreadPoolExecutor(1).submit(pipe.read_text)
    write_json(pipe, 3)
    assert reader.result(10) == "3\n"
    assert pipe.is_fifo()


def test_a_lock_leaves_the_file_that_another_is_writing(tmp_path, monkeypatch):
    def fsync(handle):
        with locked(tmp_path):
            pass

    monkeypatch.setattr(core_files, "os", SimpleNamespace(**{**vars(os), "fsync": fsync}))
    write_json(tmp_path / "state.json", 3)
    assert (tmp_path / "state.json").read_text() == "3\n"


def test_a_disk_without_locks_is_locked_by_a_file(tmp_path, monkeypatch):
    def no_lock(handle, how):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_lock)
    for _ in range(2):
        with locked(tmp_path), locked(tmp_path):
            write_json(tmp_path / "state.json", 3)
            assert (tmp_path / ".lock-file").exists()
        assert not (tmp_path / ".lock-file").exists()
    monkeypatch.setattr(core_files, "SoftFileLock", core_files.FileLock)
    with pytest.raises(InputError, match="cannot lock .*: No locks available; name a folder on"):
        locked(tmp_path).__enter__()


_HOLD = """
import sys
from pathlib import Path
from hector_jax.core.files import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        (("steps", "collect", "--walks", "3", "--out", "walks"), "walks"),
        (("steps", "train", "--data", "walks"), "."),
        (("evaluate", "--out", "judged"), "judged"),
        (("propose", "reported"), "reported"),
    ],
)
def test_each_writer_of_a_folder_waits_for_the_one_before(monkeypatch, tmp_path, words, folder):
    def say(text):
        if "another process is writing there" in text:
            raise InterruptedError(text)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(core_files, "say", say)
    holding = [sys.executable, "-c", _HOLD, folder]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(holding, **pipes) as holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InterruptedError, match=re.escape(f"{folder}: another")):
            call(monkeypatch, *words)
        holder.stdin.close()


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EROFS, errno.EMFILE])
def test_what_the_machine_refuses_is_one_line(capsys, code):
    def work():
        raise OSError(code, os.strerror(code), "there")

    assert exit_code("toy", work) == 1
    assert capsys.readouterr().err == f"toy: this machine refuses there: {os.strerror(code)}\n"


def test_a_user_without_a_home_gets_a_line_and_no_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    with pytest.raises(InputError, match="this user has no home; set XDG_CACHE_HOME"):
        cache_folder()
    assert not list(tmp_path.iterdir())


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
import sys, time
from multiprocessing import active_children
from hector_jax.core.console import exit_code
from hector_jax.core.pool import workers

def work():
    with workers(1) as pool:
        pool.submit(int).result()
        print(active_children()[0].pid, flush=True)
        pool.submit(time.sleep, 3600).result()

if __name__ == "__main__":
    sys.exit(exit_code("toy", work))
"""


@pytest.mark.skipif(not Path("/proc").exists(), reason="asks /proc for the worker")
@pytest.mark.parametrize(
    ("signals", "codes", "line"),
    [
        # the second one can come when Python has put its own handlers away: -2 is 130 to a shell
        ([signal.SIGINT, signal.SIGINT], [130, -2], "toy: interrupted"),
        ([signal.SIGTERM], [143], "toy: terminated"),
        ([signal.SIGKILL], [-9], ""),
    ],
)
def test_a_signal_ends_a_program_and_its_workers_in_one_line(tmp_path, signals, codes, line):
    (tmp_path / "program.py").write_text(PROGRAM)
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    options |= {"cwd": tmp_path, "env": os.environ | OURS, "start_new_session": True}
    program = subprocess.Popen([sys.executable, "program.py"], **options)
    worker = Path("/proc") / program.stdout.readline().strip()
    for number in signals:
        # an interrupt of the terminal reaches the workers too
        (os.killpg if number == signal.SIGINT else os.kill)(program.pid, number)
    _, err = program.communicate(timeout=60)
    assert program.returncode in codes
    assert "Traceback" not in err
    assert err.startswith(line)
    until = time.monotonic() + 10.0
    while worker.exists() and " Z " not in (worker / "stat").read_text():
        assert time.monotonic() < until
        time.sleep(0.1)


def test_a_worker_that_is_killed_is_told_in_one_line(capsys):
    def work():
        with workers(1) as pool:
            pool.submit(signal.raise_signal, signal.SIGKILL).result()

    assert exit_code("toy", work) == 1
    line = "toy: a worker process was killed, perhaps for want of memory\n"
    assert capsys.readouterr().err == line


# hector tune --resume


OWN = {"traj": ("c",), "seeds": 3, "smooth": 2.0, "start": "expert", "video": False, "processes": 1}


def resume(*words, folder="run"):
    command.run_tune(from_line(["tune", "--resume", *map(str, (folder, *words))]))


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """The folder of a run that was cut at once, in the working directory."""
    monkeypatch.chdir(tmp_path)
    return run_folder.begin(tmp_path / "run", flags.Tune(out=tmp_path / "run", **OWN))


def test_what_changes_no_number_stays_as_it_was_unless_another_is_given(begun):
    again = run_folder.resume(begun, flags.Tune(resume=begun))
    assert {name: getattr(again, name) for name in OWN} == OWN
    other = run_folder.resume(begun, flags.Tune(resume=begun, processes=3))
    assert other == replace(again, processes=3)


def test_a_run_whose_data_are_elsewhere_is_refused_at_once(begun, tmp_path, monkeypatch):
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    with pytest.raises(InputError, match=f"^data: no data here; the run was begun in {tmp_path}: "):
        resume(folder=begun)
    assert not any((tmp_path / "other").iterdir())


@pytest.mark.parametrize(
    ("changed", "given", "message"),
    [
        ({}, "--seeds 8", "run: begun with --seeds 3, got 8"),  # the default
        ({}, "--out other", "only one can be given"),
        ({"code": "another"}, "", "run: made by other code or other versions"),
        ({"robot": "another"}, "", "run: made for another robot"),
        (None, "", "run/config.json: cannot read a file of a run of"),
    ],
)
def test_another_configuration_is_not_taken_up(begun, changed, given, message):
    path = begun / "config.json"
    if changed is None:
        path.unlink()
    else:
        write_json(path, json.loads(path.read_text()) | changed)
    before = files(begun)
    with pytest.raises(InputError, match=message):
        resume(*given.split())
    assert files(begun) == before


@pytest.mark.parametrize(
    ("then", "now", "message"),
    [
        ({"command": {"velocity": 0.3}}, {"command": {"velocity": 0.5}}, "command.velocity 0.3, "),
        ({"start": {"kp": 0.8}}, {"start": {"kp": 0.9}}, "start.kp 0.8, this command expects 0.9"),
        ({"start": {}}, {"start": {"kp": 0.8}}, "start.kp None, this"),
    ],
)
def test_a_run_of_another_trajectory_or_start_is_not_taken_up(begun, then, now, message):
    then, now = {"start": {}} | then, {"start": {}} | now
    noted = run_folder.note_settings(begun, then)
    assert run_folder.note_settings(begun, then) == noted
    with pytest.raises(InputError, match=f"made with {message}"):
        run_folder.note_settings(begun, now)


def test_all_is_what_a_run_of_all_was_begun_with(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    folder, args = run_folder.plan_run(flags.Tune(traj=("all",), out=Path("run")))
    run_folder.begin(folder, args)
    again = run_folder.resume(folder, flags.Tune(traj=("all",), resume=folder))
    assert again.traj == ("straight", "c", "s")


def test_runs_of_one_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text('name = "short"\n[[segment]]\nseconds = 2.0\nv_x = 0.2\n')
    folder, args = tmp_path / "20261121-235959", flags.Tune()
    names = [run_folder.begin(folder, args).name[-6:] for _ in range(3)]
    assert names == ["235959", "000000", "000001"]
    new, given = run_folder.plan_run(flags.Tune(traj=("mine.toml",)))
    assert (new.parent, given.traj) == (Path("runs/short"), ("mine.toml",))


@pytest.mark.slow
@pytest.mark.parametrize("job", ["collection", "table"])
def test_killed_25_times_on_all_cores_it_ends_in_the_bytes_of_an_unbroken_run_on_one(tmp_path, job):
    cores = os.sched_getaffinity(0)

    def run(name, kills, cores):
        (tmp_path / name).mkdir()
        bind = lambda: os.sched_setaffinity(0, cores)  # noqa: E731
        words = "killed.py", job, tmp_path / name / job, str(kills)
        ran = python(*words, cwd=HERE, env=os.environ | OURS, preexec_fn=bind)
        assert ran.returncode == 0, ran.stderr
        return int(ran.stdout.split()[1])

    run("whole", 0, {min(cores)})
    hits = run("cut", 25, cores)
    assert hits >= 20  # the last ones may find the job done
    assert files(tmp_path / "cut" / job) == files(tmp_path / "whole" / job)
    if job == "collection":  # each kill costs one walk, at most
        cut, whole = ((tmp_path / x / "collection.done").read_text() for x in ("cut", "whole"))
        assert cut.count("\n") <= whole.count("\n") + hits
