"""The comparison of ridges, with tunings and walks whose losses are known."""

import json
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import ridge
from pretend import pretend_tuning

from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.store import nets, tunings
from hector_jax.verdict import judging


def test_the_ridges_are_compared_by_the_mean_log_ratio(monkeypatch, tmp_path):
    def tune(setup, problems, folder, *, title):
        del folder, title
        weights = nominal()._replace(others={"ridge": setup.config.ridge})
        return {key: SimpleNamespace(tuning=pretend_tuning(weights=weights)) for key in problems}

    def judge(setup, sets, command, plants, seeds, **_):
        del setup, command, plants
        factor = {name: 1.0 - 10.0 * w.others.get("ridge", 0.0) for name, w in sets.items()}
        scores = {n: [SimpleNamespace(L=2.0 * f * i) for i in seeds] for n, f in factor.items()}
        return SimpleNamespace(scores=scores)

    monkeypatch.setattr(ridge, "workers", lambda count: nullcontext())
    monkeypatch.setattr(nets, "load_or_train", lambda *_: SimpleNamespace(params=None))
    monkeypatch.setattr(tunings, "tune_all", tune)
    monkeypatch.setattr(judging, "judge", judge)
    words = ["--ridges", "0.0", "0.01", "--plants", "2", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["ridge.py", *words])
    ridge.main()
    told = json.loads((tmp_path / "out/ridge.json").read_text())
    assert np.shape(told["losses"]["hector"]["c"]["all-0.01"]) == (2,)
    report = (tmp_path / "out/report.md").read_text()
    assert "| 0.01 | -10.0 (worst -10) | -0.105 |" in report
    assert "| 0 | +0.0 (worst +0) | 0.000 |" in report


def test_a_robot_needs_a_name():
    with pytest.raises(InputError, match="--robots must be NAME=TOML, got 'robot.toml'"):
        ridge.Flags(robots=("robot.toml",))
