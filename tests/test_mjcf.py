"""Robot descriptions that are broken or mean harm: refused in one line that says what and where."""

import random
import re
import xml.etree.ElementTree as ElementTree
from functools import partial

import mujoco
import pytest
from model import EXAMPLES
from pretend import call
from published import HOLD, JOINTS, LINK, MOTOR, by_numbers, replaced, small, urdf_of

from hector_jax import InputError, walk_config
from hector_jax.robot.description import MODEL_PATH, Foot
from hector_jax.robot.model import compile_model, describe, load_robot, robot_of

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
OF_TEXT = {  # a file in the place of HECTOR's, and what is told
    "cut": (TEXT[: len(TEXT) // 2], "malformed XML.* line"),
    "a list": ("<list/>", "<list>.* expected <mujoco> or <robot>"),
    "urdf with NaN": (
        '<robot><link name="a"><inertial><origin xyz="0 nan 0"/></inertial></link></robot>',
        "<origin>.* xyz is '0 nan 0'.* finite",
    ),
    "entities": (BOMB + TEXT.replace("trunk", "&i;"), "DOCTYPE"),
    "include": (put('<include file="/etc/passwd"/>', "<asset>"), "<include> of '/etc/passwd'"),
    "huge picture": (
        swap('width="512" height="512"', 'width="99999999" height="99999999"'),
        "<texture> 'tiles'.* width is '99999999'.* to 8192",
    ),
    "huge memory": (swap('memory="4M"', 'memory="4000G"'), "memory is '4000G'.* at most 1G"),
    "nested deeply": (put(DEEP, "<worldbody>"), "nested deeper than 100"),
    "many bodies": (
        put("".join(f'<body name="b{i}"/>' for i in range(2000)), "<worldbody>"),
        "2011 bodies, expected at most 2000",
    ),
    "mass negative": (swap('mass="5.512"', 'mass="-5.512"'), "mass is '-5.512'.* above 0"),
    "range turned round": (
        swap('range="-2.38 -0.10"', 'range="-0.10 -2.38"'),
        "<joint> of 'knee'.* range is '-0.10 -2.38'.* lower one first",
    ),
    "misspelt attribute": (
        swap('mass="5.512"', 'mas="5.512"'),
        "MuJoCo refuses.* 'mas'.* did you mean 'mass'",
    ),
    "comma": (
        swap('fromto="0 -0.012 0 ', 'fromto="0,1 -0.012 0 ', 1),
        "bad format in attribute 'fromto' at <geom> of 'left_calf'",
    ),
    "degrees": (
        put('<body name="b" euler="0 0 90"/>', "<worldbody>"),
        "<body> 'b': euler is '0 0 90', expected rad, and these are degrees",
    ),
    "urdf with a comma": (
        "<!-- a\n\n-->" + re.sub('(?s)(left_knee".*?xyz=")[^ ]* ', r"\g<1>0,1 ", URDF, count=1),
        "bad format in attribute 'xyz' at <origin> of 'left_knee'",
    ),
    "urdf in degrees": (
        re.sub('(?s)(left_knee".*?rpy=")[^"]*', r"\g<1>0 180 0", URDF, count=1),
        "<origin> of 'left_knee': rpy is '0 180 0', expected rad, and these are degrees",
    ),
    "urdf with a shape of no size": (
        re.sub("(left_foot.*?)<visual>.*?</visual>", rf"\1{NO_SPHERE}", URDF),
        "<sphere> of 'left_foot': radius is '0', expected numbers above 0",
    ),
    "no standing pose": (swap('name="standing"', 'name="stand"'), "no keyframe 'standing'"),
    "renamed toe": (swap('"right_toe"', '"right_tip"'), "no sphere 'right_toe' on body"),
    "renamed joint": (
        swap("left_knee", "left_kneee"),
        "no joint 'left_knee'.* did you mean 'left_kneee'.* left_ankle",
    ),
    "knee axis reversed": (swap(KNEE, KNEE.replace("1", "-1")), "keyframe 'standing'.* expected"),
    "knee forwards": (swap('"-2.38 -0.10"', '"0.10 2.38"'), "left_knee' at -1.571"),
    "weak motor": (swap('ctrlrange="-67 67"', 'ctrlrange="-2 2"'), "'left_knee', which has 2"),
    "pose out of range": (swap(POSE, POSE.replace("-1.57", "-2.57")), "left_knee' at -2.571"),
    "out of balance": (swap(TRUNK, TRUNK.replace("0 0 0", "0.5 0 0")), "over the feet"),
    "toe off the sole": (
        swap('class="contact" pos="0.09 0 -0.03"', 'class="contact" pos="0.09 0 0"'),
        "left_toe.* 0.03 m above the floor",
    ),
    "swapped legs": (
        LEGS_SWAPPED,
        "left foot at y = -0.0942.* expected it left of the right one, at 0.0942",
    ),
}
RING = LINK + '<link name="a"/>' + HOLD.format("j", "a", "payload")
OF_LINKS = {  # what is put into a URDF, and what is told
    "a loose link": (LINK, "no joint holds payload, expected one tree below trunk"),
    "a repeated link": ('<link name="left_foot"/>', "got ['left_foot'] empty or twice"),
    "a repeated joint": (HOLD.format("left_knee", "trunk", "trunk"), "got ['left_knee'] empty or"),
    "no name": ("<link/>", "got [''] empty or twice"),
    "an unknown link": (HOLD.format("j", "trunk", "arm"), "joint 'j' joins ['trunk', 'arm'], exp"),
    "one end": ('<joint name="j"><parent link="trunk"/></joint>', "joint 'j' joins ['trunk']"),
    "two parents": (HOLD.format("j", "trunk", "left_foot"), "no other joint to have this child"),
    "a ring": (RING + HOLD.format("k", "payload", "a"), "links payload, a hang in a ring"),
}

MESH = '<geom type="mesh" mesh="thigh" density="900"/>'
COUPLED = '<equality><joint joint1="left_knee" joint2="left_ankle"/></equality>'
IN_WORLD = '<worldbody><geom type="{}"/></worldbody>'
SHORT = '<keyframe><key name="up" qpos="0 0 3"/></keyframe>'
SHIN_AS_FOOT = (Foot(None, ((0.0, 0.0, 0.0),), "left_shin"),) * 2
OF_PARTS = {  # parts of the small biped, and what is told
    "no mass": ({"shin": ""}, "body 'left_shin' moves and has no mass"),
    "a mesh's mass": ({"shin": MESH}, "body 'left_shin' has its mass from a mesh"),
    "joints of no leg": ({"weld": ()}, "joints waist, shoulder are of no leg: add them to weld"),
    "a misspelt motor": ({"motors": MOTOR.format("left_rol")}, "did you mean 'left_roll'"),
    "a coupled leg": ({"more": COUPLED}, "couples left_ankle, left_knee"),
    "terrain": ({"more": IN_WORLD.format('box" size="1 1 0.1')}, "is terrain"),
    "a low floor": ({"more": IN_WORLD.format('plane" size="1 1 1" pos="0 0 -1')}, "level at z = 0"),
    "a short keyframe": ({"more": SHORT, "standing": "up"}, "has 3 numbers"),
    "a shin as foot": ({"feet": SHIN_AS_FOOT}, "feet.left.body is 'left_shin'"),
    "out of order": (
        {"joints": (*JOINTS[1::-1], *JOINTS[2:])},
        "name each leg from the trunk down",
    ),
    "soles not level": (
        {"contacts": ((0.07, 0.0, -0.04), (-0.05, 0.0, -0.03))},
        "soles are not level",
    ),
}

HEAD = "must have left, right; or front_left, front_right, hind_left, hind_right, got "
ROLL, BODY = '"hind_left_roll"', 'body = "hind_left_calf"'
CONTACTS = '(front_left_calf"\n)contacts = .*'
OF_TABLE = {  # a change of the quadruped's TOML, and what is told
    "three feet": (
        r"(?s)\[feet.hind_right\].*?\n\n",
        "",
        f"{HEAD}front_left, front_right, hind_left$",
    ),
    "five legs": (
        r"\[joints\]",
        r'\g<0>\nleft = ["a", "b", "c"]',
        "joints: must have .* got left, fr",
    ),
    "a foot of another leg": (
        BODY,
        BODY.replace("hind", "front"),
        "feet.hind_left.body is 'front_left_calf', expected one that joint 'hind_left_knee'",
    ),
    "a joint of two legs": (
        ROLL,
        '"front_left_roll"',
        "different names, got 'front_left_roll' twice",
    ),
    "feet of two kinds": (
        CONTACTS,
        r"\1contacts = [[0.1, 0, -0.2326], [-0.1, 0, -0.2326]]",
        r"as many contacts, got \[2, 1, 1, 1\]",
    ),
    "three contacts": (
        CONTACTS,
        r"\1contacts = [[0, 0, -0.23], [0.1, 0, -0.23], [0, 0.1, -0.23]]",
        "1, 2 or 4 contacts",
    ),
    "hind legs swapped": (
        "hind_(left|right)(?=]| = )",
        lambda found: f"hind_{'right' if found[1] == 'left' else 'left'}",
        "the hind_left foot at y = -0.142, expected it left of the hind_right one",
    ),
    "no weights of moments": ("moment = 0.0085", "", "expert: missing field 'moment'"),
}


def load_text(folder, text):
    (folder / "robot.xml").write_text(text)
    load_robot(folder / "robot.xml")


def load_urdf(folder, text):
    robot_of(by_numbers(folder, text))


def load_parts(folder, parts):
    robot_of(small(folder, **parts))


def load_table(folder, change):
    file = EXAMPLES / "quadruped" / "robot.toml"
    (folder / file.name).write_text(replaced(file.read_text(), change))
    (folder / "quadruped.xml").write_bytes(file.with_name("quadruped.xml").read_bytes())
    walk_config(load_robot(folder / file.name))


def refusals():
    for name, (text, words) in OF_TEXT.items():
        yield pytest.param(partial(load_text, text=text), words, id=name)
    for name, (links, words) in OF_LINKS.items():
        text = URDF.replace("</robot>", f"{links}</robot>")
        yield pytest.param(partial(load_urdf, text=text), re.escape(words), id=name)
    text, words = urdf_of(HECTOR, effort=False), "'left_hip_yaw' has no torque limit"
    yield pytest.param(partial(load_urdf, text=text), words, id="no effort")
    for name, (parts, words) in OF_PARTS.items():
        yield pytest.param(partial(load_parts, parts=parts), words, id=name)
    for name, (*change, words) in OF_TABLE.items():
        yield pytest.param(partial(load_table, change=change), words, id=name)


@pytest.mark.parametrize(("load", "words"), list(refusals()))
def test_broken_and_hostile_files_are_told_in_one_line(load, words, monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        load(tmp_path)
    message = str(caught.value)
    assert message.startswith(str(tmp_path))
    assert "\n" not in message
    assert len(message) < 1000
    assert re.search(words, message)
    assert not list(tmp_path.glob("*LOG*"))  # of MuJoCo
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "asset",
    [
        '<mesh name="m" file="/etc/passwd"/>',
        '<mesh name="m" file="link/a.stl"/>',
        '<hfield name="m" file="a.png" size="1 1 1 1"/>',
        '<texture name="m" type="cube" fileup="../a.png"/>',
    ],
)
def test_meshes_and_pictures_are_never_opened(tmp_path, asset):
    folder = tmp_path / "robot"
    folder.mkdir()
    (tmp_path / "a.stl").write_text("solid secret")
    (folder / "link").symlink_to(tmp_path)
    (folder / "robot.xml").write_text(put(asset, "<asset>"))
    model = compile_model(describe(folder / "robot.xml"))
    assert (model.nmesh, model.nhfield, model.ntex) == (0, 0, 2)


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
    (tmp_path / "robot.xml").write_text(text)
    compile_model(describe(tmp_path / "robot.xml"))
