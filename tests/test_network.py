"""GRFM-Net as a phi."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import LEARNS_TOUCHDOWNS
from synthetic import synthetic_walk

from hector_jax.control.controller import WalkConfig
from hector_jax.control.gait import GaitConfig
from hector_jax.control.reference import named_command
from hector_jax.core.trajectory import Wrench
from hector_jax.grfm import paper, residual
from hector_jax.grfm.dataset import ACROSS, ALONG, at_interval, make_dataset, with_mirror
from hector_jax.grfm.effect import HISTORY, last_command
from hector_jax.grfm.gated import fit_gated, hats
from hector_jax.grfm.network import as_effect, effect_of, load_net, save_net, variant_of
from hector_jax.grfm.paper import fit_linear, fit_scaling
from hector_jax.grfm.residual import BOUND, plain_net
from hector_jax.grfm.training import predict
from hector_jax.robot.model import load_robot
from hector_jax.store.tunings import Problem, rollouts_of
from hector_jax.tuning.difftune import TuneConfig

apply = jax.jit(lambda effect, window: effect(window))


def untrained(data, variant="residual", seed=0, **sizes):
    """Fresh nets with the statistics of a training set."""
    part = {"paper": paper, "residual": residual}[variant]
    return part.with_statistics(part.init(jax.random.key(seed), **sizes), data)


@pytest.fixture(scope="module")
def data():
    walks = [at_interval(synthetic_walk(i, 60), 0.01) for i in range(2)]
    return make_dataset(LEARNS_TOUCHDOWNS, jax.tree.map(lambda *x: np.stack(x), *walks))[0]


@pytest.fixture(scope="module")
def params(data):
    return untrained(data, "paper")


@pytest.fixture(scope="module")
def ensemble(data):
    return untrained(data)


@pytest.fixture(scope="module", params=["params", "ensemble"], ids=["paper", "residual"])
def either(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def gated(data):
    return fit_gated(data)


@pytest.fixture(scope="module")
def windows(data):
    return jax.tree.map(jnp.asarray, data.window)


@pytest.fixture(scope="module")
def robot():
    return load_robot()


@pytest.fixture
def window(data):
    return jax.tree.map(lambda x: jnp.asarray(x[5]), data.window)


def test_the_paper_s_net_has_18_inputs_three_layers_of_64_and_6_outputs(params):
    for net in (params.force, params.moment):
        shapes = [net[f"Dense_{i}"]["kernel"].shape for i in range(4)]
        assert shapes == [(18, 64), (64, 64), (64, 64), (64, 6)]
        assert sum(name.startswith("LayerNorm") for name in net) == 3


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_effect_follows_the_dtype_of_the_window(either, window, dtype):
    commands = jax.tree.map(lambda w: jnp.asarray(w, dtype), window.commands)
    effect = apply(as_effect(either), window._replace(commands=commands))
    assert {leaf.dtype for leaf in jax.tree.leaves(effect)} == {jnp.dtype(dtype)}
    assert effect.wrench.force.shape == (2, 3)


def test_the_members_alone_are_on_average_the_ensemble(ensemble, window):
    member = variant_of(ensemble).member
    members = [apply(as_effect(member(ensemble, i)), window).wrench for i in range(4)]
    whole = apply(as_effect(ensemble), window).wrench
    for *each, mean in zip(*members, whole, strict=True):
        assert np.ptp(each, axis=0).max() > 0
        np.testing.assert_allclose(np.mean(each, axis=0), mean, rtol=1e-5, atol=1e-9)


def test_a_drawn_model_goes_through_one_member_or_the_net_that_is_no_ensemble(
    params, gated, data, ensemble
):
    config, robot, command = TuneConfig(), load_robot(), named_command("straight")
    for net in (params, gated, fit_linear(data), ensemble):
        drawn = rollouts_of(config, robot, Problem((command,), net, draws=2))
        for number, scenario in enumerate(drawn):
            (used,) = scenario.effect.args
            expected = variant_of(net).member(net, number)
            assert (expected is net) == (net is not ensemble)
            jax.tree.map(np.testing.assert_array_equal, used, expected)


def test_vmap_over_windows_equals_a_loop(either, data, windows):
    effect = as_effect(either)
    batch = predict(effect, windows).wrench
    for i in range(4):
        one = apply(effect, jax.tree.map(lambda x, i=i: x[i], data.window)).wrench
        np.testing.assert_allclose(batch.force[i], one.force, rtol=1e-12, atol=1e-12)


def test_the_derivative_in_64_bits_agrees_with_differences_and_both_modes(either, window):
    effect = as_effect(either)
    key_force, key_moment = jax.random.split(jax.random.key(2))
    along = Wrench(
        jax.random.normal(key_force, (HISTORY, 2, 3)),
        jax.random.normal(key_moment, (HISTORY, 2, 3)) * 0.1,
    )

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


def test_the_gradient_is_finite_where_nothing_is_commanded(either, window):
    silent = window._replace(commands=jax.tree.map(jnp.zeros_like, window.commands))
    total = jax.jit(jax.grad(lambda w: as_effect(either)(w).wrench.force.sum(), allow_int=True))
    gradient = total(silent)
    assert all(np.isfinite(g).all() for g in gradient.commands)


def test_an_axis_that_is_hardly_commanded_is_not_blown_up(data):
    commands = data.window.commands
    noise = np.random.default_rng(0).normal(size=commands.moment.shape) * 1e-9
    quiet = commands.moment.copy()
    quiet[..., 0] = noise[..., 0]
    scaling = fit_scaling(Wrench(commands.force, quiet))
    assert np.all(scaling.scale.moment[:, 0] > 1e-3)
    still = fit_scaling(jax.tree.map(np.zeros_like, commands))
    assert np.all(still.scale.force == 1.0)


def test_the_linear_map_finds_a_ground_that_is_linear(data, windows):
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(18, 6)), rng.normal(size=6)
    force = data.window.commands.force.reshape(-1, 18) @ A + b
    known = data._replace(label=data.label._replace(force=force.reshape(-1, 2, 3)))
    effect = as_effect(fit_linear(known))
    guess = predict(effect, windows).wrench
    np.testing.assert_allclose(guess.force, known.label.force, atol=1e-6)


def test_a_net_comes_back_as_it_was_written(tmp_path, either, robot):
    path = tmp_path / "net.npz"
    save_net(path, either, robot=robot, about={"epochs": 3})
    again, variant, card = load_net(path, robot)
    assert variant == variant_of(either).name
    assert card["about"]["epochs"] == 3
    assert jax.tree.structure(again) == jax.tree.structure(either)
    jax.tree.map(np.testing.assert_array_equal, again, either)


def test_a_net_of_another_robot_or_with_a_nan_is_refused(tmp_path, either, robot):
    path = tmp_path / "net.npz"
    save_net(path, either, robot=robot, about={})
    heavier = robot._replace(mass=np.asarray(robot.mass) + 1.0)
    with pytest.raises(ValueError, match="net.npz: made for robot"):
        load_net(path, heavier)
    broken = either._replace(force=jax.tree.map(lambda x: x * np.nan, either.force))
    save_net(path, broken, robot=robot, about={})
    with pytest.raises(ValueError, match="net.npz: a parameter of the net is not finite"):
        load_net(path, robot)


def test_a_net_of_another_variant_is_refused_by_name(tmp_path, params, robot):
    save_net(tmp_path / "net.npz", params, robot=robot, about={})
    with pytest.raises(ValueError, match="net.npz: holds grfm-paper, expected .*grfm-residual"):
        load_net(tmp_path / "net.npz", robot, "residual")


# --- the residual variant ---


def _flip(wrench):
    return Wrench(wrench.force[::-1] * ALONG, wrench.moment[::-1] * ACROSS)


def test_a_mirrored_window_has_the_mirrored_effect(data, ensemble):
    both = with_mirror(data)
    phi = as_effect(ensemble)
    count = len(data.walk)
    for i in (0, 17, 18, 40):
        here, there = (
            apply(phi, jax.tree.map(lambda x, k=k: jnp.asarray(x[k]), both.window))
            for k in (i, count + i)
        )
        jax.tree.map(
            partial(np.testing.assert_allclose, atol=1e-9), _flip(here.wrench), there.wrench
        )
        np.testing.assert_allclose(here.legs.force * ALONG, there.legs.force, atol=1e-9)
        np.testing.assert_allclose(here.legs.torque * ACROSS, there.legs.torque, atol=1e-9)
        error = here.touchdown_error
        assert np.any(error != 0.0)
        np.testing.assert_allclose(error[::-1] * ALONG, there.touchdown_error, atol=1e-9)


def test_a_command_that_stays_is_returned_as_it_is(gated, window):
    held = jax.tree.map(lambda w: jnp.broadcast_to(w[:1], w.shape), window.commands)
    more = jax.tree.map(lambda w: w.at[:, 0].add(3.0), held)
    phi = as_effect(gated)
    before, after = (apply(phi, window._replace(commands=c)).wrench for c in (held, more))
    stands = np.asarray(window.contact)
    assert stands[0]
    np.testing.assert_allclose(after.force - before.force, [[3.0] * 3, [0.0] * 3], atol=1e-9)
    np.testing.assert_allclose(after.moment - before.moment, [[3.0] * 3, [0.0] * 3], atol=1e-9)


def test_what_the_nets_add_is_bounded_and_fades_far_from_the_data(ensemble, window):
    loud = ensemble._replace(
        force=jax.tree.map(lambda p: 100.0 * p, ensemble.force),
        moment=jax.tree.map(lambda p: 100.0 * p, ensemble.moment),
    )
    linear = as_effect(ensemble.linear)
    added = []
    for size in (1.0, 30.0):
        far = window._replace(
            commands=jax.tree.map(lambda w, s=size: w.at[0].multiply(s), window.commands)
        )
        nets, gated = (apply(phi, far).wrench.force for phi in (as_effect(loud), linear))
        difference = nets - gated
        added.append(np.abs(difference / ensemble.residual_rms[:3]))
    assert added[0].max() <= BOUND + 1e-6
    assert added[0].max() > 0.1 * BOUND
    assert added[1][0].max() < 1e-3


def test_the_gated_map_finds_a_ground_that_is_gated_and_linear(data, windows, gated):
    rng = np.random.default_rng(0)
    true = gated._replace(
        bias=jnp.asarray(rng.normal(size=gated.bias.shape)),
        changes=jnp.asarray(0.2 * rng.normal(size=gated.changes.shape)),
        legs_bias=jnp.asarray(rng.normal(size=gated.legs_bias.shape)),
        legs=jnp.asarray(0.0 * gated.legs),
        touchdown=jnp.asarray(np.random.default_rng(1).normal(size=gated.touchdown.shape)),
    )
    told = predict(as_effect(true), windows)
    error = np.array(told.touchdown_error)
    error[::20] += 1e3  # robots that fall
    known = data._replace(
        label=jax.tree.map(np.asarray, told.wrench),
        legs=jax.tree.map(np.asarray, told.legs),
        touchdown_error=error,
        lands=~data.window.contact,
    )
    found = predict(as_effect(fit_gated(known)), windows)
    for part in ("force", "moment"):
        error = getattr(found.wrench, part) - getattr(told.wrench, part)
        assert np.mean(error**2) < 0.05 * np.var(getattr(told.wrench, part))
    np.testing.assert_allclose(found.legs.force, told.legs.force, atol=0.05)
    lands = ~data.window.contact
    error = np.asarray(found.touchdown_error - told.touchdown_error)[lands]
    assert np.abs(error).max() < 0.02 * np.asarray(told.touchdown_error)[lands].std()


def test_a_leg_pushes_only_while_it_swings(gated, window):
    phi = as_effect(gated)
    standing = window._replace(contact=jnp.array([True, True]))
    assert np.any(apply(phi, window).legs.force != 0.0)
    assert not np.any(apply(phi, standing).legs.force)


def test_hats_are_one_at_their_knot_and_sum_to_one():
    knots = jnp.array([0.0, 0.01, 0.05])
    np.testing.assert_allclose(hats(knots, knots), np.eye(3))
    between = hats(jnp.linspace(-0.01, 0.1, 23), knots)
    np.testing.assert_allclose(between.sum(axis=1), 1.0)


def test_the_plain_net_returns_every_command_and_has_the_shapes_of_a_trained_one(windows, ensemble):
    told = windows.commands._replace(
        force=windows.commands.force * windows.contact[:, None, :, None],
        moment=windows.commands.moment * windows.contact[:, None, :, None],
    )
    windows = windows._replace(commands=told)  # a foot in the air is commanded nothing
    plain, same = (predict(p, windows) for p in (effect_of(None, WalkConfig()), last_command))
    jax.tree.map(np.testing.assert_array_equal, plain.wrench, same.wrench)
    assert not any(np.any(load) for load in plain.legs)
    shape = partial(jax.tree.map, lambda x: (x.shape, x.dtype))
    assert shape(plain_net(GaitConfig(), 6)) == shape(ensemble)
