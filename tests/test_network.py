"""GRFM-Net as a phi."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import LEARNS_TOUCHDOWNS, ROBOT
from synthetic import synthetic_walk

from hector_jax import TuneConfig, WalkConfig, Wrench, named_command
from hector_jax.control.gait import GaitConfig
from hector_jax.core.tree import stack
from hector_jax.grfm import paper, residual
from hector_jax.grfm.dataset import ACROSS, ALONG, at_interval, make_dataset, with_mirror
from hector_jax.grfm.effect import HISTORY, last_command
from hector_jax.grfm.gated import fit_gated
from hector_jax.grfm.network import as_effect, effect_of, load_net, save_net
from hector_jax.grfm.paper import fit_linear, fit_scaling
from hector_jax.grfm.residual import BOUND, plain_net
from hector_jax.grfm.training import predict
from hector_jax.store.tunings import Problem, rollouts_of

apply = jax.jit(lambda effect, window: effect(window))


@pytest.fixture(scope="module")
def data():
    walks = stack([at_interval(synthetic_walk(i, 60), 0.01) for i in range(2)])
    return make_dataset(LEARNS_TOUCHDOWNS, walks)[0]


@pytest.fixture(scope="module")
def params(data):
    return paper.with_statistics(paper.init(jax.random.key(0)), data)


@pytest.fixture(scope="module")
def ensemble(data):
    return residual.with_statistics(residual.init(jax.random.key(0)), data)


@pytest.fixture(scope="module", params=["params", "ensemble"], ids=["paper", "residual"])
def either(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def gated(data):
    return fit_gated(data)


@pytest.fixture(scope="module")
def windows(data):
    return jax.tree.map(jnp.asarray, data.window)


@pytest.fixture
def window(data):
    return jax.tree.map(lambda x: jnp.asarray(x[5]), data.window)


def test_the_paper_s_net_has_18_inputs_three_layers_of_64_and_6_outputs(params):
    for net in (params.force, params.moment):
        shapes = [net[f"Dense_{i}"]["kernel"].shape for i in range(4)]
        assert shapes == [(18, 64), (64, 64), (64, 64), (64, 6)]
        assert sum(name.startswith("LayerNorm") for name in net) == 3


def test_a_drawn_model_has_one_member_and_their_mean_is_the_ensemble(params, ensemble, window):
    def used(net, draws=4):
        problem = Problem((named_command("straight"),), net, draws)
        return [scenario.effect for scenario in rollouts_of(TuneConfig(), ROBOT, problem)]

    members = [apply(effect, window).wrench for effect in used(ensemble)]
    for *each, mean in zip(*members, apply(as_effect(ensemble), window).wrench, strict=True):
        assert np.ptp(each, axis=0).max() > 0
        np.testing.assert_allclose(np.mean(each, axis=0), mean, rtol=1e-5, atol=1e-9)
    for effect in used(params):  # no ensemble
        jax.tree.map(np.testing.assert_array_equal, effect, as_effect(params))


def test_the_derivative_is_that_of_differences_in_both_modes_and_finite_in_silence(either, window):
    effect = as_effect(either)
    force, moment = np.random.default_rng(2).normal(size=(2, HISTORY, 2, 3))
    along = Wrench(force, 0.1 * moment)

    @jax.jit
    def value(commands):
        wrench = effect(window._replace(commands=commands)).wrench
        return jnp.sum(jnp.tanh(wrench.force / 50.0)) + jnp.sum(wrench.moment**2)

    def moved(h):
        return value(jax.tree.map(lambda c, a: c + h * a, window.commands, along))

    h = 1e-7  # small, as softsign bends at zero
    differences = (moved(h) - moved(-h)) / (2 * h)
    _, forward = jax.jvp(value, (window.commands,), (along,))
    gradient = jax.grad(value)(window.commands)
    reverse = sum(jnp.vdot(g, a) for g, a in zip(gradient, along, strict=True))
    assert np.isfinite(forward)
    np.testing.assert_allclose(forward, differences, rtol=1e-6)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    silent = window._replace(commands=jax.tree.map(jnp.zeros_like, window.commands))
    total = jax.jit(jax.grad(lambda w: as_effect(either)(w).wrench.force.sum(), allow_int=True))
    assert all(np.isfinite(g).all() for g in total(silent).commands)


def test_an_axis_that_is_hardly_commanded_is_not_blown_up(data):
    commands = data.window.commands
    quiet = commands.moment.copy()
    quiet[..., 0] = 1e-9 * np.random.default_rng(0).normal(size=quiet.shape[:-1])
    scaling = fit_scaling(Wrench(commands.force, quiet))
    assert np.all(scaling.scale.moment[:, 0] > 1e-3)
    still = fit_scaling(jax.tree.map(np.zeros_like, commands))
    assert np.all(still.scale.force == 1.0)


def test_the_linear_map_finds_a_ground_that_is_linear(data, windows):
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(18, 6)), rng.normal(size=6)
    force = data.window.commands.force.reshape(-1, 18) @ A + b
    known = data._replace(label=data.label._replace(force=force.reshape(-1, 2, 3)))
    guess = predict(as_effect(fit_linear(known)), windows).wrench
    np.testing.assert_allclose(guess.force, known.label.force, atol=1e-6)


def test_a_net_with_a_nan_is_refused_by_name(tmp_path, params):
    path = tmp_path / "net.npz"
    broken = params._replace(force=jax.tree.map(lambda x: x * np.nan, params.force))
    save_net(path, broken, robot=ROBOT, about={})
    with pytest.raises(ValueError, match="net.npz: a parameter of the net is not finite"):
        load_net(path, ROBOT)


def test_a_mirrored_window_has_the_mirrored_effect(data, ensemble):
    told, count = predict(as_effect(ensemble), with_mirror(data).window), len(data.walk)
    here, there = (jax.tree.map(lambda x, k=k: x[k : k + count], told) for k in (0, count))
    close = partial(np.testing.assert_allclose, atol=1e-9)
    close(here.wrench.force[:, ::-1] * ALONG, there.wrench.force)
    close(here.wrench.moment[:, ::-1] * ACROSS, there.wrench.moment)
    close(here.legs.force * ALONG, there.legs.force)
    close(here.legs.torque * ACROSS, there.legs.torque)
    close(here.touchdown_error[:, ::-1] * ALONG, there.touchdown_error)
    assert np.any(here.touchdown_error != 0.0)


def test_what_the_nets_add_is_bounded_and_fades_far_from_the_data(ensemble, window):
    loud = ensemble._replace(force=jax.tree.map(lambda p: 100.0 * p, ensemble.force))

    def added(size):
        commands = jax.tree.map(lambda w: w.at[0].multiply(size), window.commands)
        nets, linear = (
            apply(as_effect(params), window._replace(commands=commands)).wrench.force
            for params in (loud, ensemble.linear)
        )
        return np.abs((nets - linear) / ensemble.residual_rms[:3])

    assert 0.1 * BOUND < added(1.0).max() <= BOUND + 1e-6
    assert added(30.0)[0].max() < 1e-3


def test_the_gated_map_finds_a_ground_that_is_gated_and_linear(data, windows, gated):
    rng = np.random.default_rng(0)
    sizes = {"bias": 1.0, "changes": 0.2, "legs_bias": 1.0, "legs": 0.0, "touchdown": 1.0}
    drawn = {n: x * rng.normal(size=getattr(gated, n).shape) for n, x in sizes.items()}
    true = gated._replace(**jax.tree.map(jnp.asarray, drawn))
    told = predict(as_effect(true), windows)
    told, lands = jax.tree.map(np.asarray, told), ~data.window.contact
    error = told.touchdown_error.copy()
    error[::20] += 1e3  # robots that fall
    labels = {"label": told.wrench, "legs": told.legs, "touchdown_error": error, "lands": lands}
    known = data._replace(**labels)
    found = predict(as_effect(fit_gated(known)), windows)
    for part in ("force", "moment"):
        error = getattr(found.wrench, part) - getattr(told.wrench, part)
        assert np.mean(error**2) < 0.05 * np.var(getattr(told.wrench, part))
    np.testing.assert_allclose(found.legs.force, told.legs.force, atol=0.05)
    error = np.asarray(found.touchdown_error - told.touchdown_error)[lands]
    assert np.abs(error).max() < 0.02 * told.touchdown_error[lands].std()


def test_a_command_that_stays_is_returned_and_a_leg_pushes_only_while_it_swings(gated, window):
    held = jax.tree.map(lambda w: jnp.broadcast_to(w[:1], w.shape), window.commands)
    more = jax.tree.map(lambda w: w.at[:, 0].add(3.0), held)
    phi = as_effect(gated)
    before, after = (apply(phi, window._replace(commands=c)).wrench for c in (held, more))
    assert window.contact[0]
    np.testing.assert_allclose(after.force - before.force, [[3.0] * 3, [0.0] * 3], atol=1e-9)
    np.testing.assert_allclose(after.moment - before.moment, [[3.0] * 3, [0.0] * 3], atol=1e-9)
    standing = window._replace(contact=jnp.array([True, True]))
    assert np.any(apply(phi, window).legs.force != 0.0)
    assert not np.any(apply(phi, standing).legs.force)


def test_the_plain_net_returns_every_command_and_has_the_shapes_of_a_trained_one(windows, ensemble):
    stands = windows.contact[:, None, :, None]  # a foot in the air is commanded nothing
    windows = windows._replace(commands=jax.tree.map(lambda w: w * stands, windows.commands))
    plain, same = (predict(p, windows) for p in (effect_of(None, WalkConfig()), last_command))
    jax.tree.map(np.testing.assert_array_equal, plain.wrench, same.wrench)
    assert not any(np.any(load) for load in plain.legs)
    shape = partial(jax.tree.map, lambda x: (x.shape, x.dtype))
    assert shape(plain_net(GaitConfig(), 6)) == shape(ensemble)
