"""Which point of the path of a tuning is the set `best` of a run."""

from concurrent.futures import Executor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import CONFIG, ROBOT
from pretend import instead, tuning_of

from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.store.setup import Setup
from hector_jax.tuning.difftune import Iteration
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.status import StepStatus
from hector_jax.verdict import choice, judging
from hector_jax.verdict.metrics import score_like

SETUP = Setup(Executor(), CONFIG, ROBOT)


def _tuning(count):
    """A tuning that accepted every second iteration; the weights tell how many came before."""
    seen = Evaluation(np.zeros(()), {}, nominal(), np.zeros(()), np.zeros(()))

    def iteration(i):
        weights = jax.tree.map(lambda w: w * (1.0 + i // 2), nominal())
        status = StepStatus.NO_GAIN if i % 2 else StepStatus.ACCEPTED
        return Iteration(np.asarray(i), weights, seen, np.asarray(status), np.ones(()))

    history = [iteration(i) for i in range(2 * count - 1)]
    return tuning_of(history)


def test_start_quarter_half_and_end_of_the_accepted_path_walk():
    points = choice.points_of(_tuning(9))
    assert list(points) == ["iteration 0", "iteration 4", "iteration 8", "iteration 16"]
    scale = points["iteration 8"].Q.euler / nominal().Q.euler
    np.testing.assert_array_equal(scale, np.full(3, 5.0))
    assert list(choice.points_of(_tuning(1))) == ["iteration 0"]


def _walk(monkeypatch, median):
    """Let sets walk with these losses on even plants, in reverse order on odd ones."""

    def judge(setup, sets, command, plants, seeds, **notes):
        assert "drawn around the hfs" in notes["title"]
        tuned_on = choice.drawn_plants(ROBOT, 1000)  # the most of --walk-plants
        assert not {float(plant.mass) for plant in plants} & {float(p.mass) for p in tuned_on}
        scale, score = (1.0, 100.0)[command is not STRAIGHT], score_like(loss=CONFIG.loss)
        costs = {name: [scale * x * (0.9, 1.1)[i % 2] for i in seeds] for name, x in median.items()}
        return SimpleNamespace(
            scores={
                name: [score._replace(losses={"L": np.array(L)}) for L in costs[name]]
                for name in sets
            }
        )

    instead(monkeypatch, judging, "judge", judge)


STRAIGHT = named_command("straight")


@pytest.mark.parametrize("winner", ["set 0", "set 2"])
def test_the_set_that_walks_best_on_drawn_plants_is_taken(monkeypatch, capsys, winner):
    losses = {"set 0": 1.0, "set 1": 0.9, "set 2": 1.1, "set 3": 2.0, winner: 0.5}
    _walk(monkeypatch, losses)
    sets, commands = dict.fromkeys(losses, nominal()), (STRAIGHT, named_command("c"))
    assert choice.walks_best(SETUP, sets, commands, 3, seconds=4.0, folder=None) == winner
    said = capsys.readouterr().err
    assert f"best: {winner} of set 0 to set 3 walks best on 3 plants drawn around the hfs" in said
