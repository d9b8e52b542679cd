"""Scripts: planted faults, golden results, scenes in the way, and the searches of a race."""

import ast
import json
import os
from dataclasses import replace
from functools import partial

import many_plants
import numpy as np
import pytest
import race
from model import ROOT
from pretend import pretend_score, python
from rivals import RIVALS, Task, search
from scenes import DIRECTIONS, Level, SceneConfig, evaluate_level, make_scenes, significant

from benchmarks import golden, mutation, table
from hector_jax import InputError, TuneConfig, hfs, load_robot, named_command, nominal
from hector_jax.core.tree import stack
from hector_jax.sim.engine import MUJOCO_C
from hector_jax.walk_tuning.campaign import Campaign

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


BOX = np.array([[-3.0, 1.0]] * 6)
GOAL = np.linspace(-2.0, 2.0, 6)  # partly beyond the box


def bowl(point):
    return np.sum((point - GOAL) ** 2) - np.sum(GOAL**2)


def test_cma_es_goes_downhill_inside_the_box():
    seen, losses = search(RIVALS["cma-es"], Task(bowl, bowl, BOX, 1.0, 3), 600)
    assert len(seen) == len(losses) == 600
    assert ((BOX[:, 0] <= seen) & (seen <= BOX[:, 1])).all()
    np.testing.assert_allclose(seen[-1], np.clip(GOAL, *BOX.T), atol=0.1)


def test_a_fall_is_worse_than_all_before_it_and_the_best_so_far_passes_over_falls_and_an_end():
    falling = lambda point: np.inf if point[0] < 0.0 else bowl(point)  # noqa: E731
    seen, losses = search(RIVALS["random"], Task(falling, bowl, BOX, 1.0, 3), 20)
    falls = np.flatnonzero(seen[:, 0] < 0.0)
    assert len(falls) > 5
    assert [losses[fall] for fall in falls] == [losses[:fall].max() + 1.0 for fall in falls]
    losses = np.array([[6.0, np.inf, 5.0, 7.0, 4.0], [6.0, 5.0, 3.0, np.nan, np.nan]])
    own = {1: [6.0, 6.0], 2: [6.0, 5.0], 5: [4.0, 3.0]}
    assert race.entry(losses) == {"own": own, "falls": [1, 0]}


def test_a_search_over_plants_that_was_cut_ends_as_if_it_had_not_been(monkeypatch, tmp_path):
    robot, walked = load_robot(), []
    inputs = tmp_path, TuneConfig(), robot, nominal(robot), {"s": named_command("s")}, [hfs()]
    campaign = Campaign(*inputs)

    def losses_of(pool, campaign, engine, sets, batch):
        walked.append(len(sets))
        for weights in sets:
            loss = 1.0 + np.log(weights.Q.euler[0] / campaign.start.Q.euler[0] / 2.0) ** 2
            yield np.array([loss if loss < 1.6 else np.inf])  # a QP that was not solved

    monkeypatch.setattr(many_plants, "losses_of", losses_of)
    flags = many_plants.Flags(generations=12, population=8)
    search = partial(many_plants.search, None, campaign, MUJOCO_C)
    whole, path = search(flags), tmp_path / "generations.jsonl"
    assert walked == [1, *[8] * 12]  # the start, then the generations
    assert whole.Q.euler[0] > 1.2 * campaign.start.Q.euler[0]
    lines = path.read_bytes().splitlines(keepends=True)
    assert b"null" in b"".join(lines)
    path.write_bytes(b"".join(lines[:9]) + lines[9][:50])
    walked.clear()
    np.testing.assert_array_equal(search(flags).Q.euler, whole.Q.euler)
    assert (walked, path.read_bytes()) == ([1, *[8] * 4], b"".join(lines))
    path.write_bytes(b"".join([*lines[:2], b'{"steps": [[0]], "losses": [1]}\n']))
    for other, told in ((flags, "line 3"), (replace(flags, seed=5), "made with seed 0")):
        walked.clear()  # the record knows its functions with all that they hold
        with pytest.raises(InputError, match=told):
            search(other)


def test_planted_faults_are_the_same_each_time_of_every_part_and_change_the_program():
    drawn = mutation.draw(ROOT, 200, seed=0)
    assert drawn == mutation.draw(ROOT, 200, seed=0)
    assert all(sum(one.part == part for one in drawn) == 50 for part in mutation.PARTS)
    for fault in drawn:
        source = (ROOT / fault.file).read_bytes()
        assert source[fault.begin : fault.end].decode() == fault.before
        planted = source[: fault.begin] + fault.after.encode() + source[fault.end :]
        assert ast.dump(ast.parse(planted)) != ast.dump(ast.parse(source))


def test_the_difference_of_two_results_is_beside_the_largest_number():
    one, missing = np.array([1.0, 100.0]), np.array([1.0, np.nan])
    assert golden.difference(one, one + [0.0, 1.0]) == pytest.approx(0.01)
    assert golden.difference(missing, missing) == 0.0
    for other in (missing, one[:1]):
        assert golden.difference(one, other) == np.inf


def test_the_page_of_performance_has_the_table_of_its_runs():
    page = table.PAGE.read_text()
    assert table.with_table(page) == page
    for path in table.RUNS.iterdir():
        run = json.loads(path.read_text())
        assert run["table"] == table.lines_of(run) != []
