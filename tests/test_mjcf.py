"""Robot descriptions that are broken or mean harm: refused in one line that says what and where."""

import pytest

from hector_jax.robot.description import MODEL_PATH
from hector_jax.robot.model import compile_model, describe

TEXT = MODEL_PATH.read_text()


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
