"""Flags of a tuning that make `best` smoother or safer."""

from concurrent.futures import Executor
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import BEST_OTHERS, CONFIG, ROBOT
from pretend import instead, pretend_tuning
from synthetic import synthetic_walk

from hector_jax.cli import run_folder
from hector_jax.cli import tune as command
from hector_jax.cli.flags import Tune
from hector_jax.control.parameters import GROUPS
from hector_jax.control.trajectories import command_of
from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.store import tunings
from hector_jax.store.setup import Setup
from hector_jax.store.tunings import Tuned
from hector_jax.tuning.loss import alphas, between_loss
from hector_jax.verdict import choice


def _tunings(monkeypatch, folder, flags, robot=ROBOT, config=CONFIG):
    """Settings, start and problem of each tuning of a run with flags, by set."""
    seen = {}

    def tune(setup, problems, *, start, **_):
        seen.update({name: (setup.config, start, problem) for name, problem in problems.items()})
        return dict.fromkeys(problems, Tuned(pretend_tuning(3, start), ""))

    instead(monkeypatch, tunings, "tune_all", tune)
    setup, course = Setup(Executor(), config, robot), (command_of("straight"),)
    run = command._Run(setup, folder, flags, nominal(), course, SimpleNamespace(params=None))
    command._tune_sets(run)
    return seen


def test_best_alone_is_tuned_smoothly_on_drawn_models_with_its_own_numbers(monkeypatch, tmp_path):
    seen = _tunings(monkeypatch, tmp_path, Tune(smooth=3.0, safe=0.05))
    assert list(seen) == ["without", "with", "best"]
    for name in ("without", "with"):
        config, start, problem = seen[name]
        assert (config, start.others, problem.draws) == (CONFIG, {}, 0)
    config, start, problem = seen["best"]
    assert start.others == {**BEST_OTHERS, "position_limit": 0.05}
    before = alphas(CONFIG.loss)
    assert alphas(config.loss) == {**before, "L_between": 3.0 * before["L_ctrl"]}
    assert config.others == GROUPS["integral"]
    assert (config.rollout, problem.draws) == (CONFIG.rollout, choice.DRAWS)
    jax.tree.map(np.testing.assert_array_equal, start[:2], nominal()[:2])


def test_a_limit_of_the_position_error_is_set_once():
    with pytest.raises(InputError, match="--safe sets the position limit, which --start has"):
        run_folder.trajectories(Tune(safe=0.05, start="best"), ROBOT)


def test_changes_between_switches_are_those_of_control_without_switches():
    walk = synthetic_walk(0, 60)
    wrench = np.concatenate([walk.command.force, walk.command.moment], axis=-1)
    changes = np.sum(np.diff(wrench, axis=0) ** 2, axis=(1, 2))
    stays = np.all(walk.contact[1:] == walk.contact[:-1], axis=-1)
    assert 0 < stays.sum() < len(stays)
    between = float(between_loss(jax.tree.map(jnp.asarray, walk)))
    assert between == pytest.approx(changes[stays].sum())
