"""Flags of a tuning that make `best` smoother or safer."""

from concurrent.futures import Executor
from types import SimpleNamespace

import numpy as np
import pytest
from model import BEST_OTHERS, CONFIG, ROBOT
from pretend import pretend_tuning

from hector_jax.cli import run_folder
from hector_jax.cli import tune as command
from hector_jax.cli.flags import Tune
from hector_jax.control.trajectories import command_of
from hector_jax.control.weights import expert, nominal
from hector_jax.core.inputs import InputError
from hector_jax.runs import tunings
from hector_jax.runs.setup import Setup
from hector_jax.runs.tunings import Tuned
from hector_jax.tuning.loss import alphas


def test_the_command_tunes_smoothly_and_takes_a_safe_set(monkeypatch, tmp_path):
    tuned, seen = Tuned(pretend_tuning(3, expert()), ""), []

    def tune(setup, *_, **__):
        seen.append(setup.config)
        return {"without": tuned, "with": tuned}

    monkeypatch.setattr(tunings, "tune", tune)
    flags, net = Tune(smooth=3.0, safe=0.05), SimpleNamespace(params=None)
    setup, course = Setup(Executor(), CONFIG, ROBOT), (command_of("straight"),)
    run = command._Run(setup, tmp_path, flags, nominal(), course, net)
    best = command._tune_sets(run).sets["best"]
    (config,), before = seen, alphas(CONFIG.loss)
    assert alphas(config.loss) == {**before, "L_ctrl": 3.0 * before["L_ctrl"]}
    assert config.rollout == CONFIG.rollout
    assert best.others == {**BEST_OTHERS, "position_limit": np.array(0.05)}


def test_a_limit_of_the_position_error_is_set_once():
    with pytest.raises(InputError, match="--safe sets the position limit, which --start has"):
        run_folder.trajectories(Tune(safe=0.05, start="best"), ROBOT)
