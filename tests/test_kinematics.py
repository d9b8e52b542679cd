"""Leg kinematics against MuJoCo.

Two or four legs of any number, order and sign of joints, with turned bodies; then HECTOR's closed
form.
"""

from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model import EXAMPLES
from published import converted
from scipy.spatial.transform import Rotation

from hector_jax.core.geometry import rot_x, rot_y, rot_z
from hector_jax.robot.kinematics import foot_jacobians, foot_poses, inverse_legs, leg_gravity
from hector_jax.robot.model import compile_model, describe, load_robot

LEGS = {  # axes in the trunk frame, from the trunk down
    4: ["x", "y", "y", "-y"],
    5: ["x", "z", "y", "-y", "y"],  # not the order of the closed form
    6: ["-y", "x", "-z", "y", "y", "-x"],
    7: ["z", "x", "y", "-y", "z", "y", "x"],
}
BEND = 0.5  # [rad] of hip and ankle; the knee bends twice as much


def joint_axis(name):
    return (-1.0 if name[0] == "-" else 1.0) * np.eye(3)["xyz".index(name[-1])]


def leg_xml(side, axes, name, turns):
    """One leg; each body is turned by a rotation of its own, which changes nothing."""
    pitches = [i for i, axis in enumerate(axes) if axis[-1] == "y"]
    knee, ankle = pitches[1], pitches[2]
    before, text = np.eye(3), ""
    for i, axis in enumerate(axes):
        step = np.array([0.01, 0.01 * side, -0.01])
        if i == 0:
            step = np.array([0.0, 0.08 * side, -0.06])
        elif i in (knee, ankle):
            step = np.array([0.0, 0.0, -0.25])
        R = turns[i]
        quat = Rotation.from_matrix(before.T @ R).as_quat(scalar_first=True)
        local = R.T @ joint_axis(axis)
        com = R.T @ np.array([0.01, 0.0, -0.05])
        text += (
            f'<body name="{name}{i}" pos="{" ".join(map(str, before.T @ step))}" '
            f'quat="{" ".join(map(str, quat))}">'
            f'<inertial pos="{" ".join(map(str, com))}" mass="{1.0 - 0.1 * i}" '
            'diaginertia="0.004 0.005 0.003"/>'
            f'<joint name="{name}{i}" axis="{" ".join(map(str, local))}" range="-2.5 2.5" '
            'actuatorfrcrange="-90 90"/>'
        )
        before = R
    return text + "</body>" * len(axes), before


def written(folder, count):
    """A biped with legs of `count` joints, and its TOML."""
    rng, axes = np.random.default_rng(count), LEGS[count]
    legs, soles = "", []
    for side, name in ((1, "left"), (-1, "right")):
        turns = Rotation.random(count, random_state=rng.integers(1000)).as_matrix()
        text, last = leg_xml(side, axes, name, turns)
        legs += text
        soles.append(last)
    (folder / "made.xml").write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 1"><freejoint/>'
        '<inertial pos="0 0 0.1" mass="10" diaginertia="0.2 0.2 0.1"/>'
        f"{legs}</body></worldbody></mujoco>"
    )
    pitches = [i for i, axis in enumerate(axes) if axis[-1] == "y"]
    bends = dict(zip(pitches, (-BEND, 2 * BEND, -BEND), strict=True))
    signs = {i: -1.0 if axes[i][0] == "-" else 1.0 for i in range(count)}
    lines = ['name = "made"', 'model = "made.xml"', "[standing]"]
    lines += [f"{s}{i} = {b * signs[i]}" for s in ("left", "right") for i, b in bends.items()]
    names = {s: [f"{s}{i}" for i in range(count)] for s in ("left", "right")}
    lines += ["[joints]", *(f"{side} = {joints!r}" for side, joints in names.items())]
    for side, R in zip(("left", "right"), soles, strict=True):
        corners = [(R.T @ (x, y, -0.05)).tolist() for x in (-0.06, 0.1) for y in (-0.03, 0.03)]
        point = (R.T @ np.array([0.0, 0.0, -0.05])).tolist()
        lines += [f"[feet.{side}]", f'body = "{side}{count - 1}"']
        lines += [f"contacts = {corners}", f"point = {point}"]
    path = folder / "made.toml"
    path.write_text("\n".join(lines))
    return path


@pytest.fixture(scope="module", params=[*LEGS, "quadruped", "hector"])
def made(request, tmp_path_factory):
    path = EXAMPLES / "quadruped" / "robot.toml"
    if request.param == "hector":
        path = None
    elif request.param in LEGS:
        folder = tmp_path_factory.mktemp("made")
        path = converted(written(folder, request.param), folder / "robot")
    return load_robot(path), compile_model(describe(path))


poses, jacobians, gravity = map(jax.jit, (foot_poses, foot_jacobians, leg_gravity))
levelled = jax.jit(jax.vmap(lambda roll, pitch: rot_y(pitch) @ rot_x(roll)))


def posed(robot, model, joints, quaternion=(1.0, 0.0, 0.0, 0.0)):
    data = mujoco.MjData(model)
    data.qpos[:7] = 0, 0, 0, *quaternion
    for name, angle in zip(robot.description.joints, joints, strict=True):
        data.joint(name).qpos[0] = angle
    mujoco.mj_forward(model, data)
    return data


def random_joints(robot, spread=0.4):
    rng = np.random.default_rng(0)
    for _ in range(20):
        yield robot.standing_joints + rng.uniform(-spread, spread, len(robot.standing_joints))


def test_feet_jacobians_and_the_weight_of_the_legs_under_a_tilted_trunk_are_those_of_mujoco(made):
    robot, model = made
    standing = posed(robot, model, robot.standing_joints)
    names = [foot.point for foot in robot.description.feet]
    bodies = [model.site(name).bodyid[0] for name in names]
    soles = [standing.xmat[b].reshape(3, 3).T for b in bodies]  # level when it stands
    for joints in random_joints(robot):
        data, feet = posed(robot, model, joints), poses(robot, jnp.asarray(joints))
        J_v, J_w = jacobians(robot, jnp.asarray(joints))
        count = robot.description.leg_joints
        for side, (name, body) in enumerate(zip(names, bodies, strict=True)):
            np.testing.assert_allclose(feet.position[side], data.site(name).xpos, atol=1e-12)
            R = data.xmat[body].reshape(3, 3) @ soles[side]
            np.testing.assert_allclose(feet.rotation[side], R, atol=1e-12)
            full_v, full_w = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jacSite(model, data, full_v, full_w, model.site(name).id)
            joints_ = robot.description.joints[side * count :][:count]
            own = [model.joint(joint).dofadr[0] for joint in joints_]
            np.testing.assert_allclose(J_v[side], full_v[:, own], atol=1e-12)
            np.testing.assert_allclose(J_w[side], full_w[:, own], atol=1e-12)
    rng = np.random.default_rng(2)
    for joints in random_joints(robot):
        tilt = Rotation.from_euler("xyz", rng.uniform(-0.8, 0.8, 3))
        data = posed(robot, model, joints, tilt.as_quat(scalar_first=True))
        own = [model.joint(name).dofadr[0] for name in robot.description.joints]
        up = jnp.asarray(tilt.inv().apply(robot.gravity))
        found = gravity(robot, jnp.asarray(joints), up)
        np.testing.assert_allclose(found, data.qfrc_bias[own], atol=1e-10)


def test_joints_are_found_from_feet(made):
    """In the rows that a leg places; the position always, all of the sole from six joints on."""
    robot, _ = made
    count = robot.description.leg_joints
    placed = {3: (0, 1, 2), 4: (0, 1, 2, 4), 5: (0, 1, 2, 4, 5)}.get(count, tuple(range(6)))
    assert robot.structure.placed == placed
    inverse = jax.jit(partial(inverse_legs, steps=20))
    start = jnp.asarray(robot.standing_joints)
    rng, legs = np.random.default_rng(1), len(robot.foot_point)
    reach = np.array([0.0, 0.0, 0.05])  # less than standing: the quadruped's knees stay bent
    for _ in range(20):
        feet = poses(robot, start)
        position = feet.position + reach + rng.uniform(-0.04, 0.04, (legs, 3))
        roll, pitch, yaw = jnp.asarray(rng.uniform(-0.2, 0.2, (3, legs)))
        level = np.asarray(levelled(roll, pitch))
        up = level[:, 2]
        found = poses(robot, inverse(robot, position, yaw, up, start))
        np.testing.assert_allclose(found.position, position, atol=1e-9)
        if count >= 6:
            turned = Rotation.from_euler("z", np.asarray(yaw)[:, None]).as_matrix()
            wanted = np.swapaxes(level, 1, 2) @ turned
            np.testing.assert_allclose(found.rotation, wanted, atol=1e-9)


def test_rates_are_the_derivative_of_the_joints_and_all_is_finite_on_axes_and_out_of_reach(made):
    robot, _ = made
    start, legs = jnp.asarray(robot.standing_joints), len(robot.foot_point)
    position = poses(robot, start).position
    up, yaw = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (legs, 1)), jnp.zeros(legs)
    moved = jnp.tile(jnp.array([[0.3, 0.1, 0.2], [-0.2, 0.1, 0.3]]), (legs // 2, 1))
    at = jax.jit(lambda t: inverse_legs(robot, position + t * moved, yaw, up, start, steps=12))
    here, rates = jax.jvp(at, (jnp.asarray(0.05),), (jnp.asarray(1.0),))
    difference = (at(jnp.asarray(0.05 + 1e-5)) - at(jnp.asarray(0.05 - 1e-5))) / 2e-5
    if robot.description.leg_joints <= 6:  # of a seventh joint the part that moves no foot is left
        np.testing.assert_allclose(rates, difference, atol=2e-4)
    J_v, _ = jacobians(robot, here)
    speeds = np.einsum("lij,lj->li", J_v, rates.reshape(legs, -1))
    np.testing.assert_allclose(speeds, moved, atol=1e-6)

    axes = np.cumsum(robot.joint_origin, axis=1).swapaxes(0, 1)
    hip = axes[2]
    beside = hip + robot.joint_origin[:, 3:].sum(axis=1) * [0, 1, 0]  # in the plane of the leg
    targets = [*axes, hip + [0.0, 0.0, 0.5], hip * 1e6, np.full((legs, 3), -5.0)]
    # the ankle in the hip, and the leg straight
    targets += [beside + robot.foot_point, beside + [0.0, 0.0, -0.48]]
    find = lambda position: inverse_legs(robot, position, yaw, up, start, steps=12)  # noqa: E731
    for function in (find, jax.jacfwd(find), jax.jacrev(find)):
        found = jax.jit(jax.vmap(function))(jnp.asarray(np.stack(targets)))
        assert jnp.isfinite(found).all()


HECTOR = load_robot()


def closed_form(robot, position, yaw, pitch):
    """Of soles that pitch as their leg is rolled; the closed form needs no joints to start from."""
    zero = jnp.zeros_like(pitch)
    in_leg = jnp.stack([jnp.sin(pitch), zero, jnp.cos(pitch)], axis=1)
    up = jnp.einsum("fij,fj->fi", jax.vmap(rot_z)(yaw), in_leg)
    return inverse_legs(robot, position, yaw, up, jnp.zeros(10))


closed_form_jit = jax.jit(closed_form)


def test_the_closed_form_finds_joints_within_their_limits_and_points_at_what_is_out_of_reach():
    rng = np.random.default_rng(1)
    tried = 0
    for joints in rng.uniform(HECTOR.joint_lower, HECTOR.joint_upper, size=(40, 10)):
        feet = poses(HECTOR, jnp.asarray(joints))
        legs = joints.reshape(2, 5)
        yaw, pitch = legs[:, 0], legs[:, 2:].sum(axis=1)
        back = closed_form_jit(HECTOR, feet.position, yaw, pitch)
        # a foot folded up beside its hip roll axis belongs to the other branch
        roll_axis = HECTOR.joint_origin[:, 0, 2] + HECTOR.joint_origin[:, 1, 2]
        below = feet.position[:, 2] < roll_axis - 0.1
        tried += int(below.sum())
        np.testing.assert_allclose(back.reshape(2, 5)[below], legs[below], rtol=0, atol=1e-10)
    assert tried > 60
    far = np.array([[0.3, 0.2, -2.0], [-0.3, -0.2, -2.0]])
    joints = closed_form_jit(HECTOR, far, jnp.zeros(2), jnp.zeros(2))
    np.testing.assert_allclose(np.asarray(joints)[[3, 8]], HECTOR.joint_upper[[3, 8]], atol=1e-12)
    ankle, hip = np.array([0.0, 0.0, 0.04]), HECTOR.joint_origin[:, :3].sum(axis=1)
    wanted, got = far + ankle - hip, poses(HECTOR, joints).position + ankle - hip
    wanted, got = (v[:, 0] / np.linalg.norm(v, axis=1) for v in (wanted, got))
    np.testing.assert_allclose(got, wanted, atol=0.01)
