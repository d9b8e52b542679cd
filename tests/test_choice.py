"""The set `best` of a run: its settings, and which point of the path of its tuning it is."""

import itertools
from concurrent.futures import Executor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import BEST_OTHERS, CONFIG, ROBOT
from pretend import instead, pretend_score, pretend_tuning

from hector_jax.cli import run_folder
from hector_jax.cli.flags import Tune
from hector_jax.control.parameters import GROUPS
from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.core.inputs import InputError
from hector_jax.store.setup import Setup
from hector_jax.tuning.loss import alphas
from hector_jax.verdict import choice, judging


def test_start_quarter_half_and_end_of_the_accepted_path_walk():
    points = choice.points_of(pretend_tuning(16, refused=range(1, 16, 2)))
    assert list(points) == ["iteration 0", "iteration 4", "iteration 8", "iteration 16"]
    assert list(choice.points_of(pretend_tuning(0))) == ["iteration 0"]


@pytest.mark.parametrize("winner", ["set 0", "set 2"])
def test_the_set_that_walks_best_on_drawn_plants_is_taken(monkeypatch, capsys, winner):
    def judge(setup, sets, command, plants, seeds, **notes):
        walked.append({float(plant.mass) for plant in plants})
        scale = 1.0 if command is straight else 100.0
        scores = {name: [pretend_score(scale * losses[name])] * len(plants) for name in sets}
        return SimpleNamespace(scores=scores)

    instead(monkeypatch, judging, "judge", judge)
    walked = []
    losses = {"set 0": 1.0, "set 1": 0.9, "set 2": 1.1, "set 3": 2.0, winner: 0.5}
    setup, sets = Setup(Executor(), CONFIG, ROBOT), dict.fromkeys(losses, nominal())
    straight, turning = map(named_command, ("straight", "c"))
    for plants in (3, choice.HELD_OUT):  # after a tuning, and after walks
        best = choice.walks_best(setup, sets, (straight, turning), plants, seconds=4.0, folder=None)
        assert best == winner
    tuned_on = {float(plant.mass) for plant in choice.drawn_plants(ROBOT, 1000)}  # the most
    assert [len(plants) for plants in walked] == [3, 3, 8, 8]
    assert not any(a & b for a, b in itertools.combinations((tuned_on, *walked[::2]), 2))
    said = capsys.readouterr().err
    assert f"best: {winner} of set 0 to set 3 walks best on 3 plants drawn around the hfs" in said


def test_best_is_tuned_with_numbers_of_its_own_and_smoothly_where_asked():
    start = nominal()._replace(others={"footstep_width": np.array(0.09)})
    config, at = choice.settings_of_best(CONFIG, ROBOT, start, smooth=3.0, safe=0.05)
    assert at.others == {**BEST_OTHERS, "position_limit": 0.05, "footstep_width": 0.09}
    before = alphas(CONFIG.loss)
    assert alphas(config.loss) == {**before, "L_between": 3.0 * before["L_ctrl"]}
    assert config.others == GROUPS["integral"]
    assert config.rollout == CONFIG.rollout
    jax.tree.map(np.testing.assert_array_equal, at[:2], start[:2])


def test_a_limit_of_the_position_error_is_set_once():
    with pytest.raises(InputError, match="--safe sets the position limit, which --start has"):
        run_folder.trajectories(Tune(safe=0.05, start="best"), ROBOT)
