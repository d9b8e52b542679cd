"""Rivals on a bowl in place of a simulator, and the contests of the race."""

from importlib.util import find_spec

import jax
import numpy as np
import pytest
import race
from model import AHEAD, BRIEF
from rivals import RIVALS, Spent, Task

from hector_jax.control.weights import expert, nominal
from hector_jax.core.trajectory import no_samples
from hector_jax.robot.model import load_robot
from hector_jax.sim.world import hfs
from hector_jax.tuning.difftune import TuneConfig
from hector_jax.walk_tuning import walks
from hector_jax.walk_tuning.campaign import Campaign, box_of
from hector_jax.walk_tuning.walk_log import LogScore, log_of

SIZE = 6
GOAL = np.linspace(-1.0, 1.0, SIZE)
NEEDS = {"lq-cma-es": "cma", "turbo": "botorch", "turbo on model": "botorch"}


def bowl(point):
    return float(np.log(1.0 + np.sum((point - GOAL) ** 2)))


def walked_by(name, seed=1, budget=60, loss=bowl, box=2.0):
    """Return the points that a rival walks, and their losses."""
    if not find_spec(NEEDS.get(name, "cmaes")):
        pytest.skip(f"{NEEDS[name]} is not installed")
    points, losses = [], []

    def walk(point):
        if len(points) == budget:
            raise Spent
        points.append(np.array(point))
        losses.append(loss(points[-1]))
        return losses[-1]

    rough = 0.5 * GOAL + 0.3 * np.random.default_rng(0).standard_normal((200, SIZE))
    source = rough, np.array([bowl(point) for point in rough])
    with pytest.raises(Spent):
        RIVALS[name](Task(walk, np.tile([-box, box], (SIZE, 1)), 0.5, seed, source))
    return np.array(points), np.array(losses)


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_goes_downhill_within_its_box_and_repeats_itself(name):
    points, losses = walked_by(name)
    assert losses.min() < 0.95 * bowl(np.zeros(SIZE))
    assert np.abs(points).max() <= 2.0 + 1e-9
    np.testing.assert_array_equal(walked_by(name, budget=20)[0], points[:20])


def test_differences_halve_a_step_that_raises_the_loss():
    points, losses = walked_by("differences", budget=SIZE + 4, loss=lambda x: bowl(20.0 * x))
    np.testing.assert_allclose(points[1 : SIZE + 1], np.log(1.05) * np.eye(SIZE))
    lengths = np.linalg.norm(points[SIZE + 1 :], axis=1)
    assert losses[SIZE + 1] > losses[0]
    np.testing.assert_allclose(lengths[1:] / lengths[:-1], 0.5)


@pytest.fixture(scope="module")
def robot():
    return jax.tree.map(np.asarray, load_robot())


@pytest.fixture
def bowl_walks(monkeypatch, robot):
    """Walk on a bowl: L falls towards the expert's weights."""
    made, log = [], log_of(no_samples(len(robot.joint_lower), len(robot.foot_point)))

    def walk_case(campaign, weights, case):
        made.append(weights)
        steps = [np.log(a / b) for a, b in zip(weights.Q, expert().Q, strict=True)]
        score = LogScore(1.0 + float(np.sum(np.square(steps))), 0.1)
        return score, log

    monkeypatch.setattr(walks, "walk_case", walk_case)
    monkeypatch.setattr(walks, "save_tree", lambda *args, **options: None)
    return made


def contest(folder, robot, method, seed=0):
    entry = race.Contest("short", "nominal", method, seed)
    inputs = folder, TuneConfig(rollout=BRIEF), robot, nominal(robot), {"short": AHEAD}, [hfs()]
    campaign = Campaign(*inputs, seed=seed, **race.OURS.get(method, {}))
    size = len(box_of(campaign))
    rng = np.random.default_rng(0)
    space = race.few_walks.space_of(np.eye(size), box_of(campaign))
    return campaign, entry, race.Model(space, rng.normal(size=(50, size)), rng.random(50))


@pytest.mark.parametrize("method", ["cma-es", "random in metric", "no gradients"])
def test_a_contest_that_was_cut_ends_as_if_it_had_not_been(robot, bowl_walks, tmp_path, method):
    one = contest(tmp_path / "one", robot, method)
    race.contest_job(*one, 12)
    count = one[1].rows_after(12)
    assert count == 12 + (method != "no gradients")
    assert len(bowl_walks) == count
    whole = (tmp_path / "one" / "walks.jsonl").read_bytes()
    other = contest(tmp_path / "other", robot, method)
    race.contest_job(*other, 5)
    race.contest_job(*other, 12)
    assert len(bowl_walks) == 2 * count  # none twice
    assert (tmp_path / "other" / "walks.jsonl").read_bytes() == whole


def test_a_lead_is_paired_and_charges_the_net():
    def at(*rows):
        return dict(zip((0, 36, 100), map(list, rows), strict=True))

    losses = {
        race.Entry("tuned", "walks"): at((2.0, 2.0), (1.5, 1.5), (1.0, 1.1)),
        race.Entry("tuned", "cma-es"): at((2.0, 2.0), (1.4, 1.4), (1.25, 1.375)),
        race.Entry("nominal", "random"): at((6.0, 6.0), (5.0, 5.0), (3.0, 3.0)),
    }
    ours = next(iter(losses))
    found = race.lead(losses, ours, 100)
    assert found.rival == race.Entry("tuned", "cma-es")
    np.testing.assert_allclose(found[1:], 0.8)
    charged = race.lead(losses, ours, 100, charge=64)
    assert charged.rival == race.Entry("nominal", "random")
    np.testing.assert_allclose(charged[1:], 0.5)
