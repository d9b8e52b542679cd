"""Which iteration of a tuning is taken."""

from concurrent.futures import Executor
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
from model import CONFIG, ROBOT

from hector_jax.control.reference import named_command
from hector_jax.control.weights import nominal
from hector_jax.robot.description import TuningSettings
from hector_jax.runs import choice, verdicts
from hector_jax.runs.metrics import score_like
from hector_jax.tuning.difftune import Iteration, Tuning
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.status import StepStatus


def _tuning(count):
    """A tuning that accepted every second iteration; the weights tell how many came before."""
    seen = Evaluation(np.zeros(()), {}, nominal(), np.zeros(()), np.zeros(()))

    def iteration(i):
        weights = jax.tree.map(lambda w: w * (1.0 + i // 2), nominal())
        status = StepStatus.ROSE if i % 2 else StepStatus.ACCEPTED
        return Iteration(np.asarray(i), weights, seen, np.asarray(status), np.ones(()))

    history = [iteration(i) for i in range(2 * count - 1)]
    return Tuning(history, nominal(), history[-1].weights, "")


def test_the_best_point_of_each_path_over_all_commands_is_taken(monkeypatch, tmp_path, capsys):
    def judge(pool, config, robot, sets, command, plants, seeds, **notes):
        del pool, config, robot, notes
        assert (len(plants), list(seeds)) == (3, [0, 1, 2])
        assert {"start", "with-16", "without-8"} <= set(sets)
        scale = 1.0 if command is commands[0] else 100.0  # of a command that costs more

        def loss(name):
            number = float(sets[name].Q.euler[0] / nominal().Q.euler[0]) - 1
            worse = 1000.0 * name.startswith("without")
            return scale * (worse + 100.0 + (number - 8) ** 2)

        scores = {
            name: [score_like(loss=CONFIG.loss)._replace(losses={"L": np.array(loss(name))})] * 3
            for name in sets
        }
        return SimpleNamespace(scores=scores)

    monkeypatch.setattr(verdicts, "judge", judge)
    commands = named_command("straight"), named_command("c")
    tunings = {"with": _tuning(17), "without": _tuning(9)}
    description = replace(ROBOT.description, tuning=TuningSettings(choice_plants=3))
    asks = ROBOT._replace(description=description)
    notes = {"seconds": 4.0, "folder": tmp_path}
    chosen = choice.choose(Executor(), CONFIG, asks, tunings, commands, **notes)
    one = chosen["with"]
    assert (one.iteration, one.of) == (16, 32)
    np.testing.assert_array_equal(one.weights.Q.euler, 9 * nominal().Q.euler)
    assert chosen["without"].iteration == 0
    said = capsys.readouterr().err
    assert "with: iteration 16 of 32 walks best on plants drawn around the hfs: L -39 %" in said
    assert choice.choose(Executor(), CONFIG, ROBOT, tunings, commands, **notes) == {}
