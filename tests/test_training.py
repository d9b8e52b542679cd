"""Training GRFM-Net on walks that no simulator made, and what is told of a phi."""

import doctest
import json
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from model import ANCHOR, ROBOT, SHORT
from synthetic import synthetic_walk

from hector_jax import Scenario, named_command, nominal, rollout
from hector_jax.core.tree import stack
from hector_jax.grfm.dataset import at_interval, make_dataset, split_by_walk
from hector_jax.grfm.effect import Phi, last_command
from hector_jax.grfm.network import VARIANTS, as_effect, load_net, save_net
from hector_jax.grfm.training import TrainConfig, errors, errors_by_phi, train
from hector_jax.report import fidelity

paper = partial(TrainConfig, "paper", batch=64)


@pytest.fixture(scope="module")
def parts():
    walks = [at_interval(synthetic_walk(i, 200, 0.3), 0.01) for i in range(10)]
    return split_by_walk(make_dataset(ROBOT, stack(walks))[0], 0.3)


@pytest.fixture(scope="module")
def trained(parts):
    return train(paper(epochs=25, learning_rate=3e-3, mirror=False), *parts)


def test_the_residual_net_beats_its_linear_part_on_walks_it_never_saw(parts):
    gated, _ = train(TrainConfig("gated"), *parts)
    params, history = train(TrainConfig(epochs=10, batch=64, learning_rate=2e-3), *parts)
    phis = {"raw": last_command, "gated": as_effect(gated), "net": as_effect(params)}
    told = errors_by_phi(phis, parts[1])
    for kind in ("force", "moment"):
        assert told["net"][kind] < 0.99 * told["gated"][kind]
        assert told["gated"][kind] < 0.9 * told["raw"][kind]
    # the mean of an ensemble is no worse than its members in the mean
    assert told["net"]["force"] < 1.001 * history.valid_force.min()


def test_the_error_of_touchdowns_is_that_of_feet_that_land(parts):
    data = parts[1]
    lands = ~data.window.contact & (np.arange(len(data.walk)) % 3 == 0)[:, None]
    away = np.where(lands[..., None], [0.02, -0.01, 0.5], np.nan)
    learned = data._replace(lands=lands, touchdown_error=away)
    np.testing.assert_allclose(errors(last_command, learned).touchdown, [4.0, 1.0])


def test_the_net_of_the_best_epochs_beats_command_and_linear_map_on_new_walks(parts, trained):
    linear, _ = train(TrainConfig("linear"), *parts)
    phis = {"raw": last_command, "linear": as_effect(linear), "net": as_effect(trained[0])}
    told = errors_by_phi(phis, parts[1])
    assert told["net"]["force"] < 0.35 * told["raw"]["force"]
    assert told["net"]["force"] < 0.7 * told["linear"]["force"]
    assert told["net"]["moment"] < 0.8 * told["linear"]["moment"]
    assert told["linear"]["force"] < told["raw"]["force"]
    params, history = trained
    assert history.valid_force.shape == (25,)
    told = errors(as_effect(params), parts[1])
    np.testing.assert_allclose(told.force, history.valid_force.min(), rtol=1e-3)
    np.testing.assert_allclose(told.moment, history.valid_moment.min(), rtol=1e-3)
    assert history.train_force[-1] < 0.2 * history.train_force[0]


def test_the_same_seed_makes_the_same_bytes(parts):
    half = jax.tree.map(lambda x: x[::2], parts[0])  # as many with mirror images: one program
    one, other, third = (train(paper(epochs=2, seed=s), half, parts[1]) for s in (0, 0, 1))
    jax.tree.map(np.testing.assert_array_equal, one, other)
    kernels = (net.force["Dense_0"]["kernel"] for net, _ in (one, third))
    assert not np.array_equal(*kernels)


def test_no_samples_and_samples_that_are_not_finite_are_refused(parts):
    none = jax.tree.map(lambda x: x[:0], parts[0])
    with pytest.raises(ValueError, match="validation set has no samples"):
        train(TrainConfig(epochs=1), parts[0], none)
    broken = parts[0]._replace(label=jax.tree.map(lambda w: w * np.nan, parts[0].label))
    with pytest.raises(ValueError, match="training diverged"):
        train(paper(epochs=1, mirror=False), broken, parts[1])


def test_a_variant_is_added_in_one_place(parts, tmp_path, monkeypatch):
    """That of docs/extending.md: the ground returns a share of every command."""
    page = (Path(__file__).parents[1] / "docs" / "extending.md").read_text()
    examples, mine = doctest.DocTestParser().get_examples(page.partition("of phi\n")[2]), {}
    exec("import jax, jax.numpy as jnp\n" + "".join(e.source for e in examples), mine)
    phi = Phi("share", *(mine[name] for name in ("Share", "init", "fit", "apply")))
    monkeypatch.setitem(VARIANTS, "share", phi)
    params, _ = train(TrainConfig("share"), *parts)
    assert errors(as_effect(params), parts[1]).force < errors(last_command, parts[1]).force
    save_net(tmp_path / "net.npz", params, robot=ROBOT, about={})
    again, variant, _ = load_net(tmp_path / "net.npz", ROBOT)
    assert variant == "share"
    np.testing.assert_array_equal(again.share, params.share)


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
