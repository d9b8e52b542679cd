"""Robot descriptions that are broken or mean harm: refused in one line that says what and where."""

import struct

import pytest

from hector_jax.robot.description import MODEL_PATH
from hector_jax.robot.mjcf import read_mjcf
from hector_jax.robot.model import compile_model, describe

TEXT = MODEL_PATH.read_text()
HEAD = '<mujoco model="hector">'
ASSET = "<asset>"


def swap(old, new, count=-1):
    assert old in TEXT, old
    return TEXT.replace(old, new, count)


def put(text, after):
    return swap(after, after + text, 1)


def without(*marks):
    return "\n".join(line for line in TEXT.split("\n") if not any(mark in line for mark in marks))


DEEP = "<body>" * 5000 + "</body>" * 5000
BOMB = (
    '<!DOCTYPE m [<!ENTITY a "ha">'
    + "".join(
        f'<!ENTITY {y} "{f"&{x};" * 10}">' for x, y in zip("abcdefgh", "bcdefghi", strict=True)
    )
    + "]>"
)

HOSTILE = {
    "empty": ("", ["malformed XML"]),
    "blank": ("  \n", ["malformed XML"]),
    "prose": ("a robot with two legs", ["malformed XML"]),
    "json": ('{"mujoco": 1}', ["malformed XML"]),
    "cut": (TEXT[: len(TEXT) // 2], ["malformed XML", "line"]),
    "null bytes": (TEXT.replace("trunk", "tr\0nk"), ["malformed XML"]),
    "urdf": ('<robot name="hector"/>', ["<robot>", "expected <mujoco>"]),
    "only a root": ("<mujoco/>", ["free joints", "expected exactly one"]),
    "doctype": ('<!DOCTYPE mujoco SYSTEM "http://example.org/a.dtd">' + TEXT, ["DOCTYPE"]),
    "entities": (BOMB + TEXT.replace("trunk", "&i;"), ["DOCTYPE"]),
    "entity in lower case": ('<!entity x SYSTEM "/etc/passwd">' + TEXT, ["ENTITY"]),
    "include": (put('<include file="/etc/passwd"/>', HEAD), ["<include> of '/etc/passwd'"]),
    "include beside it": (
        put('<include file="other.xml"/>', HEAD),
        ["<include>", "self-contained"],
    ),
    "submodel": (put('<model name="m" file="m.xml"/>', ASSET), ["<model> of 'm.xml'"]),
    "replicas": (
        put('<replicate count="100000000"><geom size="1"/></replicate>', "<worldbody>"),
        ["<replicate>"],
    ),
    "composite": (
        put('<composite type="grid" count="9999 9999 1"/>', "<worldbody>"),
        ["<composite>"],
    ),
    "mesh far away": (put('<mesh file="/etc/passwd"/>', ASSET), ["<mesh> file", "'/etc/passwd'"]),
    "mesh above": (put('<mesh file="../secret.stl"/>', ASSET), ["'../secret.stl'", "own folder"]),
    "mesh folder above": (
        put('<compiler meshdir="../.."/>', HEAD).replace(ASSET, ASSET + '<mesh file="a.stl"/>'),
        ["meshdir refers to '../..'"],
    ),
    "mesh through a link": (put('<mesh file="link/a.stl"/>', ASSET), ["'link/a.stl'"]),
    "mesh not there": (
        put('<mesh name="shin" file="shinn.stl"/>', ASSET),
        ["<mesh> file: no file 'shinn.stl'", "did you mean 'shin.stl'"],
    ),
    "mesh that is none": (put('<mesh name="shin" file="shin.stl"/>', ASSET), ["MuJoCo refuses"]),
    "picture above": (
        put('<texture name="t" type="cube" fileup="../a.png"/>', ASSET),
        ["<texture> fileup", "'../a.png'"],
    ),
    "huge picture": (
        swap('width="512" height="512"', 'width="99999999" height="99999999"'),
        ["<texture> 'tiles'", "width is '99999999'", "to 8192"],
    ),
    "huge memory": (swap('memory="4M"', 'memory="4000G"'), ["memory is '4000G'", "at most 1G"]),
    "nested deeply": (put(DEEP, "<worldbody>"), ["nested deeper than 100"]),
    "many bodies": (
        put("".join(f'<body name="b{i}"/>' for i in range(300)), "<worldbody>"),
        ["311 bodies, expected at most 200"],
    ),
    "mass NaN": (
        swap('mass="5.512"', 'mass="nan"'),
        ["<inertial> of 'trunk'", "mass is 'nan'", "above 0"],
    ),
    "mass negative": (swap('mass="5.512"', 'mass="-5.512"'), ["mass is '-5.512'", "above 0"]),
    "mass nothing": (swap('mass="5.512"', 'mass="0"'), ["mass is '0'", "above 0"]),
    "mass infinite": (swap('mass="5.512"', 'mass="1e400"'), ["mass is '1e400'"]),
    "mass in words": (swap('mass="5.512"', 'mass="heavy"'), ["mass is 'heavy'"]),
    "gravity NaN": (
        swap('<option timestep="0.001"', '<option gravity="0 0 nan" timestep="0.001"'),
        ["<option>", "gravity is '0 0 nan'", "finite"],
    ),
    "step of time": (
        swap('timestep="0.001"', 'timestep="0.002"'),
        ["timestep is '0.002'", "expected 0.001, the step of all walks"],
    ),
    "range turned round": (
        swap('range="-2.38 -0.10"', 'range="-0.10 -2.38"'),
        ["<joint> of 'knee'", "range is '-0.10 -2.38'", "lower one first"],
    ),
    "armature negative": (
        swap('armature="0.016"', 'armature="-1"'),
        ["armature is '-1'", "least 0"],
    ),
    "no free joint": (without("<freejoint", "<key "), ["0 free joints", "left_hip_yaw"]),
    "nine actuators": (without('<motor name="right_ankle"'), ["9 actuators", "expected 10"]),
    "a motor at nothing": (
        swap('joint="left_knee"', 'joint="left_kneee"'),
        ["MuJoCo refuses", "'left_kneee'", "did you mean 'left_knee'"],
    ),
    "renamed foot": (
        swap('"left_foot_point"', '"left_fot_point"'),
        ["no site 'left_foot_point'", "did you mean 'left_fot_point'"],
    ),
    "misspelt attribute": (
        swap('mass="5.512"', 'mas="5.512"'),
        ["MuJoCo refuses", "'mas'", "did you mean 'mass'"],
    ),
    "misspelt element": (
        swap("<actuator>", "<actuators>").replace("</actuator>", "</actuators>"),
        ["MuJoCo refuses", "did you mean 'actuator'"],
    ),
    "a name twice": (swap('name="right_toe"', 'name="left_toe"'), ["MuJoCo refuses", "left_toe"]),
    "no standing pose": (swap('name="standing"', 'name="stand"'), ["no keyframe 'standing'"]),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a mesh that is none and a link that leads out of it."""
    folder = tmp_path_factory.mktemp("outer") / "robot"
    folder.mkdir()
    (folder / "shin.stl").write_text("solid nothing")
    (folder.parent / "a.stl").write_text("solid secret")
    (folder / "link").symlink_to(folder.parent)
    return folder


def refused(path):
    with pytest.raises(ValueError, match="robot.xml") as caught:
        compile_model(describe(path))
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 1000
    return message


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_descriptions_are_refused_in_one_line(
    name, folder, monkeypatch, tmp_path, capfd
):
    text, words = HOSTILE[name]
    monkeypatch.chdir(tmp_path)
    (folder / "robot.xml").write_text(text)
    message = refused(folder / "robot.xml")
    for word in words:
        assert word in message
    assert list(tmp_path.iterdir()) == []  # MuJoCo leaves no log
    assert capfd.readouterr() == ("", "")


def test_there_are_forty_of_them():
    assert len(HOSTILE) >= 40


def test_fifty_megabytes_are_refused_unread(folder):
    path = folder / "robot.xml"
    with path.open("wb") as file:
        file.truncate(50_000_000)
    assert "50.0 MB, expected at most 1 MB" in refused(path)


@pytest.mark.parametrize("data", [b"\xff\xfe\x00\x80", TEXT.encode("utf-16")])
def test_what_is_no_utf8_is_refused(folder, data):
    path = folder / "robot.xml"
    path.write_bytes(data)
    assert "not a text file" in refused(path)


def test_a_mesh_beside_the_file_is_taken(folder):
    corners = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.1)]
    faces = [corners[:i] + corners[i + 1 :] for i in range(4)]
    body = b"".join(struct.pack("<12fH", *[0.0] * 3, *sum(face, ()), 0) for face in faces)
    (folder / "meshes").mkdir()
    (folder / "meshes" / "tip.stl").write_bytes(bytes(80) + struct.pack("<I", 4) + body)
    text = put('<compiler meshdir="meshes"/>', HEAD)
    text = text.replace(ASSET, ASSET + '<mesh name="tip" file="tip.stl" inertia="shell"/>')
    (folder / "robot.xml").write_text(text)
    assert compile_model(describe(folder / "robot.xml")).nmesh == 1


def test_the_packaged_robot_passes():
    assert read_mjcf(MODEL_PATH).tag == "mujoco"
