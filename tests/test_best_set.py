"""The set `best` of a run: its settings, and the plants on whose walks it is tuned further."""

import jax
import numpy as np
import pytest
from model import BEST_OTHERS, CONFIG, ROBOT

from hector_jax import InputError, hfs, nominal
from hector_jax.cli import arguments
from hector_jax.control.parameters import GROUPS
from hector_jax.tuning.loss import alphas
from hector_jax.walk_tuning import best_set


def masses(plants):
    return [float(plant.mass) for plant in plants]


# flags, commands, and the plants and walks: four sets, none beside the hfs, or eight sets
BUDGETS = [
    (None, None, 1, 12, 48),
    (None, None, 3, 12, 144),
    (2, None, 1, 2, 8),
    (0, None, 1, 1, 4),
]
BUDGETS += [(None, 0, 1, 1, 0), (None, 2, 1, 1, 2), (None, 40, 1, 5, 40), (None, 36, 3, 1, 36)]
BUDGETS += [(None, 100_000, 1, 16, 100_000), (3, 24, 2, 3, 24)]


@pytest.mark.parametrize("budget", BUDGETS)
def test_a_budget_is_four_sets_on_twelve_plants_or_eight_on_more(budget):
    *given, plants, walks = budget
    found, all_walks = best_set.walk_plants(ROBOT, *given)
    assert (len(found), all_walks) == (plants, walks)
    if given[0] == 0:
        same = jax.tree.map(np.array_equal, found, [hfs(ROBOT.description)])
        assert jax.tree.all(same)
    else:  # a larger budget begins with the same plants
        assert masses(found) == masses(best_set.drawn_plants(ROBOT, 16)[:plants])
        assert len(set(masses(found))) == plants


def test_plants_of_a_tuning_are_none_that_judge_it():
    standin = masses(arguments.plants("standin", range(32), ROBOT.description))
    assert not {*standin} & {*masses(best_set.drawn_plants(ROBOT, 1000))}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((None, 1, 1), "at least 2 (1 command on 1 plant, twice), got 1"),
        ((None, 5, 3), "at least 6 (3 commands on 1 plant, twice), got 5"),
        ((8, 15, 1), "at least 16 (1 command on 8 plants, twice), got 15"),
        ((0, 3, 2), "at least 4 (2 commands on 1 plant, twice), got 3"),
    ],
)
def test_a_budget_with_which_no_second_set_walks_is_one_line(given, words):
    with pytest.raises(InputError) as error:
        best_set.walk_plants(ROBOT, *given)
    assert str(error.value) == f"--walks must be 0 or {words}"


def test_best_is_tuned_with_numbers_of_its_own_and_smoothly_where_asked():
    start = nominal()._replace(others={"footstep_width": np.array(0.09)})
    config, at = best_set.settings_of_best(CONFIG, ROBOT, start, smooth=3.0, safe=0.05)
    assert at.others == {**BEST_OTHERS, "position_limit": 0.05, "footstep_width": 0.09}
    before = alphas(CONFIG.loss)
    assert alphas(config.loss) == {**before, "L_between": 3.0 * before["L_ctrl"]}
    assert config.others == GROUPS["integral"]
    assert config.rollout == CONFIG.rollout
    jax.tree.map(np.testing.assert_array_equal, at[:2], start[:2])
