"""Training GRFM-Net on walks that no simulator made."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import synthetic_walk

from hector_jax.core.trajectory import Wrench
from hector_jax.grfm.dataset import at_interval, make_dataset, split_by_walk
from hector_jax.grfm.effect import Phi, ground_effect, last_command
from hector_jax.grfm.gated import fit_gated
from hector_jax.grfm.nets import NO_EPOCHS
from hector_jax.grfm.network import VARIANTS, as_effect, load_net, save_net
from hector_jax.grfm.paper import fit_linear
from hector_jax.grfm.training import TrainConfig, errors, errors_by_phi, train
from hector_jax.robot.model import load_robot


def dataset(seeds, ticks=200, noise=0.3):
    walks = [at_interval(synthetic_walk(i, ticks, noise), 0.01) for i in seeds]
    return make_dataset(load_robot(), jax.tree.map(lambda *x: np.stack(x), *walks))[0]


@pytest.fixture(scope="module")
def parts():
    return split_by_walk(dataset(range(10)), 0.3)


@pytest.fixture(scope="module")
def told():
    """What is told of the progress of `trained`: epochs, and how many errors there are."""
    return []


@pytest.fixture(scope="module")
def trained(parts, told):
    return train(
        TrainConfig("paper", epochs=25, batch=64, learning_rate=3e-3, mirror=False),
        *parts,
        progress=lambda epoch, history: told.append((epoch, len(history.valid_force))),
    )


@pytest.fixture(scope="module")
def gated(parts):
    return fit_gated(parts[0])


@pytest.fixture(scope="module")
def residual(parts):
    return train(TrainConfig(epochs=10, batch=64, learning_rate=2e-3), *parts)


def test_the_net_beats_the_raw_command_and_the_linear_map_on_walks_it_never_saw(parts, trained):
    held_out = parts[1]
    told = errors_by_phi(
        {
            "raw": last_command,
            "linear": as_effect(fit_linear(parts[0])),
            "net": as_effect(trained[0]),
        },
        held_out,
    )
    assert told["net"]["force"] < 0.35 * told["raw"]["force"]
    assert told["net"]["force"] < 0.7 * told["linear"]["force"]
    assert told["net"]["moment"] < 0.8 * told["linear"]["moment"]
    assert told["linear"]["force"] < told["raw"]["force"]


def test_the_residual_net_beats_its_linear_part_on_walks_it_never_saw(parts, residual, gated):
    params, history = residual
    told = errors_by_phi(
        {"raw": last_command, "gated": as_effect(gated), "net": as_effect(params)}, parts[1]
    )
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


def test_the_kept_nets_are_those_of_the_best_held_out_epochs(parts, trained):
    params, history = trained
    assert history.valid_force.shape == (25,)
    told = errors(as_effect(params), parts[1])
    np.testing.assert_allclose(told.force, history.valid_force.min(), rtol=1e-3)
    np.testing.assert_allclose(told.moment, history.valid_moment.min(), rtol=1e-3)
    assert history.train_force[-1] < 0.2 * history.train_force[0]


def test_the_same_seed_makes_the_same_bytes(parts):
    half = jax.tree.map(
        lambda x: x[::2], parts[0]
    )  # as many as all of them with their mirror images
    config = TrainConfig("paper", epochs=2, batch=64)
    one, other = train(config, half, parts[1]), train(config, half, parts[1])
    jax.tree.map(np.testing.assert_array_equal, one, other)
    third, _ = train(TrainConfig("paper", epochs=2, batch=64, seed=1), half, parts[1])
    assert not np.array_equal(third.force["Dense_0"]["kernel"], one[0].force["Dense_0"]["kernel"])


def test_sixteen_samples_can_be_learned_by_heart(parts):
    # again and again, as many as there are in `parts`: one program
    repeated = [20 + np.arange(len(part.walk)) % 16 for part in parts]
    few, again = (jax.tree.map(lambda x, rows=rows: x[rows], parts[0]) for rows in repeated)
    rates = {"learning_rate": 3e-3, "l2": 0.0}
    params, history = train(
        TrainConfig("paper", epochs=30, batch=64, mirror=False, **rates), few, again
    )
    spread = float(few.label.force.var(axis=0).mean())
    assert history.valid_force.min() < 1e-3 * spread
    assert errors(as_effect(params), few).force < 1e-3 * spread


def test_no_samples_or_no_sense_are_refused(parts):
    none = jax.tree.map(lambda x: x[:0], parts[0])
    with pytest.raises(ValueError, match="validation set has no samples"):
        train(TrainConfig(epochs=1), parts[0], none)
    with pytest.raises(ValueError, match="epochs must be a whole number of at least 1, got 0"):
        TrainConfig(epochs=0)
    with pytest.raises(ValueError, match="variant must be .* got 'papier'; did you mean 'paper'"):
        TrainConfig("papier")
    with pytest.raises(ValueError, match="learning_rate must be a number above 0, got nan"):
        TrainConfig(learning_rate=float("nan"))
    broken = parts[0]._replace(label=jax.tree.map(lambda w: w * np.nan, parts[0].label))
    with pytest.raises(ValueError, match="training diverged"):
        train(TrainConfig("paper", epochs=1, batch=64, mirror=False), broken, parts[1])


# A variant of one's own: the ground returns a share of every command


class Share(NamedTuple):
    """What the ground returns of a command."""

    share: jax.Array  # (2,) of the force and of the moment


def init_share(key, feet=2, axes=6, hidden=()):
    return Share(jnp.ones(2))


def fit_share(config, training, validation, progress):
    newest = [w[:, 0] for w in training.window.commands]
    pairs = zip(newest, training.label, strict=True)
    return Share(jnp.array([np.vdot(c, y) / np.vdot(c, c) for c, y in pairs])), NO_EPOCHS


def apply_share(params, window):
    force, moment = (w[0] for w in window.commands)
    return ground_effect(Wrench(params.share[0] * force, params.share[1] * moment))


SHARE = Phi("share", Share, init_share, fit_share, apply_share)


def test_a_variant_is_added_in_one_place(parts, tmp_path, monkeypatch):
    monkeypatch.setitem(VARIANTS, "share", SHARE)
    params, _ = train(TrainConfig("share"), *parts)
    assert errors(as_effect(params), parts[1]).force < errors(last_command, parts[1]).force
    save_net(tmp_path / "net.npz", params, robot=load_robot(), about={})
    again, variant, _ = load_net(tmp_path / "net.npz", load_robot())
    assert variant == "share"
    np.testing.assert_array_equal(again.share, params.share)


@pytest.mark.parametrize("name", ["linear", "gated"])
def test_the_closed_forms_are_variants_too(parts, gated, name):
    fitted = {"linear": fit_linear(parts[0]), "gated": gated}[name]
    params, history = train(TrainConfig(name), *parts)
    jax.tree.map(np.testing.assert_array_equal, params, jax.device_get(fitted))
    assert history.valid_force.size == 0
