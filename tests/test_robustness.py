"""Scenes with something in the way, and what is told of their walks."""

import json
import os

import numpy as np
import pytest
from model import ROOT
from pretend import pretend_score, python
from scenes import DIRECTIONS, Level, SceneConfig, evaluate_level, make_scenes, significant

from hector_jax.core.tree import stack

SMALL = SceneConfig(forces=(50.0, 100.0), frictions=(0.4, 0.2), phases=3)


def scores(losses, fallen=()):
    """Scores of (plants, scenes); `fallen` names pairs that fell."""
    rows = [
        [pretend_score(loss, (i, j) in fallen) for j, loss in enumerate(row)]
        for i, row in enumerate(losses)
    ]
    return stack([stack(row) for row in rows])


def test_pushes_come_from_eight_sides_at_all_phases_of_a_cycle():
    found = make_scenes(SMALL, "straight")[Level("push", 50.0)]
    force = np.stack([scene.push.force[0] for scene in found])
    angles = np.rad2deg(np.arctan2(force[:, 1], force[:, 0])) % 360
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), 50.0)
    np.testing.assert_allclose(angles, np.repeat(DIRECTIONS, 3), atol=1e-9)
    start = np.array([scene.push.start[0] for scene in found[:3]])
    np.testing.assert_allclose((start - start[0]) / 0.4, [0, 1 / 3, 2 / 3])
    assert all(scene.push.start[0] + 1.0 < scene.seconds for scene in found)


def test_a_set_is_judged_by_the_median_of_paired_ratios_and_plants_are_its_sample():
    losses = np.array([[2e6, 4e6, 8e6], [1e6, 3e6, 9e6]])
    half = evaluate_level(scores(0.5 * losses), scores(losses))
    assert (half.ratio.value, half.survived.value) == pytest.approx((0.5, 1.0))
    assert (half.falls, half.walks, half.counts) == (0, 6, True)
    base, fell = np.full((4, 3), 1e6), {(i, k) for i in (2, 3) for k in range(3)}
    found = evaluate_level(scores(base * [[0.5], [0.5], [2.0], [2.0]], fell), scores(base))
    assert found.ratio == pytest.approx((1.25, 0.5, 2.0))
    assert found.survived == pytest.approx((0.5, 0.0, 1.0))
    assert (found.falls, found.falls_by_plant) == (6, (0, 0, 3, 3))
    assert not found.counts
    alone = evaluate_level(scores(base[:1]), scores(base[:1]))
    assert np.isnan(alone.ratio.low)


def test_falling_more_often_is_an_exact_test_on_scenes_that_differ_corrected_step_by_step():
    base, ours = np.full((2, 4), 1e6), {(0, 0), (0, 1), (1, 2)}
    found = evaluate_level(scores(base, ours), scores(base, {(1, 2), (1, 3)}))
    assert (found.more, found.fewer) == (2, 1)
    assert found.p == pytest.approx(4 / 8)  # two or three of three
    same = evaluate_level(scores(base), scores(base))
    assert (same.more, same.fewer, same.p) == (0, 0, 1.0)
    assert significant([0.2, 0.012, 0.001, 0.02]) == [2, 1, 3]  # 0.05 / 4, / 3, / 2
    assert significant([0.013, 0.013, 0.013, 0.013]) == []


@pytest.mark.slow
def test_the_report_is_written_and_walks_are_taken_up_again(tmp_path):
    script = [ROOT / "experiments/robustness.py", "--out", tmp_path]
    flags = "--plants ideal=0-0 --traj straight --forces 50 --frictions 0.4 --phases 1"
    call = [*script, *flags.split(), "--processes", "1"]
    options = {"env": os.environ | {"PYTHONPATH": str(ROOT)}, "check": True}
    runs = [python(*call, **options) for _ in range(2)]
    assert {run.stdout.strip() for run in runs} == {str(tmp_path / "report.md")}
    assert "36 walks" in runs[0].stderr
    assert "walks" not in runs[1].stderr
    told = json.loads((tmp_path / "robustness.json").read_text())
    calm = told["cells"][0]
    assert [calm[key] for key in ("traj", "world", "level")] == ["straight", "ideal", "calm floor"]
    assert calm["sets"]["expert"]["falls"] == 0
    assert told["totals"]["nominal"]["walks"] == 18
    assert (tmp_path / "straight-ideal.png").exists()
