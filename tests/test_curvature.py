"""Which weights matter: the Gauss-Newton matrix against differences, and its words."""

import jax
import numpy as np
import pytest

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import direction_names, nominal, scale_weights
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.tuning.curvature import gauss_newton, main_directions
from hector_jax.tuning.loss import PAPER_LOSS, losses, total
from hector_jax.tuning.rollout import RolloutConfig, rollout

ROBOT = load_robot()
CONFIG = RolloutConfig(ticks=30)
NAMES = direction_names()
WALK = named_command("c"), standing_anchor(ROBOT), last_command


def test_the_matrix_is_the_curvature_of_the_loss_along_the_change_of_the_walk():
    loss, matrix = gauss_newton(CONFIG, ROBOT, nominal(), *WALK, PAPER_LOSS)
    walk = jax.jit(rollout, static_argnums=0)

    def walked(name, step):
        logs = np.array([step * (one == name) for one in NAMES])
        found = walk(CONFIG, ROBOT, scale_weights(nominal(), logs), *WALK)
        return jax.tree.map(np.asarray, found)

    start = walked("", 0.0)

    def loss_at(state, command):
        moved = start._replace(state=state, command=command)
        return float(total(PAPER_LOSS, losses(PAPER_LOSS, moved)))

    here = loss_at(start.state, start.command)
    assert float(loss) == pytest.approx(here, rel=1e-12)
    for name in ("Q_z", "R_Fz", "Q_wy"):
        ends = [walked(name, step) for step in (1e-3, -1e-3)]
        slope = jax.tree.map(lambda x, y: (x - y) / 2e-3, *((e.state, e.command) for e in ends))
        around = [
            loss_at(*jax.tree.map(lambda x, d, h=h: x + h * d, (start.state, start.command), slope))
            for h in (1.0, -1.0)
        ]
        i = NAMES.index(name)
        assert float(matrix[i, i]) == pytest.approx(sum(around) - 2 * here, rel=1e-4)
    np.testing.assert_allclose(matrix, matrix.T, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())


def test_directions_are_said_with_the_weights_that_matter_in_them():
    matrix = np.zeros((18, 18))
    vector = np.zeros(18)
    vector[[NAMES.index("Q_pitch"), NAMES.index("Q_x"), NAMES.index("R_Fz")]] = 0.9, -0.43, 0.05
    matrix += np.outer(vector, vector)
    found = main_directions(matrix, nominal())
    (one,) = found.directions
    assert one.text == "`Q_pitch` against `Q_x`"
    assert one.change == pytest.approx(0.5 * np.log(2.0) ** 2 * vector @ vector)
    assert found.number == 18
    assert set(found.flat) == {*NAMES} - {"Q_pitch", "Q_x"}
