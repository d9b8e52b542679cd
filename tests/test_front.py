"""The front of tracking, smooth commands and falls: its sets, walks, table and picture."""

from concurrent.futures import Executor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import BEST_OTHERS, CONFIG, ROBOT
from pretend import pretend_history, pretend_verdict

from hector_jax.cli import run_folder
from hector_jax.cli import tune as command
from hector_jax.cli.flags import Tune
from hector_jax.control.reference import named_command
from hector_jax.control.trajectories import NamedCommand
from hector_jax.control.weights import between, expert, nominal
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import State
from hector_jax.report import plots
from hector_jax.report.report import front_table
from hector_jax.runs import choice, front, tunings, verdicts
from hector_jax.runs.metrics import score_like
from hector_jax.runs.setup import Setup
from hector_jax.runs.tunings import Problem, Tuned
from hector_jax.runs.verdicts import ScoredWalk
from hector_jax.tuning.difftune import Tuning
from hector_jax.tuning.loss import alphas

SAFE = "10", "0.08", "0.04"
SETUP = Setup(Executor(), CONFIG, ROBOT)
COMMANDS = {"straight": named_command("straight"), "stop-and-go": named_command("stop-and-go")}


def _tuned(weights):
    return Tuned(Tuning(pretend_history(3), nominal(), weights, "done"), "")


def test_a_smoother_tuning_counts_the_changes_of_the_command_more_and_nothing_else():
    assert front.smoothed(SETUP, 1.0) == SETUP
    smooth = front.smoothed(SETUP, 3.0).config
    before = alphas(CONFIG.loss)
    assert alphas(smooth.loss) == {**before, "L_ctrl": 3.0 * before["L_ctrl"]}
    assert smooth.rollout == CONFIG.rollout


def test_each_smoothness_is_tuned_with_its_loss_and_judged_with_that_of_the_robot(
    monkeypatch, tmp_path
):
    def tune(setup, problems, folder, *, title, start):
        del folder, title
        np.testing.assert_array_equal(start.Q.euler, nominal().Q.euler)
        weight = alphas(setup.config.loss)["L_ctrl"]
        return {name: _tuned(jax.tree.map(lambda w: w * weight, expert())) for name in problems}

    def choose(setup, results, commands, **options):
        del results, options
        assert setup is SETUP
        assert commands == list(COMMANDS.values())
        return {}

    monkeypatch.setattr(tunings, "tune", tune)
    monkeypatch.setattr(choice, "choose", choose)
    problems = dict.fromkeys(("without", "with"), Problem((COMMANDS["straight"],), None))
    options = {"start": nominal(), "seconds": 4.0, "folder": tmp_path}
    tuned = front.tune(SETUP, COMMANDS, problems, **options)
    assert list(tuned) == list(front.SMOOTH)
    for smooth, pair in tuned.items():
        assert len(pair) == 2
        np.testing.assert_allclose(pair[1].Q.euler, smooth * expert().Q.euler)


def test_the_sets_lie_between_two_tunings_and_limit_the_position_error_more_and_more():
    sets = front.points(SETUP, {1.0: [nominal(), expert()], 10.0: [expert(), expert()]}, 0.25)
    assert len(sets) == 2 * len(front.SAFE)
    limits = [sets[f"smooth_1_safe_{safe}"].others["position_limit"] for safe in SAFE]
    assert limits == [10.0, 0.08, 0.04]
    middle = between(nominal(), expert(), 0.25)
    jax.tree.map(np.testing.assert_array_equal, sets["smooth_1_safe_10"][:2], middle[:2])


@pytest.fixture
def walked(monkeypatch, tmp_path):
    """Walks in which one set falls under pushes to the front and tracks twice as well."""
    seen = []
    anywhere = State(*np.zeros((4, 3)))

    def score_jobs(setup, jobs, *, title, folder, **options):
        del title, options
        assert setup is SETUP
        assert folder == tmp_path / "front"
        seen.extend(jobs.items())

        def score(case, job):
            mine = case[0].partition("-")[0] == "mine"
            falls = mine and job.push.force.any() and job.push.force[0, 0] > 0.0
            scale = 1.0 + case[1]  # by plant, so that only paired ratios are all alike
            L, L_ctrl = scale * (0.5 if mine else 1.0), scale * (1.2 if mine else 1.0)
            losses = dict.fromkeys(("L_Eul", "L_pos", "L"), np.array(L))
            losses |= {"L_ctrl": np.array(L_ctrl)}
            scored = score_like(loss=CONFIG.loss)._replace(losses=losses, fallen=np.array(falls))
            return ScoredWalk(scored, np.ones(()), anywhere, "", ""), None

        return {case: score(case, job) for case, job in jobs.items()}

    monkeypatch.setattr(verdicts, "score_jobs", score_jobs)
    options = {"seconds": 4.0, "folder": tmp_path}
    return front.walk(SETUP, COMMANDS, {"mine": expert()}, **options), seen


def test_all_sets_walk_alone_and_under_pushes_from_all_sides_on_the_same_plants(walked):
    result, seen = walked
    calm = len(COMMANDS) * front.PLANTS
    assert result.falls == {"nominal": 0, "expert": 0, "mine": 4 * calm}
    assert result.pushed == 8 * calm
    assert not any(score.fallen.any() for score in result.calm.scores.values())
    assert len(seen) == 3 * 9 * calm
    pushed = {tuple(np.round(job.push.force[0], 3)) for _, job in seen if job.push.force.any()}
    assert len(pushed) == 8
    np.testing.assert_allclose([np.linalg.norm(force) for force in pushed], 90.0, rtol=1e-4)
    plants = choice.drawn_plants(ROBOT, 20)  # of the choice, with room for more
    others = {float(job.imperfections.mass) for _, job in seen}
    assert not others & {float(plant.mass) for plant in plants}


def test_the_front_is_a_table_and_a_picture(walked, tmp_path):
    result, _ = walked
    rows = front_table(result).splitlines()
    assert rows[-1] == "| mine | -50 [-50, -50] | +20 [+20, +20] | 32 of 64 | 0 of 8 |"
    assert "against falls" in plots.front(tmp_path / "front.png", result)
    assert (tmp_path / "front.png").stat().st_size > 0


def _run(tmp_path, **flags):
    course = NamedCommand("straight", COMMANDS["straight"])
    net = SimpleNamespace(params=None)
    return command._Run(SETUP, tmp_path, Tune(**flags), nominal(), (course,), net)


def test_the_command_tunes_smoothly_and_takes_a_safe_set(monkeypatch, tmp_path):
    there, seen = _tuned(expert()), {}

    def tune(setup, *_, **__):
        seen["L_ctrl"] = alphas(setup.config.loss)["L_ctrl"]
        return {"without": there, "with": there}

    monkeypatch.setattr(tunings, "tune", tune)
    tuned = command._tune_sets(_run(tmp_path, smooth=3.0, safe=0.05))
    assert seen["L_ctrl"] == 3.0 * alphas(CONFIG.loss)["L_ctrl"]
    assert tuned.sets["best"].others == {**BEST_OTHERS, "position_limit": 0.05}


def test_the_command_stores_the_sets_of_the_front(monkeypatch, tmp_path):
    pairs = {smooth: [nominal(), expert()] for smooth in front.SMOOTH}
    monkeypatch.setattr(front, "tune", lambda *_, **__: pairs)
    walked = front.Front(pretend_verdict(), {}, 64)
    seen = []

    def walk(setup, commands, sets, **options):
        del setup, commands, options
        seen.extend(sets)
        return walked

    monkeypatch.setattr(front, "walk", walk)
    assert command._walk_front(_run(tmp_path, front=True)) is walked
    assert len(seen) == 9
    assert sorted(seen) == sorted(path.stem for path in (tmp_path / "front").glob("*.json"))


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ({"safe": 0.05, "start": "best"}, "--safe and --front set the position limit"),
        ({"front": True, "start": "best"}, "--safe and --front set the position limit"),
        ({"front": True, "refresh": 1}, "--front tunes through the first net"),
    ],
)
def test_what_a_front_cannot_be_with_is_refused(flags, words):
    with pytest.raises(InputError, match=words):
        run_folder.trajectories(Tune(**flags), ROBOT)


def test_a_front_that_was_added_to_a_run_stays_when_it_is_resumed_again(tmp_path):
    folder = run_folder.begin(tmp_path / "run", Tune())
    added = run_folder.resume(folder, Tune(front=True, data=tmp_path))
    assert added.front
    command._note_settings(_run(folder, front=True))
    assert run_folder.resume(folder, Tune(data=tmp_path)).front
