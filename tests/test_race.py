"""The rivals of the race, on a bowl in place of a simulator."""

from importlib.util import find_spec

import numpy as np
import pytest
from rivals import RIVALS, Spent, Task

SIZE = 6
GOAL = np.linspace(-1.0, 1.0, SIZE)
NEEDS = {"lq-cma-es": "cma", "turbo": "botorch", "turbo on model": "botorch"}


def bowl(point):
    return float(np.log(1.0 + np.sum((point - GOAL) ** 2)))


def walked_by(name, budget=60):
    """Return the points that a rival walks, and their losses."""
    if not find_spec(NEEDS.get(name, "cmaes")):
        pytest.skip(f"{NEEDS[name]} is not installed")
    points, losses = [], []

    def walk(point):
        if len(points) == budget:
            raise Spent
        points.append(np.array(point))
        losses.append(bowl(points[-1]))
        return losses[-1]

    rough = 0.5 * GOAL + 0.3 * np.random.default_rng(0).standard_normal((200, SIZE))
    source = rough, np.array([bowl(point) for point in rough])
    with pytest.raises(Spent):
        RIVALS[name](Task(walk, np.tile([-2.0, 2.0], (SIZE, 1)), 0.5, 1, source))
    return np.array(points), np.array(losses)


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_goes_downhill_within_its_box_and_repeats_itself(name):
    points, losses = walked_by(name)
    assert losses.min() < 0.95 * bowl(np.zeros(SIZE))
    assert np.abs(points).max() <= 2.0 + 1e-9
    np.testing.assert_array_equal(walked_by(name, budget=20)[0], points[:20])
