"""Flat feet and legs of six joints: the wrench of a foot, the gradient, both engines, export."""

from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation
from test_rollout import OBLIQUE, check_gradient

from hector_jax.control.contact import CORNER_FRICTION, FLAT_FOOT, Contact, rows
from hector_jax.control.controller import walk_config
from hector_jax.control.reference import named_command, standing_anchor
from hector_jax.control.weights import nominal
from hector_jax.control.weights_file import load_weights, save_weights, weights_tree
from hector_jax.export.controller import compare_with_live, record
from hector_jax.export.export import (
    TOLERANCE,
    controller,
    export_controller,
    load_controller,
    weights_schema,
)
from hector_jax.grfm.dataset import at_interval
from hector_jax.grfm.effect import last_command
from hector_jax.robot.model import load_robot
from hector_jax.sim.loop import Job
from hector_jax.sim.parallel import walk_batch
from hector_jax.sim.walk import walk
from hector_jax.sim.world import hfs
from hector_jax.tuning.rollout import RolloutConfig, Scenario

ROBOT = load_robot(Path(__file__).parents[1] / "examples" / "humanoid" / "robot.toml")
CONFIG = walk_config(ROBOT)
MU, MOST = 0.6, 800.0


def flat_rows(yaw, *extra):
    """Rows and bounds of a flat foot in (F, M), M in the foot's yaw frame."""
    eye = jnp.eye(6)
    contact = Contact(eye[:3], eye[3:], jnp.asarray(yaw), ROBOT, MU, MOST)
    parts = [rows(one, contact, eye) for one in (*FLAT_FOOT.constraints, *extra)]
    return [np.concatenate([np.asarray(x) for x in part]) for part in zip(*parts, strict=True)]


def corner_forces(yaw):
    """Corners of the sole (4, 3) in the yaw frame and the map from their forces to (F, M)."""
    length, width = (ROBOT.toe, -ROBOT.heel), (ROBOT.half_width, -ROBOT.half_width)
    corners = np.array([(x, y, 0.0) for x, y in product(length, width)])
    R = Rotation.from_euler("z", yaw).as_matrix()
    cross = lambda v: np.cross(v, np.eye(3)).T  # noqa: E731
    moments = [cross(corner) @ R.T for corner in corners]
    return np.concatenate([np.tile(np.eye(3), 4), np.concatenate(moments, axis=1)])


def held(wrench, yaw):
    """Whether forces at the corners, each in its pyramid, exert a wrench."""
    A = [
        [*(0.0,) * 3 * i, a, b, -MU, *(0.0,) * 3 * (3 - i)]
        for i, a, b in product(range(4), (1, -1), (1, -1))
    ]
    found = linprog(
        np.zeros(12), np.array(A), np.zeros(16), corner_forces(yaw), wrench, [(None, None)] * 12
    )
    return found.status == 0


def extremes(yaw, *extra):
    """Wrenches at corners of what the rows allow, at 300 N."""
    A, lower, upper = flat_rows(yaw, *extra)
    up, down = np.isfinite(upper), np.isfinite(lower)
    both = np.concatenate([A[up], -A[down]]), np.concatenate([upper[up], -lower[down]])
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(40, 6)) * [1, 1, 0, 10, 10, 10]:
        bounds = [(None, None)] * 2 + [(300.0, 300.0)] + [(None, None)] * 3
        found = linprog(-direction, *both, bounds=bounds)
        assert found.status == 0
        yield found.x


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 4, -1.2])
def test_what_corner_friction_allows_the_corners_hold(yaw):
    for wrench in extremes(yaw, CORNER_FRICTION):
        assert held(wrench * [1, 1, 1, 0.999, 0.999, 0.999], yaw)


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 4, -1.2])
def test_corner_friction_allows_all_that_the_corners_hold_within_their_squares(yaw):
    """The edges of that cone: one corner loaded, its force at a corner of its square."""
    side = 0.5 * MU / max(abs(np.cos(yaw)), abs(np.sin(yaw)))
    foot = np.array([(side * a, side * b, 1.0) for a, b in product((1, -1), (1, -1))])
    forces = foot @ Rotation.from_euler("z", yaw).as_matrix().T
    edges = np.concatenate(
        [corner_forces(yaw)[:, 3 * i : 3 * i + 3] @ forces.T for i in range(4)], 1
    )
    eye = jnp.eye(6)
    A, lower, upper = rows(CORNER_FRICTION, Contact(eye[:3], eye[3:], yaw, ROBOT, MU, MOST), eye)
    room = np.minimum(A @ edges - lower[:, None], upper[:, None] - A @ edges)
    np.testing.assert_allclose(room.min(axis=1), 0.0, atol=1e-12)


def test_the_bounds_of_a_flat_foot_are_its_edges():
    A, lower, upper = flat_rows(0.3)
    inside = lambda w: np.all(lower - 1e-9 <= A @ w) and np.all(A @ w <= upper + 1e-9)  # noqa: E731
    edges = {
        (0, 0, 300.0, 0, -300.0 * float(ROBOT.toe), 0): (4, -1),  # pressed at the toe
        (0, 0, 300.0, 0, 300.0 * float(ROBOT.heel), 0): (4, 1),
        (0, 0, 300.0, 300.0 * float(ROBOT.half_width), 0, 0): (3, 1),  # at the left edge
    }
    for wrench, (axis, sign) in edges.items():
        wrench = np.array(wrench)
        assert inside(wrench)
        assert held(wrench, 0.3)
        beyond = wrench + 0.1 * sign * np.eye(6)[axis]
        assert not inside(beyond)
        assert not held(beyond, 0.3)
    twist = np.array([0, 0, 300.0, 0, 0, 1.0])
    most = 300.0 * MU * np.hypot(0.5 * (ROBOT.toe + ROBOT.heel), ROBOT.half_width)
    assert not inside(twist * [0, 0, 1, 0, 0, most])
    assert inside(twist * [0, 0, 1, 0, 0, 0.47 * most])


def test_the_controller_of_flat_feet_has_six_inputs_a_foot():
    assert CONFIG.mpc.contact == FLAT_FOOT
    assert (FLAT_FOOT.inputs, len(CONFIG.legs.kp)) == (6, 6)


def test_gains_in_a_weights_file_are_one_for_each_joint(tmp_path):
    gains = {"kp": np.full(6, 120.0)}
    save_weights(tmp_path / "six.json", nominal(ROBOT)._replace(others=gains))
    weights = load_weights(tmp_path / "six.json", ROBOT)
    np.testing.assert_array_equal(CONFIG.parameters(weights).legs.kp, gains["kp"])
    with pytest.raises(ValueError, match="others.kp must be 5 numbers"):
        load_weights(tmp_path / "six.json")
    jsonschema.validate(weights_tree(weights), weights_schema(ROBOT))


def check_gradients(robot):
    """The gradient is that of differences: over 50 ticks to 1e-6, over 4 s to 1e-4."""
    short, long = (RolloutConfig(walk=walk_config(robot), ticks=ticks) for ticks in (50, 400))
    anchor, weights = standing_anchor(robot), nominal(robot)
    s, c = (Scenario(robot, named_command(name), anchor, last_command) for name in "sc")
    check_gradient(short, s, weights, 1e-6, OBLIQUE, case="50 ticks")
    check_gradient(long, c, weights, 1e-4, case="4 s")


@pytest.mark.slow
def test_gradient_of_the_humanoid_is_that_of_differences():
    check_gradients(ROBOT)


def check_engines(robot):
    """Both engines walk alike."""
    config, plant = walk_config(robot), hfs(robot.description)
    job = Job(nominal(robot), named_command("straight"), plant, seconds=0.4)
    (batch,) = walk_batch(config, robot, [job])
    alone = at_interval(walk(config, robot, job), 0.01)
    np.testing.assert_allclose(batch.state.position, alone.state.position, atol=1e-6)
    np.testing.assert_allclose(batch.effect.force, alone.effect.force, atol=1e-2)


def check_export(robot):
    """The exported controller answers as the live one."""
    config, weights = walk_config(robot), nominal(robot)
    example = controller(config, robot, weights)[1]
    loaded = load_controller(export_controller(config, robot, weights)), example
    walked = record(config, robot, weights, command=named_command("s"), seconds=0.4)
    found = compare_with_live(config, *loaded, walked)
    assert max(found.force, found.moment, found.torque) <= TOLERANCE
    assert found.unsolved == 0


@pytest.mark.slow
def test_the_humanoid_walks_alike_in_both_engines():
    check_engines(ROBOT)


@pytest.mark.slow
def test_the_controller_of_the_humanoid_is_exported():
    check_export(ROBOT)


@pytest.mark.slow
def test_the_humanoid_walks_twelve_seconds_in_hfs():
    """At 0.25 sqrt(g h), and in a turn of 0.5 rad/s."""
    fast = 0.25 * float(np.sqrt(ROBOT.gravity[2] * ROBOT.standing_height))
    straight = jax.tree.map(np.asarray, named_command("straight"))
    for speed, turn in ((fast, 0.0), (0.3, 0.5)):
        velocity = np.tile([speed, 0.0], (2, 1))
        command = straight._replace(velocity=velocity, yaw_rate=np.full(2, turn))
        found = walk(CONFIG, ROBOT, Job(nominal(ROBOT), command, hfs(ROBOT.description), 12.0))
        assert not found.fallen.any(), (speed, turn)
        if turn:
            turned = found.state.euler[-1, 2] - found.initial.euler[2]
            assert turned == pytest.approx(6.0, abs=0.5)
