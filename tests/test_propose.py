"""What `hector robot` finds in a model, the TOML that it proposes, and the rules of its numbers."""

import re
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from published import small, urdf_of

from hector_jax.cli.main import main
from hector_jax.control.controller import walk_config
from hector_jax.core.inputs import InputError
from hector_jax.core.settings import as_toml
from hector_jax.importing.propose import HEIGHT, MASS, propose_robot
from hector_jax.importing.remarks import remarks
from hector_jax.importing.soles import find_soles
from hector_jax.importing.survey import survey_file
from hector_jax.robot.description import (
    DESCRIPTION_PATH,
    MODEL_PATH,
    description_of,
    read_description,
)
from hector_jax.robot.model import compile_model, load_robot, robot_of
from hector_jax.robot.response import response, swing_frequency
from hector_jax.tuning.loss import loss_of_robot

EXAMPLES = Path(__file__).parents[1] / "examples"
STRIDER, HUMANOID = (EXAMPLES / name / "robot.toml" for name in ("strider", "humanoid"))


def loaded(proposal):
    """Description, robot and controller of a proposal, from the text of its file."""
    table = tomllib.loads(as_toml(proposal.table, ["a comment"]))
    assert table == proposal.table
    description = description_of(proposal.survey.path.with_suffix(".toml"), table)
    robot = robot_of(description)
    loss_of_robot(description)
    return description, robot, walk_config(robot)


def call(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["hector", "robot", *map(str, words)])
    return main()


def standing(robot):
    model = compile_model(robot.description)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data


# What is found


@pytest.mark.parametrize("path", [DESCRIPTION_PATH, STRIDER, HUMANOID], ids=lambda p: p.parent.name)
def test_a_proposal_loads_and_names_joints_and_feet_as_the_robots_own_toml(path):
    own = read_description(path)
    proposal = propose_robot(own.model)
    assert proposal.wrong == ()
    description, robot, config = loaded(proposal)
    assert description.joints == own.joints
    for got, expected in zip(description.feet, own.feet, strict=True):
        assert (got.contacts, got.body) == (expected.contacts, expected.body)
    np.testing.assert_allclose(robot.foot_point, robot_of(own).foot_point, atol=1e-9)
    assert len(config.legs.kp) == own.leg_joints
    assert proposal.survey.forwards == (path == HUMANOID,)


def test_legs_are_told_from_arms_and_what_is_of_no_leg_is_welded(tmp_path):
    found = survey_file(small(tmp_path).model)
    legs = [[found.model.joint(j).name for j in leg] for leg in found.legs]
    assert legs == [
        [f"{s}_{j}" for j in ("roll", "pitch", "knee", "ankle")] for s in ("left", "right")
    ]
    assert set(found.weld) == {"waist", "shoulder"}
    assert found.model.body(found.trunk).name == "base"
    assert (found.knee, found.forwards) == (2, (True,))
    proposal = propose_robot(found.path)
    assert proposal.wrong == ()
    _, robot, _ = loaded(proposal)
    assert robot.structure.contact == "line"


def test_a_urdf_is_proposed_as_the_mjcf_that_it_came_from(tmp_path):
    description = read_description(HUMANOID)
    path = tmp_path / "humanoid.urdf"
    path.write_text(urdf_of(compile_model(description)))
    found, own = survey_file(path), survey_file(description.model)
    names = [[one.model.joint(j).name for leg in one.legs for j in leg] for one in (found, own)]
    assert names[0] == names[1]
    assert found.forwards == (True,)


def test_a_model_without_legs_names_its_chains(tmp_path):
    path = tmp_path / "arm.xml"
    joint = '<joint name="{0}" axis="0 1 0"/><geom size="0.1"/>'
    path.write_text(
        f"<mujoco><worldbody><body>{joint.format('one')}<body pos='0 0 1'>{joint.format('two')}"
        "</body></body></worldbody></mujoco>"
    )
    with pytest.raises(InputError, match=r"no two legs found, .* by their last joint: two \(2\)"):
        survey_file(path)


def meshes_only(folder):
    """A copy of the small biped whose feet are meshes."""
    path = small(folder).model
    text = path.read_text()
    text = text.replace('<geom type="box" size="0.06 0.03 0.01" pos="0.01 0 -0.03"/>', "")
    text = text.replace('<geom type="sphere" size="0.005" mass="0.01"/>', "")
    path.write_text(re.sub(r'<body name="\w+_cap"[^>]*>\s*</body>', "", text))
    return path


def test_soles_of_meshes_are_asked_for(monkeypatch, capsys, tmp_path):
    path, draft, out = (tmp_path / name for name in ("robot.xml", "draft.toml", "robot.toml"))
    proposal = propose_robot(meshes_only(tmp_path))
    assert all(sole.guessed for sole in proposal.soles)
    (line,) = [line for line in proposal.wrong if "guessed" in line]
    assert line.startswith("no box, sphere, capsule or cylinder of body 'left_foot' collides")
    assert line.endswith("measure the sole and correct feet.left and feet.right")
    assert call(monkeypatch, path, "--out", draft) == 2
    err = capsys.readouterr().err
    assert f"the proposal is in {draft}; mend it, then: hector robot {draft}" in err
    assert err.endswith(f"hector: {line}\n")
    assert f"# To be mended: {line}" in draft.read_text()
    assert read_description(draft).model == path
    # whoever leaves the contacts as they are takes them
    assert call(monkeypatch, draft, "--out", out) == 0
    assert f"walk with it: hector walk --robot {out}" in capsys.readouterr().err
    assert read_description(out).model == tmp_path / "robot-standard.xml"


def test_wrenches_act_in_the_middle_of_a_sole_with_a_short_heel(tmp_path):
    path = small(tmp_path).model
    path.write_text(path.read_text().replace('pos="0.01 0 -0.03"', 'pos="0.05 0 -0.03"'))
    proposal = propose_robot(path)
    assert proposal.wrong == ()
    assert "point" not in proposal.table["feet"]["left"]
    _, robot, _ = loaded(proposal)
    np.testing.assert_allclose(robot.foot_point[:, 0], 0.05, atol=1e-4)
    np.testing.assert_allclose([robot.toe, robot.heel], 0.06, atol=1e-4)
    _, data = standing(robot)
    ankles = [data.joint(f"{side}_ankle").xanchor[0] for side in ("left", "right")]
    assert abs(data.subtree_com[1][0] - np.mean(ankles)) < 1e-3
    assert not any("along -x" in line for line in remarks(robot))


def test_a_tilted_box_is_the_sole_and_is_level_standing(tmp_path):
    path = small(tmp_path).model
    text, box = path.read_text(), '<geom type="box" size="0.06 0.03 0.01" pos="0.01 0 -0.03"'
    text = re.sub(r'<geom type="sphere" size="0.005" mass="0.01"/>', "", text)
    assert text.count(box) == 2
    path.write_text(text.replace(box, f'{box} euler="0 0.2 0"'))
    for sole in find_soles(survey_file(path)):
        np.testing.assert_allclose(sole.axes[:, 2], [np.sin(0.2), 0.0, np.cos(0.2)], atol=1e-9)
    proposal = propose_robot(path)
    assert proposal.wrong == ()
    angles = proposal.table["standing"]
    total = sum(angles[f"left_{joint}"] for joint in ("pitch", "knee", "ankle"))
    assert total == pytest.approx(-0.2, abs=2e-3)


# The numbers


@pytest.fixture(scope="module")
def humanoid():
    proposal = propose_robot(HUMANOID.with_name("humanoid.xml"))
    return proposal, *loaded(proposal)


def test_the_standing_pose_bends_the_knees_and_balances_on_level_soles(humanoid):
    proposal, description, robot, _ = humanoid
    assert dict(description.standing)["left_knee"] == 1.0
    model, data = standing(robot)
    ankles = [data.joint(f"{side}_ankle_pitch").xanchor[0] for side in ("left", "right")]
    assert abs(data.subtree_com[1][0] - np.mean(ankles)) < 1e-3
    heights = [
        data.geom(name).xpos[2] - model.geom(name).size[0]
        for foot in description.named_feet
        for name in foot.contacts
    ]
    np.testing.assert_allclose(heights, 0.0, atol=1e-4)


def test_gains_follow_from_what_hangs_at_a_joint(humanoid):
    proposal, description, robot, config = humanoid
    I = response(robot).inertia[: description.leg_joints]  # noqa: E741
    kp, kd = np.array(config.legs.kp), np.array(config.legs.kd)
    most = 2.0 * robot.torque_limit[: description.leg_joints]
    w = swing_frequency(response(robot))
    assert 10.0 < w < 30.0
    np.testing.assert_allclose(kp, np.minimum(w**2 * I, most), rtol=6e-3)
    np.testing.assert_allclose(kd, np.sqrt(kp * I), rtol=1e-2)
    assert config.legs.gravity_compensation


def test_sizes_scale_with_mass_and_height(humanoid):
    _, description, robot, config = humanoid
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


# The command


def test_the_command_prints_the_table_and_the_proposal(monkeypatch, capsys):
    assert call(monkeypatch, MODEL_PATH) == 0
    out = capsys.readouterr().out
    table, text = out.split("\n\n", 1)
    assert table.startswith("robot    hector: 12 kg, trunk 'trunk'")
    assert "knees bend backwards" in table
    assert re.search(r"left_hip_yaw, right_hip_yaw +\+z yaw", table)
    assert "feet     line: " in table
    assert "mended   " in table
    assert "wrong    nothing" in table
    assert tomllib.loads(text)["joints"]["left"][0] == "left_hip_yaw"


def test_a_toml_is_checked(monkeypatch, capsys, tmp_path):
    assert call(monkeypatch, STRIDER) == 0
    assert "strider: 20 kg" in capsys.readouterr().out
    path = tmp_path / "robot.toml"
    path.write_text(STRIDER.read_text().replace("kp = [150, 150, 150, 150, 50]", "kp = [150]"))
    (tmp_path / "strider.xml").write_text(STRIDER.with_name("strider.xml").read_text())
    out = tmp_path / "new.toml"
    assert call(monkeypatch, path, "--out", out) == 2
    printed, err = capsys.readouterr()
    error = "legs.kp must be a gain for each of the 5 joints"
    assert error in err
    assert error in printed
    assert re.search(f"(?m)^# To be mended: .*{error}", out.read_text())


def test_a_proposal_is_written_once_and_beside_its_model(monkeypatch, capsys, tmp_path):
    model, out = small(tmp_path).model, tmp_path / "robot.toml"
    assert call(monkeypatch, model, "--out", out) == 0
    assert out.read_text().startswith("# Proposed by `hector robot ")
    assert read_description(out).model == tmp_path / "robot-standard.xml"
    assert call(monkeypatch, out) == 0
    other = tmp_path / "other" / "robot.toml"
    assert call(monkeypatch, model, "--out", other) == 0
    assert load_robot(other).mass == load_robot(out).mass
    other.unlink()
    capsys.readouterr()
    for wrong, text in (
        (out, "must be a new file"),
        (tmp_path / "robot.txt", "must end in .toml"),
        (other, "robot-standard.xml, which must be a new file"),
    ):
        assert call(monkeypatch, model, "--out", wrong) == 2
        assert text in capsys.readouterr().err


def test_a_model_that_cannot_be_used_is_shown_as_far_as_it_goes(monkeypatch, capsys, tmp_path):
    path = tmp_path / "humanoid.xml"
    text = HUMANOID.with_name("humanoid.xml").read_text()
    path.write_text(re.sub(r"<motor\b[^>]*/>", "", text))
    assert call(monkeypatch, path) == 2
    out, err = capsys.readouterr()
    draft = tomllib.loads(out[out.index("# Proposed") :])
    assert draft["joints"]["left"][3] == "left_knee"
    assert draft["feet"]["left"]["body"] == "left_foot"
    assert "'left_hip_pitch' has no torque limit, nor have left_hip_roll, " in err
    assert "To be mended: " in out


def test_what_is_likely_trouble_is_told():
    robot = robot_of(read_description(HUMANOID))
    assert not remarks(robot)
    bare = replace(
        robot.description, control=(("mpc", (("max_force", 900.0), ("sole_width", 0.6))),)
    )
    (heavy,) = remarks(robot._replace(description=bare))
    assert heavy.startswith("the legs are 41 % of the mass")
    described = replace(robot.description, control=(("mpc", (("max_force", 300.0),)),))
    assert any(
        "mpc.max_force is 300 N" in line for line in remarks(robot._replace(description=described))
    )
