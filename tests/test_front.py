"""The front of tracking, smooth commands and falls: its sets, walks, table and picture."""

from concurrent.futures import Executor
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from model import CONFIG, ROBOT

from hector_jax.control.reference import named_command
from hector_jax.control.weights import between, expert, nominal
from hector_jax.report import plots
from hector_jax.report.report import front_table
from hector_jax.runs import choice, front, tunings
from hector_jax.runs.metrics import score_like
from hector_jax.runs.setup import Setup
from hector_jax.tuning.loss import alphas

SETUP = Setup(Executor(), CONFIG, ROBOT)
COMMANDS = {"straight": named_command("straight"), "stop-and-go": named_command("stop-and-go")}


def test_a_smoother_tuning_counts_the_changes_of_the_command_more_and_nothing_else():
    assert front.smoothed(SETUP, 1.0) == SETUP
    smooth = front.smoothed(SETUP, 3.0).config
    before = alphas(CONFIG.loss)
    assert alphas(smooth.loss) == {**before, "L_ctrl": 3.0 * before["L_ctrl"]}
    assert smooth.rollout == CONFIG.rollout


def test_each_smoothness_is_tuned_with_its_loss_and_judged_with_that_of_the_robot(monkeypatch):
    def tune(setup, problems, folder, *, title, start):
        del folder, title
        assert start == "start"
        weight = alphas(setup.config.loss)["L_ctrl"]
        results = (SimpleNamespace(converged=(name, weight)) for name in problems)
        return dict(zip(problems, map(lambda r: SimpleNamespace(tuning=r), results), strict=True))

    def choose(setup, results, commands, **options):
        del results, options
        assert setup is SETUP
        assert commands == list(COMMANDS.values())
        return {}

    monkeypatch.setattr(tunings, "tune", tune)
    monkeypatch.setattr(choice, "choose", choose)
    problems = {"without": None, "with": None}
    options = {"start": "start", "seconds": 4.0, "folder": front.Path("kept")}
    tuned = front.tune(SETUP, COMMANDS, problems, **options)
    assert tuned == {s: [("without", s), ("with", s)] for s in front.SMOOTH}


def test_the_sets_lie_between_two_tunings_and_plan_with_less_and_less_friction():
    sets = front.points(SETUP, {1.0: [nominal(), expert()], 10.0: [expert(), expert()]}, 0.25)
    assert len(sets) == 2 * len(front.SAFE)
    friction = [sets[f"smooth_1_safe_{safe:.2f}"].others["friction"] for safe in front.SAFE]
    np.testing.assert_allclose(friction, [0.6, 0.55, 0.45])
    middle = between(nominal(), expert(), 0.25)
    jax.tree.map(np.testing.assert_array_equal, sets["smooth_1_safe_1.00"][:2], middle[:2])


@pytest.fixture
def points(monkeypatch, tmp_path):
    """Points of walks in which one set falls under pushes from behind and tracks twice as well."""
    seen = []

    def score_jobs(setup, jobs, *, title, folder):
        del title
        assert setup is SETUP
        assert folder == tmp_path / "front"
        seen.extend(jobs.items())

        def score(case, job):
            mine = case[0].startswith("mine-")
            pushed = job.push.force.any()
            falls = mine and pushed and job.push.force[0, 0] > 0.0
            scale = 1.0 + case[1]  # by plant, so that only paired ratios are all alike
            L, L_ctrl = scale * (0.5 if mine else 1.0), scale * (1.2 if mine else 1.0)
            losses = {"L": np.array(L), "L_ctrl": np.array(L_ctrl)}
            scored = score_like(loss=CONFIG.loss)._replace(losses=losses, fallen=np.array(falls))
            return SimpleNamespace(score=scored), None

        return {case: score(case, job) for case, job in jobs.items()}

    monkeypatch.setattr(front, "score_jobs", score_jobs)
    options = {"seconds": 4.0, "folder": tmp_path}
    return front.walk(SETUP, COMMANDS, {"mine": expert()}, **options), seen


def test_all_sets_walk_alone_and_under_pushes_from_all_sides_on_the_same_plants(points):
    (*_, mine), seen = points
    calm = len(COMMANDS) * front.PLANTS
    assert mine == pytest.approx(("mine", -50.0, 20.0, 4 * calm, 8 * calm, 0, calm))
    assert len(seen) == 3 * 9 * calm
    pushed = {tuple(np.round(job.push.force[0], 3)) for _, job in seen if job.push.force.any()}
    assert len(pushed) == 8
    np.testing.assert_allclose([np.linalg.norm(force) for force in pushed], 90.0, rtol=1e-4)
    plants = choice.drawn_plants(ROBOT, 20)  # of the choice, with room for more
    others = {float(job.imperfections.mass) for _, job in seen}
    assert not others & {float(plant.mass) for plant in plants}


def test_the_front_is_a_table_and_a_picture(points, tmp_path):
    rows = front_table(points[0]).splitlines()
    assert rows[-1] == "| mine | -50 | +20 | 32 of 64 | 0 of 8 |"
    caption = plots.front(tmp_path / "front.png", points[0])
    assert "64 walks under a push" in caption
    assert (tmp_path / "front.png").stat().st_size > 0
