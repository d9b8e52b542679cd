"""A robot with four legs as data: what is found, proposed, read, and what is refused."""

import re
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from hector_jax.cli.main import main
from hector_jax.control.controller import walk_config
from hector_jax.control.legs import stance_torques
from hector_jax.core.inputs import InputError
from hector_jax.core.trajectory import FEET, State, Wrench, pack_wrench
from hector_jax.importing.propose import propose_robot
from hector_jax.importing.remarks import remarks
from hector_jax.importing.survey import survey_file
from hector_jax.robot import srbm
from hector_jax.robot.description import description_of
from hector_jax.robot.kinematics import foot_poses, leg_gravity
from hector_jax.robot.model import compile_model, load_robot, robot_of

FILE = Path(__file__).parents[1] / "examples" / "quadruped" / "robot.toml"
MODEL = FILE.with_name("quadruped.xml")
ROBOT = load_robot(FILE)
LEGS = FEET[4]
TABLE = FILE.read_text()


def joints_of(leg):
    return [f"{leg}_{joint}" for joint in ("roll", "pitch", "knee")]


def changed(folder, *changes):
    """The model with some of its text replaced."""
    text = MODEL.read_text()
    for old, new in changes:
        assert re.search(old, text)
        text = re.sub(old, new, text)
    path = folder / "quadruped.xml"
    path.write_text(text)
    return path


# What is found and proposed


def test_the_example_is_what_is_proposed_for_its_model():
    proposal = propose_robot(MODEL)
    assert proposal.wrong == ()
    assert proposal.table == tomllib.loads(TABLE)
    assert proposal.survey.forwards == (False, False)


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
    assert names == [joints_of(f"part{i}") for i in range(4)]
    assert propose_robot(path).wrong == ()


def test_motors_without_armature_get_one_by_their_torque(tmp_path):
    proposal = propose_robot(changed(tmp_path, (' armature="0.01"', "")))
    assert proposal.table["joints"]["armature"] == pytest.approx(
        2e-4 * ROBOT.torque_limit[:3], rel=5e-3
    )
    assert "armature" not in tomllib.loads(TABLE)["joints"]
    assert remarks(ROBOT) == []
    (line,) = remarks(robot_of(replace(ROBOT.description, model=tmp_path / "quadruped.xml")))
    assert line.startswith("joint 'front_left_roll' has no armature")


HIND_PITCH = ("-0.5236 4.5379", "-4.5379 0.5236")
HIND_KNEES = (r'(?=<joint name="hind_\w+_knee")<joint', '<joint range="0.83776 2.7227"')


def test_hind_knees_that_bend_the_other_way_are_told_and_stand(tmp_path, monkeypatch, capsys):
    path = changed(tmp_path, HIND_KNEES, HIND_PITCH)
    proposal = propose_robot(path)
    assert proposal.wrong == ()
    assert proposal.survey.forwards == (False, True)
    angles = proposal.table["standing"]
    for joint in ("pitch", "knee"):
        assert angles[f"hind_left_{joint}"] == pytest.approx(
            -angles[f"front_left_{joint}"], abs=1e-3
        )
    monkeypatch.setattr(sys, "argv", ["hector", "robot", str(path)])
    assert main() == 0
    assert "knees bend backwards in front and forwards behind" in capsys.readouterr().out


def test_pairs_that_are_not_alike_are_refused(tmp_path):
    toe = r'<body pos="0 0 -0.2"><joint name="\1_toe"/><geom size="0.01"/></body>'
    hind = (r'(?s)(hind_\w+)_calf".*?<geom class="foot"/>', rf"\g<0>{toe}")
    with pytest.raises(
        InputError, match=r"2 pairs of chains of \[4, 3\] hinges end as low as legs"
    ):
        survey_file(changed(tmp_path, hind))


# What is read


def posed():
    """MuJoCo's model and data, standing."""
    model = compile_model(ROBOT.description)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data


def test_feet_are_pairs_from_the_front_and_mirror_images():
    assert ROBOT.description.legs == LEGS
    assert ROBOT.structure.contact == "point"
    assert ROBOT.structure.placed == (0, 1, 2)
    assert ROBOT.joint_origin.shape == (4, 3, 3)
    np.testing.assert_allclose(ROBOT.foot_ahead, [0.1934] * 2 + [-0.1934] * 2, atol=1e-4)
    feet = foot_poses(ROBOT, jnp.asarray(ROBOT.standing_joints)).position
    np.testing.assert_allclose(feet[1::2], feet[::2] * np.array([1, -1, 1]), atol=1e-12)
    mirrored = ROBOT.inertia * np.outer([1, -1, 1], [1, -1, 1])
    np.testing.assert_allclose(mirrored, ROBOT.inertia, atol=1e-9)


def test_joint_torques_of_four_feet_are_the_statics_of_mujoco():
    model, data = posed()
    points = np.array([data.site(foot.point).xpos for foot in ROBOT.description.named_feet])
    arms = points - data.subtree_com[1]
    # the least vertical forces that balance weight and moments
    A = np.stack([np.ones(4), arms[:, 0], arms[:, 1]])
    weight = float(ROBOT.mass * ROBOT.gravity[2])
    force = np.linalg.lstsq(A, [weight, 0.0, 0.0])[0][:, None] * [0.0, 0.0, 1.0]
    need = data.qfrc_bias.copy()
    for foot, of_foot in zip(ROBOT.description.named_feet, force, strict=True):
        J = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, J, None, model.site(foot.point).id)
        need -= J.T @ of_foot
    np.testing.assert_allclose(need[:6], 0.0, atol=1e-9)
    joints = jnp.asarray(ROBOT.standing_joints)
    state = State(*jnp.zeros((4, 3)))._replace(position=jnp.asarray(data.subtree_com[1]))

    @jax.jit
    def torques(wrench):
        weight = leg_gravity(ROBOT, joints, jnp.asarray(ROBOT.gravity))
        return stance_torques(ROBOT, state, joints, wrench) + weight

    found = torques(Wrench(jnp.asarray(force), jnp.zeros((4, 3))))
    np.testing.assert_allclose(found, need[6:], atol=1e-8)


def test_the_linearisation_has_a_column_for_each_force_and_moment():
    rng = np.random.default_rng(0)
    euler, dt = jnp.array([0.0, 0.0, 0.6]), 0.01
    state = State(euler, jnp.array([0.0, 0.0, 0.36]), *jnp.zeros((2, 3)))
    feet = jnp.asarray(rng.uniform(-0.3, 0.3, (4, 3)))
    _, B = jax.jit(lambda levers: srbm.linearise(ROBOT, euler, levers, dt))(feet - state.position)
    assert B.shape == (15, 24)

    @jax.jit
    def moved(wrench):
        rate = srbm.rates(jax.tree.map(jnp.asarray, ROBOT), state, wrench, feet)
        return jnp.concatenate([*(dt * x for x in rate), jnp.zeros(3)])

    wrench = Wrench(*jnp.asarray(rng.normal(size=(2, 4, 3))))
    free = moved(jax.tree.map(jnp.zeros_like, wrench))
    packed = np.asarray(pack_wrench(wrench))
    np.testing.assert_allclose(np.asarray(B) @ packed, moved(wrench) - free, atol=1e-12)


# What is refused


def swap(table, *legs):
    """Swap joints and feet of two legs, or of two pairs."""
    for part in ("joints", "feet"):
        for one, other in legs:
            table[part][one], table[part][other] = table[part][other], table[part][one]


WRONG = {
    "must have left, right; or front_left, front_right, hind_left, hind_right, got front_left, "
    "front_right, hind_left$": lambda t: t["feet"].pop("hind_right"),
    "joints: must have .* got left, front_left": lambda t: t["joints"].update(left=["a", "b", "c"]),
    "feet: unknown field 'rear_left'": lambda t: t["feet"].update(rear_left={}),
    "feet.hind_left.body is 'front_left_calf', expected one that joint 'hind_left_knee'": (
        lambda t: t["feet"]["hind_left"].update(body="front_left_calf")
    ),
    "different names, got 'front_left_roll' twice": lambda t: t["joints"].update(
        hind_left=t["joints"]["front_left"]
    ),
    r"as many contacts, got \[2, 1, 1, 1\]": lambda t: t["feet"].update(
        front_left={"point": "sole", "toe": "toe", "heel": "heel"}
    ),
    "the hind_left foot at y = -0.142, expected it left of the hind_right one": lambda t: swap(
        t, ("hind_left", "hind_right")
    ),
    "no joint 'knee'": lambda t: t["joints"]["hind_left"].__setitem__(2, "knee"),
    "1, 2 or 4 contacts": lambda t: t["feet"]["hind_left"].update(contacts=[[0, 0, 0]] * 3),
    "expert: missing field 'moment'": lambda t: t["weights"]["expert"].pop("moment"),
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_wrong_is_told_in_one_line(words):
    table = tomllib.loads(TABLE)
    WRONG[words](table)
    with pytest.raises(InputError, match=words) as error:
        walk_config(robot_of(description_of(FILE, table)))
    assert "\n" not in str(error.value)
