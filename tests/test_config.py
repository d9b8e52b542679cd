"""Flags from files: the line beats the file, the file beats the default, and faults have a name."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import pytest

from hector_jax.cli.flags import COMMANDS, Configured, Evaluate, Tune
from hector_jax.cli.parse import as_command, as_table, from_file, from_line


def written(folder, text, name="run.toml"):
    path = folder / name
    path.write_text(text)
    return path


def test_the_line_beats_the_file_and_the_file_beats_the_default(tmp_path):
    path = written(tmp_path, 'traj = "c"\nseeds = 3\nvideo = false\ndata = "mine"\n')
    found = from_line(["tune", "--config", str(path), "--seeds", "5", "--video"])
    assert found == Tune(config=path, traj=("c",), seeds=5, video=True, data=Path("mine"))
    assert as_command("hector tune", found) == "hector tune --traj c --seeds 5 --data mine"
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


@pytest.mark.parametrize("kind", [k for k in COMMANDS.values() if issubclass(k, Configured)])
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
        told = json.dumps({"flags": as_table(asked), "tune": {"other": "things"}})
        assert from_file(kind, written(tmp_path, told, "config.json")) == asked
