"""What `hector robot` says of files that CAD programs and other laboratories write."""

import re
import sys
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
from published import JOINTS, MOTOR, small

from hector_jax.cli.arguments import data_folder
from hector_jax.cli.main import main
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import as_toml
from hector_jax.core.tree_file import save_tree
from hector_jax.importing.propose import propose_robot
from hector_jax.importing.remarks import remarks
from hector_jax.importing.survey import survey_file
from hector_jax.importing.table import table_of
from hector_jax.robot.description import read_description
from hector_jax.robot.model import compile_model, load_robot
from hector_jax.robot.source import build_spec

HUMANOID = Path(__file__).parents[1] / "examples" / "humanoid" / "humanoid.xml"


def edited(folder, *changes, **parts):
    """The small biped with some of its text replaced, each change as often as it is there."""
    path = small(folder, **parts).model
    text = path.read_text()
    for old, new in changes:
        assert re.search(old, text), old
        text = re.sub(old, new, text)
    path.write_text(text)
    return path


def told(path):
    """The remarks on a proposed robot, which can be used."""
    proposal = propose_robot(path)
    assert proposal.error is None
    return remarks(proposal.robot)


def command(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["hector", "robot", *map(str, words)])
    return main()


# Nothing grows, nothing vanishes


def shapes(model, body):
    geoms = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name == body]
    return [(model.geom_type[g], model.geom_size[g]) for g in geoms]


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ('type="cylinder" size="0.06 0.02"', [0.06 / 2**0.5, 0.06 / 2**0.5, 0.02]),
        ('type="ellipsoid" size="0.06 0.05 0.02"', np.array([0.06, 0.05, 0.02]) / 3**0.5),
    ],
)
def test_a_disc_becomes_the_largest_box_in_it(tmp_path, shape, size):
    path = edited(tmp_path, ('type="cylinder" size="0.03 0.08"', shape))
    model = build_spec(propose_robot(path).robot.description).spec.compile()
    (box,) = [x for kind, x in shapes(model, "left_thigh") if kind == mujoco.mjtGeom.mjGEOM_BOX]
    np.testing.assert_allclose(box, size)


def test_excluded_pairs_do_not_touch(tmp_path):
    pair = '<contact><exclude body1="left_thigh" body2="right_thigh"/></contact>'
    wide = ('type="cylinder" size="0.03 0.08"', 'type="capsule" size="0.11 0.02"')
    proposal = propose_robot(edited(tmp_path, wide, more=pair))
    model = build_spec(proposal.robot.description).spec.compile()
    assert model.nexclude == 1
    assert not [line for line in remarks(proposal.robot) if "overlap" in line]
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    bodies = {model.body(model.geom_bodyid[g]).name for c in data.contact for g in c.geom}
    assert "left_thigh" not in bodies


def test_shapes_that_overlap_and_do_not_in_the_file_are_named(tmp_path):
    # thighs that touch nothing but other things in the file
    wide = ('type="cylinder" size="0.03 0.08"', 'type="capsule" size="0.11 0.02" conaffinity="0"')
    (line,) = [x for x in told(edited(tmp_path, wide)) if "overlap" in x]
    assert line.startswith("bodies left_thigh and right_thigh overlap when standing, and not in")
    both = ('type="cylinder" size="0.03 0.08"', 'type="capsule" size="0.11 0.02"')
    assert not [x for x in told(edited(tmp_path, both)) if "overlap" in x]


def test_what_pushes_bodies_is_refused_and_named(tmp_path):
    lifted = ('<body name="torso"', '<body name="torso" gravcomp="1"')
    with pytest.raises(InputError, match=r"'torso' push bodies \(gravcomp"):
        survey_file(edited(tmp_path, lifted))
    jet = "<general name='jet' body='torso'/>"
    with pytest.raises(InputError, match=r"'jet' push bodies .*expected motors of joints alone"):
        survey_file(edited(tmp_path, motors=jet))


def test_a_slide_in_a_leg_is_named(tmp_path):
    slide = (r'name="(\w+)_knee" axis="0 1 0"', r'name="\1_knee" type="slide" axis="0 0 1"')
    with pytest.raises(InputError, match="no hinges: left_knee, right_knee"):
        survey_file(edited(tmp_path, slide))


@pytest.mark.parametrize("mass", [1e-7, 0.3])
@pytest.mark.parametrize("inertia", ["1e-15 -1e-15 1e-15 0 0 0", "1 1e-9 1e-9 0 0 0"])
def test_a_fixed_frame_whose_inertia_no_body_has_is_a_point_mass(tmp_path, mass, inertia):
    frame = f'<body name="imu" pos="0.1 0 0"><inertial pos="0 0 0" mass="{mass}" '
    frame += f'fullinertia="{inertia}"/></body>'
    own, robot = (propose_robot(edited(tmp_path, arm=arm)).robot for arm in ("", frame))
    assert robot.mass == pytest.approx(float(own.mass) + mass * (mass > 1e-6), rel=1e-12)
    np.testing.assert_allclose(robot.inertia, own.inertia, atol=1e-9 if mass < 1e-6 else 0.1)


def test_a_link_that_moves_needs_an_inertia(tmp_path):
    path = edited(tmp_path, ("0.004 0.004 0.001", "0 0.004 0.001"))
    with pytest.raises(InputError, match="body 'left_shin' has moments of inertia from 0"):
        survey_file(path)


def test_the_compiler_of_a_urdf_counts(tmp_path):
    path = edited(tmp_path, ('diaginertia="0.004 0.004 0.001"', 'diaginertia="0.04 0.004 0.001"'))
    hint = r'write <compiler balanceinertia="true"/> into <mujoco>, in a URDF too'
    with pytest.raises(InputError, match=hint):
        survey_file(path)
    inertia = '<inertia ixx="{}" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(
        f'<link name="{name}"><inertial><mass value="1"/>{inertia.format(xx)}</inertial></link>'
        for name, xx in (("base", 1), ("arm", 9))
    )
    joint = '<joint name="a" type="revolute"><parent link="base"/><child link="arm"/>'
    joint += '<axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    compiler = '<mujoco><compiler balanceinertia="true"/><option timestep="9"/></mujoco>'
    for extra, words in (("", "balanceinertia"), (compiler, "no two legs found")):
        path = tmp_path / "arm.urdf"
        path.write_text(f'<robot name="arm">{extra}{links}{joint}</robot>')
        with pytest.raises(InputError, match=words):
            survey_file(path)


# Legs as mirror images


def test_a_hinge_is_a_line(tmp_path):
    """Knee, ankle and hip of the right leg are moved along their own axes."""
    own = propose_robot(edited(tmp_path))
    moved = [
        (r'(name="right_knee" axis="0 1 0")', r'\1 pos="0 0.08 0"'),
        (
            r'(name="right_ankle" axis="0 1 0" range="-1 1") pos="0 0 0.01"',
            r'\1 pos="0 -0.05 0.01"',
        ),
        (r'(name="right_roll" axis="1 0 0")', r'\1 pos="0.06 0 0"'),
    ]
    proposal = propose_robot(edited(tmp_path, *moved))
    assert proposal.error is None
    assert proposal.table["standing"] == own.table["standing"]
    assert proposal.robot.standing_height == pytest.approx(own.robot.standing_height, abs=1e-9)
    assert not [line for line in remarks(proposal.robot) if "mirror" in line]


def test_the_nearest_pair_of_joints_is_told_where_no_legs_are_found(tmp_path):
    path = edited(tmp_path, (r'<body name="right_shin" pos="0 0 -0.2">', '<body pos="0.1 0 -0.2">'))
    text = r"no two legs found, .*; the lines of left_knee and right_knee are 10.0 cm from mirrored"
    with pytest.raises(InputError, match=text):
        survey_file(path)


def test_a_robot_that_looks_along_y_is_told_how_to_turn(tmp_path):
    changes = [
        (r'<body name="(\w+)_hip" pos="0 (-?0.1) -0.1">', r'<body name="\1_hip" pos="\2 0 -0.1">'),
        (r'pos="0.01 0 -0.02"', 'pos="0 0.01 -0.02"'),
        ('axis="1 0 0"', 'axis="0 -1 0"'),
        (r'(name="\w+_(pitch|knee|ankle)") axis="0 1 0"', r'\1 axis="1 0 0"'),
    ]
    with pytest.raises(InputError, match="looks along y, expected along x: put its trunk into"):
        survey_file(edited(tmp_path, *changes))


KNEE = 'right_knee" axis="0 1 0" range="-0.1 '
MOTOR_OF = 'joint="right_ankle" kp="100" forcerange="-{0} {0}"'
FOOT = '<body name="right_foot" pos="0 0 -0.2'
UNLIKE = {  # changes, joint, what is told
    "range": (f'{KNEE}2"', f'{KNEE}1.5"', "knee", r"range \[rad\] -0.1, 2 and -0.1, 1.5$"),
    "axis": (
        'right_pitch" axis="0 1 0"',
        'right_pitch" axis="0 1 0.3"',
        "pitch",
        "axis 0, 1, 0 and",
    ),
    "motor": (MOTOR_OF.format(30), MOTOR_OF.format(20), "ankle", r"motor \[N m\] 30 and 20$"),
    "mass": (r'(?s)(right_shin.*?mass=)"0.5"', r'\1"0.7"', "knee", r"link \[kg\] 0.5 and 0.7$"),
    "length": (f'{FOOT}">', f'{FOOT}2">', "ankle", r"place \[m\] 0, 0, -0.19 and 0, 0, -0.21"),
}


@pytest.mark.parametrize("kind", UNLIKE)
def test_legs_that_are_no_mirror_images_are_told_joint_by_joint(tmp_path, kind):
    old, new, joint, text = UNLIKE[kind]
    proposal = propose_robot(edited(tmp_path, (old, new)))
    lines = [x for x in remarks(proposal.robot) if "mirror" in x]
    expected = f"left_{joint} and right_{joint} are no mirror images: {text}"
    assert any(re.match(expected, line) for line in lines), lines
    if kind == "motor":
        assert re.search(
            r"left_ankle, right_ankle .* 30 / 20 ", "\n".join(table_of(proposal.robot))
        )


def test_opposite_axes_of_mirrored_joints_are_alike(tmp_path):
    """A joint that turns the other way has the other range."""
    knee = 'right_knee" axis="0 1 0" range="-0.1 2"', 'right_knee" axis="0 -1 0" range="-2 0.1"'
    roll = 'left_roll" axis="1 0 0" range="-0.5 0.5"', 'left_roll" axis="1 0 0" range="-0.2 0.5"'
    other = 'right_roll" axis="1 0 0" range="-0.5 0.5"', 'right_roll" axis="1 0 0" range="-0.5 0.2"'
    assert not [x for x in told(edited(tmp_path, knee, roll, other)) if "mirror" in x]


# Numbers that no robot has


def test_knees_bend_from_the_straight_leg(tmp_path):
    plain = r'(name="\w+_ankle" axis="0 1 0") range="-1 1" pos="0 0 0.01"', r'\1 range="-1.9 1.9"'
    own = propose_robot(edited(tmp_path, plain))
    crouch = [
        plain,
        (r'(<body name="\w+_shin" pos="0 0 -0.2")>', r'\1 euler="0 0.9 0">'),
        (r'(<body name="\w+_foot" pos="0 0 -0.2")>', r'\1 euler="0 -0.9 0">'),
        ('range="-0.1 2"', 'range="-1 1.1"'),
    ]
    proposal = propose_robot(edited(tmp_path, *crouch))
    assert proposal.survey.forwards == own.survey.forwards == (True,)
    assert proposal.table["standing"]["left_knee"] == pytest.approx(0.1, abs=1e-3)
    assert proposal.robot.standing_height == pytest.approx(own.robot.standing_height, abs=1e-3)


def test_units_and_placeholders_are_told(tmp_path):
    assert not [x for x in told(edited(tmp_path)) if "unit" in x or "placeholder" in x]
    narrow = (r'(name="\w+_roll" axis="1 0 0") range="-0.5 0.5"', r'\1 range="-0.01 0.01"')
    (line,) = [x for x in told(edited(tmp_path, narrow)) if "unit" in x]
    assert "left_roll -0.01 to +0.01, right_roll" in line
    wide = (r'(name="\w+_pitch" axis="0 1 0") range="-1 1"', r'\1 range="-1 9"')
    (line,) = [x for x in told(edited(tmp_path, wide)) if "unit" in x]
    assert "left_pitch -1.00 to +9.00" in line
    strong = ('forcerange="-30 30"', 'forcerange="-3000 3000"')
    (line,) = [x for x in told(edited(tmp_path, strong)) if "placeholder" in x]
    assert "left_knee 3000" in line
    heavy = ('mass="4" diag', 'mass="4000" diag'), ('mass="3" diag', 'mass="3000" diag')
    proposal = propose_robot(edited(tmp_path, *heavy))
    assert any("write kg and m" in x for x in remarks(proposal.robot))


def refused(path):
    proposal = propose_robot(path)
    assert proposal.error in proposal.wrong
    return proposal.error


def test_all_joints_that_lack_something_are_told_at_once(tmp_path):
    error = refused(edited(tmp_path, (' range="[^"]*"', "")))
    assert "joint 'left_roll' has no range, nor have left_pitch, left_knee, " in error
    error = refused(edited(tmp_path, motors=MOTOR.format("left_roll")))
    assert "joint 'left_pitch' has no torque limit, nor have left_knee, left_ankle, right" in error
    assert "named in joints.weld" in error


@pytest.mark.parametrize("span", ["", 'range="-1000 1000"'])
def test_a_wheel_is_no_foot(tmp_path, span):
    path = edited(tmp_path, (r'(name="\w+_ankle" axis="0 1 0") range="-1 1"', rf"\1 {span}"))
    assert "joints left_ankle, right_ankle turn without end, as wheels do" in refused(path)


def test_nothing_but_soles_stands_on_the_floor(tmp_path):
    path = edited(tmp_path, ('<geom type="box" size="0.05 0.08 0.1"/>', (
        '<geom type="box" size="0.05 0.08 0.1" pos="0 0 -0.45"/>'
    )))  # fmt: skip
    assert re.search(r"has body 'base' 0\.\d+ m below the floor, expected nothing", refused(path))


# A proposal is never nothing


SHANK = '<inertial pos="0.002 0 -0.12" mass="0.3" diaginertia="0.002 0.002 0.0002"/>'


def stilts(folder, places=((0.0, 0.1), (0.0, -0.1)), foot=""):
    """Legs of roll, pitch and knee with round feet, or without any."""
    link = '<inertial pos="0 0 {z}" mass="{m}" diaginertia="0.003 0.003 0.001"/>'
    legs = "".join(
        f'<body name="{i}_hip" pos="{x} {y} -0.05">{link.format(z=0, m=0.4)}'
        f'<joint name="{i}_roll" axis="1 0 0" range="-0.6 0.6"/>'
        f'<body name="{i}_thigh">{link.format(z=-0.1, m=0.8)}'
        f'<joint name="{i}_pitch" axis="0 1 0" range="-1.5 1.5"/>'
        f'<body name="{i}_shank" pos="0 0 -0.25">{SHANK}'
        f'<joint name="{i}_knee" axis="0 1 0" range="-0.1 2.2"/>{foot}</body></body></body>'
        for i, (x, y) in enumerate(places)
    )
    joints = [f"{i}_{joint}" for i in range(len(places)) for joint in ("roll", "pitch", "knee")]
    motors = "".join(f'<motor joint="{joint}" ctrlrange="-40 40"/>' for joint in joints)
    path = folder / "stilts.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="box">'
        '<freejoint/><inertial pos="0 0 0.05" mass="8" diaginertia="0.1 0.1 0.1"/>'
        f"{legs}</body></worldbody><actuator>{motors}</actuator></mujoco>"
    )
    return path


BALL = '<geom type="sphere" size="0.02" pos="0 0 -0.25"/>'
FOUR = tuple((x, y) for x in (0.2, -0.2) for y in (0.1, -0.1))


@pytest.mark.parametrize("places", [FOUR[:2], FOUR])
@pytest.mark.parametrize("foot", ["", BALL])
def test_legs_of_three_joints_stand_on_points(tmp_path, places, foot):
    proposal = propose_robot(stilts(tmp_path, places, foot))
    assert proposal.error is None
    assert [len(sole.contacts) for sole in proposal.soles] == [1] * len(places)
    assert bool(proposal.wrong) == (not foot)
    if not foot:
        half = np.sqrt(1.5 * (0.0042 - 0.0004) / 0.3)  # of the box with the shank's inertia
        length = np.linalg.norm(proposal.soles[0].contacts[0])
        assert length == pytest.approx(0.12 + half, abs=1e-3)


def test_a_draft_has_what_was_found_and_what_is_to_be_mended(monkeypatch, capsys, tmp_path):
    path, out = edited(tmp_path, (' range="[^"]*"', "")), tmp_path / "draft.toml"
    assert command(monkeypatch, path, "--out", out) == 2
    text = out.read_text()
    assert re.search(r"(?m)^# To be mended: .*'left_roll' has no range", text)
    draft = tomllib.loads(text)
    assert draft["joints"]["left"] == JOINTS[:4]
    assert draft["feet"]["left"]["body"] == "left_foot"
    assert "has no range" in capsys.readouterr().err
    unlike = ('(?s)(right_foot.*?)size="0.06 0.03 0.01"', r'\1size="0.09 0.03 0.01"')
    proposal = propose_robot(edited(tmp_path, unlike))
    assert "expected the same" in proposal.wrong[0]
    assert proposal.table["joints"]["left"] == JOINTS[:4]
    (tmp_path / "none.xml").write_text("<mujoco><worldbody/></mujoco>")
    assert command(monkeypatch, tmp_path / "none.xml") == 2
    assert "# To be mended: " in (printed := capsys.readouterr().out)
    assert tomllib.loads(printed[printed.index("# Proposed") :])["model"] == "none.xml"


def test_what_a_hand_written_file_leaves_out_is_filled_in_by_the_rules(
    monkeypatch, capsys, tmp_path
):
    model = edited(tmp_path)
    full = propose_robot(model).table
    path, out = tmp_path / "own.toml", tmp_path / "full.toml"
    path.write_text('model = "robot.xml"\n[gait]\nstance = 24\n[weights.nominal]\neuler = 7\n')
    proposal = propose_robot(path)
    assert proposal.error is None
    expected = {**full, "name": "own", "gait": full["gait"] | {"stance": 24}}
    weights = full["weights"]["nominal"] | {"euler": 7}
    expected["weights"] = full["weights"] | {"nominal": weights}
    assert proposal.table == expected
    assert {"joints", "gait.swing", "weights.nominal.force"} <= set(proposal.filled)
    assert not {"gait", "gait.stance", "model"} & set(proposal.filled)
    assert command(monkeypatch, path) == 0
    assert "left out " in capsys.readouterr().out
    assert command(monkeypatch, path, "--out", out) == 0
    assert load_robot(out).mass == pytest.approx(float(proposal.robot.mass), rel=1e-6)
    assert not propose_robot(out).filled


def test_legs_that_a_file_names_are_taken(tmp_path):
    """Without their ankles the legs have another number of joints, which no rule finds."""
    model = edited(tmp_path)
    joints = {
        side: [f"{side}_{x}" for x in ("roll", "pitch", "knee")] for side in ("left", "right")
    }
    text = "\n".join(f"{side} = {names}" for side, names in joints.items())
    path = tmp_path / "own.toml"
    path.write_text(f'model = "{model.name}"\n[joints]\n{text}\n')
    proposal = propose_robot(path)
    assert proposal.table["joints"]["left"] == joints["left"]
    assert "left_ankle" in proposal.table["joints"]["weld"]


LEG = '["left_roll", "left_pitch", "left_knee"]'


@pytest.mark.parametrize(
    ("joints", "error"),
    [
        ("left = 3", "left must be a list, each text, got 3"),
        (f'left = {LEG}\nright = ["right_roll"]', "must be 3 to 7 names each and as many in both"),
    ],
)
def test_legs_that_a_file_names_are_checked_before_they_are_taken(tmp_path, joints, error):
    path = tmp_path / "own.toml"
    path.write_text(f'model = "{edited(tmp_path).name}"\n[joints]\n{joints}\n')
    assert re.match(f"{path}: joints: .*{error}", refused(path))


@pytest.mark.parametrize("kind", ["line", "point", "flat"])
def test_the_standard_form_is_read_as_it_is_and_is_the_same_robot(monkeypatch, tmp_path, kind):
    model, out = edited(tmp_path), tmp_path / "new.toml"
    if kind == "point":
        model = stilts(tmp_path, FOUR, BALL)
    elif kind == "flat":
        model = HUMANOID
    assert command(monkeypatch, model, "--out", out) == 0
    description = read_description(out)
    assert build_spec(description).notes == ()
    assert description.standing == description.standing_key
    assert description.weld == description.armature == ()
    proposal = propose_robot(model)
    own, robot = proposal.robot, load_robot(out)
    again = propose_robot(tmp_path / "new-standard.xml").table
    for section, key in (("mpc", "inertia_share"), ("legs", "kp"), ("legs", "kd")):
        np.testing.assert_allclose(again[section][key], proposal.table[section][key], rtol=0.02)
    assert robot.structure == own.structure
    assert robot.structure.contact == kind
    for name in own._fields[:-2]:
        np.testing.assert_allclose(getattr(robot, name), getattr(own, name), atol=2e-5, rtol=1e-4)
    names = (
        "geom_contype geom_conaffinity geom_type dof_armature dof_frictionloss exclude_signature"
    )
    for name in names.split():
        arrays = (getattr(compile_model(x.description), name) for x in (robot, own))
        np.testing.assert_allclose(*arrays, rtol=1e-5)


def test_robots_whose_files_have_one_name_do_not_share_data(tmp_path):
    data, paths = tmp_path / "data", [tmp_path / x / "robot.toml" for x in ("a", "b")]
    robots = []
    for path, mass in zip(paths, ("4", "5"), strict=True):
        path.parent.mkdir()
        model = edited(path.parent, ('mass="4" diag', f'mass="{mass}" diag'))
        path.write_text(as_toml(propose_robot(model).table, []))
        robots.append(load_robot(path))
    assert [robot.description.name for robot in robots] == ["robot", "robot"]
    first, second = (data_folder(data, *pair) for pair in zip(paths, robots, strict=True))
    assert first == second == data / "robot"
    save_tree(first / "walks" / "0.npz", {"x": np.zeros(1)}, kind="walks", robot=robots[0])
    first, second = (data_folder(data, *pair) for pair in zip(paths, robots, strict=True))
    assert first == data / "robot"
    assert re.fullmatch(r"robot-[0-9a-f]{6}", second.name)
    (first / "walks" / "0.npz").write_bytes(b"damaged")
    assert data_folder(data, paths[0], robots[0]) == first
    assert data_folder(data, None, robots[0]) == data


def test_a_file_for_another_robot_names_the_command(tmp_path):
    with pytest.raises(InputError, match=r"no joint 'left_hip_yaw'.*: hector robot .*robot.xml"):
        load_robot(edited(tmp_path))
