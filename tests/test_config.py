"""Flags from files: the line beats the file, the file beats the default, and faults have a name."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hector_jax.cli import parse
from hector_jax.cli.flags import COMMANDS, Configured, Evaluate, Tune
from hector_jax.cli.parse import as_table, from_file, from_line
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import convert

FILES = [kind for kind in COMMANDS.values() if issubclass(kind, Configured)]


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
