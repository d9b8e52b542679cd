"""What `hector robot` finds, says and proposes of files that others write."""

import re
import tomllib
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from model import EXAMPLES
from pretend import call
from published import JOINTS, SIDES, converted, proposed, replaced, small, write_box

from hector_jax import InputError, walk_config
from hector_jax.importing.elements import read_file
from hector_jax.importing.propose import HEIGHT, MASS
from hector_jax.importing.remarks import remarks
from hector_jax.importing.soles import find_soles
from hector_jax.importing.survey import survey_file
from hector_jax.importing.table import table_of
from hector_jax.robot.description import MODEL_PATH, read_description
from hector_jax.robot.model import compile_model, load_robot
from hector_jax.robot.poses import standing_data
from hector_jax.robot.response import response, swing_frequency
from hector_jax.tuning.loss import loss_of_robot

HUMANOID, QUADRUPED = (EXAMPLES / x / f"{x}.xml" for x in ("humanoid", "quadruped"))


def edited(folder, *changes, **parts):
    path = small(folder, **parts).model
    path.write_text(replaced(path.read_text(), *changes))
    return path


def told(path):
    """The remarks on a proposed robot, which can be used."""
    proposal = proposed(path)
    assert proposal.error is None
    return remarks(proposal.robot, proposal.standard)


THIGH = 'type="cylinder" size="0.03 0.08"'


def test_a_disc_becomes_the_largest_box_in_it(tmp_path):
    for shape, size in (
        ('type="cylinder" size="0.06 0.02"', [0.06 / 2**0.5, 0.06 / 2**0.5, 0.02]),
        ('type="ellipsoid" size="0.06 0.05 0.02"', np.array([0.06, 0.05, 0.02]) / 3**0.5),
    ):
        robot = proposed(edited(tmp_path, (THIGH, shape))).robot
        model = compile_model(robot.description)
        of_thigh = model.geom_bodyid == model.body("left_thigh").id
        (box,) = model.geom_size[of_thigh & (model.geom_type == mujoco.mjtGeom.mjGEOM_BOX)]
        np.testing.assert_allclose(box, size)


def test_shapes_that_overlap_and_do_not_in_the_file_are_named_unless_excluded(tmp_path):
    wide = 'type="capsule" size="0.11 0.02"'
    alone = f'{wide} conaffinity="0"'  # thighs that touch nothing but other things in the file
    excluded = '<contact><exclude body1="left_thigh" body2="right_thigh"/></contact>'
    for shape, more, count in ((wide, "", 0), (alone, "", 1), (wide, excluded, 0)):
        lines = [x for x in told(edited(tmp_path, (THIGH, shape), more=more)) if "overlap" in x]
        assert len(lines) == count
        assert all("left_thigh and right_thigh overlap when standing, and" in x for x in lines)


@pytest.mark.parametrize(
    ("mass", "inertia"), [(1e-7, "1e-15 -1e-15 1e-15 0 0 0"), (0.3, "1 1e-9 1e-9 0 0 0")]
)
def test_a_fixed_frame_whose_inertia_no_body_has_is_a_point_mass(tmp_path, mass, inertia):
    frame = f'<body name="imu" pos="0.1 0 0"><inertial pos="0 0 0" mass="{mass}" '
    frame += f'fullinertia="{inertia}"/></body>'
    own, robot = (proposed(edited(tmp_path, arm=arm)).robot for arm in ("", frame))
    assert robot.mass == pytest.approx(float(own.mass) + mass * (mass > 1e-6), rel=1e-12)
    np.testing.assert_allclose(robot.inertia, own.inertia, atol=1e-9 if mass < 1e-6 else 0.1)


def test_the_compiler_of_a_urdf_counts(tmp_path):
    inertia = '<inertia ixx="{}" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(
        f'<link name="{name}"><inertial><mass value="1"/>{inertia.format(xx)}</inertial></link>'
        for name, xx in (("base", 1), ("arm", 9))
    )
    joint = '<joint name="a" type="revolute"><parent link="base"/><child link="arm"/>'
    joint += '<axis xyz="0 1 0"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    compiler = '<mujoco><compiler balanceinertia="true"/><option timestep="9"/></mujoco>'
    hint = 'write <compiler balanceinertia="true"/> into <mujoco>, in a URDF too'
    path = tmp_path / "arm.urdf"
    for extra, words in (("", hint), (compiler, "no two legs found")):
        path.write_text(f'<robot name="arm">{extra}{links}{joint}</robot>')
        assert words in proposed(path).error


MOTORS = "<actuator>.*</actuator>"
REFUSED = [  # what is told, and changes of the small biped
    ("'torso' push bodies", ('name="torso"', 'name="torso" gravcomp="1"')),
    ("'jet' push bodies", (MOTORS, "<actuator><general name='jet' body='torso'/></actuator>")),
    ("no hinges: left_knee", ('_knee" axis="0 1 0"', '_knee" type="slide" axis="0 0 1"')),
    ("'left_shin' has moments of inertia from 0", ("0.004 0.004 0.001", "0 0.004 0.001")),
    ("right_knee are 10.0 cm from mirrored", ('name="right_shin" pos="0 ', 'pos="0.1 ')),
    (
        "looks along y, expected along x: put its trunk into",
        (r'(_hip" pos=)"0 (-?0.1) -0.1"', r'\1"\2 0 -0.1"'),
        (r'pos="0.01 0 -0.02"', 'pos="0 0.01 -0.02"'),
        ('axis="1 0 0"', 'axis="0 -1 0"'),
        (r'(name="\w+_(pitch|knee|ankle)") axis="0 1 0"', r'\1 axis="1 0 0"'),
    ),
    ("right_ankle turn without end, as wheels do", (r'(_ankle.*) range="-1 1"', r"\1")),
    ("right_ankle turn .* another unit: rad", (r'(_ankle.*) range="-1 1"', r'\1 range="10 60"')),
    (r"expected it in its range \[10. 16.\]", (r'(_ankle.*) range="-1 1"', r'\1 range="10 16"')),
    (r"'base' 0\.\d+ m below the floor", ('0.08 0.1"/>', '0.08 0.1" pos="0 0 -0.45"/>')),
]


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case[0])
def test_a_robot_that_cannot_be_used_is_refused_with_the_reason(tmp_path, case):
    text, *changes = case
    proposal = proposed(edited(tmp_path, *changes))
    assert re.search(text, proposal.error)
    assert proposal.error in proposal.wrong


GUESSED = [  # what is told of a proposal that can be used, and changes of the small biped
    ("'left_roll' has no range, nor have left_pitch, left_knee, .*guess", (' range="[^"]*"', "")),
    ("'left_knee' has no range, nor have right_knee: half", ('(_knee.*) range="[^"]*"', r"\1")),
    ("'left_roll' has no torque limit, nor have left_pitch, .*joints.weld", (MOTORS, "")),
    (
        "body 'left_foot' is guessed .*, no shape .* it has no mesh: .* cm long, .*measure heel",
        (r'\n *<geom type="box" size="0.06 0.03 0.01".*', ""),
        (r'<geom type="sphere".*', ""),
        (r'<body name="\w+_cap"[^>]*>\s*</body>', ""),
    ),
]


@pytest.mark.parametrize("case", GUESSED, ids=lambda case: case[0])
def test_what_a_file_does_not_have_is_guessed_and_told(monkeypatch, capsys, tmp_path, case):
    text, *changes = case
    path, folder = edited(tmp_path, *changes), tmp_path / "new"
    assert call(monkeypatch, "robot", path, "--out", folder) == 0
    assert re.search(text, capsys.readouterr().out)
    out = folder / "robot.toml"
    assert re.search(f"(?m)^# A guess: .*{text}", out.read_text())
    assert load_robot(out).torque_limit.min() > 0.0


FIXED = [  # a note, and changes of the small biped
    (
        "<flag> of <option> not used",
        ("<asset>", '<option><flag sensornoise="enable"/></option><asset>'),
    ),
    ("moments .* a ball's: left_foot", ("(?s)(left_foot.*?)0.0002 0.0003 0.0002", r"\g<1>0 0 0")),
    (
        "moments .* the mean.*: left_foot",
        ("(?s)(left_foot.*?)0.0002 0.0003", r"\g<1>0.0009 0.0003"),
    ),
    ("not used", ("<compiler", '<compiler coordinate="local"')),
]


@pytest.mark.parametrize("case", FIXED, ids=lambda case: case[0])
def test_what_does_not_matter_is_mended_and_told(tmp_path, case):
    text, *changes = case
    own = proposed(edited(tmp_path))
    proposal = proposed(edited(tmp_path, *changes))
    assert proposal.wrong == ()
    assert re.search(text, "\n".join(proposal.standard.notes))
    assert proposal.robot.mass == pytest.approx(float(own.robot.mass))


def test_files_beside_a_model_are_included_and_others_are_not(tmp_path):
    whole = proposed(edited(tmp_path))
    path = edited(tmp_path)
    text = path.read_text()
    motors = re.search(MOTORS, text)[0]
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "motors.xml").write_text(f"<mujoco>{motors}</mujoco>")
    for file, error in (
        ("parts/motors.xml", None),
        ("../motors.xml", "<include> of '../motors.xml' is not accepted, expected a file beside"),
        ("robot.xml", "that is included once"),
    ):
        path.write_text(text.replace(motors, f'<include file="{file}"/>'))
        proposal = proposed(path)
        assert error is None or error in proposal.error
        assert error or proposal.table == whole.table


def test_legs_that_hang_at_the_world_have_it_as_their_trunk(tmp_path):
    path = edited(tmp_path)
    (start,) = re.findall('<body name="base".*?>', path.read_text())
    floor = '<geom type="plane" size="1 1 1" pos="0 0 -3"/>'
    edited_text = path.read_text().replace(start + "<freejoint/>", floor)
    edited_text = re.sub('(?s)<inertial pos="0.01 0 0.05".*?/>', "", edited_text)
    box = '<geom type="box" size="0.05 0.08 0.1"/>'
    edited_text = edited_text.replace(box, box.replace("/>", ' mass="4"/>'))
    path.write_text(re.sub(r"</body>(\s*</worldbody>)", r"\1", edited_text))
    proposal = proposed(path)
    assert proposal.wrong == ()
    assert proposal.table["joints"]["left"] == JOINTS[:4]
    assert proposal.robot.mass == pytest.approx(12.12, abs=0.01)


TOE = '<body name="{0}_toes" pos="0.06 0 0"><joint name="{0}_toe" axis="0 1 0" range="-1 1"/>'
TOE += '<inertial pos="0 0 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/></body>'
ROD = '<equality><joint joint1="left_ankle" joint2="left_toe"/></equality>'


def test_a_joint_that_is_welded_is_of_no_leg_and_frees_what_is_coupled_to_it(
    monkeypatch, capsys, tmp_path
):
    own = proposed(edited(tmp_path))
    toes = [(f'(<body name="{s}_cap")', TOE.format(s) + r"\1") for s in SIDES]
    path = edited(tmp_path, *toes, more=ROD)
    assert call(monkeypatch, "robot", path) == 2
    assert "couples left_ankle, left_toe" in capsys.readouterr().err
    out = tmp_path / "new"
    assert call(monkeypatch, "robot", path, "--out", out, "--weld", "left_toe", "right_toe") == 0
    assert read_description(out / "robot.toml").joints == own.robot.description.joints
    assert call(monkeypatch, "robot", path, "--weld", "left_tow") == 2
    assert "no joint 'left_tow'; did you mean 'left_toe'?" in capsys.readouterr().err


def test_soles_are_measured_on_the_lowest_facets_of_meshes(monkeypatch, capsys, tmp_path):
    """A box, 12 x 6 x 2 cm, as the STL, OBJ, DAE and MSH of a foot, and tilted by 0.2 rad."""
    for suffix in ("stl", "obj", "dae", "msh"):
        for tilt in (0.0, 0.2):
            folder = tmp_path / f"{suffix}{tilt}"
            (folder / "meshes").mkdir(parents=True)
            write_box(folder / "meshes" / f"sole.{suffix}", (60.0, 30.0, 10.0))
            mesh = (
                f'<mesh name="sole" file="sole.{suffix}" scale="1e-3 1e-3 1e-3"/><mesh name="arm"'
            )
            geom = f'<geom type="mesh" mesh="sole" pos="0.01 0 -0.03" euler="0 {tilt} 0"/>'
            changes = [('<mesh name="arm"', mesh), (BOX, geom), (CAP, ""), ("../meshes", "meshes")]
            path = edited(folder, *changes, (r'<body name="\w+_cap"[^>]*>\s*</body>', ""))
            proposal, shape = proposed(path), BOX.replace("/>", f' euler="0 {tilt} 0"/>')
            assert (proposal.wrong, proposal.guesses) == ((), ())
            plain = edited(tmp_path, (BOX, shape), (CAP, ""))
            for sole, expected in zip(
                proposal.soles, find_soles(survey_file(read_file(plain))), strict=True
            ):
                assert sole.files == (f"sole.{suffix}",)
                np.testing.assert_allclose(sole.contacts, expected.contacts, atol=2e-4)
                np.testing.assert_allclose(sole.axes, expected.axes, atol=1e-6)
    assert call(monkeypatch, "robot", path) == 0
    assert "changed  soles measured on sole.msh" in capsys.readouterr().out


KNEE, PITCH = 'right_knee" axis="0 1 0" range="-0.1 ', 'right_pitch" axis="0 1 0'
ANKLE = 'joint="right_ankle" kp="100" forcerange="-{0} {0}"'
FOOT = '<body name="right_foot" pos="0 0 -0.2'
TOLD = {  # a change of the small biped, and what is told of it
    "range": (f'{KNEE}2"', f'{KNEE}1.5"', r"right_knee are .*\[rad\] -0.1, 2 and -0.1, 1.5$"),
    "axis": (f'{PITCH}"', f'{PITCH}.3"', "right_pitch are .*axis 0, 1, 0 and"),
    "motor": (ANKLE.format(30), ANKLE.format(20), r"right_ankle are .*\[N m\] 30 and 20$"),
    "mass": (r'(?s)(right_shin.*?mass=)"0.5"', r'\1"0.7"', r"right_knee are .* 0.5 and 0.7$"),
    "length": (f'{FOOT}">', f'{FOOT}2">', "right_ankle are .*place .* 0, 0, -0.19 and 0, 0, -0.21"),
    "degrees": ('"-0.5 0.5"', '"-0.01 0.01"', r"left_roll -0.01 to \+0.01, right_roll.*unit"),
    "turns": (r'(_pitch.*)"-1 1"', r'\1"-1 9"', r"left_pitch -1.00 to \+9.00.*unit"),
    "placeholder": ('"-30 30"', '"-3000 3000"', "left_knee 3000.*placeholder"),
    "grams": (r'mass="(4|3)" diag', r'mass="\g<1>000" diag', "write kg and m"),
}


@pytest.mark.parametrize("kind", TOLD)
def test_what_is_likely_wrong_is_told(tmp_path, kind):
    *change, text = TOLD[kind]
    for changes, count in (((), 0), ((change,), 1)):
        robot = proposed(edited(tmp_path, *changes)).robot
        assert len([line for line in remarks(robot) if re.search(text, line)]) == count
    if kind == "motor":
        assert re.search(r"left_ankle, right_ankle .* 30 / 20 ", "\n".join(table_of(robot)))


def test_a_hinge_is_a_line_and_has_no_sign(tmp_path):
    """Knee, ankle and hip of the right leg are moved along their own axes."""
    own = proposed(edited(tmp_path))
    moved = [
        (r'(name="right_knee" axis="0 1 0")', r'\1 pos="0 0.08 0"'),
        (r'(name="right_ankle".*) pos="0 0 0.01"', r'\1 pos="0 -0.05 0.01"'),
        (r'(name="right_roll" axis="1 0 0")', r'\1 pos="0.06 0 0"'),
    ]
    proposal = proposed(edited(tmp_path, *moved))
    assert proposal.error is None
    assert proposal.table["standing"] == own.table["standing"]
    assert proposal.robot.standing_height == pytest.approx(own.robot.standing_height, abs=1e-9)
    # joints that turn the other way have the other range
    knee = 'right_knee" axis="0 1 0" range="-0.1 2"', 'right_knee" axis="0 -1 0" range="-2 0.1"'
    roll = 'left_roll" axis="1 0 0" range="-0.5 0.5"', 'left_roll" axis="1 0 0" range="-0.2 0.5"'
    other = 'right_roll" axis="1 0 0" range="-0.5 0.5"', 'right_roll" axis="1 0 0" range="-0.5 0.2"'
    for changes in (moved, [knee, roll, other]):
        assert not [line for line in told(edited(tmp_path, *changes)) if "mirror" in line]


def test_knees_bend_from_the_straight_leg(tmp_path):
    plain = r'(name="\w+_ankle" axis="0 1 0") range="-1 1" pos="0 0 0.01"', r'\1 range="-1.9 1.9"'
    own = proposed(edited(tmp_path, plain))
    crouch = [
        plain,
        (r'(<body name="\w+_shin" pos="0 0 -0.2")>', r'\1 euler="0 0.9 0">'),
        (r'(<body name="\w+_foot" pos="0 0 -0.2")>', r'\1 euler="0 -0.9 0">'),
        ('range="-0.1 2"', 'range="-1 1.1"'),
    ]
    proposal = proposed(edited(tmp_path, *crouch))
    assert proposal.survey.forwards == own.survey.forwards == (True,)
    assert proposal.table["standing"]["left_knee"] == pytest.approx(0.1, abs=1e-3)
    assert proposal.robot.standing_height == pytest.approx(own.robot.standing_height, abs=1e-3)


def test_a_draft_has_what_was_found_and_what_is_to_be_mended(monkeypatch, capsys, tmp_path):
    unlike = ('(?s)(right_foot.*?)size="0.06 0.03 0.01"', r'\1size="0.09 0.03 0.01"')
    proposal = proposed(edited(tmp_path, unlike))
    assert "expected the same" in proposal.wrong[0]
    assert proposal.table["joints"]["left"] == JOINTS[:4]
    arm = "<body><joint name='one' axis='0 1 0'/><geom size='0.1'/></body>"
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{arm}</worldbody></mujoco>")
    assert call(monkeypatch, "robot", tmp_path / "arm.xml") == 2
    printed, err = capsys.readouterr()
    assert re.search(r"no two legs found, .* by their last joint: one \(1\)", err)
    assert "# To be fixed: " in printed
    assert tomllib.loads(printed[printed.index("# Proposed") :])["model"] == "arm.xml"


def test_what_a_file_names_is_checked_and_taken_and_the_rest_is_filled_in(
    monkeypatch, capsys, tmp_path
):
    model = edited(tmp_path)
    full = proposed(model).table
    path = tmp_path / "own.toml"
    path.write_text('model = "robot.xml"\n[gait]\nstance = 24\n[weights.nominal]\neuler = 7\n')
    proposal = proposed(path)
    assert proposal.error is None
    expected = {**full, "name": "own", "gait": full["gait"] | {"stance": 24}}
    weights = full["weights"]["nominal"] | {"euler": 7}
    expected["weights"] = full["weights"] | {"nominal": weights}
    assert proposal.table == expected
    assert {"joints", "gait.swing", "weights.nominal.force"} <= set(proposal.filled)
    assert not {"gait", "gait.stance", "model"} & set(proposal.filled)
    assert call(monkeypatch, "robot", path) == 0
    assert "left out " in capsys.readouterr().out

    def named(joints):
        path.write_text(f'model = "{model.name}"\n[joints]\n{joints}\n')
        return proposed(path)

    left = ["left_roll", "left_pitch", "left_knee"]
    table = named(f"left = {left}\nright = {[x.replace('left', 'right') for x in left]}").table
    assert table["joints"]["left"] == left
    assert "left_ankle" in table["joints"]["weld"]
    error = named("left = 3").error
    assert error.startswith(f"{path}: joints: left must be a list, each text, got 3")
    error = named(f'left = {left}\nright = ["right_roll"]').error
    assert "must be 3 to 7 names each and as many in both" in error


@pytest.mark.parametrize("kind", ["line", "point", "flat"])
def test_a_robot_in_the_standard_form_is_the_one_of_its_file(monkeypatch, capsys, tmp_path, kind):
    model = {"line": edited(tmp_path), "point": QUADRUPED, "flat": HUMANOID}[kind]
    assert call(monkeypatch, "robot", model, "--out", tmp_path / "new") == 0
    assert {x.name for x in (tmp_path / "new").iterdir()} == {"robot.toml", "robot.xml"}
    robot, own = load_robot(tmp_path / "new" / "robot.toml"), proposed(model).robot
    assert robot.structure == own.structure
    assert robot.structure.contact == kind
    walk_config(robot)
    loss_of_robot(robot.description)
    for name in own._fields[:-2]:
        np.testing.assert_array_equal(getattr(robot, name), getattr(own, name))
    # and once more: nothing is left to convert
    capsys.readouterr()
    again = tmp_path / "again"
    assert call(monkeypatch, "robot", tmp_path / "new" / "robot.toml", "--out", again) == 0
    assert "replace" not in capsys.readouterr().out
    for name in ("robot.toml", "robot.xml"):
        texts = [(tmp_path / x / name).read_text().split("\n", 1)[1] for x in ("new", "again")]
        assert texts[0] == texts[1]


@pytest.mark.parametrize("path", ["hector", "strider", "humanoid"])
def test_a_robot_that_is_converted_has_the_mechanics_of_its_own_toml(tmp_path, path):
    own = load_robot(None if path == "hector" else EXAMPLES / path / "robot.toml")
    model = MODEL_PATH if path == "hector" else EXAMPLES / path / f"{path}.xml"
    proposal = proposed(model)
    assert proposal.wrong == ()
    assert proposal.survey.forwards == (path == "humanoid",)
    robot = load_robot(converted(model, tmp_path / "out"))
    assert robot.description.joints == own.description.joints
    assert len(walk_config(robot).legs.kp) == own.description.leg_joints
    for name in ("mass", "joint_origin", "joint_axis", "link_mass", "link_com", "torque_limit"):
        np.testing.assert_allclose(getattr(robot, name), getattr(own, name), atol=1e-9)
    np.testing.assert_allclose(robot.toe + robot.heel, own.toe + own.heel, atol=1e-9)


BOX = '<geom type="box" size="0.06 0.03 0.01" pos="0.01 0 -0.03"/>'
CAP = '<geom type="sphere" size="0.005" mass="0.01"/>'


def test_a_draft_has_all_that_its_model_needs(monkeypatch, capsys, tmp_path):
    """What a model includes is in it, its meshes are beside it, and there it can be mended."""
    (tmp_path / "parts").mkdir()
    for name, half in (("left", (60.0, 30.0, 10.0)), ("parts/left", (1.0, 2.0, 3.0))):
        write_box(tmp_path / f"{name}.stl", half)
    meshes = '<mesh name="sole" file="left.stl" scale="1e-3 1e-3 1e-3"/>'
    meshes += '<mesh file="parts/left.stl"/>'
    (tmp_path / "parts" / "assets.xml").write_text(f"<mujoco><asset>{meshes}</asset></mujoco>")
    box = BOX.replace('type="box" size="0.06 0.03 0.01"', 'type="mesh" mesh="sole"')
    path = edited(
        tmp_path,
        ("<asset>", '<include file="parts/assets.xml"/><asset>'),
        (' meshdir="../meshes"', ""),
        (BOX, box),
        (r'<body name="\w+_cap"[^>]*>\s*<geom.*\s*</body>', ""),
        ("0.004 0.004 0.001", "0 0.004 0.001"),
    )
    draft = tmp_path / "draft" / "robot.toml"
    assert call(monkeypatch, "robot", path, "--out", draft.parent) == 2
    err = capsys.readouterr().err
    assert (
        f"the proposal is in {draft.parent}; fix it, then: hector robot {draft} --out FOLDER\n"
        in err
    )
    line = proposed(path).wrong[-1]
    assert err.endswith(f"hector: {line}\n")
    assert f"# To be fixed: {line}" in draft.read_text()
    assert tomllib.loads(draft.read_text())["model"] == path.name
    there = {x.relative_to(draft.parent).as_posix() for x in draft.parent.rglob("*.*")}
    assert there == {"robot.toml", "robot.xml", "meshes/left.stl", "meshes/left_.stl"}
    # what it was made of is not needed
    for file in (path, *tmp_path.glob("*.stl"), *(tmp_path / "parts").iterdir()):
        file.unlink()
    model = draft.with_name(path.name)
    model.write_text(replaced(model.read_text(), ("0 0.004 0.001", "0.004 0.004 0.001")))
    assert call(monkeypatch, "robot", draft, "--out", tmp_path / "mended") == 0
    assert "soles measured on left.stl" in capsys.readouterr().out
    assert load_robot(tmp_path / "mended" / "robot.toml").toe == pytest.approx(0.06, abs=1e-3)
    with pytest.raises(InputError, match=f"hector robot {draft} --out FOLDER"):
        load_robot(draft)


def test_a_draft_keeps_the_folder_of_meshes_that_are_not_there(monkeypatch, tmp_path):
    """Of two meshes one is found; later the other one lies where the model has it."""
    (tmp_path / "parts").mkdir()
    write_box(tmp_path / "parts" / "one.stl", (1.0, 1.0, 1.0))
    meshes = '<mesh name="one" file="one.stl"/><mesh name="two" file="sub/two.stl"/>'
    for found in ({"one.stl"}, set()):
        path = edited(
            tmp_path,
            ("<asset>", f"<asset>{meshes}"),
            ("../meshes", "parts"),
            ("0.004 0.004 0.001", "0 0.004 0.001"),
        )
        draft = tmp_path / f"draft{len(found)}"
        assert call(monkeypatch, "robot", path, "--out", draft) == 2
        root = ElementTree.parse(draft / path.name).getroot()
        files = {x.get("name"): x.get("file") for x in root.iter("mesh") if x.get("file")}
        assert files == {
            "one": "meshes/one.stl" if found else "parts/one.stl",
            "two": "parts/sub/two.stl",
            "thigh": "parts/thigh.stl",
            "arm": "/etc/passwd",
        }
        assert not [x for x in root.iter("compiler") if "meshdir" in x.attrib]
        assert {x.name for x in draft.rglob("*.stl")} == found
        (tmp_path / "parts" / "one.stl").unlink(missing_ok=True)


@pytest.mark.parametrize("suffix", ["xml", "toml"])
def test_there_is_no_draft_of_a_model_that_cannot_be_read(monkeypatch, capsys, tmp_path, suffix):
    path = edited(tmp_path)
    text = path.read_text()
    (tmp_path / "robot.toml").write_text(f'model = "{path.name}"\n')
    included = text.replace("<asset>", '<include file="gone.xml"/><asset>')
    for content, words in ((text[:900], "malformed XML"), (included, "<include> of 'gone.xml'")):
        path.write_text(content)
        assert (
            call(monkeypatch, "robot", tmp_path / f"robot.{suffix}", "--out", tmp_path / "d") == 2
        )
        err = capsys.readouterr().err
        assert re.search(f"hector: {path}: {words}[^\n]*\n$", err)
        assert "fix it" not in err
        assert not (tmp_path / "d").exists()


def test_a_file_that_is_still_to_be_converted_is_not_approved(monkeypatch, capsys, tmp_path):
    assert call(monkeypatch, "robot", edited(tmp_path), "--out", tmp_path / "new") == 0
    own, new = tmp_path / "own.toml", tmp_path / "new" / "robot.toml"
    own.write_text('model = "robot.xml"\n')
    words = f"other commands refuse it: {tmp_path}/robot.xml: <mesh> of 'thigh.stl' is of another "
    words += f"file; convert it: hector robot {own} --out FOLDER\n"
    for path, count in ((own, 1), (new, 0)):
        capsys.readouterr()
        assert call(monkeypatch, "robot", path) == 0
        printed = capsys.readouterr().out
        assert (printed.count(words), printed.count("other commands")) == (count, count)
    # where it is converted there is nothing to be told
    assert call(monkeypatch, "robot", own, "--out", tmp_path / "once") == 0
    assert "other commands" not in capsys.readouterr().out


def test_legs_that_are_unlike_are_told_once(monkeypatch, capsys, tmp_path):
    path = edited(tmp_path, ('right_knee" axis="0 1 0"', 'right_knee" axis="0 -1 0"'))
    assert call(monkeypatch, "robot", path, "--out", tmp_path / "draft") == 2
    printed, err = capsys.readouterr()
    for text in (printed, err, (tmp_path / "draft" / "robot.toml").read_text()):
        assert text.count("left_knee and right_knee are no mirror images") == 1


@pytest.mark.parametrize("fault", ["axis", "sole", "balance"])
def test_a_draft_that_is_mended_is_the_robot_whose_model_never_was_wrong(
    monkeypatch, capsys, tmp_path, fault
):
    change = {
        "axis": ('right_knee" axis="0 1 0"', 'right_knee" axis="0 -1 0"'),
        "sole": ('(?s)(right_foot.*?)size="0.06 0.03 0.01"', r'\1size="0.09 0.03 0.01"'),
        "balance": ('pos="0.01 0 0.05" mass="4"', 'pos="1 0 0.05" mass="4"'),
    }[fault]
    sound = edited(tmp_path).read_text()
    assert call(monkeypatch, "robot", tmp_path / "robot.xml", "--out", tmp_path / "sound") == 0
    path, draft = edited(tmp_path, change), tmp_path / "draft" / "robot.toml"
    assert call(monkeypatch, "robot", path, "--out", draft.parent) == 2
    table = tomllib.loads(draft.read_text())
    assert {*table} == {"name", "model", "joints"}
    assert table["joints"] == proposed(tmp_path / "sound" / "robot.toml").table["joints"] | {
        "weld": ["waist", "shoulder"]
    }
    assert call(monkeypatch, "robot", path) == 2  # what is printed is the same
    printed = capsys.readouterr().out
    assert tomllib.loads(printed[printed.rindex("# Proposed") :]) == table
    draft.with_name("robot.xml").write_text(sound)
    assert call(monkeypatch, "robot", draft, "--out", tmp_path / "mended") == 0
    for name in ("robot.toml", "robot.xml"):
        texts = [(tmp_path / x / name).read_text().split("\n", 1)[1] for x in ("sound", "mended")]
        assert texts[0] == texts[1]


def test_wrenches_act_in_the_middle_of_a_sole_which_may_be_a_tilted_box(
    tmp_path,
):
    proposal = proposed(edited(tmp_path, ('pos="0.01 0 -0.03"', 'pos="0.05 0 -0.03"')))
    assert proposal.wrong == ()
    assert "point" not in proposal.table["feet"]["left"]
    robot = proposal.robot
    np.testing.assert_allclose(robot.foot_point[:, 0], 0.05, atol=1e-4)
    np.testing.assert_allclose([robot.toe, robot.heel], 0.06, atol=1e-4)
    data = standing_data(robot.description, compile_model(robot.description))
    ankles = [data.joint(f"{side}_ankle").xanchor[0] for side in ("left", "right")]
    assert abs(data.subtree_com[1][0] - np.mean(ankles)) < 1e-3
    assert not any("along -x" in line for line in remarks(robot))
    path = edited(tmp_path, (CAP, ""), (BOX, BOX.replace("/>", ' euler="0 0.2 0"/>')))
    for sole in find_soles(survey_file(read_file(path))):
        np.testing.assert_allclose(sole.axes[:, 2], [np.sin(0.2), 0.0, np.cos(0.2)], atol=1e-9)
    proposal = proposed(path)
    assert proposal.wrong == ()
    angles = proposal.table["standing"]
    total = sum(angles[f"left_{joint}"] for joint in ("pitch", "knee", "ankle"))
    assert total == pytest.approx(-0.2, abs=2e-3)


def test_gains_follow_from_what_hangs_at_a_joint_and_sizes_scale_with_mass_and_height():
    proposal = proposed(HUMANOID)
    robot, description = proposal.robot, proposal.robot.description
    config = walk_config(robot)
    I = response(robot).inertia[: description.leg_joints]  # noqa: E741
    kp, kd = np.array(config.legs.kp), np.array(config.legs.kd)
    most = 2.0 * robot.torque_limit[: description.leg_joints]
    w = swing_frequency(response(robot))
    assert 10.0 < w < 30.0
    assert proposal.table["standing"]["left_knee"] == 1.0
    np.testing.assert_allclose(kp, np.minimum(w**2 * I, most), rtol=6e-3)
    np.testing.assert_allclose(kd, np.sqrt(kp * I), rtol=1e-2)
    assert config.legs.gravity_compensation
    m, h = float(robot.mass) / MASS, float(robot.standing_height) / HEIGHT
    assert config.gait.stance == config.gait.swing == round(20 * np.sqrt(h))
    assert config.mpc.step_ticks * config.mpc.horizon > config.gait.swing
    assert config.mpc.max_force == pytest.approx(2.5 * robot.mass * robot.gravity[2], rel=0.02)
    assert (config.mpc.effort_reference, config.mpc.sole_width) == ("gravity", 0.6)
    force, moment = description.nominal[-2][0], description.nominal[-1][0]
    assert force == pytest.approx(0.3e-4 / m**2, rel=6e-3)
    assert moment == pytest.approx(0.3e-3 / (m * h) ** 2, rel=6e-3)
    assert dict(description.loss) == {"L_ctrl": pytest.approx(1 / m**2, rel=6e-3)}
    assert description.plants.joint_friction == pytest.approx(m * h, rel=6e-3)
    assert description.plants.push == description.plants.payload == pytest.approx(m, rel=6e-3)


def test_a_proposal_is_printed_and_written_once_into_a_new_folder(monkeypatch, capsys, tmp_path):
    assert call(monkeypatch, "robot", MODEL_PATH) == 0
    out = capsys.readouterr().out
    table, text = out.split("\n\n", 1)
    assert table.startswith("robot    hector: 12 kg, trunk 'trunk'")
    assert "knees bend backwards" in table
    assert re.search(r"left_hip_yaw, right_hip_yaw +\+z yaw", table)
    assert "feet     line: " in table
    for title in ("fixed    no joint", "changed  "):
        assert len(re.findall(f"(?m)^{title}", table)) == 1
    assert "wrong    nothing" in table
    assert tomllib.loads(text)["joints"]["left"][0] == "left_hip_yaw"
    model, out = edited(tmp_path), tmp_path / "other"
    assert call(monkeypatch, "robot", model, "--out", out) == 0
    assert (out / "robot.toml").read_text().startswith("# Proposed by `hector robot ")
    assert call(monkeypatch, "robot", out / "robot.toml") == 0
    for wrong in (out, tmp_path / "robot.toml"):
        assert call(monkeypatch, "robot", model, "--out", wrong) == 2
        assert "--out must be a new folder, which gets" in capsys.readouterr().err


def test_what_is_likely_trouble_is_told():
    robot = load_robot(HUMANOID.with_name("robot.toml"))
    assert not remarks(robot)

    def told(**mpc):
        control = (("mpc", tuple(mpc.items())),)
        return remarks(robot._replace(description=replace(robot.description, control=control)))

    (heavy,) = told(max_force=900.0, sole_width=0.6)
    assert heavy.startswith("the legs are 41 % of the mass")
    assert any("mpc.max_force is 300 N" in line for line in told(max_force=300.0))
