"""The console script as a person meets it: plain words, exit codes, one line for bad input."""

import json
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from model import BEST_OTHERS, EXAMPLES, ROBOT, small_net
from pretend import HandsOver, call, files, instead, python, refused
from synthetic import synthetic_walk

from hector_jax.cli import arguments, doctor
from hector_jax.cli.flags import COMMANDS, Tune
from hector_jax.cli.parse import from_file
from hector_jax.control.parameters import GROUPS
from hector_jax.control.weights import nominal, weight_names, weights_to_vector
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.core.inputs import InputError
from hector_jax.grfm.network import save_net
from hector_jax.robot.description import MODEL_PATH
from hector_jax.store import nets
from hector_jax.store.nets import CollectConfig, TrainedNet


def test_help_opens_with_what_is_typed_first_and_names_each_command_once():
    shown = python("-m", "hector_jax")
    assert (shown.returncode, shown.stderr) == (0, "")
    rows = re.findall(r"^  (\w+(?: \w+)?) +\S", shown.stdout, re.MULTILINE)
    assert rows[:6] == ["tune", "view", "export", "robot", "walk", "evaluate"]
    assert sorted(rows) == sorted(COMMANDS)
    assert max(map(len, shown.stdout.splitlines())) < 88
    assert "hector tune --traj straight" in shown.stdout.splitlines()[2]


def helped(monkeypatch, capsys, *words):
    with pytest.raises(SystemExit) as left:
        call(monkeypatch, *words)
    assert left.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("words", [["log"], ["log", "--help"], ["-h", "steps"]])
def test_a_first_word_of_two_shows_the_commands_that_begin_with_it(monkeypatch, capsys, words):
    (top,) = {"log", "steps"} & {*words}
    shown = helped(monkeypatch, capsys, *words)
    rows = re.findall(r"^  (\w+ \w+) +\S", shown, re.MULTILINE)
    assert rows == [name for name in rows if name.startswith(f"{top} ")]
    assert sorted(rows) == sorted(name for name in COMMANDS if name.startswith(f"{top} "))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_tells_each_flag_and_gives_an_example(monkeypatch, capsys, name):
    monkeypatch.setenv("COLUMNS", "200")
    shown = helped(monkeypatch, capsys, *name.split(), "--help-all")
    assert f"Example: hector {name}" in shown
    assert "None" not in shown
    assert not re.search(r"^.*--[\w-]+( \S+)?  +\(default", shown, re.MULTILINE)


def test_the_help_of_tune_fits_on_a_screen_and_says_where_the_rest_is(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    lines = helped(monkeypatch, capsys, "tune", "--help").splitlines()
    told = [flag[1] for line in lines if (flag := re.match(r"  --([\w-]+)", line))]
    assert sorted(told) == sorted(Tune.usual)
    assert lines[-1] == f"{len(fields(Tune)) - len(told)} more flags: hector tune --help-all"
    assert len(lines) <= 40


def test_a_walk_whose_qps_were_not_solved_is_no_result_and_no_fall(monkeypatch, capsys):
    walk = synthetic_walk(0, 30)
    fallen = np.arange(len(walk.fallen)) >= 20 * len(walk.fallen) // 30
    walk = walk._replace(fallen=fallen, residual=np.where(fallen, np.inf, 0.0))
    instead(monkeypatch, arguments, "walk_once", lambda *args, **kwargs: walk)
    assert call(monkeypatch, "walk") == 1
    out, err = capsys.readouterr()
    assert "nominal weights: ended after 0.20 s" in out
    assert "10 of 30 QPs were not solved (largest relative residual inf, expected at most" in err
    assert call(monkeypatch, "walk", "--json") == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["fell"], found["plans"], found["unsolved"]) == (False, 30, 10)
    assert found["residual"] is None


FILES = {  # that the lines below name
    "list/config.json": "[]",
    "mine.py": "",
    "mine.toml": 'name = "short"\n[[segment]]\nseconds = 2.0\nv_x = 0.2\n',
    "no.sh": "#!/bin/sh\n",
    "own.toml": "model = ''\n",
    "runs/kept": "mine",
    "walks/card.json": '{"walks": 4, "settings": {"walks": 4}}',
    "elsewhere.toml": "model = 'sub/robot.xml'\n",
    "folder.toml": "model = '.'\n",
    "root.toml": "model = '/'\n",
}
BESIDE = "model must name a file beside it"
ARMS = "examples/hector-v2/arms.toml"
STRIDER = "--robot examples/strider/robot.toml"
REFUSED = [  # the whole of what is said, or a part of it
    ("check x.npz", "hector: unknown command 'check'; it is `hector log check` now"),
    ("report runs x.npz", "hector: unknown command 'report'; it is `hector log add` now"),
    ("train", "hector: unknown command 'train'; it is `hector steps train` now"),
    ("compare a b", "hector: unknown command 'compare'; it is `hector evaluate --runs` now"),
    ("log chekc x.npz", "hector: unknown command 'log chekc'; did you mean 'log check'?"),
    ("eval", "hector: unknown command 'eval'; did you mean 'evaluate'?"),
    ("wlak", "unknown command 'wlak'; did you mean 'walk'?"),
    ("walk --wrold hfs", "walk has no flag '--wrold'; did you mean '--world'?"),
    ("walk --zzz", "walk has no flag '--zzz'; see hector walk --help"),
    ("walk there", "walk does not expect 'there'; see hector walk --help"),
    ("walk --seed", "Missing value for argument '--seed'. Expected 1 values."),
    ("walk --seed 1 --seed 2", "--seed is given twice"),
    ("evaluate --weights nominal nominal", "--weights names 'nominal' twice"),
    ("view", "RUN expects a value, got none; or --live"),
    ("walk --seconds long", "Error parsing --seconds: expected a number, got 'long'"),
    ("walk --world moon", "invalid choice 'moon' for argument '--world'. Expected one of ('"),
    ("walk --robot assets/hector.xml", "hector robot MODEL --out FOLDER makes one, got"),
    (f"walk --weights {300 * 'x'}.json", "cannot read the file: File name too long"),
    (f"tune --resume {300 * 'x'}", "--resume must be the folder of a run of `hector tune`"),
    ("walk --world srbm --engine mjx", "--engine mjx needs a world with a plant"),
    (f"walk --world srbm --plant {ARMS}", "--plant needs a world of MuJoCo, got --world srbm"),
    ("walk --weights exprt", "'exprt'; did you mean 'expert'?"),
    ("walk --gait trot", "--gait: trot is for 4 legs, not 2"),
    ("export best", "got 'best'; that is `shipped` now, or weights/best.json of a run"),
    ("export shipped --set without", "--set is of a run, and shipped is weights"),
    ("walk --weights best", "got 'best'; that is `shipped` now, or weights/best.json of a run"),
    (f"walk --weights shipped {STRIDER}", "strider/robot-shipped.json; name nominal, expert"),
    ("walk --traj examples/slalom.toml --seconds 4", "slalom lasts 6 s, as its file says, got 4"),
    ("walk --traj examples/slalom.toml --seconds 2 --out never.npz", "got 2"),
    (f"tune --start shipped {STRIDER}", "strider/robot-shipped.json; name nominal, expert"),
    ("tune --traj circle", "straight, c, s"),
    ("tune --traj c mine.toml", "of one length, got c 4 s, short 2 s"),
    ("tune --traj all --walks 5", "--walks must be 0 or at least 6 (3 commands on 1 pl"),
    ("tune --safe 0.05 --start shipped", "--safe sets the position limit, which --start has"),
    ("tune --net net.npz --variant paper", "net.npz: holds grfm-residual, expected grfm-paper"),
    ("tune --out runs --data runs", "exists"),
    ("tune --walker mine.py", "--walker needs --walks"),
    ("tune --walker mine.py --walks 20 --safe 0.1", "--safe is for this project's controller"),
    ("tune --planner mine.py", "--planner plans for the walks of a --walker, which is not given"),
    ("propose out --planner mine.py --tune footsteps", "--tune must be weights beside --planner"),
    ("propose out --planner no.sh", "chmod +x"),
    ("steps collect --seconds 0.001", "at least 0.03 s, the 3 ticks of one sample, got 0.001"),
    ("steps collect --walks 2", "--walks must be a whole number from 3 to"),
    ("steps collect --walks 5 --out walks", "walks: made"),
    ("robot own.toml", "model is missing"),
    ("robot elsewhere.toml", BESIDE),
    ("robot folder.toml", BESIDE),
    ("robot root.toml", BESIDE),
    ("view runs --out shown", "runs/config.json: cannot read a file of a run of"),
    ("view list --out shown", "list/config.json: expected a JSON object"),
    ("evaluate --world ideal --seeds 8", "--seeds 8: --world ideal is one plant"),
    ("evaluate --world hfs --first-seed 3", "--first-seed 3: --world hfs is one plant"),
    ("evaluate --walker mine.py --engine c", "--engine and --walker: only one can be given"),
    ("evaluate --walker no.sh", "chmod +x"),
    ("evaluate --walker mine.py --walker-uses gone", "gone: no such file or folder"),
    (
        "evaluate --weights expert --out out",
        "which changes are against, and other sets",
    ),
    ("evaluate --weights nominal nominla", "got 'nominla'; did you mean 'nominal'?"),
    ("evaluate --weights nominal expert=c.json", "there is a set 'expert' already; use NAME="),
    ("evaluate --weights nominal list", "straight.json: cannot read"),
    ("evaluate --weights nominal .", "straight.json: cannot read"),
    ("evaluate --engine all c", "--engine all stands alone, got all c"),
    ("evaluate --plant light light", "--plant names 'light' twice"),
    ("evaluate --runs runs --seeds 3", "--runs compares what has walked already, so not beside"),
    ("evaluate --first-seed 4294967293 --seeds 1 --plant heavy", "the largest is 4294967295"),
]


@pytest.fixture(scope="module")
def named(tmp_path_factory):
    folder = tmp_path_factory.mktemp("named")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    (folder / "examples").symlink_to(EXAMPLES)
    save_net(folder / "net.npz", small_net(), robot=ROBOT, about={})
    save_weights(folder / "c.json", nominal())
    return folder


@pytest.mark.parametrize(("line", "fault"), REFUSED)
def test_wrong_input_is_one_line_before_anything_is_made(monkeypatch, capsys, named, line, fault):
    monkeypatch.chdir(named)
    before = files(named)
    said = refused(monkeypatch, capsys, *line.split())
    assert said == fault if fault.startswith("hector:") else fault in said
    assert files(named) == before


def test_a_step_with_settings_of_its_own_leaves_what_a_tuning_reads(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    trained = TrainedNet(small_net(), None, {}, None, None, [])
    paths = []
    instead(monkeypatch, nets, "train_net", lambda *args: paths.append(args[-1]) or trained)
    instead(monkeypatch, nets, "collect_walks", lambda *args: paths.append(args[-1]))
    for line in ("", "--epochs 5", "--data data/more", "--variant paper", "--out a.npz"):
        assert call(monkeypatch, "steps", "train", *line.split(), "--json") == 0
    found = "data/grfm data/grfm-epochs-5 data/grfm-more data/grfm-paper a".split()
    assert paths == [Path(f"{name}.npz") for name in found]
    paths.clear()
    for line in ("", "--engine c", "--walks 128", "--walks 128 --out data/walks"):
        assert call(monkeypatch, "steps", "collect", *line.split()) == 0
    assert list(map(str, paths)) == ["data/walks"] * 2 + ["data/walks-walks-128", "data/walks"]


def test_walks_of_other_settings_are_refused_before_anything_is_compiled(monkeypatch, named):
    monkeypatch.setattr(nets, "compile_programs", None)
    with pytest.raises(InputError, match=f"^{named / 'walks'}: made"):
        nets.collect_walks(HandsOver(), CollectConfig(walks=5), ROBOT, named / "walks")


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["c", "mjx"])
def test_a_net_is_trained_on_walks_of_either_engine(monkeypatch, capsys, tmp_path, engine):
    monkeypatch.setattr(nets, "tuning_paths", lambda *args: [])
    walks, flags = tmp_path / "walks", ("steps", "collect", "--walks", "5", "--seconds", "0.1")
    assert call(monkeypatch, *flags, "--engine", engine, "--out", walks) == 0
    settings = json.loads((walks / "card.json").read_text())["settings"]
    assert settings["engine"].split()[0] == engine
    other = {"c": "mjx", "mjx": "c"}[engine]
    assert call(monkeypatch, *flags, "--engine", other, "--out", walks) == 2
    capsys.readouterr()
    flags = ("--data", walks, "--out", tmp_path / "net.npz", "--epochs", "1", "--json")
    assert call(monkeypatch, "steps", "train", *flags) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["net"] == str(tmp_path / "net.npz")
    assert {"raw", "net"} <= told["errors"].keys()


@pytest.mark.long
@pytest.mark.slow
def test_the_main_job_leaves_what_it_promises(monkeypatch, capsys, tmp_path):
    """From nothing to a verdict, small: data, net, two tunings, judges, report."""
    monkeypatch.chdir(tmp_path)
    # its rollouts are of four seconds: programs as the user has them are sooner done
    quick = "--xla_backend_optimization_level=0"
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"].replace(quick, ""))
    small = CollectConfig(walks=6, seconds=1.0)
    monkeypatch.setattr(nets, "CollectConfig", lambda: small)
    flags = ("--seeds", "2", "--iterations", "6", "--walk-plants", "1")
    assert call(monkeypatch, "tune", *flags, "--out", "run", "--json") == 0
    out, run = capsys.readouterr().out, tmp_path / "run"
    result = json.loads((run / "result.json").read_text())
    assert json.loads(out) == {"run": "run", "traj": "straight", **result}
    asked = {"seeds": 2, "iterations": 6, "walk_plants": 1}
    assert from_file(Tune, run / "config.json") == Tune(**asked, json=True)
    assert float(json.loads((run / "versions.json").read_text())["seconds"]) > 0.0
    assert list(result["sets"]) == ["nominal", "expert", "without", "with", "best"]
    for name, worlds in result["sets"].items():
        standin = worlds["standin"]
        assert (standin["seeds"], standin["scenes"], standin["falls"]) == ([0, 1], ["straight"], 0)
        for part in ("L", "L_Eul", "L_pos", "L_ctrl"):
            assert standin[part]["mean"] > 0.0
            assert standin[part]["low"] is None  # two plants have no interval
        assert (run / "weights" / f"{name}.json").exists()
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [*dict.fromkeys(line["set"] for line in lines)] == ["without", "with", "best"]
    best = load_weights(run / "weights" / "best.json")
    assert best.others == {**best.others, **BEST_OTHERS}
    assert best.others.keys() == {*BEST_OTHERS, *GROUPS["integral"]}
    start, *steps = result["walks"]
    assert start == {"change": 0.0, "falls": 0, "accepted": True}
    assert 1 <= len(steps) <= 3  # of the four sets of the budget
    assert len(list((run / "walks" / "logs").glob("*.npz"))) == 1 + len(steps)
    starts = {path.name for path in (run / "walks" / "starts").iterdir()}
    assert starts == {"best", "with", "without", "start"}
    report = (run / "report.md").read_text()
    expected = "On a robot that is not this simulator expect "
    assert result["elsewhere"]["change"].keys() == {"straight"}
    for words in (
        expected,
        "hardware stand-in",
        "## Tuning on walks",
        "Each weight set walked 1 time ",
    ):
        assert words in report
    for picture in ("tracking", "path", "losses", "weights", "wrenches", "training"):
        assert (run / "pictures" / f"{picture}.png").stat().st_size > 10_000

    # one set for two trajectories, from those weights, on the same data
    start, flags = run / "weights" / "with.json", ("--seeds", "1", "--iterations", "4")
    several = ("--traj", "straight", "c", "--start", start, "--no-video", "--out", "both")
    several += ("--tune", "turn_lead", "--net", Path("data/grfm.npz"), "--walks", "0")
    assert call(monkeypatch, "tune", *flags, *several) == 0
    out = capsys.readouterr().out
    for title in ("straight, c, 1 plant", "straight, 1 plant", "c, 1 plant"):
        assert f"\n{title} on the" in f"\n{out}"
    result = json.loads(Path("both/result.json").read_text())
    assert list(result["sets"]) == ["nominal", "expert", "start", "without", "with", "best"]
    means = [one["sets"]["with"]["standin"]["L"]["mean"] for one in result["trajectories"].values()]
    assert len(means) == 2
    tuned = result["sets"]["with"]
    assert tuned["standin"]["L"]["mean"] == pytest.approx(np.mean(means))
    assert tuned["hfs"]["L"]["mean"] > 0.0
    for world in tuned.values():
        assert (world["seeds"], world["scenes"]) == ([0], ["straight", "c"])
    lines = [json.loads(line) for line in Path("both/metrics.jsonl").read_text().splitlines()]
    at_start = [*weights_to_vector(load_weights(start)).tolist(), 0.5]
    names = [*weight_names(), "turn_lead"]
    assert lines[0]["weights"] == pytest.approx(dict(zip(names, at_start, strict=True)))
    for name in ("with", "best"):
        assert load_weights(Path(f"both/weights/{name}.json")).others["turn_lead"] != 0.5
    report = Path("both/report.md").read_text()
    for words in ("- turn_lead: 0.5 at the start", "walking: straight, c"):
        assert words in report
    assert "Tuning on walks" not in report
    assert "walks" not in result

    # the nets of these data
    assert call(monkeypatch, "steps", "grfm", "--seeds", "0", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert {"raw", "paper", "residual"} <= told["worlds"]["hfs"]["errors"].keys()
    assert (tmp_path / told["report"]).exists()


def test_the_doctor_reports_what_works_and_what_does_not(monkeypatch, capsys):
    for name in ("walk", "walk_rigid_body"):
        instead(monkeypatch, doctor, name, lambda *args: synthetic_walk(0, 30))
    instead(monkeypatch, doctor, "write_film", lambda *args: "egl")
    assert call(monkeypatch, "doctor", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told.pop("faults"), told["precision"]) == ([], "float64")
    assert told["robot"].startswith(str(MODEL_PATH))
    assert {"python", "jax", "mujoco", "devices", "cache", "extras", "video"} <= told.keys()
    assert "view: yes (for hector view)" in told["extras"]
    assert call(monkeypatch, "doctor") == 0  # without --json the same lines
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(told)

    instead(monkeypatch, doctor, "choose_engine", InputError("it is of another Python"))
    fallen = synthetic_walk(0, 30)._replace(fallen=np.ones(1, bool))
    instead(monkeypatch, doctor, "walk", lambda *args: fallen)
    assert call(monkeypatch, "doctor") == 1
    faults = capsys.readouterr().err
    for words in ("it is of another Python", "the robot does not walk in ideal"):
        assert words in faults


def test_a_reader_that_has_enough_is_no_error():
    work = "from hector_jax.core.console import exit_code; "
    work += r'exit(exit_code("x", lambda: print("y\n" * 99999)))'
    line = '"$0" -c "$1" | head -n 1; exit ${PIPESTATUS[0]}'
    shown = subprocess.run(["bash", "-c", line, sys.executable, work], capture_output=True)
    assert (shown.returncode, shown.stdout, shown.stderr) == (141, b"y\n", b"")
