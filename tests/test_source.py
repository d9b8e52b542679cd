"""Robots as published, brought to one form: what is kept, what is fixed, what is refused."""

import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from model import EXAMPLES
from oracles import mass_matrix
from published import HOLD, JOINTS, LINK, by_numbers, replaced, small, urdf_of

from hector_jax.robot.description import MODEL_PATH, Description, read_description
from hector_jax.robot.source import build_spec

STRIDER = EXAMPLES / "strider" / "robot.toml"


def compiled(description):
    return build_spec(description).spec.compile()


def standing(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data


def contacts_of(description):
    return [name for foot in description.named_feet for name in foot.contacts]


@pytest.mark.parametrize("path", [None, STRIDER])
def test_a_model_that_has_the_form_is_left_bit_for_bit(path):
    description = Description() if path is None else read_description(path)
    source = build_spec(description)
    expected = mujoco.MjModel.from_xml_path(str(description.model))
    assert source.notes == ()
    ours, theirs = (np.zeros(mujoco.mj_sizeModel(expected), np.uint8) for _ in range(2))
    mujoco.mj_saveModel(source.spec.compile(), None, ours)
    mujoco.mj_saveModel(expected, None, theirs)
    assert ours.tobytes() == theirs.tobytes()


def edited(folder, *changes):
    (folder / "robot.xml").write_text(replaced(MODEL_PATH.read_text(), *changes))
    return Description(model=folder / "robot.xml")


def test_solver_height_and_friction_are_mended_and_named_feet_stay(tmp_path):
    expected = compiled(Description())
    solver, height = ('cone="pyramidal"', 'cone="elliptic"'), ('qpos="0 0 0.548', 'qpos="0 0 0.648')
    for changes, notes in (
        ((solver, height), ["option cone set", "keyframe 'standing' lowered by 0.1 m to stand on"]),
        ((('friction="0.1 ', 'friction="0.9 '),), ["contact bits, friction and shapes set"]),
    ):
        description = edited(tmp_path, *changes)
        source = build_spec(description)
        got, names = source.spec.compile(), contacts_of(description)
        for told, note in zip(source.notes, notes, strict=True):
            assert told.startswith(note)
        assert names == ["left_toe", "left_heel", "right_toe", "right_heel"]
        assert all(got.geom(name).friction[0] == 0.1 for name in names)
        assert got.opt.cone == expected.opt.cone
        np.testing.assert_allclose(got.site_pos, expected.site_pos, atol=1e-12)
        np.testing.assert_allclose(got.key_qpos, expected.key_qpos, atol=1e-6)
        ours, theirs = (mass_matrix(model, standing(model)) for model in (got, expected))
        np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.parametrize("world", [False, True])
def test_a_urdf_is_the_robot_that_its_numbers_are(tmp_path, world):
    hector = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    source = build_spec(by_numbers(tmp_path, urdf_of(hector, world)))
    model = source.spec.compile()
    assert "a URDF" in " ".join(source.notes)
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
    description = small(tmp_path, **legs)
    model = compiled(description)
    names = [model.body(b).name for b in range(1, model.nbody)]
    assert names == ["base"] + [
        f"{s}_{part}" for s in ("left", "right") for part in ("hip", "thigh", "shin", "foot")
    ]
    np.testing.assert_allclose(model.body("base").mass, 7.7, rtol=1e-12)
    np.testing.assert_allclose(model.body("left_foot").mass, 0.21, rtol=1e-12)
    # the file as MuJoCo reads it, its hinges at the same angles
    spec = mujoco.MjSpec.from_string(
        description.model.read_text()
        .replace('<geom class="visual" mesh="thigh"/>', "")
        .replace('<mesh name="thigh" file="thigh.stl"/><mesh name="arm" file="/etc/passwd"/>', "")
    )
    whole = spec.compile()
    data, other = standing(model), mujoco.MjData(whole)
    other.qpos[:7] = data.qpos[:7]
    for name, angle in description.standing:
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
    source = build_spec(small(tmp_path, free="", more=arms, arm=frame, weld=weld))
    model = source.spec.compile()
    told = ("torque motors replace the actuators", "floor added", "<equality> is not used")
    assert {*told, "4 meshes and pictures are not read"} <= set(source.notes)
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
    description = small(tmp_path)
    model = build_spec(description).spec.compile()
    data, spheres = standing(model), set(contacts_of(description))
    places = np.array([data.geom(name).xpos for name in spheres])
    np.testing.assert_allclose(places[:, 2], 0.01, atol=1e-12)
    for side, foot in enumerate(description.named_feet):
        site, y = data.site(foot.point).xpos, (0.1, -0.1)[side]
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
    flat = small(tmp_path, contacts=corners)
    names = [f"{side}_contact_{i}" for side in ("left", "right") for i in range(4)]
    assert contacts_of(flat) == names
    assert all(compiled(flat).geom(name).type == mujoco.mjtGeom.mjGEOM_SPHERE for name in names)


def test_a_keyframe_of_the_file_is_kept_when_joints_are_welded(tmp_path):
    legs = "0 -0.3 0.6 -0.3"
    key = f'<keyframe><key name="up" qpos="0 0 3 1 0 0 0 {legs} 0.4 1 {legs}"/></keyframe>'
    got = compiled(small(tmp_path, more=key, standing="up"))
    by_angles = compiled(small(tmp_path))
    assert [got.key(i).name for i in range(got.nkey)] == ["up"]
    np.testing.assert_array_equal(got.key_qpos, by_angles.key_qpos)
    np.testing.assert_array_equal(got.body_inertia, by_angles.body_inertia)


def test_the_mass_of_a_urdf_is_that_of_all_its_links_and_one_beside_a_robot_is_left_out(tmp_path):
    drawn = '<visual><geometry><box size="0 0 0"/></geometry></visual></link>'
    urdf = urdf_of(mujoco.MjModel.from_xml_path(str(MODEL_PATH))).replace("</link>", drawn)
    held = LINK.replace("</i", '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></i')
    urdf = urdf.replace("</robot>", f"{held}{HOLD.format('hold', 'trunk', 'payload')}</robot>")
    masses = [float(x) for x in re.findall('<mass value="([^"]*)"', urdf)]
    model = compiled(by_numbers(tmp_path, urdf))
    assert model.body_mass.sum() == pytest.approx(sum(masses), rel=1e-12)
    lamp = '<body name="lamp"><geom size="1" mass="9" contype="0" conaffinity="0"/></body>'
    source = build_spec(small(tmp_path, more=f"<worldbody>{lamp}</worldbody>"))
    assert "left out, which no joint holds: lamp" in source.notes
    without = compiled(small(tmp_path)).body_mass.sum()
    assert source.spec.compile().body_mass.sum() == pytest.approx(without)


def test_names_are_the_files_own_and_what_has_none_gets_one(tmp_path):
    description = small(tmp_path)
    expected, path = compiled(description), description.model
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
    joints = tuple(names.get(x, x) for x in description.joints)
    stands = tuple((names.get(x, x), angle) for x, angle in description.standing)
    weld = ("joint_5", "shoulder")
    got = compiled(replace(description, joints=joints, weld=weld, standing=stands))
    for name in ("body_mass", "body_inertia", "jnt_range", "key_qpos", "geom_size"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))
    assert len({got.body(b).name for b in range(got.nbody)}) == got.nbody
