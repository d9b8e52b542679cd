"""Errors of a phi by phase, and where a rigid body goes under recorded commands."""

import json

import jax
import numpy as np
import pytest
from model import ANCHOR, ROBOT, SHORT
from synthetic import synthetic_walk

from hector_jax import Scenario, last_command, named_command, nominal, rollout
from hector_jax.grfm.dataset import at_interval, make_dataset
from hector_jax.grfm.training import errors_by_phi
from hector_jax.report import fidelity


@pytest.fixture(scope="module")
def walks():
    """A walk of the rigid body itself, on ground that returns what is commanded."""
    scenario = Scenario(ROBOT, named_command("straight"), ANCHOR, last_command)
    one = jax.jit(rollout, static_argnums=0)(SHORT, scenario, nominal())
    return jax.tree.map(lambda x: np.asarray(x)[None], one)


def drift(effect, walks):
    return fidelity.drift(ROBOT, effect, walks, np.zeros(len(walks.fallen), int))


def test_a_rigid_body_is_predicted_up_to_a_fall_and_a_weaker_ground_lets_it_sag(walks):
    for effect in (last_command, None):
        found = drift(effect, walks)
        assert found.time[-1] == pytest.approx(0.4)
        # the recorded foot is taken halfway through the tick, where it is set down at a switch
        assert found.position.max() < 0.01
        assert found.euler.max() < 0.05
    less = lambda window: jax.tree.map(lambda w: 0.9 * w[0], window.commands)  # noqa: E731
    weak = jax.tree_util.Partial(lambda x: last_command(x)._replace(wrench=less(x)))
    fall = 0.5 * 0.1 * 9.81 * 0.4**2  # a tenth of the weight is missing
    assert 0.5 * fall < drift(weak, walks).position[-1] < 2.0 * fall
    two = jax.tree.map(lambda x: np.concatenate([x, x]), walks)
    whole = drift(last_command, two)
    two.fallen[1, 20:] = True
    two.state.position[1, 20:] = 7.0
    np.testing.assert_allclose(drift(last_command, two).position, whole.position)
    with pytest.raises(ValueError, match="30 ticks are too short to predict 40 ticks"):
        drift(last_command, walks._replace(fallen=walks.fallen[:, :30]))


def test_what_nothing_was_measured_of_is_null_and_a_dash(tmp_path, walks):
    """No sample in the last phase, no walk that stayed up: no warning, no NaN in a file."""
    synthetic = [at_interval(synthetic_walk(i, 60), 0.01) for i in range(2)]
    samples = make_dataset(ROBOT, jax.tree.map(lambda *x: np.stack(x), *synthetic))[0]
    early = samples.window.since_switch < 0.1
    some = jax.tree.map(lambda x: x[early], samples)
    fell = walks._replace(fallen=np.ones_like(walks.fallen))
    effects = {"raw": last_command}
    found = fidelity.as_result(
        errors_by_phi(effects, some),
        fidelity.by_phase(effects, some),
        {"raw": drift(last_command, fell), "measured": drift(None, fell)},
    )
    text = fidelity.write_net_report(tmp_path, {"hfs": found}, []).read_text()
    assert "| last 50 ms, stance, F [N^2] | - |" in text
    assert "nan" not in text
    told = json.loads((tmp_path / "result.json").read_text())["hfs"]
    assert told["phases"]["raw"]["last 50 ms"] == {"stance": [None] * 6, "swing": [None] * 6}
    assert told["open_loop"]["measured"]["0.4 s"] == {"position": None, "euler": None}
