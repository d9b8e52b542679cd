"""Robot descriptions that are broken or mean harm: refused in one line that says what and where."""

import random
import re
import xml.etree.ElementTree as ElementTree

import mujoco
import pytest
from pretend import call
from published import urdf_of

from hector_jax.robot.description import MODEL_PATH
from hector_jax.robot.model import compile_model, describe

TEXT = MODEL_PATH.read_text()
URDF = urdf_of(mujoco.MjModel.from_xml_path(str(MODEL_PATH)))
EXAMPLES = MODEL_PATH.parents[1] / "examples"


def swap(old, new, count=-1):
    assert old in TEXT, old
    return TEXT.replace(old, new, count)


def put(text, after):
    return swap(after, after + text, 1)


DEEP = "<body>" * 5000 + "</body>" * 5000
BOMB = (
    '<!DOCTYPE m [<!ENTITY a "ha">'
    + "".join(
        f'<!ENTITY {y} "{f"&{x};" * 10}">' for x, y in zip("abcdefgh", "bcdefghi", strict=True)
    )
    + "]>"
)

HOSTILE = {
    "cut": (TEXT[: len(TEXT) // 2], ["malformed XML", "line"]),
    "a list": ("<list/>", ["<list>", "expected <mujoco> or <robot>"]),
    "urdf with NaN": (
        '<robot><link name="a"><inertial><origin xyz="0 nan 0"/></inertial></link></robot>',
        ["<origin>", "xyz is '0 nan 0'", "finite"],
    ),
    "entities": (BOMB + TEXT.replace("trunk", "&i;"), ["DOCTYPE"]),
    "include": (put('<include file="/etc/passwd"/>', "<asset>"), ["<include> of '/etc/passwd'"]),
    "huge picture": (
        swap('width="512" height="512"', 'width="99999999" height="99999999"'),
        ["<texture> 'tiles'", "width is '99999999'", "to 8192"],
    ),
    "huge memory": (swap('memory="4M"', 'memory="4000G"'), ["memory is '4000G'", "at most 1G"]),
    "nested deeply": (put(DEEP, "<worldbody>"), ["nested deeper than 100"]),
    "many bodies": (
        put("".join(f'<body name="b{i}"/>' for i in range(2000)), "<worldbody>"),
        ["2011 bodies, expected at most 2000"],
    ),
    "mass negative": (swap('mass="5.512"', 'mass="-5.512"'), ["mass is '-5.512'", "above 0"]),
    "range turned round": (
        swap('range="-2.38 -0.10"', 'range="-0.10 -2.38"'),
        ["<joint> of 'knee'", "range is '-0.10 -2.38'", "lower one first"],
    ),
    "misspelt attribute": (
        swap('mass="5.512"', 'mas="5.512"'),
        ["MuJoCo refuses", "'mas'", "did you mean 'mass'"],
    ),
    "comma": (
        swap('fromto="0 -0.012 0 ', 'fromto="0,1 -0.012 0 ', 1),
        ["bad format in attribute 'fromto' at <geom> of 'left_calf'"],
    ),
    "degrees": (
        put('<body name="b" euler="0 0 90"/>', "<worldbody>"),
        ["<body> 'b': euler is '0 0 90', expected rad, and these are degrees"],
    ),
    "urdf with a comma": (
        "<!-- a\n\n-->" + re.sub('(?s)(left_knee".*?xyz=")[^ ]* ', r"\g<1>0,1 ", URDF, count=1),
        ["bad format in attribute 'xyz' at <origin> of 'left_knee'"],
    ),
    "urdf in degrees": (
        re.sub('(?s)(left_knee".*?rpy=")[^"]*', r"\g<1>0 180 0", URDF, count=1),
        ["<origin> of 'left_knee': rpy is '0 180 0', expected rad, and these are degrees"],
    ),
    "urdf with a shape of no size": (
        re.sub(
            "(left_foot.*?)<visual>.*?</visual>",
            r'\1<collision><geometry><sphere radius="0"/>'
            "</geometry></collision>",
            URDF,
        ),
        ["<sphere> of 'left_foot': radius is '0', expected numbers above 0"],
    ),
    "no standing pose": (swap('name="standing"', 'name="stand"'), ["no keyframe 'standing'"]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_descriptions_are_refused_in_one_line(
    name, monkeypatch, tmp_path, capfd
):
    text, words = HOSTILE[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(ValueError, match="robot.xml") as caught:
        compile_model(describe(tmp_path / "robot.xml"))
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 1000
    for word in words:
        assert word in message
    assert [path.name for path in tmp_path.iterdir()] == ["robot.xml"]  # MuJoCo leaves no log
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
