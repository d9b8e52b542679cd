"""GRFM-Net as a phi."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import synthetic_walk

from hector_jax.grfm.dataset import at_interval, make_dataset
from hector_jax.grfm.network import (
    as_effect,
    fit_linear,
    fit_scaling,
    init_params,
    linear_effect,
    load_net,
    save_net,
)
from hector_jax.model.effect import HISTORY, Window
from hector_jax.robot import load_robot
from hector_jax.trajectory import Wrench


@pytest.fixture(scope="module")
def data():
    walks = [at_interval(synthetic_walk(i, 60), 0.01) for i in range(2)]
    return make_dataset(jax.tree.map(lambda *x: np.stack(x), *walks))[0]


@pytest.fixture(scope="module")
def params(data):
    return init_params(jax.random.key(0), data)


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


def test_each_net_reads_its_own_kind_only(params, window):
    effect = as_effect(params)
    commands = window.commands
    pushed = window._replace(commands=commands._replace(force=commands.force + 10.0))
    before, after = effect(window).wrench, effect(pushed).wrench
    np.testing.assert_array_equal(before.moment, after.moment)
    assert np.all(np.abs(before.force - after.force) > 0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_effect_follows_the_dtype_of_the_window(params, window, dtype):
    effect = as_effect(params)(
        window._replace(commands=jax.tree.map(lambda w: jnp.asarray(w, dtype), window.commands))
    )
    assert {leaf.dtype for leaf in jax.tree.leaves(effect)} == {jnp.dtype(dtype)}
    assert effect.wrench.force.shape == (2, 3)
    assert not np.any(effect.spread.force)


def test_vmap_over_windows_equals_a_loop(params, data):
    some = jax.tree.map(lambda x: jnp.asarray(x[:4]), data.window)
    effect = as_effect(params)
    batch = jax.vmap(effect)(some).wrench
    for i in range(4):
        one = effect(jax.tree.map(lambda x, i=i: x[i], some)).wrench
        np.testing.assert_allclose(batch.force[i], one.force, rtol=1e-12, atol=1e-12)


def test_new_parameters_need_no_new_compilation(params, data, window):
    traces = []

    @jax.jit
    def rollout(effect, window: Window):
        traces.append(1)
        return effect(window).wrench.force

    other = init_params(jax.random.key(1), data)
    first, second = rollout(as_effect(params), window), rollout(as_effect(other), window)
    assert len(traces) == 1
    assert not np.allclose(first, second)


def test_the_derivative_in_64_bits_agrees_with_differences_and_both_modes(params, window):
    effect = as_effect(params)
    key_force, key_moment = jax.random.split(jax.random.key(2))
    along = Wrench(
        jax.random.normal(key_force, (HISTORY, 2, 3)),
        jax.random.normal(key_moment, (HISTORY, 2, 3)) * 0.1,
    )

    def value(commands):
        wrench = effect(window._replace(commands=commands)).wrench
        return jnp.sum(jnp.tanh(wrench.force / 50.0)) + jnp.sum(wrench.moment**2)

    def moved(h):
        return value(jax.tree.map(lambda c, a: c + h * a, window.commands, along))

    h = 1e-6  # small, as softsign bends at zero
    differences = (moved(h) - moved(-h)) / (2 * h)
    _, forward = jax.jvp(value, (window.commands,), (along,))
    gradient = jax.grad(value)(window.commands)
    reverse = sum(jnp.vdot(g, a) for g, a in zip(gradient, along, strict=True))
    assert np.isfinite(forward)
    np.testing.assert_allclose(forward, differences, rtol=1e-6)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)


def test_the_gradient_is_finite_where_nothing_is_commanded(params, window):
    silent = window._replace(commands=jax.tree.map(jnp.zeros_like, window.commands))
    gradient = jax.grad(lambda w: as_effect(params)(w).wrench.force.sum(), allow_int=True)(silent)
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


def test_the_linear_map_finds_a_ground_that_is_linear(data):
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(18, 6)), rng.normal(size=6)
    force = data.window.commands.force.reshape(-1, 18) @ A + b
    known = data._replace(label=data.label._replace(force=force.reshape(-1, 2, 3)))
    effect = linear_effect(fit_linear(known))
    guess = jax.vmap(effect)(jax.tree.map(jnp.asarray, data.window)).wrench
    np.testing.assert_allclose(guess.force, known.label.force, atol=1e-6)


def test_an_unknown_variant_is_refused(params):
    with pytest.raises(ValueError, match="unknown variant 'papier'.*: paper"):
        as_effect(params, "papier")


def test_a_net_comes_back_as_it_was_written(tmp_path, params, robot):
    path = tmp_path / "net.npz"
    save_net(path, params, robot=robot, about={"epochs": 3})
    again, variant, card = load_net(path, robot)
    assert variant == "paper"
    assert card["about"]["epochs"] == 3
    assert jax.tree.structure(again) == jax.tree.structure(params)
    jax.tree.map(np.testing.assert_array_equal, again, params)


def test_a_net_of_another_robot_or_with_a_nan_is_refused(tmp_path, params, robot):
    path = tmp_path / "net.npz"
    save_net(path, params, robot=robot, about={})
    heavier = robot._replace(mass=np.asarray(robot.mass) + 1.0)
    with pytest.raises(ValueError, match="net.npz: made for robot"):
        load_net(path, heavier)
    broken = params._replace(inputs=jax.tree.map(lambda x: x * np.nan, params.inputs))
    save_net(path, broken, robot=robot, about={})
    with pytest.raises(ValueError, match="net.npz: a parameter of the net is not finite"):
        load_net(path, robot)


def test_a_net_of_another_size_comes_back(tmp_path, data, robot):
    small = init_params(jax.random.key(0), data, hidden=(8, 5))
    save_net(tmp_path / "net.npz", small, robot=robot, about={})
    again, _, _ = load_net(tmp_path / "net.npz", robot)
    jax.tree.map(np.testing.assert_array_equal, again, small)
