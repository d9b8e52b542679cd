"""Which iteration of a tuning is taken, and which set is the answer of a run."""

from concurrent.futures import Executor
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import BEST_OTHERS, CONFIG, ROBOT
from pretend import tuning_of

from hector_jax.control.footstep import FootstepConfig
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.reference import named_command
from hector_jax.control.weights import between, expert, nominal
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.robot.description import TuningSettings
from hector_jax.runs import choice, verdicts
from hector_jax.runs.metrics import score_like
from hector_jax.runs.setup import Setup
from hector_jax.tuning.difftune import Iteration
from hector_jax.tuning.evaluate import Evaluation
from hector_jax.tuning.status import StepStatus


def _tuning(count):
    """A tuning that accepted every second iteration; the weights tell how many came before."""
    seen = Evaluation(np.zeros(()), {}, nominal(), np.zeros(()), np.zeros(()))

    def iteration(i):
        weights = jax.tree.map(lambda w: w * (1.0 + i // 2), nominal())
        status = StepStatus.NO_GAIN if i % 2 else StepStatus.ACCEPTED
        return Iteration(np.asarray(i), weights, seen, np.asarray(status), np.ones(()))

    history = [iteration(i) for i in range(2 * count - 1)]
    return tuning_of(history)


def test_the_best_point_of_each_path_over_all_commands_is_taken(monkeypatch, tmp_path, capsys):
    def judge(setup, sets, command, plants, seeds, **notes):
        del setup, notes
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
    chosen = choice.choose(Setup(Executor(), CONFIG, asks), tunings, commands, **notes)
    one = chosen["with"]
    assert (one.iteration, one.of) == (16, 32)
    np.testing.assert_array_equal(one.weights.Q.euler, 9 * nominal().Q.euler)
    assert chosen["without"].iteration == 0
    said = capsys.readouterr().err
    assert "with: iteration 16 of 32 walks best on plants drawn around the hfs: L -39 %" in said
    assert choice.choose(Setup(Executor(), CONFIG, ROBOT), tunings, commands, **notes) == {}


def _between(sets, config=CONFIG, robot=ROBOT, safe=None):
    pair, notes = ("without", "with"), {"seconds": 4.0, "folder": None, "safe": safe}
    commands = (named_command("straight"),)
    return choice.answer(Setup(Executor(), config, robot), sets, pair, 0.25, commands, **notes)


def test_the_answer_lies_between_two_tunings_with_other_steps_and_a_limited_error():
    sets = {"nominal": nominal(), "without": nominal(), "with": expert()}
    found = _between(sets)
    assert found.others == BEST_OTHERS
    wanted = between(nominal(), expert(), 0.25)
    jax.tree.map(np.testing.assert_array_equal, found[:2], wanted[:2])
    tuned = {n: w._replace(others={"footstep_width": np.array(0.06)}) for n, w in sets.items()}
    assert _between(tuned).others == {**found.others, "footstep_width": 0.06}
    assert _between(sets, safe=0.05).others["position_limit"] == 0.05
    tall = ROBOT._replace(standing_height=2 * ROBOT.standing_height)
    assert _between(sets, robot=tall).others["position_limit"] == 0.161


@pytest.mark.parametrize(("limit", "width", "wanted"), [(1e-4, 0.1, 1e-3), (20.0, 0.3, 10.0)])
def test_the_answer_can_be_read_whatever_the_controllers_numbers(tmp_path, limit, width, wanted):
    sets = {"nominal": nominal(), "without": nominal(), "with": expert()}
    own = {"mpc": MpcConfig(position_limit=limit), "footstep": FootstepConfig(width=width)}
    rollout = replace(CONFIG.rollout, walk=replace(CONFIG.rollout.walk, **own))
    save_weights(tmp_path / "best.json", _between(sets, replace(CONFIG, rollout=rollout)))
    others = {"position_limit": wanted, "footstep_width": min(0.875 * width, 0.2)}
    others["footstep_feedback"] = 0.08
    assert load_weights(tmp_path / "best.json").others == pytest.approx(others)


def test_whichever_set_is_taken_has_the_limit_that_was_given(monkeypatch):
    def ratios(setup, sets, *inputs, **notes):
        del setup, inputs, notes
        assert not sets["nominal"].others
        return {name: np.array([float(name != "with")]) for name in sets}

    monkeypatch.setattr(choice, "_ratios", ratios)
    description = replace(ROBOT.description, tuning=TuningSettings(choice_plants=3))
    sets = {"nominal": nominal(), "without": nominal(), "with": expert()}
    asks = ROBOT._replace(description=description)
    assert _between(sets, robot=asks).others == {}
    assert _between(sets, robot=asks, safe=0.05).others == {"position_limit": 0.05}


@pytest.mark.parametrize("winner", ["with", "between"])
def test_a_robot_with_drawn_plants_takes_what_walks_best_there(monkeypatch, capsys, winner):
    def judge(setup, sets, command, plants, seeds, **notes):
        del setup, command, notes
        assert (len(plants), list(seeds)) == (2, [0, 1])
        assert list(sets) == ["nominal", "without", "with", "between"]
        cost = {name: np.array(0.5 if name == winner else 1.0) for name in sets}
        cost["nominal"] = np.array(0.1)  # what was not tuned is no answer
        score = score_like(loss=CONFIG.loss)
        return SimpleNamespace(
            scores={name: [score._replace(losses={"L": x})] * 2 for name, x in cost.items()}
        )

    monkeypatch.setattr(verdicts, "judge", judge)
    description = replace(ROBOT.description, tuning=TuningSettings(choice_plants=2))
    sets = {"nominal": nominal(), "without": nominal(), "with": expert()}
    found = _between(sets, robot=ROBOT._replace(description=description))
    wanted = {"with": expert(), "between": _between(sets)}[winner]
    jax.tree.map(np.testing.assert_array_equal, found, wanted)
    assert f"best: {winner} walks best on plants drawn around the hfs" in capsys.readouterr().err


@pytest.mark.parametrize(("second", "chosen"), [(0.60, "set 2"), (0.51, "set 1")])
def test_after_walks_the_earliest_set_as_good_as_the_best_is_taken(
    monkeypatch, capsys, second, chosen
):
    """On plants of its own: one standard error of the differences is 0.023 here."""
    median = {
        "set 0": 1.0,
        "set 1": second,
        "set 2": 0.5,
        "set 3": 0.9,
    }  # set 3 fits its own plants

    def judge(setup, sets, command, plants, seeds, **notes):
        del setup, command, notes
        assert len(plants) == choice.HELD_OUT
        tuned_on = choice.drawn_plants(ROBOT, 1000)  # the most of --walk-plants
        assert not {float(plant.mass) for plant in plants} & {float(p.mass) for p in tuned_on}
        score, spread = score_like(loss=CONFIG.loss), {"set 1": 0.06}
        return SimpleNamespace(
            scores={
                name: [
                    score._replace(losses={"L": np.array(x + spread.get(name, 0.0) * (-1) ** i)})
                    for i in seeds
                ]
                for name, x in median.items()
            }
        )

    monkeypatch.setattr(verdicts, "judge", judge)
    sets = dict.fromkeys(median, nominal())
    commands, notes = (named_command("s"),), {"seconds": 4.0, "folder": None}
    assert choice.earliest(Setup(Executor(), CONFIG, ROBOT), sets, commands, **notes) == chosen
    assert (
        f"best: {chosen}, the earliest as good as set 2 on 8 other plants"
        in capsys.readouterr().err
    )


def test_the_standard_error_of_that_choice_is_one_over_plants(monkeypatch):
    """Copies of a command are no further sample: log L differs by 0.6 standard errors."""
    excess = 0.1 * (-1.0) ** np.arange(choice.HELD_OUT)
    excess += 0.6 * excess.std(ddof=1) / np.sqrt(choice.HELD_OUT)

    def judge(*inputs, **notes):
        del inputs, notes
        losses, score = {"set 0": np.exp(-excess), "set 1": np.exp(-2 * excess)}, score_like()
        return SimpleNamespace(
            scores={
                name: [score._replace(losses={"L": np.asarray(x)}) for x in L]
                for name, L in losses.items()
            }
        )

    monkeypatch.setattr(verdicts, "judge", judge)
    sets, setup = dict.fromkeys(("set 0", "set 1"), nominal()), Setup(Executor(), CONFIG, ROBOT)
    for count in (1, 4):
        assert choice.earliest(setup, sets, (named_command("s"),) * count) == "set 0"
