"""Errors of a phi by phase, and where a rigid body goes under recorded commands."""

import json

import jax
import numpy as np
import pytest
from model import SHORT
from synthetic import synthetic_walk

from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal
from hector_jax.grfm.dataset import at_interval, make_dataset
from hector_jax.grfm.effect import last_command
from hector_jax.grfm.training import errors, errors_by_phi
from hector_jax.report import fidelity
from hector_jax.robot.model import load_robot
from hector_jax.tuning.rollout import Scenario, rollout


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture(scope="module")
def samples(robot):
    walks = [at_interval(synthetic_walk(i, 60), 0.01) for i in range(2)]
    return make_dataset(robot, jax.tree.map(lambda *x: np.stack(x), *walks))[0]


@pytest.fixture(scope="module")
def walks(robot):
    """A walk of the rigid body itself, on ground that returns what is commanded."""
    scenario = Scenario(robot, named_command("straight"), standing_anchor(robot), last_command)
    one = jax.jit(rollout, static_argnums=0)(SHORT, scenario, nominal())
    return jax.tree.map(lambda x: np.asarray(x)[None], one)


@pytest.fixture(scope="module")
def drifts(robot, walks):
    effects = {"raw": last_command, "measured": None}
    return {n: fidelity.drift(robot, e, walks, np.zeros(1, int)) for n, e in effects.items()}


def test_the_phases_make_up_the_whole(samples):
    told = fidelity.by_phase({"raw": last_command}, samples)["raw"]
    since, stands = samples.window.since_switch, samples.window.contact
    counts = [
        (((since > low - 1e-6) & (since < high - 1e-6))[:, None] & stands).sum()
        for low, high in fidelity.PHASES.values()
    ]
    assert sum(counts) == stands.sum()
    stance = np.average([told[phase]["stance"] for phase in told], axis=0, weights=counts)
    np.testing.assert_allclose(stance, errors(last_command, samples).stance)


def test_a_rigid_body_is_predicted_as_it_went(drifts):
    for found in drifts.values():
        assert found.time[-1] == pytest.approx(0.4)
        # the recorded foot is taken halfway through the tick, where it is set down at a switch
        assert found.position.max() < 0.01
        assert found.euler.max() < 0.05


def test_a_weaker_ground_lets_the_body_sag(robot, walks):
    weak = jax.tree_util.Partial(
        lambda window: last_command(window)._replace(
            wrench=jax.tree.map(lambda w: 0.9 * w[0], window.commands)
        )
    )
    found = fidelity.drift(robot, weak, walks, np.zeros(1, int))
    fall = 0.5 * 0.1 * 9.81 * 0.4**2  # a tenth of the weight is missing
    assert 0.5 * fall < found.position[-1] < 2.0 * fall


def test_what_follows_a_fall_is_not_predicted(robot, walks):
    two = jax.tree.map(lambda x: np.concatenate([x, x]), walks)
    fallen = two.fallen.copy()
    fallen[1, 20:] = True
    broken = jax.tree.map(np.copy, two)._replace(fallen=fallen)
    broken.state.position[1, 20:] = 7.0
    here = fidelity.drift(robot, last_command, broken, np.zeros(2, int))
    whole = fidelity.drift(robot, last_command, two, np.zeros(2, int))
    np.testing.assert_allclose(here.position, whole.position)
    short = walks._replace(fallen=walks.fallen[:, :30])
    with pytest.raises(ValueError, match="30 ticks are too short to predict 40 ticks"):
        fidelity.drift(robot, last_command, short, np.zeros(1, int))


def test_what_nothing_was_measured_of_is_null_and_a_dash(tmp_path, robot, samples, walks):
    """No sample in the last phase, no walk that stayed up: no warning, no NaN in a file."""
    early = samples.window.since_switch < 0.1
    some = jax.tree.map(lambda x: x[early], samples)
    fell = walks._replace(fallen=np.ones_like(walks.fallen))
    effects = {"raw": last_command}
    phis = {**effects, "measured": None}
    found = fidelity.as_result(
        errors_by_phi(effects, some),
        fidelity.by_phase(effects, some),
        {n: fidelity.drift(robot, e, fell, np.zeros(1, int)) for n, e in phis.items()},
    )
    text = fidelity.write_net_report(tmp_path, {"hfs": found}, []).read_text()
    assert "| last 50 ms, stance, F [N^2] | - |" in text
    assert "nan" not in text
    told = json.loads((tmp_path / "result.json").read_text())["hfs"]
    assert told["phases"]["raw"]["last 50 ms"] == {"stance": [None] * 6, "swing": [None] * 6}
    assert told["open_loop"]["measured"]["0.4 s"] == {"position": None, "euler": None}
