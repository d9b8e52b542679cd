"""The controller as a whole: what it measures, remembers, plans and asks of the joints."""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model import HEIGHT, ROBOT, WEIGHT

from hector_jax import State, WalkConfig, expert, named_command
from hector_jax.control import Anchor, GaitConfig, actuate, controller, init_memory, plan, step_plan
from hector_jax.control.legs import Measurement, stance_torques
from hector_jax.control.mpc import Horizon, MpcConfig
from hector_jax.control.parameters import TUNABLES, Q
from hector_jax.core.geometry import rotation_from_euler
from hector_jax.qp import Status
from hector_jax.robot.model import compile_model, describe

CONFIG = WalkConfig()
STRAIGHT = named_command("straight")
ANCHOR = Anchor(jnp.array([0.0, 0.0, HEIGHT]), jnp.array(0.0), jnp.array(0))

feet_of = jax.jit(lambda measurement: controller.measured_feet(ROBOT, measurement))


@partial(jax.jit, static_argnames="max_contacts")
def planned(tick, memory, measurement, max_contacts=1, limit=np.inf):
    parameters = TUNABLES["position_limit"].write(CONFIG.parameters(expert()), limit)
    asked = {"command": STRAIGHT, "anchor": ANCHOR, "max_contacts": max_contacts}
    now = {"tick": tick, "memory": memory, "measurement": measurement}
    return step_plan(CONFIG, ROBOT, parameters, **asked, **now)


@jax.jit
def commanded(decided, memory, substep, measurement):
    legs, now = CONFIG.legs.parameters, {"substep": substep, "measurement": measurement}
    return actuate(CONFIG, ROBOT, legs, plan=decided, memory=memory, **now)


def standing(x=0.0):
    zero = jnp.zeros(3)
    state = State(zero, jnp.array([x, 0.0, HEIGHT]), zero, zero)
    return Measurement(state, jnp.asarray(ROBOT.standing_joints), jnp.zeros(10))


def at(tick, measurement=None, memory=None, max_contacts=1):
    measurement = standing() if measurement is None else measurement
    memory = init_memory(ROBOT, measurement) if memory is None else memory
    return planned(jnp.array(tick), memory, measurement, max_contacts=max_contacts)


@pytest.mark.parametrize("euler", [(0, 0, 0), (0.1, -0.2, 0.3), (-0.1, 0.1, 3.5), (0, 0.1, -9)])
def test_measured_feet_are_those_of_mujoco_and_their_yaw_is_as_continuous_as_the_robots(euler):
    model = compile_model(describe())
    data = mujoco.MjData(model)
    joints = np.array(ROBOT.standing_joints)
    joints[[0, 5, 6]] += 0.1, 0.3, -0.2
    R = np.array(rotation_from_euler(jnp.array(euler, float)))
    data.qpos[:3], data.qpos[7:] = (0.3, -0.1, 0.6), joints
    mujoco.mju_mat2Quat(data.qpos[3:7], R.ravel())
    mujoco.mj_forward(model, data)
    position = data.qpos[:3] + R @ ROBOT.com_offset
    state = State(*(jnp.array(row, float) for row in (euler, position, (0, 0, 0), (0, 0, 0))))
    feet = feet_of(Measurement(state, jnp.asarray(joints), jnp.zeros(10)))
    for foot, point in enumerate(ROBOT.description.feet):
        site = data.site(point.point)
        np.testing.assert_allclose(feet.position[foot], site.xpos, atol=1e-9)
        heading = [np.cos(feet.yaw[foot]), np.sin(feet.yaw[foot])]
        ahead = site.xmat.reshape(3, 3)[:2, 0]
        np.testing.assert_allclose(heading, ahead / np.linalg.norm(ahead), atol=1e-9)
        assert abs(feet.yaw[foot] - euler[2]) < 0.5


def test_a_standing_foot_is_remembered_and_a_flying_one_is_not():
    old = init_memory(ROBOT, standing())
    now = standing(x=0.2)
    memory, decided = at(5, now, old)
    assert decided.contact.tolist() == [True, False]
    feet = feet_of(now)
    np.testing.assert_allclose(memory.liftoff.position[0], feet.position[0])
    np.testing.assert_allclose(memory.liftoff.position[1], old.liftoff.position[1])
    later, _ = at(25, standing(x=0.4), memory)
    np.testing.assert_allclose(later.liftoff.position[0], feet.position[0])
    np.testing.assert_allclose(later.liftoff.position[1, 0] - memory.liftoff.position[1, 0], 0.4)


def test_every_number_that_the_plan_reads_has_a_derivative_and_compiles_nothing():
    compiled = []
    moving = standing(x=-0.3).state._replace(velocity=jnp.array([0.3, 0.0, 0.0]))
    beside = jnp.array([0.02, -0.01, 0.03])  # all that is integrated is off
    moving = moving._replace(euler=beside, position=moving.position + beside)

    @jax.jit
    def slope(parameters, moved):
        compiled.append(1)

        def force(parameters):
            asked = {"command": named_command("c"), "anchor": ANCHOR, "tick": jnp.array(3)}
            now = {"state": moving, "feet": feet_of(standing())}
            decided = plan(CONFIG, ROBOT, parameters, **asked, **now)
            return decided.wrench.force, decided.touchdown.position

        return jax.jvp(force, (parameters,), (moved,))[1]

    parameters = TUNABLES["position_limit"].write(CONFIG.parameters(expert()), 0.1)
    parameters = jax.tree.map(lambda x: np.asarray(x, float), parameters)
    still = jax.tree.map(np.zeros_like, parameters)
    felt, reached = {}, {"yaw_limit": 1e-3, "integral_limit": 1e-4}
    for name, one in TUNABLES.items():
        if not name.startswith("k"):
            at = parameters
            if name in reached:  # a limit that is passed here, as are those of the integral action
                at = one.write(at, np.array(reached[name]))
                at = TUNABLES["tilt_gain"].write(at, np.array(100.0))
            changes = slope(at, one.write(still, np.ones(())))
            felt[name] = bool(sum(jnp.abs(change).max() for change in changes) > 1e-9)
    unfelt = {"gravity_compensation", "foot_height", "landing"}
    assert felt == {name: name not in unfelt for name in felt}
    slope(TUNABLES["footstep_feedback"].write(parameters, np.array(0.3)), still)
    assert len(compiled) == 1
    assert Q.read(parameters) is parameters.mpc.weights.Q


def test_the_numbers_beside_the_weights_are_those_of_the_weights_or_of_the_config():
    same = CONFIG.parameters(CONFIG.with_others(expert(), TUNABLES))
    jax.tree.map(np.testing.assert_array_equal, CONFIG.parameters(expert()), same)
    mine = CONFIG.with_others(expert()._replace(others={"turn_lead": 0.9}), ["turn_lead", "kp"])
    assert mine.others["turn_lead"] == 0.9
    assert mine.others["kp"].tolist() == list(CONFIG.legs.kp)
    parameters = CONFIG.parameters(mine._replace(others={**mine.others, "foot_height": 0.1}))
    assert (parameters.footstep.turn, parameters.legs.height) == (0.9, 0.1)
    jax.tree.map(np.testing.assert_array_equal, parameters.mpc.weights, expert())
    for name, one in TUNABLES.items():
        assert np.shape(one.read(CONFIG.parameters(expert()))) == one.shape(), name


@pytest.mark.parametrize(
    ("tick", "foot", "swung"), [(0, 0, 0), (19, 0, 19), (20, 1, 0), (39, 1, 19), (-61, 0, 19)]
)
def test_the_stance_foot_carries_the_robot_and_the_other_nothing(tick, foot, swung):
    _, decided = at(tick)
    assert decided.status == Status.SOLVED
    assert decided.residual < 1e-8
    assert bool(decided.contact[foot])
    assert (decided.swing_ticks[foot], decided.swing_ticks[1 - foot]) == (0, swung)
    assert 0.5 * WEIGHT < decided.wrench.force[foot, 2] < 2 * WEIGHT
    assert not np.asarray(decided.wrench.force[1 - foot]).any()
    assert not np.asarray(decided.wrench.moment[1 - foot]).any()


def test_an_error_beyond_the_limit_counts_as_the_limit():
    def force(x, limit):
        memory = init_memory(ROBOT, standing(x=x))
        _, decided = planned(jnp.array(2), memory, standing(x=x), limit=limit)
        return np.asarray(decided.wrench.force)

    # the reference is 1 cm ahead of the anchor at tick 2
    np.testing.assert_allclose(force(-0.3, 0.05), force(-0.04, np.inf), atol=1e-6)
    np.testing.assert_array_equal(force(-0.03, 0.05), force(-0.03, np.inf))
    # to the side and ahead: only the distance shrinks, not the direction nor the height
    state = standing().state
    away = state._replace(position=state.position + jnp.array([0.3, -0.4, 0.02]))
    ahead = State(*jnp.zeros((4, 3, 3)))
    horizon = Horizon(ahead, ahead.euler, *[jnp.zeros((3, 2))] * 2, jnp.ones((3, 2), bool))
    moved = controller.limit_errors(horizon, away, state, 0.1).reference
    np.testing.assert_allclose(moved.position, [[0.24, -0.32, 0.0]] * 3, atol=1e-9)
    np.testing.assert_array_equal(moved.euler, 0.0)
    for yaw, shift in ((2.0, 1.7), (0.25, 0.0), (-0.5, -0.2)):
        turned = state._replace(euler=jnp.array([0.1, 0.2, yaw]))
        euler = controller.limit_errors(horizon, turned, state, np.inf, 0.3).reference.euler
        np.testing.assert_allclose(euler, [[0.0, 0.0, shift]] * 3, atol=1e-9)
    place = lambda x: controller.limit_errors(horizon, x, state, np.inf).reference.position  # noqa: E731
    unlimited = jax.grad(lambda x: place(x)[0, 0])
    assert not any(part.any() for part in unlimited(state))  # and is finite without an error


def test_a_foot_that_lands_twice_within_the_horizon_lands_a_stride_further():
    config = WalkConfig(gait=GaitConfig(stance=10, swing=10), mpc=MpcConfig(horizon=15))
    assert config.touchdowns == 3
    walking = jax.tree.map(jnp.asarray, standing())
    state = walking.state._replace(velocity=jnp.array([0.5, 0.0, 0.0]))
    asked = {"command": STRAIGHT, "anchor": ANCHOR, "tick": jnp.array(0)}
    ahead_of = jax.jit(partial(controller.plan_horizon, config, ROBOT, config.footstep.parameters))
    horizon, _, touchdown = ahead_of(**asked, state=state, feet=feet_of(walking))
    stands = np.asarray(horizon.contact)
    assert stands.sum(axis=1).tolist() == [1] * 15
    # a foot stands 0.1 s: at 0.5 m/s it is hardly further than 3 cm from under the body
    assert np.abs(np.asarray(horizon.lever)[stands][:, 0]).max() < 0.035
    ahead = np.asarray(horizon.lever[-1, 0] + 0.5 * 0.42 - touchdown.position[0])[0]
    assert ahead == pytest.approx(0.5 * 0.2, abs=0.01)  # a cycle further on


def test_before_the_gait_both_feet_share_the_weight_and_have_room_as_in_double_support():
    _, decided = at(-110, max_contacts=2)
    assert decided.contact.tolist() == [True, True]
    assert decided.swing_ticks.tolist() == [0, 0]
    np.testing.assert_allclose(decided.wrench.force[:, 2], WEIGHT / 2, rtol=0.2)
    np.testing.assert_allclose(decided.wrench.force[0, 2], decided.wrench.force[1, 2], rtol=1e-3)
    needed = partial(controller.contacts_needed, CONFIG)
    assert list(map(needed, (-110, -81, -80, 0, 400))) == [2, 2, 1, 1, 1]
    double = WalkConfig(gait=GaitConfig(stance=24, swing=16))
    assert controller.contacts_needed(double, 0) == 2


def test_a_stance_leg_pushes_as_planned_a_swing_leg_is_pulled_on_and_ticks_join():
    measurement = standing()
    memory, decided = at(22, measurement)
    now, later = (commanded(decided, memory, jnp.array(ms), measurement) for ms in (0, 9))
    expected = stance_torques(ROBOT, measurement.state, measurement.joints, decided.wrench)
    np.testing.assert_allclose([now[5:], later[5:]], [expected[5:]] * 2, atol=1e-9)
    assert now[8] > 5.0  # the knee holds the weight
    assert later[3] < now[3] - 0.5  # and that of the other leg bends more and more
    memory, decided = at(25, measurement)
    next_tick = decided._replace(swing_ticks=decided.swing_ticks + jnp.array([1, 0]))
    one = commanded(decided, memory, jnp.array(10), measurement)
    other = commanded(next_tick, memory, jnp.array(0), measurement)
    np.testing.assert_allclose(one, other, atol=1e-9)
