"""Flags from files: the line beats the file, the file beats the default, and faults have a name."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from table import Flags as Table

from hector_jax.cli import parse
from hector_jax.cli.flags import COMMANDS, Configured, Evaluate, Tune
from hector_jax.cli.parse import as_table, from_file, from_line
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import convert

FILES = [kind for kind in (*COMMANDS.values(), Table) if issubclass(kind, Configured)]


def written(folder, text, name="run.toml"):
    path = folder / name
    path.write_text(text)
    return path


def parsed(*words):
    return from_line([str(word) for word in words])


def test_the_line_beats_the_file_and_the_file_beats_the_default(tmp_path):
    path = written(tmp_path, 'traj = "c"\nseeds = 3\nvideo = false\ndata = "mine"\n')
    found = parsed("tune", "--config", path, "--seeds", "5", "--video")
    assert found == Tune(config=path, traj=("c",), seeds=5, video=True, data=Path("mine"))
    assert parsed("tune", "--seeds", "5", f"--config={path}").traj == ("c",)
    assert parsed("tune").seeds == Tune().seeds


def test_keys_are_spelt_as_flags_or_as_fields(tmp_path):
    for key in ("first-seed", "first_seed"):
        assert from_file(Evaluate, written(tmp_path, f"{key} = 7\n")).first_seed == 7
    text = "first-seed = 7\nfirst_seed = 8\n"
    with pytest.raises(ValueError, match="first_seed is given twice"):
        from_file(Evaluate, written(tmp_path, text))


def test_lists_paths_and_whole_numbers_are_taken_as_their_flags_want_them(tmp_path):
    text = 'weights = ["nominal", "mine.json"]\nseconds = 2\njson = true\n'
    found = from_file(Evaluate, written(tmp_path, text))
    assert found == Evaluate(weights=("nominal", "mine.json"), seconds=2.0, json=True)
    text = 'kept = "shelf"\nextra = ["a=x"]\n'
    assert from_file(Table, written(tmp_path, text)) == Table(kept=Path("shelf"), extra=("a=x",))


_MORE = {"tune": "friction", "engine": "drake", "plant": Path("more")}  # of tuples


@pytest.mark.parametrize("kind", FILES)
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
        elif field.name != "config":
            moved[field.name] = Path("else") if old is None else type(old)("else")
    asked = kind(**moved)
    told = json.dumps({"flags": as_table(asked), "tune": {"other": "things"}})
    assert from_file(kind, written(tmp_path, told, "config.json")) == asked
    told = json.dumps({"flags": as_table(kind())})  # null where nothing is named
    assert from_file(kind, written(tmp_path, told, "config.json")) == kind()
    assert "config" not in as_table(asked)


def test_the_line_that_asks_again_needs_no_file(tmp_path):
    found = parsed("tune", "--config", written(tmp_path, 'traj = "s"\n'), "--seeds", "4")
    assert parse.as_command("hector tune", found) == "hector tune --traj s --seeds 4"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("sedes = 3", "unknown field 'sedes'; did you mean 'seeds'?"),
        ('config = "other.toml"', "config stands on the line only"),
        ('seeds = "3"', "seeds must be a whole number from 1 to 10000, got '3'"),
        ("seeds = 3.0", "seeds must be a whole number from 1 to 10000, got 3.0"),
        ("quick = 1", "quick must be true or false, got 1"),
        ('trajectories = "c"', "trajectories must be a list, each text, got 'c'"),
        ("seeds = ", "not valid TOML: "),
        ("seeds = 1\nseeds = 2", "not valid TOML: "),
    ],
)
def test_a_wrong_file_is_one_line_with_file_and_key(tmp_path, text, fault):
    path = written(tmp_path, text)
    with pytest.raises(ValueError, match=r"run\.toml: ") as told:
        from_file(Table, path)
    assert str(told.value).startswith(f"{path}: {fault}")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("key", "fault"),
    [
        ('world = "standing"', "must be 'ideal', 'hfs', .*did you mean 'standin'"),
        ("seconds = 0", "seconds must be a number from 0.01 to 600, got 0"),
        ("seconds = nan", "seconds must be a number from 0.01 to 600, got nan"),
        (f"seconds = 1{400 * '0'}", "seconds must be a number from 0.01 to 600, got 1000"),
    ],
)
def test_choices_and_ranges_hold_in_a_file(tmp_path, key, fault):
    with pytest.raises(ValueError, match=fault):
        from_file(Evaluate, written(tmp_path, key))


@pytest.mark.parametrize(
    ("name", "data", "fault"),
    [
        ("run.toml", b"\xff\xfe", "not a text file"),
        ("run.json", b"[]", "no `flags` in it"),
        ("run.json", b'{"flags": {"seeds": null}}', "seeds must be a whole number.*got None"),
        ("run.json", b"[" * 100_000, "not valid"),
        ("none.toml", None, "No such file"),
    ],
)
def test_a_file_that_is_none_is_named(tmp_path, name, data, fault):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(ValueError, match=fault) as told:
        from_file(Tune, tmp_path / name)
    assert str(tmp_path / name) in str(told.value)


_VALUES = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=20)
    | st.sampled_from(["s", "hfs", "auto", "paper", 1, 10, 2**32, 10**400, ["a"], [1], {"a": 1}])
)
_KEYS = st.text(max_size=20) | st.sampled_from(
    sorted({field.name for kind in FILES for field in fields(kind)})
)


@settings(max_examples=300, derandomize=True, deadline=None, database=None)
@given(st.sampled_from(FILES), st.dictionaries(_KEYS, _VALUES, max_size=4))
def test_any_table_makes_flags_in_range_or_one_line_with_the_file(tmp_path_factory, kind, table):
    path = tmp_path_factory.mktemp("any") / "config.json"
    path.write_text(json.dumps({"flags": table}))
    told = f"{path}: "
    try:
        found = from_file(kind, path)
        for field in fields(kind):
            convert(getattr(found, field.name), field.type)
    except InputError as error:
        told = str(error)
    assert told.startswith(f"{path}: ")
    assert len(told.splitlines()) == 1
