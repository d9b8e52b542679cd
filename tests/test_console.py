"""What a person sees while waiting."""

import io
import time
from types import SimpleNamespace

from rich.console import Console

from hector_jax.core import console


def test_a_bar_ends_at_its_end_whatever_converged_early(monkeypatch):
    terminal = Console(file=io.StringIO(), force_terminal=True, width=100)
    monkeypatch.setattr(console, "console", terminal)
    with console.bar("tuning") as tell:
        tell(162, 300, "straight: L 1.2e6")
    last = terminal.file.getvalue().rpartition("tuning")[2]
    assert "300/300" in last
    with console.bar("nothing to do"):
        pass
    assert "1/1" in terminal.file.getvalue()


def test_what_is_slow_is_told_and_what_is_not_is_silent(capsys):
    with console.say_if_slow("reading"):
        pass
    time.sleep(1.2)
    assert capsys.readouterr().err == ""
    with console.say_if_slow("reading"):
        time.sleep(1.2)
    assert capsys.readouterr().err == "reading\n"


def test_nothing_that_controls_a_terminal_is_said(capsys):
    console.say("two\nlines\x1b[31m")
    assert capsys.readouterr().err == "two lines?[31m\n"


def test_time_left_is_told_from_what_was_done_after_compiling(capsys, monkeypatch):
    clock = iter([0.0, 1.0, 100.0, 120.0, 130.0])
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with console.bar("walking") as tell:
        tell(0, 50, "compiling")
        tell(1, 50, "")
        tell(11, 50, "")
    said = capsys.readouterr().err
    assert "  1/50 after 100 s\n" in said
    assert "  11/50 after 120 s, about 78 s left\n" in said
