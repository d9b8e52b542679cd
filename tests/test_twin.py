"""The MPC of another controller: its parts, and parity of its plans with those of the example."""

import json
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import AHEAD, ANCHOR, EXAMPLES, HEIGHT, PLAIN, ROBOT
from pretend import call

from hector_jax import InputError, State, expert, load_robot, named_command
from hector_jax.control.contact import BOX_FRICTION, TWIST, Constraint
from hector_jax.control.controller import WalkConfig, plan, plan_horizon, walk_config
from hector_jax.control.footstep import Feet
from hector_jax.control.mpc import MpcConfig
from hector_jax.control.twin import FROM_ROBOT, FROZEN, PATH, ReferenceInputs, TwinConfig
from hector_jax.tuning.rollout import RolloutConfig, Scenario, rollout, rollout_config

OWN = EXAMPLES / "own_controller"
STATE = State(*(jnp.array(x) for x in ([0.05, 0.1, 0.3], [1.0, 2.0, 0.5], [0.1] * 3, [0.4, 0, 0])))
FEET = Feet(STATE.position + jnp.array([[0.1, 0.08, -0.5], [-0.1, -0.08, -0.45]]), jnp.full(2, 0.2))


@partial(jax.jit, static_argnums=0)
def horizon(config, tick=5):
    now = {"tick": jnp.asarray(tick), "state": STATE, "feet": FEET}
    parameters = config.footstep.parameters
    inputs = {"command": named_command("s"), "anchor": ANCHOR, **now}
    return plan_horizon(config, ROBOT, parameters, **inputs)[0]


@partial(jax.jit, static_argnums=0)
def planned(config, tick=5, last=None):
    asked = {"command": named_command("s"), "anchor": ANCHOR, "tick": jnp.asarray(tick)}
    asked["max_contacts"] = 2 if config.twin.air_moments else 1
    now = {"state": STATE, "feet": FEET, "last": last}
    return plan(config, ROBOT, config.parameters(expert()), **asked, **now)


def twin(**changes):
    return WalkConfig(twin=TwinConfig(**changes))


def test_a_reference_from_the_robot_starts_at_it_and_keeps_to_the_path_where_nothing_moves():
    motion = ReferenceInputs(named_command("c"), ANCHOR, jnp.arange(0, 33, 3), STATE)
    ahead = FROM_ROBOT.of(0.01, motion)
    np.testing.assert_allclose(ahead.position[0], [1.0, 2.0, HEIGHT], atol=1e-15)
    np.testing.assert_allclose(ahead.euler[:, 2], 0.3 + 0.03 * np.pi / 4 * np.arange(11))
    steps = np.diff(ahead.position, axis=0) / 0.03
    np.testing.assert_allclose(steps, ahead.velocity[:-1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ahead.velocity, axis=1), 0.25)
    # the path, which does not know the robot, has the same rates and lengths of the steps
    path = PATH.of(0.01, motion)
    np.testing.assert_allclose(path.ang_velocity, ahead.ang_velocity)
    np.testing.assert_allclose(path.position[0], [*ROBOT.com_offset[:2], HEIGHT], atol=1e-12)
    path, robot, both = (
        horizon(twin(**changes)).reference
        for changes in ({}, {"reference": FROM_ROBOT}, {"reference": FROM_ROBOT, "at_rest": 0.2})
    )
    assert abs(path.velocity[0, 1]) < 0.2 < path.velocity[0, 0]  # ahead along x
    np.testing.assert_allclose(both.position[:, 0], robot.position[:, 0])
    step = both.position[:, 1] - robot.position[:, 1]
    np.testing.assert_allclose(step, step[0])
    assert abs(both.position[0, 1] - path.position[0, 1]) < 0.01


def test_late_targets_frozen_linearisations_and_contacts_at_a_share_of_a_step_are_as_asked_for():
    on_time, late = (horizon(twin(late=late)).reference for late in (0, 1))
    for now, then in zip(on_time, late, strict=True):
        np.testing.assert_array_equal(then[1:], now[:-1])
    found = horizon(twin(linearisation=FROZEN))
    np.testing.assert_allclose(found.euler, np.tile(STATE.euler, (10, 1)))
    np.testing.assert_allclose(found.lever, np.tile(FEET.position - STATE.position, (10, 1, 1)))
    np.testing.assert_allclose(found.foot_yaw, 0.2)
    # steps of 3 ticks from tick 18 on; the feet change at 20 and at 40, within the step from 39 on
    begin, middle = (horizon(twin(contact_at=x), 18).contact[:, 0] for x in (0.0, 0.5))
    np.testing.assert_array_equal(np.flatnonzero(begin != middle), [7])


def test_between_plans_of_several_ticks_the_wrench_of_the_last_one_is_kept():
    robot = ROBOT._replace(description=ROBOT.description)
    config = RolloutConfig(walk=replace(WalkConfig(), twin=TwinConfig(plan_ticks=2)), ticks=12)
    walk = jax.jit(partial(rollout, config))(Scenario(robot, AHEAD, ANCHOR, PLAIN), expert())
    forces = np.asarray(walk.command.force)
    np.testing.assert_array_equal(forces[1::2], forces[::2])
    assert (np.diff(forces[::2], axis=0) != 0).any(axis=(1, 2)).all()
    assert (np.asarray(walk.residual)[1::2] == 0.0).all()


def test_a_foot_in_the_air_with_inputs_changes_the_plan_and_exerts_nothing():
    # of the rows of a line foot one also makes the yaw moment zero without a force
    walk = WalkConfig(mpc=MpcConfig(line_friction=False))
    without, found = planned(walk), planned(replace(walk, twin=TwinConfig(air_moments=True)))
    air = ~np.asarray(found.contact)
    assert air.sum() == 1
    assert np.abs(np.asarray(found.wrench.moment)[air]).max() == 0.0
    assert np.abs(np.asarray(found.wrench.moment - without.wrench.moment)).max() > 1e-3
    assert found.residual < 1e-9


def test_the_body_of_a_twin_is_planned_with():
    given = {"mass": 2.0 * float(ROBOT.mass), "inertia": (1.0, 2.0, 3.0), "toe": 0.01, "heel": 0.02}
    body = TwinConfig(**given).body(ROBOT)
    np.testing.assert_array_equal(body.inertia, np.diag([1.0, 2.0, 3.0]))
    assert (body.mass, body.toe, body.heel) == (given["mass"], 0.01, 0.02)
    configs = twin(reference=FROM_ROBOT, mass=given["mass"]), twin(reference=FROM_ROBOT)
    heavy, own = (float(planned(config).wrench.force[0, 2]) for config in configs)
    assert heavy > 1.2 * own
    with pytest.raises(InputError, match="TwinConfig.inertia must be 3 numbers"):
        TwinConfig(inertia=(1.0,))
    with pytest.raises(InputError, match="TwinConfig.com needs height"):
        TwinConfig(com=(0.0, 0.0, 0.0))


def test_a_limit_of_the_position_error_is_one_from_the_twins_own_reference():
    far = twin(reference=FROM_ROBOT)  # the path is 2 m away
    configs = (replace(far, mpc=MpcConfig(position_limit=limit)) for limit in (None, 0.1))
    free, limited = (planned(config).wrench for config in configs)
    np.testing.assert_allclose(limited.force, free.force, atol=1e-6)


def test_friction_as_a_box_and_a_limited_twist_hold_along_the_foot():
    names = ("box_friction", "unilateral_force", "line_pressure", "twist")
    known = {str(one): one for one in Constraint.known}
    constraints = tuple(known[name] for name in names)
    assert {BOX_FRICTION, TWIST} <= {*constraints}
    config = replace(twin(), mpc=MpcConfig(constraints=constraints, friction=0.05, twist=0.002))
    wrench = planned(config).wrench
    c, s = np.cos(0.2), np.sin(0.2)
    (fx, fy, fz), mz = np.asarray(wrench.force[0]), float(wrench.moment[0, 2])
    along, across = c * fx + s * fy, c * fy - s * fx
    assert max(abs(along), abs(across)) <= 0.05 * fz + 1e-9
    assert max(abs(along), abs(across)) == pytest.approx(0.05 * fz)  # it is active
    assert abs(mz) == pytest.approx(0.002 * fz)


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """The log of the example, and the line of a command about it."""
    pytest.importorskip("daqp")
    path = tmp_path_factory.mktemp("own") / "log.npz"
    line = ("--traj", "s", "--seconds", 1.5, "--weights", "expert")
    with pytest.MonkeyPatch.context() as patch:
        walker = ("walk", "--walker", OWN / "walker.py", *line, "--out", path)
        assert call(patch, *walker, "--robot", OWN / "twin.toml") == 0
    return path, ("log", "twin", path, *line, "--robot")


def test_the_plans_of_the_example_are_those_of_its_twin(walked, monkeypatch, capsys):
    path, line = walked
    assert call(monkeypatch, *line, OWN / "twin.toml", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["plans"] == 149
    assert found["unsolved"] == found["other_contact"] == 0
    assert max(of["worst"] for of in found["differences"].values()) < 1e-6


def test_a_twin_of_another_kind_is_told_where_it_differs(walked, tmp_path, monkeypatch, capsys):
    path, line = walked
    (tmp_path / "hector.xml").write_bytes((OWN / "hector.xml").read_bytes())
    text = (OWN / "twin.toml").read_text().replace("cycles = 1", "cycles = 2")
    gait = text.replace("stance = 40\nswing = 40", "stance = 44\nswing = 36")
    for changed, told in (
        (gait, "% of the plans the log has other feet on the floor: see [gait]"),
        (text.replace('"from_robot"', '"path"'), "from the reference in the log on, at most "),
    ):
        (tmp_path / "other.toml").write_text(changed)
        assert call(monkeypatch, *line, tmp_path / "other.toml") == 0
        lines = capsys.readouterr().out
        assert "149 plans" in lines
        assert " foot, F_" in lines
        assert told in lines


def test_a_twin_file_is_read_as_a_robots_and_nothing_is_said_of_its_motors(monkeypatch, capsys):
    config = walk_config(robot := load_robot(OWN / "twin.toml"))
    assert config.twin == TwinConfig(FROM_ROBOT, linearisation=FROZEN, contact_at=0.0, plan_ticks=2)
    assert config.plan_interval == pytest.approx(0.01)
    assert rollout_config(robot).ticks == 800  # 4 s
    assert call(monkeypatch, "robot", OWN / "twin.toml") == 0
    lines = capsys.readouterr().out
    assert "own_controller: 12 kg" in lines
    assert "of the motors" not in lines
