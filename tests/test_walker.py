"""A program of the user that walks: its log, its ends, and what takes it as an engine."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
import pytest
from model import AHEAD, HEIGHT, ROBOT, ROOT
from pretend import USUAL, call, refused, walking_program

from hector_jax.control.controller import walk_config
from hector_jax.control.weights import expert, nominal
from hector_jax.control.weights_file import save_weights
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import no_samples
from hector_jax.core.tree_file import named_leaves
from hector_jax.own.program import program_of
from hector_jax.own.walk_file import read_walk
from hector_jax.own.walker import Walker, walker_engine
from hector_jax.robot.model import load_robot
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.sim.loop import Job
from hector_jax.sim.world import hfs

CONFIG, SECONDS, PERIOD = walk_config(ROBOT), 0.1, 0.005
# off to the left by 1 cm for each e-fold of Q_y from 500
PROGRAM = walking_program('0.01 * np.log(request["weights"]["Q"]["position"][1] / 500.0)', HEIGHT)
WRITE = "np.savez(sys.argv[2], **log)\n"


def program(folder, text=WRITE):
    path = folder / "mine.py"
    path.write_text(PROGRAM + text)
    return path


def engine(path, limit=20.0, uses=(), strict=True):
    return walker_engine(Walker(program_of(path, limit, uses), strict))


def walked(path, limit=20.0, **changes):
    job = Job(nominal(ROBOT), AHEAD, hfs(ROBOT.description), SECONDS)._replace(**changes)
    return next(engine(path, limit).walk(None, CONFIG, ROBOT, [job]))


@pytest.fixture
def arrays():
    count = round(SECONDS / PERIOD)
    still = jax.tree.map(lambda x: np.zeros((count, *x.shape[1:])), no_samples(10, 2))
    still.state.position[:, 2] = HEIGHT
    needed = ("state", "command", "joints")
    found = {n: x for n, x in named_leaves(still).items() if n.split(".")[0] in needed}
    start = {f"initial.{n}": x[0] for n, x in named_leaves(still.state).items()}
    return {"period": np.array(PERIOD), **start, **found}


def read(folder, arrays, seconds=SECONDS):
    np.savez(folder / "log.npz", **{n: x for n, x in arrays.items() if x is not None})
    return read_walk(folder / "log.npz", ROBOT, seconds, 0.01)


def test_a_log_with_the_least_entries_is_a_walk_and_its_yaw_goes_on(tmp_path, arrays):
    arrays["state.euler"][5:, 2] += 2.0 * np.pi
    walk, end = read(tmp_path, arrays)
    assert np.abs(walk.state.euler).max() < 1e-9
    assert (end, walk.fallen.any(), float(walk.period)) == ("", False, PERIOD)
    assert walk.joints.shape == (20, 10)
    np.testing.assert_array_equal(walk.effect.force, walk.command.force)


def test_how_a_walk_ended_is_told(tmp_path, arrays):
    _, end = read(tmp_path, arrays, seconds=0.14)
    assert end == "its log has 20 of 28 samples of 0.005 s, which counts as a fall"
    for row, value, told in ((8, 0.1, "fell after 0.04 s"), (8, np.nan, "no number from 0.04 s")):
        changed = arrays["state.position"].copy()
        changed[row:, 2] = value
        walk, end = read(tmp_path, arrays | {"state.position": changed})
        assert told in end
        assert walk.fallen.tolist() == [False] * 8 + [True] * 12
        assert np.isfinite(walk.state.position).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"joints": np.zeros((20, 9))}, r"joints must have shape \(20, 10\), got \(20, 9\)"),
        ({"state.euler": np.full((20, 3), np.nan)}, "state.euler must hold finite numbers"),
        ({"joints": np.full((20, 10), np.nan)}, "joints must hold finite numbers"),
        ({"command.force": None}, "command.force is missing; expected initial.euler"),
        (
            {"joints": np.zeros((21, 10))},
            "expected 20 samples of joints in 0.1 s of 0.005 s, got 21",
        ),
        ({"contact": np.full((20, 2), 0.5)}, "contact must hold zeros and ones"),
        ({"period": np.array(0.003)}, r"period must be 0.01 s, the gait's tick, divided by a who"),
    ],
)
def test_a_log_that_is_none_is_refused_in_one_line(tmp_path, arrays, change, words):
    with pytest.raises(InputError, match=words):
        read(tmp_path, arrays | change)


def test_what_is_no_whole_archive_is_refused(tmp_path, arrays):
    read(tmp_path, arrays)
    path = tmp_path / "log.npz"
    for content in (b"no log", path.read_bytes()[:-400]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"not a log \(\.npz\)"):
            read_walk(path, ROBOT, SECONDS, 0.01)


def test_a_program_walks_with_the_weights_and_the_command_that_it_is_asked_for(tmp_path):
    path = program(tmp_path)
    weights = nominal(ROBOT)
    off = 0.01 * np.log(float(weights.Q.position[1]) / 500.0)
    walk = walked(path)
    np.testing.assert_allclose((walk.state.position - walk.reference.position)[:, 1], off)
    np.testing.assert_allclose(walk.state.position[-1, 0], SECONDS * AHEAD.velocity[0, 0])
    np.testing.assert_allclose(walk.reference.position[:, 0], walk.state.position[:, 0])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("raise SystemExit('no solver')", "ended with code 1: no solver"),
        ("import time; time.sleep(60)", "took longer than 2 s; killed"),
        ("raise SystemExit(124)", "ended with code 124: no output"),
        ("", "ended with code 0, but wrote no log"),
        (
            "log.pop('joints')\n" + WRITE,
            "its log: expected 20 samples of joints in 0.1 s of 0.005 s, got 0",
        ),
    ],
)
def test_a_program_that_makes_no_walk_is_told_in_one_line(tmp_path, text, told):
    with pytest.raises(InputError) as error:
        walked(program(tmp_path, text), limit=2.0)
    assert str(error.value).startswith(f"{tmp_path / 'mine.py'}: ")
    assert told in str(error.value)


def test_a_roll_that_stays_is_an_exchanged_angle_and_one_at_the_end_a_fall(tmp_path):
    lean = "log['state.euler'][{}:, 0] = 0.9\n" + WRITE
    fell = walked(program(tmp_path, lean.format(-1)))
    assert [*np.flatnonzero(fell.fallen)] == [len(fell.fallen) - 1]
    with pytest.raises(InputError, match="is it yaw, pitch, roll"):
        walked(program(tmp_path, lean.format(5)))


def test_in_a_tuning_a_walk_that_is_not_made_is_a_fall(tmp_path, capsys):
    walker = engine(program(tmp_path, "raise SystemExit('no solver')"), strict=False)
    job = Job(nominal(ROBOT), AHEAD, hfs(ROBOT.description), SECONDS)
    walk = next(walker.walk(None, CONFIG, ROBOT, [job]))
    assert walk.fallen.all()
    assert "ended with code 1: no solver; counts as a fall" in capsys.readouterr().err


# starts a program in another session, which keeps its output open, and notes its number
LEAVE = f"""
import subprocess, time
left = [{sys.executable!r}, "-c", "import time; time.sleep(60)"]
number = subprocess.Popen(left, start_new_session=True).pid
open(__file__ + ".pid", "w").write(str(number))
"""


@pytest.mark.parametrize("hangs", [True, False])
def test_a_program_is_ended_with_all_that_it_started(tmp_path, hangs):
    path, start = (
        program(tmp_path, LEAVE + ("time.sleep(60)" if hangs else WRITE)),
        time.monotonic(),
    )
    with pytest.raises(InputError, match="took longer") if hangs else nullcontext():
        walked(path, limit=4.0)
    assert time.monotonic() - start < 20.0
    assert ended(tmp_path)


CALL = """
import sys
from pathlib import Path
from hector_jax.core.console import exit_code
from hector_jax.own.program import call_program, program_of
walker = program_of(Path(sys.argv[1]), 60.0)
sys.exit(exit_code("toy", lambda: call_program(walker, Path("request"), Path("log"))))
"""


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)]
)
def test_a_program_ends_with_the_command_that_walks(tmp_path, number, code):
    path = tmp_path / "mine.py"
    path.write_text(LEAVE + "time.sleep(60)")
    toy = subprocess.Popen([sys.executable, "-c", CALL, path], start_new_session=True)
    note = tmp_path / "mine.py.pid"
    while not note.exists() or not note.read_text():
        assert toy.poll() is None
        time.sleep(0.02)
    os.killpg(toy.pid, number)  # as a terminal does
    assert toy.wait(timeout=20) == code
    assert ended(tmp_path)


SEES = """#!/usr/bin/env python3
import json, os, sys
names = "JAX_ENABLE_X64", "XLA_FLAGS", "PWD"
seen = [os.environ.get(name) for name in names], os.getcwd(), sorted(os.sched_getaffinity(0))
open(sys.argv[2], "w").write(json.dumps(seen))
"""
SHOW = """
import os, sys
from pathlib import Path
from hector_jax.core.pool import workers
from hector_jax.core.runtime import setup_jax
from hector_jax.own.program import call_program, program_of
if __name__ == "__main__":
    os.sched_setaffinity(0, {int(sys.argv[2])})
    setup_jax()
    call = program_of(Path(sys.argv[1]), 60.0), Path("request")
    os.sched_setaffinity(0, range(64))
    call_program(*call, Path("here"))
    os.sched_setaffinity(0, {int(sys.argv[2])})
    with workers(1) as pool:
        pool.submit(call_program, *call, Path("there")).result()
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no binding to cores")
def test_a_program_gets_what_the_command_was_started_with(tmp_path):
    """Not what this program changes for itself and for its workers."""
    (tmp_path / "show.py").write_text(SHOW)
    path, core = tmp_path / "sees.py", max(os.sched_getaffinity(0))
    path.write_text(SEES)
    path.chmod(0o755)
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    usual = USUAL | {"JAX_ENABLE_X64": "1", "PWD": str(folder), "PYTHONPATH": str(ROOT)}
    line = [sys.executable, tmp_path / "show.py", path, str(core)]
    subprocess.run(line, cwd=folder, env=usual, check=True)
    for log in ("here", "there"):
        seen = json.loads((folder / log).read_text())
        assert seen == [["1", None, str(folder)], str(folder), [core]]


def ended(folder, patience=20.0):
    """Whether the process that a program noted comes to its end."""
    number, until = (folder / "mine.py.pid").read_text(), time.monotonic() + patience
    stat = Path("/proc", number, "stat")
    while stat.exists() and " Z " not in stat.read_text():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def test_a_program_ends_when_whoever_waits_for_it_is_killed(tmp_path):
    path, note = program(tmp_path, LEAVE + "time.sleep(60)"), tmp_path / "mine.py.pid"
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        walk = pool.submit(walked, path)
        while not note.exists() or not note.read_text():
            time.sleep(0.02)
        (waiting,) = pool._processes
        os.kill(waiting, signal.SIGKILL)
        assert isinstance(walk.exception(), BrokenExecutor)
    assert ended(tmp_path)


def test_a_walker_is_a_file_and_has_no_other_plant(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        program_of(tmp_path / "gone.py", 1.0)
    with pytest.raises(InputError, match="has a robot of its own: Job.plant must be None"):
        walked(program(tmp_path), plant=ROBOT)


def test_walks_of_another_program_have_another_key(tmp_path):
    texts = (WRITE, WRITE, WRITE + "#")
    one, same, other = (engine(program(tmp_path, x)).key for x in texts)
    assert one == same != other
    assert one != MUJOCO_C._replace(name="mine.py").key


@pytest.mark.parametrize(
    ("file", "same"),
    [
        ("notes.py", True),
        ("lib/__pycache__/a.pyc", True),
        ("gains.py", False),
        ("model/inner/part.py", False),
        ("lib/gains.yaml", False),
        ("plant.bin", False),
    ],
)
def test_walks_are_known_by_what_makes_them(tmp_path, file, same):
    """The program, what it imports from its folder and what it names; not where that is."""

    def key(folder, content, limit=1.0):
        (folder / file).write_text(content)
        uses = (folder / "lib", folder / "plant.bin")
        return engine(folder / "mine.py", limit, uses).key

    names = "notes.py lib/__pycache__/a.pyc gains.py model/inner/part.py lib/gains.yaml plant.bin"
    for path in map((tmp_path / "one").joinpath, names.split()):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    program(tmp_path / "one", "import gains, model.inner.part\n" + WRITE)
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    one = key(tmp_path / "one", "")
    assert one == key(tmp_path / "two", "", limit=2.0)
    assert (one == key(tmp_path / "two", "a = 1")) == same


def test_the_example_walks_by_a_controller_of_its_own():
    weights, path = expert(ROBOT), ROOT / "examples" / "own_controller" / "walker.py"
    plant = hfs(ROBOT.description)._replace(mass=np.ones(()))
    walk = walked(path, weights=weights, imperfections=plant, seconds=1.0)
    assert not walk.fallen.any()
    assert walk.contact.sum(axis=1).max() == 1  # one foot after the other
    assert 0.2 < walk.state.position[-1, 0] - walk.initial.position[0] < 0.6
    weight = float(ROBOT.mass * ROBOT.gravity[2])
    assert walk.effect.force[..., 2].sum(axis=1).mean() == pytest.approx(weight, rel=0.1)


def test_hector_evaluate_takes_it_as_an_engine(tmp_path, monkeypatch, capsys):
    path = program(tmp_path)
    assert call(monkeypatch, "evaluate", "--walker", path, "--seeds", 2, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [column["engine"] for column in found["columns"]] == ["mine.py"]
    assert found["sets"]["nominal"]["falls"] == 0


# as `PROGRAM`, and when it walks sideways it is the further off the larger Q_y
KEPT = """({old}) if velocity[0] else 0.01 + PRICE * np.log(
    request["weights"]["Q"]["position"][1] / 50.0)"""
COUNTED = "open(__file__ + '.calls', 'a').write('walk ')\n" + WRITE


@pytest.mark.parametrize("price", [0.001, pytest.param(0.1, marks=pytest.mark.slow)])
def test_hector_tune_by_walks_alone_keeps_a_command(price, tmp_path, monkeypatch, capsys):
    off = '0.01 * np.log(request["weights"]["Q"]["position"][1] / 500.0)'
    path, run = tmp_path / "mine.py", tmp_path / "run"
    text = KEPT.format(old=off).replace("PRICE", str(price))
    path.write_text(walking_program(text, HEIGHT) + COUNTED)
    line = ("tune", "--walker", path, "--slopes", "walks", "--keep", "sideways", "--walks", 24)
    assert call(monkeypatch, *line, "--seeds", 1, "--out", run, "--json") == 0
    out, err = capsys.readouterr()
    said, found = " ".join(err.split()), json.loads(out)
    assert "do not depend on `plant`: 1 plant for each command" in said
    assert "slopes by Q_roll+Q_pitch, Q_yaw, Q_x+Q_y, " in said
    assert "the first set takes 9 walks, each better one 3, one that is no better 1" in said
    assert "so 24 walks about" in said
    sideways, change = found["kept"]["sideways"], found["sets"]["best"]["standin"]["change"]
    assert not sideways["broken"]
    if price < 0.01:
        assert 0.0 < sideways["change"] <= 10.0
        assert "kept, against the start: sideways +" in said
        assert change["start"]["median"] < -20.0
    else:
        assert sideways["change"] == pytest.approx(0.0)
        assert "no better set keeps what it should (set 1 sideways +" in said
    calls = tmp_path / "mine.py.calls"
    made = len(calls.read_text().split())
    assert call(monkeypatch, "tune", "--resume", run, "--json") == 0
    assert json.loads(capsys.readouterr().out) == found
    assert len(calls.read_text().split()) == made + 2  # that tell whether it takes plants


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--keep", "straight"), "--keep straight is tuned: it stands in --traj"),
        (("--slopes", "walks", "--planner", __file__), "--slopes walks and --planner: only one"),
        (("--keep", "c", "--slopes", "walks"), "at least 11 (1 command and 1 to keep on 1 plant"),
    ],
)
def test_what_a_tuning_of_a_program_cannot_do_is_one_line(monkeypatch, capsys, words, told):
    line = ("tune", "--walker", __file__, "--walks", 5, *words)
    assert told in refused(monkeypatch, capsys, *line)
    if "--planner" not in words:
        line = ("tune", *words)
        told = f"{words[0]} is for the walks of a --walker, which is not given"
        assert told in refused(monkeypatch, capsys, *line)


@pytest.mark.slow  # the model of a walk of 4 s is compiled
def test_hector_tune_finds_what_its_walks_show(tmp_path, monkeypatch, capsys):
    line = ("tune", "--walker", program(tmp_path), "--out", tmp_path / "run", "--walks", 10)
    assert call(monkeypatch, *line, "--walk-plants", 1, "--seeds", 2, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["sets"]["best"]["standin"]["change"]["start"]["median"] < -1.0
    best = json.loads((tmp_path / "run" / "weights" / "best.json").read_text())
    assert abs(np.log(best["Q"]["position"][1] / 500.0)) < 0.7
    for words in (
        ("view", tmp_path / "run", "--out", tmp_path / "out"),
        ("export", tmp_path / "run"),
    ):
        assert call(monkeypatch, *words) == 2
        assert f"its walks are those of {tmp_path / 'mine.py'}" in capsys.readouterr().err


def test_a_file_of_numbers_is_filled_in_in_its_order_and_units(tmp_path, monkeypatch, capsys):
    template, weights = tmp_path / "gains.yaml.j2", tmp_path / "mine.json"
    save_weights(weights, nominal(ROBOT))
    text = 'q: [{{ Q.position[2] }}, {{ Q.euler[0] }}]\nr: {{ "%.2f" % (1e4 * R.force[0][2]) }}\n'
    line = ("export", weights, "--template", template, "--out", tmp_path)
    template.write_text(text)
    assert call(monkeypatch, *line) == 0
    assert (tmp_path / "gains.yaml").read_text() == "q: [50.0, 50.0]\nr: 1.00\n"
    capsys.readouterr()
    assert call(monkeypatch, "export", "shipped", *line[2:], "--json") == 0  # that comes along
    assert json.loads(capsys.readouterr().out) == {"file": str(tmp_path / "gains.yaml")}
    assert float((tmp_path / "gains.yaml").read_text()[4:].split(",")[0]) > 0.0


def test_a_template_takes_the_robot_of_its_run(tmp_path, monkeypatch):
    file = ROOT / "examples" / "quadruped" / "robot.toml"
    save_weights(tmp_path / "run" / "weights" / "best.json", nominal(load_robot(file)))
    (tmp_path / "run" / "config.json").write_text(json.dumps({"flags": {"robot": str(file)}}))
    (tmp_path / "gains.j2").write_text("{{ R.force | length }}")
    line = ("export", tmp_path / "run", "--template", tmp_path / "gains.j2")
    assert call(monkeypatch, *line, "--out", tmp_path) == 0
    assert (tmp_path / "gains").read_text() == "4"
