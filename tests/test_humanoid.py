"""Other robots: their models, flat feet, gradients, both engines, export, tuning."""

import json
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from model import EXAMPLES, QUADRUPED
from pretend import call
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation
from test_rollout import OBLIQUE, check_gradient

from hector_jax import Job, RolloutConfig, Scenario, hfs, ideal, last_command, load_robot, walk
from hector_jax.control import expert, named_command, nominal, standing_anchor, walk_config
from hector_jax.control.contact import CORNER_FRICTION, FLAT_FOOT, Contact, rows
from hector_jax.control.controller import WalkConfig
from hector_jax.control.weights_file import load_weights, save_weights
from hector_jax.export.check import compare_with_live, compile_controller, compiler, record
from hector_jax.export.source import controller_source
from hector_jax.grfm.dataset import at_interval
from hector_jax.importing.remarks import differences
from hector_jax.sim.parallel import walk_batch
from hector_jax.store import nets
from hector_jax.store.collection import load_walks
from hector_jax.store.nets import CollectConfig
from hector_jax.store.run import Run

ROBOT = load_robot(EXAMPLES / "humanoid" / "robot.toml")
CONFIG = walk_config(ROBOT)
MU, MOST = 0.6, 800.0
FILES = [("humanoid/robot.toml", 35.0, 0.647), ("hector-v2/robot.toml", 11.468, 0.417)]
FILES += [("hector-v2/arms.toml", 14.848, 0.478)]


@pytest.mark.parametrize(("file", "mass", "com_height"), FILES)
def test_a_model_weighs_what_its_source_says_and_is_its_own_mirror_image(file, mass, com_height):
    robot = load_robot(EXAMPLES / file)
    assert robot.mass == pytest.approx(mass, abs=1e-3)
    assert robot.standing_height == pytest.approx(com_height, abs=1e-3)
    np.testing.assert_allclose(robot.inertia[1, [0, 2]], 0.0, atol=1e-9)
    np.testing.assert_array_equal(*np.split(robot.torque_limit, 2))
    assert differences(robot) == []


def rows_of(yaw, constraints):
    """Rows and bounds of a flat foot in (F, M), M in the foot's yaw frame."""
    eye = jnp.eye(6)
    contact = Contact(eye[:3], eye[3:], jnp.asarray(yaw), ROBOT, MU, MOST)
    parts = [rows(one, contact, eye) for one in constraints]
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


def extremes(yaw):
    """Wrenches at corners of what the rows allow, at 300 N."""
    A, lower, upper = rows_of(yaw, (*FLAT_FOOT.constraints, CORNER_FRICTION))
    up, down = np.isfinite(upper), np.isfinite(lower)
    both = np.concatenate([A[up], -A[down]]), np.concatenate([upper[up], -lower[down]])
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(40, 6)) * [1, 1, 0, 10, 10, 10]:
        bounds = [(None, None)] * 2 + [(300.0, 300.0)] + [(None, None)] * 3
        found = linprog(-direction, *both, bounds=bounds)
        assert found.status == 0
        yield found.x


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 4, -1.2])
def test_corner_friction_is_what_the_corners_hold_within_their_squares(yaw):
    for wrench in extremes(yaw):
        assert held(wrench * [1, 1, 1, 0.999, 0.999, 0.999], yaw)
    # the edges of that cone: one corner loaded, its force at a corner of its square
    side = 0.5 * MU / max(abs(np.cos(yaw)), abs(np.sin(yaw)))
    foot = np.array([(side * a, side * b, 1.0) for a, b in product((1, -1), (1, -1))])
    forces = foot @ Rotation.from_euler("z", yaw).as_matrix().T
    edges = np.hstack([corner_forces(yaw)[:, 3 * i : 3 * i + 3] @ forces.T for i in range(4)])
    A, lower, upper = rows_of(yaw, [CORNER_FRICTION])
    room = np.minimum(A @ edges - lower[:, None], upper[:, None] - A @ edges)
    np.testing.assert_allclose(room.min(axis=1), 0.0, atol=1e-12)


def test_the_bounds_of_a_flat_foot_are_its_edges():
    A, lower, upper = rows_of(0.3, FLAT_FOOT.constraints)
    inside = lambda w: np.all(lower - 1e-9 <= A @ w) and np.all(A @ w <= upper + 1e-9)  # noqa: E731
    edges = [
        (4, -1, -300.0 * float(ROBOT.toe)),  # pressed at the toe
        (4, 1, 300.0 * float(ROBOT.heel)),
        (3, 1, 300.0 * float(ROBOT.half_width)),  # at the left edge
    ]
    for axis, sign, moment in edges:
        axis = np.eye(6)[axis]
        for wrench, expected in ((moment * axis, True), ((moment + 0.1 * sign) * axis, False)):
            wrench = wrench + [0, 0, 300.0, 0, 0, 0]
            assert inside(wrench) == held(wrench, 0.3) == expected
    twist = np.array([0, 0, 300.0, 0, 0, 1.0])
    most = 300.0 * MU * np.hypot(0.5 * (ROBOT.toe + ROBOT.heel), ROBOT.half_width)
    assert not inside(twist * [0, 0, 1, 0, 0, most])
    assert inside(twist * [0, 0, 1, 0, 0, 0.47 * most])


def test_gains_in_a_weights_file_are_one_for_each_joint(tmp_path):
    gains = {"kp": np.full(6, 120.0)}
    save_weights(tmp_path / "six.json", nominal(ROBOT)._replace(others=gains))
    weights = load_weights(tmp_path / "six.json", ROBOT)
    np.testing.assert_array_equal(CONFIG.parameters(weights).legs.kp, gains["kp"])
    with pytest.raises(ValueError, match="others.kp must be 5 numbers"):
        load_weights(tmp_path / "six.json")


def both(test):
    """A longer story of either robot."""
    robots = pytest.mark.parametrize("robot", [ROBOT, QUADRUPED], ids=["humanoid", "quadruped"])
    return pytest.mark.slow(robots(test))


@both
def test_the_gradient_is_that_of_differences(robot):
    """Over 50 ticks to 1e-6, over 4 s to 1e-4."""
    short, long = (RolloutConfig(walk=walk_config(robot), ticks=ticks) for ticks in (50, 400))
    anchor, weights = standing_anchor(robot), nominal(robot)
    s, c = (Scenario(robot, named_command(name), anchor, last_command) for name in "sc")
    check_gradient(short, s, weights, 1e-6, OBLIQUE, case="50 ticks")
    check_gradient(long, c, weights, 1e-4, case="4 s")


@both
def test_both_engines_walk_alike(robot):
    config, plant = walk_config(robot), hfs(robot.description)
    job = Job(nominal(robot), named_command("straight"), plant, seconds=0.4)
    (batch,) = walk_batch(config, robot, [job])
    alone = at_interval(walk(config, robot, job), 0.01)
    np.testing.assert_allclose(batch.state.position, alone.state.position, atol=1e-6)
    np.testing.assert_allclose(batch.effect.force, alone.effect.force, atol=1e-2)


@both
@pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
def test_the_controller_in_c_answers_as_the_live_one(robot, tmp_path):
    config, weights = walk_config(robot), nominal(robot)
    source = controller_source(config, robot, weights, name="nominal", content=b"")
    walked = record(config, robot, Job(weights, named_command("s"), ideal(robot.description), 0.4))
    found = compare_with_live(config, robot, compile_controller(source, tmp_path), walked)
    assert max(found.force, found.moment, found.torque) <= 1e-8
    assert found.unsolved == 0


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


STRIDER = EXAMPLES / "strider" / "robot.toml"


@pytest.fixture(scope="module")
def strider():
    return load_robot(STRIDER)


def test_the_description_of_hector_says_what_the_code_takes_by_default():
    robot = load_robot()
    assert walk_config(robot) == WalkConfig()
    assert repr(walk_config(robot)) == repr(WalkConfig())  # by which walks are known
    for of_robot, default in ((nominal(robot), nominal()), (expert(robot), expert())):
        jax.tree.map(np.testing.assert_array_equal, of_robot, default)


@pytest.mark.slow
def test_strider_walks_five_metres_untuned(strider):
    for world in (ideal, hfs):
        job = Job(nominal(strider), named_command("straight"), world(), 10.5)
        found = walk(walk_config(strider), strider, job)
        assert not found.fallen.any(), world
        assert not found.legs_touch.any(), world
        ahead, aside, up = found.state.position[-1] - found.initial.position
        assert ahead > 5.0, world
        assert max(abs(aside) / 5, abs(up)) < 0.1, world


@pytest.mark.long
@pytest.mark.slow
def test_strider_is_tuned_by_the_same_command_and_a_run_knows_it(monkeypatch, strider, tmp_path):
    monkeypatch.chdir(tmp_path)
    small = CollectConfig(walks=6, seconds=1.0)
    monkeypatch.setattr(nets, "CollectConfig", lambda: small)
    Path("ahead.toml").write_text('name = "ahead"\n[[segment]]\nseconds = 1.5\nv_x = 0.3\n')
    flags = ("--traj", "ahead.toml", "--seeds", "1", "--iterations", "4", "--no-video")
    few = ("--walk-plants", "1", "--processes", "1")
    assert call(monkeypatch, "tune", "--robot", STRIDER, *flags, *few) == 0
    assert len(load_walks(tmp_path / "data" / "strider" / "walks", strider).job.seed) == 6
    assert (tmp_path / "data" / "strider" / "grfm.npz").exists()
    with pytest.raises(ValueError, match="made for another robot"):
        load_walks(tmp_path / "data" / "strider" / "walks", load_robot())
    (run,) = (tmp_path / "runs" / "strider" / "ahead").iterdir()
    assert Run(run).weights_file("with") == run / "weights" / "with.json"
    assert Run(run).controller == walk_config(strider)
    assert Run(run).request.robot == STRIDER
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for name in ("without", "with"):
        L = [line["L"] for line in lines if line["set"] == name and line["accepted"]]
        assert L[-1] < 0.95 * L[0]
    assert json.loads((run / "result.json").read_text())["sets"]["with"]["hfs"]["falls"] == 0
