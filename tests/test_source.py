"""Robots as published, brought to one form: what is kept, what is mended, what is refused."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from published import JOINTS, MOTOR, SHIN, small, urdf_of

from hector_jax.control.controller import walk_config
from hector_jax.control.reference import named_command
from hector_jax.control.weights import expert
from hector_jax.robot.description import MODEL_PATH, Description, Foot, read_description
from hector_jax.robot.model import load_robot, robot_of
from hector_jax.robot.source import build_spec
from hector_jax.sim.loop import Job
from hector_jax.sim.walk import walk
from hector_jax.sim.world import ideal
from hector_jax.tuning.loss import PAPER_LOSS, losses, total

STRIDER = Path(__file__).parents[1] / "examples" / "strider" / "robot.toml"
ARRAYS = (
    "body_mass body_inertia body_pos body_quat body_ipos body_iquat body_parentid jnt_axis jnt_pos "
    "jnt_range dof_damping dof_armature dof_frictionloss geom_size geom_pos geom_quat geom_type "
    "geom_bodyid geom_contype geom_conaffinity geom_condim geom_friction geom_solmix geom_rgba "
    "geom_matid site_pos actuator_ctrlrange actuator_forcerange actuator_gainprm actuator_trnid "
    "key_qpos qpos0 mat_rgba tex_data"
)


def compiled(description):
    return build_spec(description).spec.compile()


def standing(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return data


def contacts_of(description):
    return [name for foot in description.named_feet for name in foot.contacts]


def mass_matrix(model, data):
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    return M


# A file that has the form already


@pytest.mark.parametrize("path", [None, STRIDER])
def test_a_model_that_has_the_form_is_left_bit_for_bit(path):
    description = Description() if path is None else read_description(path)
    source = build_spec(description)
    got, expected = source.spec.compile(), mujoco.MjModel.from_xml_path(str(description.model))
    assert source.notes == ()
    for name in ARRAYS.split():
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), name)


def edited(folder, *changes):
    text = MODEL_PATH.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "robot.xml").write_text(text)
    return Description(model=folder / "robot.xml")


def test_solver_and_height_are_mended_in_place(tmp_path):
    changes = (('cone="pyramidal"', 'cone="elliptic"'), ('qpos="0 0 0.548', 'qpos="0 0 0.648'))
    source = build_spec(edited(tmp_path, *changes))
    got, expected = source.spec.compile(), compiled(Description())
    assert source.notes == (
        "option cone set",
        "keyframe 'standing' lowered by 0.1 m to stand on the floor",
    )
    np.testing.assert_allclose(got.key_qpos, expected.key_qpos, atol=1e-6)
    assert (got.opt.cone, got.ngeom) == (expected.opt.cone, expected.ngeom)


def test_named_feet_stay_when_the_robot_is_written_anew(tmp_path):
    description = edited(tmp_path, ('friction="0.1 ', 'friction="0.9 '))
    source = build_spec(description)
    assert source.notes == ("contact bits, friction and shapes set",)
    got, expected = source.spec.compile(), compiled(Description())
    names = contacts_of(description)
    assert names == ["left_toe", "left_heel", "right_toe", "right_heel"]
    for name in (*names, "trunk", "left_sole"):
        for field in ("pos", "size", "contype", "conaffinity", "condim", "friction"):
            ours, theirs = (getattr(model.geom(name), field) for model in (got, expected))
            np.testing.assert_allclose(ours, theirs, atol=1e-12)
    np.testing.assert_allclose(got.site_pos, expected.site_pos, atol=1e-12)
    np.testing.assert_allclose(got.key_qpos, expected.key_qpos, atol=1e-6)
    ours, theirs = (mass_matrix(model, standing(model)) for model in (got, expected))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


# HECTOR written as a URDF


def by_numbers(folder, text, **changes):
    """HECTOR's description, feet by places and standing by angles, of another file."""
    path = folder / "robot.urdf"
    path.write_text(text)
    angles = {f"{s}_{j}": a for s in ("left", "right") for j, a in BEND.items()}
    feet = tuple(
        Foot((0.0, 0.0, -0.04), ((0.09, 0.0, -0.04), (-0.06, 0.0, -0.04)), f"{side}_foot")
        for side in ("left", "right")
    )
    return Description(
        **{"model": path, "standing": tuple(angles.items()), "feet": feet, **changes}
    )


BEND = {"hip_pitch": 0.785398163397, "knee": -1.570796326795, "ankle": 0.785398163397}


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
    got, expected = standing(model), standing(hector)
    np.testing.assert_allclose(
        mass_matrix(model, got), mass_matrix(hector, expected), atol=1e-9, rtol=0
    )


@pytest.mark.slow
def test_a_urdf_of_hector_walks_like_it(tmp_path):
    text = urdf_of(mujoco.MjModel.from_xml_path(str(MODEL_PATH)))
    armature = (0.008, 0.008, 0.008, 0.016, 0.008)
    own, ideally = load_robot(), ideal()
    urdf = robot_of(by_numbers(tmp_path, text, armature=armature))

    def loss(robot):
        job = Job(expert(), named_command("straight"), ideally)
        return float(total(PAPER_LOSS, losses(PAPER_LOSS, walk(walk_config(own), robot, job))))

    assert loss(urdf) == pytest.approx(loss(own), rel=0.01)


def test_a_urdf_without_effort_names_the_joint(tmp_path):
    hector = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
    text = urdf_of(hector, effort=False)
    assert "'left_hip_yaw' has no torque limit" in refused(by_numbers(tmp_path, text))


def refused(description):
    with pytest.raises(ValueError, match="robot") as caught:
        build_spec(description)
    message = str(caught.value)
    assert "\n" not in message
    return message


# A small biped with what published files have


def test_meshes_that_are_missing_are_not_missed_and_no_file_is_opened(tmp_path):
    source = build_spec(small(tmp_path))
    assert "4 meshes and pictures are not read" in source.notes
    assert source.spec.compile().nmesh == 0


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


def test_a_welded_massless_body_is_allowed_and_a_massless_link_named(tmp_path):
    frame = '<body name="camera"><joint name="pan"/></body>'
    assert compiled(small(tmp_path, arm=frame, weld=("waist", "shoulder", "pan"))).nbody == 10
    message = refused(small(tmp_path, shin=""))
    assert "body 'left_shin' moves and has no mass" in message
    assert "mass is '0'" in refused(small(tmp_path, shin=SHIN.replace('"0.5"', '"0"')))


def test_hinges_of_no_leg_are_listed(tmp_path):
    message = refused(small(tmp_path, weld=()))
    assert "joints waist, shoulder are of no leg: add them to weld or remove them" in message


def test_a_mass_that_only_a_mesh_has_is_refused(tmp_path):
    mesh = '<geom type="mesh" mesh="thigh" density="900"/>'
    message = refused(small(tmp_path, shin=mesh))
    assert "body 'left_shin' has its mass from a mesh" in message
    assert compiled(small(tmp_path, shin=SHIN + mesh)).nbody == 10


def test_solver_motors_and_floor_are_set(tmp_path):
    source = build_spec(small(tmp_path))
    model = source.spec.compile()
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert (model.opt.timestep, model.opt.iterations) == (0.001, 10)
    for note in ("torque motors replace the actuators", "floor added"):
        assert note in source.notes
    assert [model.joint(j).name for j in range(1, 9)] == JOINTS
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], range(1, 9))
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-30.0, 30.0]] * 8)
    np.testing.assert_array_equal(model.actuator_biasprm, 0.0)
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    assert planes.sum() == 1


def test_a_free_joint_is_added(tmp_path):
    assert compiled(small(tmp_path, free="")).nq == 15


def test_motors_that_are_missing_or_without_a_limit_name_the_joint(tmp_path):
    message = refused(small(tmp_path, motors=""))
    assert "joint 'left_roll' has no torque limit" in message
    one = MOTOR.format("left_rol")
    assert "did you mean 'left_roll'" in refused(small(tmp_path, motors=one))


def test_the_limit_of_a_motor_is_the_smallest_that_the_file_states(tmp_path):
    gear = "".join(f'<motor joint="{j}" gear="10" ctrlrange="-2 2"/>' for j in JOINTS)
    model = compiled(small(tmp_path, motors=gear))
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], 20.0)
    knee = 'range="-0.1 2" actuatorfrcrange="-15 15"'
    model = compiled(small(tmp_path, motors=gear, knee=knee))
    np.testing.assert_array_equal(model.actuator_ctrlrange[:, 1], [20, 20, 15, 20] * 2)


def test_a_knee_without_a_range_is_refused(tmp_path):
    assert "joint 'left_knee' has no range" in refused(small(tmp_path, knee=""))


def test_a_coupled_leg_is_refused_and_a_coupled_arm_is_not(tmp_path):
    legs = '<equality><joint joint1="left_knee" joint2="left_ankle"/></equality>'
    assert "couples left_ankle, left_knee" in refused(small(tmp_path, more=legs))
    arms = '<equality><joint joint1="waist" joint2="shoulder"/></equality>'
    assert "<equality> is not used" in build_spec(small(tmp_path, more=arms)).notes


def test_soles_stand_on_the_floor_with_their_spheres_alone(tmp_path):
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
    robot = model.geom_bodyid > 0
    colliding = robot & ((model.geom_contype | model.geom_conaffinity) > 0)
    assert model.geom_friction[colliding, 0].max() <= 0.2
    kinds = {int(model.geom_type[g]) for g in np.flatnonzero(colliding)}
    kinds -= {int(mujoco.mjtGeom.mjGEOM_SPHERE)}
    assert kinds == {int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_CAPSULE)}
    assert sorted({model.geom(n).condim[0] for n in spheres}) == [3]


def test_contacts_are_one_two_or_four_and_level(tmp_path):
    corners = tuple((x, y, -0.04) for x in (0.07, -0.05) for y in (0.03, -0.03))
    flat = small(tmp_path, contacts=corners)
    model, names = build_spec(flat).spec.compile(), contacts_of(flat)
    assert names == [f"{side}_contact_{i}" for side in ("left", "right") for i in range(4)]
    assert {model.geom(name).type[0] for name in names} == {int(mujoco.mjtGeom.mjGEOM_SPHERE)}
    tilted = ((0.07, 0.0, -0.04), (-0.05, 0.0, -0.03))
    with pytest.raises(ValueError, match="soles are not level"):
        robot_of(small(tmp_path, contacts=tilted))
    path = tmp_path / "robot.toml"
    three = "{ body = 'a', contacts = [[0, 0, 0], [1, 0, 0], [0, 1, 0]] }"
    path.write_text(f"model = 'small.xml'\n[feet]\nleft = {three}\nright = {three}\n")
    with pytest.raises(ValueError, match="1, 2 or 4 contacts"):
        read_description(path)


def test_a_keyframe_of_the_file_is_kept_when_joints_are_welded(tmp_path):
    legs = "0 -0.3 0.6 -0.3"
    key = f'<keyframe><key name="up" qpos="0 0 3 1 0 0 0 {legs} 0.4 1 {legs}"/></keyframe>'
    by_key = small(tmp_path, more=key, standing="up")
    got = compiled(by_key)
    by_angles = compiled(small(tmp_path))
    assert [got.key(i).name for i in range(got.nkey)] == ["up"]
    np.testing.assert_array_equal(got.key_qpos, by_angles.key_qpos)
    np.testing.assert_array_equal(got.body_inertia, by_angles.body_inertia)
    assert "has 3 numbers" in refused(
        small(tmp_path, more=key.replace(f" 1 0 0 0 {legs} 0.4 1 {legs}", ""), standing="up")
    )


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('<geom type="box" size="1 1 0.1"/>', "is terrain"),
        ('<geom type="plane" size="1 1 1" pos="0 0 -1"/>', "expected level at z = 0"),
    ],
)
def test_a_world_that_is_no_floor_is_refused(tmp_path, more, words):
    world = f"<worldbody>{more}</worldbody>"
    assert words in refused(small(tmp_path, more=world))


def test_a_wrong_body_of_a_foot_or_order_of_joints_is_refused(tmp_path):
    feet = (Foot(None, ((0.0, 0.0, 0.0),), "left_shin"),) * 2
    assert "feet.left.body is 'left_shin'" in refused(small(tmp_path, feet=feet))
    turned = tuple(JOINTS[i] for i in (1, 0, 2, 3, 4, 5, 6, 7))
    assert "name each leg from the trunk down" in refused(small(tmp_path, joints=turned))
