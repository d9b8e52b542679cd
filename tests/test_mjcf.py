"""Robot descriptions that are broken or mean harm: refused in one line that says what and where."""

import random
import re
import xml.etree.ElementTree as ElementTree

import mujoco
import pytest
from model import EXAMPLES
from pretend import call
from published import HOLD, JOINTS, LINK, MOTOR, SIDES, by_numbers, replaced, small, urdf_of

from hector_jax import InputError, load_robot, walk_config
from hector_jax.core.settings import as_toml
from hector_jax.importing.propose import propose_robot
from hector_jax.robot.description import DESCRIPTION_PATH, MODEL_PATH

TEXT = MODEL_PATH.read_text()
HECTOR = mujoco.MjModel.from_xml_path(str(MODEL_PATH))
URDF = urdf_of(HECTOR)


def swap(old, new, count=-1):
    assert old in TEXT, old
    return TEXT.replace(old, new, count)


def put(text, after):
    return swap(after, after + text, 1)


DEEP = "<body>" * 5000 + "</body>" * 5000
BOMB = '<!DOCTYPE m [<!ENTITY a "ha">'
for x, y in zip("abcdefgh", "bcdefghi", strict=True):
    BOMB += f'<!ENTITY {y} "{f"&{x};" * 10}">'
BOMB += "]>"

KNEE = 'axis="0 1 0" range="-2.38'
POSE = "0 0 0.785398163397 -1.570796326795 0.785398163397"
LEGS_SWAPPED = TEXT.replace("left_", "?_").replace("right_", "left_").replace("?_", "right_")
TRUNK = 'pos="0 0 0" mass="5.512"'
NO_SPHERE = '<collision><geometry><sphere radius="0"/></geometry></collision>'
NO_NUMBER = '<robot><link name="a"><inertial><origin xyz="0 nan 0"/></inertial></link></robot>'
OF_TEXT = {  # by what is told, a file in the place of HECTOR's
    "malformed XML.* line": TEXT[: len(TEXT) // 2],
    "<list>.* expected <mujoco>": "<list/>",
    "DOCTYPE": BOMB + TEXT.replace("trunk", "&i;"),
    "<include> of '/etc/passwd' is of another": put('<include file="/etc/passwd"/>', "<asset>"),
    "<mesh> of '/etc/passwd' is of another": put('<mesh name="m" file="/etc/passwd"/>', "<asset>"),
    "<texture> of '../a.png' is of": put(
        '<texture name="m" type="cube" fileup="../a.png"/>', "<asset>"
    ),
    "<texture> 'tiles'.* width is '99999999'.* to 8192": swap(
        'width="512" height="512"', 'width="99999999" height="99999999"'
    ),
    "memory is '4000G'.* at most 1G": swap('memory="4M"', 'memory="4000G"'),
    "nested deeper than 100": put(DEEP, "<worldbody>"),
    "2011 bodies, expected at most 2000": put(
        "".join(f'<body name="b{i}"/>' for i in range(2000)), "<worldbody>"
    ),
    "mass is '-5.512'.* above 0": swap('mass="5.512"', 'mass="-5.512"'),
    "<joint> of 'knee'.* range is '-0.10 -2.38'.* lower one first": swap(
        'range="-2.38 -0.10"', 'range="-0.10 -2.38"'
    ),
    "MuJoCo refuses.* 'mas'.* did you mean 'mass'": swap('mass="5.512"', 'mas="5.512"'),
    "bad format in attribute 'fromto' at <geom> of 'left_calf'": swap(
        'fromto="0 -0.012 0 ', 'fromto="0,1 -0.012 0 ', 1
    ),
    "<body> 'b': euler is '0 0 90', expected rad, and these are degrees": put(
        '<body name="b" euler="0 0 90"/>', "<worldbody>"
    ),
    "no keyframe 'standing'": swap('name="standing"', 'name="stand"'),
    "no geom 'right_toe'; did you mean": swap('"right_toe"', '"right_tip"'),
    "no joint 'left_knee'.* did you mean 'left_kneee'.* left_ankle": swap(
        "left_knee", "left_kneee"
    ),
    "keyframe 'standing' has the soles 0.3711 m above the floor": swap(
        KNEE, KNEE.replace("1", "-1")
    ),
    "left_knee' at -1.571": swap('"-2.38 -0.10"', '"0.10 2.38"'),
    "'left_knee', which has 2": swap(
        'ctrlrange="-67 67" forcerange="-67 67"', 'ctrlrange="-2 2" forcerange="-2 2"'
    ),
    "left_knee' at -2.571": swap(POSE, POSE.replace("-1.57", "-2.57")),
    "over the feet": swap(TRUNK, TRUNK.replace("0 0 0", "0.5 0 0")),
    "soles are not level.* left_toe 30.0": swap(
        'class="contact" pos="0.09 0 -0.03"', 'class="contact" pos="0.09 0 0"'
    ),
    "joints are base, right_hip_yaw, .* expected a free one, then left_hip_yaw": LEGS_SWAPPED,
}
OF_URDF = {  # a URDF in the place of HECTOR's
    "<list>.* expected <mujoco> or <robot>": "<list/>",
    "<origin>.* xyz is '0 nan 0'.* finite": NO_NUMBER,
    "bad format in attribute 'xyz' at <origin> of 'left_knee'": "<!-- a\n\n-->"
    + re.sub('(?s)(left_knee".*?xyz=")[^ ]* ', r"\g<1>0,1 ", URDF, count=1),
    "<origin> of 'left_knee': rpy is '0 180 0', expected rad, and these are degrees": re.sub(
        '(?s)(left_knee".*?rpy=")[^"]*', r"\g<1>0 180 0", URDF, count=1
    ),
    "<sphere> of 'left_foot': radius is '0', expected numbers above 0": re.sub(
        "(left_foot.*?)<visual>.*?</visual>", rf"\1{NO_SPHERE}", URDF
    ),
}
RING = LINK + '<link name="a"/>' + HOLD.format("j", "a", "payload")
OF_LINKS = {  # and what is put into a URDF
    "no joint holds payload, expected one tree below trunk": LINK,
    "got ['left_foot'] empty or twice": '<link name="left_foot"/>',
    "got ['left_knee'] empty or": HOLD.format("left_knee", "trunk", "trunk"),
    "got [''] empty or twice": "<link/>",
    "joint 'j' joins ['trunk', 'arm'], exp": HOLD.format("j", "trunk", "arm"),
    "joint 'j' joins ['trunk']": '<joint name="j"><parent link="trunk"/></joint>',
    "no other joint to have this child": HOLD.format("j", "trunk", "left_foot"),
    "links payload, a hang in a ring": RING + HOLD.format("k", "payload", "a"),
}

MESH = '<geom type="mesh" mesh="thigh" density="900"/>'
COUPLED = '<equality><joint joint1="left_knee" joint2="left_ankle"/></equality>'
IN_WORLD = '<worldbody><geom type="{}"/></worldbody>'
SHORT = '<keyframe><key name="up" qpos="0 0 3"/></keyframe>'
OF_PARTS = {  # parts of the small biped
    "body 'left_shin' moves and has no mass": {"shin": ""},
    "body 'left_shin' has its mass from a mesh": {"shin": MESH},
    "joints waist, shoulder are of no leg: add them to weld": {"weld": ()},
    "did you mean 'left_roll'": {"motors": MOTOR.format("left_rol")},
    "couples left_ankle, left_knee": {"more": COUPLED},
    "is terrain": {"more": IN_WORLD.format('box" size="1 1 0.1')},
    "level at z = 0": {"more": IN_WORLD.format('plane" size="1 1 1" pos="0 0 -1')},
    "has 3 numbers": {"more": SHORT, "standing": "up"},
    "feet.left.body is 'left_shin'": {"feet": ["left_shin", "left_shin"]},
    "name each leg from the trunk down": {"joints": [*JOINTS[1::-1], *JOINTS[2:]]},
    "soles are not level": {"contacts": ((0.07, 0.0, -0.04), (-0.05, 0.0, -0.03))},
}

HEAD = "must have left, right; or front_left, front_right, hind_left, hind_right, got "
ROLL, BODY = '"hind_left_roll"', 'body = "hind_left_calf"'
CONTACTS = '(front_left_calf"\n)contacts = .*'
LEGS = [f"{pair}_{side}" for pair in ("front", "hind") for side in SIDES]
STANDS = {
    f"{leg}_{joint}": angle for leg in LEGS for joint, angle in (("pitch", 0.5), ("knee", -1))
}
FOUR = {
    "model": "quadruped.xml",
    "standing": STANDS,
    "joints": {leg: [f"{leg}_{joint}" for joint in ("roll", "pitch", "knee")] for leg in LEGS},
    "feet": {leg: {"body": f"{leg}_calf", "contacts": [[-0.01, 0, -0.2326]]} for leg in LEGS},
}
OF_TABLE = {  # a change of a TOML of the quadruped as it is published
    f"{HEAD}front_left, front_right, hind_left$": (r"hind_right = \[.*\n", ""),
    "expected them in feet, got front_left, front_right, hind_left$": (
        r"(?s)\[feet.hind_right\].*",
        "",
    ),
    "joints: must have .* got left, fr": (r"\[joints\]", r'\g<0>\nleft = ["a", "b", "c"]'),
    "feet.hind_left.body is 'front_left_calf', expected one that joint 'hind_left_knee'": (
        BODY,
        BODY.replace("hind", "front"),
    ),
    "different names, got 'front_left_roll' twice": (ROLL, '"front_left_roll"'),
    r"as many contacts, got \[2, 1, 1, 1\]": (
        CONTACTS,
        r"\1contacts = [[0.1, 0, -0.2326], [-0.1, 0, -0.2326]]",
    ),
    "1, 2 or 4 contacts": (
        CONTACTS,
        r"\1contacts = [[0, 0, -0.23], [0.1, 0, -0.23], [0, 0.1, -0.23]]",
    ),
    "the hind_left foot at y = -0.142, expected it left of the hind_right one": (
        "hind_(left|right)(?=]| = )",
        lambda found: f"hind_{'right' if found[1] == 'left' else 'left'}",
    ),
    "standing must be finite angles": ("front_left_knee = -1", "front_left_knee = nan"),
    "joints: armature must be a number for each of the 3": (
        r"\[joints\]",
        r"\g<0>\narmature = [1]",
    ),
}
OF_STRIDER = {  # a change of the strider's TOML
    "robot.toml: unknown field 'gate'.*did you mean 'gait'?": ("[gait]", "[gate]"),
    "gait: stance must be a whole number.*got '22'": ("stance = 22", 'stance = "22"'),
    r"legs.kp must be a number for each of the 5 joints.*got \(150.0,": ("kp = [150,", "kp = ["),
    r"legs.armature must be a number for each of the 5 joints.*got \(0.01,": (
        "[legs]",
        "[legs]\narmature = [0.01, 0.01]",
    ),
    "robot.toml: gait.tick must be at most half": ("[mpc]", "[mpc]\nstep_ticks = 1"),
    "did you mean 'friction'": ("[mpc]", "[mpc]\nconstraints = ['frictoin']"),
    "joints: left and right must be 3 to 7 names each.*got 4 and 5": ('"left_yaw", ', ""),
    "joints: linkage must be two.*from 1 to 5": ("linkage = [5, 4]", "linkage = [6, 4]"),
    r"nominal: euler must be a number.*got \[50, 0": ("l.euler = 50", "l.euler = [50, 0, 50]"),
    "robot.toml: model is missing.*MJCF or URDF beside": ('model = "strider.xml"', ""),
    "expert: missing field 'moment'": ("expert.moment = 1.8e-3", ""),
    "unknown field 'weld'.* converted once, by hector robot .*/robot.toml --out FOLDER": (
        "[joints]",
        '[joints]\nweld = ["waist"]',
    ),
    "feet: left: unknown field 'body'.*by hector robot": (
        'left = { point = "left_sole"',
        'left = { body = "a"',
    ),
    "no site 'left_soul'.*did you mean 'left_sole'?": ('"left_sole"', '"left_soul"'),
}


def load_text(folder, text):
    (folder / "robot.xml").write_text(text)
    toml = DESCRIPTION_PATH.read_text().replace("hector.xml", "robot.xml")
    (folder / "robot.toml").write_text(toml)
    load_robot(folder / "robot.toml")


def load_published(path):
    if error := propose_robot(path, path.parent / "out").error:
        raise InputError(error)


def load_urdf(folder, text):
    load_published(by_numbers(folder, text).write())


def load_parts(folder, parts):
    load_published(small(folder, **parts).write())


def load_table(folder, change):
    (folder / "quadruped.toml").write_text(replaced(as_toml(FOUR, []), change))
    model = EXAMPLES / "quadruped" / "quadruped.xml"
    (folder / "quadruped.xml").write_bytes(model.read_bytes())
    load_published(folder / "quadruped.toml")


def load_strider(folder, change):
    file, old = EXAMPLES / "strider" / "robot.toml", re.escape(change[0])
    (folder / "robot.toml").write_text(replaced(file.read_text(), (old, change[1])))
    (folder / "strider.xml").write_bytes(file.with_name("strider.xml").read_bytes())
    walk_config(load_robot(folder / "robot.toml"))


TABLES = {load_text: OF_TEXT, load_urdf: OF_URDF, load_parts: OF_PARTS, load_table: OF_TABLE}
TABLES |= {load_strider: OF_STRIDER}


def refusals():
    for words, links in OF_LINKS.items():
        yield load_urdf, URDF.replace("</robot>", f"{links}</robot>"), re.escape(words)
    for load, table in TABLES.items():
        yield from ((load, changed, words) for words, changed in table.items())


@pytest.mark.parametrize("case", list(refusals()), ids=lambda case: case[-1])
def test_broken_and_hostile_files_are_told_in_one_line(case, monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    load, changed, words = case
    with pytest.raises(InputError) as caught:
        load(tmp_path, changed)
    message = str(caught.value)
    assert message.startswith(str(tmp_path))
    assert "\n" not in message
    assert len(message) < 1000
    assert re.search(words, message)
    assert not list(tmp_path.glob("*LOG*"))  # of MuJoCo
    assert capfd.readouterr() == ("", "")


ASSETS = ['<mesh name="m" file="/etc/passwd"/>', '<mesh name="m" file="link/a.stl"/>']
ASSETS += ['<hfield name="m" file="a.png" size="1 1 1 1"/>']
ASSETS += ['<texture name="m" type="cube" fileup="../a.png"/>']


@pytest.mark.parametrize("asset", ASSETS)
def test_meshes_and_pictures_are_never_opened(tmp_path, asset):
    folder = tmp_path / "robot"
    folder.mkdir()
    (tmp_path / "a.stl").write_text("solid secret")
    (folder / "link").symlink_to(tmp_path)
    (folder / "robot.xml").write_text(put(asset, "<asset>"))
    proposal = propose_robot(folder / "robot.xml", tmp_path / "out")
    assert proposal.error is None
    assert "asset" not in proposal.standard.text.replace("<asset>", "").replace("</asset>", "")
    assert not re.search("file|mesh|hfield", proposal.standard.text)


VALUES = ("", "x", "0", "-1", "1e9", "-1e-9", "nan", "floor", "0 0 0", "10 60", "0 0 0 0")


def check_changed(monkeypatch, capsys, folder, count, seed):
    """Change, rename or remove single attributes of shipped models and of a URDF."""
    (folder / "hector.urdf").write_text(URDF)
    files = [MODEL_PATH, folder / "hector.urdf", *sorted(EXAMPLES.glob("*/*.xml"))]
    draw = random.Random(seed)
    for _ in range(count):
        file = draw.choice(files)
        root = ElementTree.parse(file).getroot()
        element, name = draw.choice([(x, name) for x in root.iter() for name in x.attrib])
        value = draw.choice((*VALUES, "gone", "renamed"))
        old = element.attrib.pop(name)
        if value != "gone":
            renamed = value == "renamed"
            element.set(f"{name}s" if renamed else name, old if renamed else value)
        ElementTree.ElementTree(root).write(path := folder / f"changed{file.suffix}")
        code, err = call(monkeypatch, "robot", path), capsys.readouterr().err
        what = file.name, element.tag, name, value, err
        assert code in (0, 2), what
        assert ("hector: " in err) == (code == 2), what
        assert not any(x in err for x in ("Traceback", "Warning", "no robot can be made")), what


def test_a_model_with_one_attribute_changed_is_taken_or_refused(monkeypatch, capsys, tmp_path):
    check_changed(monkeypatch, capsys, tmp_path, 25, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 6))
def test_many_models_with_one_attribute_changed(monkeypatch, capsys, tmp_path, seed):
    check_changed(monkeypatch, capsys, tmp_path, 200, seed)


def test_a_flag_is_a_word_and_no_number(tmp_path):
    text = swap('ls_iterations="10"/>', 'ls_iterations="10"><flag frictionloss="enable"/></option>')
    load_text(tmp_path, text)
