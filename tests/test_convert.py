"""Robots as published, brought to one form: what is kept, what is fixed, what is refused."""

import re

import mujoco
import numpy as np
import pytest
from model import EXAMPLES
from oracles import mass_matrix
from published import HOLD, JOINTS, LINK, by_numbers, converted, replaced, small, standard, urdf_of

from hector_jax import InputError, load_robot
from hector_jax.robot.description import DESCRIPTION_PATH, MODEL_PATH, read_description
from hector_jax.robot.model import compile_model, describe

STRIDER = EXAMPLES / "strider" / "robot.toml"
HECTOR = mujoco.MjModel.from_xml_path(str(MODEL_PATH))


def compiled(given):
    return mujoco.MjSpec.from_string(standard(given).text).compile()


def standing(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data


def contacts_of(model):
    names = [model.geom(g).name for g in range(model.ngeom)]
    return [name for name in names if "_contact_" in name]


@pytest.mark.parametrize("path", [None, STRIDER])
def test_a_model_that_has_the_form_is_left_bit_for_bit(path):
    description = describe(path)
    expected = mujoco.MjModel.from_xml_path(str(description.model))
    ours, theirs = (np.zeros(mujoco.mj_sizeModel(expected), np.uint8) for _ in range(2))
    mujoco.mj_saveModel(compile_model(description), None, ours)
    mujoco.mj_saveModel(expected, None, theirs)
    assert ours.tobytes() == theirs.tobytes()


NOT_STANDARD = {  # what is told of HECTOR's model with a change
    "option cone is 1, expected 0": ('cone="pyramidal"', 'cone="elliptic"'),
    "geom 'trunk' of body 'trunk' has friction 0.9, expected at most 0.2": (
        'friction="0.1 ',
        'friction="0.9 ',
    ),
    "geom 'trunk' .* has condim 3, expected 1": ('condim="1"', 'condim="3"'),
    "a geom without a name of body 'left_thigh' has conaffinity 7, .* those of 5": (
        '<geom name="left_thigh"',
        '<geom conaffinity="7"',
    ),
    "expected a motor of torque for each": ('forcerange="-67 67"', 'gear="2"'),
    "expected one floor": ('contype="1" conaffinity="0"', 'contype="1" conaffinity="1"'),
    "expected each joint in the origin": (
        'name="left_knee" class',
        'name="left_knee" ref="1" class',
    ),
    "joints are base, wrist, left_hip_yaw, .* expected a free": (
        '<body name="left_hip_yaw"',
        '<body><joint name="wrist"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
        r"\g<0>",
    ),
    "expected a body for each joint and no other": ('<body name="left_hip_yaw"', r"<body/>\g<0>"),
}


@pytest.mark.parametrize("words", NOT_STANDARD)
def test_a_model_without_the_form_names_the_command_that_brings_it_there(tmp_path, words):
    path = tmp_path / "own.toml"
    path.write_text(DESCRIPTION_PATH.read_text())
    model = replaced(MODEL_PATH.read_text(), NOT_STANDARD[words])
    (tmp_path / "hector.xml").write_text(model)
    command = f"converted once, by hector robot {path} --out FOLDER"
    with pytest.raises(InputError, match=f"standard form: {words}.* {re.escape(command)}$"):
        load_robot(path)
    for other in (MODEL_PATH, EXAMPLES / "quadruped" / "quadruped.xml"):
        with pytest.raises(InputError, match=f"hector robot {other} --out FOLDER$"):
            load_robot(other)


def test_solver_height_and_friction_are_mended_and_feet_may_have_names(tmp_path):
    for change in (
        ('cone="pyramidal"', 'cone="elliptic"'),
        ('qpos="0 0 0.548', 'qpos="0 0 0.648'),
        ('friction="0.1 ', 'friction="0.9 '),
    ):
        text = replaced(MODEL_PATH.read_text(), change)
        (tmp_path / "hector.xml").write_text(text)
        (tmp_path / "own.toml").write_text(DESCRIPTION_PATH.read_text())
        out = tmp_path / f"out{change[0][:4]}"
        got = compile_model(read_description(converted(tmp_path / "own.toml", out)))
        expected = HECTOR
        assert len(contacts_of(got)) == 4
        assert all(got.geom(name).friction[0] == 0.1 for name in contacts_of(got))
        assert got.opt.cone == expected.opt.cone
        np.testing.assert_allclose(got.site_pos, expected.site_pos, atol=1e-12)
        np.testing.assert_allclose(got.key_qpos, expected.key_qpos, atol=1e-6)
        ours, theirs = (mass_matrix(model, standing(model)) for model in (got, expected))
        np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_gravity_is_that_of_the_file(tmp_path):
    given = small(tmp_path)
    path, text = given.write(), given.model.read_text()
    assert "gravity" not in standard(given).text  # MuJoCo's own
    for gravity in (3.7, 9.80665):
        given.model.write_text(replaced(text, ("<option", f'<option gravity="0 0 -{gravity}"')))
        robot = load_robot(converted(path, tmp_path / f"on{gravity}"))
        np.testing.assert_array_equal(robot.gravity, [0.0, 0.0, gravity])
        assert dict(dict(robot.description.control)["mpc"])["max_force"] == pytest.approx(
            2.5 * robot.mass * gravity, rel=0.05
        )


@pytest.mark.parametrize("world", [False, True])
def test_a_urdf_is_the_robot_that_its_numbers_are(tmp_path, world):
    hector, given = HECTOR, by_numbers(tmp_path, urdf_of(HECTOR, world))
    model = compiled(given)
    assert "a URDF" in " ".join(standard(given).notes)
    assert (model.nq, model.nu, model.nmesh) == (17, 10, 0)
    np.testing.assert_allclose(model.actuator_ctrlrange, hector.actuator_ctrlrange)
    np.testing.assert_allclose(model.jnt_range, hector.jnt_range)
    np.testing.assert_allclose(model.key_qpos, hector.key_qpos, atol=1e-6)
    model.dof_armature[:] = hector.dof_armature  # of which a URDF knows nothing
    for side in ("left", "right"):
        ours, theirs = model.site(f"{side}_point"), hector.site(f"{side}_foot_point")
        np.testing.assert_allclose(ours.pos, theirs.pos, atol=1e-9)
    ours, theirs = (mass_matrix(one, standing(one)) for one in (model, hector))
    np.testing.assert_allclose(ours, theirs, atol=1e-9, rtol=0)


TURNED = {  # a body, and a joint that is not zero where the file draws it
    "thigh": 'pos="0.01 0 -0.02" euler="0 0.2 0"',
    "knee": 'range="-0.1 2" ref="0.1"',
    "ankle": -0.4,
}


@pytest.mark.parametrize("legs", [{}, TURNED])
def test_welded_and_jointless_bodies_are_part_of_the_trunk_and_the_feet(tmp_path, legs):
    given = small(tmp_path, **legs)
    model = compiled(given)
    names = [model.body(b).name for b in range(1, model.nbody)]
    assert names == ["base"] + [
        f"{s}_{part}" for s in ("left", "right") for part in ("hip", "thigh", "shin", "foot")
    ]
    np.testing.assert_allclose(model.body("base").mass, 7.7, rtol=1e-12)
    np.testing.assert_allclose(model.body("left_foot").mass, 0.21, rtol=1e-12)
    # the file as MuJoCo reads it, its hinges at the same angles
    spec = mujoco.MjSpec.from_string(
        given.model.read_text()
        .replace('<geom class="visual" mesh="thigh"/>', "")
        .replace('<mesh name="thigh" file="thigh.stl"/><mesh name="arm" file="/etc/passwd"/>', "")
    )
    whole = spec.compile()
    data, other = standing(model), mujoco.MjData(whole)
    other.qpos[:7] = data.qpos[:7]
    for name, angle in given.table["standing"].items():
        other.joint(name).qpos[:] = angle
    mujoco.mj_forward(whole, other)
    np.testing.assert_allclose(data.subtree_com[1], other.subtree_com[1], atol=1e-12)
    ours, theirs = mass_matrix(model, data), mass_matrix(whole, other)
    np.testing.assert_allclose(ours[:6, :6], theirs[:6, :6], atol=1e-12)
    dofs = [whole.joint(name).dofadr[0] for name in JOINTS]
    np.testing.assert_allclose(ours[6:, 6:], theirs[np.ix_(dofs, dofs)], atol=1e-12)


def test_solver_motors_and_floor_are_set_and_meshes_and_coupled_arms_are_left_out(tmp_path):
    arms = '<equality><joint joint1="waist" joint2="shoulder"/></equality>'
    frame = '<body name="camera"><joint name="pan"/></body>'  # without a mass, and welded
    weld = ("waist", "shoulder", "pan")
    given = small(tmp_path, free="", more=arms, arm=frame, weld=weld)
    model, notes = compiled(given), standard(given).notes
    told = ("torque motors replace the actuators", "floor added", "<equality> is not used")
    assert {*told, "4 meshes and pictures are not read"} <= set(notes)
    assert (model.nq, model.nbody, model.nmesh) == (15, 10, 0)
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (model.opt.timestep, model.opt.iterations) == (0.001, 10)
    assert [model.joint(j).name for j in range(1, 9)] == JOINTS
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], range(1, 9))
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-30.0, 30.0]] * 8)
    np.testing.assert_array_equal(model.actuator_biasprm, 0.0)
    assert np.sum(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) == 1


def test_the_limit_of_a_motor_is_the_smallest_that_the_file_states(tmp_path):
    gear = "".join(f'<motor joint="{j}" gear="10" ctrlrange="-2 2"/>' for j in JOINTS)
    model = compiled(small(tmp_path, motors=gear))
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], 20.0)
    knee = 'range="-0.1 2" actuatorfrcrange="-15 15"'
    model = compiled(small(tmp_path, motors=gear, knee=knee))
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], [20, 20, 15, 20] * 2)


def test_soles_of_two_or_four_contacts_stand_on_the_floor_with_their_spheres_alone(tmp_path):
    model = compiled(small(tmp_path))
    data, spheres = standing(model), set(contacts_of(model))
    places = np.array([data.geom(name).xpos for name in spheres])
    np.testing.assert_allclose(places[:, 2], 0.01, atol=1e-12)
    for side, y in (("left", 0.1), ("right", -0.1)):
        site = data.site(f"{side}_point").xpos
        np.testing.assert_allclose(site[1:], [y, 0.0], atol=1e-12)
    data.qpos[2] -= 1e-4
    mujoco.mj_forward(model, data)
    touching = {model.geom(g).name for c in data.contact for g in c.geom}
    assert touching == spheres | {"floor"}
    colliding = (model.geom_bodyid > 0) & ((model.geom_contype | model.geom_conaffinity) > 0)
    assert model.geom_friction[colliding, 0].max() <= 0.2
    kinds = {mujoco.mjtGeom(int(kind)).name for kind in model.geom_type[colliding]}
    assert kinds == {"mjGEOM_SPHERE", "mjGEOM_BOX", "mjGEOM_CAPSULE"}
    corners = tuple((x, y, -0.04) for x in (0.07, -0.05) for y in (0.03, -0.03))
    flat = compiled(small(tmp_path, contacts=corners))
    names = [f"{side}_contact_{i}" for side in ("left", "right") for i in range(4)]
    assert contacts_of(flat) == names
    assert all(flat.geom(name).type == mujoco.mjtGeom.mjGEOM_SPHERE for name in names)


def test_a_keyframe_of_the_file_is_kept_when_joints_are_welded(tmp_path):
    legs = "0 -0.3 0.6 -0.3"
    key = f'<keyframe><key name="up" qpos="0 0 3 1 0 0 0 {legs} 0.4 1 {legs}"/></keyframe>'
    got = compiled(small(tmp_path, more=key, standing="up"))
    by_angles = compiled(small(tmp_path))
    assert [got.key(i).name for i in range(got.nkey)] == ["standing"]
    np.testing.assert_array_equal(got.key_qpos, by_angles.key_qpos)
    np.testing.assert_array_equal(got.body_inertia, by_angles.body_inertia)


def test_the_mass_of_a_urdf_is_that_of_all_its_links_and_one_beside_a_robot_is_left_out(tmp_path):
    drawn = '<visual><geometry><box size="0 0 0"/></geometry></visual></link>'
    urdf = urdf_of(HECTOR).replace("</link>", drawn)
    held = LINK.replace("</i", '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></i')
    urdf = urdf.replace("</robot>", f"{held}{HOLD.format('hold', 'trunk', 'payload')}</robot>")
    masses = [float(x) for x in re.findall('<mass value="([^"]*)"', urdf)]
    model = compiled(by_numbers(tmp_path, urdf))
    assert model.body_mass.sum() == pytest.approx(sum(masses), rel=1e-12)
    lamp = '<body name="lamp"><geom size="1" mass="9" contype="0" conaffinity="0"/></body>'
    given = small(tmp_path, more=f"<worldbody>{lamp}</worldbody>")
    assert "left out, which no joint holds: lamp" in standard(given).notes
    mass = compiled(given).body_mass.sum()
    assert mass == pytest.approx(compiled(small(tmp_path)).body_mass.sum())


def test_names_are_the_files_own_and_what_has_none_gets_one(tmp_path):
    given = small(tmp_path)
    expected, path = compiled(given), given.model
    changes = [
        ('<geom type="box" size="0.05', '<geom name="floor" type="box" size="0.05'),
        ('<body name="[a-z]+_(hip|thigh|shin)"', "<body"),
        ('name="waist" ', ""),
        ("left_knee", "base"),
        ("right_ankle", "floor"),
        ('name="torso"', 'name="floor"'),
    ]
    path.write_text(replaced(path.read_text(), *changes))
    names = {"left_knee": "base", "right_ankle": "floor", "waist": "joint_5"}
    renamed = lambda words: [names.get(x, x) for x in words]  # noqa: E731
    joints = {key: renamed(words) for key, words in given.table["joints"].items()}
    stands = {names.get(x, x): angle for x, angle in given.table["standing"].items()}
    got = compiled(given._replace(table=given.table | {"joints": joints, "standing": stands}))
    for name in ("body_mass", "body_inertia", "jnt_range", "key_qpos", "geom_size"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert len({got.body(b).name for b in range(got.nbody)}) == got.nbody
