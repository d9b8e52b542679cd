"""A robot with four legs as data: what is found, proposed, and read."""

import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from model import EXAMPLES, QUADRUPED
from pretend import call
from published import replaced

from hector_jax.core.trajectory import FEET
from hector_jax.importing.propose import propose_robot
from hector_jax.importing.remarks import remarks
from hector_jax.importing.survey import survey_file
from hector_jax.robot.model import robot_of

FILE = EXAMPLES / "quadruped" / "robot.toml"
MODEL = FILE.with_name("quadruped.xml")
LEGS = FEET[4]
TABLE = FILE.read_text()


def changed(folder, *changes):
    path = folder / "quadruped.xml"
    path.write_text(replaced(MODEL.read_text(), *changes))
    return path


def test_the_example_is_what_is_proposed_for_its_model():
    proposal = propose_robot(MODEL)
    assert (proposal.wrong, proposal.table) == ((), tomllib.loads(TABLE))
    assert proposal.survey.forwards == (False, False)


@pytest.mark.parametrize("ahead", [0.0, 0.3])
def test_an_anchor_may_be_anywhere_on_its_axis(tmp_path, ahead):
    """Also where the anchors of the hind legs are ahead of those of the front legs."""

    def proposed(roll, pitch):
        hips = ((rf'(<joint name="{end}_\w+_roll")', x) for end, x in roll.items())
        changes = [(hip, rf'\1 pos="{x} 0 0"') for hip, x in hips]
        for side, x in (("left", ahead), ("right", -ahead)):
            pose = f'axis="{x} 0.95 0" pos="{x * pitch} {0.95 * pitch} 0"'
            changes.append((rf'(<joint name="\w+_{side}_pitch")', rf"\1 {pose}"))
        return propose_robot(changed(tmp_path, *changes))

    own, got = proposed({}, 0.0), proposed({"front": -0.3, "hind": 0.3}, 0.06)
    assert got.error is None
    assert got.table["joints"] == own.table["joints"]
    assert got.table["standing"] == pytest.approx(own.table["standing"], abs=2e-4)
    for name in ("standing_height", "foot_ahead"):
        values = (getattr(x.robot, name) for x in (got, own))
        np.testing.assert_allclose(*values, atol=1e-4)


def test_springs_are_told_and_are_part_of_the_load(tmp_path):
    knee = '<joint range="-2.7227 -0.83776"'
    for stiffness in (0, 60, 300):
        spring = (knee, f'{knee} stiffness="{stiffness}" springref="-1.5"')
        proposal = propose_robot(changed(tmp_path, spring))
        lines = [line for line in remarks(proposal.robot) if "springs turn" in line]
        text = f"front_left_knee ({stiffness} N m/rad, standing {stiffness / 2:.3g} of 45.4 N m)"
        assert [text in line for line in lines] == [True] * (stiffness > 0)
        assert ("standing takes" in (proposal.error or "")) == (stiffness == 300)
    hip = ('<joint axis="1 0 0"', '<joint axis="1 0 0" stiffness="5"')
    (line,) = [x for x in remarks(propose_robot(changed(tmp_path, hip)).robot) if "springs" in x]
    assert "hind_right_roll (5 N m/rad, standing 0 of 23.7 N m)" in line


NAMED = [  # names of the legs in the file, and what is told
    (LEGS, ""),
    (("lf", "rf", "lh", "rh"), ""),
    (("FL", "FR", "RL", "RR"), ""),
    (("a", "b", "c", "d"), ""),
    (LEGS[2:] + LEGS[:2], "hind_left_roll is front, hind_right_roll is front, front_left_roll is "),
    (("FR", "FL", "RL", "RR"), "names, FR_roll is left, FL_roll is right: "),
    (("RR", "RL", "FR", "FL"), "RR_roll is front, .* FL_roll is hind, RR_roll is left, FR_roll"),
]


@pytest.mark.parametrize(("names", "told"), NAMED)
def test_names_of_other_places_are_told(tmp_path, names, told):
    path, new = changed(tmp_path), dict(zip(LEGS, names, strict=True))
    path.write_text(re.sub("|".join(LEGS), lambda x: new[x[0]], path.read_text()))
    lines = [line for line in remarks(propose_robot(path).robot) if "places" in line]
    assert len(lines) == bool(told)
    assert all(re.search(told, line) and "looks along -x" in line for line in lines)


def test_legs_are_found_in_any_order_and_by_any_name(tmp_path):
    text = MODEL.read_text()
    for i, leg in enumerate(LEGS):
        text = text.replace(leg, f"part{i}")
    front, middle, hind = (text.index(f'<body name="part{i}_hip"') for i in (0, 2, 3))
    end = text.index("    </body>\n  </worldbody>")
    text = text[:front] + text[hind:end] + text[middle:hind] + text[front:middle] + text[end:]
    path = tmp_path / "turned.xml"
    path.write_text(text)
    found = survey_file(path)
    names = [[found.model.joint(j).name for j in leg] for leg in found.legs]
    assert names == [[f"part{i}_{joint}" for joint in ("roll", "pitch", "knee")] for i in range(4)]
    assert propose_robot(path).wrong == ()


def test_motors_without_armature_get_one_by_their_torque_and_are_told(tmp_path):
    proposal = propose_robot(changed(tmp_path, (' armature="0.01"', "")))
    expected = 2e-4 * QUADRUPED.torque_limit[:3]
    assert proposal.table["joints"]["armature"] == pytest.approx(expected, rel=5e-3)
    assert remarks(QUADRUPED) == []
    (line,) = remarks(robot_of(replace(QUADRUPED.description, model=tmp_path / "quadruped.xml")))
    assert line.startswith("joint 'front_left_roll' has no armature")


def test_hind_knees_that_bend_the_other_way_are_told_and_stand(tmp_path, monkeypatch, capsys):
    knees = (r'(?=<joint name="hind_\w+_knee")<joint', '<joint range="0.83776 2.7227"')
    path = changed(tmp_path, knees, ("-0.5236 4.5379", "-4.5379 0.5236"))
    proposal = propose_robot(path)
    assert (proposal.wrong, proposal.survey.forwards) == ((), (False, True))
    angles = proposal.table["standing"]
    for joint in ("pitch", "knee"):
        front, hind = (angles[f"{pair}_left_{joint}"] for pair in ("front", "hind"))
        assert hind == pytest.approx(-front, abs=1e-3)
    assert call(monkeypatch, "robot", path) == 0
    assert "knees bend backwards in front and forwards behind" in capsys.readouterr().out


def test_a_shank_without_a_foot_stands_on_a_point_that_is_guessed_from_its_inertia(tmp_path):
    bare = ('size="0.012"', 'size="0.012" contype="0" conaffinity="0"')  # 0.202 m long
    proposal = propose_robot(changed(tmp_path, ('<geom class="foot"/>', ""), bare))
    assert proposal.error is None
    assert any("guessed" in line for line in proposal.wrong)
    for sole in proposal.soles:
        assert sole.guessed
        assert len(sole.contacts) == 1
        assert np.linalg.norm(sole.contacts) == pytest.approx(0.202, abs=0.005)


def test_pairs_that_are_not_alike_are_refused(tmp_path):
    toe = r'<body pos="0 0 -0.2"><joint name="\1_toe"/><geom size="0.01"/></body>'
    hind = (r'(?s)(hind_\w+)_calf".*?<geom class="foot"/>', rf"\g<0>{toe}")
    error = propose_robot(changed(tmp_path, hind)).error
    assert "2 pairs of chains of [4, 3] hinges end as low as legs" in error
