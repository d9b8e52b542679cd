"""The table of delays, with walks whose losses are known."""

import json
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import delay
import numpy as np
import pytest

from hector_jax.core.inputs import InputError
from hector_jax.verdict import metrics


def test_each_change_walks_with_each_delay_and_seed(monkeypatch, tmp_path):
    def walk_many(pool, config, robot, jobs):
        del pool, robot
        for job in jobs:
            lost = 1e9 * job.imperfections.delay * job.seed * config.legs.kp[0] / 47.4
            yield SimpleNamespace(L=lost, losses={"L_ctrl": lost / 2}, fallen=lost > 1e7)

    monkeypatch.setattr(delay, "workers", lambda count: nullcontext())
    monkeypatch.setattr(delay, "walk_many", walk_many)
    monkeypatch.setattr(metrics, "score", lambda loss, walk: walk)
    words = ["--changes", "as proposed", "kp x 0.5", "--delays", "2", "5", "--lags", "4", "6"]
    monkeypatch.setattr(sys, "argv", ["delay.py", *words, "--seeds", "3", "--out", str(tmp_path)])
    delay.main()
    told = json.loads((tmp_path / "delay.json").read_text())
    walks = told["walks"]["quadruped"]["straight"]["as proposed"]
    assert [[walk["L"] / 1e6 for walk in cell] for cell in walks] == [
        pytest.approx([2.0, 4.0, 6.0]),
        pytest.approx([5.0, 10.0, 15.0]),
    ]
    report = (tmp_path / "report.md").read_text()
    assert "| as proposed | 4.00 (2.00) | 10.00 (5.00), 1 fell |" in report
    assert "| kp x 0.5 | 2.00 (1.00) | 5.00 (2.50) |" in report
    assert (tmp_path / "root-locus-quadruped.png").stat().st_size > 10_000
    growth = {
        name: np.array(max(locus[-1]))[0] for name, locus in told["root_locus"]["quadruped"].items()
    }
    assert growth[delay.BEFORE] > 2.0 * growth[delay.AS_PROPOSED]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"robots": ("robot.toml",)}, "--robots must be NAME=TOML, got 'robot.toml'"),
        ({"lags": (4.0,)}, "--lags must be one for each of --delays, got 4 delays and 1 lags"),
        ({"changes": ("kp",)}, "Flags.changes must be of as proposed"),
    ],
)
def test_a_wrong_flag_is_told(flags, message):
    with pytest.raises(InputError, match=message):
        delay.Flags(**flags)
