"""Words and files become flags, or one line says which word is wrong."""

import json
import os
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
from pretend import python, refused

from hector_jax.cli import flags, parse
from hector_jax.cli.flags import COMMANDS, Evaluate, Tune, Walk
from hector_jax.cli.parse import from_file, from_line
from hector_jax.core.files import write_json

EVALUATED = Evaluate(weights=("nominal", "a.json"), first_seed=3, json=True)
A, B = Path("a"), Path("b")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("evaluate --weights nominal a.json --first-seed 3 --json", EVALUATED),
        ("evaluate --json --first_seed=3 --weights nominal a.json", EVALUATED),
        ("evaluate --json --runs a b", Evaluate(runs=(A, B), json=True)),
        ("tune --no-video", Tune(video=False)),
        ("view a --sets a b --seconds 2", flags.View((A,), sets=("a", "b"), seconds=2.0)),
        ("export --set without a --json", flags.Export(A, set="without", json=True)),
        ("walk --out=-dash.npz", Walk(out=Path("-dash.npz"))),
    ],
)
def test_flags_are_taken_in_any_order_and_spelling(line, expected):
    assert from_line(line.split()) == expected


FLAGS = [(name, field) for name, kind in COMMANDS.items() for field in fields(kind)]
COUNTS = [(name, field.name) for name, field in FLAGS if type(field.default) is int]


@pytest.mark.parametrize(("command", "name"), COUNTS)
def test_every_number_has_an_upper_bound_that_is_told(monkeypatch, capsys, command, name):
    """Nothing is made of the number before: a list of 10**12 jobs would take all memory."""
    kind = {field.name: field for field in fields(COMMANDS[command])}
    required = [each for each, field in kind.items() if field.default is MISSING]
    words = [*command.split(), *(__file__ if each == "logs" else "." for each in required)]
    line = refused(monkeypatch, capsys, *words, f"--{name.replace('_', '-')}", 10**12)
    rule = get_args(kind[name].type)[1]
    assert f"from {rule.low} to {rule.high}, got 1000000000000" in line


UNREADABLE = [(lambda path: None, "No such file or directory"), (os.mkfifo, "not a plain file")]


@pytest.mark.parametrize(("make", "fault"), UNREADABLE, ids=["missing", "pipe"])
@pytest.mark.parametrize(
    ("words", "name"), [(["walk", "--weights"], "own.json"), (["log", "add", "runs"], "own.npz")]
)
def test_an_unreadable_file_is_told_before_anything_is_loaded(tmp_path, make, fault, words, name):
    make(tmp_path / name)
    code = "import sys; from hector_jax.cli.main import main; print(main(), 'jax' in sys.modules)"
    shown = python("-c", code, *words, tmp_path / name)
    assert shown.stdout == "2 False\n"
    assert shown.stderr == f"hector: {tmp_path / name}: cannot read the file: {fault}\n"


@pytest.mark.parametrize(
    "words", ["tune --data", "evaluate --out", "steps grfm --out", "steps collect --out"]
)
def test_what_is_no_folder_is_told_before_anything_is_made(monkeypatch, capsys, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    for name in ("/dev/null", "file", "file/below"):
        line = refused(monkeypatch, capsys, *words.split(), name)
        assert line == f"hector: {words.split()[-1]} must be a folder, got {name!r}"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_latest_is_the_tuning_that_began_last(monkeypatch, capsys, tmp_path):
    """Not a copy, a folder of `hector propose` or of a verdict, nor a run that was refused."""
    monkeypatch.chdir(tmp_path)
    last, old = {"tune": {}, "began": "20260203-000000"}, {"tune": {}}  # that did not record it
    configs = {"strider/s/2": last, "c/1": {"tune": {}, "began": "20260101-000000"}}
    configs |= {"s/20260202-000000": old, "s/20260202-000000.bak": old, "strider/s/2.copy": last}
    configs |= {"refused": {"began": "20260301-000000"}, "list": []}
    for name, config in configs.items():
        write_json(tmp_path / "runs" / name / "config.json", config)
        write_json(tmp_path / "runs" / name / "versions.json", {})
    write_json(tmp_path / "runs" / "robot" / "config.json", {"flags": {}})
    last_run = Path("runs/strider/s/2")
    assert parse.resolve_latest(from_line(["view", "latest"])).run == (last_run,)
    assert parse.resolve_latest(from_line(["export", "latest"])).run == last_run
    found = parse.resolve_latest(from_line(["evaluate", "--runs", "runs/c/1", "latest"]))
    assert found.runs == (Path("runs/c/1"), Path("runs/strider/s/2"))
    assert "latest is runs/strider/s/2\n" in capsys.readouterr().err
    found = parse.resolve_latest(from_line(["tune", "--resume", "latest"]))
    assert found == Tune(resume=Path("runs/refused"))  # perhaps it was cut
    (tmp_path / "latest").mkdir()  # one that is there under that name is meant
    assert parse.resolve_latest(from_line(["view", "latest"])).run == (Path("latest"),)


def test_a_path_with_an_equals_sign_is_a_file_where_there_is_one(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_json(Path("a=b/mine.json"), {})
    assert flags.named_file("a=b/mine.json") == ("", "a=b/mine.json")
    assert flags.named_file("c=b/mine.json") == ("c", "b/mine.json")
    parse.check_flags(from_line(["evaluate", "--weights", "nominal", "a=b/mine.json"]))


NAMES_OF_FILES = [
    (name, "" if field.default is MISSING else f"--{field.name}")
    for name, field in FLAGS
    if "Path" in str(field.type) or "Source" in str(field.type)
]


@pytest.mark.parametrize(("name", "flag"), NAMES_OF_FILES)
@pytest.mark.parametrize("exists", [True, False])
def test_a_name_that_is_not_utf8_is_refused(monkeypatch, capsys, tmp_path, name, flag, exists):
    wrong = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.toml")
    if exists:
        Path(wrong).write_text("")
    line = refused(monkeypatch, capsys, name, *flag.split(), wrong)
    assert line == f"hector: names must be in UTF-8, got '{tmp_path}/caf\\udce9.toml'"


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_no_name_makes_a_message_or_a_result_unprintable(tmp_path, encoding):
    """Not that of the current folder, of the cache or of a command."""
    odd = os.fsencode(tmp_path) + b"/caf\xe9"
    os.mkdir(odd)
    environment = os.environb | {b"XDG_CACHE_HOME": odd, b"PYTHONIOENCODING": encoding.encode()}
    environment[b"PYTHONPATH"] = os.fsencode(Path(__file__).parents[1])
    program = "import sys; from hector_jax.core import console, runtime\n"
    program += "sys.exit(console.exit_code('toy', lambda: print(runtime.cache_folder())))"
    for words in (["-c", program], ["-m", "hector_jax.cli.main", b"w\xe9lk"]):
        done = python(*words, cwd=odd, env=environment)
        assert "Traceback" not in done.stderr
        assert done.returncode == 2
        assert (done.stdout + done.stderr).count("\n") == 1


def written(folder, text, name="run.toml"):
    path = folder / name
    path.write_text(text)
    return path


def test_the_line_beats_the_file_and_the_file_beats_the_default(tmp_path):
    path = written(tmp_path, 'traj = "c"\nseeds = 3\nvideo = false\ndata = "mine"\n')
    found = from_line(["tune", "--config", str(path), "--seeds", "5", "--video"])
    assert found == Tune(config=path, traj=("c",), seeds=5, video=True, data=Path("mine"))
    assert parse.as_command("hector tune", found) == "hector tune --traj c --seeds 5 --data mine"
    assert from_line(["tune", "--seeds", "5", f"--config={path}"]).traj == ("c",)


def test_keys_are_spelt_as_flags_or_as_fields_and_lists_and_whole_numbers_are_taken(tmp_path):
    text = 'weights = ["nominal", "mine.json"]\nseconds = 2\njson = true\n'
    expected = Evaluate(weights=("nominal", "mine.json"), seconds=2.0, json=True, first_seed=7)
    for key in ("first-seed", "first_seed"):
        assert from_file(Evaluate, written(tmp_path, f"{text}{key} = 7\n")) == expected
    with pytest.raises(ValueError, match="first_seed is given twice"):
        from_file(Evaluate, written(tmp_path, "first-seed = 7\nfirst_seed = 8\n"))


_MORE = {"tune": "friction", "engine": "drake"}  # of tuples
_MORE |= dict.fromkeys(("runs", "walker_uses"), Path("more"))


@pytest.mark.parametrize("kind", [k for k in COMMANDS.values() if issubclass(k, flags.Configured)])
def test_what_is_written_is_read_as_it_was(tmp_path, kind):
    """Every field is moved from its default, written as a run does, and read again."""
    moved, types = {}, get_type_hints(kind)
    for field in fields(kind):
        old = getattr(kind(), field.name)
        if get_origin(types[field.name]) is Literal:
            moved[field.name] = get_args(types[field.name])[-1]
        elif isinstance(old, bool):
            moved[field.name] = not old
        elif isinstance(old, int | float):
            moved[field.name] = old + 1 if isinstance(old, int) else old / 2
        elif field.name == "safe":
            moved[field.name] = 0.05  # a number or nothing
        elif isinstance(old, tuple):
            moved[field.name] = (*old, _MORE.get(field.name, "more"))
        elif field.name not in ("cluster", "config"):  # of the call
            absent = 48 if field.name in ("walks", "walk_plants") else Path("else")
            moved[field.name] = absent if old is None else type(old)("else")
    for asked in (kind(**moved), kind()):  # null where nothing is named
        told = json.dumps({"flags": parse.as_table(asked), "tune": {"other": "things"}})
        assert from_file(kind, written(tmp_path, told, "config.json")) == asked
