"""What the controller does not know, and the integral action that learns it from errors."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import ANCHOR, ROBOT, robot_with

from hector_jax import InputError, RolloutConfig, State, Wrench, named_command, nominal
from hector_jax.control.disturbance import NO_DISTURBANCE, IntegralGains, integrate_error
from hector_jax.control.parameters import GROUPS, TUNABLES
from hector_jax.grfm.effect import Window, ground_effect, last_command
from hector_jax.robot import srbm
from hector_jax.tuning import variation as variations
from hector_jax.tuning.evaluate import evaluate_jit
from hector_jax.tuning.loss import PAPER_LOSS, losses, total
from hector_jax.tuning.rollout import Scenario, rollout, rollout_config, with_variation
from hector_jax.tuning.variation import drawn_variation, moved_by, no_variation

SCENARIO = Scenario(ROBOT, named_command("s"), ANCHOR, last_command)
FEET = jnp.array([[0.02, 0.08, 0.0], [-0.01, -0.08, 0.0]])
DT = 0.01
BELIEVED = jax.tree.map(jnp.asarray, no_variation())
assert_same = partial(jax.tree.map, partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12))


def tilted():
    rng = np.random.default_rng(0)
    rows = [jnp.asarray(0.2 * rng.normal(size=3)) for _ in range(4)]
    return State(rows[0], rows[1] + jnp.array([0.0, 0.0, 0.5]), rows[2], rows[3])


def wrench(seed):
    rng = np.random.default_rng(seed)
    return Wrench(*(jnp.asarray(10.0 * rng.normal(size=(2, 3))) for _ in range(2)))


def moved(variation, now, before=None, feet_before=FEET):
    before = now if before is None else before
    now, before = ground_effect(now), ground_effect(before)
    before = before, feet_before
    return moved_by(variation, ROBOT, tilted(), dt=DT, now=(now, FEET), before=before)


def test_the_body_moves_as_the_rigid_body_late_by_its_delay_and_less_where_it_is_heavier():
    assert_same(moved(BELIEVED, wrench(0)), srbm.step(ROBOT, tilted(), wrench(0), FEET, DT))
    late, there = BELIEVED._replace(delay=jnp.asarray(DT)), FEET + 0.1
    expected = srbm.step(ROBOT, tilted(), wrench(1), there, DT)
    assert_same(moved(late, wrench(0), wrench(1), there), expected)
    heavy = BELIEVED._replace(mass=jnp.asarray(1.1), inertia=jnp.asarray(1.1))
    nothing = jax.tree.map(jnp.zeros_like, wrench(0))
    assert_same(moved(heavy, nothing), moved(BELIEVED, nothing))
    free = moved(BELIEVED, nothing).velocity
    pushed = moved(BELIEVED, wrench(0)).velocity - free
    less = moved(heavy, wrench(0)).velocity - free
    np.testing.assert_allclose(less, pushed / 1.1, rtol=1e-9)


def test_a_force_through_the_true_centre_of_mass_does_not_turn_the_body():
    offset = jnp.array([0.01, -0.02, 0.005])
    state = State(*(jnp.zeros(3) for _ in range(4)))
    up = Wrench(jnp.zeros((2, 3)).at[0, 2].set(50.0), jnp.zeros((2, 3)))
    under = jnp.array([[0.01, -0.02, -0.4]] * 2)
    variation = BELIEVED._replace(com=offset)
    now = ground_effect(up), under
    found = moved_by(variation, ROBOT, state, dt=DT, now=now, before=now)
    np.testing.assert_allclose(found.ang_velocity, 0.0, atol=1e-12)
    beside = moved_by(BELIEVED, ROBOT, state, dt=DT, now=now, before=now)
    assert np.abs(beside.ang_velocity).max() > 1e-3


def test_a_foot_that_slips_keeps_its_direction_and_load():
    force = jnp.array([[30.0, -20.0, 50.0], [15.0, 8.0, 50.0]])
    found = variations.within_friction(Wrench(force, force), jnp.asarray(0.5)).force
    # twice the limit keeps half of it, 23 of 25 N nearly all: the edge is smooth
    share = (1.0 + np.array([2.0, 23.0 / 25.0]) ** 8) ** (-1 / 8)
    np.testing.assert_allclose(found[:, :2], share[:, None] * force[:, :2])
    np.testing.assert_allclose(share, [0.5, 0.95], atol=1e-2)
    np.testing.assert_array_equal(found[:, 2], force[:, 2])
    none = Wrench(jnp.zeros((2, 3)), jnp.zeros((2, 3)))
    assert np.isfinite(jax.grad(lambda f: variations.within_friction(none, f).force.sum())(0.5))


def test_drawn_variations_are_as_robots_differ():
    config = rollout_config(ROBOT).walk
    drawn = [drawn_variation(config, ROBOT, seed) for seed in range(200)]
    ranges = {"mass": (0.9, 1.1), "inertia": (0.8, 1.2), "friction": (0.48, 0.96)}
    for name, (low, high) in (ranges | {"delay": (0.0, 0.008)}).items():
        values = np.array([getattr(one, name) for one in drawn])
        assert low <= values.min() < low + 0.1 * (high - low), name
        assert high - 0.1 * (high - low) < values.max() <= high, name
    com = np.abs([one.com for one in drawn]).max(axis=0)
    np.testing.assert_allclose(com, [0.01, 0.01, 0.02], rtol=0.05)
    assert len({int(one.seed) for one in drawn}) == 200
    again = drawn_variation(config, ROBOT, 7)
    jax.tree.map(np.testing.assert_array_equal, again, drawn[7])


def test_the_error_of_the_estimate_has_its_stated_sizes():
    sizes = State(*(jnp.asarray(rows) for rows in np.linspace(0.01, 0.12, 12).reshape(4, 3)))
    noisy = BELIEVED._replace(noise=sizes)
    draw = jax.jit(jax.vmap(lambda tick: variations.estimate_error(noisy, tilted(), tick)))
    for found, size in zip(draw(jnp.arange(2000)), sizes, strict=True):
        np.testing.assert_allclose(found.std(axis=0), size, rtol=0.1)
        assert (np.abs(found.mean(axis=0)) < 0.1 * size).all()


def test_the_description_of_a_robot_states_the_noise_and_the_delay_of_its_tunings():
    assert with_variation(rollout_config(ROBOT), SCENARIO).variation is None
    config = rollout_config(robot_with(estimate_noise=2.0, delay=0.005))
    variation = with_variation(config, SCENARIO).variation
    np.testing.assert_allclose(variation.noise.velocity, 0.04)
    np.testing.assert_allclose(variation.noise.euler, 0.002)
    assert_same(variation._replace(noise=BELIEVED.noise, delay=0.0), BELIEVED)
    assert variation.delay == 0.005
    told = r"tuning: .*delay must be a number from 0 to 0.01, got 0.02"
    with pytest.raises(InputError, match=told):
        rollout_config(robot_with(delay=0.02))


def test_a_tuning_sees_the_noise_and_the_delay_of_the_description():
    config = rollout_config(robot_with(estimate_noise=1.0, delay=0.005), seconds=0.1)
    without = rollout_config(ROBOT, seconds=0.1)
    walk = partial(jax.jit(rollout, static_argnums=0), weights=nominal())
    seen, told = walk(config, SCENARIO), with_variation(config, SCENARIO)
    assert_same(seen, walk(without, told))
    plain, as_plain = (walk(without, SCENARIO._replace(variation=v)) for v in (None, BELIEVED))
    loss, loss_as_plain, loss_seen = (
        float(total(PAPER_LOSS, losses(PAPER_LOSS, x))) for x in (plain, as_plain, seen)
    )
    assert loss_as_plain == pytest.approx(loss, rel=1e-9)
    assert 1e-3 < abs(loss_seen / loss - 1.0) < 0.5


GAINS = {"horizontal_gain": 10.0, "height_gain": 40.0, "tilt_gain": 100.0, "yaw_gain": 50.0}
INTEGRAL = IntegralGains(*GAINS.values())
integrate = jax.jit(integrate_error, static_argnums=4)
AT_REST = State(*np.zeros((4, 3)))


@jax.tree_util.Partial
def weak(window: Window):
    """The ground returns less than what was commanded, and a moment more."""
    wrench = jax.tree.map(lambda w: w[0], window.commands)
    stands = window.contact[:, None]
    moment = wrench.moment + stands * jnp.array([0.0, 0.5, 0.0])
    return ground_effect(wrench._replace(force=0.9 * wrench.force, moment=moment))


def test_a_robot_too_low_lacks_force_in_its_yaw_frame_and_a_push_counts_less_than_a_steady_error():
    heading = np.array([0.0, 0.0, np.pi / 2])  # it looks along y
    there = AT_REST._replace(euler=heading, position=np.array([0.0, -0.01, -0.02]))
    wanted = AT_REST._replace(euler=heading)
    found = integrate(INTEGRAL, NO_DISTURBANCE, there, wanted, 0.01)
    assert max(found.linear[0], found.linear[2]) < 0
    np.testing.assert_allclose(found.linear[1], 0.0, atol=1e-15)
    np.testing.assert_allclose(found.angular, 0.0, atol=1e-15)

    def counts(error):
        tilted = AT_REST._replace(euler=np.full(3, error))
        return integrate(INTEGRAL, NO_DISTURBANCE, tilted, AT_REST, 0.01).angular

    assert (0.0 < counts(0.3)).all()
    assert (counts(0.3) < counts(0.02)).all()


def test_what_is_missing_has_a_bound():
    """As it integrates on a stand, 2 cm above the floor and at a standstill."""
    held = AT_REST._replace(position=np.array([0.0, 0.0, 0.02]), euler=np.array([0.05, 0.0, 0.0]))
    gains = INTEGRAL._replace(limit=4.9)
    found = NO_DISTURBANCE
    for _ in range(100):
        found = integrate(gains, found, held, AT_REST, 1.0)
    np.testing.assert_allclose(found.linear, [0.0, 0.0, 4.9])
    np.testing.assert_allclose(found.angular, [49.0, 0.0, 0.0])
    one = integrate(gains, NO_DISTURBANCE, held, AT_REST, 0.01)
    free = integrate(INTEGRAL, NO_DISTURBANCE, held, AT_REST, 0.01)
    jax.tree.map(np.testing.assert_array_equal, one, free)


def test_steady_errors_go():
    """On ground that returns 90 % of the forces, and a moment that the model does not have."""
    walk, last = jax.jit(rollout, static_argnums=0), []
    scenario = Scenario(ROBOT, named_command("straight"), ANCHOR, weak)
    for gains in (dict.fromkeys(GAINS, 0.0), GAINS):
        walked = walk(RolloutConfig(), scenario, nominal()._replace(others=gains))
        assert not walked.fallen.any()
        off = jax.tree.map(lambda x, y: np.mean((x - y)[-80:], 0), walked.state, walked.reference)
        last.append((off.position[2], off.euler[1]))
    (low, pitch), (low_with, pitch_with) = last
    assert low < -0.01
    assert abs(low_with) < 0.2 * abs(low)
    assert abs(pitch) > 0.01
    assert abs(pitch_with) < 0.2 * abs(pitch)


def test_gradients_of_all_numbers_are_those_of_differences():
    config = RolloutConfig(ticks=50)
    names = GROUPS["all"]
    others = {"effort_reference": 0.3, **GAINS}
    start = config.walk.with_others(nominal()._replace(others=others), names)

    scenario = Scenario(ROBOT, named_command("s"), ANCHOR, weak)

    def evaluate(others):
        return evaluate_jit(config, scenario, start._replace(others=others), PAPER_LOSS)

    found = evaluate(start.others).gradient.others
    assert set(found) == set(names)
    for name in names:
        step = 1e-5 * (TUNABLES[name].upper - TUNABLES[name].lower)
        ends = [evaluate({**start.others, name: start.others[name] + s}) for s in (step, -step)]
        slope = (ends[0].loss - ends[1].loss) / (2 * step)
        assert float(found[name]) == pytest.approx(float(slope), rel=1e-4), name
