"""Proposals for tuning on few walks: from a history alone, on made-up losses."""

import numpy as np
import pytest

from hector_jax.search.few_walks import Model, WalkResult, incumbent, needs_model, propose, space_of

SIZE = 5
MATRIX = np.diag([4.0, 1.0, 0.25, 0.0])  # of four of the five steps
SPACE = space_of(MATRIX, np.tile([-3.0, 3.0], (SIZE, 1)))
GOAL = np.array([0.8, -0.6, 0.5, 0.4, -0.7])  # in steps
SCALE = np.append(np.diag(MATRIX), 1.0) + 0.3


def bowl(goal, point):
    """A log-loss with its least value, 0, at a goal, and its gradient."""
    away = SPACE.to_steps @ point - goal
    return 0.5 * away @ (SCALE * away), SPACE.to_steps.T @ (SCALE * away)


def model_of(goal):
    """A model whose loss is that bowl about a goal."""

    def evaluate(point):
        log, gradient = bowl(goal, point)
        return np.exp(log), np.exp(log) * gradient

    def matrix(point):
        return evaluate(point)[0] * SPACE.to_steps.T @ np.diag(SCALE) @ SPACE.to_steps

    return Model(evaluate, matrix)


# wrong about where the goal is, and does not feel the last number
model = model_of(GOAL * [0.8, 0.8, 0.5, 0.0, 0.0])


def walked(proposal, loss, margin=0.1):
    return WalkResult(*proposal, loss=loss, margin=margin)


def tune(walks, truth=lambda point: bowl(GOAL, point)[0], margin=lambda point: 0.1, by=model):
    history = []
    for _ in range(walks):
        proposal = propose(SPACE, history, by)
        history.append(walked(proposal, truth(proposal.point), margin(proposal.point)))
    return history


@pytest.fixture(scope="module")
def history():
    return tune(24)


def test_the_metric_makes_the_loss_round_and_leaves_unknown_numbers_alone():
    curved = SPACE.to_steps.T @ np.pad(MATRIX, (0, 1)) @ SPACE.to_steps
    np.testing.assert_allclose(curved, np.diag(SPACE.curvature), atol=1e-12)
    assert SPACE.curvature.max() < 1.0
    np.testing.assert_allclose(SPACE.to_point @ SPACE.to_steps, np.eye(SIZE), atol=1e-12)
    np.testing.assert_allclose(SPACE.to_steps[4], np.eye(SIZE)[4])


def test_the_model_leads_first_then_the_surrogate(history):
    methods = [row.method for row in history]
    turn = methods.index("surrogate")
    assert methods[0] == "start"
    assert 2 <= turn - 1 <= 6
    assert set(methods[1:turn]) == {"model"}
    assert set(methods[turn:]) == {"surrogate"}
    assert [needs_model(history[:i]) for i in (1, turn + 1)] == [True, False]


def test_without_a_model_the_surrogate_proposes_alone():
    rows = tune(12, by=None)
    assert {row.method for row in rows} == {"start", "surrogate"}
    assert min(row.loss for row in rows) < rows[0].loss


def test_what_the_model_does_not_know_is_found_by_the_walks(history):
    losses = [row.loss for row in history]
    turn = [row.method for row in history].index("surrogate")
    by_model = min(losses[:turn])
    assert by_model < 0.75 * losses[0]  # a model that is wrong helps
    assert min(losses) < 0.2 * by_model  # and is not all
    best = SPACE.to_steps @ history[incumbent(SPACE, history)].point
    assert abs(best[4] - GOAL[4]) < 0.35  # of which the model feels nothing


def test_a_model_that_repeats_itself_gives_way_to_the_surrogate_nearby():
    """Its predictions made the region large, which the surrogate has not earned."""
    history = []
    for _ in range(10):
        proposal = propose(SPACE, history, model_of(0.5 * GOAL))
        if proposal.method == "surrogate":
            break
        history.append(walked(proposal, bowl(0.5 * GOAL, proposal.point)[0]))
    assert proposal.method == "surrogate"
    points = [row.point for row in history]
    apart = [np.linalg.norm(x - y) for i, x in enumerate(points) for y in points[:i]]
    assert min(apart) > 0.02
    center = history[incumbent(SPACE, history)].point
    assert np.linalg.norm(proposal.point - center) < 1.02
    assert not needs_model([*history, walked(proposal, 0.1)])


def test_where_walks_never_repeat_the_region_is_about_the_last_good_one_and_grows():
    """One walk that gains less than predicted, by its noise, does not shrink it."""
    far = SPACE.to_point @ np.array([-2.0, 2.0, -2.0, 2.0, 0.0])
    start, good = np.zeros(SIZE), np.full(SIZE, 0.1)
    history = [WalkResult(start, "start", None, 0.0, 0.1)]
    history += [WalkResult(good, "model", -0.5, -0.02, 0), WalkResult(-good, "model", -0.6, 0.1, 0)]
    proposal = propose(SPACE, history, model_of(SPACE.to_steps @ far)._replace(every_walk=True))
    assert np.linalg.norm(proposal.point - good) == pytest.approx(2.0, rel=0.02)


def test_proposals_stay_in_the_box():
    narrow = SPACE._replace(box=np.tile([-0.1, 0.1], (SIZE, 1)))
    history = []
    for _ in range(8):
        proposal = propose(narrow, history, model)
        assert np.abs(narrow.to_steps @ proposal.point).max() <= 0.1 + 1e-12
        history.append(walked(proposal, bowl(GOAL, proposal.point)[0]))
    assert min(row.loss for row in history) < history[0].loss


def test_a_fall_shrinks_the_region_and_is_not_fitted(history):
    proposal = propose(SPACE, history[:1], model)
    fell = [history[0], walked(proposal, np.inf, 1.0)]
    after = propose(SPACE, fell, model)
    assert np.linalg.norm(after.point) < 0.7 * np.linalg.norm(proposal.point)
    assert incumbent(SPACE, fell) == 0
    late = [*history[:12], history[12]._replace(loss=np.inf, margin=1.0)]
    assert np.isfinite(propose(SPACE, late, model).point).all()
    assert incumbent(SPACE, late) != 12


def test_where_a_margin_is_short_the_surrogate_does_not_go(history):
    """The robot would fall beyond 0.3 of the last number, which is where the loss is least."""
    towards = lambda point: -(SPACE.to_steps @ point)[4]  # noqa: E731
    margin = lambda point: float(np.clip(0.1 + 1.2 * towards(point), 0.0, 1.0))  # noqa: E731
    careful, careless = tune(24, margin=margin), history  # whose margins are all the same
    beyond = [sum(towards(row.point) > 0.45 for row in one) for one in (careful, careless)]
    assert beyond[0] < beyond[1] / 2


def test_the_luckiest_walk_is_not_believed(history):
    """One walk is lucky by far more than the walks around it allow."""
    best = SPACE.to_steps @ history[incumbent(SPACE, history)].point
    away = 0.05 * np.random.default_rng(0).standard_normal((12, SIZE))
    around = [WalkResult(SPACE.to_point @ (best + x), "surrogate", None, 0.05, 0.1) for x in away]
    lucky = min(row.loss for row in history) - 0.02
    walks = [*history, *around[:-1], around[-1]._replace(loss=lucky)]
    assert incumbent(SPACE, walks) != len(walks) - 1
